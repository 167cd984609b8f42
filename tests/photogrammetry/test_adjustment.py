# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The bundle adjustment and its precision, against dense matrices, scipy and Monte Carlo."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import rigs
from scipy import optimize
from threadpoolctl import threadpool_limits

from fluoro_calib_ros.correction.series import Functions
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation.initial_network import adjusted_with_precision
from fluoro_calib_ros.estimation.priors import gauge_conditions
from fluoro_calib_ros.photogrammetry import adjustment
from fluoro_calib_ros.photogrammetry.adjustment import (
    _Secants,
    adjust,
    residuals_and_q,
    total_cost,
)
from fluoro_calib_ros.photogrammetry.collinearity import AdditionalParameters, project
from fluoro_calib_ros.photogrammetry.elimination import (
    eliminates_exposures,
)
from fluoro_calib_ros.photogrammetry.noise import LOSSES, Noise
from fluoro_calib_ros.photogrammetry.outliers import adjust_and_estimate_noise
from fluoro_calib_ros.photogrammetry.precision import geometric_redundancy, precision
from fluoro_calib_ros.photogrammetry.rotations import rotation_angle

MANY_TARGETS = dict(exposures=4, targets=30)  # eliminates the points
MANY_EXPOSURES = dict(exposures=14, targets=20)  # eliminates the exposures


@pytest.fixture(autouse=True, scope='module')
def one_thread():
    """Use one thread, as a calibration does: two are slower for matrices of this size."""
    with threadpool_limits(1):
        yield


def cost_at(network, result, x=None, correction=0.0):
    """F at a solution displaced by x, for its noise model."""
    parameters = result.parameters if x is None else rigs.moved(network, result.parameters, x)
    _, q = residuals_and_q(network, parameters, correction, result.noise)
    return total_cost(network, parameters, q, result.noise)


def test_cost_of_points_behind_the_source_is_infinite():
    network, start = rigs.small_network()
    q = np.full(len(network.uv), np.nan)
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        assert total_cost(network, start, q, Noise(gross=0.01)) == np.inf


def standard_deviations(network, result):
    """Standard deviations of all unknowns from the dense weighted normal matrix."""
    return np.sqrt(np.diagonal(np.linalg.inv(rigs.dense_normal_matrix(network, result))))


def assert_same_solution(one, other, position_mm=1e-5, angle=1e-8, points_mm=1e-6, interior=1e-4):
    np.testing.assert_allclose(
        one.parameters.position_mm, other.parameters.position_mm, rtol=0, atol=position_mm
    )
    assert (
        np.max(
            rotation_angle(one.parameters.rotation @ other.parameters.rotation.transpose(0, 2, 1))
        )
        < angle
    )
    np.testing.assert_allclose(
        one.parameters.points_mm, other.parameters.points_mm, rtol=0, atol=points_mm
    )
    np.testing.assert_allclose(
        one.parameters.interior, other.parameters.interior, rtol=0, atol=interior
    )


@pytest.mark.parametrize('shape', [MANY_TARGETS, MANY_EXPOSURES])
@pytest.mark.parametrize('loss', LOSSES)
def test_gradient_of_the_cost_is_zero_at_the_solution(loss, shape):
    """Central differences of F along as many directions as there are unknowns.

    Each direction has the length of one standard deviation.
    """
    network, truth = rigs.small_network(**shape, nu=4.0)
    result = adjust_and_estimate_noise(network, rigs.disturbed(truth), noise=Noise(loss))
    assert result.converged
    directions = np.linalg.cholesky(np.linalg.inv(rigs.dense_normal_matrix(network, result))).T
    step = 1e-3
    slope = [
        (cost_at(network, result, step * d) - cost_at(network, result, -step * d)) / (2 * step)
        for d in directions
    ]
    assert np.linalg.norm(slope) < 2e-4  # the remaining decrease is less than 2e-8
    assert result.cost == pytest.approx(cost_at(network, result), rel=1e-12)


def test_gaussian_adjustment_equals_scipy_least_squares():
    network, truth = rigs.small_network(**MANY_TARGETS)
    result = adjust_and_estimate_noise(
        network,
        rigs.disturbed(truth),
        noise=Noise('gaussian'),
        tolerance=1e-12,
    )
    assert len(set(network.sigma)) > 1

    def residuals(x):
        parameters = rigs.moved(network, truth, x)
        image = (network.uv - project(*network.per_image_point(parameters))) / (
            result.noise.scale * network.sigma
        )[:, None]
        survey = (parameters.points_mm - network.survey_mm) / network.survey_sd_mm[:, None]
        return np.concatenate([image.ravel(), survey.ravel()])

    sd = standard_deviations(network, result)
    theirs = optimize.least_squares(
        residuals,
        np.zeros(network.n_unknowns),
        x_scale=sd,
        xtol=1e-13,
        ftol=1e-15,
        gtol=1e-12,
        jac='3-point',
    )
    parameters = rigs.moved(network, truth, theirs.x)
    assert_same_solution(result, replace(result, parameters=parameters), 2e-3, 1e-6, 1e-5, 5e-3)
    constant = np.sum(np.log(2 * np.pi * (result.noise.scale * network.sigma) ** 2))
    assert result.cost - constant == pytest.approx(theirs.cost, rel=1e-9)


@pytest.mark.long
@pytest.mark.parametrize('loss', ['student_t', 'huber'])
def test_no_better_solution_is_found_by_direct_minimisation(loss):
    """With the same noise model, scipy cannot improve the solution and finds it from elsewhere."""
    network, truth = rigs.small_network(exposures=3, targets=10, nu=4.0)
    result = adjust_and_estimate_noise(
        network, rigs.disturbed(truth), noise=Noise(loss), tolerance=1e-12
    )
    root = np.linalg.cholesky(np.linalg.inv(rigs.dense_normal_matrix(network, result)))
    ours = cost_at(network, result)
    for start in (
        np.zeros(network.n_unknowns),
        np.random.default_rng(1).normal(0, 0.5, network.n_unknowns),
    ):
        theirs = optimize.minimize(
            lambda z: cost_at(network, result, root @ z),
            start,
            method='BFGS',
            options={'gtol': 1e-5},
        )
        assert ours - theirs.fun < 1e-5
        assert np.max(np.abs(theirs.x)) < 0.02  # in standard deviations


@pytest.mark.parametrize('loss', LOSSES)
@pytest.mark.parametrize(
    'shape', [MANY_TARGETS, MANY_EXPOSURES, dict(exposures=3, targets=25, fluoroscopes=2)]
)
def test_both_eliminations_give_the_same_solution_and_covariances(shape, loss):
    network, truth = rigs.small_network(**shape, nu=5.0)
    assert eliminates_exposures(network) == (shape is MANY_EXPOSURES)
    found = []
    for of_exposures in (False, True):
        with rigs.eliminating(of_exposures):
            result = adjust_and_estimate_noise(network, rigs.disturbed(truth), noise=Noise(loss))
            found.append((result, precision(network, result)))
    (one, one_precise), (other, other_precise) = found
    assert one.steps == other.steps
    assert one.cost == pytest.approx(other.cost, rel=1e-10)
    assert_same_solution(one, other)
    for name in ('interior', 'exterior', 'points', 'residual', 'redundancy', 'survey_redundancy'):
        a = getattr(one_precise, name)
        b = getattr(other_precise, name)
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-7 * np.max(np.abs(b)), err_msg=name)


@pytest.mark.parametrize('free', [True, False])
@pytest.mark.parametrize('loss', LOSSES)
@pytest.mark.parametrize(
    'shape', [MANY_TARGETS, MANY_EXPOSURES, dict(exposures=3, targets=25, fluoroscopes=2)]
)
def test_covariances_equal_the_dense_inverse(shape, loss, free):
    """Unknowns by the Fisher information, residuals by the weighted problem.

    Redundancy numbers sum to observations less unknowns.
    """
    network, truth = rigs.small_network(**shape, nu=5.0, free=free)
    result = adjust_and_estimate_noise(network, truth, noise=Noise(loss))
    precise = precision(network, result)
    m, n = network.n_exposures, network.n_points
    assert network.n_unknowns == 6 * m + 3 * n + 3 * free * network.n_fluoroscopes
    total = precise.redundancy.sum() + precise.survey_redundancy.sum()
    assert total == pytest.approx(2 * len(network.uv) + 3 * n - network.n_unknowns, rel=1e-8)
    for numbers in (precise.redundancy, precise.survey_redundancy):
        assert numbers.min() > -1e-9 and numbers.max() < 1 + 1e-9
    honest = np.linalg.inv(
        rigs.dense_normal_matrix(network, result, result.noise.information_factor(result.q))
    )
    points = slice(6 * m, 6 * m + 3 * n)
    np.testing.assert_allclose(precise.joint_points, honest[points, points], rtol=1e-5, atol=1e-9)
    for j in range(m):
        part = slice(6 * j, 6 * j + 6)
        np.testing.assert_allclose(precise.exterior[j], honest[part, part], rtol=1e-5, atol=1e-9)
    for i in range(n):
        part = slice(6 * m + 3 * i, 6 * m + 3 * i + 3)
        np.testing.assert_allclose(precise.points[i], honest[part, part], rtol=1e-5, atol=1e-9)
    for f, own in enumerate(precise.interior):
        part = slice(6 * m + 3 * n + 3 * f, 6 * m + 3 * n + 3 * f + 3)
        np.testing.assert_allclose(
            own, honest[part, part] if free else np.zeros((3, 3)), rtol=1e-5, atol=1e-6
        )

    a = rigs.design_matrix(network, result.parameters)
    weighted = a @ np.linalg.inv(rigs.dense_normal_matrix(network, result)) @ a.T
    variance = np.repeat(
        (result.noise.scale * network.sigma) ** 2 / result.noise.weight(result.q), 2
    )
    residual = np.diag(variance) - weighted
    own = residual.reshape(len(network.uv), 2, len(network.uv), 2)
    own = np.diagonal(own, axis1=0, axis2=2).transpose(2, 0, 1) / variance[::2, None, None]
    np.testing.assert_allclose(
        precise.residual / variance[::2, None, None], own, rtol=0, atol=1e-6
    )
    np.testing.assert_allclose(
        precise.redundancy.ravel(), 1 - np.diagonal(weighted) / variance, atol=1e-6
    )


def test_geometric_redundancy_assumes_equal_weights():
    """It equals the redundancy numbers of a Gaussian adjustment."""
    network, truth = rigs.small_network(**MANY_TARGETS)
    result = adjust_and_estimate_noise(network, truth, noise=Noise('gaussian'))
    numbers = precision(network, result).redundancy.mean(axis=1)
    noise = Noise('student_t', result.noise.scale, 3.0)
    np.testing.assert_allclose(
        geometric_redundancy(network, result.parameters, noise), numbers, atol=1e-9
    )


def normalised_errors(count, loss, **network):
    """Squared errors in units of their covariances from `count` simulated adjustments.

    Returns {unknowns: (n,)} and the estimated scales.
    """
    out = {'interior': [], 'exterior': [], 'points': []}
    scales = []
    for seed in range(count):
        net, truth = rigs.small_network(seed=seed, **network)
        result, precise = adjusted_with_precision(net, truth, np.zeros_like(net.uv), Noise(loss))
        found = result.parameters
        turn = small_vectors(found.rotation @ truth.rotation.transpose(0, 2, 1))
        errors = {
            'interior': found.interior - truth.interior,
            'points': found.points_mm - truth.points_mm,
            'exterior': np.concatenate([found.position_mm - truth.position_mm, turn], axis=1),
        }
        for name, error in errors.items():
            out[name].append(normalised(error, getattr(precise, name)))
        scales.append(result.noise.scale)
    return {name: np.concatenate(values) for name, values in out.items()}, scales


@pytest.mark.long
def test_standard_deviations_of_gaussian_noise_against_monte_carlo():
    """60 simulated adjustments: errors agree with their covariances."""
    errors, scales = normalised_errors(60, 'gaussian', exposures=6, targets=40)
    assert np.mean(scales) == pytest.approx(0.3, rel=0.02)
    # Means of 180, of 2160 correlated, and of 7200 hardly correlated squares of unit variance.
    assert np.mean(errors['interior']) == pytest.approx(1, abs=0.3)
    assert np.mean(errors['exterior']) == pytest.approx(1, abs=0.2)
    assert np.mean(errors['points']) == pytest.approx(1, abs=0.05)


@pytest.mark.long
def test_standard_deviations_of_heavy_tailed_noise_against_monte_carlo():
    """The same for t noise with four degrees of freedom.

    Without the factor (nu+4)/(nu+2), the mean square would be 1.4.
    """
    errors, scales = normalised_errors(
        40, 'student_t', exposures=5, targets=80, nu=4.0, survey_sd_mm=0.02
    )
    assert np.mean(scales) == pytest.approx(0.3, rel=0.05)
    assert np.mean(errors['exterior']) == pytest.approx(1, abs=0.2)
    assert np.mean(errors['interior']) == pytest.approx(1, abs=0.3)


def normalised(error, covariance):
    """Squared errors (n,) in units of their covariances, over the number of unknowns."""
    return np.einsum('na,nab,nb->n', error, np.linalg.inv(covariance), error) / error.shape[1]


def small_vectors(turn):
    """Rotation vectors of small turns."""
    return (
        np.stack(
            [
                turn[:, 2, 1] - turn[:, 1, 2],
                turn[:, 0, 2] - turn[:, 2, 0],
                turn[:, 1, 0] - turn[:, 0, 1],
            ],
            axis=1,
        )
        / 2
    )


def test_false_matches_do_not_move_the_solution():
    """5 % false matches change the Student-t solution by a fraction of its standard deviation."""
    network, truth = rigs.small_network(exposures=6, targets=40)
    false = np.random.default_rng(1).permutation(len(network.uv))[: len(network.uv) // 20]
    uv = network.uv.copy()
    uv[false] += np.random.default_rng(2).choice([-60, 60], (len(false), 2))
    keep = np.setdiff1d(np.arange(len(uv)), false)
    clean = replace(
        network,
        uv=uv[keep],
        sigma=network.sigma[keep],
        exposure=network.exposure[keep],
        point=network.point[keep],
    )
    wanted = adjust_and_estimate_noise(clean, truth)
    sd = np.sqrt(np.diagonal(precision(clean, wanted).exterior, axis1=1, axis2=2)[:, :3])

    def shift(loss):
        found = adjust_and_estimate_noise(
            replace(network, uv=uv), rigs.disturbed(truth), noise=Noise(loss)
        )
        assert found.converged
        return np.max(
            np.abs(found.parameters.position_mm - wanted.parameters.position_mm) / sd
        ), found

    moved, found = shift('student_t')
    assert moved < 0.6 and not found.inliers[false].any() and found.inliers[keep].mean() > 0.98
    assert shift('gaussian')[0] > 5, 'the false matches are too small to test anything'


def test_order_of_image_points_does_not_matter():
    network, truth = rigs.small_network(exposures=5, targets=30, nu=4.0)
    order = np.lexsort((np.random.default_rng(1).random(len(network.uv)), network.exposure))
    assert (order != np.arange(len(order))).any()
    shuffled = replace(
        network, uv=network.uv[order], sigma=network.sigma[order], point=network.point[order]
    )
    one = adjust_and_estimate_noise(network, rigs.disturbed(truth))
    other = adjust_and_estimate_noise(shuffled, rigs.disturbed(truth))
    assert_same_solution(one, other)
    np.testing.assert_allclose(one.residuals[order], other.residuals, atol=1e-6)


def test_scale_is_relative_to_sigma():
    """Ten times sigma gives a tenth of the scale and changes nothing else."""
    network, truth = rigs.small_network(**MANY_TARGETS)
    one = adjust_and_estimate_noise(network, rigs.disturbed(truth))
    other = adjust_and_estimate_noise(
        replace(network, sigma=10 * network.sigma), rigs.disturbed(truth), noise=Noise(scale=0.1)
    )
    assert other.noise.scale == pytest.approx(one.noise.scale / 10, rel=1e-6)
    assert_same_solution(one, other)


def test_image_points_with_small_sigma_dominate():
    """Where two exposures contradict each other on a point, it follows the one that is more
    precise.
    """
    network, truth = rigs.small_network(
        exposures=6, targets=40, noise_px=0.3, survey_sd_mm=50.0, seen=1.0
    )
    rough = network.exposure % 2 == 1
    sigma = np.where(rough, 50.0, 1.0)
    uv = project(*network.per_image_point(truth))
    uv += np.where(rough[:, None], 5.0, 0.0) * np.random.default_rng(1).normal(size=uv.shape)
    uv += 0.01 * np.random.default_rng(2).normal(size=uv.shape)
    interior_fixed = replace(
        network,
        uv=uv,
        survey_mm=truth.points_mm,
        survey_sd_mm=np.full(40, 0.5),
        interior_free=np.array([False]),
    )
    error = [
        np.sqrt(
            np.mean(
                (
                    adjust_and_estimate_noise(
                        replace(interior_fixed, sigma=s), truth
                    ).parameters.points_mm
                    - truth.points_mm
                )
                ** 2
            )
        )
        for s in (sigma, np.ones(len(uv)))
    ]
    assert error[0] < 0.2 * error[1]


def test_held_interior_orientation_does_not_change():
    """Also if the interior orientation of the other fluoroscope is estimated."""
    network, truth = rigs.small_network(exposures=4, targets=30, fluoroscopes=2)
    network = replace(network, interior_free=np.array([False, True]))
    start = rigs.disturbed(truth)
    result = adjust_and_estimate_noise(network, start)
    assert result.converged
    np.testing.assert_array_equal(result.parameters.interior[0], start.interior[0])
    assert np.all(result.parameters.interior[1] != start.interior[1])
    precise = precision(network, result)
    assert not precise.interior[0].any() and np.all(np.diagonal(precise.interior[1]) > 0)


def test_correction_is_subtracted_from_the_observed_points():
    """Undistorted = observed - correction: distorted points with it adjust equally."""
    network, truth = rigs.small_network(**MANY_TARGETS)
    correction = np.random.default_rng(1).normal(0, 5, network.uv.shape)
    one = adjust_and_estimate_noise(network, rigs.disturbed(truth))
    distorted = replace(network, uv=network.uv + correction)
    other = adjust_and_estimate_noise(distorted, rigs.disturbed(truth), correction)
    assert_same_solution(one, other)
    np.testing.assert_allclose(one.residuals, other.residuals, atol=1e-6)
    np.testing.assert_allclose(
        precision(distorted, other, correction).residual,
        precision(network, one).residual,
        rtol=1e-4,
        atol=1e-7,
    )


def test_distant_start_values_give_the_same_solution():
    network, truth = rigs.small_network(exposures=6, targets=40, nu=5.0)
    noise = Noise(scale=0.3)
    near = adjust(network, truth, noise=noise)
    far = adjust(network, rigs.disturbed(truth, degrees=3.0, mm=40.0), noise=noise)
    assert near.converged and far.converged
    assert near.cost == pytest.approx(far.cost, abs=1e-3)
    sd = standard_deviations(network, near)[:3]
    assert (
        np.max(np.abs(near.parameters.position_mm[0] - far.parameters.position_mm[0]) / sd) < 1e-2
    )


@pytest.mark.parametrize('seed', [5, 25, 28])
def test_start_off_the_gauge_gives_the_same_solution(seed):
    """The normal matrix of a large first decrease must not be reused: outliers would keep points
    that are lost on the way.
    """
    network, truth = rigs.small_network(exposures=6, targets=40, seed=seed)
    rng = np.random.default_rng(seed)
    false = rng.random(len(network.uv)) < 0.2
    uv = network.uv.copy()
    uv[false] += rng.normal(0, 25, (int(false.sum()), 2))
    values = Functions((1024, 1024), 3)(uv)
    count = 2 * values.shape[1]
    rows = gauge_conditions(values, uv, truth.interior[0])
    network = replace(
        network,
        uv=uv,
        additional=(AdditionalParameters(values, 1e-2 * np.eye(count), None, rows),),
    )
    start = replace(
        rigs.disturbed(truth, degrees=0.3, mm=3.0), additional=(rng.normal(0, 1, count),)
    )
    near = adjust(network, replace(truth, additional=(np.zeros(count),)), noise=Noise(scale=0.3))
    far = adjust(network, start, noise=Noise(scale=0.3))
    assert near.converged and far.converged
    assert far.cost == pytest.approx(near.cost, abs=1e-2)


def test_secants_correct_an_approximation_with_which_steps_creep():
    """The initial matrix is a hundred times too large in some directions."""
    rng = np.random.default_rng(3)
    axes = np.linalg.qr(rng.normal(size=(40, 40)))[0]
    curvature = np.ones(40)
    curvature[:4] = 0.01
    hessian = axes * curvature @ axes.T
    solution = rng.normal(size=40)
    left = []
    for with_secants in (False, True):
        secants = _Secants()
        x = np.zeros(40)
        for _ in range(15):
            secants.arrived(hessian @ (solution - x))
            step = secants.step(lambda right: right)
            x = x + step
            if with_secants:
                secants.moved(step)
        left.append(np.max(np.abs(x - solution)))
    assert left[0] > 0.5 and left[1] < 1e-6


@pytest.mark.parametrize('seed', range(56, 60))
def test_an_exposure_without_weight_causes_no_overflow(seed):
    """Its weights change by hundreds of orders of magnitude between two steps."""
    network, truth = rigs.small_network(exposures=6, targets=40, seed=seed)
    rng = np.random.default_rng(seed)
    values = Functions((1024, 1024), 3)(network.uv)
    count = 2 * values.shape[1]
    network = replace(network, additional=(AdditionalParameters(values, 1e-4 * np.eye(count)),))
    position = truth.position_mm.copy()
    position[0] += rng.normal(0, 15, 3)
    start = replace(truth, position_mm=position, additional=(rng.normal(0, 6, count),))
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        result = adjust(network, start, noise=Noise(scale=0.3, nu=200.0, gross=0.01))
    assert np.isfinite(result.cost)


def test_running_out_of_steps_is_reported(monkeypatch):
    monkeypatch.setattr(adjustment, 'MAX_STEPS', 2)
    network, truth = rigs.small_network(**MANY_TARGETS)
    result = adjust(network, rigs.disturbed(truth, degrees=3.0, mm=40.0))
    assert not result.converged and result.steps == 2


def test_undetermined_network_is_rejected():
    """Two targets do not determine the orientation of an exposure."""
    network, truth = rigs.small_network(**MANY_TARGETS, seen=1.0)
    keep = (network.exposure != 1) | (network.point < 2)
    open_one = replace(
        network,
        uv=network.uv[keep],
        sigma=network.sigma[keep],
        exposure=network.exposure[keep],
        point=network.point[keep],
    )
    with pytest.raises(DataError, match='do not determine the unknowns'):
        adjusted_with_precision(open_one, truth, np.zeros_like(open_one.uv), Noise())


def test_given_noise_model_is_not_changed():
    """Scale and degrees of freedom stay as given, and the solution minimises their cost."""
    network, truth = rigs.small_network(**MANY_TARGETS)
    held = adjust(
        network,
        rigs.disturbed(truth),
        noise=Noise(scale=0.7, nu=9.0),
        tolerance=1e-12,
    )
    assert (held.noise.scale, held.noise.nu) == (0.7, 9.0) and held.converged
    directions = np.linalg.cholesky(np.linalg.inv(rigs.dense_normal_matrix(network, held))).T
    slope = [
        cost_at(network, held, 1e-3 * d) - cost_at(network, held, -1e-3 * d) for d in directions
    ]
    assert np.linalg.norm(slope) / 2e-3 < 1e-5
    assert adjust_and_estimate_noise(network, truth).noise.scale == pytest.approx(0.3, rel=0.3)


def test_exact_observations_give_the_exact_solution():
    """The noise scale stops at a hundredth of a pixel instead of going to zero."""
    network, truth = rigs.small_network(**MANY_TARGETS, noise_px=0.0, survey_sd_mm=1e-9)
    network = replace(network, survey_sd_mm=np.full(30, 0.1))
    result = adjust_and_estimate_noise(network, rigs.disturbed(truth))
    assert result.converged and result.noise.scale * np.median(network.sigma) == pytest.approx(
        0.01
    )
    assert_same_solution(result, replace(result, parameters=truth), 1e-2, 1e-5, 1e-4, 1e-2)
