# Copyright 2026 fluoro_calib_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""A correction that depends on the angle of the C-arm: live by joint states, and from a bag."""

from dataclasses import replace

import numpy as np
import pytest
import rigs
from fluoro_calib_msgs.srv import Calibrate
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from ros_graph import BAGS, NAMES, value_of
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from sensor_msgs.msg import JointState

from fluoro_calib_ros.bags.definitions import (
    ADDED,
    FLUOROSCOPE_CALIBRATION,
    Definition,
    earlier_text,
    from_cdr,
)
from fluoro_calib_ros.bags.writer import BagWriter
from fluoro_calib_ros.calibration.result import digest_of_sources
from fluoro_calib_ros.exposures.angles import AngleOptions
from fluoro_calib_ros.files.calibration import load_calibrations, save_calibration
from fluoro_calib_ros.files.phantom import read_phantom
from fluoro_calib_ros.jobs.sources import BagSelection, read_calibrated_source
from fluoro_calib_ros.nodes.messages.fields import stamp_from_nanoseconds
from fluoro_calib_ros.nodes.messages.fluoroscope_calibration import message_from_calibration

START_NS = 10**18
STEP_NS = 50_000_000  # between frames, and between states
FRAMES = 60
STATES = 40  # the last frames have none that is new enough
BEHIND_NS = 7_000_000  # of a frame after a state
JOINTS = 'a:frontal,b:lateral'
SIGNS = {'a': 1.0, 'b': -1.0}  # of the angles


@pytest.fixture
def turning(calibrated):
    """Folder with calibrations that depend on the angle, and the calibrations."""
    calibrations = {n: rigs.turning(c) for n, c in load_calibrations(calibrated).items()}
    for calibration in calibrations.values():
        save_calibration(calibrated, calibration)
    return calibrated, calibrations


def angle_of_state(number):
    """Return the angle at a state [rad], at the end beyond all calibrated ones."""
    return np.deg2rad(2.5 * number - 10) + 1e-9  # files have microdegrees


def joint_state(number, stamp_ns=None):
    message = JointState(name=['table', 'frontal', 'lateral'])
    stamp_ns = START_NS + STEP_NS * number if stamp_ns is None else stamp_ns
    message.header.stamp = stamp_from_nanoseconds(stamp_ns)
    angle = angle_of_state(number)
    message.position = [3.0, SIGNS['a'] * angle, SIGNS['b'] * angle]
    return message


def frames_of(tracking):
    """Return pairs of frames, each a little after a state, or where one would have been."""
    return [
        [
            replace(tracking[n][i], number=i, stamp_ns=START_NS + i * STEP_NS + BEHIND_NS)
            for n in NAMES
        ]
        for i in range(FRAMES)
    ]


def joint_output(client, readers):
    """Return a publisher of joint states whose readers are connected."""
    output = client.create_publisher(JointState, 'joint_states', QoSProfile(depth=1000))
    client.wait_until(lambda: output.get_subscription_count() == readers, what='readers of joints')
    return output


def publish_states(client, output, node, numbers):
    """Publish states, and wait until a node has them."""
    for number in numbers:
        output.publish(joint_state(number))
    for name in NAMES:
        client.wait_for_diagnostics(
            node, lambda s: value_of(s, 'joint states received') == str(len(numbers)), name
        )


def test_live_corrections_are_those_of_the_recorded_bag(graph, turning, tracking, tmp_path):
    """At angles that change, in a gap of the states, and beyond the calibrated angles."""
    folder, calibrations = turning
    client = graph.client
    heard = {n: client.listen(f'{n}/corrected_observations') for n in NAMES}
    topics = [f'{graph.namespace}/{n}/target_observations' for n in NAMES]
    recorder = graph.start(
        'recorder_node',
        {'folder': tmp_path / 'bag', 'topics': str(topics), 'angle_joint': "'carm'"},
    )
    node = graph.start(
        'correction_node', {'calibration_directory': folder, 'angle_joint': f"'{JOINTS}'"}
    )
    output = joint_output(client, 2)
    client.wait_for_diagnostics(
        'recorder_node', lambda s: value_of(s, 'topics') == '3', 'recorder'
    )
    graph.wait_for_readers(1)
    for name in NAMES:
        client.wait_for_diagnostics('correction_node', lambda s: value_of(s, 'calibration'), name)
    publish_states(client, output, 'correction_node', range(STATES))
    messages = [frame for pair in frames_of(tracking) for frame in pair]
    for number, frame in enumerate(messages):
        client.wait_until(
            lambda number=number: number - sum(map(len, heard.values())) < 20, what='the answers'
        )
        client.publish(frame)
    client.wait_until(lambda: sum(map(len, heard.values())) == len(messages), what='all frames')
    client.wait_for_diagnostics(
        'recorder_node',
        lambda s: value_of(s, 'messages') == str(STATES + len(messages)),
        'recorder',
    )
    recorder.interrupt()
    assert recorder.wait() == 0
    recording, _ = read_calibrated_source(
        tmp_path / 'bag',
        folder,
        validate=False,
        selection=BagSelection(angles=AngleOptions(JOINTS)),
    )
    known = STATES + 8  # the last frame within 0.5 s of the last state
    for name in NAMES:
        calibration = calibrations[name]
        statuses = set()
        for i, (frame, live) in enumerate(zip(recording.frames[name], heard[name], strict=True)):
            angle = SIGNS[name] * angle_of_state(min(i, STATES - 1)) if i <= known else None
            assert frame.number == live.frame_number == i
            assert frame.angle == (None if angle is None else pytest.approx(angle, abs=2e-8))
            offline = calibration.correct(frame.uv, frame.sigma, angle=frame.angle)
            assert np.array_equal(np.stack([live.u, live.v], axis=1), offline.uv, equal_nan=True)
            assert np.array_equal(live.sigma, offline.sigma, equal_nan=True)
            assert np.array_equal(live.status, offline.status)
            mean = calibration.correct(frame.uv, frame.sigma)
            if angle is not None:
                assert np.abs(mean.uv - offline.uv).max() > 0.1
            statuses.add((angle is None, live.status[0]))
        assert statuses == {(False, live.OK), (False, live.OUTSIDE), (True, live.OK)}
    unknown = FRAMES - known - 1
    status = client.wait_for_diagnostics(
        'correction_node', lambda s: value_of(s, 'frames without angle') == str(unknown)
    )
    assert value_of(status, 'angle [deg]') == ''
    note, _ = [n for n in recording.notes if 'have no angle' in n]
    assert f'{unknown} of {FRAMES} frames of fluoroscope a' in note
    assert any('depends on the angle' in n for n in recording.notes)
    assert node.log.count('the angle of the C-arm is unknown: joint frontal') == 1
    assert node.log.count('the angle of the C-arm is unknown: joint lateral') == 1


def test_diagnostics_say_which_angle_is_used_and_why_it_is_not_known(graph, turning, tracking):
    folder, _ = turning
    client = graph.client
    corrected = client.listen('a/corrected_observations')
    graph.start('correction_node', {'calibration_directory': folder, 'angle_joint': 'frontal'})
    output = joint_output(client, 1)
    client.wait_for_diagnostics('correction_node', lambda s: value_of(s, 'calibration'))
    frame = frames_of(tracking)[0][0]

    def status_after(number, condition):
        """Publish a frame again until the status of the node fulfils a condition."""
        stamped = replace(frame, number=number, stamp_ns=frame.stamp_ns + number * STEP_NS)

        def fulfilled():
            client.publish(stamped)
            status = client.statuses.get('correction_node: a')
            return status if status is not None and condition(status) else None

        return client.wait_until(fulfilled, what=f'the status of frame {number}')

    status = status_after(0, lambda s: 'angle of the C-arm is unknown' in s.message)
    assert 'joint frontal: it has no state yet; the mean correction' in status.message
    publish = [joint_state(8), joint_state(10, START_NS + 8 * STEP_NS + 1)]
    output.publish(publish[0])
    status = status_after(8, lambda s: value_of(s, 'angle [deg]'))
    assert value_of(status, 'angle [deg]') == '10.000'
    status_after(8, lambda s: s.message == 'correcting')
    output.publish(joint_state(36, START_NS + 20 * STEP_NS))
    status = status_after(20, lambda s: 'far from all calibrated' in s.message)
    assert '80.0 degrees, is far from all calibrated ones, the nearest is 60.0' in status.message
    status = status_after(400, lambda s: 'angle_max_age' in s.message)
    output.publish(JointState(name=['frontal'], position=[90.0], header=publish[0].header))
    assert corrected


def test_captured_exposures_get_their_angles(graph, exposures, tmp_path):
    """The calibration by the node is of the same frames and angles as one from a bag."""
    client = graph.client
    graph.calibration_node(tmp_path / 'saved', angle_joint="'a:frontal'", rig_frame='rig')
    heard = client.listen('a/calibration')
    output = joint_output(client, 1)
    pairs = list(zip(*(exposures[n] for n in NAMES)))
    expected = []
    for number, (frame, _) in enumerate(pairs):
        output.publish(joint_state(number, frame.stamp_ns - 1))
        expected.append(replace(frame, angle=float(angle_of_state(number))))
    client.wait_for_diagnostics(
        'calibration_node', lambda s: value_of(s, 'joint states received') == str(len(pairs))
    )
    for pair in pairs:
        for frame in pair:
            client.publish(frame)
    client.wait_for_status(lambda s: s.exposures == len(pairs))
    answer = client.call(Calibrate, 'calibrate', fluoroscopes=['a'], model='none')
    assert answer.success, answer.message
    client.wait_until(lambda: heard, what='the calibration')
    phantom = read_phantom(BAGS / 'phantom.csv')
    phantom = getattr(phantom, 'phantom', phantom)
    assert heard[-1].source_digest == digest_of_sources(expected, phantom)
    status = client.wait_for_diagnostics('calibration_node', lambda s: value_of(s, 'angle [deg]'))
    assert value_of(status, 'frames without angle') == '0'


def test_calibration_of_an_earlier_bag_is_used(graph, calibrated, tmp_path):
    """Recorded before the message had angles."""
    (tmp_path / 'play').mkdir()
    calibration = load_calibrations(calibrated)['a']
    data = serialize_message(message_from_calibration(calibration))
    present = from_cdr(data, FLUOROSCOPE_CALIBRATION)
    text = earlier_text(FLUOROSCOPE_CALIBRATION)
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(text, FLUOROSCOPE_CALIBRATION))
    added = (*ADDED[FLUOROSCOPE_CALIBRATION], '__msgtype__')
    earlier = store.types[FLUOROSCOPE_CALIBRATION](
        **{name: value for name, value in vars(present).items() if name not in added}
    )
    with BagWriter(tmp_path / 'bag') as writer:
        definition = Definition(text, 'ros2msg', store.hash_rihs01(FLUOROSCOPE_CALIBRATION))
        writer.add_topic('/a/calibration', FLUOROSCOPE_CALIBRATION, 'latched', definition)
        writer.write(
            '/a/calibration',
            FLUOROSCOPE_CALIBRATION,
            bytes(store.serialize_cdr(earlier, FLUOROSCOPE_CALIBRATION)),
            START_NS,
        )
    graph.start('correction_node')
    graph.play(tmp_path / 'bag', 1)
    status = graph.client.wait_for_diagnostics(
        'correction_node', lambda s: value_of(s, 'calibration')
    )
    assert value_of(status, 'calibration') == calibration.calibration_id


def test_joint_of_another_fluoroscope_keeps_a_node_from_starting(graph):
    process = graph.start('correction_node', {'angle_joint': "'c:frontal'"}, wait=False)
    assert process.wait() == 1
    assert "parameter angle_joint: there is no fluoroscope 'c', only a, b" in process.log
