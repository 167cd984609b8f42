# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Tracking a knee from image points: gaps, single views, impacts, and the job around it."""

import dataclasses

import numpy as np
import pytest
from body_views import Noise, body, exposure, orientation, project
from scipy.spatial.transform import Rotation

from fluoro_calib_ros.bodies.body import Body, PoseStatus
from fluoro_calib_ros.bodies.butterworth import filtered_poses
from fluoro_calib_ros.bodies.tracking import BodyTracker, poses_alone, poses_of
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.photogrammetry.rotations import vector_from_matrix

RATE = 250.0
COUNT = 60


class Trial:
    """Two moving bodies and their exposures."""

    def __init__(self, seed=0, lost=0.0, hidden=None, count=COUNT):
        rng = np.random.default_rng(seed)
        self.rig = orientation()
        self.bodies = [body(rng, 4, 'femur', 1), body(rng, 4, 'tibia', 11)]
        self.ids = np.concatenate([one.target_id for one in self.bodies])
        t = np.arange(count) / RATE
        bend = 0.4 * np.sin(2 * np.pi * 1.5 * t)
        self.rotation = [
            Rotation.from_rotvec(np.stack([s * bend, 0.1 * bend, 0 * t], 1)).as_matrix()
            for s in (1, -1)
        ]
        path = np.stack([30 * np.sin(3 * t), 20 * np.cos(4 * t), 10 * t], axis=1)
        self.position = [path + [0, 40 * k, 0] - one.centre for k, one in enumerate(self.bodies)]
        self.exposures = []
        for k in range(count):
            points = np.concatenate(
                [
                    one.xyz_mm @ turn[k].T + place[k]
                    for one, turn, place in zip(self.bodies, self.rotation, self.position)
                ]
            )
            uv = project(self.rig, points) + rng.normal(0, 0.2, (2, 8, 2))
            uv[rng.random((2, 8)) < lost] = np.nan
            if hidden is not None:
                hidden(k, uv)
            self.exposures.append(exposure(self.rig, self.ids, uv, Noise(0.2)))

    def follow(self, lag=None, rate=RATE):
        """The tracker and its reports; rate: of the exposures [Hz]."""
        tracker = BodyTracker(self.rig, self.bodies, lag=lag)
        found = [
            tracker.add(one, k, 1 + round(1e9 * k / rate)) for k, one in enumerate(self.exposures)
        ]
        return tracker, [one for one in found if one is not None]

    def errors(self, poses, row):
        """Errors (T, 6) of the poses of a body, and their standard deviations."""
        away = np.concatenate(
            [
                poses.position_mm - self.position[row],
                vector_from_matrix(poses.rotation @ np.swapaxes(self.rotation[row], 1, 2)),
            ],
            axis=1,
        )
        return away, poses.sd


@pytest.mark.parametrize('seed', range(4))
def test_body_is_followed_from_its_first_pose_although_its_speed_is_unknown(seed):
    """At 100 Hz any speed is a turn by 23 degrees in an exposure; half of the exposures have fewer
    than three markers in space.
    """
    trial = Trial(seed, lost=0.25)
    tracker, _ = trial.follow(rate=100.0)
    poses = poses_of(trial.bodies, tracker.smoothed())
    for row, found in enumerate(poses):
        alone = np.flatnonzero(found.status == PoseStatus.OK)
        assert alone[0] < 10 and len(alone) > 0.8 * COUNT
        assert (found.status[alone[0] :] != PoseStatus.FAILED).sum() > 0.95 * (COUNT - alone[0])
        error = found.position_mm[alone] - trial.position[row][alone]
        assert np.abs(error).max() < 0.5


def test_one_image_point_a_view_is_never_believed_to_give_the_pose():
    """Two markers, each in one view for 80 ms: live errors stay below 4.5 standard deviations."""

    def hidden(k, uv):
        if k % 40 >= 20:
            uv[0, [0, 2, 3]] = uv[1, [0, 1, 2]] = np.nan
            uv[0, 5:] = uv[1, [4, 6, 7]] = np.nan

    squares = []
    for seed in range(2):
        trial = Trial(seed, hidden=hidden, count=120)
        _, live = trial.follow(lag=0)
        for row, poses in enumerate(poses_of(trial.bodies, live)):
            away, sd = trial.errors(poses, row)
            known = poses.known
            assert known.mean() > 0.9
            assert np.nanmax(np.abs(away / sd)[20:]) < 4.5
            solved = np.linalg.solve(poses.covariance[known], away[known][:, :, None])
            squares.append(np.mean(np.sum(away[known] * solved[:, :, 0], axis=1)) / 6)
    assert 0.6 < np.mean(squares) < 2


def test_a_trial_is_smoothed_with_honest_deviations():
    trial = Trial()
    tracker, _ = trial.follow()
    exposures = tracker.smoothed()
    alone = poses_alone(trial.bodies, exposures)
    for row, poses in enumerate(poses_of(trial.bodies, exposures)):
        away, sd = trial.errors(poses, row)
        single, _ = trial.errors(alone[row], row)
        assert np.sqrt(np.mean(away**2)) < 0.6 * np.sqrt(np.mean(single**2))
        assert 0.5 < np.mean((away / sd) ** 2) < 1.6
        assert (poses.status == PoseStatus.OK).all() and (poses.markers == 4).all()


def test_poses_are_predicted_any_number_of_times_and_shapes_replaced_on_the_way():
    """Neither a prediction nor a shape with other markers in the same frame changes results."""
    trial = Trial(2)
    _, expected = trial.follow(lag=0)
    tracker = BodyTracker(trial.rig, trial.bodies)
    fewer = [one.rows(np.arange(4) < 3) for one in trial.bodies]
    for k, one in enumerate(trial.exposures):
        stamp_ns = 1 + round(1e9 * k / RATE)
        for _ in range(3):
            ahead = tracker.predict(stamp_ns)
        found = tracker.add(one, k, stamp_ns)
        if k < 60:
            assert np.array_equal(found.centre_mm, expected[k].centre_mm)
            assert np.array_equal(found.covariance, expected[k].covariance)
        for row, body_ in enumerate(tracker.bodies) if k > 20 else ():
            true = trial.position[row][k] + trial.rotation[row][k] @ body_.centre
            sd = np.sqrt(np.diagonal(ahead.covariance[row])[:3])
            assert (np.abs(ahead.centre_mm[row] - true) < 5 * sd).all()
        if k == 60:
            tracker.reshape(fewer)


def test_markers_that_come_and_go_make_no_jump():
    """A third of all image points is lost; errors stay below five standard deviations."""
    trial = Trial(1, lost=0.35)
    tracker, _ = trial.follow()
    for row, poses in enumerate(poses_of(trial.bodies, tracker.smoothed())):
        away, sd = trial.errors(poses, row)
        known = np.isfinite(away).all(axis=1)
        assert known[30:].all()  # tracking starts when both views first see three markers
        assert np.abs(away[known] / sd[known]).max() < 5
        assert {PoseStatus.OK, PoseStatus.WEAK} <= set(poses.status.tolist())


def hide(first, last, keep):
    """Hide image points of the femur in some exposures, except those at indices (view, marker)."""

    def hidden(k, uv):
        if first <= k < last:
            kept = [(view, marker, uv[view, marker].copy()) for view, marker in keep]
            uv[:, :4] = np.nan
            for view, marker, value in kept:
                uv[view, marker] = value

    return hidden


@pytest.mark.long
@pytest.mark.parametrize(
    ('keep', 'status'),
    [
        ([(0, 0), (0, 1)], PoseStatus.WEAK),
        ([(0, 0), (0, 1), (0, 2), (0, 3)], PoseStatus.OK),  # one view suffices for a pose
        ([], PoseStatus.FILLED),
    ],
)
def test_gaps_are_filled_and_marked(keep, status):
    trial = Trial(2, hidden=hide(50, 65, keep), count=75)
    tracker, _ = trial.follow()
    poses = poses_of(trial.bodies, tracker.smoothed())[0]
    away, sd = trial.errors(poses, 0)
    assert (poses.status[50:65] == status).all()
    assert (poses.status[:50] == PoseStatus.OK).all()
    assert np.abs(away[50:65] / sd[50:65]).max() < 4
    assert sd[57, :3].max() > 1.3 * sd[30, :3].max()


def test_a_body_that_is_away_for_long_has_no_pose_until_it_is_seen_again():
    trial = Trial(3, hidden=hide(20, 80, []), count=90)
    _, found = trial.follow(lag=0)
    status = np.array([one.status[0] for one in found])
    assert status[78] == PoseStatus.FAILED and np.isnan(found[78].rotation[0]).all()
    assert (status[80:] == PoseStatus.OK).all()
    assert np.isfinite(found[78].rotation[1]).all()


def test_live_and_recorded_with_the_same_lag_are_the_same_bytes():
    trial = Trial(4, lost=0.2, count=60)
    tracker, live = trial.follow(lag=4)
    live += tracker.flush()
    again, recorded = trial.follow(lag=4)
    recorded += again.flush()
    assert len(live) == len(recorded) == 60
    for one, other in zip(live, recorded):
        assert one.number == other.number
        for name in ('rotation', 'centre_mm', 'covariance', 'fixed', 'rig_root'):
            assert getattr(one, name).tobytes() == getattr(other, name).tobytes()


@pytest.mark.parametrize(
    ('times_s', 'rad'),
    [
        (0.1 * np.arange(40), 0.0),
        (0.15 * np.arange(40), 1.3),
        (0.5 * np.arange(40), 0.5),
        (10.0 * np.arange(20), 0.02),
        (0.01 * np.arange(40) + 1e3 * (np.arange(40) >= 20), 0.01),
        ([0.0], 0.0),
    ],
)
def test_poses_far_apart_in_time_are_as_good_as_each_alone(times_s, rad):
    """Low rates, a long gap, and a single exposure; rad: rotation between two exposures."""
    rng = np.random.default_rng(3)
    rig = orientation()
    bone = body(rng, 4, 'femur', 1)
    k = np.arange(len(times_s))
    turn = Rotation.from_rotvec(np.outer(rad * k, [0.6, 0.8, 0])).as_matrix()
    place = np.outer(np.sin(rad * k), [30, 20, 10])
    tracker = BodyTracker(rig, [bone], lag=None)
    live = BodyTracker(rig, [bone], lag=2)
    lagged = []
    for number, time_s in enumerate(times_s):
        points = bone.xyz_mm @ turn[number].T + place[number]
        uv = project(rig, points) + rng.normal(0, 0.2, (2, 4, 2))
        given = exposure(rig, bone.target_id, uv, Noise(0.2)), number, 1 + round(1e9 * time_s)
        tracker.add(*given)
        lagged.append(live.add(*given))
    lagged = [one for one in lagged if one is not None] + live.flush()
    for tracked in (tracker.smoothed(), lagged):
        (found,) = poses_of([bone], tracked)
        (alone,) = poses_alone([bone], tracked)
        assert (found.status == PoseStatus.OK).all()
        assert (found.sd <= 1.001 * alone.sd).all()
        assert (np.abs(found.position_mm - place) < 5 * found.sd[:, :3]).all()
        error = vector_from_matrix(found.rotation @ np.swapaxes(turn, 1, 2))
        assert (np.abs(error) < 5 * found.sd[:, 3:]).all()


def test_an_exposure_that_is_not_later_is_not_taken():
    trial = Trial(5, count=3)
    tracker = BodyTracker(trial.rig, trial.bodies)
    assert tracker.add(trial.exposures[0], 0, 1_000) is not None
    assert tracker.add(trial.exposures[1], 1, 1_000) is None
    assert tracker.add(trial.exposures[2], 2, 4_000_000) is not None


@pytest.mark.long
def test_stamps_of_arrival_lose_no_body():
    """Exposures are stamped on arrival, some within a tenth of a millisecond."""
    trial = Trial(seed=4, count=600)
    rng = np.random.default_rng(11)
    tracker = BodyTracker(trial.rig, trial.bodies)
    arrived = 0
    poses = []
    for k, one in enumerate(trial.exposures):
        late = rng.choice([0.0, 2e6, 9e6, 25e6], p=[0.6, 0.2, 0.15, 0.05])
        arrived = max(round(1e9 * k / RATE + late), arrived + round(rng.uniform(2e4, 2e5)))
        poses.append(tracker.add(one, k, arrived))
    assert all(one.frame.alone.all() for one in poses)
    assert all((one.status == PoseStatus.OK).all() for one in poses[1:])


def test_errors_that_stay_are_not_smoothed_away():
    """The error of the correction is the same in all exposures, however many there are."""
    rng = np.random.default_rng(6)
    rig = orientation()
    given = body(rng, 4)
    squares = []
    for _ in range(6):
        tracker = BodyTracker(rig, [given], lag=None)
        shift = rng.normal(0, 0.2, (2, 4, 2))
        for k in range(15):
            uv = project(rig, given.xyz_mm) + shift + rng.normal(0, 0.1, (2, 4, 2))
            seen = exposure(rig, given.target_id, uv, Noise(0.1, 0.2))
            tracker.add(seen, k, 1 + round(1e9 * k / RATE))
        poses = poses_of([given], tracker.smoothed())[0]
        away = poses.position_mm[7]
        covariance = poses.covariance[7][:3, :3]
        squares.append(away @ np.linalg.solve(covariance, away) / 3)
        assert poses.covariance_noise[7][0, 0] < 0.3 * poses.covariance_fixed[7][0, 0]
    assert 0.4 < np.mean(squares) < 2


def test_butterworth_propagates_deviations_and_refuses_what_it_cannot_do():
    trial = Trial(7)
    tracker, _ = trial.follow()
    alone = poses_alone(trial.bodies, tracker.smoothed())[0]
    filtered = filtered_poses(alone, 12.0)
    away, _ = trial.errors(filtered, 0)
    sd = np.sqrt(np.diagonal(filtered.covariance_noise, axis1=1, axis2=2))
    assert sd[45, 0] < 0.5 * alone.sd[45, 0]
    assert np.mean((away[20:70] / sd[20:70]) ** 2) < 3
    with pytest.raises(DataError, match='not between 0 and half of the rate'):
        filtered_poses(alone, 125.0)
    uneven = dataclasses.replace(alone, stamp_ns=alone.stamp_ns + (alone.number > 50) * 10**8)
    with pytest.raises(DataError, match='equal time intervals'):
        filtered_poses(uneven, 12.0)


def test_predictions_do_not_change_what_an_exposure_says():
    """Predictions are requested twice, for another time, and before better shapes are used."""
    trial = Trial(count=12)
    plain, asked = (BodyTracker(trial.rig, trial.bodies, lag=0) for _ in range(2))
    shift = np.array([3.0, -2.0, 1.0])
    moved = [dataclasses.replace(one, xyz_mm=one.xyz_mm + shift) for one in trial.bodies]
    for number, one in enumerate(trial.exposures):
        stamp_ns = 1 + round(1e9 * number / RATE)
        first = asked.predict(stamp_ns)
        asked.predict(stamp_ns + 10**7)
        again = asked.predict(stamp_ns)
        np.testing.assert_array_equal(first.centre_mm, again.centre_mm)
        if number == 8:
            before = plain.predict(stamp_ns).centre_mm
            for tracker in (plain, asked):
                tracker.reshape(moved)
            turned = plain.filter.rotation @ shift
            np.testing.assert_allclose(
                plain.predict(stamp_ns).centre_mm - before, turned, atol=0.2
            )
        found = plain.add(one, number, stamp_ns), asked.add(one, number, stamp_ns)
        np.testing.assert_array_equal(found[0].centre_mm, found[1].centre_mm)
        np.testing.assert_array_equal(found[0].covariance, found[1].covariance)


@pytest.mark.parametrize('blind', [False, True])
def test_a_pose_alone_is_ambiguous_if_another_one_fits_as_well(blind):
    """Of a flat body that one view sees; also without a filter."""
    rng = np.random.default_rng(11)
    rig = orientation()
    corners = np.array([[-10.0, -10, 0], [10, -9, 0], [9, 11, 0], [-11, 8, 0]])
    flat = Body('patella', np.arange(4), corners - corners.mean(axis=0), np.zeros(4))
    turn = rig.rotation[0].T @ Rotation.from_rotvec([0.35, 0.1, 0]).as_matrix()
    tracker = BodyTracker(rig, [flat])
    tracked = []
    for k, time_s in enumerate([0.0, 0.005]):
        uv = project(rig, flat.xyz_mm @ turn.T) + rng.normal(0, 0.2, (2, 4, 2))
        if k and blind:
            uv[1] = np.nan
        given = exposure(rig, flat.target_id, uv, Noise(0.2))
        tracked.append(tracker.add(given, k, 1 + round(1e9 * time_s)))
    expected = PoseStatus.AMBIGUOUS if blind else PoseStatus.OK
    assert tracked[1].status[0] == poses_alone([flat], tracked)[0].status[1] == expected
