# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Places where the signal varies more: bumps, gain of a window, and their prior."""

import functools
from dataclasses import replace

import numpy as np
import pytest
import rigs
from scipy.linalg import block_diag
from threadpoolctl import threadpool_limits

from fluoro_calib_ros.correction.series import Functions
from fluoro_calib_ros.estimation.calibrate import calibrate
from fluoro_calib_ros.estimation.local_signal import (
    LocalSignal,
    SineEstimates,
    bumps,
    largest_gain,
    with_likely_places,
)
from fluoro_calib_ros.estimation.priors import (
    Prior,
    SeriesEquations,
    most_likely_prior,
    prior_precision,
    signal_precision,
    starting_prior,
    with_more_places,
    with_shown_places,
)
from fluoro_calib_ros.estimation.signal import Signal

SIZE = (1024, 1024)
NOISE = 0.25
SMOOTH = Prior(Signal(0.5, 300.0, 1e-3, 200.0), np.zeros(0))


@pytest.fixture(autouse=True, scope='module')
def one_thread():
    """Use one thread, as a calibration does."""
    with threadpool_limits(1):
        yield


def place(middle, variance):
    """A window of 4 x 4 bumps about a centre."""
    axis = 32.0 * (np.arange(4) - 1.5)
    nodes = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2) + middle
    return LocalSignal(nodes, np.zeros(16, dtype=int), np.array([variance]))


def drawn(functions, local=None, seed=1, count=2000):
    """Image points, and values (n, 2) drawn from a smooth field with a place."""
    rng = np.random.default_rng(seed)
    uv = rng.uniform(0, 1023, (count, 2))
    variance = SMOOTH.signal.variance(functions.frequency)
    coefficients = rng.normal(0, np.sqrt(variance)[:, None], (len(variance), 2))
    if local is not None:
        heights = rng.normal(0, np.sqrt(local.of_bumps)[:, None], (len(local.nodes), 2))
        coefficients += bumps(functions, local.nodes) @ heights
    return uv, functions(uv) @ coefficients + rng.normal(0, NOISE, (count, 2))


def equations(functions, uv, values):
    """Information and right-hand side of the coefficients, those of u first."""
    design = functions(uv) / NOISE
    return np.kron(np.eye(2), design.T @ design), (design.T @ values / NOISE).T.ravel()


def test_bumps_are_those_of_the_sines():
    """The bumps are Gaussians of 24 px if the sines are short enough for them."""
    functions = Functions(SIZE, -1, 70)
    nodes = np.array([[300.0, 400.0], [512.0, 700.0]])
    uv = np.random.default_rng(0).uniform(200, 800, (200, 2))
    found = functions(uv) @ bumps(functions, nodes)
    square = np.sum((uv[:, None] - nodes) ** 2, axis=2)
    np.testing.assert_allclose(found, np.exp(-square / (2 * 24.0**2)), atol=0.002)


def test_gain_of_a_window_is_that_of_the_marginal_likelihood():
    """The likelihood is that of the values, with the full covariance matrix, before and after."""
    functions = Functions(SIZE, -1, 16)
    uv, values = drawn(functions, place((416.0, 608.0), 0.3), count=500)
    information, right = equations(functions, uv, values)

    def cost(prior):
        design = functions(uv)
        precision = signal_precision(functions, prior)
        covariance = design @ np.linalg.solve(precision, design.T) + NOISE**2 * np.eye(len(uv))
        root = np.linalg.cholesky(covariance)
        whitened = np.linalg.solve(root, values)
        return 2 * np.sum(np.log(np.diagonal(root))) + np.sum(whitened**2) / 2

    m = len(functions)
    covariance = np.linalg.inv(information + prior_precision(functions, SMOOTH))
    mean = (covariance @ right).reshape(2, m).T
    estimates = SineEstimates.of(
        signal_precision(functions, SMOOTH), mean, covariance[None, :m, :m]
    )
    found = with_likely_places(functions, estimates, None)
    first = found.window == 0
    alone = LocalSignal(found.nodes[first], found.window[first], found.variances[:1])
    gain = cost(SMOOTH) - cost(replace(SMOOTH, local=alone))
    assert largest_gain(functions, estimates) == pytest.approx(gain, rel=1e-6)
    assert gain > 6


@pytest.mark.long
def test_place_is_found_and_its_variance_estimated():
    """The place is located, and its variance is within a half in the mean of several fields."""
    functions = Functions(SIZE, -1, 24)
    there = place((416.0, 608.0), 0.36)
    variances = []
    for seed in range(3):
        uv, values = drawn(functions, there, seed)
        found = with_shown_places(functions, functions(uv) / NOISE, values / NOISE, SMOOTH)
        strong = found.local.of_bumps > 0.5 * found.local.variances.max()
        assert np.abs(found.local.nodes[strong] - (416.0, 608.0)).max() < 160
        information, right = equations(functions, uv, values)
        prior = replace(SMOOTH, local=place((416.0, 608.0), 0.02))
        gauge = np.zeros_like(information)
        for _ in range(5):
            prior = most_likely_prior(SeriesEquations(functions, information, right, gauge), prior)
        variances.append(prior.local.variances[0])
        more = with_more_places(SeriesEquations(functions, information, right, gauge), prior)
        assert len(more.local.variances) <= 2
    assert np.mean(variances) == pytest.approx(0.36, rel=0.5)


@pytest.mark.long
@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('bend', [0.0, 0.1])
def test_low_edge_is_found_by_the_band_along_it(seed, bend):
    """A jump of 1 px across a line, straight or bent, with noise of 0.25 px."""
    functions = Functions(SIZE, -1, 24)
    uv, values = drawn(functions, seed=seed)
    angle = 0.4 + seed

    def across(at):
        x = (at - 512) / 512
        along = x @ [-np.sin(angle), np.cos(angle)]
        return (x @ [np.cos(angle), np.sin(angle)] - 0.1 + bend * along**2) * 512

    values += 0.5 * np.tanh(across(uv) / 5)[:, None] * [0.6, -0.8]
    found = with_shown_places(functions, functions(uv) / NOISE, values / NOISE, SMOOTH).local
    first = found.nodes[found.window == 0]
    assert len(first) > 60
    assert np.median(np.abs(across(first))) < 48


@pytest.mark.parametrize('reach', [80.0, 300.0])
def test_field_that_is_the_same_everywhere_has_no_place(reach):
    functions = Functions(SIZE, -1, 18)
    prior = Prior(Signal(0.5, reach, 1e-3, 200.0), np.zeros(0))
    rng = np.random.default_rng(5)
    variance = prior.signal.variance(functions.frequency)
    for _ in range(3):
        uv = rng.uniform(0, 1023, (2000, 2))
        coefficients = rng.normal(0, np.sqrt(variance)[:, None], (len(variance), 2))
        values = functions(uv) @ coefficients + rng.normal(0, NOISE, uv.shape)
        found = with_shown_places(functions, functions(uv) / NOISE, values / NOISE, prior)
        assert found.local is None


def test_image_points_that_do_not_determine_the_trend_show_no_place():
    """All points lie on a line through the image centre, where most polynomials are zero."""
    functions = Functions(SIZE, 3, 18)
    uv = np.column_stack([np.full(100, 511.5), np.linspace(0, 1023, 100)])
    prior = starting_prior(functions, 1.0)
    found = with_shown_places(functions, functions(uv) / NOISE, np.zeros_like(uv), prior)
    assert found.local is None


def test_window_that_nothing_shows_vanishes():
    functions = Functions(SIZE, -1, 18)
    uv, values = drawn(functions)
    information, right = equations(functions, uv, values)
    prior = replace(SMOOTH, local=place((416.0, 608.0), 0.05))
    for _ in range(6):
        prior = most_likely_prior(
            SeriesEquations(functions, information, right, np.zeros_like(information)), prior
        )
    assert prior.local is None or np.sqrt(prior.local.variances[0]) < 0.1


def test_prior_of_the_coefficients_holds_the_bumps():
    """The precision of the prior is the inverse of the sum of both covariances."""
    functions = Functions(SIZE, -1, 14)
    local = place((416.0, 608.0), 0.3)
    base = bumps(functions, local.nodes)
    variance = SMOOTH.signal.variance(functions.frequency)
    covariance = np.diag(variance) + 0.3 * base @ base.T
    found = prior_precision(functions, replace(SMOOTH, local=local))
    scale = np.sqrt(np.concatenate([variance, variance]))
    product = found @ block_diag(covariance, covariance) * scale / scale[:, None]
    np.testing.assert_allclose(product, np.eye(2 * len(functions)), atol=1e-6)


SHALLOW = np.array([800.0, 700.0])
ROUND = np.array([600.0, 320.0])
DEEP = np.array([400.0, 600.0])


def shallow(uv):
    """Displacements (n, 2) [px] of a dent of 4 px, 40 px wide."""
    square = np.sum((uv - SHALLOW) ** 2, axis=1, keepdims=True)
    return np.exp(-square / (2 * 40.0**2)) * [-2.4, 3.2]


def round_dent(uv):
    """Displacements (n, 2) [px] of a dent of 4 px, 60 px in radius."""
    square = np.sum((uv - ROUND) ** 2, axis=1, keepdims=True) / 60.0**2
    return np.clip(1 - square, 0, None) ** 2 * [3.2, 2.4]


def deep(uv):
    """Displacements (n, 2) [px] of a dent of 6 px, 35 px wide."""
    square = np.sum((uv - DEEP) ** 2, axis=1, keepdims=True)
    return np.exp(-square / (2 * 35.0**2)) * [3.0, 5.1]


@functools.cache
def dented():
    """Self-calibrations of a fluoroscope with all dents and of the same one without them."""
    frames = [
        replace(f, uv=f.uv + shallow(f.uv) + round_dent(f.uv) + deep(f.uv))
        for f in rigs.exposures()['a'][:10]
    ]
    run = calibrate({'a': frames}, rigs.rig().phantom).runs['a']
    return run, rigs.calibrated('a', 10).runs['a']


@pytest.mark.long
def test_dent_is_corrected_and_the_rest_stays_precise():
    """Elsewhere, the standard deviation grows by less than a fifth over that without dents."""
    run, without_dents = dented()
    uv = run.measured.network.uv
    distance = np.linalg.norm(uv - SHALLOW, axis=1)
    change = run.models['a'].predict(uv) - without_dents.models['a'].predict(uv)
    assert np.sqrt(np.mean((change - shallow(uv))[distance < 60] ** 2)) < 0.35
    far = np.linalg.norm(uv - [[SHALLOW], [ROUND], [DEEP]], axis=2).min(axis=0) > 200
    claimed, before = (
        np.sqrt(np.mean(one.models['a'].evaluate(uv[far]).sd ** 2)) for one in (run, without_dents)
    )
    assert claimed < 1.2 * before


@pytest.mark.long
def test_a_dent_whose_points_were_rejected_is_followed():
    """The weights of a fit with long waves only reject the image points of this dent."""
    run, plain = dented()
    axis = np.linspace(-50, 50, 21)
    uv = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2) + ROUND
    shown = run.models['a'].predict(uv) - plain.models['a'].predict(uv)
    error = shown - round_dent(uv)
    assert np.sqrt(np.mean(error**2)) < 0.5 * np.sqrt(np.mean(round_dent(uv) ** 2))
    assert run.after.inliers.sum() > plain.after.inliers.sum() - 6


@pytest.mark.long
def test_dent_whose_image_points_look_like_false_matches_is_followed():
    """Its image points agree with those of other exposures."""
    run, _ = dented()
    near = np.linalg.norm(run.measured.network.uv - DEEP, axis=1) < 70
    assert near.sum() > 40
    assert run.after.inliers[near].mean() > 0.97
    assert run.after.inliers.mean() < 0.995  # false matches elsewhere stay rejected
