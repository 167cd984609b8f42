# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Variance of the distortion between exposures, excluding what object points can absorb."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import rigs
from rigs import values_by_exposure

from fluoro_calib_ros.correction.angle_field import harmonics
from fluoro_calib_ros.correction.calibration_record import HARMONICS
from fluoro_calib_ros.correction.series import Functions, sd_grid_pixels
from fluoro_calib_ros.estimation.collocation import CollocationTerms
from fluoro_calib_ros.estimation.estimator import (
    AdjustmentProblem,
    GaugeKind,
    gauge_basis,
    gauge_coefficients,
)
from fluoro_calib_ros.estimation.exposure_terms import (
    VARYING,
    Effects,
    ExposureTerms,
    SeriesWithExposures,
    _Effects,
    estimates_beside_free_points,
    exposure_functions,
    field_of,
    fit_angles,
    is_determined,
    variance_between_exposures,
    variation,
)
from fluoro_calib_ros.photogrammetry.adjustment import adjust
from fluoro_calib_ros.photogrammetry.collinearity import (
    AdditionalParameters,
    project,
    project_with_jacobian,
)
from fluoro_calib_ros.photogrammetry.elimination import factorize
from fluoro_calib_ros.photogrammetry.noise import Noise
from fluoro_calib_ros.photogrammetry.normal_equations import normal_equations
from fluoro_calib_ros.photogrammetry.precision import information_of_additional

SIZE = (1024, 1024)
SIZE_PX = 0.5
EXPOSURES = 10


@pytest.fixture(scope='module')
def case():
    """A network, its adjustment and derivatives, and terms of its exposures."""
    network, true = rigs.small_network(EXPOSURES, 80, survey_sd_mm=0.2, free=False, seed=3)
    found = adjust(network, true, np.zeros_like(network.uv), Noise('gaussian', 0.3))
    _, by_exterior, by_point, _ = project_with_jacobian(*network.per_image_point(found.parameters))
    functions = exposure_functions(network.uv, SIZE, found.parameters.interior[0])
    return (
        network,
        found,
        by_exterior,
        by_point,
        ExposureTerms(functions, network.exposure, SIZE_PX),
    )


def mean_square_left(network, by_exterior, values):
    """Mean square of values (N, 2) after removing what exposure orientations absorb."""
    square = 0.0
    for number in range(network.n_exposures):
        at = network.exposure == number
        y = values[at].ravel()
        a = by_exterior[at].reshape(len(y), -1)
        a = a / np.linalg.norm(a, axis=0)
        square += np.sum((y - a @ np.linalg.lstsq(a, y, rcond=None)[0]) ** 2)
    return square / values.size


def test_terms_that_differ_at_random_have_their_own_size(case):
    network, found, by_exterior, _, terms = case
    rng = np.random.default_rng(1)
    exact = np.zeros((terms.count, terms.count))
    ratios = []
    for _ in range(10):
        coefficients = rng.normal(0, np.sqrt(np.tile(terms.variance, terms.exposures)))
        true = mean_square_left(network, by_exterior, values_by_exposure(terms) @ coefficients)
        got = variance_between_exposures(network, found, 0, terms, coefficients, exact).mean()
        ratios.append(got / true)
    assert np.mean(ratios) == pytest.approx(1, abs=0.05)
    assert np.std(ratios) < 0.1
    # Coefficients of which only the prior is known are as large as the prior states.
    prior = np.diag(np.tile(terms.variance, terms.exposures))
    got = variance_between_exposures(network, found, 0, terms, np.zeros(terms.count), prior).mean()
    draws = [rng.normal(0, np.sqrt(np.diagonal(prior))) for _ in range(20)]
    expected = np.mean(
        [mean_square_left(network, by_exterior, values_by_exposure(terms) @ c) for c in draws]
    )
    assert got == pytest.approx(expected, rel=0.1)


def test_a_phantom_that_has_shrunk_is_no_variation(case):
    network, found, by_exterior, by_point, terms = case
    loose = replace(network, survey_sd_mm=np.full(network.n_points, 3.0))
    shrunk = network.survey_mm * [2e-3, -2e-3, 0]
    shift = np.einsum('nak,nk->na', by_point, shrunk[network.point])
    values = values_by_exposure(terms).reshape(2 * len(shift), -1)
    coefficients = np.linalg.lstsq(values, shift.ravel(), rcond=None)[0]
    like_variation = values_by_exposure(terms) @ coefficients
    scale = np.sqrt(np.mean(like_variation**2))
    assert scale > 0.1  # the terms can imitate the shrinkage
    exact = np.zeros((terms.count, terms.count))
    got = variance_between_exposures(loose, found, 0, terms, coefficients, exact).mean()
    assert got < 0.3 * mean_square_left(network, by_exterior, like_variation)


def estimated_size(network, true):
    """Size of exposure terms [px] after some updates, with free points and under the survey.

    The second estimate takes the survey errors to be independent.
    """
    sizes = []
    for beside_free_points in (True, False):
        functions = exposure_functions(network.uv, SIZE, true.interior[0])
        terms = ExposureTerms(functions, network.exposure, SIZE_PX)
        start = replace(true, additional=(np.zeros(terms.count),))
        for _ in range(8):
            own = AdditionalParameters(
                np.zeros((len(network.uv), 0)), np.diag(terms.precision), terms.functions
            )
            varying = replace(network, additional=(own,))
            found = adjust(varying, start, noise=Noise('gaussian', 0.3))
            if beside_free_points:
                mean, variance = estimates_beside_free_points(varying, found)[0]
            else:
                mean = found.parameters.additional[0]
                matrix = factorize(
                    varying, normal_equations(varying, found.parameters, 0.0, found.noise)
                )
                variance = np.diagonal(np.linalg.inv(information_of_additional(matrix, 0)))
            terms.renew(mean, variance)
        sizes.append(terms.size_px)
    return sizes


def test_a_bent_phantom_makes_no_terms_of_exposures():
    network, true = rigs.small_network(EXPOSURES, 80, survey_sd_mm=0.05, free=False, seed=3)
    x, y, z = true.points_mm.T / np.max(np.abs(true.points_mm))
    bent = true.points_mm + 0.4 * np.stack([y * z, x * z, x * y], axis=1)
    true = replace(true, points_mm=bent)
    rng = np.random.default_rng(4)
    noise = rng.normal(0, 0.3, network.uv.shape) * network.sigma[:, None]
    uv = project(*network.per_image_point(true)) + noise
    free, surveyed = estimated_size(replace(network, uv=uv), true)
    assert free < 0.5 * surveyed


def test_terms_of_exposures_are_found_beside_free_points(case):
    network, found, _, _, terms = case
    rng = np.random.default_rng(2)
    coefficients = rng.normal(0, np.sqrt(np.tile(terms.variance, terms.exposures)))
    varying = replace(network, uv=network.uv + values_by_exposure(terms) @ coefficients)
    free, surveyed = estimated_size(varying, found.parameters)
    assert free == pytest.approx(SIZE_PX, rel=0.15)
    assert surveyed == pytest.approx(SIZE_PX, rel=0.15)


def test_a_self_calibration_renews_its_terms_of_exposures_until_they_settle(case):
    network, found, _, _, true = case
    rng = np.random.default_rng(5)
    coefficients = rng.normal(0, np.sqrt(true.variance), (EXPOSURES, len(true.variance)))
    network = replace(network, uv=network.uv + values_by_exposure(true) @ coefficients.ravel())
    problem = AdjustmentProblem(network, [SIZE], found, (GaugeKind.FULL,))
    terms = CollocationTerms(problem, modes=0)
    terms._refinements = []
    terms.parts[0].own = ExposureTerms(true.functions.values, network.exposure, 0.3 * SIZE_PX)
    parameters = replace(
        found.parameters, additional=tuple(np.zeros(part.count) for part in terms.parts)
    )
    sizes = []
    for _ in range(5):
        varying = terms.with_additional(network)
        adjusted = adjust(varying, parameters, noise=Noise('gaussian', 0.3))
        parameters = adjusted.parameters
        matrix = factorize(varying, normal_equations(varying, parameters, 0.0, adjusted.noise))
        terms.renew(varying, matrix, adjusted)
        sizes.append(terms.parts[0].own.size_px)
    # The mean over the exposures is no difference between them.
    there = np.sqrt(np.sum(np.var(coefficients, axis=0, ddof=1)))
    assert sizes[-1] == pytest.approx(there, rel=0.1)
    assert sizes[-1] == sizes[-2]


# ---- what the angle of a C-arm explains

ANGLES = np.deg2rad(np.linspace(-80.0, 85.0, 12))


def estimated_terms(sd, random_px, seed=6, series_px=0.0):
    """Estimates of a series and of exposure terms that follow the angle, with their changes.

    sd: standard deviation of the estimates [px]; random_px: random change of an exposure [px].
    """
    rng = np.random.default_rng(seed)
    exposures = len(ANGLES)
    uv = rng.uniform(0, 1024, (40 * exposures, 2))
    exposure = np.repeat(np.arange(exposures), 40)
    functions = exposure_functions(uv, SIZE, np.array([511.5, 511.5, 4000.0]))
    terms = ExposureTerms(functions, exposure, 1.0)
    effects = np.zeros((HARMONICS, 14))
    effects[:2] = rng.normal(0, 0.3, (2, 14))
    h = harmonics(ANGLES) - harmonics(ANGLES).mean(axis=0)
    change = h @ effects + rng.normal(0, random_px, (exposures, 14))
    series = Functions(SIZE, 3)
    c = 2 * len(series)
    p = c + terms.count
    root = rng.normal(0, 1.0, (p, p))
    covariance = sd**2 * (np.eye(p) + 0.5 * root @ root.T / p)
    drawn = np.concatenate([np.full(c, series_px), change.ravel()])
    # Posterior: the prior of the terms has shrunk the estimates.
    information = np.linalg.inv(covariance)
    prior = np.diag(np.r_[np.zeros(c), terms.precision])
    posterior = np.linalg.inv(information + prior)
    found = posterior @ information @ (drawn + np.linalg.cholesky(covariance) @ rng.normal(size=p))
    estimated = SeriesWithExposures(series, uv, terms, found, posterior)
    return estimated, change, h, effects


def test_terms_that_follow_the_angle_are_a_field_of_it():
    estimated, change, _, effects = estimated_terms(0.01, 0.01)
    fit = fit_angles(estimated, ANGLES)
    np.testing.assert_allclose(fit.effects.mean.reshape(HARMONICS, 14)[:2], effects[:2], atol=0.06)
    assert fit.remaining < 0.02
    at = estimated.uv[:30]
    functions = estimated.terms.functions.values[:30]
    for angle, own in zip(ANGLES[::5], change[::5]):
        np.testing.assert_allclose(fit.field.change(at, angle)[0], functions @ own, atol=0.15)
    other, *_ = estimated_terms(0.01, 0.5, seed=7)
    less = fit_angles(other, ANGLES)
    assert less is None or less.remaining > 0.4


def test_effects_of_the_angle_are_a_posterior_of_all_estimates():
    """Dense solution: harmonics and random differences with the found variances, series free."""
    estimated, _, h, _ = estimated_terms(0.05, 0.05, series_px=2.0)
    terms = estimated.terms
    fit = fit_angles(estimated, ANGLES)
    effects = _Effects(terms, h)
    c = 2 * len(estimated.functions)
    information = np.linalg.inv(estimated.covariance)
    right = information @ estimated.coefficients
    own = np.linalg.inv(estimated.covariance[c:, c:])
    plain = own - np.diag(terms.precision)
    mean, covariance = effects.estimate(plain, own @ estimated.coefficients[c:])
    np.testing.assert_allclose(fit.effects.mean, mean[: effects.count], rtol=1e-9)
    variance = effects._variance
    # Joint estimate of all coefficients: first those of the series, then the effects.
    design = np.block(
        [
            [np.eye(c), np.zeros((c, effects.design.shape[1]))],
            [np.zeros((terms.count, c)), effects.design],
        ]
    )
    likelihood = information - np.diag(np.r_[np.zeros(c), terms.precision])
    normal = design.T @ likelihood @ design + np.diag(np.r_[np.zeros(c), 1 / variance])
    everything = np.linalg.inv(normal)
    solved = everything @ design.T @ right
    np.testing.assert_allclose(mean, solved[c:], atol=1e-6)
    np.testing.assert_allclose(fit.coefficients, solved[:c], atol=1e-6)
    np.testing.assert_allclose(fit.covariance, everything[:c, :c], atol=1e-8)
    count = effects.count
    np.testing.assert_allclose(
        fit.effects.covariance, everything[c : c + count, c : c + count], atol=1e-8
    )
    np.testing.assert_allclose(fit.effects.mixed, everything[:c, c : c + count], atol=1e-8)
    np.testing.assert_allclose(covariance, everything[c:, c:], atol=1e-8)
    by_angle = variance[:count].reshape(HARMONICS, 14).sum(axis=1) @ np.mean(h**2, axis=0)
    at_random = variance[count : count + 14].sum()
    assert effects.explained(h) == pytest.approx(by_angle / (by_angle + at_random))
    assert fit.remaining == pytest.approx(1 - effects.explained(h))


def test_variances_of_effects_are_the_most_likely_ones():
    estimated, _, h, _ = estimated_terms(0.05, 0.1)
    terms = estimated.terms
    effects = _Effects(terms, h)
    c = 2 * len(estimated.functions)
    own = np.linalg.inv(estimated.covariance[c:, c:])
    information = own - np.diag(terms.precision)
    right = own @ estimated.coefficients[c:]
    effects.estimate(information, right)
    found = effects._factors.copy()

    def evidence(factors):
        effects._factors = factors
        variance = effects._variance
        normal = effects.design.T @ information @ effects.design + np.diag(1 / variance)
        vector = effects.design.T @ right
        fit = vector @ np.linalg.solve(normal, vector)
        return (fit - np.linalg.slogdet(normal)[1] - np.sum(np.log(variance))) / 2

    here = evidence(found)
    for k in (0, 2):  # the second order vanishes
        for factor in (0.6, 1.6):
            other = found.copy()
            other[k] *= factor
            assert evidence(other) < here
    assert found[1] < 0.05 * found[0]


def test_a_field_has_the_covariances_of_its_effects():
    """Compare with drawn fields, over the grid, as the mean of u and v."""
    rng = np.random.default_rng(9)
    estimated, *_ = estimated_terms(0.05, 0.05)
    series, terms = estimated.functions, estimated.terms
    q, c = HARMONICS * 14, 2 * len(series)
    root = rng.normal(0, 0.05, (c + q, c + q))
    joint = root @ root.T
    effects = Effects(rng.normal(size=q), joint[c:, c:], joint[:c, c:])
    field = field_of(estimated, ANGLES, effects)
    uv = estimated.uv
    by_harmonic = effects.mean.reshape(HARMONICS, 14)
    cubic = Functions(SIZE, 3)
    for j in range(HARMONICS):
        expected = terms.functions.values @ by_harmonic[j]
        np.testing.assert_allclose(cubic(uv) @ field.coefficients[j].T, expected, atol=1e-8)
    pixels = sd_grid_pixels(SIZE)
    to_cubic = [
        np.linalg.lstsq(cubic(uv), terms.functions.values[:, a], rcond=None)[0] for a in (0, 1)
    ]
    at = 400
    of_terms = [cubic(pixels[at : at + 1]) @ m for m in to_cubic]
    of_series = series(pixels[at : at + 1])[0]
    m = len(of_series)

    def row(axis, j):
        out = np.zeros(c + q)
        out[c + 14 * j : c + 14 * (j + 1)] = of_terms[axis][0]
        return out

    def row_of_series(axis):
        out = np.zeros(c + q)
        out[axis * m : (axis + 1) * m] = of_series
        return out

    variances = field.variances.reshape(len(field.variances), -1)[:, at]
    with_series = [
        np.mean([row_of_series(a) @ joint @ row(a, j) for a in (0, 1)]) for j in range(HARMONICS)
    ]
    pairs = [
        np.mean([row(a, j) @ joint @ row(a, k) for a in (0, 1)])
        for j in range(HARMONICS)
        for k in range(j, HARMONICS)
    ]
    np.testing.assert_allclose(variances, [*with_series, *pairs], atol=1e-9)


def test_terms_that_are_not_determined_follow_no_angle():
    estimated, *_ = estimated_terms(0.05, 0.05)
    nothing = replace(estimated, covariance=np.zeros_like(estimated.covariance))
    assert fit_angles(nothing, ANGLES) is None


def test_exposures_of_enough_image_points_determine_terms():
    exposure = np.repeat([4, 5, 9], [30, 29, 31])
    assert is_determined(exposure, 2) and not is_determined(exposure, 3)


def test_small_exposures_do_not_count_in_a_variation():
    """Expected values are written out as square sums over their expectation."""
    rng = np.random.default_rng(10)
    exposure = np.repeat([0, 1, 2], [60, 29, 50])
    uv = rng.uniform(0, 1024, (139, 2))
    functions = exposure_functions(uv, SIZE, np.array([511.5, 511.5, 4000.0]))
    residuals = rng.normal(0, 0.3, uv.shape)
    residuals[:60] += functions[:60] @ rng.normal(0, 0.4, 14)
    found = variation(residuals, exposure, functions)
    explained = left = 0.0
    for e, count in ((0, 60), (2, 50)):
        a = functions[exposure == e].reshape(2 * count, 14)
        y = residuals[exposure == e].ravel()
        rest = y - a @ np.linalg.lstsq(a, y, rcond=None)[0]
        left += rest @ rest
        explained += y @ y - rest @ rest
    noise = left / (2 * 110 - 2 * 14 - 2 * 6)
    assert found.chi2_per_dof == pytest.approx(explained / (28 * noise))
    assert found.noise_px == pytest.approx(np.sqrt(noise))
    size = np.sqrt((explained - VARYING * 28 * noise) / 220)
    assert found.size_px == pytest.approx(size) and found.is_varying
    none = variation(residuals[60:89], exposure[60:89], functions[60:89])
    assert (none.chi2_per_dof, none.size_px, none.is_varying) == (0.0, 0.0, False)


def test_changes_of_the_interior_are_what_turns_do_not_absorb():
    rng = np.random.default_rng(11)
    uv = rng.uniform(0, 1024, (300, 2))
    interior = np.array([480.0, 530.0, 2000.0])
    functions = exposure_functions(uv, SIZE, interior, with_interior=True)
    flat = functions.reshape(600, 17)
    np.testing.assert_allclose(flat.T @ flat / 600, np.eye(17), atol=1e-9)
    turns = gauge_basis(uv, interior, GaugeKind.TURNS).reshape(600, -1)
    np.testing.assert_allclose(turns.T @ flat[:, 14:], 0, atol=1e-6)
    whole = gauge_basis(uv, interior).reshape(600, -1)
    both = np.linalg.lstsq(np.hstack([turns, flat[:, 14:]]), whole, rcond=None)[0]
    np.testing.assert_allclose(np.hstack([turns, flat[:, 14:]]) @ both, whole, atol=1e-9)


def test_terms_beside_a_series_in_the_gauge_of_its_trend_are_in_that_gauge():
    """Otherwise a series and the terms of exposures could sum up to a tilt."""
    uv = np.random.default_rng(13).uniform(0, 1024, (300, 2))
    interior = np.array([511.5, 511.5, 4000.0])
    for kind, degree in product((GaugeKind.FULL, GaugeKind.TREND), (3, 5)):
        functions = exposure_functions(uv, SIZE, interior, kind=kind, degree=degree)
        count = functions.shape[2]
        flat = functions.reshape(600, count)
        np.testing.assert_allclose(flat.T @ flat / 600, np.eye(count), atol=1e-9)
        parts = [gauge_coefficients(uv, f, interior, kind) for f in functions.transpose(2, 0, 1)]
        np.testing.assert_allclose(parts, 0, atol=1e-9)


@pytest.mark.parametrize('loss', ['gaussian', 'student_t'])
def test_estimates_beside_free_points_are_those_with_a_loose_survey(loss):
    """Reference: a new solution with ten times the standard deviations of the survey."""
    network, true = rigs.small_network(4, 40, survey_sd_mm=0.2, seed=3)
    functions = exposure_functions(network.uv, SIZE, true.interior[0])
    terms = ExposureTerms(functions, network.exposure, SIZE_PX)
    own = AdditionalParameters(
        np.zeros((len(network.uv), 0)), np.diag(terms.precision), terms.functions
    )
    varying = replace(network, additional=(own,))
    start = replace(true, additional=(np.zeros(terms.count),))
    noise = Noise(loss, 0.3, 8.0)
    ((mean, variance),) = estimates_beside_free_points(
        varying, adjust(varying, start, noise=noise)
    )
    loose = replace(varying, survey_sd_mm=10 * varying.survey_sd_mm)
    there = adjust(loose, start, noise=noise)
    expected = there.parameters.additional[0]
    assert np.abs(mean - expected).max() < 0.25 * np.abs(expected).max()
    factor = 1.0 if loss == 'gaussian' else 10 / 12
    matrix = factorize(loose, normal_equations(loose, there.parameters, 0.0, noise, factor))
    sd = np.sqrt(np.diagonal(np.linalg.inv(information_of_additional(matrix, 0))))
    np.testing.assert_allclose(np.sqrt(variance), sd, rtol=0.05)
