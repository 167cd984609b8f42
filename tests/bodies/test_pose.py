# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Poses from one exposure: scatter against covariance, bound, scipy, and false markers."""

from dataclasses import replace

import numpy as np
import pytest
from body_views import Noise, body, exposure, observed, orientation, project
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, norm

from fluoro_calib_ros.bodies.body import Body, check_bodies
from fluoro_calib_ros.bodies.pose import (
    PoseSolver,
    Prediction,
    _curvature,
    _variance_of_last,
)
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.photogrammetry.rotations import cross_matrix, vector_from_matrix


def unknown(count):
    """Return the prediction of bodies of which nothing is known."""
    return Prediction(
        np.tile(np.eye(3), (count, 1, 1)),
        np.zeros((count, 3)),
        np.tile(np.eye(6), (count, 1, 1)),
        known=np.zeros(count, dtype=bool),
        weak=np.ones(count, dtype=int),
    )


UNKNOWN = unknown(1)


def random_pose(rng):
    return Rotation.from_rotvec(rng.normal(0, 0.5, 3)).as_matrix(), rng.uniform(-25, 25, 3)


class Drawn:
    """Bodies of random shapes and poses, which are solved in one exposure, each as if alone."""

    def __init__(self, rng, count, markers, shape_sd=0.0):
        self.bodies = [
            body(rng, markers, f'body {i}', 1 + markers * i, shape_sd) for i in range(count)
        ]
        poses = [random_pose(rng) for _ in self.bodies]
        self.rotation, self.centre = (np.array(part) for part in zip(*poses))
        self.points = np.array(
            [
                (one.xyz_mm + rng.normal(0, shape_sd, (markers, 3)) - one.centre) @ r.T + c
                for one, (r, c) in zip(self.bodies, poses)
            ]
        )

    def uv(self, rng, rig, px=0.2):
        """Return noisy image points (F, count, markers, 2); errors of the rig for each body."""
        root = rig.covariance_root()
        return np.stack(
            [project(rig, points, root @ rng.normal(size=len(root))) for points in self.points],
            axis=1,
        ) + rng.normal(0, px, (len(rig.fluoroscopes), *self.points.shape[:2], 2))

    def solve(self, rig, uv, noise, reject=4.0, prediction=None):
        ids = np.concatenate([one.target_id for one in self.bodies])
        seen = exposure(rig, ids, uv.reshape(len(uv), -1, 2), noise, reject)
        return PoseSolver(rig, self.bodies).solve(seen, prediction or unknown(len(self.bodies)))

    def errors(self, centre, rotation):
        """Errors (count, 6) of poses: shift, and rotation about the axes of the rig."""
        turns = rotation @ np.swapaxes(self.rotation, 1, 2)
        return np.column_stack([centre - self.centre, vector_from_matrix(turns)])


def trials(rng, rig, count, markers=4, noise=Noise(), shape_sd=0.0):
    """Errors (count, 6) and covariances of random poses, with all errors drawn anew."""
    drawn = Drawn(rng, count, markers, shape_sd)
    uv = drawn.uv(rng, rig, np.hypot(noise.px, noise.correction_px))
    found = drawn.solve(rig, uv, noise)
    assert found.alone.all()
    by_rig = found.rig_root @ np.swapaxes(found.rig_root, 1, 2)
    covariance = found.covariance_noise + found.covariance_fixed + by_rig
    return drawn.errors(found.centre_mm, found.rotation), covariance


def nse(errors, covariances):
    solved = np.linalg.solve(covariances, errors[:, :, None])[:, :, 0]
    return float(np.mean(np.sum(errors * solved, axis=1)) / 6)


@pytest.mark.parametrize(('markers', 'views'), [(3, 2), (6, 2), (4, 3)])
def test_scatter_is_as_claimed(markers, views):
    rng = np.random.default_rng(markers)
    errors, covariances = trials(
        rng,
        orientation(views),
        150,
        markers=markers,
        noise=Noise(0.2, 0.1),
        shape_sd=0.05,
    )
    assert nse(errors, covariances) == pytest.approx(1, abs=0.17)  # 3 sd: 3 sqrt(2 / 900)


def test_errors_of_the_rig_are_part_of_the_covariance():
    rng = np.random.default_rng(1)
    sd = np.tile([0.05, 0.05, 0.05, 1e-4, 1e-4, 1e-4, 0.05, 0.05, 0.1], 2)
    root = sd[:, None] * rng.normal(size=(18, 4)) / 2
    rig = orientation(2, root @ root.T)
    errors, covariances = trials(rng, rig, 150)
    assert nse(errors, covariances) == pytest.approx(1, abs=0.17)


def test_pose_is_that_of_scipy():
    rng = np.random.default_rng(2)
    rig = orientation()
    given = body(rng, 5)
    rotation, centre = random_pose(rng)
    points = (given.xyz_mm - given.centre) @ rotation.T + centre
    uv = project(rig, points) + rng.normal(0, 0.2, (2, 5, 2))
    found = PoseSolver(rig, [given]).solve(exposure(rig, given.target_id, uv, Noise(0.2)), UNKNOWN)

    def residuals(x):
        turn = Rotation.from_rotvec(x[3:]).as_matrix()
        return (project(rig, (given.xyz_mm - given.centre) @ turn.T + x[:3]) - uv).ravel()

    start = np.concatenate([centre, Rotation.from_matrix(rotation).as_rotvec()])
    peer = least_squares(residuals, start, xtol=1e-14, ftol=1e-14)
    assert np.abs(found.centre_mm[0] - peer.x[:3]).max() < 1e-4
    turn = Rotation.from_rotvec(peer.x[3:]).as_matrix()
    assert np.abs(found.rotation[0] - turn).max() < 1e-6
    bound = 0.2**2 * np.linalg.inv(peer.jac.T @ peer.jac)[:3, :3]
    assert found.covariance_noise[0][:3, :3] == pytest.approx(bound, rel=0.02, abs=1e-7)


@pytest.mark.parametrize('view', [0, 1])
def test_one_view_contributes_what_it_sees(view):
    """With a prediction, the pose from a single view scatters as claimed."""
    rng = np.random.default_rng(3)
    rig = orientation()
    sd = np.array([2.0, 2, 2, 0.02, 0.02, 0.02])
    squares = []
    for _ in range(5):
        drawn = Drawn(rng, 20, 4)
        uv = drawn.uv(rng, rig)
        uv[1 - view] = np.nan
        away = rng.normal(0, sd, (20, 6))
        prediction = replace(
            unknown(20),
            rotation=Rotation.from_rotvec(away[:, 3:]).as_matrix() @ drawn.rotation,
            centre_mm=drawn.centre + away[:, :3],
            covariance=np.tile(np.diag(sd**2), (20, 1, 1)),
            known=np.ones(20, dtype=bool),
        )
        found = drawn.solve(rig, uv, Noise(0.2), prediction=prediction)
        assert np.isfinite(found.covariance_fixed).all()
        told = found.information
        for normal, right, error in zip(
            told.normal, told.right, drawn.errors(told.centre_mm, told.rotation)
        ):
            # At the linearisation point, the data pull by `right`, in balance with the prediction.
            values, vectors = np.linalg.eigh(normal)
            seen = values > 1e-3 * values.max()
            missing = (vectors.T @ (right - normal @ -error))[seen] / np.sqrt(values[seen])
            squares.append(np.mean(missing**2))
    assert np.mean(squares) == pytest.approx(1, abs=0.25)


def test_false_marker_is_found_and_the_others_stay():
    rng = np.random.default_rng(4)
    rig = orientation()
    drawn = Drawn(rng, 60, 5)
    uv = drawn.uv(rng, rig)
    bodies = np.arange(60)
    row = rng.integers(5, size=60)
    uv[:, bodies, row] += rng.normal(0, 10, (2, 60, 2))
    found = drawn.solve(rig, uv, Noise(0.2), reject=None)
    right = ~found.used[bodies, row] & (found.used.sum(axis=1) == 4)
    assert np.count_nonzero(~right) <= 3
    assert (found.test[bodies, row][right] > 1).all()
    shift = found.centre_mm - drawn.centre
    assert (np.linalg.norm(shift[right], axis=1) < 0.5).all()


def differences(function, size, step):
    """Derivatives (..., size) of a function of a vector, by central differences."""
    steps = step * np.eye(size)
    return np.stack([(function(h) - function(-h)) / (2 * step) for h in steps], axis=-1)


def test_false_marker_is_found_beside_errors_of_the_rig():
    """The test is e' (S + B B')^-1 e of its residuals e from the pose of the others (peer: dense).

    S is their covariance without errors of the rig, B their change by those of unit variance.
    """
    rng = np.random.default_rng(17)
    sd = np.tile([0.1] * 3 + [2e-4] * 3 + [0.5, 0.5, 2.0], 2)
    rig = orientation(covariance=np.diag(sd**2))
    root = rig.covariance_root()
    noise = Noise(0.3)
    shape_sd = 0.03
    limit = chi2.isf(2 * norm.sf(4), 4)
    for _ in range(4):
        given = body(rng, 5, sd=shape_sd)
        rotation, centre = random_pose(rng)
        markers = given.xyz_mm - given.centre
        true = markers @ rotation.T + centre
        uv = project(rig, true, root @ rng.normal(size=len(root)))
        uv = uv + rng.normal(0, noise.px, uv.shape)
        uv[0, 2] += [0.0, 6.0]
        found = PoseSolver(rig, [given]).solve(
            exposure(rig, given.target_id, uv, noise, reject=None), UNKNOWN
        )
        assert found.used[0].tolist() == [True, True, False, True, True]
        rotation, centre = found.rotation[0], found.centre_mm[0]

        def of_pose(step):
            turned = markers @ rotation.T @ Rotation.from_rotvec(step[3:]).as_matrix().T
            return project(rig, turned + centre + step[:3]).transpose(1, 0, 2).reshape(5, 4)

        points = markers @ rotation.T + centre

        def of_place(step):
            return project(rig, points + step).transpose(1, 0, 2).reshape(5, 4)

        def of_rig(step):
            return project(rig, points, root @ step).transpose(1, 0, 2).reshape(5, 4)

        by_pose, by_place = differences(of_pose, 6, 1e-4), differences(of_place, 3, 1e-3)
        by_rig = differences(of_rig, root.shape[1], 1e-2)
        covariance = noise.px**2 * np.eye(4) + shape_sd**2 * by_place @ np.swapaxes(by_place, 1, 2)
        weighted = np.swapaxes(np.linalg.solve(covariance, by_pose), 1, 2)
        others = np.arange(5) != 2
        pose_covariance = np.linalg.inv((weighted @ by_pose)[others].sum(axis=0))
        by_others = -pose_covariance @ (weighted @ by_rig)[others].sum(axis=0)
        e = uv.transpose(1, 0, 2).reshape(5, 4)[2] - of_pose(np.zeros(6))[2]
        b = by_rig[2] + by_pose[2] @ by_others
        total = covariance[2] + by_pose[2] @ pose_covariance @ by_pose[2].T + b @ b.T
        expected = e @ np.linalg.solve(total, e) / limit
        assert found.test[0, 2] == pytest.approx(expected, rel=0.02)


def test_true_markers_are_kept():
    rng = np.random.default_rng(5)
    drawn = Drawn(rng, 150, 6)
    found = drawn.solve(orientation(), drawn.uv(rng, orientation()), Noise())
    assert found.used.sum() >= 150 * 6 - 3  # 1 of 16,000 markers exceeds four standard deviations


def test_markers_that_contradict_each_other_by_far_leave_a_frame_without_a_pose():
    """Precise markers that all disagree are excluded until the pose is singular."""
    rng = np.random.default_rng(9)
    drawn = Drawn(rng, 60, 4)
    uv = drawn.uv(rng, orientation())
    found = drawn.solve(orientation(), uv, Noise(0.005), reject=None)
    assert (np.isfinite(found.rotation).all(axis=(1, 2)) == found.alone).all()
    assert np.count_nonzero(found.used.sum(axis=1) < 3) > 40


def test_two_markers_give_no_pose_alone():
    rng = np.random.default_rng(6)
    rig = orientation()
    given = body(rng, 4)
    uv = project(rig, given.xyz_mm - given.centre)
    uv[:, 2:] = np.nan
    found = PoseSolver(rig, [given]).solve(exposure(rig, given.target_id, uv, Noise(0.2)), UNKNOWN)
    assert not found.alone[0] and np.isnan(found.rotation).all()


def test_a_prediction_that_all_markers_contradict_rejects_none():
    """A body has been hit, and the exposure alone does not determine its pose."""
    rng = np.random.default_rng(8)
    rig = orientation()
    given = body(rng, 4)
    points = given.xyz_mm - given.centre
    uv = project(rig, points + [2.0, -1.0, 2.0]) + rng.normal(0, 0.2, (2, 4, 2))
    uv[:, 2:] = np.nan
    start = Prediction(
        np.eye(3)[None],
        np.zeros((1, 3)),
        np.diag([0.1**2] * 3 + [1e-3**2] * 3)[None],
        known=np.ones(1, dtype=bool),
        weak=np.ones(1, dtype=int),
    )
    found = PoseSolver(rig, [given]).solve(exposure(rig, given.target_id, uv, Noise(0.2)), start)
    assert not found.alone[0]
    assert found.used[0].tolist() == [True, True, False, False]


def test_markers_on_a_line_give_no_rotation_about_it():
    rng = np.random.default_rng(7)
    rig = orientation()
    xyz = np.outer(np.linspace(-15, 15, 4), [1.0, 0.5, 0.2])
    given = Body('fibula', np.arange(4), xyz, np.zeros(4))
    found = PoseSolver(rig, [given]).solve(observed(rig, given.target_id, xyz, rng), UNKNOWN)
    assert not found.alone[0]


def flat_from_one_view(thickness, prediction_sd, blind=1):
    """A body of four nearly coplanar markers, tilted by 20 degrees to the view that sees it."""
    rng = np.random.default_rng(11)
    rig = orientation()
    corners = np.array([[-10.0, -10, 0], [10, -9, 0], [9, 11, 0], [-11, 8, 0]])
    corners[:, 2] = thickness * np.array([1, -1, 1, -1])
    given = Body('patella', np.arange(4), corners - corners.mean(axis=0), np.zeros(4))
    turn = rig.rotation[1 - blind].T @ Rotation.from_rotvec([0.35, 0.1, 0]).as_matrix()
    uv = project(rig, given.xyz_mm @ turn.T) + rng.normal(0, 0.2, (2, 4, 2))
    uv[blind] = np.nan
    start = Prediction(
        turn[None],
        np.zeros((1, 3)),
        np.diag([25.0] * 3 + [prediction_sd**2] * 3)[None],
        known=np.ones(1, dtype=bool),
        weak=np.ones(1, dtype=int),
    )
    return PoseSolver(rig, [given]).solve(exposure(rig, given.target_id, uv, Noise(0.2)), start)


def test_a_flat_body_that_one_view_sees_is_ambiguous_unless_the_prediction_tells():
    assert flat_from_one_view(0.0, 0.5).ambiguous[0]
    assert not flat_from_one_view(0.0, 0.03).ambiguous[0]
    assert not flat_from_one_view(8.0, 0.5).ambiguous[0]
    # The second pose is the reflection at the line of sight of the view that sees the body.
    assert flat_from_one_view(0.0, 0.5, blind=0).ambiguous[0]


def test_bodies_are_solved_as_one_by_one():
    rng = np.random.default_rng(8)
    rig = orientation()
    bodies = [body(rng, 5, 'femur', 1), body(rng, 3, 'tibia', 20), body(rng, 4, 'talus', 40)]
    ids = np.concatenate([one.target_id for one in bodies])
    points = np.concatenate(
        [one.xyz_mm - one.centre + [30 * k, 0, 0] for k, one in enumerate(bodies)]
    )
    seen = observed(rig, ids, points, rng)
    together = PoseSolver(rig, bodies).solve(seen, unknown(len(bodies)))
    for row, one in enumerate(bodies):
        alone = PoseSolver(rig, [one]).solve(seen, UNKNOWN)
        assert together.centre_mm[row] == pytest.approx(alone.centre_mm[0], abs=1e-9)
        assert together.rotation[row] == pytest.approx(alone.rotation[0], abs=1e-11)
        assert together.markers[row] == len(one.target_id)


@pytest.mark.parametrize(
    ('arguments', 'cause'),
    [
        (('femur', [1, 1, 2], np.eye(3), np.zeros(3)), 'marker 1 is given twice'),
        (('femur', [1, 2], np.eye(3), np.zeros(3)), '2 markers, 3 positions'),
        (('', [1, 2, 3], np.eye(3), np.zeros(3)), 'no name'),
        (('femur', [1, 2, 3], np.eye(3), [0, -1, 0]), 'marker 2'),
        (('femur', [], np.zeros((0, 3)), []), 'no markers'),
    ],
)
def test_impossible_bodies_are_refused(arguments, cause):
    with pytest.raises(DataError, match=cause):
        Body(*arguments)


def test_a_marker_of_two_bodies_is_refused():
    rng = np.random.default_rng(9)
    with pytest.raises(DataError, match='marker 4 is one of femur and of tibia'):
        check_bodies([body(rng, 4, 'femur', 1), body(rng, 4, 'tibia', 4)])
    with pytest.raises(DataError, match='two bodies are called femur'):
        check_bodies([body(rng, 4, 'femur', 1), body(rng, 4, 'femur', 11)])


def test_what_derivatives_neglect_by_monte_carlo():
    rng = np.random.default_rng(12)
    place = rng.normal(0, 10, 3)
    by_place = rng.normal(0, 3, (1, 1, 1, 2, 3))
    by_pose = np.hstack([np.eye(3), -cross_matrix(place)])[None, None]
    root = rng.normal(size=(6, 6)) * np.repeat([0.5, 0.1], 3)[:, None]
    twists = rng.normal(size=(200_000, 6)) @ root.T
    moved = twists[:, :3] + np.cross(twists[:, 3:], place)
    neglected = np.cross(twists[:, 3:], moved) / 2 @ by_place[0, 0, 0].T
    found = _curvature(by_place, by_pose, (root @ root.T)[None])
    assert found[0, 0, 0] == pytest.approx(np.mean(neglected**2), rel=0.03)


def test_observations_with_an_error_in_common_tell_no_more_than_it_allows():
    noise, common = 0.04, 0.1
    number = np.arange(1, 21)
    told = np.sum(1 / _variance_of_last(np.array(noise), np.array(common), number))
    covariance = noise * np.eye(20) + common
    assert told == pytest.approx(np.sum(np.linalg.inv(covariance)), rel=1e-9)


def body_in_two_views(rng, rig):
    """A body of four markers, its pose, and its image points (2, 4, 2)."""
    given = body(rng, 4)
    rotation, centre = random_pose(rng)
    points = (given.xyz_mm - given.centre) @ rotation.T + centre
    return given, (rotation, centre), project(rig, points) + rng.normal(0, 0.2, (2, 4, 2))


@pytest.mark.parametrize('false_px', [0.0, 20.0])
def test_iteration_starts_near_a_body_unless_its_markers_contradict_each_other(false_px):
    """Two of the four markers are in space, the others only in one view."""
    rng = np.random.default_rng(9)
    rig = orientation()
    for _ in range(20):
        given, (rotation, centre), uv = body_in_two_views(rng, rig)
        uv[1, 2:] = np.nan
        uv[0, 2] += false_px
        away = Rotation.from_rotvec(rng.normal(0, 0.2, 3)).as_matrix()
        near = replace(
            UNKNOWN,
            rotation=(away @ rotation)[None],
            centre_mm=(centre + rng.normal(0, 5, 3))[None],
            near=np.ones(1, dtype=bool),
        )
        seen = exposure(rig, given.target_id, uv, Noise(0.2))
        solver = PoseSolver(rig, [given])
        assert not solver.solve(seen, UNKNOWN).alone[0]
        found = solver.solve(seen, near)
        if false_px:
            assert not found.alone[0] and not found.markers[0]
        else:
            assert found.markers[0] == 4
            turn = vector_from_matrix(found.rotation[0] @ rotation.T)
            assert np.linalg.norm(turn) < 0.1 and np.abs(found.centre_mm[0] - centre).max() < 1


def test_contradicting_points_of_which_any_three_fit_a_pose_give_none():
    """Of four markers in one view one is false, and the others fit whichever is excluded."""
    rng = np.random.default_rng(11)
    rig = orientation()
    for _ in range(20):
        given, (rotation, centre), uv = body_in_two_views(rng, rig)
        uv[1] = np.nan
        uv[0, rng.integers(4)] += 30.0
        expected = replace(
            UNKNOWN,
            rotation=rotation[None],
            centre_mm=centre[None],
            covariance=np.diag([4.0] * 3 + [0.04] * 3)[None],
            known=np.ones(1, dtype=bool),
        )
        seen = exposure(rig, given.target_id, uv, Noise(0.2))
        found = PoseSolver(rig, [given]).solve(seen, expected)
        assert not found.alone[0] and not found.markers[0]
