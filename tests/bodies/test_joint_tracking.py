# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Joint angles computed exposure by exposure equal those of the whole trial."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fluoro_calib_ros.bodies.body import BodyPoses, PoseStatus
from fluoro_calib_ros.bodies.joints import Joint, JointStatus, joint_motion, with_neutral
from fluoro_calib_ros.bodies.tracking import MAX_NEUTRAL, JointTracker
from fluoro_calib_ros.errors import DataError

COUNT = 40
JOINT = Joint('knee', 'femur', 'tibia', 'cardan_xyz')
FIRST = 11  # number of the first exposure


def poses(body, turns):
    """Poses with rotation vectors (T, 3) [rad] about x, y and z."""
    count = len(turns)
    covariance = np.broadcast_to(np.diag([0.01, 0.01, 0.01, 1e-6, 2e-6, 3e-6]), (count, 6, 6))
    number = FIRST + np.arange(count)
    return BodyPoses(
        body,
        number,
        10**9 * number,
        Rotation.from_euler('XYZ', turns).as_matrix(),
        np.outer(np.arange(count), [1.0, 2.0, 3.0]),
        covariance_noise=covariance.copy(),
        covariance_fixed=covariance / 4,
        rig_root=np.zeros((count, 6, 2)),
        markers=np.full(count, 4),
        status=np.zeros(count, dtype=np.uint8),
    )


@pytest.fixture
def trial():
    """A femur at rest, and a tibia that makes more than one full turn about x."""
    turn = np.linspace(0.2, 9.0, COUNT)
    tibia = poses('tibia', np.column_stack([turn, 0.1 * np.sin(turn), 0.2 * np.cos(turn)]))
    return poses('femur', np.zeros((COUNT, 3))), tibia


def one_by_one(tracker, trial):
    rows = np.eye(len(trial[0].number), dtype=bool)
    return [tracker.add(*(one.rows(row) for one in trial)) for row in rows]


def test_angles_are_those_of_the_whole_trial(trial):
    """Also after full turns."""
    found = one_by_one(JointTracker(JOINT), trial)
    expected = joint_motion(JOINT, *trial)
    assert np.allclose(np.concatenate([one.angles for one in found]), expected.angles, atol=1e-12)
    assert np.ptp(expected.angles[:, 0]) > 2 * np.pi
    covariance = np.concatenate([one.covariance for one in found])
    assert np.allclose(covariance, expected.covariance, rtol=1e-12)


@pytest.mark.parametrize(
    ('degrees', 'status'),
    [
        ([[100, 0, 0], [170, 0, 0], [250, 0, 0], [330, 0, 0], [400, 0, 0]], PoseStatus.AMBIGUOUS),
        ([[80, 70, 80], [150, 88.5, 150], [225, 89.5, 225], [250, 70, 250]], PoseStatus.FILLED),
    ],
)
def test_full_turns_are_counted_as_in_the_whole_trial(degrees, status):
    """From ambiguous poses as well, and not from filled ones near gimbal lock."""
    tibia = poses('tibia', np.radians(degrees))
    tibia.status[1:-1] = status
    trial = poses('femur', np.zeros((len(degrees), 3))), tibia
    found = one_by_one(JointTracker(JOINT), trial)
    expected = joint_motion(JOINT, *trial).angles
    assert np.allclose(np.concatenate([one.angles for one in found]), expected, atol=1e-12)


def test_angles_after_the_neutral_trial_are_those_of_the_whole_trial(trial):
    tracker = JointTracker(JOINT, (FIRST + 2, FIRST + 6))
    found = one_by_one(tracker, trial)
    assert [one.status[0] for one in found[:6]] == 6 * [JointStatus.FAILED]
    assert np.isnan(found[5].angles).all() and not tracker.needs_neutral
    neutral = (one.rows((np.arange(COUNT) >= 2) & (np.arange(COUNT) <= 6)) for one in trial)
    expected = joint_motion(with_neutral(JOINT, *neutral), *trial)
    turn = 2 * np.pi
    error = np.concatenate([one.angles for one in found[6:]]) - expected.angles[6:]
    assert np.allclose(error, turn * np.round(error / turn), atol=1e-12)
    assert np.array_equal(found[-1].covariance, expected.covariance[-1:])


def test_neutral_trial_that_ends_between_two_exposures_is_used(trial):
    """The last exposures of the neutral trial are missing."""
    tracker = JointTracker(JOINT, (FIRST + 2, FIRST + 6))
    kept = [row for row in range(COUNT) if row not in (5, 6)]
    found = [tracker.add(*(one.rows(np.arange(COUNT) == row) for one in trial)) for row in kept]
    assert not tracker.needs_neutral and np.isfinite(found[5].angles).all()


def test_neutral_trial_without_poses_leaves_the_angles_unknown(trial):
    femur, tibia = trial
    hidden = replace(tibia, status=np.full(COUNT, PoseStatus.FILLED, dtype=np.uint8))
    tracker = JointTracker(JOINT, (FIRST, FIRST + 3))
    found = one_by_one(tracker, (femur, hidden))
    assert tracker.needs_neutral and 'neutral' in str(tracker.error)
    assert np.isnan(found[-1].angles).all()


def test_stream_that_begins_after_the_neutral_trial_has_no_angles(trial):
    tracker = JointTracker(JOINT, (1, FIRST - 1))
    found = one_by_one(tracker, trial)
    assert tracker.error is not None and np.isnan(found[0].angles).all()


def test_neutral_trial_that_is_too_long_is_refused():
    with pytest.raises(DataError, match='10000'):
        JointTracker(JOINT, (1, MAX_NEUTRAL + 1))
    JointTracker(JOINT, (1, MAX_NEUTRAL))


def test_angles_near_the_lock_before_any_other_are_counted_from_zero_as_in_the_whole_trial():
    joint = Joint('knee', 'femur', 'tibia', 'euler_xyx')
    tibia = poses('tibia', np.zeros((4, 3)))
    degrees = [[170, 0.1, 0], [175, 0.1, 0], [-178, 20, 0], [-160, 40, 0]]
    turns = Rotation.from_euler('XYX', degrees, degrees=True).as_matrix()
    trial = poses('femur', np.zeros((4, 3))), replace(tibia, rotation=turns)
    expected = joint_motion(joint, *trial)
    assert expected.determined.tolist() == [False, False, True, True]
    np.testing.assert_allclose(np.degrees(expected.angles[:2, 0]), [170, 175])
    found = one_by_one(JointTracker(joint), trial)
    assert np.allclose(np.concatenate([one.angles for one in found]), expected.angles, atol=1e-12)
