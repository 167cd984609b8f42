# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Poses and joint angles are retracted when points they depend on are retracted, also in bags."""

import numpy as np
from fluoro_calib_msgs.msg import BodyPoses, JointAngles, Retraction
from rclpy.serialization import deserialize_message
from ros_graph import NAMES, value_of

from fluoro_calib_ros.io.bags.reader import iterate_messages, read_frames
from fluoro_calib_ros.io.bodies import joint_definition, read_bodies, read_joints, write_bodies
from fluoro_calib_ros.io.calibration import load_orientation, orientation_path
from fluoro_calib_ros.jobs.bodies import BodiesOptions, track_bodies
from fluoro_calib_ros.jobs.sources import read_calibrations
from fluoro_calib_ros.nodes.messages.observations import message_from_frame, stamp_from_nanoseconds
from fluoro_calib_ros.nodes.runtime.topics import observations_qos
from fluoro_calib_ros.simulation.knee import simulate_knee, virtual_knee, walking
from fluoro_calib_ros.simulation.rig import virtual_rig

RATE_HZ = 250.0
EXPOSURES = 12
TAKEN = 7  # row of the exposure with a retracted image point of a
FORMS = ('body_poses', 'joint_angles', 'retractions')


def started(graph, by_command, knee):
    """Start the nodes and a recorder; return the recorder."""
    client = graph.client
    files = {'bodies': graph.directory / 'bodies.csv', 'joints': graph.directory / 'joints.toml'}
    write_bodies(files['bodies'], knee.surveyed)
    files['joints'].write_text(joint_definition(knee.joint, knee.landmarks))
    given = {'calibration_directory': by_command}
    graph.start('correction_node', given)
    graph.start('reconstruction_node', {**given, **files})
    outputs = [f'reconstruction/{form}' for form in FORMS]
    for topic in outputs:
        client.listen(topic)
        client.wait_until(lambda topic=topic: client.count_publishers(topic), what=topic)
    topics = [*outputs, 'a/retractions', *(f'{name}/target_observations' for name in NAMES)]
    names = [f'{graph.namespace}/{topic}' for topic in topics]
    recorder = graph.start(
        'recorder_node', {'folder': graph.directory / 'bag', 'topics': str(names)}
    )
    for name in ('reconstruction_node', 'correction_node'):
        client.wait_until_known_to(name)
    for name in NAMES:
        client.wait_for_diagnostics(
            'correction_node',
            lambda s: value_of(s, 'calibration') and int(value_of(s, 'readers') or 0) >= 1,
            name,
        )
    client.wait_for_diagnostics(
        'reconstruction_node', lambda s: value_of(s, 'orientation'), 'reconstruction'
    )
    return recorder


def test_poses_by_points_that_are_taken_back(graph, by_command):
    client = graph.client
    knee = virtual_knee(1)
    motion = walking(knee, np.arange(EXPOSURES) / RATE_HZ)
    frames = simulate_knee(virtual_rig(1), knee, motion, seed=1).frames
    wrong = int(knee.bodies[1].target_id[0])
    taking = client.create_publisher(Retraction, 'a/retractions', observations_qos())
    recorder = started(graph, by_command, knee)
    # The reconstruction node and the recorder read frames and retractions.
    client.wait_until(lambda: taking.get_subscription_count() == 2, what='readers')
    client.wait_for_diagnostics(
        'recorder_node', lambda s: value_of(s, 'topics') == '6', 'recorder', 'its topics'
    )
    poses, joints, points = (client.messages[f'reconstruction/{form}'] for form in FORMS)
    pairs = [(n, message_from_frame(frames[n][row])) for row in range(EXPOSURES) for n in NAMES]
    client.publish_in_step(pairs, lambda: 2 * len(poses))
    client.wait_until(lambda: len(poses) == len(joints) == EXPOSURES, what='all exposures')
    frame = frames['a'][TAKEN]
    message = Retraction(frame_number=frame.number, target_id=[wrong])
    message.header.stamp = stamp_from_nanoseconds(frame.stamp_ns)
    message.header.frame_id = frame.frame_id
    taking.publish(message)
    client.wait_until(lambda: len(poses) == len(joints) == EXPOSURES + 1, what='what replaces it')
    before, after = poses[TAKEN], poses[-1]
    assert before.status[1] == BodyPoses.OK and after.header == before.header
    assert after.frame_number == before.frame_number and after.body == ['tibia']
    assert after.orientation_id == before.orientation_id
    assert list(after.status) == [BodyPoses.FAILED]
    assert np.isnan([after.x[0], after.qw[0], *after.covariance]).all()
    assert joints[-1].header == joints[TAKEN].header and joints[-1].joint == ['knee']
    assert list(joints[-1].status) == [JointAngles.FAILED] and np.isnan(joints[-1].angle).all()
    client.wait_until(lambda: len(points) == 1, what='the point')
    client.wait_for_diagnostics(
        'reconstruction_node', lambda s: value_of(s, 'poses retracted') == '1', 'reconstruction'
    )
    count = 2 * EXPOSURES + 1 + sum(map(len, (poses, joints, points)))
    client.wait_for_diagnostics(
        'recorder_node', lambda s: int(value_of(s, 'messages')) >= count, 'recorder'
    )
    recorder.interrupt()
    assert recorder.wait() == 0, recorder.log
    check_bag(graph, (poses, joints))
    check_offline(graph.directory, by_command, frames, wrong)


def check_bag(graph, published):
    """Check that the messages are recorded and played in the order of publication."""
    client = graph.client
    place = f'{graph.namespace.strip("/")}/reconstruction'
    again = [client.listen(f'{place}/{form}') for form in FORMS[:2]]
    topics = [f'{graph.namespace}/reconstruction/{form}' for form in FORMS[:2]]
    for topic, kind, expected in zip(topics, (BodyPoses, JointAngles), published):
        messages = iterate_messages(graph.directory / 'bag', [topic])
        found = [deserialize_message(m.data, kind) for m in messages]
        assert list(map(repr, found)) == list(map(repr, expected))
    played = {'bag': graph.directory / 'bag', 'rate': 10.0, 'topics': str(topics)}
    graph.start('player_node', played, wait=False)
    for found, expected in zip(again, published):
        client.wait_until(lambda f=found, e=expected: len(f) == len(e), what='what is played')
        assert list(map(repr, found)) == list(map(repr, expected))


def check_offline(folder, by_command, frames, wrong):
    """Check that the poses of the bag are those without the retracted image point."""
    bodies = read_bodies(folder / 'bodies.csv')
    joints = read_joints(folder / 'joints.toml', bodies)
    orientation = load_orientation(orientation_path(by_command))
    options = BodiesOptions(smooth='lag', lag=0, estimate_shapes=False)

    def angles(recorded):
        outcome = track_bodies(
            recorded,
            read_calibrations(by_command),
            orientation,
            bodies=bodies,
            joints=joints,
            options=options,
        )
        return outcome.joints[0].angles

    kept = [
        frame.rows(frame.target_id != wrong) if row == TAKEN else frame
        for row, frame in enumerate(frames['a'])
    ]
    of_bag = angles(read_frames(folder / 'bag').frames)
    assert np.array_equal(of_bag, angles({**frames, 'a': kept}))
    assert np.abs(of_bag - angles(frames))[TAKEN].max() > 0
