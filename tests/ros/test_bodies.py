# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Bones and joints of a knee, live: bit for bit those of the offline job, in all message types."""

from dataclasses import replace

import numpy as np
import pytest
from fluoro_calib_msgs.msg import BodyPoses, JointAngles
from rclpy.serialization import deserialize_message
from ros_graph import NAMES, value_of

from fluoro_calib_ros.io.bags.reader import iterate_messages
from fluoro_calib_ros.io.bodies import joint_definition, read_bodies, read_joints, write_bodies
from fluoro_calib_ros.io.calibration import load_orientation, orientation_path
from fluoro_calib_ros.jobs.bodies import BodiesOptions, track_bodies
from fluoro_calib_ros.jobs.sources import read_calibrations
from fluoro_calib_ros.nodes.messages.bodies import FORMS as OPTIONAL
from fluoro_calib_ros.nodes.messages.observations import message_from_frame
from fluoro_calib_ros.photogrammetry.rotations import vector_from_matrix
from fluoro_calib_ros.simulation.knee import simulate_knee, virtual_knee, walking
from fluoro_calib_ros.simulation.rig import virtual_rig

RATE_HZ = 250.0
EXPOSURES = 90
STEP_S = 1e-4  # seconds; step of a difference quotient
ONE_VIEW = range(30, 40)  # exposures with the tibia in one view only
HIDDEN = range(50, 54)  # exposures with the tibia in no view
GONE = range(70, EXPOSURES)  # tibia in no view, for longer than its motion can be predicted
NEUTRAL = (1, 10)
JOINTS = ('joint_angles', 'joint_states')
SEEN = 'since last seen [s]'
PAUSE_S = 0.05  # between the last exposures; longer than before
LAST_SEEN = f'{len(GONE) / RATE_HZ + (len(GONE) - 1) * PAUSE_S:.3f}'  # at the last exposure [s]
FORMS = (
    'body_poses',
    *JOINTS,
    'bodies/tibia/pose',
    'bodies/tibia/odometry',
    *OPTIONAL,
)


def knee_frames():
    """Frames of a knee by fluoroscope, in which the tibia is not always visible."""
    knee = virtual_knee(1)
    motion = walking(knee, np.arange(EXPOSURES) / RATE_HZ)
    frames = simulate_knee(virtual_rig(1), knee, motion, seed=1).frames
    tibia = knee.bodies[1].target_id
    out = {}
    for name, of_view in frames.items():
        out[name] = []
        for row, frame in enumerate(of_view):
            stamp = frame.stamp_ns
            if row >= GONE.start:
                stamp += round((row - GONE.start) * PAUSE_S * 1e9)
            hidden = row in HIDDEN or row in GONE or (row in ONE_VIEW and name == 'b')
            keep = ~np.isin(frame.target_id, tibia) if hidden else slice(None)
            out[name].append(
                replace(frame, stamp_ns=stamp, target_id=frame.target_id[keep], uv=frame.uv[keep])
            )
    return knee, out


def write_files(knee, folder):
    """Write bodies.csv and joints.toml; return the parameters of the node."""
    write_bodies(folder / 'bodies.csv', knee.surveyed)
    text = joint_definition(knee.joint, knee.landmarks)
    neutral = f'neutral = {list(NEUTRAL)}\n\n[joint.proximal_frame'
    (folder / 'joints.toml').write_text(text.replace('\n[joint.proximal_frame', neutral))
    return {'bodies': folder / 'bodies.csv', 'joints': folder / 'joints.toml'}


@pytest.fixture(scope='module')
def live(module_graph, by_command, tmp_path_factory):
    """All nodes and a recorder, after all exposures of a knee."""
    graph = module_graph
    client = graph.client
    folder = tmp_path_factory.mktemp('knee')
    knee, graph.frames = knee_frames()
    graph.files = write_files(knee, folder)
    given = {'calibration_directory': by_command}
    graph.start('correction_node', given)
    graph.reconstruction = graph.start('reconstruction_node', {**given, **graph.files})
    topics = [f'reconstruction/{form}' for form in FORMS]
    for topic in (*topics, '/tf'):
        client.listen(topic)
        client.wait_until(lambda topic=topic: client.count_publishers(topic), what=topic)
    graph.bag = folder / 'bag'
    names = [f'{graph.namespace}/{topic}' for topic in topics]
    recorder = graph.start('recorder_node', {'folder': graph.bag, 'topics': str(names)})
    client.wait_for_diagnostics(
        'recorder_node', lambda s: value_of(s, 'topics') == str(len(names)), 'recorder'
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
    came = client.messages['reconstruction/body_poses']
    pairs = [
        (n, message_from_frame(graph.frames[n][row])) for row in range(EXPOSURES) for n in NAMES
    ]
    client.publish_in_step(pairs, lambda: 2 * len(came))
    for topic in ('reconstruction/body_poses', *(f'reconstruction/{f}' for f in JOINTS), '/tf'):
        found = client.messages[topic]
        client.wait_until(lambda found=found: len(found) == EXPOSURES, what=topic)
    # Statuses come once a second: the last one before may belong to the neutral trial.
    graph.statuses = {
        name: client.wait_for_diagnostics('reconstruction_node', lambda s: s.level == b'\0', name)
        for name in ('body femur', 'joint knee')
    }
    graph.lost = client.wait_for_diagnostics(
        'reconstruction_node',
        lambda s: value_of(s, 'status') == 'FAILED' and value_of(s, SEEN) == LAST_SEEN,
        'body tibia',
    )
    count = sum(len(client.messages[topic]) for topic in topics)
    client.wait_for_diagnostics(
        'recorder_node', lambda s: int(value_of(s, 'messages')) >= count, 'recorder'
    )
    recorder.interrupt()
    assert recorder.wait() == 0, recorder.log
    return graph


@pytest.fixture(scope='module')
def offline(live, by_command):
    """The same exposures processed by the command's offline job."""
    bodies = read_bodies(live.files['bodies'])
    joints = read_joints(live.files['joints'], bodies)
    calibrations = read_calibrations(by_command)
    orientation = load_orientation(orientation_path(by_command))
    options = BodiesOptions(smooth='lag', lag=0, estimate_shapes=False)
    return track_bodies(
        live.frames, calibrations, orientation, bodies=bodies, joints=joints, options=options
    )


def received(live, form):
    return live.client.messages[f'reconstruction/{form}']


def column(messages, name, row, width=1):
    """Return the values (T, width) of a body or joint in a flat array of every message."""
    part = slice(width * row, width * (row + 1))
    return np.array([getattr(message, name)[part] for message in messages])


def stamp(message):
    return message.header.stamp.sec, message.header.stamp.nanosec


def assert_same(found, expected, tolerance):
    assert np.array_equal(np.isnan(found), np.isnan(expected))
    assert np.nanmax(np.abs(found - expected)) <= tolerance


def test_poses_are_those_of_the_job(live, offline):
    messages = received(live, 'body_poses')
    scale = np.repeat([1e-3, 1.0], 3)
    for row, poses in enumerate(offline.poses):
        assert {message.body[row] for message in messages} == {poses.body}
        for axis, name in enumerate('xyz'):
            assert_same(column(messages, name, row)[:, 0], poses.position_mm[:, axis] / 1e3, 0)
        q = np.stack([column(messages, f'q{name}', row)[:, 0] for name in 'xyzw'])
        x, y, z, w = q
        first = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)], 1)
        assert_same(first, poses.rotation[:, :, 0], 1e-12)
        covariance = column(messages, 'covariance', row, 36).reshape(-1, 6, 6)
        expected = poses.covariance * scale * scale[:, None]
        assert_same(covariance, expected, 1e-12 * np.nanmax(expected))
        assert np.array_equal(column(messages, 'status', row)[:, 0], poses.status)
        assert np.array_equal(column(messages, 'markers', row)[:, 0], poses.markers)
    tibia = offline.poses[1].status
    assert {*tibia[list(ONE_VIEW)]} <= {BodyPoses.OK, BodyPoses.WEAK}
    assert {*tibia[list(HIDDEN)]} == {BodyPoses.FILLED} and tibia[GONE[-1]] == BodyPoses.FAILED


def test_angles_are_those_of_the_job_after_the_neutral_trial(live, offline):
    messages = received(live, 'joint_angles')
    (expected,) = offline.joints
    scale = np.repeat([1.0, 1e-3], 3)
    after = slice(NEUTRAL[1] - 1, None)
    assert messages[0].convention == ['grood_suntay_knee'] and messages[0].joint == ['knee']
    assert tuple(messages[0].angle_name) == expected.angle_names
    assert_same(column(messages, 'angle', 0, 3)[after], expected.angles[after], 0)
    shifts = column(messages, 'translation', 0, 3)[after]
    assert_same(shifts, expected.translations[after] / 1e3, 0)
    covariance = column(messages, 'covariance', 0, 36).reshape(-1, 6, 6)[after]
    wanted = (expected.covariance * scale * scale[:, None])[after]
    assert_same(covariance, wanted, 1e-12 * np.nanmax(wanted))
    status = column(messages, 'status', 0)[:, 0]
    assert np.array_equal(status[after], expected.status[after])
    assert set(status[: NEUTRAL[1] - 1]) == {JointAngles.FAILED}


def test_types_without_a_status_have_measured_poses_only(live):
    messages = received(live, 'body_poses')
    seen = {stamp(m): m for m in messages if m.status[1] <= BodyPoses.WEAK}
    client = live.client
    for form in ('bodies/tibia/pose', 'bodies/tibia/odometry'):
        found = received(live, form)
        client.wait_until(lambda found=found: len(found) >= len(seen), what=form)
        assert {stamp(m) for m in found} == set(seen) and len(found) == len(seen)
        for message in found:
            source = seen[stamp(message)]
            assert message.header == source.header and message.pose.pose.position.x == source.x[1]
            assert np.array_equal(message.pose.covariance, source.covariance[36:])
    assert {m.child_frame_id for m in found} == {'tibia'}
    for form, entries, name in (
        ('body_markers', 'markers', 'ns'),
        ('body_detections', 'detections', 'id'),
        ('rigid_bodies', 'rigidbodies', 'rigid_body_name'),
    ):
        if form in FORMS:
            found = received(live, form)
            client.wait_until(lambda found=found: len(found) == EXPOSURES, what=form)
            shown = [{getattr(one, name) for one in getattr(m, entries)} for m in found]
            assert shown == [
                {body for body, status in zip(m.body, m.status) if status <= BodyPoses.WEAK}
                for m in messages
            ]
    frames = [t for m in client.messages['/tf'] for t in m.transforms]
    assert {t.header.frame_id for t in frames} == {'rig'}
    assert sum(t.child_frame_id == 'tibia' for t in frames) == len(seen)
    assert sum(t.child_frame_id == 'femur' for t in frames) == EXPOSURES
    states = received(live, 'joint_states')
    named = [m for m in states if m.name]
    assert set(named[0].name) == {'knee_flexion', 'knee_adduction', 'knee_internal_rotation'}
    angles = {stamp(m): m for m in received(live, 'joint_angles')}
    for state in named:
        assert np.array_equal(state.position, angles[stamp(state)].angle)


def test_velocities_of_the_odometry_are_those_of_the_motion(live):
    """Velocities are along the axes of the body, so they do not depend on the rig frame."""
    rows = np.arange(10, ONE_VIEW.start)
    before, after = (
        walking(virtual_knee(1), rows / RATE_HZ + shift) for shift in (-STEP_S, STEP_S)
    )
    back = walking(virtual_knee(1), rows / RATE_HZ).rotation['tibia'].swapaxes(1, 2)
    moved = (after.position_mm['tibia'] - before.position_mm['tibia']) / (2 * STEP_S) / 1000
    turned = vector_from_matrix(
        after.rotation['tibia'] @ before.rotation['tibia'].swapaxes(1, 2)
    ) / (2 * STEP_S)
    true = np.hstack([(back @ v[..., None])[..., 0] for v in (moved, turned)])
    found = [received(live, 'bodies/tibia/odometry')[row].twist for row in rows]
    twist = np.array(
        [
            [
                getattr(part, axis)
                for part in (one.twist.linear, one.twist.angular)
                for axis in 'xyz'
            ]
            for one in found
        ]
    )
    covariance = np.array([one.covariance for one in found]).reshape(-1, 6, 6)
    error = twist - true
    squares = np.sum(error * np.linalg.solve(covariance, error[..., None])[..., 0], axis=1)
    assert 0.2 < np.mean(squares) / 6 < 3  # errors are correlated: few of them are independent
    assert np.abs(true).max(axis=0).min() > 0.02 and np.abs(error).max() < np.abs(true).max()


def test_diagnostics_tell_which_body_is_lost(live):
    assert live.statuses['body femur'].level == b'\0'
    assert value_of(live.statuses['body femur'], 'markers seen') == '4'
    assert 0.1 < float(value_of(live.statuses['body femur'], 'chi-squared over expectation')) < 3
    assert live.statuses['joint knee'].level == b'\0'
    assert live.lost.level == b'\1'


def test_messages_are_recorded_and_replayed_as_they_were_published(live):
    kinds = {'body_poses': BodyPoses, 'joint_angles': JointAngles}
    published = {form: list(map(repr, received(live, form))) for form in kinds}
    for form, kind in kinds.items():
        topic = f'{live.namespace}/reconstruction/{form}'
        found = [deserialize_message(m.data, kind) for m in iterate_messages(live.bag, [topic])]
        assert list(map(repr, found)) == published[form]
    # The player puts the recorded names into its own namespace.
    place = f'{live.namespace.strip("/")}/reconstruction'
    again = {form: live.client.listen(f'{place}/{form}') for form in FORMS}
    live.start('player_node', {'bag': live.bag, 'rate': 10.0}, wait=False)
    for form, expected in published.items():
        live.client.wait_until(lambda form=form: len(again[form]) == EXPOSURES, what=form)
        assert list(map(repr, again[form])) == expected


def test_damaged_file_of_bodies_ends_the_node_in_a_sentence(graph, by_command, tmp_path):
    file = tmp_path / 'bodies.csv'
    file.write_text('body,marker,x,y,z,sd\nfemur,1,0,0,0,0.1\nfemur,2,1,0,0,0.1\n')
    parameters = {'calibration_directory': by_command, 'bodies': file}
    node = graph.start('reconstruction_node', parameters, wait=False)
    assert node.wait() == 1
    assert f'{file}: body femur: the coordinates of only 2 of its 2 markers are known' in node.log
    assert 'Traceback' not in node.log
