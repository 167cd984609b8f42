# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Models adjusted with the network: series, collocation, additional parameters, stepwise terms,
auto.
"""

import functools
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rigs
from rigs import create_model
from scipy.linalg import block_diag
from scipy.spatial.distance import cdist
from scipy.special import gamma, kv
from threadpoolctl import threadpool_limits

from fluoro_calib_ros.correction.calibration_record import SD_GRID
from fluoro_calib_ros.correction.registry import MODELS
from fluoro_calib_ros.correction.series import (
    Functions,
    Series,
    packed,
    sd_grid_pixels,
    sd_over_image,
    unpacked,
    without_absent_bands,
)
from fluoro_calib_ros.correction.terms import (
    GAUGE,
    HIGHEST,
    expert_terms,
    polynomial_coefficients,
    trend_transformation,
)
from fluoro_calib_ros.estimation.calibrate import adjust_with_calibrations, calibrate
from fluoro_calib_ros.estimation.collocation import CollocationTerms, EarlierTerms
from fluoro_calib_ros.estimation.estimator import AdjustmentProblem, GaugeKind, gauge_basis
from fluoro_calib_ros.estimation.fluoroscope_terms import FluoroscopeTerms
from fluoro_calib_ros.estimation.initial_network import (
    adjusted_with_precision,
    measured_network,
    start_noise,
)
from fluoro_calib_ros.estimation.model_choice import better_model
from fluoro_calib_ros.estimation.options import CalibrationOptions
from fluoro_calib_ros.estimation.priors import (
    Prior,
    SeriesEquations,
    gauge_conditions,
    has_rings,
    most_likely_prior,
    starting_prior,
)
from fluoro_calib_ros.estimation.refinements import START_MODES
from fluoro_calib_ros.estimation.ripples import Ripples, shown_ripples
from fluoro_calib_ros.estimation.self_calibration import (
    adjust_with_terms,
    calibrate_by_adjustment,
    estimator_of,
)
from fluoro_calib_ros.estimation.signal import (
    Signal,
    SignalEquations,
    _likelihood,
    spectral_density,
)
from fluoro_calib_ros.photogrammetry.adjustment import (
    adjust,
    residuals_and_q,
    total_cost,
)
from fluoro_calib_ros.photogrammetry.collinearity import (
    AdditionalParameters,
    GroupedFunctions,
)
from fluoro_calib_ros.photogrammetry.elimination import (
    factorize,
)
from fluoro_calib_ros.photogrammetry.noise import Noise
from fluoro_calib_ros.photogrammetry.normal_equations import normal_equations, right_sides
from fluoro_calib_ros.photogrammetry.precision import (
    covariance_blocks,
    covariance_of_projection,
    information_of_additional,
    precision,
    solved_additional,
)
from fluoro_calib_ros.photogrammetry.rig_orientation import ExteriorPrior
from fluoro_calib_ros.simulation.rig import (
    DistortionField,
    StreamStart,
    simulate_exposures,
    virtual_rig,
)

sys.path.append(str(Path(__file__).resolve().parents[2]))  # benchmarks are not installed

SIZE = (1024, 768)


@pytest.fixture(autouse=True, scope='module')
def one_thread():
    """Use one thread, as a calibration does: two are slower for matrices of this size."""
    with threadpool_limits(1):
        yield


def pixels(count=400, seed=0, size=SIZE):
    return np.random.default_rng(seed).uniform(0, np.asarray(size) - 1, (count, 2))


# ---- series


def test_functions_agree_with_the_documentation():
    """The basis functions are written out one by one from docs/files.md."""
    functions = Functions(SIZE, 2, 3)
    uv = pixels(20)
    w, h = SIZE
    x = (uv[:, 0] - (w - 1) / 2) / 512
    y = (uv[:, 1] - (h - 1) / 2) / 512
    columns = [x**i * y**j for i in range(3) for j in range(3 - i)]
    a = 0.65 * w
    b = 0.65 * h
    columns += [
        np.sin(np.pi * i * (512 * x + a) / (2 * a))
        * np.sin(np.pi * j * (512 * y + b) / (2 * b))
        / np.sqrt(a * b)
        for i in range(1, 4)
        for j in range(1, 4)
        if np.hypot(i, j * w / h) <= 3.5
    ]
    np.testing.assert_allclose(functions(uv), np.stack(columns, axis=1), atol=1e-12)
    assert len(functions) == len(columns)


def test_rings_are_orthogonal_radial_polynomials():
    """Compare with R(r) / r (x, y) of Zernike polynomials, over the disc around the image."""
    size = (640, 480)
    functions = Functions(size, 3, 0, 2)
    radius = np.hypot(*size) / 2
    rng = np.random.default_rng(4)
    r = np.sqrt(rng.uniform(0, 1, 40_000))
    angle = rng.uniform(0, 2 * np.pi, len(r))
    x = r * np.cos(angle)
    y = r * np.sin(angle)
    values = functions(radius * np.column_stack([x, y]) + [319.5, 239.5])[:, 10:]
    fifth = 10 * r**4 - 12 * r**2 + 3
    seventh = 35 * r**6 - 60 * r**4 + 30 * r**2 - 4
    expected = np.stack([x * fifth, y * fifth, x * seventh, y * seventh], axis=1)
    np.testing.assert_allclose(values, expected, atol=1e-10)
    lower = np.stack([x, x * r**2], axis=1)
    assert np.abs(lower.T @ values[:, [0, 2]] / len(r)).max() < 0.02


def test_rings_are_written_as_polynomials():
    functions = Functions(SIZE, 3, 4, 2)
    coefficients = np.random.default_rng(5).normal(size=(2, len(functions)))
    plain, same = functions.as_polynomials(coefficients)
    assert (plain.degree, plain.rings, plain.modes) == (7, 0, 4)
    uv = pixels(50)
    np.testing.assert_allclose(plain(uv) @ same.T, functions(uv) @ coefficients.T, atol=1e-10)
    again, back = plain.as_rings(same, 3, 2)
    assert again == functions
    np.testing.assert_allclose(back, coefficients, atol=1e-9)
    cubic = Functions(SIZE, 3, 4)
    _, values = cubic.as_rings(np.ones((2, len(cubic))), 3, 2)
    assert (values[:, :10] == 1).all() and (values[:, 10:14] == 0).all()


@pytest.mark.parametrize('amplitude', [0.0, 5.0])
def test_rings_exist_where_the_distortion_has_them(amplitude):
    """A radial term of degree 5 plus a random field, seen in the middle of the image only."""
    side = 1024
    functions = Functions((side, side), 3, 12, 2)
    uv = pixels(1500, 6, (side, side))
    uv = uv[np.linalg.norm(uv - 511.5, axis=1) < 480]
    rng = np.random.default_rng(7)
    sd = np.sqrt(Signal(0.1, 300.0).variance(functions.frequency))
    values = functions(uv)
    observed = values[:, functions.trend :] @ (sd[:, None] * rng.normal(size=(len(sd), 2)))
    xy = (uv - 511.5) / 512
    observed += amplitude * np.sum(xy**2, axis=1, keepdims=True) ** 2 * xy
    observed += rng.normal(0, 0.25, observed.shape)
    information = np.kron(np.eye(2), values.T @ values / 0.25**2)
    right = (values.T @ observed / 0.25**2).T.ravel()
    prior = starting_prior(functions, 1.0)
    rows = gauge_conditions(values, uv, np.array([511.5, 511.5, 4000.0]))
    gauge = rows.T @ rows
    for _ in range(4):
        prior = most_likely_prior(SeriesEquations(functions, information, right, gauge), prior)
    assert has_rings(functions, prior) == (amplitude > 0)
    # The spiral and the terms that resemble affinity and shear do not exist.
    assert (prior.trend[[15, 16, 17]] < 1e-6).all()


def test_bands_of_sines_can_be_left_out():
    """The sines of the other bands remain; the full series with zero coefficients is the same."""
    every = Functions(SIZE, 3, 12)
    some = replace(every, absent=(5, 6, 7, 8, 9))
    assert (every.complete, some.complete) == (12, 4)
    assert set(some.band) == {2, 3, 4, 10, 11, 12}
    uv = pixels(50)
    coefficients = np.random.default_rng(0).normal(0, 1, (2, len(some)))
    whole = every.converted(some, coefficients.ravel()).reshape(2, -1)
    expected = some(uv) @ coefficients.T
    np.testing.assert_allclose(every(uv) @ whole.T, expected, rtol=0, atol=1e-12)
    sums, squares = some.sums_of_sines(uv, expected)
    sines = some(uv)[:, some.trend :]
    np.testing.assert_allclose(sums, sines.T @ expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(squares, np.sum(sines**2, axis=0), rtol=1e-9)
    functions, found = without_absent_bands(every, whole)
    assert functions == some
    np.testing.assert_array_equal(found, coefficients)
    for full in (every, Functions(SIZE, 3)):
        kept, _ = without_absent_bands(full, np.ones((2, len(full))))
        assert kept == full


def test_packing_of_a_series_is_exact():
    functions = Functions(SIZE, 3, 5)
    rng = np.random.default_rng(1)
    series = Series(
        functions, rng.normal(size=(2, len(functions))), rng.uniform(0, 1, (SD_GRID, SD_GRID))
    )
    again = unpacked(SIZE, *packed(series))
    assert again.predict(pixels()).tobytes() == series.predict(pixels()).tobytes()
    assert again.sd_at(pixels()).tobytes() == series.sd_at(pixels()).tobytes()
    assert unpacked(SIZE, *packed(None)) is None


@pytest.mark.parametrize(
    'changes, said',
    [
        ({0: 2}, 'has 2 x'),
        ({1: 4}, 'has 2 x'),
        ({0: 99}, 'is unknown'),
        ({1: 10**9}, 'is unknown'),
        ({2: np.full((2, 10), np.nan)}, 'not a number'),
        ({3: np.zeros((33, 32))}, 'standard deviations, not'),
    ],
)
def test_damaged_series_is_refused(changes, said):
    parts = [3, 0, np.zeros((2, 10)), np.zeros((SD_GRID, SD_GRID))]
    for at, value in changes.items():
        parts[at] = value
    with pytest.raises(ValueError, match=said):
        unpacked(SIZE, *parts)


def test_standard_deviation_over_the_image_follows_from_the_coefficients():
    functions = Functions(SIZE, 3, 6)
    root = np.random.default_rng(2).normal(size=(2 * len(functions), 50))
    sd = sd_over_image(functions, root @ root.T)
    nodes = sd_grid_pixels(SIZE)
    drawn = np.stack([functions(nodes) @ part for part in np.split(root, 2)])
    np.testing.assert_allclose(sd.ravel(), np.sqrt(np.sum(drawn**2, axis=(0, 2)) / 2), rtol=1e-9)
    series = Series(functions, np.zeros((2, len(functions))), sd)
    np.testing.assert_allclose(series.sd_at(nodes), sd.ravel(), rtol=1e-9)


def test_model_with_a_series_has_a_calibrated_area():
    functions = Functions(SIZE, 3)
    uv = pixels(size=(500, 500))
    model = create_model(
        'collocation',
        0,
        uv,
        np.zeros_like(uv),
        series=Series(functions, np.ones((2, 10)), np.full((SD_GRID, SD_GRID), 0.1)),
    )
    found = model.evaluate(np.array([[250.0, 250.0], [900.0, 700.0]]))
    assert list(found.outside) == [False, True] and found.sd == pytest.approx(0.1)
    for kind, series, message in (
        ('collocation', None, 'collocation needs a series'),
        ('local_linear', model.series, 'local_linear has no series'),
    ):
        with pytest.raises(ValueError, match=message):
            create_model(kind, 6, uv, uv, series=series)


# ---- signal and trend


@pytest.mark.parametrize('sd, reach, nu', [(0.5, 180.0, 2.5), (1.2, 100.0, 2.5), (0.5, 150, 6.0)])
def test_sines_have_the_matern_covariance_function(sd, reach, nu):
    """Compare with the closed form with a Bessel function (Rasmussen and Williams 2006, Eq. 4.14),
    away from the edge, where the sines vanish.
    """
    functions = Functions((1024, 1024), -1, 40)
    uv = pixels(40, size=(500, 500)) + 262
    values = functions(uv)
    ours = (values * spectral_density(functions.frequency, sd, reach, nu)) @ values.T
    scaled = np.sqrt(2 * nu) * np.maximum(cdist(uv, uv), 1e-9) / reach
    theirs = sd**2 * 2 ** (1 - nu) / gamma(nu) * scaled**nu * kv(nu, scaled)
    np.testing.assert_allclose(ours, theirs, atol=0.02 * sd**2)


def drawn_field(functions, prior, seed, uv, noise):
    """Draw coefficients from a Prior; return noisy values of the field at pixels as information
    matrix and right-hand side.
    """
    rng = np.random.default_rng(seed)
    m = len(functions)
    t = len(functions.powers)
    back = np.linalg.inv(trend_transformation(functions.degree)[0])
    terms = np.zeros(2 * t)
    terms[: len(prior.trend)] = rng.normal(0, np.sqrt(prior.trend))
    coefficients = np.concatenate(
        [
            np.zeros((2, t)),
            rng.normal(
                0,
                np.sqrt(prior.signal.variance(functions.frequency)),
                (2, m - t),
            ),
        ],
        axis=1,
    )
    coefficients[:, :t] = (back @ terms).reshape(2, t)
    values = functions(uv)
    observed = values @ coefficients.T + rng.normal(0, noise, (len(uv), 2))
    gram = values.T @ values / noise**2
    information = np.kron(np.eye(2), gram)
    return information, (values.T @ observed / noise**2).T.ravel()


def test_prior_of_a_signal_is_estimated():
    """Standard deviation and correlation length agree within a fifth in the mean of several
    fields; absent terms get no variance.
    """
    functions = Functions((1024, 1024), 3, 18)
    uv = pixels(2500, 3, (1024, 1024))
    there = np.zeros(14)
    there[[0, 4, 9]] = 25.0
    found = []
    for seed in range(4):
        prior = starting_prior(functions, 1.0)
        information, right = drawn_field(
            functions, Prior(Signal(0.5, 220.0), there), seed, uv, 0.25
        )
        rows = gauge_conditions(functions(uv), uv, np.array([511.5, 511.5, 4000.0]))
        gauge = rows.T @ rows
        for _ in range(4):
            prior = most_likely_prior(SeriesEquations(functions, information, right, gauge), prior)
        found.append(prior)
    assert np.mean([p.signal.sd for p in found]) == pytest.approx(0.5, rel=0.2)
    assert np.mean([p.signal.reach for p in found]) == pytest.approx(220, rel=0.2)
    trend = np.array([p.trend for p in found])
    assert (trend[:, [0, 4, 9]] > 0.01).all()
    assert np.mean(np.delete(trend, [0, 4, 9], axis=1) < 0.05) > 0.8


def test_slopes_of_the_likelihood_of_a_signal():
    """The derivatives agree with finite differences of the cost."""
    functions = Functions((1024, 1024), 3, 12)
    uv = pixels(600, 5, (1024, 1024))
    prior = Prior(Signal(0.8, 400.0, 0.2, 60.0), np.ones(14))
    information, right = drawn_field(functions, prior, 1, uv, 0.25)
    information += 1e-3 * np.eye(len(right))
    t = len(functions.powers)
    m = len(functions)
    columns = np.concatenate([np.arange(t, m), m + np.arange(t, m)])

    equations = SignalEquations(functions.frequency, information, right[:, None], columns)

    def cost(at):
        return _likelihood(at, equations)

    at = np.log([0.6, 300.0, 0.3, 80.0, 3.5])
    numeric = [(cost(at + h).cost - cost(at - h).cost) / 2e-4 for h in 1e-4 * np.eye(5)]
    np.testing.assert_allclose(cost(at).slopes, numeric, rtol=1e-4, atol=1e-4)


def test_likelihood_of_u_and_v_with_the_same_matrix():
    """It is that of both together, and needs only the matrix of one."""
    functions = Functions((1024, 1024), 3, 12)
    values = functions(pixels(600, 5, (1024, 1024))) / 0.25
    matrix = values.T @ values + 1e-3 * np.eye(len(functions))
    right = values.T @ np.random.default_rng(1).normal(0, 4, (600, 2))
    t = len(functions.powers)
    m = len(functions)
    columns = np.arange(t, m)
    of_either = SignalEquations(functions.frequency, matrix, right, columns)
    of_both = SignalEquations(
        functions.frequency,
        block_diag(matrix, matrix),
        right.T.reshape(-1, 1),
        np.concatenate([columns, m + columns]),
    )
    at = np.log([0.6, 300.0, 0.3, 80.0, 3.5])
    first, second = (_likelihood(at, equations) for equations in (of_either, of_both))
    assert first.cost == pytest.approx(second.cost, rel=1e-12)
    np.testing.assert_allclose(first.slopes, second.slopes, rtol=1e-9)
    np.testing.assert_allclose(first.curvature, second.curvature, rtol=1e-9)


@pytest.mark.parametrize('smoothness', [1.5, 4.0])
def test_prior_of_a_signal_says_what_short_waves_have(smoothness):
    """Rough and smooth field have the same standard deviation and correlation length."""
    functions = Functions((1024, 1024), -1, 20)
    uv = pixels(2500, 3, (1024, 1024))
    there = Prior(Signal(1.0, 200.0, smoothness=smoothness), np.zeros(0))
    information, right = drawn_field(functions, there, 4, uv, 0.1)
    prior = starting_prior(functions, 1.0)
    for _ in range(5):
        prior = most_likely_prior(
            SeriesEquations(functions, information, right, np.zeros_like(information)), prior
        )
    for part in (0.7, 1.0):
        at = part * functions.highest
        assert prior.signal.sd_beyond(at) == pytest.approx(there.signal.sd_beyond(at), rel=0.4)


def test_a_signal_of_two_scales_is_found_from_the_observations():
    """Ripples on a long wave: their standard deviation is within a quarter, and the prior states
    the size of what a series omits.
    """
    functions = Functions((1024, 1024), -1, 22)
    uv = pixels(2500, 3, (1024, 1024))
    information, right = drawn_field(
        functions, Prior(Signal(3.0, 800.0, 0.4, 80.0), np.zeros(0)), 2, uv, 0.25
    )
    prior = starting_prior(functions, 5.0)
    gauge = np.zeros_like(information)
    for _ in range(5):
        prior = most_likely_prior(SeriesEquations(functions, information, right, gauge), prior)
    assert prior.signal.fine_sd == pytest.approx(0.4, rel=0.25)
    assert prior.signal.fine_reach == pytest.approx(80, rel=0.3)
    assert prior.signal.sd_beyond(0.0) == pytest.approx(
        np.hypot(prior.signal.sd, prior.signal.fine_sd)
    )


def plane_wave(uv, wavelength):
    """Displacements (n, 2) [px] of a plane wave, 0.3 px along u and 0.2 px along v."""
    return np.sin(2 * np.pi / wavelength * (uv @ [0.6, 0.8]))[:, None] * [0.3, -0.2]


@pytest.mark.parametrize(
    'wavelength, count', [(60.0, 1500), (80.0, 1500), (150.0, 1500), (80.0, 600)]
)
def test_residuals_show_the_band_of_ripples(wavelength, count):
    """Ripples are found even where the point spacing is half their wavelength. Noise of equal size
    shows none, nor do ripples that the series can follow.
    """
    uv = pixels(count, 4, (1024, 1024))
    noise = np.random.default_rng(6).normal(0, 0.25, uv.shape)
    exposure = np.arange(count) % 12
    wave = noise + plane_wave(uv, wavelength)
    assert shown_ripples((1024, 1024), uv, noise, exposure, 10) is None
    found = shown_ripples((1024, 1024), uv, wave, exposure, 10)
    band = 2 * 1.3 * 1024 / wavelength
    assert min(found.bands) < band < max(found.bands)
    assert len(found.bands) <= 9
    assert shown_ripples((1024, 1024), uv, wave, exposure, 48) is None
    larger = shown_ripples((1024, 1024), uv, 4 * wave, exposure, 10)
    assert larger.variances == pytest.approx(16 * np.array(found.variances), rel=1e-9)


@pytest.mark.parametrize('exposures', [3, 15])
def test_ripples_that_differ_between_exposures_are_not_those_of_the_distortion(exposures):
    """Like corners of a board that are all displaced alike, the wave moves with the board."""
    rng = np.random.default_rng(7)
    exposure = np.repeat(np.arange(exposures), 200)
    uv = pixels(len(exposure), 4, (1024, 1024))
    shift = rng.uniform(0, 70, (exposures, 2))[exposure]
    residuals = plane_wave(uv + shift, 70.0) + rng.normal(0, 0.1, uv.shape)
    assert shown_ripples((1024, 1024), uv, residuals, exposure, 10) is None


def test_variances_of_shown_ripples_are_those_of_their_sines():
    """Variances agree with the mean squares of the coefficients, in noise of equal size."""
    functions = Functions((1024, 1024), -1, 30)
    rng = np.random.default_rng(8)
    inside = (functions.band >= 20) & (functions.band <= 22)
    coefficients = rng.normal(0, 20.0, (len(functions), 2)) * inside[:, None]
    uv = pixels(4000, 4, (1024, 1024))
    residuals = functions(uv) @ coefficients + rng.normal(0, 1.0, uv.shape)
    found = shown_ripples((1024, 1024), uv, residuals, np.arange(4000) % 12, 10)
    assert {20, 21, 22} <= set(found.bands) and len(found.bands) < 11
    there = [np.mean(coefficients[functions.band == band] ** 2) for band in (20, 21, 22)]
    assert np.mean(found.variances[20:23]) == pytest.approx(np.mean(there), rel=0.3)


def test_ripples_are_common_where_those_of_exposures_agree():
    """Ripples that shift with the exposure count only if points are reassigned at random."""
    rng = np.random.default_rng(7)
    exposure = np.repeat(np.arange(8), 600)
    uv = pixels(len(exposure), 4, (1024, 1024))
    shift = rng.uniform(0, 70, (8, 2))[exposure]
    residuals = plane_wave(uv + shift, 70.0) + rng.normal(0, 0.1, uv.shape)
    assert shown_ripples((1024, 1024), uv, residuals, exposure, 10) is None
    dealt = rng.permutation(exposure)
    assert shown_ripples((1024, 1024), uv, residuals, dealt, 10) is not None


def test_ripples_that_short_sines_have_followed_stand_out_of_their_bands():
    """A wave of 150 px does, a field whose power falls with frequency does not; both noisy."""
    uv = pixels(2000, 4, (1024, 1024))
    exposure = np.arange(2000) % 15
    noise = np.random.default_rng(6).normal(0, 0.25, uv.shape)
    wave = shown_ripples((1024, 1024), uv, plane_wave(uv, 150.0) + noise, exposure, 12).alone()
    assert min(wave.bands) <= 17 <= 18 <= max(wave.bands)
    assert len(wave.bands) <= 7
    functions = Functions((1024, 1024), -1, 30)
    variance = Signal(1.0, 100.0).density(functions.frequency) * (functions.band > 12)
    coefficients = np.random.default_rng(2).normal(0, np.sqrt(variance), (2, len(functions)))
    field = functions(uv) @ coefficients.T
    assert np.std(field) > 0.2
    assert shown_ripples((1024, 1024), uv, field + noise, exposure, 12).alone() is None


def test_prior_of_ripples_is_estimated():
    """A long field and a band of short waves: a covariance function that falls with frequency
    cannot have such a gap. The mean variance of the band is within a fifth.
    """
    functions = Functions((1024, 1024), -1, 22, absent=tuple(range(11, 20)))
    width = functions.frequency_of_mode
    uv = pixels(2000, 3, (1024, 1024))

    def ripples(variance):
        return Ripples(width, (*[0.0] * 20, variance, variance, variance))

    there = Signal(1.0, 600.0, ripples=ripples(300.0))
    information, right = drawn_field(functions, Prior(there, np.zeros(0)), 2, uv, 0.25)
    prior = Prior(Signal(0.5, 300.0, 1e-3, 200.0, ripples=ripples(30.0)), np.zeros(0))
    for _ in range(5):
        prior = most_likely_prior(
            SeriesEquations(functions, information, right, np.zeros_like(information)), prior
        )
    found = prior.signal.variance(width * np.array([20.0, 21.0, 22.0]))
    assert found.mean() == pytest.approx(300.0, rel=0.2)
    assert prior.signal.ripples.bands == (20, 21, 22)
    assert prior.signal.density(width * 20.0) < 10.0


def test_expert_terms_and_gauge_are_independent():
    names, terms = expert_terms()
    gauge = np.stack([polynomial_coefficients(HIGHEST, parts) for parts in GAUGE.values()])
    assert len(set(names)) == len(terms) == 31
    everything = np.concatenate([terms, gauge]).reshape(37, -1)
    assert np.linalg.matrix_rank(everything / np.linalg.norm(everything, axis=1)[:, None]) == 37


# ---- additional parameters in the adjustment


def network_with_additional(kind, seed=0, **shape):
    """A small network of two fluoroscopes, both with additional parameters, and its true
    parameters. kind: 'separate' for u and v, 'shared' by them, or 'grouped' by exposures, too.
    """
    network, truth = rigs.small_network(fluoroscopes=2, seed=seed, **shape)
    rng = np.random.default_rng(seed)
    additional = []
    coefficients = []
    for f in range(2):
        uv = network.uv[network.rows(f)]
        values = Functions((1024, 1024), 2, 2)(uv)[:, 3:]
        own = None
        if kind == 'shared':
            values = np.einsum('nm,amt->nat', values, rng.normal(size=(2, values.shape[1], 5)))
        if kind == 'grouped':
            exposure = network.exposure[network.rows(f)]
            own = np.einsum('nm,amt->nat', values, rng.normal(size=(2, values.shape[1], 2)))
            own = GroupedFunctions(own, exposure - exposure[0])
        made = AdditionalParameters(values, np.zeros((1, 1)), own)
        root = rng.normal(size=(made.count, made.count))
        additional.append(replace(made, prior=root @ root.T / made.count + np.eye(made.count)))
        coefficients.append(rng.normal(size=made.count))
    network = replace(network, additional=tuple(additional))
    truth = replace(truth, additional=tuple(coefficients))
    return replace(network, uv=network.uv + network.additional_correction(truth)), truth


def dense_normal(network, result):
    """Dense normal matrix of all unknowns, additional parameters last, from central differences of
    the residuals.
    """
    m, n = network.n_exposures, network.n_points
    count = network.layout.n_globals - 3 * network.n_fluoroscopes
    u = 6 * m + 3 * n + 3 * int(network.interior_free.sum())

    def moved(x):
        plain = rigs.moved(network, result.parameters, x[:u])
        parts = np.split(x[u:], [network.additional[0].count])
        return replace(
            plain, additional=tuple(a + p for a, p in zip(result.parameters.additional, parts))
        )

    step = np.concatenate(
        [
            np.tile([1e-2] * 3 + [1e-6] * 3, m),
            np.full(3 * n, 1e-3),
            np.full(u - 6 * m - 3 * n, 1e-2),
            np.full(count, 1e-3),
        ]
    )
    columns = [
        (
            residuals_and_q(network, moved(h * e), 0.0, result.noise)[0]
            - residuals_and_q(network, moved(-h * e), 0.0, result.noise)[0]
        ).ravel()
        / (2 * h)
        for h, e in zip(step, np.eye(u + count))
    ]
    a = np.stack(columns, axis=1)
    weight = result.noise.weight(result.q) / (result.noise.scale * network.sigma) ** 2
    normal = a.T @ (np.repeat(weight, 2)[:, None] * a)
    points = np.arange(6 * m, 6 * m + 3 * n)
    normal[points, points] += np.repeat(1 / network.survey_sd_mm**2, 3)
    at = u
    for additional in network.additional:
        part = slice(at, at + additional.count)
        normal[part, part] += additional.prior
        at += additional.count
    return normal, u, a


@pytest.mark.parametrize('kind', ['separate', 'shared', 'grouped'])
@pytest.mark.parametrize('shape', [dict(exposures=3, targets=30), dict(exposures=7, targets=20)])
def test_covariances_with_additional_parameters_equal_the_dense_inverse(kind, shape):
    """Covariances of all unknowns and the projection, information of the additional ones."""
    network, truth = network_with_additional(kind, **shape)
    result = adjust(
        network,
        rigs.disturbed(truth).__class__(
            **{
                **vars(rigs.disturbed(truth)),
                'additional': tuple(np.zeros_like(a) for a in truth.additional),
            }
        ),
        noise=Noise('student_t', 0.3, 8.0),
    )
    assert result.converged
    matrix = factorize(
        network,
        normal_equations(network, result.parameters, np.zeros_like(network.uv), result.noise),
    )
    blocks = covariance_blocks(matrix)
    normal, u, a = dense_normal(network, result)
    inverse = np.linalg.inv(normal)
    count = network.additional[0].count
    np.testing.assert_allclose(blocks.gg[6:, 6:], inverse[u:, u:], rtol=2e-4, atol=1e-6)
    for f in range(2):
        own = slice(u + f * count, u + (f + 1) * count)
        np.testing.assert_allclose(
            np.linalg.inv(information_of_additional(matrix, f)),
            inverse[own, own],
            rtol=2e-4,
            atol=1e-6,
        )
    projected = (a @ inverse @ a.T).reshape(len(network.uv), 2, -1, 2)[
        np.arange(len(network.uv)), :, np.arange(len(network.uv))
    ]
    np.testing.assert_allclose(
        covariance_of_projection(network, result.parameters, blocks),
        projected,
        rtol=2e-3,
        atol=1e-6,
    )
    precise = precision(network, result)
    assert [len(c) for c in precise.additional] == [count, count]


@pytest.mark.parametrize('kind', ['separate', 'shared', 'grouped'])
@pytest.mark.parametrize('prior', ['interior', 'exterior'])
def test_right_sides_alone_equal_those_of_the_normal_equations(kind, prior):
    network, truth = network_with_additional(kind, exposures=4, targets=20)
    if prior == 'interior':
        network = replace(
            network, interior_mean=truth.interior + 3.0, interior_sd=np.full((2, 3), 2.0)
        )
    else:
        sd = np.tile([5.0, 5.0, 5.0, 1e-3, 1e-3, 1e-3], (network.n_exposures, 1))
        network = replace(
            network, exterior=ExteriorPrior(truth.rotation, truth.position_mm + 1.0, sd)
        )
    at = replace(rigs.disturbed(truth), additional=truth.additional)
    noise = Noise('student_t', 0.3, 8.0)
    correction = np.full_like(network.uv, 0.1)
    equations = normal_equations(network, at, correction, noise)
    found = right_sides(network, at, correction, noise)
    for one, other in (
        (found.exteriors, equations.right.exteriors),
        (found.points, equations.right.points),
        (found.globals, equations.right.globals),
    ):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9 * np.abs(other).max())


@pytest.mark.parametrize('of_exposures', [False, True])
def test_both_eliminations_agree_with_additional_parameters(of_exposures):
    network, truth = network_with_additional('separate', exposures=4, targets=25)
    noise = Noise('student_t', 0.3, 8.0)
    expected = adjust(network, truth, noise=noise, tolerance=1e-12)
    with rigs.eliminating(of_exposures):
        found = adjust(network, truth, noise=noise, tolerance=1e-12)
    assert found.cost == pytest.approx(expected.cost, abs=1e-7)
    for one, other in zip(found.parameters.additional, expected.parameters.additional):
        np.testing.assert_allclose(one, other, atol=1e-4)


def test_gradient_is_zero_at_the_solution_with_additional_parameters():
    network, truth = network_with_additional('separate', exposures=4, targets=25)
    result = adjust(network, truth, noise=Noise('student_t', 0.3, 8.0), tolerance=1e-12)

    def cost(f, move):
        moved = list(result.parameters.additional)
        moved[f] = moved[f] + move
        parameters = replace(result.parameters, additional=tuple(moved))
        _, q = residuals_and_q(network, parameters, 0.0, result.noise)
        return total_cost(network, parameters, q, result.noise)

    for f in range(2):
        for direction in np.eye(network.additional[f].count):
            slope = (cost(f, 1e-3 * direction) - cost(f, -1e-3 * direction)) / 2e-3
            assert abs(slope) < 1e-3


# ---- models of whole calibrations


def rig_with(field, seed=1):
    """The virtual rig with a given distortion in fluoroscope a."""
    rig = virtual_rig(seed)
    first = replace(rig.fluoroscopes[0], distortion=field(rig.fluoroscopes[0].distortion))
    return replace(rig, fluoroscopes=(first, *rig.fluoroscopes[1:]))


def whole(rig, model, count=10, seed=1):
    """SelfCalibration of fluoroscope a, and the state of its model."""
    measured = measured_network(
        {'a': simulate_exposures(rig, count, seed).frames['a']}, rig.phantom
    )
    before, _ = adjusted_with_precision(
        measured.network,
        measured.start,
        np.zeros_like(measured.network.uv),
        start_noise('student_t'),
    )
    problem = AdjustmentProblem(measured.network, measured.image_size, before, (GaugeKind.FULL,))
    terms = estimator_of(model).adjusted_terms(problem)
    return calibrate_by_adjustment(measured, before, MODELS[model], terms, 60), terms


@pytest.mark.long
def test_stepwise_selects_the_true_terms():
    """Pincushion and spiral alone yield radial and spiral terms and hardly any others; no
    distortion yields none.
    """

    def smooth(field):
        return DistortionField(np.array([511.5, 511.5]), 9.5, np.zeros(2), 2.0, np.zeros((0, 5)))

    _, state = whole(rig_with(smooth), 'parametric')
    names = {name for name, there in zip(state.names, state.parts[0].selected) if there}
    assert {'radial 1', 'spiral 1'} <= names and len(names) <= 4
    _, state = whole(
        rig_with(lambda field: replace(smooth(field), pincushion=0.0, spiral=0.0)), 'parametric'
    )
    assert state.parts[0].selected.sum() <= 1


class Woven(DistortionField):
    """A distortion with ripples of 75 px."""

    def __call__(self, uv):
        """Corrections (n, 2) [px] of observed pixels uv (n, 2)."""
        return super().__call__(uv) + plane_wave(np.asarray(uv, dtype=float), 75.0)


@pytest.mark.long
def test_ripples_of_one_wavelength_are_corrected():
    """The ripples are shorter than the shortest sine of a smooth field; uncorrected, 0.25 px would
    remain.
    """
    field = None

    def woven(plain):
        nonlocal field
        field = Woven(**vars(plain))
        return field

    run, state = whole(rig_with(woven), 'collocation', 15)
    uv = run.measured.network.uv[run.after.inliers]
    model = run.models['a']
    error = model.predict(uv) - field(uv)
    basis = gauge_basis(uv, run.after.parameters.interior[0]).reshape(2 * len(uv), -1)
    error = error.ravel() - basis @ np.linalg.lstsq(basis, error.ravel(), rcond=None)[0]
    assert np.sqrt(np.mean(error**2)) < 0.11
    assert np.sqrt(np.mean(model.evaluate(uv).sd ** 2)) < 0.13
    # Calibrations of parts continue with exactly these sines, not with all of similar wavelength.
    problem = AdjustmentProblem(
        run.measured.network, run.measured.image_size, run.before, (GaugeKind.FULL,)
    )
    parts = CollocationTerms(problem, earlier=EarlierTerms([model.series], [None], False))
    assert parts.parts[0].functions == state.parts[0].functions
    assert parts.priors[0].signal.ripples.bands == state.priors[0].signal.ripples.bands


@pytest.mark.parametrize('feedback', [-1.5, -0.6, -0.1, 0.3])
def test_gauge_settles_where_its_steps_move_the_principal_point(feedback):
    """With half of the image blind, a gauge step moves the estimate back and overshoots."""
    network, truth = rigs.small_network()
    problem = AdjustmentProblem(network, [(1024, 1024)], adjust(network, truth), (GaugeKind.FULL,))
    part = FluoroscopeTerms.first(problem, 0, START_MODES)
    settled = part.interior + [80.0, -50.0, 3.0]
    for _ in range(12):
        part.use_interior(settled + feedback * (part.interior - settled))
    assert np.abs(part.interior - settled).max() < 0.01


def test_reported_changes_of_the_correction_vanish_as_its_terms_settle():
    network, truth = rigs.small_network(8, 60)
    bent = 3.0 * ((network.uv - 511.5) / 512) ** 2
    network = replace(network, uv=network.uv + bent)
    before = adjust(network, truth)
    problem = AdjustmentProblem(network, [(1024, 1024)], before, (GaugeKind.FULL,))
    terms = CollocationTerms(problem, modes=0)
    changes = []
    _, _, converged = adjust_with_terms(
        network, before, terms, 20, lambda _, change: changes.append(change)
    )
    assert converged and 2 < len(changes) < 20
    assert 0.2 < changes[0] < 3.0
    assert changes[-1] < 0.02 * changes[0]


@pytest.mark.long
def test_auto_selects_collocation_unless_cross_validation_is_worse():
    """A distortion with steps in small squares is no smooth signal: a neighbour model predicts it
    better.
    """
    run, state = whole(virtual_rig(1), 'collocation', 15)
    assert better_model(run, state) is None
    squares = np.floor(run.measured.network.uv / 80).sum(axis=1) % 2
    steps = np.where(squares[:, None] == 0, 1.0, -1.0) * [1.0, 0.7]
    stepped = replace(run, after=replace(run.after, residuals=run.after.residuals + steps))
    assert better_model(stepped, state) in ('local_linear', 'knn')
    # A polynomial that the terms of `parametric` do not contain is no reason to choose it.
    x, y = (run.measured.network.uv - 512).T / 512
    polynomial = np.stack([20 * x**4 * y**3, -15 * x * y**5], axis=1)
    residuals = run.after.residuals - run.correction + polynomial
    bent = replace(run, after=replace(run.after, residuals=residuals))
    assert better_model(bent, state) != 'parametric'


@functools.cache
def unused():
    """Exposures that no calibration uses."""
    return simulate_exposures(rigs.rig(), 40, 10**6, start=StreamStart(number=1001))


def point_error(frames, job):
    """3-D error [mm] of the object points of exposures of a, adjusted with a calibration."""
    rig = rigs.rig()
    found = adjust_with_calibrations({'a': frames}, rig.phantom, job.calibrations).targets
    off = found.xyz_mm - rig.true_mm[found.target_id - 1]
    return np.sqrt(np.mean(np.sum(off**2, axis=1)))


@functools.cache
def error_with_known_distortion():
    """3-D error [mm] of the unused exposures when their distortion is known."""

    def undistorted(seen):
        return [replace(f, uv=uv) for f, uv in zip(seen.frames['a'], seen.undistorted['a'])]

    train = undistorted(simulate_exposures(rigs.rig(), 15, 1))
    job = calibrate({'a': train}, rigs.rig().phantom, CalibrationOptions('none'))
    return point_error(undistorted(unused()), job)


@pytest.mark.long
@pytest.mark.parametrize(
    'options, most', [({}, 1.1), ({'model': 'hybrid'}, 1.15), ({'model': 'parametric'}, 1.8)]
)
def test_out_of_sample_error_is_near_that_of_known_distortion(options, most):
    """40 unused exposures: 3-D error of the object points, relative to known distortion."""
    found = point_error(unused().frames['a'], rigs.calibrated('a', **options))
    assert found < most * error_with_known_distortion()


# ---- shorter versions of long benchmark runs


@pytest.mark.long
def test_errors_agree_with_standard_deviations():
    """A few calibrations of `make precision`: object points 0.9 to 1.1, coverage of the correction
    near 95 %.
    """
    from benchmarks.precision import normalised

    results = [normalised(seed, exposures=8) for seed in range(3)]
    assert 0.9 < np.mean([r['object points'] for r in results]) < 1.1
    assert (
        0.3 < np.mean([r['T'] for r in results]) < 2.5
        and 0.3 < np.mean([r['q'] for r in results]) < 2.5
    )
    assert 0.9 < np.mean([r['interval'] for r in results]) < 0.99
    assert np.mean([r['sigma0'] for r in results]) == pytest.approx(0.25, rel=0.05)


@pytest.mark.long
@pytest.mark.parametrize('seed', [5001, 5008])
def test_random_rigs_converge_to_the_right_answer(seed):
    """A few cases of `make convergence`."""
    from benchmarks.convergence import outcome

    result = outcome(seed)
    assert result['end'] == 'converged' and not result['wrong']


def differently_bent(exposures, terms_at, size_px, seed):
    """Exposures with other amounts of some terms (n, k) of the place in each."""
    rng = np.random.default_rng(seed)
    frames = []
    for frame in simulate_exposures(virtual_rig(5), exposures, 5).frames['a']:
        terms = np.stack(terms_at(*((frame.uv - 511.5) / 512).T), axis=1)
        bend = rng.normal(0, size_px, (terms.shape[1], 2))
        frames.append(replace(frame, uv=np.clip(frame.uv + terms @ bend, 0, 1022)))
    return frames


@pytest.mark.long
def test_claims_hold_for_unseen_exposures_where_the_distortion_varies():
    frames = differently_bent(
        20, lambda x, y: [x * y * y, y * x * x, x**3, y**3], size_px=0.8, seed=4
    )
    phantom = virtual_rig(5).phantom
    result = calibrate({'a': frames[::2]}, phantom)
    calibration = result.calibrations['a']
    assert calibration.image_sd > 1.2 * calibration.sigma0
    table = adjust_with_calibrations({'a': frames[1::2]}, phantom, result.calibrations).residuals
    good = ~table.outlier
    claimed = calibration.correct(table.uv[good], exact=True).sigma
    square = np.sum((table.residual[good] / claimed[:, None]) ** 2)
    assert 0.6 < square / np.sum(table.redundancy[good]) < 1.6


@pytest.mark.long
def test_changes_beyond_cubic_are_followed():
    """Cubic terms of the exposures leave residuals of 0.243 px; without a change, 0.199 px."""
    frames = differently_bent(10, lambda x, y: [x**4, y**4, x * x * y * y], size_px=3.0, seed=6)
    result = calibrate({'a': frames}, virtual_rig(5).phantom)
    table = result.residuals
    assert np.sqrt(np.mean(table.residual[~table.outlier] ** 2)) < 0.21


@pytest.mark.parametrize('exposures', [4, 14])  # eliminates the points, or the exposures
def test_coefficients_at_the_solution_of_an_adjustment_that_stopped_before(exposures):
    """If its prior nearly fixes a coefficient, the pull on it is visible only at the solution."""
    network, truth = rigs.small_network(exposures, 25, noise_px=0.3, nu=4.0, free=False)
    functions = Functions((1024, 1024), 3)(network.uv)
    count = 2 * functions.shape[1]
    prior = np.diag(np.where(np.arange(count) % 2, 1e8, 1.0))
    network = replace(network, additional=(AdditionalParameters(functions, prior),))
    start = replace(truth, additional=(np.full(count, 0.5),))
    noise = Noise(scale=0.3, nu=4.0)
    stopped = adjust(network, start, noise=noise, tolerance=100.0)
    exact = adjust(network, start, noise=noise, tolerance=1e-12)
    equations = normal_equations(network, stopped.parameters, 0.0, noise, 0.75)
    solved = solved_additional(factorize(network, equations), network, stopped)[0]
    pulls = [prior @ c for c in (stopped.parameters.additional[0], solved)]
    expected = prior @ exact.parameters.additional[0]
    errors = [np.max(np.abs(pull - expected)) for pull in pulls]
    assert errors[1] < 0.1 * errors[0]
    assert errors[1] < 0.1 * np.max(np.abs(expected))
