# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Correction that depends on the C-arm angle: live from joint states, and from a bag."""

from array import array
from dataclasses import replace

import numpy as np
import pytest
import rigs
from fluoro_calib_msgs.srv import Calibrate
from rclpy.duration import Duration
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from ros_graph import BAGS, NAMES, value_of
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from sensor_msgs.msg import Image, JointState

import tests.images.test_markers as markers
from benchmarks.bead_images import bead_image
from fluoro_calib_ros.correction.fluoroscope_calibration import digest_of_sources
from fluoro_calib_ros.exposures.angles import AngleOptions
from fluoro_calib_ros.exposures.frame import angle_in_degrees
from fluoro_calib_ros.images.angle_maps import AngleMaps
from fluoro_calib_ros.images.markers import FirstMarkers
from fluoro_calib_ros.io.bags.metadata import (
    ADDED,
    FLUOROSCOPE_CALIBRATION,
    Definition,
    earlier_text,
    from_cdr,
)
from fluoro_calib_ros.io.bags.writer import BagWriter
from fluoro_calib_ros.io.calibration import load_calibrations, save_calibration
from fluoro_calib_ros.io.phantom import read_phantom
from fluoro_calib_ros.jobs.followers import MarkerSettings
from fluoro_calib_ros.jobs.sources import BagSelection, read_calibrated_source
from fluoro_calib_ros.nodes.messages.fluoroscope_calibration import message_from_calibration
from fluoro_calib_ros.nodes.messages.observations import stamp_from_nanoseconds
from fluoro_calib_ros.nodes.runtime.streams import FaultHandlers, StreamReader
from fluoro_calib_ros.nodes.runtime.topics import images_qos

START_NS = 10**18
STEP_NS = 50_000_000  # between frames, and between joint states
FRAMES = 60
STATES = 40  # the last frames have no joint state that is recent enough
BEHIND_NS = 7_000_000  # delay of a frame after its joint state
JOINTS = 'a:frontal,b:lateral'
SIGNS = {'a': 1.0, 'b': -1.0}  # of the angles


@pytest.fixture
def turning(calibrated):
    """Folder with calibrations that depend on the angle, and these calibrations."""
    calibrations = {n: rigs.turning(c) for n, c in load_calibrations(calibrated).items()}
    for calibration in calibrations.values():
        save_calibration(calibrated, calibration)
    return calibrated, calibrations


def angle_of_state(number):
    """Return the angle at a state [rad]; the last ones exceed the calibrated range."""
    return np.deg2rad(2.5 * number - 10) + 1e-9  # files store microdegrees


def joint_state(number, stamp_ns=None):
    message = JointState(name=['table', 'frontal', 'lateral'])
    stamp_ns = START_NS + STEP_NS * number if stamp_ns is None else stamp_ns
    message.header.stamp = stamp_from_nanoseconds(stamp_ns)
    angle = angle_of_state(number)
    message.position = [3.0, SIGNS['a'] * angle, SIGNS['b'] * angle]
    return message


def frames_of(tracking):
    """Return pairs of frames, each shortly after a state or after the time of a missing one."""
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
    """Publish states and wait until a node has received them."""
    for number in numbers:
        output.publish(joint_state(number))
    for name in NAMES:
        client.wait_for_diagnostics(
            node, lambda s: value_of(s, 'joint states received') == str(len(numbers)), name
        )


def test_live_corrections_are_those_of_the_recorded_bag(graph, turning, tracking, tmp_path):
    """Covers changing angles, a gap in the states, and angles beyond the calibrated range."""
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
        """Publish a frame repeatedly until the status of the node fulfils a condition."""
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


def image_message(image, name, stamp_ns):
    encoding = 'mono8' if image.dtype == np.uint8 else 'mono16'
    message = Image(height=image.shape[0], width=image.shape[1], encoding=encoding)
    message.step = image.shape[1] * image.itemsize
    message.data = array('B', image.tobytes())
    message.header.stamp = stamp_from_nanoseconds(stamp_ns)
    message.header.frame_id = f'{name}_optical'
    return message


def test_images_are_corrected_at_the_angle_of_their_stamp(graph, turning, exposures):
    """Uses the maps of the angle; where it is unknown, the mean, which the node reports."""
    folder, calibrations = turning
    client = graph.client
    found = {n: [] for n in NAMES}
    shown = {n: client.create_publisher(Image, f'{n}/image_raw', images_qos()) for n in NAMES}
    for name in NAMES:
        client.create_subscription(Image, f'{name}/image_corrected', found[name].append, 30)
    node = graph.start(
        'image_node', {'calibration_directory': folder, 'angle_joint': f"'{JOINTS}'"}
    )
    output = joint_output(client, len(NAMES))  # each fluoroscope has its own thread reading them
    for name in NAMES:
        client.wait_until(shown[name].get_subscription_count, what='the reader of images')
        client.wait_until(
            lambda name=name: client.count_publishers(f'{name}/image_corrected'), what='images'
        )
        client.wait_for_diagnostics('image_node', lambda s: value_of(s, 'calibration'), name)
    publish_states(client, output, 'image_node', range(STATES))
    pictures = {n: bead_image(exposures[n][0].uv, exposures[n][0].image_size) for n in NAMES}

    def corrected(name, stamp_ns):
        """Return the pixels that the node publishes for an image with a given stamp."""
        message = image_message(pictures[name], name, stamp_ns)
        shown[name].publish(message)

        def answer():
            return next((m for m in found[name] if m.header == message.header), None)

        out = client.wait_until(answer, what='the corrected image')
        return np.frombuffer(out.data, np.uint8).reshape(out.height, out.width)

    for name in NAMES:
        maps = AngleMaps(calibrations[name])
        mean = maps.mean.correct(pictures[name])
        for number in (8, 20):
            pixels = corrected(name, START_NS + number * STEP_NS + BEHIND_NS)
            at_angle = maps.at(SIGNS[name] * angle_of_state(number)).correct(pictures[name])
            assert np.array_equal(pixels, at_angle)
            assert not np.array_equal(pixels, mean)
        # A stationary arm needs no further map.
        assert np.array_equal(corrected(name, START_NS + 20 * STEP_NS + BEHIND_NS + 1), at_angle)
        status = client.wait_for_diagnostics(
            'image_node', lambda s: value_of(s, 'maps made for angles') == '2', name
        )
        assert value_of(status, 'angle [deg]') == f'{SIGNS[name] * 40:.3f}'
        before = corrected(name, START_NS - 1)
        assert np.array_equal(before, mean)
        status = client.wait_for_diagnostics(
            'image_node', lambda s: value_of(s, 'frames without angle') == '1', name
        )
        assert value_of(status, 'angle [deg]') == ''
    assert node.log.count('angle of the C-arm is unknown: joint frontal: it has no state at') == 1

    def status_while_shown(number, condition):
        """Publish images with a given stamp until the status of the node fulfils a condition."""

        def fulfilled():
            corrected('a', START_NS + number * STEP_NS + next(later))
            status = client.statuses.get('image_node: a')
            return status if status is not None and condition(status) else None

        later = iter(range(10**6))
        return client.wait_until(fulfilled, what=f'the status of images {number}')

    status = status_while_shown(60, lambda s: 'angle_max_age' in s.message)
    assert 'the mean correction over all angles is used' in status.message
    status = status_while_shown(39, lambda s: 'far from all calibrated' in s.message)
    assert 'the correction of the images is extrapolated' in status.message
    status_while_shown(20, lambda s: s.message == 'correcting')


def test_states_are_taken_before_each_image_that_waits(graph):
    """Otherwise a queued image would get the angle of the first image in the queue."""
    client = graph.client
    heard = []
    faults = FaultHandlers(heard.append, lambda *fault: heard.append(fault), heard.append)
    reader = StreamReader(client, faults)
    outputs = {}
    for topic in ('slow', 'first'):
        reader.subscribe(
            JointState,
            topic,
            lambda message, _, topic=topic: heard.append((topic, message.name[0])),
            QoSProfile(depth=10),
            first=faults if topic == 'first' else None,
        )
        outputs[topic] = client.create_publisher(JointState, topic, QoSProfile(depth=10))
        client.wait_until(outputs[topic].get_subscription_count, what=topic)
    for number in range(3):
        outputs['slow'].publish(JointState(name=[f'{number}']))
        outputs['first'].publish(JointState(name=[f'{number}']))
    for output in outputs.values():
        assert output.wait_for_all_acked(Duration(seconds=30))
    reader.start()
    client.wait_until(lambda: len(heard) == 6, what='all messages')
    reader.stop()
    assert heard[:3] == [('first', str(number)) for number in range(3)]
    assert heard[3:] == [('slow', str(number)) for number in range(3)]


def test_markers_are_followed_at_the_angles_of_their_images(graph, tmp_path):
    """Doubtful ids equal those found offline; the mean correction would have decided otherwise."""
    markers.save_turning(tmp_path / 'result')
    markers.write_turned_first(tmp_path / 'first.csv')
    first = {
        name: FirstMarkers(each.target_id, np.round(each.uv, 6))
        for name, each in markers.turned_first().items()
    }
    bodies = markers.followed_bodies()

    def rounded(number):  # as the angles of joint states are
        angles = markers.angles_of_exposure(number)
        return {name: np.radians(angle_in_degrees(angle)) for name, angle in angles.items()}

    def offline(known):
        follower = MarkerSettings(
            first, markers.OPTIONS, markers.turning(), markers.turning_orientation(), bodies
        )()
        return [
            follower.extract(images, n, (), rounded(n) if known else None)
            for n, images in enumerate(markers.turned_images(), 1)
        ]

    def doubtful(found):
        return [sum(each.doubtful for each in of.values()) for of in found]

    at_angle = offline(True)
    pairs = enumerate(zip(doubtful(at_angle), doubtful(offline(False))))
    last = next(number for number, (one, other) in pairs if one != other)
    client = graph.client
    found = {n: client.listen(f'{n}/target_observations') for n in NAMES}
    shown = {n: client.create_publisher(Image, f'{n}/image_raw', images_qos()) for n in NAMES}
    texts = [f'{body.name}: ' + ' '.join(map(str, body.target_id)) for body in bodies]
    parameters = {
        'mode': 'markers',
        'markers': tmp_path / 'first.csv',
        'calibration_directory': tmp_path / 'result',
        'clusters': str(texts),
        'shutter': markers.OPTIONS.shutter,
        'angle_joint': f"'{JOINTS}'",
    }
    node = graph.start('extraction_node', parameters)
    output = joint_output(client, 1)
    client.wait_until(
        lambda: all(p.get_subscription_count() for p in shown.values()), what='readers'
    )
    for number in range(1, last + 2):
        state = JointState(name=['frontal', 'lateral'])
        state.header.stamp = stamp_from_nanoseconds(START_NS + number * STEP_NS)
        state.position = [markers.angle_at(n, number) for n in NAMES]
        output.publish(state)
    client.wait_for_diagnostics(
        'extraction_node', lambda s: value_of(s, 'joint states received') == str(last + 1)
    )

    def show(number, stamp_ns):
        for name, image in markers.turned_images()[number - 1].items():
            message = image_message(image, name, stamp_ns)
            shown[name].publish(message)

    for number in range(1, last + 2):
        show(number, START_NS + number * STEP_NS + BEHIND_NS)
        client.wait_until(
            lambda number=number: all(len(each) == number for each in found.values()),
            what=f'the markers of exposure {number}',
        )
        for name in NAMES:
            expected = at_angle[number - 1][name]
            assert list(found[name][-1].target_id) == expected.target_id.tolist()
            assert np.array_equal(np.stack([found[name][-1].u, found[name][-1].v], 1), expected.uv)
    for name in NAMES:
        status = client.wait_for_diagnostics(
            'extraction_node', lambda s: value_of(s, 'images extracted') == str(last + 1), name
        )
        assert value_of(status, 'doubtful') == str(at_angle[last][name].doubtful)
        angle = np.degrees(markers.angle_at(name, last + 1))
        assert value_of(status, 'angle [deg]') == f'{angle:.3f}'
        assert value_of(status, 'frames without angle') == '0'
    assert node.running and 'Traceback' not in node.log

    def unknown():
        """Publish the next exposure that is too late for the last state; return its status."""
        count = len(found['b'])
        show(last + 1, START_NS + next(late) * 10**9)
        client.wait_until(lambda: len(found['b']) > count, what='its markers')
        status = client.statuses.get('extraction_node: a')
        return status if status is not None and 'predicted by the mean' in status.message else None

    late = iter(range(100, 10**6))
    status = client.wait_until(unknown, what='the status')
    assert 'joint frontal: its last state is' in status.message


def test_captured_exposures_get_their_angles(graph, exposures, tmp_path):
    """The node calibrates from the same frames and angles as a calibration from a bag."""
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
    """The bag was recorded before the message had angles and a noise profile."""
    (tmp_path / 'play').mkdir()
    calibration = replace(load_calibrations(calibrated)['a'], noise_profile=None)
    data = serialize_message(message_from_calibration(calibration))
    present = from_cdr(data, FLUOROSCOPE_CALIBRATION)
    text = earlier_text(FLUOROSCOPE_CALIBRATION)
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(text, FLUOROSCOPE_CALIBRATION))
    added = [name for names in ADDED[FLUOROSCOPE_CALIBRATION] for name in names] + ['__msgtype__']
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
