# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Smoothing against batch least squares, honest variances, and the best Butterworth filter."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fluoro_calib_ros.bodies.motion import (
    MotionFilter,
    PoseInformation,
    _scores,
    _smoothed_covariance,
    _transition,
    noise_factors,
    pose_after,
    smooth_trial,
    turn_of_twists,
    twist_between,
)
from fluoro_calib_ros.photogrammetry.rotations import (
    cross_matrix,
    left_jacobian,
    matrix_from_vector,
    vector_from_matrix,
)

RATE = 250.0
SD = np.array([0.05, 0.05, 0.05, 0.002, 0.002, 0.002])


def gait(t):
    """Sum of harmonics of a gait with one step per second."""
    sizes = [60, 18, 6, 2, 1]
    return sum(size * np.sin(2 * np.pi * (k + 1) * t + k) for k, size in enumerate(sizes))


def landing(t):
    """A fall that ends with a damped oscillation of 28 Hz."""
    s = np.clip(t - 0.5, 0, None)
    fall = -60 * np.minimum(t, 0.5) ** 2
    return fall + np.where(s > 0, -6 * np.exp(-s / 0.03) * np.sin(2 * np.pi * 28 * s), 0)


def trial(motion, seconds=0.8, seed=0, bodies=3):
    """True centres (T, B, 3) and rotations, and the information of each exposure."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, seconds, 1 / RATE)
    phase = 0.02 * np.arange(bodies)
    centre = np.stack(
        [np.stack([motion(t + p), 0.6 * motion(t + p), 0.2 * motion(t + p)], 1) for p in phase], 1
    )
    turn = matrix_from_vector(centre / 150)
    seen = []
    for k in range(len(t)):
        noise = rng.normal(0, SD, (bodies, 6))
        seen.append(
            PoseInformation(
                matrix_from_vector(noise[:, 3:]) @ turn[k],
                centre[k] + noise[:, :3],
                np.tile(np.diag(SD**-2), (bodies, 1, 1)),
                np.zeros((bodies, 6)),
            )
        )
    return t, centre, turn, seen


def follow(seen, lag=None):
    """A filter after following a trial, and its reports."""
    bodies = len(seen[0].centre_mm)
    follower = MotionFilter(bodies, lag)
    reports = []
    for k, one in enumerate(seen):
        follower.predict(1 / RATE if k else 0.0)
        follower.update(one, np.full(bodies, k == 0))
        if lag is not None and k >= lag:
            reports.append(follower.smoothed())
    return follower, reports


def errors(motion, centre, turn):
    """Errors (T, B, 6) of a motion, and their claimed standard deviations."""
    away = np.concatenate(
        [
            motion.centre_mm - centre,
            vector_from_matrix(motion.rotation @ np.swapaxes(turn, -1, -2)),
        ],
        axis=-1,
    )
    return away, np.sqrt(np.diagonal(motion.covariance, axis1=-2, axis2=-1)[..., :6])


def best_butterworth(values, true):
    """Smallest RMS error of zero-lag Butterworth filters, with the cutoff chosen by the truth."""
    from scipy.signal import butter, filtfilt  # slow import: half a second in each worker

    return min(
        np.sqrt(np.mean((filtfilt(*butter(2, cutoff, fs=RATE), values, axis=0) - true) ** 2))
        for cutoff in np.geomspace(2, 0.45 * RATE, 30)
    )


def test_smoother_is_least_squares_of_the_whole_trial():
    """Positions with given densities, against a dense solution of all states and noises.

    Rotations are known to a microradian, as otherwise they and positions are not independent.
    """
    rng = np.random.default_rng(1)
    count = 12
    sd = np.where(np.arange(6) < 3, SD, 1e-6)
    dt = 0.01
    log_q = np.column_stack([rng.uniform(8, 12, count), np.full(count, 5.0)])
    places = np.cumsum(rng.normal(0, 0.1, (count, 3)), axis=0)
    follower = MotionFilter(1, None)
    for k in range(count):
        follower.predict(dt if k else 0.0, log_q[k][None])
        seen = PoseInformation(
            np.eye(3)[None], places[k][None], np.diag(sd**-2)[None], np.zeros((1, 6))
        )
        follower.update(seen, np.array([k == 0]), adapt=False)
    follower.lag = None
    smoothed = follower.smoothed()

    into = _transition(dt, np.zeros((1, 3)))[0][np.ix_([0, 6, 12], [0, 6, 12])]
    first = follower.steps[0].covariance[0][np.ix_([0, 6, 12], [0, 6, 12])]
    normal = np.zeros((3 * count, 3 * count))
    right = np.zeros(3 * count)
    normal[:3, :3] += np.linalg.inv(first)
    right[0] += np.linalg.inv(first)[0, 0] * places[0, 0]
    for k in range(count):
        normal[3 * k, 3 * k] += SD[0] ** -2
        right[3 * k] += places[k, 0] * SD[0] ** -2
        if k:
            weight = np.linalg.inv(np.exp(log_q[k, 0]) * noise_factors(dt))
            rows = np.hstack([-into, np.eye(3)])
            block = slice(3 * k - 3, 3 * k + 3)
            normal[block, block] += rows.T @ weight @ rows
    peer = np.linalg.solve(normal, right)
    inverse = np.linalg.inv(normal)
    assert smoothed.centre_mm[:, 0, 0] == pytest.approx(peer[::3], abs=1e-6)
    assert smoothed.velocity[:, 0, 0] == pytest.approx(peer[1::3], abs=1e-4)
    variance = smoothed.covariance[:, 0, 0, 0]
    assert variance == pytest.approx(np.diagonal(inverse)[::3], rel=0.01)
    assert variance[3:] == pytest.approx(np.diagonal(inverse)[9::3], rel=1e-4)


def test_derivatives_by_the_densities_are_those_of_the_likelihood():
    """Score of the smoother against differences of the likelihood of all innovations."""
    _, _, _, seen = trial(gait, 0.12, bodies=1)
    rng = np.random.default_rng(2)
    log_q = np.column_stack([rng.uniform(14, 17, len(seen)), rng.uniform(6, 9, len(seen))])

    def run(h):
        follower = MotionFilter(1, None)
        cost = 0.0
        for k, one in enumerate(seen):
            follower.predict(1 / RATE if k else 0.0, h[k][None])
            follower.update(one, np.array([k == 0]), adapt=False)
            step = follower.steps[-1]
            if k:
                inverse = step.m[0]
                innovation = np.linalg.solve(inverse, step.z[0])
                cost += 0.5 * np.linalg.slogdet(inverse)[1] - 0.5 * innovation @ step.z[0]
        return cost, follower

    _, follower = run(log_q)
    score = _scores(follower.steps)[0, :, 0]
    for k, kind in ((5, 0), (12, 1), (20, 0)):
        shifted = [log_q.copy() for _ in range(2)]
        for sign, h in zip((1, -1), shifted):
            h[k, kind] += sign * 1e-3
        numeric = (run(shifted[0])[0] - run(shifted[1])[0]) / 2e-3
        # Rotations are slightly nonlinear: 2 % for scores of size one.
        assert score[k, kind] == pytest.approx(numeric, rel=0.02, abs=0.02)


def test_transition_of_rotations_by_differences():
    rng = np.random.default_rng(3)
    dt = 0.02
    turn = rng.normal(0, 0.3, 3)
    into = _transition(dt, turn[None])[0]
    for axis in range(3):
        d = np.zeros(3)
        d[axis] = 1e-6
        plain = matrix_from_vector(turn)
        by_rotation = matrix_from_vector(turn) @ matrix_from_vector(d)
        by_speed = matrix_from_vector(turn + dt * d)
        for column, moved in ((3 + axis, by_rotation), (9 + axis, by_speed)):
            change = vector_from_matrix(moved @ plain.T) / 1e-6
            assert into[3:6, column] == pytest.approx(change, abs=1e-5)


def test_poses_follow_twists_and_back():
    rng = np.random.default_rng(4)
    first = Rotation.random(5, random_state=rng).as_matrix(), rng.normal(0, 20, (5, 3))
    twist = rng.normal(0, 1, (5, 6)) * [20, 20, 20, 1, 1, 1]
    assert twist_between(first, pose_after(*first, twist)) == pytest.approx(twist, abs=1e-9)
    # A rotation about a line leaves the points on that line in place.
    point = np.array([3.0, -8.0, 5.0])
    line = np.array([0.3, 0.5, -0.4])
    turn = np.concatenate([-np.cross(line, point), line])
    rotation, centre = pose_after(np.eye(3)[None], np.zeros((1, 3)), turn[None])
    for moved in (point, point + 4 * line):
        assert rotation[0] @ moved + centre[0] == pytest.approx(moved, abs=1e-9)


def test_where_exposures_are_linearised_does_not_matter_to_what_they_do_not_see():
    """With two markers, the information is independent of the rotation about their line."""
    rng = np.random.default_rng(6)
    truth = Rotation.random(random_state=rng).as_matrix()
    markers = np.array([[8.0, -3, 2], [-5, 6, 4]]) @ truth.T
    line = (markers[1] - markers[0]) / np.linalg.norm(markers[1] - markers[0])
    derivatives = [np.hstack([np.eye(3), -cross_matrix(p)]) for p in markers]
    normal = sum(d.T @ d for d in derivatives) / SD[0] ** 2
    noise = rng.normal(0, 1 / SD[0], (40, 2, 3))
    turns = rng.normal(0, 0.3, 40)

    def follow_line(turns):
        follower = MotionFilter(1, 0)
        for k, angle in enumerate(turns):
            follower.predict(1 / RATE if k else 0.0, np.array([[15.0, 8.0]]))
            whole = k < 20
            turn = np.eye(3) if whole else matrix_from_vector(angle * line)
            axes = turn_of_twists(np.eye(3)[None], turn[None])[0]
            told = normal + np.diag(SD**-2) if whole else normal
            right = sum(d.T @ n for d, n in zip(derivatives, noise[k]))
            follower.update(
                PoseInformation(
                    (turn @ truth)[None],
                    (markers[0] - turn @ markers[0])[None],
                    (axes @ told @ axes.T)[None],
                    (axes @ right)[None],
                ),
                np.array([k == 0]),
                adapt=False,
            )
        return follower.smoothed()

    plain = follow_line(0 * turns)
    turned = follow_line(turns)
    sd = np.sqrt(np.diagonal(plain.covariance[0, 0]))
    assert sd[3:6].max() > 5 * sd[3:6].min()
    assert np.sqrt(np.diagonal(turned.covariance[0, 0])) == pytest.approx(sd, rel=0.02)
    difference, _ = errors(turned, plain.centre_mm, plain.rotation)
    assert (np.abs(difference[0, 0]) < 0.2 * sd[:6]).all()


def test_left_jacobian_by_differences_at_small_and_large_angles():
    rng = np.random.default_rng(4)
    for size in (1e-9, 1e-3, 0.04, 0.06, 1.0, 3.0):
        w = rng.normal(size=3)
        w *= size / np.linalg.norm(w)
        for axis in range(3):
            d = np.zeros(3)
            d[axis] = 1e-6
            moved = matrix_from_vector(w + d) @ matrix_from_vector(w - d).T
            numeric = vector_from_matrix(moved) / 2e-6
            assert left_jacobian(w)[:, axis] == pytest.approx(numeric, abs=1e-6)


@pytest.mark.long
@pytest.mark.parametrize(('motion', 'limit'), [(gait, 1.0), (landing, 0.75)])
def test_errors_are_smaller_than_with_the_best_cutoff_and_as_claimed(motion, limit):
    _, centre, turn, seen = trial(motion)
    follower, _ = follow(seen)
    away, sd = errors(smooth_trial(follower, seen), centre, turn)
    measured = np.array([one.centre_mm for one in seen])
    for body in range(3):
        best = best_butterworth(measured[:, body], centre[:, body])
        assert np.sqrt(np.mean(away[:, body, :3] ** 2)) < limit * best
    # 3600 errors correlated over about five exposures: 3 sd of their mean square.
    assert 0.7 < np.mean((away / sd) ** 2) < 1.3


@pytest.mark.parametrize('motion', [gait, landing])
def test_live_without_lag_errors_are_smaller_than_of_single_exposures(motion):
    _, centre, turn, seen = trial(motion)
    _, reports = follow(seen, lag=0)
    away = []
    for k, report in enumerate(reports[20:], 20):
        error, sd = errors(report, centre[k][None], turn[k][None])
        away.append(error[0] / sd[0])
        assert (sd[0, :, :3] <= 1.01 * SD[:3]).all()
    away = np.array(away)
    assert 0.75 < np.mean(away**2) < 1.3
    assert np.abs(away).max() < 6


def test_a_lag_is_the_smoother_of_what_was_seen_until_then():
    _, _, _, seen = trial(gait, 0.3, bodies=2)
    _, reports = follow(seen, lag=5)
    follower, _ = follow(seen[:31])
    whole = follower.smoothed()
    assert reports[25].centre_mm[0] == pytest.approx(whole.centre_mm[25], abs=1e-9)
    assert reports[25].covariance[0] == pytest.approx(whole.covariance[25], rel=1e-6, abs=1e-12)


@pytest.mark.long
def test_a_gap_is_as_unsure_as_it_is():
    """12 exposures without a marker: errors are as claimed, and larger in the middle."""
    _, centre, turn, seen = trial(gait, 0.5, bodies=5)
    for one in seen[60:72]:
        one.normal[:] = 0
    follower, _ = follow(seen)
    away, sd = errors(smooth_trial(follower, seen), centre, turn)
    assert (sd[66, :, :3] > 1.5 * sd[40, :, :3]).all()
    assert 0.1 < np.mean((away[60:72] / sd[60:72]) ** 2) < 2.5


def test_rotations_of_full_turns_are_followed():
    """A body that rotates at 20 rad/s through several full turns."""
    count = 120
    rng = np.random.default_rng(5)
    angle = 20 * np.arange(count) / RATE
    turn = Rotation.from_rotvec(angle[:, None] * [0.6, 0, 0.8]).as_matrix()
    noise = rng.normal(0, 0.002, (count, 3))
    seen = [
        PoseInformation(
            (matrix_from_vector(noise[k]) @ turn[k])[None],
            np.zeros((1, 3)),
            np.diag(SD**-2)[None],
            np.zeros((1, 6)),
        )
        for k in range(count)
    ]
    follower, _ = follow(seen)
    motion = smooth_trial(follower, seen)
    away = vector_from_matrix(motion.rotation[:, 0] @ np.swapaxes(turn, 1, 2))
    assert np.sqrt(np.mean(away**2)) < 0.001
    assert motion.velocity[40:80, 0, 3:] == pytest.approx(
        np.tile([12.0, 0, 16.0], (40, 1)), abs=0.3
    )


def test_covariance_that_rounding_has_made_indefinite_is_smoothed():
    """As after contradicting exposures, when a variance has decreased by many digits."""
    rng = np.random.default_rng(3)
    axes = np.linalg.qr(rng.normal(size=(18, 18)))[0]
    spread = np.geomspace(1e-9, 1, 18)
    covariance = (axes * np.r_[-1e-9, spread[1:]]) @ axes.T
    known = 1e12 * np.outer(axes[:, -1], axes[:, -1])  # information on the largest direction
    smoothed = _smoothed_covariance(covariance[None], (known / (1 + known.max()))[None])[0]
    assert np.isfinite(smoothed).all() and np.linalg.eigvalsh(smoothed)[0] > -1e-15
    unknown = _smoothed_covariance(covariance[None], np.zeros((1, 18, 18)))[0]
    np.testing.assert_allclose(unknown, covariance)
