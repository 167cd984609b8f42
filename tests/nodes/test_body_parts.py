# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Bodies and joints of the reconstruction node without a graph: messages, files, following."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import rigs
from rclpy.serialization import deserialize_message, serialize_message
from scipy.spatial.transform import Rotation

from fluoro_calib_ros.bodies.anatomical_frames import AnatomicalFrame
from fluoro_calib_ros.bodies.body import Body, BodyPoses, PoseStatus
from fluoro_calib_ros.bodies.joints import Joint, JointStatus
from fluoro_calib_ros.bodies.tracking import BodyTracker, poses_of, twists_of
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.io.bodies import JointEntry
from fluoro_calib_ros.nodes.messages.bodies import (
    AXIS_MM,
    BodiesContent,
    body_markers,
    joint_state,
    message_from_bodies,
    message_from_joints,
    odometry,
    pose_with_covariance,
    transforms_of_bodies,
)
from fluoro_calib_ros.nodes.reconstruction_output import statuses_of
from fluoro_calib_ros.nodes.retractions import BodyRetractions
from fluoro_calib_ros.nodes.rig_input import BodyFollower, BodyParameters, Rig, read_body_files
from fluoro_calib_ros.nodes.runtime.diagnostics import OK, WARN, RecentCounts
from fluoro_calib_ros.photogrammetry.noise import ObservedScatter
from fluoro_calib_ros.photogrammetry.rig_orientation import RigOrientation
from fluoro_calib_ros.reconstruction.intersection import Intersector
from fluoro_calib_ros.reconstruction.reconstruct import CorrectedView, intersect_exposure

SIGMA_PX = 0.25
RATE_HZ = 250.0
MARKERS = np.array([[0, 0, 0], [30, 5, -4], [-6, 28, 9], [4, -8, 31.0]])
BODIES = (
    Body('femur', np.arange(1, 5), MARKERS, np.full(4, 0.02)),
    Body('tibia', np.arange(11, 15), 1.1 * MARKERS[:, ::-1], np.full(4, 0.02)),
)
SPIN = np.array([1.5, -2.0, 0.7])  # rad/s, rig frame
SPEED = np.array([40.0, -90.0, 150.0])  # mm/s


def orientation(source='capture'):
    fluoroscopes = rigs.rig().fluoroscopes
    sd = np.tile([0.05, 0.05, 0.05, 1e-4, 1e-4, 1e-4, 0.3, 0.3, 1.0], len(fluoroscopes))
    return RigOrientation(
        fluoroscopes=tuple(one.name for one in fluoroscopes),
        interior=np.array([one.interior for one in fluoroscopes]),
        rotation=np.array([one.rotation for one in fluoroscopes]),
        position_mm=np.array([one.position_mm for one in fluoroscopes]),
        covariance=np.diag(sd**2),
        frame_id='lab',
        source=source,
        calibration_ids=('a-1', 'b-1'),
        stamp_ns=0,
        exposures=10,
        optical_frame_ids=('a_optical', 'b_optical'),
    )


def rig(number=1, reject=4.0):
    one = orientation()
    return Rig(f'rig-{number}', one, Intersector(one, reject), ObservedScatter(), None)


def true_pose(row):
    """Return rotation and origin of both bodies in an exposure."""
    t = row / RATE_HZ
    return Rotation.from_rotvec(SPIN * t).as_matrix(), SPEED * t + [5, 3, -10]


def exposure(row, visible=('femur', 'tibia'), rng=None):
    """Return the intersected views of an exposure; without rng, they are free of noise."""
    turn, origin = true_pose(row)
    shown = [body for body in BODIES if body.name in visible]
    ids = np.concatenate([[99], *(body.target_id for body in shown)]).astype(int)
    points = np.concatenate([[[60, 0, 0]], *(body.xyz_mm @ turn.T + origin for body in shown)])
    one = orientation()
    views = []
    for place, axes, (xp, yp, c) in zip(one.position_mm, one.rotation, one.interior):
        x = (points - place) @ axes.T
        uv = c * x[:, :2] / x[:, 2:] + [xp, yp]
        uv = uv if rng is None else uv + rng.normal(0, SIGMA_PX, uv.shape)
        flat = np.ones(len(ids))
        views.append(CorrectedView(ids, uv, SIGMA_PX * flat, 0.05 * flat, flat < 0))
    return intersect_exposure(views, Intersector(one))


def stamp(row):
    return 10**18 + round(1e9 * row / RATE_HZ)


def follow(follower, rows, number=1, later_s=0, **kind):
    return [
        content
        for row in rows
        for content in follower.add(
            exposure(row, **kind), rig(number), row + 1, stamp(row) + later_s * 10**9
        )
    ]


def content_of(rotation, position_mm=(0, 0, 0), covariance=None, status=PoseStatus.OK):
    """Return the content of a message with one body."""
    poses = BodyPoses(
        'femur',
        np.array([7]),
        np.array([3_000_000_004]),
        np.asarray(rotation)[None],
        np.array([position_mm], dtype=float),
        covariance_noise=np.zeros((1, 6, 6)) if covariance is None else covariance[None],
        covariance_fixed=np.zeros((1, 6, 6)),
        rig_root=np.zeros((1, 6, 2)),
        markers=np.array([4]),
        status=np.array([status], dtype=np.uint8),
    )
    twist = np.array([[100.0, 200.0, 300.0, 1.0, 2.0, 3.0]])
    return BodiesContent(
        3_000_000_004,
        7,
        'rig-1',
        orientation(),
        bodies=[BODIES[0]],
        poses=[poses],
        twist=twist,
        twist_covariance=np.diag([1e6, 4e6, 9e6, 1, 4, 9.0])[None],
        joints=[],
        used=[BODIES[0].target_id],
    )


def test_covariance_is_about_the_fixed_axes_of_the_header_frame():
    """A body that is uncertain along and about its own x axis only, turned by 90 degrees about z.

    That axis is y of the header frame. Rotating a pose manually about this y, after its attitude,
    as REP 103 and robot_localization do, puts the error in the same place.
    """
    quarter = Rotation.from_euler('z', 90, degrees=True).as_matrix()
    own = np.diag([0.3**2, 0, 0, 0.02**2, 0, 0])  # mm, rad; along the axes of the body
    axes = np.kron(np.eye(2), quarter)
    message = message_from_bodies(content_of(quarter, covariance=axes @ own @ axes.T))
    covariance = np.array(pose_with_covariance(message, 0).pose.covariance).reshape(6, 6)
    assert np.allclose(np.diag(covariance), [0, 0.0003**2, 0, 0, 0.02**2, 0], atol=1e-20)
    turned = message_from_bodies(content_of(Rotation.from_euler('y', 0.02).as_matrix() @ quarter))
    q, p = (Rotation.from_quat([m.qx[0], m.qy[0], m.qz[0], m.qw[0]]) for m in (turned, message))
    error = (q * p.inv()).as_euler('xyz')  # roll, pitch, yaw about fixed axes
    assert np.allclose(error, np.sqrt(np.diag(covariance)[3:]), atol=1e-15)


def test_units_header_and_types_of_a_body():
    turn = Rotation.from_rotvec([0.3, -0.2, 1.0])
    content = content_of(turn.as_matrix(), (10.0, -20.0, 30.0))
    message = message_from_bodies(content)
    assert repr(deserialize_message(serialize_message(message), type(message))) == repr(message)
    assert (message.x[0], message.y[0], message.z[0]) == (0.01, -0.02, 0.03)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (3, 4)
    assert message.header.frame_id == 'lab' and list(message.calibration_id) == ['a-1', 'b-1']
    moving = odometry(content, message, 0)
    assert (moving.header.frame_id, moving.child_frame_id) == ('lab', 'femur')
    assert (moving.twist.twist.linear.y, moving.twist.twist.angular.z) == (0.2, 3.0)
    assert np.allclose(np.diag(moving.twist.covariance.reshape(6, 6)), [1, 4, 9, 1, 4, 9])
    (frame,) = transforms_of_bodies(content, message, 'rig').transforms
    assert (frame.header.frame_id, frame.child_frame_id) == ('rig', 'femur')
    q = frame.transform.rotation
    assert np.allclose(Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), turn.as_matrix())


@pytest.mark.parametrize('status', [PoseStatus.FILLED, PoseStatus.FAILED, PoseStatus.AMBIGUOUS])
def test_types_without_a_status_have_no_predicted_pose(status):
    content = content_of(np.eye(3), status=status)
    message = message_from_bodies(content)
    assert list(message.status) == [status]
    assert not content.measured
    assert not transforms_of_bodies(content, message, 'rig').transforms
    assert not joint_state(content).name


def test_twist_is_that_of_the_origin_along_the_axes_of_the_body():
    """The centre of the markers moves some 50 mm/s faster or slower."""
    tracker = BodyTracker(orientation(), BODIES, lag=0)
    for row in range(60):
        found = tracker.add(exposure(row), row, stamp(row))
    twist, covariance = twists_of(BODIES, found)
    turn, _ = true_pose(59)
    assert np.allclose(twist[:, :3], SPEED @ turn, atol=3)  # mm/s
    assert np.allclose(twist[:, 3:], SPIN @ turn, atol=0.02)
    assert np.allclose(covariance, np.swapaxes(covariance, 1, 2))


def test_covariance_of_the_twist_is_that_of_its_derivatives():
    """Compared with finite differences of the twist by the state: R, then both velocities."""
    tracker = BodyTracker(orientation(), BODIES, lag=0)
    rng = np.random.default_rng(3)
    for row in range(30):
        found = tracker.add(exposure(row, rng=rng), row, stamp(row))
    _, covariance = twists_of(BODIES, found)
    jacobian = np.zeros((2, 6, 18))
    for n in (*range(3, 6), *range(6, 12)):
        ends = []
        for step in (1e-6, -1e-6):
            turn = (
                Rotation.from_rotvec(step * np.eye(3)[n - 3]).as_matrix() if n < 6 else np.eye(3)
            )
            velocity = found.velocity + (step * np.eye(6)[n - 6] if n >= 6 else 0)
            moved = SimpleNamespace(
                rotation=turn @ found.rotation, velocity=velocity, covariance=found.covariance
            )
            ends.append(twists_of(BODIES, moved)[0])
        jacobian[:, :, n] = (ends[0] - ends[1]) / 2e-6
    expected = jacobian @ found.covariance @ np.swapaxes(jacobian, 1, 2)
    assert np.allclose(covariance, expected, rtol=1e-6, atol=1e-9 * expected.max())


def test_markers_of_a_body_are_where_its_pose_puts_them():
    """For RViz: beads at their positions, and the axes of the body starting at their centre."""
    turn, origin = true_pose(60)
    content = content_of(turn, origin)
    axes, beads = body_markers(content, message_from_bodies(content)).markers
    assert axes.ns == beads.ns == 'femur' and axes.header.frame_id == 'lab'
    for marker, places in (
        (beads, MARKERS),
        (axes, MARKERS.mean(axis=0) + np.kron(AXIS_MM * np.eye(3), [[0], [1]])),
    ):
        q, p = marker.pose.orientation, marker.pose.position
        points = np.array([[one.x, one.y, one.z] for one in marker.points])
        found = Rotation.from_quat([q.x, q.y, q.z, q.w]).apply(points) + [p.x, p.y, p.z]
        assert found == pytest.approx((places @ turn.T + origin) / 1000, abs=1e-12)
    assert len(axes.colors) == len(axes.points) == 6
    lost = content_of(turn, origin, status=PoseStatus.FILLED)
    assert not body_markers(lost, message_from_bodies(lost)).markers


def test_follower_gives_the_poses_of_the_tracker():
    rng = np.random.default_rng(2)
    shown = [exposure(row, rng=rng) for row in range(20)]
    follower = BodyFollower(BODIES, (), lag=3)
    tracker = BodyTracker(orientation(), BODIES, lag=3)
    for row, one in enumerate(shown):
        found = follower.add(one, rig(), row + 1, stamp(row))
        expected = tracker.add(one, row + 1, stamp(row))
        assert len(found) == (row >= 3)
        if found:
            assert found[0].frame_number == row - 2 and found[0].stamp_ns == stamp(row - 3)
            for a, b in zip(found[0].poses, poses_of(BODIES, [expected])):
                assert np.array_equal(a.rotation, b.rotation)
                assert np.array_equal(a.covariance, b.covariance)


@pytest.mark.parametrize(('reject', 'markers'), [(4.0, 3), (None, 4)])
def test_follower_leaves_out_what_is_false_by_the_limit_of_the_rig(reject, markers):
    """A marker of the body appears where no marker is; without a limit, all markers are used."""
    follower = BodyFollower(BODIES, (), lag=0)
    rng = np.random.default_rng(5)
    for row in range(10):
        shown = exposure(row, rng=rng)
        if row == 9:
            shown.views.uv[:, np.searchsorted(shown.target_id, 12)] += 6.0
        (found,) = follower.add(shown, rig(reject=reject), row + 1, stamp(row))
    femur, tibia = found.poses
    assert (femur.markers[0], tibia.markers[0]) == (4, markers)


@pytest.mark.parametrize('change', ['orientation', 'recording that begins anew'])
def test_new_tracker_first_gives_what_waits(change):
    """No exposure is lost, and the new tracker starts without a motion."""
    follower = BodyFollower(BODIES, (), lag=5)
    assert len(follow(follower, range(10))) == 5
    row, number, later_s = (10, 2, 0) if change == 'orientation' else (0, 1, -2)
    rest = follow(follower, [row], number, later_s)
    assert [one.frame_number for one in rest] == [6, 7, 8, 9, 10]
    assert {one.orientation_id for one in rest} == {'rig-1'}
    found = follow(follower, range(row + 1, row + 7), number, later_s)
    assert found[0].frame_number == row + 1 and found[0].orientation_id == f'rig-{number}'


def test_exposures_that_wait_at_the_end_are_returned_and_the_next_begins_anew():
    follower = BodyFollower(BODIES, (), lag=3)
    assert [content.frame_number for content in follow(follower, range(10))] == [*range(1, 8)]
    assert [content.frame_number for content in follower.flush()] == [8, 9, 10]
    assert not follower.flush()
    (content,) = follow(follower, range(20, 24))
    assert content.frame_number == 21


def test_angles_of_a_joint_are_those_from_its_neutral_trial_on():
    """The axes of the tibia are 0.3 rad off; a restarted recording has its own neutral trial."""
    off = AnatomicalFrame(Rotation.from_euler('x', 0.3).as_matrix(), np.zeros(3))
    joint = Joint('knee', 'femur', 'tibia', 'cardan_xyz', distal_frame=off)
    free, zeroed = (
        BodyFollower(BODIES, [JointEntry(joint, neutral)], lag=0) for neutral in (None, (2, 4))
    )
    for content in follow(free, range(3)):
        assert content.joints[0].angles == pytest.approx(np.array([[0.3, 0, 0]]), abs=1e-3)
        names = [f'knee_{name}' for name in content.joints[0].angle_names]
        assert list(joint_state(content).name) == names
    for later_s in (0, -2):
        found = follow(zeroed, range(6), later_s=later_s)
        assert [len(joint_state(content).position) for content in found] == [0, 0, 0, 3, 3, 3]
        for content in found[3:]:
            assert joint_state(content).position == pytest.approx([0, 0, 0], abs=1e-3)


def taken_back(lag=0, rows=range(4)):
    """Return a follower, its retractions and what they publish, after some exposures."""
    joint = Joint('knee', 'femur', 'tibia', 'cardan_xyz')
    follower = BodyFollower(BODIES, [JointEntry(joint, None)], lag)
    published = []
    retractions = BodyRetractions(published.append)
    for content in follow(follower, rows, rng=np.random.default_rng(3)):
        retractions.note(content)
    return follower, retractions, published


def test_a_pose_by_a_marker_that_is_taken_back_is_not_known_any_more():
    _, retractions, published = taken_back()
    retractions.take_back(stamp(2), [99])  # not a marker of any body
    retractions.take_back(stamp(2), [12])
    retractions.take_back(stamp(2), [12, 13])  # the same pose is not retracted twice
    assert retractions.count == len(published) == 1
    message = message_from_bodies(published[0])
    assert message.header.stamp == message_from_bodies(follow_one(2)).header.stamp
    assert message.frame_number == 3 and message.body == ['tibia']
    assert list(message.status) == [message.FAILED] and list(message.markers) == [0]
    assert np.isnan([*message.x, *message.qw, *message.covariance]).all()
    angles = message_from_joints(published[0])
    assert angles.joint == ['knee'] and list(angles.status) == [angles.FAILED]
    assert np.isnan([*angles.angle, *angles.translation, *angles.covariance]).all()
    retractions.take_back(stamp(2), [1])
    assert message_from_bodies(published[1]).body == ['femur']


def follow_one(row):
    follower = BodyFollower(BODIES, [], 0)
    return follow(follower, [row])[0]


def test_a_pose_that_rejected_the_marker_stays():
    follower = BodyFollower(BODIES, [], 0)
    published = []
    retractions = BodyRetractions(published.append)
    wrong = exposure(0)
    uv = wrong.views.uv.copy()
    uv[:, wrong.views.target_id == 12] += 60.0
    points = Intersector(orientation(), None).intersect(uv, wrong.views.sigma)
    wrong = replace(wrong, views=replace(wrong.views, uv=uv), points=points)
    for content in follower.add(wrong, rig(), 1, stamp(0)):
        retractions.note(content)
    retractions.take_back(stamp(0), [12])
    assert not published
    retractions.take_back(stamp(0), [13])
    assert [one.body for one in published[0].poses] == ['tibia']


def test_a_pose_that_waits_for_later_exposures_is_taken_back_after_it_is_published():
    follower, retractions, published = taken_back(lag=2)
    retractions.take_back(stamp(3), [1])
    assert not published
    for content in follow(follower, range(4, 6)):
        retractions.note(content)
    assert [(one.frame_number, one.bodies[0].name) for one in published] == [(4, 'femur')]


def test_exposure_out_of_order_is_skipped_and_the_neutral_position_stays():
    """As if frames of several fluoroscopes with different clocks are paired by number."""
    joint = Joint('knee', 'femur', 'tibia', 'cardan_xyz')
    follower = BodyFollower(BODIES, [JointEntry(joint, (2, 4))], lag=0)
    follow(follower, range(6))
    assert not follower.joints[0].needs_neutral
    assert not follower.add(exposure(4), rig(), 7, stamp(5) - 500_000)
    assert follower.untimed == 1 and not follower.joints[0].needs_neutral
    assert follow(follower, [6])[0].joints[0].status[0] == JointStatus.OK


def test_state_of_bodies_is_that_since_the_stamps_restarted():
    follower = BodyFollower(BODIES, [], lag=0)
    follow(follower, range(3))
    follow(follower, [0], later_s=-2, visible=('femur',))
    assert follower.state.seen_ns.tolist() == [stamp(0) - 2 * 10**9, -1]


def test_exposure_with_the_stamp_of_the_one_before_is_counted():
    follower = BodyFollower(BODIES, (), lag=0)
    assert len(follow(follower, [0, 1])) == 2
    assert not follow(follower, [1]) and follower.untimed == 1
    assert statuses_of(follower, RecentCounts())[0].level == WARN


def numbers_in(sentence):
    return [float(number) for number in re.findall(r'\d+\.\d+', sentence)]


def test_a_body_with_mirrored_coordinates_is_told_in_the_diagnostics():
    """Three of its markers fit their mirror image: the poses have the status OK."""
    mirrored = replace(BODIES[0], xyz_mm=BODIES[0].xyz_mm * [-1, 1, 1])
    for body, level in ((BODIES[0], OK), (mirrored, WARN)):
        follower = BodyFollower((body, BODIES[1]), [], 0)
        contents = follow(follower, range(80), rng=np.random.default_rng(1))
        assert contents[-1].poses[0].status[0] == PoseStatus.OK
        femur, tibia = statuses_of(follower, RecentCounts())
        assert (femur.level, tibia.level) == (level, OK)
        assert ('do not fit in most exposures' in femur.message) == (level == WARN)


def test_diagnostics_of_a_body_from_unseen_to_lost():
    follower = BodyFollower(BODIES, (), lag=0)
    assert statuses_of(follower, RecentCounts()) == []

    def tibia():
        return next(s for s in statuses_of(follower, RecentCounts()) if s.name == 'body tibia')

    follow(follower, range(3), visible=('femur',))
    assert (tibia().level, tibia().values['status']) == (WARN, 'FAILED')
    assert tibia().values['since last seen [s]'] == ''
    assert tibia().values['chi-squared over expectation'] == 'nan'
    follow(follower, range(3, 30))
    assert (tibia().level, tibia().values['status']) == (OK, 'OK')
    assert tibia().values['markers seen'] == 4
    follow(follower, range(30, 36), visible=('femur',))
    assert (tibia().level, tibia().values['status']) == (WARN, 'FILLED')
    assert numbers_in(tibia().message) == [round(6 / RATE_HZ, 2)] != [0.0]
    follow(follower, [30 + 250], visible=('femur',))
    assert (tibia().level, tibia().values['status']) == (WARN, 'FAILED')
    assert float(tibia().values['since last seen [s]']) == pytest.approx(251 / RATE_HZ)
    assert numbers_in(tibia().message) == [round(251 / RATE_HZ, 1)]


FAULTS = {
    'body x y,1,0,0,0,0.1\nbody x y,2,1,0,0,0.1\nbody x y,3,0,1,0,0.1\n': "body 'body x y'",
    'femur,1,0,0,0,0.1\nfemur,2,1,0,0,0.1\nfemur,3,0,1,0,\n': 'marker 3 has no standard deviation',
    'femur,1,0,0,0,0.1\nfemur,2,1,0,0,0.1\nfemur,3,,,,\n': 'only 2 of its 3 markers',
}


@pytest.mark.parametrize('rows', FAULTS)
def test_file_with_bodies_that_cannot_be_followed_is_refused(rows, tmp_path):
    path = tmp_path / 'bodies.csv'
    path.write_text('body,marker,x,y,z,sd\n' + rows)
    with pytest.raises(DataError) as caught:
        read_body_files(BodyParameters(bodies=str(path)))
    assert FAULTS[rows] in str(caught.value) and str(path) in str(caught.value)
    assert '\n' not in str(caught.value)


def test_joints_need_bodies():
    with pytest.raises(ValueError, match='bodies'):
        BodyParameters(joints='joints.toml')


def test_a_missing_file_of_bodies_is_named_once(tmp_path):
    path = tmp_path / 'bodies.csv'
    with pytest.raises(DataError) as refused:
        read_body_files(BodyParameters(bodies=str(path)))
    assert str(refused.value) == f'{path}: there is no such file'


def test_a_body_is_not_named_as_its_parent_in_tf(tmp_path):
    """Its transform would be that of a frame to itself, which tf2 refuses."""
    path = tmp_path / 'bodies.csv'
    rows = ('lab,1,0,0,0,0.1', 'lab,2,1,0,0,0.1', 'lab,3,0,1,0,0.1')
    path.write_text('\n'.join(('body,marker,x,y,z,sd', *rows, '')))
    parameters = BodyParameters(bodies=str(path))
    assert read_body_files(parameters, 'rig')[0][0].name == 'lab'
    with pytest.raises(DataError, match=r'body lab: .*rig_frame has this name') as refused:
        read_body_files(parameters, 'lab')
    assert str(path) in str(refused.value)
