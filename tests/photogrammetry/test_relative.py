# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Relative orientation constraints against finite differences and dense matrices."""

from dataclasses import replace

import numpy as np
import pytest
import rigs
from threadpoolctl import threadpool_limits

from fluoro_calib_ros.photogrammetry.adjustment import (
    adjust,
    residuals_and_q,
    total_cost,
)
from fluoro_calib_ros.photogrammetry.collinearity import AdditionalParameters, project
from fluoro_calib_ros.photogrammetry.noise import LOSSES, Noise
from fluoro_calib_ros.photogrammetry.outliers import adjust_and_estimate_noise
from fluoro_calib_ros.photogrammetry.precision import precision
from fluoro_calib_ros.photogrammetry.rotations import (
    matrix_from_vector,
    rotation_angle,
    vector_from_matrix,
)
from fluoro_calib_ros.photogrammetry.unknowns import (
    RIGID_SD_MM,
    RIGID_SD_RAD,
    RelativeConstraint,
    RelativePose,
    discrepancies,
    discrepancies_with_jacobian,
    exposures_from_pose,
    mean_pose,
    relative_poses,
)

POSE = RelativePose(matrix_from_vector([0.03, -1.19, -0.02]), np.array([-1300.0, 30.0, 980.0]))
SHAPES = [
    dict(exposures=4, targets=40),  # eliminates the points
    dict(exposures=12, targets=20),  # eliminates the exposures
]
SOFT = (0.5, 2e-4)


@pytest.fixture(autouse=True, scope='module')
def one_thread():
    with threadpool_limits(1):
        yield


def rigid_network(exposures=4, targets=30, sd=SOFT, seed=0, alone=1, nu=np.inf, length_mm=None):
    """Joint Network of two fluoroscopes of a rigid rig, and its true Parameters.

    The last `alone` exposures have no partner.
    """
    network, truth = rigs.small_network(exposures, targets, 2, seed=seed, nu=nu, seen=0.9)
    a = np.arange(exposures)
    pairs = np.stack([a, a + exposures], axis=1)[: exposures - alone]
    constraint = RelativeConstraint((0, 1), pairs, *sd, length_mm)
    rotation = truth.rotation.copy()
    position = truth.position_mm.copy()
    every = RelativeConstraint((0, 1), np.stack([a, a + exposures], axis=1), 1.0, 1.0)
    rotation[every.pairs[:, 1]], position[every.pairs[:, 1]] = exposures_from_pose(
        truth, every, POSE
    )
    truth = replace(truth, rotation=rotation, position_mm=position, relative=(POSE,))
    noise = network.sigma[:, None] * np.random.default_rng(seed + 1).normal(
        0, 0.3, network.uv.shape
    )
    uv = project(*network.per_image_point(truth)) + noise
    return replace(network, uv=uv, relative=(constraint,)), truth


def disturbed(truth, seed=0):
    return replace(
        rigs.disturbed(truth, seed),
        relative=tuple(
            p.updated(np.random.default_rng(seed).normal(0, [3.0] * 3 + [1e-3] * 3))
            for p in truth.relative
        ),
    )


def dense(network, result, factor=1.0):
    """Dense normal matrix (u, u), and derivatives (6k, u) of the constraint.

    Unknowns: exposures, points, interior and relative orientations. The derivatives are the
    analytic ones, which test_derivatives_equal_finite_differences verifies: the rounding errors of
    finite differences, amplified by the inverse, would be larger than the tolerances here.
    """
    plain = rigs.dense_normal_matrix(replace(network, relative=()), result, factor)
    u = len(plain)
    constraint = network.relative[0]
    pose = result.parameters.relative[0]
    _, d_a, d_b, d_pose = discrepancies_with_jacobian(constraint, pose, result.parameters)
    rows = np.zeros((len(constraint.pairs), 6, u + 6))
    for row, (a, b) in enumerate(constraint.pairs):
        rows[row, :, 6 * a : 6 * a + 6] = d_a[row]
        rows[row, :, 6 * b : 6 * b + 6] = d_b[row]
        rows[row, :, u:] = d_pose[row]
    rows = rows.reshape(-1, u + 6)
    normal = np.zeros((u + 6, u + 6))
    normal[:u, :u] = plain
    weights = np.tile(constraint.weights, len(constraint.pairs))
    return normal + rows.T @ (weights[:, None] * rows), rows


@pytest.mark.parametrize('length_mm', [None, 1500.0])
def test_derivatives_equal_finite_differences(length_mm):
    network, truth = rigid_network(alone=0)
    constraint = replace(network.relative[0], length_mm=length_mm)
    parameters = disturbed(truth, 1)
    pose = POSE.updated([2, -5, 8, 0.2, -0.1, 0.15])
    off, d_a, d_b, d_pose = discrepancies_with_jacobian(constraint, pose, parameters)
    np.testing.assert_allclose(off, discrepancies(constraint, pose, parameters))
    (a, b) = constraint.pairs.T
    step = 1e-6

    def by(rows, axis):
        def shifted(sign):
            rotation = parameters.rotation.copy()
            position = parameters.position_mm.copy()
            x = sign * step * np.eye(6)[axis]
            rotation[rows] = matrix_from_vector(x[3:]) @ rotation[rows]
            position[rows] = position[rows] + x[:3]
            return discrepancies(
                constraint, pose, replace(parameters, rotation=rotation, position_mm=position)
            )

        return (shifted(1) - shifted(-1)) / (2 * step)

    for axis in range(6):
        np.testing.assert_allclose(d_a[:, :, axis], by(a, axis), atol=2e-6 * 1500)
        np.testing.assert_allclose(d_b[:, :, axis], by(b, axis), atol=2e-6 * 1500)
        x = step * np.eye(6)[axis]
        slope = (
            discrepancies(constraint, pose.updated(x), parameters)
            - discrepancies(constraint, pose.updated(-x), parameters)
        ) / (2 * step)
        np.testing.assert_allclose(d_pose[:, :, axis], slope, atol=1e-6)


@pytest.mark.parametrize('angle', [0.0, 1e-9, 1e-3, 1.0, 3.0])
def test_rotation_vector_of_a_matrix(angle):
    w = angle * np.array([0.6, -0.64, 0.48])
    np.testing.assert_allclose(
        vector_from_matrix(matrix_from_vector(w)), w, rtol=1e-12, atol=1e-18
    )


@pytest.mark.parametrize('loss', LOSSES)
@pytest.mark.parametrize('shape', SHAPES)
def test_covariances_equal_the_dense_inverse(shape, loss):
    network, truth = rigid_network(**shape, nu=5.0)
    result = adjust(network, disturbed(truth), noise=Noise(loss, 0.3))
    assert result.converged
    precise = precision(network, result)
    expected = np.linalg.inv(dense(network, result, result.noise.information_factor(result.q))[0])
    sd = np.sqrt(np.diagonal(expected))

    def assert_equal(block, rows, columns):
        """Compare in standard deviations, as elements near zero are differences of larger ones."""
        error = block - expected[rows, columns]
        assert np.max(np.abs(error) / np.outer(sd[rows], sd[columns])) < 1e-7

    global_rows = slice(6 * network.n_exposures + 3 * network.n_points, None)
    for j in range(network.n_exposures):
        exposure = slice(6 * j, 6 * j + 6)
        assert_equal(precise.exterior[j], exposure, exposure)
        assert_equal(precise.exterior_global[j], exposure, global_rows)
    assert_equal(precise.all_global, global_rows, global_rows)
    assert_equal(precise.relative[0], slice(-6, None), slice(-6, None))
    weighted, rows = dense(network, result)
    part = np.einsum('ka,ab,kb->k', rows, np.linalg.inv(weighted), rows) * np.tile(
        network.relative[0].weights, len(network.relative[0].pairs)
    )
    np.testing.assert_allclose(precise.relative_redundancy[0].ravel(), 1 - part, atol=1e-6)
    total = (
        precise.redundancy.sum()
        + precise.survey_redundancy.sum()
        + precise.relative_redundancy[0].sum()
    )
    assert total == pytest.approx(network.n_observations - network.n_unknowns, rel=1e-7)


@pytest.mark.parametrize('shape', SHAPES)
@pytest.mark.parametrize('sd', [SOFT, (RIGID_SD_MM, RIGID_SD_RAD)])
def test_both_eliminations_give_the_same_solution_and_covariances(shape, sd):
    network, truth = rigid_network(**shape, sd=sd)
    rng = np.random.default_rng(5)
    network = replace(
        network,
        additional=(
            AdditionalParameters(rng.normal(0, 1, (len(network.rows(0)), 3)), np.eye(6)),
            None,
        ),
    )
    start = replace(disturbed(truth), additional=(np.zeros(6), None))
    found = []
    for of_exposures in (False, True):
        with rigs.eliminating(of_exposures):
            result = adjust_and_estimate_noise(network, start)
            found.append((result, precision(network, result)))
        assert result.converged
    (one, one_precise), (other, other_precise) = found
    sd = np.sqrt(np.diagonal(one_precise.exterior, axis1=1, axis2=2)[:, :3])
    assert np.max(np.abs(one.parameters.position_mm - other.parameters.position_mm) / sd) < 1e-4
    for name in (
        'interior',
        'exterior',
        'points',
        'residual',
        'redundancy',
        'all_global',
        'exterior_global',
    ):
        a = getattr(one_precise, name)
        b = getattr(other_precise, name)
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-5 * np.max(np.abs(b)), err_msg=name)


@pytest.mark.parametrize('shape', SHAPES)
def test_gradient_of_the_cost_is_zero_at_the_solution(shape):
    network, truth = rigid_network(**shape)
    result = adjust_and_estimate_noise(network, disturbed(truth), tolerance=1e-12)
    root = np.linalg.cholesky(np.linalg.inv(dense(network, result)[0]))
    plain = replace(network, relative=())

    def cost(x):
        moved = replace(
            rigs.moved(plain, result.parameters, x[:-6]),
            relative=(result.parameters.relative[0].updated(x[-6:]),),
        )
        _, q = residuals_and_q(network, moved, 0.0, result.noise)
        return total_cost(network, moved, q, result.noise)

    slope = [(cost(1e-3 * d) - cost(-1e-3 * d)) / 2e-3 for d in root.T]
    assert np.linalg.norm(slope) < 2e-4


@pytest.mark.parametrize('shape', SHAPES)
def test_rigid_constraint_equals_a_reparametrisation(shape):
    """Expressing b's exposures by those of a gives the same to 5e-5 standard deviations."""
    network, truth = rigid_network(**shape, sd=(RIGID_SD_MM, RIGID_SD_RAD))
    noise = Noise('gaussian', 0.3)
    result = adjust(network, disturbed(truth), noise=noise)
    assert result.converged
    precise = precision(network, result)
    parameters = result.parameters
    plain = replace(network, relative=())
    constraint = network.relative[0]
    rotation = parameters.rotation.copy()
    position = parameters.position_mm.copy()
    rotation[constraint.pairs[:, 1]], position[constraint.pairs[:, 1]] = exposures_from_pose(
        parameters, constraint, parameters.relative[0]
    )
    on = replace(parameters, rotation=rotation, position_mm=position)
    k = reparametrisation(plain, on, constraint)
    normal = k.T @ rigs.dense_normal_matrix(plain, replace(result, parameters=on)) @ k
    r = network.uv - project(*network.per_image_point(on))
    weight = np.repeat((0.3 * network.sigma) ** -2.0, 2)
    a = rigs.design_matrix(plain, on)
    gradient = a.T @ (weight * r.ravel())
    m, n = network.n_exposures, network.n_points
    gradient[6 * m : 6 * m + 3 * n] += (
        (network.survey_mm - on.points_mm) / network.survey_sd_mm[:, None] ** 2
    ).ravel()
    covariance = np.linalg.inv(normal)
    step = covariance @ (k.T @ gradient)
    assert np.max(np.abs(step) / np.sqrt(np.diagonal(covariance))) < 5e-5
    full = k @ covariance @ k.T
    for j in range(m):
        part = slice(6 * j, 6 * j + 6)
        np.testing.assert_allclose(
            precise.exterior[j],
            full[part, part],
            rtol=0,
            atol=5e-5 * np.max(np.abs(full[part, part])),
        )
    sd = np.sqrt(np.diagonal(covariance)[-6:])
    np.testing.assert_allclose(np.sqrt(np.diagonal(precise.relative[0])), sd, rtol=5e-5)


def reparametrisation(plain, parameters, constraint):
    """Derivatives of all unknowns by those of a rigid network, by finite differences."""
    u = plain.n_unknowns
    pairs = constraint.pairs
    step = 1e-6
    keep = np.setdiff1d(np.arange(u), (6 * pairs[:, 1:] + np.arange(6)).ravel())
    out = np.zeros((u, len(keep) + 6))
    out[keep, np.arange(len(keep))] = 1
    pose = mean_pose(parameters, pairs)
    columns = [(np.searchsorted(keep, 6 * a + i), a, i) for a in pairs[:, 0] for i in range(6)]
    for column, a, i in columns + [(len(keep) + i, None, i) for i in range(6)]:
        ends = []
        for sign in (1, -1):
            x = np.zeros(u)
            if a is not None:
                x[6 * a + i] = sign * step
            shifted = rigs.moved(plain, parameters, x)
            own = pose if a is not None else pose.updated(sign * step * np.eye(6)[i])
            ends.append(exposures_from_pose(shifted, constraint, own))
        turn = ends[0][0] @ ends[1][0].transpose(0, 2, 1)
        rows = 6 * pairs[:, 1:] + np.arange(6)
        out[rows, column] = np.concatenate(
            [ends[0][1] - ends[1][1], vector_from_matrix(turn)], axis=1
        ) / (2 * step)
    return out


def test_constraint_reduces_scatter_and_errors():
    """Scatter and errors of the relative orientation decrease with its standard deviation."""
    scatter = []
    error = []
    for sd in ((1e3, 1.0), SOFT, (RIGID_SD_MM, RIGID_SD_RAD)):
        network, truth = rigid_network(8, 40, sd, alone=0)
        result = adjust_and_estimate_noise(network, disturbed(truth))
        _, shift = relative_poses(result.parameters, network.relative[0].pairs)
        scatter.append(np.linalg.norm(np.std(shift, axis=0)))
        error.append(np.linalg.norm(result.parameters.position_mm - truth.position_mm))
    assert scatter[0] > scatter[1] > scatter[2] and scatter[2] < 1e-3
    assert error[2] < error[0]


@pytest.mark.long
def test_standard_deviations_against_monte_carlo():
    """Errors of the relative orientation agree with its covariance."""
    squares = []
    for seed in range(40):
        network, truth = rigid_network(5, 40, (RIGID_SD_MM, RIGID_SD_RAD), seed)
        result = adjust_and_estimate_noise(network, truth, noise=Noise('gaussian'))
        pose = result.parameters.relative[0]
        error = np.concatenate(
            [
                pose.translation_mm - POSE.translation_mm,
                vector_from_matrix(pose.rotation @ POSE.rotation.T),
            ]
        )
        squares.append(error @ np.linalg.solve(precision(network, result).relative[0], error) / 6)
    assert np.mean(squares) == pytest.approx(1, abs=0.35)


def test_mean_pose_is_robust_to_one_pair():
    network, truth = rigid_network(7, 20, alone=0)
    position = truth.position_mm.copy()
    position[-1] += 500.0
    pose = mean_pose(replace(truth, position_mm=position), network.relative[0].pairs)
    np.testing.assert_allclose(pose.translation_mm, POSE.translation_mm, atol=1e-6)
    assert rotation_angle(pose.rotation @ POSE.rotation.T) < 1e-9
    weights = np.tile(np.eye(6), (7, 1, 1))
    assert (
        np.linalg.norm(
            mean_pose(truth, network.relative[0].pairs, weights).translation_mm
            - POSE.translation_mm
        )
        < 1e-6
    )


def test_three_fluoroscopes_share_the_first():
    """Two constraints with different numbers of pairs: both eliminations agree, all pairs fit."""
    network, truth = rigs.small_network(5, 30, 3, seen=0.9)
    a = np.arange(5)
    other = RelativePose(matrix_from_vector([0.02, 0.6, 0.01]), np.array([800.0, -20.0, 250.0]))
    every = [
        RelativeConstraint((0, f), np.stack([a, a + 5 * f], axis=1), RIGID_SD_MM, RIGID_SD_RAD)
        for f in (1, 2)
    ]
    rotation = truth.rotation.copy()
    position = truth.position_mm.copy()
    for constraint, pose in zip(every, (POSE, other)):
        b = constraint.pairs[:, 1]
        rotation[b], position[b] = exposures_from_pose(truth, constraint, pose)
    truth = replace(truth, rotation=rotation, position_mm=position, relative=(POSE, other))
    uv = project(*network.per_image_point(truth)) + np.random.default_rng(1).normal(
        0, 0.3, network.uv.shape
    )
    network = replace(
        network, uv=uv, relative=(every[0], replace(every[1], pairs=every[1].pairs[1:4]))
    )
    found = []
    for of_exposures in (False, True):
        with rigs.eliminating(of_exposures):
            result = adjust_and_estimate_noise(network, disturbed(truth))
            found.append((result, precision(network, result)))
        assert result.converged
    (one, one_precise), (two, two_precise) = found
    np.testing.assert_allclose(one.residuals, two.residuals, atol=1e-4)
    for name in ('interior', 'exterior', 'points', 'all_global', 'exterior_global'):
        a = getattr(one_precise, name)
        b = getattr(two_precise, name)
        np.testing.assert_allclose(a, b, rtol=0, atol=2e-5 * np.max(np.abs(b)), err_msg=name)
    for constraint, pose in zip(network.relative, one.parameters.relative):
        assert np.max(np.abs(discrepancies(constraint, pose, one.parameters))) < 1e-4
    redundancy = (
        one_precise.redundancy.sum()
        + one_precise.survey_redundancy.sum()
        + sum(r.sum() for r in one_precise.relative_redundancy)
    )
    assert redundancy == pytest.approx(network.n_observations - network.n_unknowns, rel=1e-6)
