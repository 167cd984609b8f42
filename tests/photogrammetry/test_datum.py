# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Free networks: inner constraints against dense bordered systems and other datum choices."""

from dataclasses import replace

import numpy as np
import pytest
import rigs
from test_relative import disturbed, rigid_network
from threadpoolctl import threadpool_limits

from fluoro_calib_ros.photogrammetry.adjustment import adjust
from fluoro_calib_ros.photogrammetry.collinearity import project
from fluoro_calib_ros.photogrammetry.network import similarity_directions
from fluoro_calib_ros.photogrammetry.noise import LOSSES, Noise
from fluoro_calib_ros.photogrammetry.outliers import adjust_and_estimate_noise
from fluoro_calib_ros.photogrammetry.precision import precision
from fluoro_calib_ros.photogrammetry.rotations import rotation_angle
from fluoro_calib_ros.photogrammetry.unknowns import RelativeConstraint

SHAPES = [
    dict(exposures=5, targets=30),  # eliminates the points
    dict(exposures=14, targets=20),  # eliminates the exposures
]


@pytest.fixture(autouse=True, scope='module')
def one_thread():
    with threadpool_limits(1):
        yield


def free_network(free=True, **shape):
    network, truth = rigs.small_network(**shape, free=free, seen=0.9)
    return replace(network, datum='inner'), truth


def dense_free(network, result, factor=1.0):
    """Dense normal matrix (u, u) of the image points, and the inner constraints (7, u)."""
    counted = replace(network, datum='survey')
    a = rigs.design_matrix(counted, result.parameters)
    weight = factor * result.noise.weight(result.q) / (result.noise.scale * network.sigma) ** 2
    m, n = network.n_exposures, network.n_points
    b = np.zeros((7, a.shape[1]))
    b[:, 6 * m : 6 * m + 3 * n] = (
        similarity_directions(network.survey_mm, network.survey_mm.mean(axis=0)).reshape(-1, 7).T
    )
    return a.T @ (np.repeat(weight, 2)[:, None] * a), b


def bordered_inverse(normal, b):
    """Covariance: first block of the inverse of [N B; B^T 0] (Granshaw 1980)."""
    scale = np.sqrt(np.diagonal(normal))
    b = b / scale
    b = b / np.linalg.norm(b, axis=1, keepdims=True)
    matrix = np.block([[normal / np.outer(scale, scale), b.T], [b, np.zeros((7, 7))]])
    return np.linalg.inv(matrix)[: len(normal), : len(normal)] / np.outer(scale, scale)


@pytest.mark.parametrize('free', [True, False])
@pytest.mark.parametrize('loss', LOSSES)
@pytest.mark.parametrize('shape', SHAPES)
def test_solution_and_covariances_equal_a_dense_bordered_system(shape, loss, free):
    network, truth = free_network(free, **shape)
    start = rigs.disturbed(truth)
    start = start if free else replace(start, interior=truth.interior)
    result = adjust_and_estimate_noise(network, start, noise=Noise(loss), tolerance=1e-12)
    assert result.converged
    normal, b = dense_free(network, result)
    weight = result.noise.weight(result.q) / (result.noise.scale * network.sigma) ** 2
    covariance = bordered_inverse(normal, b)
    a = rigs.design_matrix(replace(network, datum='survey'), result.parameters)
    step = covariance @ (a.T @ (np.repeat(weight, 2) * result.residuals.ravel()))
    sd = np.sqrt(np.diagonal(covariance))
    assert np.max(np.abs(step) / sd) < 1e-4, (
        'a Newton step of the bordered system moves the solution'
    )
    m, n = network.n_exposures, network.n_points
    off = (result.parameters.points_mm - network.survey_mm).ravel()
    assert np.max(np.abs(b[:, 6 * m : 6 * m + 3 * n] @ off)) < 1e-6  # sums of mm and of mm^2

    precise = precision(network, result)
    honest = covariance / result.noise.information_factor(result.q)
    for j in range(m):
        part = slice(6 * j, 6 * j + 6)
        np.testing.assert_allclose(
            precise.exterior[j],
            honest[part, part],
            rtol=1e-5,
            atol=1e-6 * np.max(np.abs(honest[part, part])),
        )
    for i in range(n):
        part = slice(6 * m + 3 * i, 6 * m + 3 * i + 3)
        np.testing.assert_allclose(precise.points[i], honest[part, part], rtol=1e-5, atol=1e-9)
    if free:
        np.testing.assert_allclose(precise.interior[0], honest[-3:, -3:], rtol=1e-5, atol=1e-6)
    residual = np.diag(1 / np.repeat(weight, 2)) - a @ covariance @ a.T
    own = residual.reshape(len(weight), 2, len(weight), 2)
    own = np.diagonal(own, axis1=0, axis2=2).transpose(2, 0, 1)
    off = (precise.residual - own) * weight[:, None, None]
    assert np.abs(off).max() < 1e-6
    assert precise.redundancy.sum() == pytest.approx(
        network.n_observations - network.n_unknowns, rel=1e-7
    )


@pytest.mark.parametrize('shape', SHAPES)
def test_residuals_and_interior_orientation_equal_a_minimal_datum(shape):
    """The minimal datum fixes the first exposure and one coordinate of the second source."""
    network, truth = free_network(**shape)
    noise = Noise('gaussian', 0.3)
    inner = adjust(network, rigs.disturbed(truth), noise=noise, tolerance=1e-12)
    dense_b = np.zeros((7, replace(network, datum='survey').n_unknowns))
    m = network.n_exposures
    for row, column in enumerate([0, 1, 2, 3, 4, 5]):  # the first exposure
        dense_b[row, column] = 1
    dense_b[6, 6] = 1  # and a coordinate of the second source: the scale
    parameters = replace(truth)
    plain = replace(network, datum='survey')
    for _ in range(30):
        r = network.uv - project(*network.per_image_point(parameters))
        a = rigs.design_matrix(plain, parameters)
        weight = np.repeat((0.3 * network.sigma) ** -2.0, 2)
        covariance = bordered_inverse(a.T @ (weight[:, None] * a), dense_b)
        step = covariance @ (a.T @ (weight * r.ravel()))
        parameters = rigs.moved(plain, parameters, step)
        if np.max(np.abs(step) / np.sqrt(np.diagonal(covariance) + 1e-12)) < 1e-7:
            break
    np.testing.assert_allclose(inner.residuals, r, atol=1e-5)
    np.testing.assert_allclose(inner.parameters.interior, parameters.interior, atol=1e-3)
    np.testing.assert_allclose(
        precision(network, inner).interior[0], covariance[-3:, -3:], rtol=1e-4, atol=1e-5
    )
    assert m == network.n_exposures


def test_turned_shifted_and_scaled_start_values_do_not_matter():
    network, truth = free_network(**SHAPES[0])
    here = adjust_and_estimate_noise(network, rigs.disturbed(truth))
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    there = replace(
        truth,
        rotation=truth.rotation @ turn.T,
        position_mm=1.3 * truth.position_mm @ turn.T + 50,
        points_mm=1.3 * truth.points_mm @ turn.T + 50,
    )
    other = adjust_and_estimate_noise(network, there)
    np.testing.assert_allclose(here.parameters.points_mm, other.parameters.points_mm, atol=1e-4)
    np.testing.assert_allclose(here.residuals, other.residuals, atol=1e-4)
    assert (
        np.max(
            rotation_angle(here.parameters.rotation @ other.parameters.rotation.transpose(0, 2, 1))
        )
        < 1e-6
    )


@pytest.mark.parametrize('shape', SHAPES)
@pytest.mark.parametrize('constrained', [True, False])
def test_both_eliminations_give_the_same_solution_and_covariances(shape, constrained):
    network, truth = rigid_network(**shape)
    length = float(np.linalg.norm(truth.relative[0].translation_mm))
    constraint = RelativeConstraint((0, 1), network.relative[0].pairs, 0.5, 2e-4, length)
    network = replace(network, datum='inner', relative=(constraint,) if constrained else ())
    start = disturbed(truth) if constrained else replace(rigs.disturbed(truth), relative=())
    found = []
    for of_exposures in (False, True):
        with rigs.eliminating(of_exposures):
            result = adjust_and_estimate_noise(network, start)
            precise = precision(network, result)
        assert result.converged
        redundancy = precise.redundancy.sum() + sum(r.sum() for r in precise.relative_redundancy)
        assert redundancy == pytest.approx(network.n_observations - network.n_unknowns, rel=1e-6)
        found.append((result, precise))
    (one, one_precise), (other, other_precise) = found
    np.testing.assert_allclose(one.parameters.points_mm, other.parameters.points_mm, atol=1e-5)
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
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-6 * np.max(np.abs(b)), err_msg=name)


def test_wrong_survey_does_not_deform_a_free_network():
    network, truth = free_network(**SHAPES[0])
    survey = network.survey_mm.copy()
    survey[3] += [2.0, 0.0, 0.0]
    right = adjust_and_estimate_noise(network, truth)
    wrong = adjust_and_estimate_noise(replace(network, survey_mm=survey), truth)
    np.testing.assert_allclose(right.residuals, wrong.residuals, atol=1e-4)
    assert right.parameters.interior[0, 2] == pytest.approx(
        wrong.parameters.interior[0, 2], abs=1e-3
    )


@pytest.mark.parametrize('shape', SHAPES)
def test_prior_of_the_interior_orientation_is_a_pseudo_observation(shape):
    """Solution and covariances equal those of the dense normal matrix plus its weights."""
    network, truth = rigs.small_network(**shape)
    mean = truth.interior + [[3.0, -2.0, 30.0]]
    sd = np.array([[1.0, 2.0, 15.0]])
    weighted = replace(network, interior_mean=mean, interior_sd=sd)
    result = adjust(
        weighted,
        rigs.disturbed(truth),
        noise=Noise('gaussian', 0.3),
        tolerance=1e-12,
    )
    normal = rigs.dense_normal_matrix(network, result)
    normal[-3:, -3:] += np.diag(sd[0] ** -2.0)
    np.testing.assert_allclose(
        precision(weighted, result).interior[0], np.linalg.inv(normal)[-3:, -3:], rtol=1e-6
    )
    a = rigs.design_matrix(network, result.parameters)
    gradient = a.T @ (np.repeat((0.3 * network.sigma) ** -2.0, 2) * result.residuals.ravel())
    m, n = network.n_exposures, network.n_points
    gradient[6 * m : 6 * m + 3 * n] += (
        (network.survey_mm - result.parameters.points_mm) / network.survey_sd_mm[:, None] ** 2
    ).ravel()
    gradient[-3:] += ((mean - result.parameters.interior) / sd**2)[0]
    assert (
        np.max(
            np.abs(np.linalg.solve(normal, gradient)) / np.sqrt(np.diagonal(np.linalg.inv(normal)))
        )
        < 1e-5
    )


def test_prior_lies_between_held_and_estimated_interior_orientation():
    network, truth = rigs.small_network(**SHAPES[0])
    mean = truth.interior + [[0.0, 0.0, 50.0]]
    found = []
    for sd in (1e6, 10.0, 1e-6):
        weighted = replace(network, interior_mean=mean, interior_sd=np.full((1, 3), sd))
        found.append(adjust_and_estimate_noise(weighted, truth).parameters.interior[0, 2])
    assert found[0] == pytest.approx(
        adjust_and_estimate_noise(network, truth).parameters.interior[0, 2], abs=1e-3
    )
    assert found[2] == pytest.approx(mean[0, 2], abs=1e-3)
    assert min(found[0], found[2]) < found[1] < max(found[0], found[2])
