# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Pairs of exposures that agree on a relative orientation, and the deviations of the others."""

from dataclasses import replace

import numpy as np
import pytest
import rigs

from fluoro_calib_ros.estimation.pair_scatter import (
    _about_trend,
    _moved_once,
    agreeing,
    displacements,
    functions_of_angles,
    steps_of,
)
from fluoro_calib_ros.photogrammetry.collinearity import project
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector
from fluoro_calib_ros.photogrammetry.unknowns import (
    Parameters,
    RelativeConstraint,
    RelativePose,
    discrepancies,
    exposures_from_pose,
    mean_pose,
)

SD = np.repeat([0.5, 2e-4], 3)  # mm, rad
POSE = RelativePose(matrix_from_vector(np.array([0.1, 1.2, -0.2])), np.array([900.0, 40.0, 600.0]))
ANGLES = np.linspace(-1.2, 1.3, 20)


def scattered(offset):
    """Parameters of pairs that are off the relative orientation by (k, 6), and their constraint.

    The weights (k, 6, 6) are those of SD.
    """
    rng = np.random.default_rng(1)
    count = len(offset)
    pairs = np.column_stack([np.arange(count), count + np.arange(count)])
    constraint = RelativeConstraint((0, 1), pairs, 1.0, 1.0)
    rotation = matrix_from_vector(rng.normal(0, 0.5, (2 * count, 3)))
    position = rng.normal(0, 300.0, (2 * count, 3))
    start = Parameters(np.zeros((2, 3)), rotation, position, np.zeros((0, 3)))
    rotation[count:], position[count:] = exposures_from_pose(start, constraint, POSE, offset)
    parameters = Parameters(np.zeros((2, 3)), rotation, position, np.zeros((0, 3)))
    return parameters, constraint, np.tile(np.diag(SD**-2.0), (count, 1, 1))


def noise(count, seed=2):
    return np.random.default_rng(seed).normal(size=(count, 6)) * SD


def by_definition(parameters, constraint, weights, used):
    """Deviations (k,) from the mean of the used pairs, over their sd, and their growth factor."""
    pose = mean_pose(parameters, constraint.pairs[used], weights[used])
    off = discrepancies(constraint, pose, parameters) / SD
    chi2 = np.sum(off[used] ** 2) / (6 * (used.sum() - 1))
    return np.sqrt(np.mean(off**2, axis=1)), max(1.0, np.sqrt(chi2))


@pytest.mark.parametrize('factor', [0.3, 1.0, 3.0])
def test_pairs_scatter_about_their_weighted_mean(factor):
    case = scattered(factor * noise(20))
    found = agreeing(*case, np.ones((20, 1)))
    off_sd, growth = by_definition(*case, np.ones(20, dtype=bool))
    assert found.used.all()
    np.testing.assert_allclose(found.off_sd, off_sd, rtol=1e-6)
    assert found.growth == found.unexplained == pytest.approx(growth, rel=1e-6)
    assert found.growth == pytest.approx(max(1.0, factor), rel=0.2)
    assert not found.trend.any()


def test_a_pair_that_contradicts_the_others_is_left_out():
    off = noise(20)
    off[3] += 30 * SD
    off[11, :3] += 300 * SD[:3]
    case = scattered(off)
    found = agreeing(*case, np.ones((20, 1)))
    used = np.ones(20, dtype=bool)
    used[[3, 11]] = False
    np.testing.assert_array_equal(found.used, used)
    off_sd, growth = by_definition(*case, used)
    np.testing.assert_allclose(found.off_sd, off_sd, rtol=1e-6)
    assert found.growth == pytest.approx(growth, rel=1e-6)


@pytest.mark.parametrize('wrong, kept', [(6, False), (7, True)])
def test_no_pair_is_left_out_where_too_many_contradict(wrong, kept):
    """At most a third of the pairs, six of 20, may be excluded."""
    off = noise(20)
    off[:wrong] += np.outer(np.linspace(100, 400, wrong) * (-1) ** np.arange(wrong), SD)
    assert agreeing(*scattered(off), np.ones((20, 1))).used[:wrong].all() == kept


def test_three_pairs_have_no_majority():
    off = noise(3)
    off[1] += 50 * SD
    case = scattered(off)
    found = agreeing(*case, np.ones((3, 1)))
    assert found.used.all()
    off_sd, growth = by_definition(*case, found.used)
    np.testing.assert_allclose(found.off_sd, off_sd, rtol=1e-6)
    assert found.growth == pytest.approx(growth, rel=1e-6)


def test_one_pair_tells_no_scatter():
    found = agreeing(*scattered(noise(1)), np.ones((1, 1)))
    assert found.used.all() and found.growth == 1.0
    np.testing.assert_allclose(found.off_sd, 0, atol=1e-6)


def turning(seed=2):
    """Discrepancies (k, 6) that follow the angles, and the functions of the angles."""
    columns = functions_of_angles([ANGLES, ANGLES])
    by_angle = np.random.default_rng(3).normal(0, 40.0, (columns.shape[1] - 1, 6)) * SD
    return (columns - columns.mean(axis=0))[:, 1:] @ by_angle + noise(20, seed), columns, by_angle


def test_what_follows_the_angle_is_no_scatter():
    off, columns, by_angle = turning()
    off[6] += 40 * SD
    found = agreeing(*scattered(off), columns)
    np.testing.assert_array_equal(np.flatnonzero(~found.used), [6])
    assert found.growth > 10
    assert 1 <= found.unexplained < 1.3
    assert np.sqrt(np.mean(found.off_sd[found.used] ** 2)) == pytest.approx(0.85, abs=0.15)
    assert found.off_sd[6] > 20
    true = columns[:, 1:] @ by_angle
    left = (found.trend - found.trend.mean(axis=0) - true + true.mean(axis=0)) / SD
    assert np.sqrt(np.mean(left**2)) < 1.0


def test_scatter_that_the_angle_does_not_explain_stays():
    """Explaining half of the variance is not enough to accept the angle as the cause."""
    _, columns, _ = turning()
    case = scattered(5 * noise(20, 7))
    found = agreeing(*case, columns)
    off_sd, growth = by_definition(*case, np.ones(20, dtype=bool))
    assert not found.trend.any() and found.unexplained == found.growth == pytest.approx(growth)
    np.testing.assert_allclose(found.off_sd, off_sd, rtol=1e-6)


def test_pairs_about_a_step_are_no_single_exposures():
    """The rig was moved before the last four exposures, so none of them is excluded."""
    off, columns, _ = turning()
    off[16:] += 200 * SD
    found = agreeing(*scattered(off), columns)
    assert found.used.all()
    weights = np.tile(np.diag(SD**-2.0), (20, 1, 1))
    assert _moved_once(off, weights, columns)
    assert not _moved_once(turning()[0], weights, columns)


def test_steps_have_two_pairs_on_either_side():
    found = np.hstack(steps_of(6))
    np.testing.assert_array_equal(
        found.T, [[0, 0, 1, 1, 1, 1], [0, 0, 0, 1, 1, 1], [0] * 4 + [1] * 2]
    )
    assert steps_of(3) == []


def test_a_trend_is_that_of_weighted_least_squares():
    rng = np.random.default_rng(4)
    off = rng.normal(size=(9, 6))
    columns = np.column_stack([np.ones(9), rng.normal(size=(9, 2))])
    root = rng.normal(size=(9, 6, 6))
    shared = root @ root.transpose(0, 2, 1)
    weights = 3.0 * shared
    deviation, trend = _about_trend(off, shared, weights, columns)
    design = np.einsum('ka,ij->kiaj', columns, np.eye(6)).reshape(9, 6, 18)
    normal = np.einsum('kia,kij,kjb->ab', design, shared, design)
    right = np.einsum('kia,kij,kj->a', design, shared, off)
    expected = design @ np.linalg.solve(normal, right)
    np.testing.assert_allclose(trend, expected, atol=1e-9)
    left = off - expected
    square = [one @ weight @ one / 6 for one, weight in zip(left, weights)]
    np.testing.assert_allclose(deviation**2, square, rtol=1e-9)


def test_displacements_are_those_of_image_points():
    network, truth = rigs.small_network(exposures=2, targets=20, fluoroscopes=2, seed=5)
    pairs = np.array([[0, 2], [1, 3]])
    rotation = truth.rotation[pairs[:, 1]] @ truth.rotation[pairs[:, 0]].transpose(0, 2, 1)
    shift = truth.position_mm[pairs[:, 1]] - truth.position_mm[pairs[:, 0]]
    poses = [
        RelativePose(turn, own @ t) for turn, own, t in zip(rotation, truth.rotation[:2], shift)
    ]
    np.testing.assert_allclose(displacements(network, truth, pairs, poses), 0, atol=1e-6)
    step = np.array([1.0, -2.0, 5.0, 1e-3, 2e-3, -5e-3])
    moved = [pose.updated(step) for pose in poses]
    found = displacements(network, truth, pairs, moved)
    np.testing.assert_allclose(
        displacements(network, truth, pairs, moved, poses), found, rtol=1e-6
    )
    for k, (a, b) in enumerate(pairs):
        points = truth.points_mm[network.point[network.exposure == b]]
        ways = [
            (truth.rotation[b], truth.position_mm[b]),
            (
                matrix_from_vector(step[3:]) @ truth.rotation[b],
                truth.position_mm[b] + truth.rotation[a].T @ step[:3],
            ),
        ]
        uv = [
            project(
                np.broadcast_to(r, (len(points), 3, 3)),
                np.broadcast_to(t, points.shape),
                points,
                truth.interior[1],
            )
            for r, t in ways
        ]
        assert found[k] == pytest.approx(np.sqrt(np.mean((uv[0] - uv[1]) ** 2)), rel=1e-9)
    behind = [replace(pose, rotation=-pose.rotation) for pose in poses]
    assert np.isinf(displacements(network, truth, pairs, behind)).all()
