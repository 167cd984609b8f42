# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Distortion that differs between exposures, and distortion that a model cannot follow."""

import numpy as np
import pytest
from scipy.special import j0

from fluoro_calib_ros.correction.calibration_record import SD_GRID
from fluoro_calib_ros.correction.series import Functions, Series
from fluoro_calib_ros.estimation.estimator import gauge_basis
from fluoro_calib_ros.estimation.exposure_terms import (
    VARYING,
    ExposureTerms,
    exposure_functions,
    variation,
    without_exposure_terms,
)
from fluoro_calib_ros.estimation.lack_of_fit import (
    FittedPoints,
    LeftOut,
    _growth,
    sd_with_lack_of_fit,
)
from fluoro_calib_ros.estimation.signal import Signal, spectral_density
from fluoro_calib_ros.photogrammetry.collinearity import AdditionalParameters

SIZE = (800, 600)
INTERIOR = np.array([410.0, 290.0, 2900.0])
EXPOSURES = 12
NOISE = 0.25


def image_points(seed=0, count=100):
    """Pixels (n, 2) in several exposures, and their exposure numbers (n,)."""
    rng = np.random.default_rng(seed)
    uv = rng.uniform(0, 1, (EXPOSURES * count, 2)) * SIZE
    return uv, np.repeat(np.arange(EXPOSURES), count), rng


@pytest.mark.parametrize('degree, count', [(3, 14), (5, 36)])
def test_terms_are_orthogonal_to_each_other_and_to_the_gauge(degree, count):
    """Together with the gauge they are all polynomials of this degree; cubic ones are first."""
    uv, _, _ = image_points()
    functions = exposure_functions(uv, SIZE, INTERIOR, degree=degree).reshape(-1, count)
    np.testing.assert_allclose(functions.T @ functions / len(functions), np.eye(count), atol=1e-9)
    gauge = gauge_basis(uv, INTERIOR).reshape(len(functions), -1)
    np.testing.assert_allclose(gauge.T @ functions / len(functions), 0, atol=1e-9)
    basis = np.hstack([gauge, functions])
    values = np.random.default_rng(1).normal(0, 1, (2, len(Functions(SIZE, degree))))
    polynomial = (Functions(SIZE, degree)(uv) @ values.T).ravel()
    solution = np.linalg.lstsq(basis, polynomial, rcond=None)[0]
    np.testing.assert_allclose(basis @ solution, polynomial, atol=1e-9)
    cubic = exposure_functions(uv, SIZE, INTERIOR).reshape(-1, 14)
    np.testing.assert_allclose(functions[:, :14], cubic, atol=1e-12)


def test_terms_are_tested_beside_those_before_them():
    """A cubic change is none of degree 4 or 5, though its terms in an exposure resemble them."""
    uv, exposure, rng = image_points(4)
    functions = exposure_functions(uv, SIZE, INTERIOR, degree=5)
    noise = rng.normal(0, NOISE, uv.shape)
    for amplitudes, low, high in ((14, 0.8, 1.2), (36, 3.0, np.inf)):
        change = rng.normal(0, 0.3, (EXPOSURES, amplitudes))[exposure]
        r = noise + np.einsum('nak,nk->na', functions[:, :, :amplitudes], change)
        assert variation(r, exposure, functions[:, :, :14]).is_varying
        assert low < variation(r, exposure, functions, 14).chi2_per_dof < high


@pytest.mark.parametrize('size_px', [0.0, 0.15, 0.5])
def test_variation_is_found_with_its_size(size_px):
    uv, exposure, rng = image_points(1)
    functions = exposure_functions(uv, SIZE, INTERIOR)
    coefficients = rng.normal(0, size_px / np.sqrt(14), (EXPOSURES, 14))
    r = np.einsum('nak,nk->na', functions, coefficients[exposure])
    found = variation(r + rng.normal(0, 0.8 * NOISE, r.shape), exposure, functions)
    # Independent residuals give 1; those of an adjustment give less, which the limit is made for.
    assert found.chi2_per_dof > 1.5 * VARYING if size_px else found.chi2_per_dof < 1.25
    assert found.size_px == pytest.approx(np.sqrt(np.mean(r**2)), rel=0.25, abs=0.03)


def test_variances_of_the_terms_are_found_and_vanish_where_nothing_differs():
    uv, exposure, rng = image_points(2)
    functions = exposure_functions(uv, SIZE, INTERIOR)
    true = np.zeros(14)
    true[[0, 5, 9]] = 0.3
    coefficients = rng.normal(0, 1, (EXPOSURES, 14)) * true
    values = np.einsum('nak,nk->na', functions, coefficients[exposure])
    values += rng.normal(0, NOISE, values.shape)
    terms = ExposureTerms(functions, exposure, 0.5)
    parameters = AdditionalParameters(np.zeros((len(uv), 0)), np.zeros((0, 0)), terms.functions)
    a = np.zeros((len(uv), 2, EXPOSURES, 14))
    a[np.arange(len(uv)), :, exposure] = functions
    a = a.reshape(2 * len(uv), -1)
    information = parameters.normal_matrix(np.full(len(uv), NOISE**-2.0))
    np.testing.assert_allclose(information, a.T @ a / NOISE**2, rtol=1e-9, atol=1e-6)
    right = a.T @ values.ravel() / NOISE**2
    for _ in range(40):
        posterior = np.linalg.inv(information + np.diag(terms.precision))
        terms.renew(posterior @ right, np.diagonal(posterior))
    sd = np.sqrt(terms.variance)
    np.testing.assert_allclose(sd[true > 0], coefficients[:, true > 0].std(axis=0), rtol=0.2)
    assert (sd[true == 0] < 0.03).all()
    assert terms.size_px == pytest.approx(np.sqrt(np.sum(terms.variance)))
    reduced, rest = without_exposure_terms(information, right, terms.precision[14:], 14)
    prior = np.append(np.zeros(14), terms.precision[14:])
    everything = np.linalg.solve(information + np.diag(prior), right)
    np.testing.assert_allclose(np.linalg.solve(reduced, rest), everything[:14], rtol=1e-8)


def test_what_is_not_known_of_a_change_of_the_interior_is_as_large_as_other_terms():
    rng = np.random.default_rng(5)
    uv, exposure, _ = image_points(5)
    functions = exposure_functions(uv, SIZE, INTERIOR, with_interior=True)
    terms = ExposureTerms(functions, exposure, 0.5)
    true = np.full(17, 0.2)
    true[16] = 0.05
    mean = rng.normal(0, 1, (EXPOSURES, 17)) * true
    mean[:, 14] = 0  # undetermined: the posterior equals the prior
    for _ in range(40):
        posterior = np.full((EXPOSURES, 17), 0.01**2)
        posterior[:, 14] = terms.variance[14]
        terms.renew(mean.ravel(), posterior.ravel())
    sd = np.sqrt(terms.variance)
    assert 0.2 < sd[14] < 0.4
    np.testing.assert_allclose(sd[:14], np.sqrt(np.mean(mean[:, :14] ** 2, axis=0)), rtol=0.01)
    np.testing.assert_allclose(sd[15], 0.2, rtol=0.4)
    assert sd[16] < 0.12


def test_what_a_series_cannot_follow_is_part_of_its_standard_deviation():
    """A dent is shown in one place; where residuals are noise, nothing is added."""
    uv, exposure, rng = image_points(3, 200)
    functions = Functions(SIZE, 1)
    series = Series(functions, np.zeros((2, 3)), np.full((SD_GRID, SD_GRID), 0.02))
    noise = rng.normal(0, NOISE, uv.shape)
    flat = sd_with_lack_of_fit(FittedPoints(uv, noise, exposure), series)
    assert (flat == 0.02).mean() > 0.98
    dent = 1.5 * np.exp(-np.sum((uv - [600, 150]) ** 2, axis=1) / (2 * 50**2))
    row = round(150 / SIZE[1] * (SD_GRID - 1))
    column = round(600 / SIZE[0] * (SD_GRID - 1))
    found = sd_with_lack_of_fit(FittedPoints(uv, noise + dent[:, None], exposure), series)
    assert 0.7 < found[row, column] < 1.6
    assert np.median(found) < 0.1
    # Orientations and object points have absorbed half of noise and dent.
    half = FittedPoints(uv, (noise + dent[:, None]) / 2, exposure, np.full(len(uv), 0.5))
    np.testing.assert_allclose(sd_with_lack_of_fit(half, series), found, rtol=0.02)


def test_residuals_bound_the_variance_beyond_a_series():
    """A covariance function that expects too much is corrected, one that expects little is not."""
    uv, exposure, rng = image_points(4, 200)
    series = Series(Functions(SIZE, 1), np.zeros((2, 3)), np.zeros((SD_GRID, SD_GRID)))
    noise = rng.normal(0, NOISE, uv.shape)
    points = FittedPoints(uv, noise, exposure)

    def smooth(sd_px):
        return [LeftOut(lambda at: np.full(len(at), sd_px**2), np.ones_like)]

    assert np.median(sd_with_lack_of_fit(points, series, smooth(0.005))) == pytest.approx(
        0.005, rel=0.2
    )
    assert np.median(sd_with_lack_of_fit(points, series, smooth(1.0))) < 0.2 * NOISE
    ripples = 0.2 * np.sin(uv / 15)
    rippled = FittedPoints(uv, noise + ripples, exposure)
    shown = np.median(sd_with_lack_of_fit(rippled, series, smooth(1.0)))
    assert 0.5 * 0.14 < shown < 1.5 * 0.14
    # The same for ripples that change strongly from one point to the next.
    waves = 0.3 * np.sin(uv / 7)
    found = np.median(sd_with_lack_of_fit(FittedPoints(uv, noise + waves, exposure), series))
    assert 0.7 * 0.21 < found < 1.4 * 0.21
    # Ripples that are too short for the point spacing cannot be excluded.
    short = [LeftOut(lambda at: np.full(len(at), 0.25), np.zeros_like)]
    assert np.median(sd_with_lack_of_fit(points, series, short)) == pytest.approx(0.5)


def test_products_of_neighbours_are_extrapolated_to_no_distance():
    distance = np.random.default_rng(7).uniform(10, 40, (50, 5))
    distance[:, -1] = 1e3
    near = np.arange(5) < 4  # the last neighbour belongs to the same exposure
    other = np.broadcast_to(near, distance.shape)
    product = np.where(other, 1 - (distance / 100) ** 2, -50.0)
    expected = 1 / product[other].mean()
    assert _growth(product, distance, other) == pytest.approx(expected)
    assert _growth(-product, distance, other) == 1.0
    assert _growth(0.94 - product, distance, other) == 1.0  # the product grows with the distance
    assert _growth(product, np.full_like(distance, 20.0), other) == 1.0


def test_correlation_of_what_a_series_leaves_out():
    """It equals that of the random waves which the covariance function expects."""
    signal = Signal(0.5, 100.0, 0.2, 30.0)
    distance = np.array([0.0, 10.0, 30.0, 80.0])
    found = signal.correlation_beyond(0.05, distance)
    f = np.linspace(0.05, 3.0, 20000)
    density = spectral_density(f, 0.5, 100.0) + spectral_density(f, 0.2, 30.0)
    expected = [np.sum(density * f * j0(f * d)) / np.sum(density * f) for d in distance]
    np.testing.assert_allclose(found, expected, atol=0.02)
    assert found[0] == pytest.approx(1.0)
