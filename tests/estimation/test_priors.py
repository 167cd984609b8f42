# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Priors of trend, places and ripples are those of the largest marginal likelihood."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import j0
from threadpoolctl import threadpool_limits

from fluoro_calib_ros.correction.series import Functions
from fluoro_calib_ros.correction.terms import ABSENT_VARIANCE, trend_transformation
from fluoro_calib_ros.estimation import signal as signal_module
from fluoro_calib_ros.estimation.local_signal import (
    NODES,
    WIDTH,
    WINDOWS,
    LocalSignal,
    SineEstimates,
    _all_nodes,
    _bands,
    _Place,
    _ShownBumps,
    _windows,
    bumps,
    correlation_beyond,
    largest_gain,
    with_likely_places,
)
from fluoro_calib_ros.estimation.priors import (
    RIDGE,
    Prior,
    SeriesEquations,
    _most_likely_trend,
    covariance_by_signal,
    covariance_of_series,
    has_rings,
    most_likely_prior,
    prior_precision,
    signal_precision,
    starting_prior,
    with_more_places,
    with_shown_places,
)
from fluoro_calib_ros.estimation.ripples import Ripples, ripples_of
from fluoro_calib_ros.estimation.signal import SMOOTHNESS, Signal, starting_signal

SIZE = (1024, 1024)
NOISE = 0.25
SMOOTH = Signal(0.5, 300.0, 1e-3, 200.0)


@pytest.fixture(autouse=True, scope='module')
def one_thread():
    """Use one thread, as a calibration does."""
    with threadpool_limits(1):
        yield


def observed(functions, uv, field, seed=1):
    """Information and right-hand side of the coefficients of a field (n, 2) with noise."""
    values = field + np.random.default_rng(seed).normal(0, NOISE, field.shape)
    design = functions(uv) / NOISE
    return np.kron(np.eye(2), design.T @ design), (design.T @ values / NOISE).T.ravel()


def evidence(functions, information, right, prior):
    """Logarithm of the marginal likelihood, up to a constant."""
    precision = information + prior_precision(functions, prior)
    of_prior = -np.sum(np.log(prior.trend))
    if functions.modes:
        of_prior += 2 * np.linalg.slogdet(signal_precision(functions, prior))[1]
    fit = right @ np.linalg.solve(precision, right)
    return (of_prior - np.linalg.slogdet(precision)[1] + fit) / 2


def image_points(count=1200, seed=3, size=SIZE):
    return np.random.default_rng(seed).uniform(0, 1, (count, 2)) * (np.array(size) - 1)


@pytest.mark.parametrize('modes', [0, 8])
def test_variances_of_the_trend_are_the_most_likely_ones(modes):
    """Any other variance lowers the likelihood; rings exist either with all terms or with none."""
    functions = Functions(SIZE, 3, modes, 2)
    uv = image_points()
    xy = (uv - 511.5) / 512
    x, y = xy.T
    field = np.stack([3 * x**3 - 2 * y * y, x * y - 0.3 * x * x], axis=1)
    field += 2.0 * np.sum(xy**2, axis=1, keepdims=True) ** 2 * xy
    information, right = observed(functions, uv, field)
    # Orientations are known up to the gauge, whose terms have no prior.
    prior = replace(starting_prior(functions, 1.0), signal=Signal(0.2, 300.0))
    for _ in range(12):
        prior = _most_likely_trend(
            SeriesEquations(functions, information, right, 0 * information), prior
        )
    here = evidence(functions, information, right, prior)
    exists = prior.trend > 1e-2
    assert 4 <= exists[:14].sum() <= 12 and exists[14] and has_rings(functions, prior)
    assert (prior.trend[[15, 16, 17, 19, 20, 21]] <= ABSENT_VARIANCE * 1.01).sum() >= 5
    for j in range(14):
        for factor in (0.7, 1.4):
            if prior.trend[j] * factor > 1e-3:  # others are at their lower bound
                trend = prior.trend.copy()
                trend[j] *= factor
                other = replace(prior, trend=trend)
                assert evidence(functions, information, right, other) < here
    if not modes:
        again = most_likely_prior(
            SeriesEquations(functions, information, right, np.zeros_like(information)), prior
        )
        np.testing.assert_allclose(again.trend, prior.trend, rtol=1e-2)


def test_a_prior_without_trend_or_signal_stays():
    functions = Functions(SIZE, -1, 0)
    prior = Prior(SMOOTH, np.zeros(0))
    nothing = np.zeros((0, 0))
    assert (
        most_likely_prior(SeriesEquations(functions, nothing, np.zeros(0), nothing), prior)
        == prior
    )


def test_rings_exist_by_the_variances_of_their_terms_alone():
    functions = Functions(SIZE, 3, 0, 2)
    prior = starting_prior(functions, 1.0)
    assert len(prior.trend) == 22 and not has_rings(functions, prior)
    prior.trend[13] = 5.0
    assert not has_rings(functions, prior)
    prior.trend[14] = 1e-3
    assert has_rings(functions, prior)


def test_prior_of_the_trend_is_that_of_its_terms():
    """In terms, the precision is diagonal; terms of the gauge have no prior."""
    functions = Functions(SIZE, 3, 5, 1)
    variance = np.random.default_rng(4).uniform(0.1, 5.0, 18)
    precision = prior_precision(functions, Prior(SMOOTH, variance))
    m, t = len(functions), functions.trend
    at = np.concatenate([np.arange(t), m + np.arange(t)])
    back = np.linalg.inv(trend_transformation(3, 1)[0])
    in_terms = back.T @ precision[np.ix_(at, at)] @ back
    expected = np.zeros((2 * t, 2 * t))
    expected[:18, :18] = np.diag(1 / variance)
    np.testing.assert_allclose(in_terms, expected, atol=1e-9)
    rest = np.setdiff1d(np.arange(2 * m), at)
    assert not precision[np.ix_(at, rest)].any()
    of_signal = np.tile(1 / SMOOTH.variance(functions.frequency), 2)
    np.testing.assert_allclose(precision[np.ix_(rest, rest)], np.diag(of_signal))


def test_uncertain_terms_of_a_series_are_those_that_can_exist():
    """The covariance grows by the uncertain polynomials and by two terms of a ring."""
    functions = Functions(SIZE, 3, 4, 1)
    uv = image_points(300)
    information, right = observed(functions, uv, np.zeros((300, 2)))
    prior = Prior(SMOOTH, np.full(18, 1e-6))
    prior.trend[2] = 1.0
    covariance = np.linalg.inv(
        information + prior_precision(functions, prior) + 1e-3 * np.eye(len(right))
    )
    found = covariance_of_series(functions, prior, covariance @ right, covariance) - covariance
    m, t = len(functions), functions.trend
    at = np.concatenate([np.arange(t), m + np.arange(t)])
    to_terms = np.zeros((2 * t, 2 * m))
    to_terms[:, at] = trend_transformation(3, 1)[0]
    more = np.diagonal(to_terms @ found @ to_terms.T)
    before = np.diagonal(to_terms @ covariance @ to_terms.T)
    assert (np.delete(more[:16], 2) > 0.3 * np.delete(before[:16], 2)).all()
    assert (more[16:18] < 1e-6 * more[:16].max()).all()


# ---- uncertain signal


def drawn_field(functions, rng):
    """Coefficients (2, s) of a field whose covariance function is drawn as well."""
    signal = Signal(
        float(rng.lognormal(np.log(0.3), 0.7)),
        float(rng.lognormal(np.log(300), 0.4)),
        smoothness=float(rng.lognormal(np.log(SMOOTHNESS), 0.4)),
    )
    return rng.normal(0, 1, (2, len(functions))) * np.sqrt(signal.variance(functions.frequency))


def estimated_prior(functions, information, right):
    """The most likely prior of a signal without a trend."""
    prior = Prior(starting_signal(0.3, max(SIZE)), np.zeros(0))
    for _ in range(30):
        before = prior
        prior = most_likely_prior(
            SeriesEquations(functions, information, right, np.zeros_like(information)), before
        )
        if prior.change(before, functions) < 1e-3:
            break
    return prior


def normalized_squares(functions, error, covariances):
    """Mean squared errors of a field over their claimed variances, for each covariance matrix."""
    values = functions(image_points(200, seed=9))
    at = np.kron(np.eye(2), values)
    return [np.mean((at @ error) ** 2 / np.sum(at @ c * at, axis=1)) for c in covariances]


@pytest.mark.long
@pytest.mark.parametrize(('count', 'too_small'), [(40, (1.3, 1.7)), (400, (0.95, 1.15))])
def test_claims_hold_where_the_signal_is_only_estimated(count, too_small):
    """With few image points, the most likely signal alone understates the errors."""
    functions = Functions(SIZE, -1, 6)
    rng = np.random.default_rng(1)
    uv = image_points(count)
    found = []
    for seed in range(60):
        field = drawn_field(functions, rng)
        information, right = observed(functions, uv, functions(uv) @ field.T, seed)
        prior = estimated_prior(functions, information, right)
        known = np.linalg.inv(information + prior_precision(functions, prior))
        more = covariance_by_signal(
            SeriesEquations(functions, information, right, np.zeros_like(information)), prior
        )
        error = known @ right - field.ravel()
        found.append(normalized_squares(functions, error, (known, known + more)))
    of_known, of_estimated = np.mean(found, axis=0)
    assert too_small[0] < of_known < too_small[1]
    assert of_estimated < of_known
    assert abs(np.log(of_estimated)) < max(0.5 * np.log(of_known), 0.05)


def test_a_series_without_sines_has_no_signal_to_be_estimated():
    """The covariance of the series does not grow."""
    functions = Functions(SIZE, 3, 0)
    information, right = observed(functions, image_points(300), np.zeros((300, 2)))
    prior = Prior(SMOOTH, np.ones(14))
    gauge = np.zeros_like(information)
    assert not covariance_by_signal(
        SeriesEquations(functions, information, right, gauge), prior
    ).any()


# ---- places


def place(middle, variance):
    """A window of 4 x 4 bumps about a centre."""
    axis = 32.0 * (np.arange(4) - 1.5)
    nodes = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2) + middle
    return LocalSignal(nodes, np.zeros(16, dtype=int), np.array([variance]))


def drawn(functions, uv, local, seed=1):
    """A smooth field (n, 2) with a place."""
    rng = np.random.default_rng(seed)
    sd = np.sqrt(SMOOTH.variance(functions.frequency))[:, None]
    coefficients = sd * rng.normal(size=(len(sd), 2))
    heights = rng.normal(0, np.sqrt(local.of_bumps)[:, None], (len(local.nodes), 2))
    return functions(uv) @ (coefficients + bumps(functions, local.nodes) @ heights)


def test_variance_of_a_place_is_the_most_likely_one():
    functions = Functions(SIZE, -1, 16)
    uv = image_points()
    there = place((416.0, 608.0), 0.5)
    information, right = observed(functions, uv, drawn(functions, uv, there))
    gauge = np.zeros_like(information)
    prior = Prior(SMOOTH, np.zeros(0), place((416.0, 608.0), 0.3))
    for _ in range(12):
        prior = most_likely_prior(SeriesEquations(functions, information, right, gauge), prior)

    def at(factor):
        local = replace(prior.local, variances=factor * prior.local.variances)
        return evidence(functions, information, right, replace(prior, local=local))

    assert at(1.0) > max(at(0.8), at(1.25))
    assert abs(at(1.01) - at(0.99)) / 0.02 < 0.05


@pytest.mark.parametrize('of_v', [1.0, 0.3])
def test_more_places_are_those_that_raise_the_likelihood_most(of_v):
    """Also if v is less certain than u. Reference: dense solutions with the first place found."""
    functions = Functions(SIZE, 3, 14)
    uv = image_points(500)
    information, right = observed(functions, uv, np.zeros((500, 2)))
    m, t = len(functions), functions.trend
    local = place((416.0, 608.0), 1.0)
    field = np.random.default_rng(2).normal(0, 3.0, (16, 2))
    truth = np.zeros((m, 2))
    truth[t:] = bumps(functions, local.nodes) @ field
    right = right + information @ truth.T.ravel()
    information[m:, m:] *= of_v
    right[m:] *= of_v
    gauge = 1e-3 * np.eye(2 * m)
    prior = Prior(Signal(0.1, 300.0), np.full(14, 4.0))
    found = with_more_places(SeriesEquations(functions, information, right, gauge), prior).local
    own = found.window == 0
    first = LocalSignal(found.nodes[own], found.window[own], found.variances[:1])
    before = evidence(functions, information + gauge, right, prior)
    gain = evidence(functions, information + gauge, right, replace(prior, local=first)) - before
    assert np.abs(first.nodes.mean(axis=0) - (416.0, 608.0)).max() < 70
    for variance in (0.7, 1.4):
        other = replace(first, variances=variance * first.variances)
        less = evidence(functions, information + gauge, right, replace(prior, local=other))
        assert less - before < gain + 0.01
    beside = replace(first, nodes=first.nodes + [200.0, -200.0])
    assert evidence(functions, information + gauge, right, replace(prior, local=beside)) < before
    # A search with the found places in the prior adds at most one place.
    more = with_more_places(
        SeriesEquations(functions, information, right, gauge), replace(prior, local=found)
    )
    assert len(more.local.variances) <= len(found.variances) + 1


def test_places_that_image_points_show_are_found_with_a_signal_estimated_anew():
    functions = Functions(SIZE, 3, 18)
    uv = image_points(1500)
    square = np.sum((uv - (416.0, 608.0)) ** 2, axis=1, keepdims=True)
    dent = np.exp(-square / (2 * 35.0**2)) * [3.0, -2.0]
    values = dent + np.random.default_rng(5).normal(0, NOISE, dent.shape)
    prior = Prior(SMOOTH, np.full(14, 4.0))
    found = with_shown_places(functions, functions(uv) / NOISE, values / NOISE, prior)
    own = found.local.nodes[found.local.window == 0]
    assert np.abs(own - (416.0, 608.0)).max() < 130
    assert found.signal != prior.signal
    # With known orientations and no prior of the trend, these equations give the solution.
    design = functions(uv) / NOISE
    t = functions.trend
    matrix = design.T @ design
    matrix[np.arange(t), np.arange(t)] += RIDGE * np.max(np.diagonal(matrix))
    precision = signal_precision(functions, found)
    matrix[t:, t:] += precision
    covariance = np.linalg.inv(matrix)
    mean = (covariance @ design.T @ values / NOISE)[t:]
    estimates = SineEstimates.of(precision, mean, covariance[None, t:, t:])
    assert largest_gain(functions, estimates) < 6.0 or len(found.local.variances) > 1
    assert with_shown_places(functions, design, 0 * values, prior) is prior


def test_one_covariance_for_both_coordinates_is_two_that_are_equal():
    functions = Functions(SIZE, -1, 12)
    uv = image_points(400)
    local = place((416.0, 608.0), 0.5)
    design = functions(uv) / NOISE
    precision = np.diag(1 / SMOOTH.variance(functions.frequency))
    covariance = np.linalg.inv(design.T @ design + precision)
    values = drawn(functions, uv, local)
    mean = covariance @ design.T @ values / NOISE
    once, twice = (
        SineEstimates.of(precision, mean, np.stack([covariance] * count)) for count in (1, 2)
    )
    assert largest_gain(functions, once) == pytest.approx(largest_gain(functions, twice))
    less = SineEstimates.of(precision, mean, np.stack([covariance, 0.5 * covariance]))
    assert largest_gain(functions, less) != pytest.approx(largest_gain(functions, once), rel=1e-3)


@pytest.mark.parametrize('size', [(1024, 1024), (1024, 512)])
def test_windows_overlap_by_half(size):
    nodes = _all_nodes(size)
    spacing = size[0] / NODES
    assert len(nodes) == NODES * round(size[1] / spacing)
    np.testing.assert_allclose(nodes.min(axis=0), spacing / 2)
    np.testing.assert_allclose(nodes.max(axis=0), np.array(size) - spacing / 2)
    windows = _windows(size)
    assert len(windows) == (2 * WINDOWS - 1) * (2 * WINDOWS * size[1] // size[0] - 1)
    width = NODES // WINDOWS
    for rows in windows:
        assert len(rows) == width**2
        np.testing.assert_allclose(np.ptp(nodes[rows], axis=0), (width - 1) * spacing)
    corners = np.array([nodes[rows].min(axis=0) for rows in windows])
    assert np.diff(np.unique(corners[:, 0])) == pytest.approx(width / 2 * spacing)
    assert np.diff(np.unique(corners[:, 1])) == pytest.approx(width / 2 * spacing)


def test_bands_are_strips_in_all_directions_that_cover_the_image():
    nodes = _all_nodes(SIZE)
    bands = _bands(SIZE) > 0
    assert bands.any(axis=0).all()
    angle = np.arange(32) * np.pi / 32
    across = nodes @ np.stack([np.cos(angle), np.sin(angle)])
    found = []
    for band in bands[bands.sum(axis=1) >= NODES]:
        width = np.ptp(across[band], axis=0)
        assert width.min() <= 2 * 1.5 * 32.0 + 1e-6
        found.append(np.argmin(width))
    assert (np.bincount(found, minlength=32) >= 15).all()
    # Bands overlap by half: each inner bump lies in two or three bands of every direction.
    number = bands[:, np.abs(nodes - 512).max(axis=1) < 400].sum(axis=0)
    assert 2 * 32 <= number.min() <= number.max() <= 3 * 32


def test_what_sines_leave_out_of_a_place_are_its_short_waves():
    """Reference: square sums of the sines beyond the series, and their correlation."""
    some = Functions(SIZE, -1, 18)
    many = Functions(SIZE, -1, 60)
    local = place((512.0, 512.0), 0.5)
    beyond = many.frequency > some.highest
    energy = np.sum(bumps(many, local.nodes)[beyond] ** 2 @ local.of_bumps)
    axis = np.arange(300.0, 724.0, 6.0)
    uv = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    found = np.sum(local.variance_beyond(some, uv)) * 36.0
    assert found == pytest.approx(energy, rel=0.03)
    middle = local.variance_beyond(some, np.array([[512.0, 512.0], [700.0, 512.0]]))
    assert middle[0] > 100 * middle[1]
    distance = np.array([0.0, 10.0, 25.0, 60.0])
    f = np.linspace(some.highest, 1.0, 20000)
    density = np.exp(-((f * WIDTH * 1024) ** 2)) * f
    expected = [np.sum(density * j0(f * d)) / np.sum(density) for d in distance]
    np.testing.assert_allclose(correlation_beyond(some, distance), expected, atol=0.02)


def test_changes_of_places_are_those_of_their_variances():
    local = place((416.0, 608.0), 0.5)
    assert local.change(local) == 0
    for factor in (0.5, 2.0):
        other = replace(local, variances=factor * local.variances)
        assert local.change(other) == pytest.approx(np.log(2.0))
    assert local.change(None) == np.inf
    two = LocalSignal(
        np.concatenate([local.nodes, local.nodes + 100]),
        np.repeat([0, 1], 16),
        np.array([0.5, 0.1]),
    )
    assert local.change(two) == np.inf
    functions = Functions(SIZE, -1, 8)
    plain = Prior(SMOOTH, np.zeros(0))
    own = replace(plain, local=local)
    assert plain.change(plain, functions) == 0
    assert plain.change(own, functions) == own.change(plain, functions) == np.inf
    stronger = replace(own, local=replace(local, variances=3 * local.variances))
    assert own.change(stronger, functions) == pytest.approx(np.log(3.0))
    louder = replace(own, signal=replace(SMOOTH, sd=2 * SMOOTH.sd, fine_sd=2 * SMOOTH.fine_sd))
    assert own.change(louder, functions) == pytest.approx(np.log(4.0))


def test_renewed_variances_of_places_are_squares_over_what_is_determined():
    nodes = np.zeros((5, 2))
    local = LocalSignal(nodes, np.array([0, 0, 1, 1, 2]), np.array([0.5, 0.2, 0.1]))
    mean = np.array([[0.3, -0.5, 1e-3, 0.0, 0.2], [0.1, 0.2, 0.0, 2e-3, -0.4]])
    variance = np.array([[0.1, 0.2, 0.19, 0.1, 0.05], [0.2, 0.1, 0.15, 0.15, 0.04]])
    found = local.renewed(mean, variance)
    squares = np.sum(mean**2, axis=0)
    determined = np.sum(1 - variance / local.of_bumps, axis=0)
    expected = [squares[:2].sum() / determined[:2].sum(), squares[4] / determined[4]]
    np.testing.assert_allclose(found.variances, expected)
    assert found.window.tolist() == [0, 0, 1]
    assert local.renewed(0 * mean, variance) is None


def candidates(monkeypatch, windows, band=None):
    """Pretend that the image points show exactly these places: (corner [bumps], gain)."""
    nodes = _all_nodes(SIZE)

    def window(corner, gain, variance=0.3):
        inside = np.abs(nodes - 32.0 * (np.array(corner) + 2)).max(axis=1) < 64
        return _Place(np.flatnonzero(inside), gain, variance)

    found = [window(*one) for one in windows]
    shown = SimpleNamespace(
        nodes=nodes, windows=lambda: found, most_likely_band=lambda taken: band and window(*band)
    )
    module = 'fluoro_calib_ros.estimation.local_signal._ShownBumps'
    monkeypatch.setattr(module, SimpleNamespace(of=lambda functions, estimates: shown))
    return lambda local: with_likely_places(Functions(SIZE, -1, 8), None, local)


def corners(local):
    """Windows of places, in order, each given by its first bump."""
    count = len(local.variances)
    first = [local.nodes[local.window == w].min(axis=0) for w in range(count)]
    return [tuple(np.rint((one - 16) / 32).astype(int).tolist()) for one in first]


def test_a_window_beside_a_place_needs_less_gain_than_one_anywhere(monkeypatch):
    """An edge continues; no bump is used twice."""
    windows = [
        ((20, 8), 5.0),  # not next to a place
        ((12, 8), 2.0),  # next to a place
        ((8, 8), 9.0, 0.7),
        ((4, 8), 1.0),  # next to a place, but the gain is too small
        ((10, 10), 8.0),  # some of its bumps are used already
        ((8, 26), 6.5),
        ((12, 12), 3.0),  # at a corner
    ]
    likely = candidates(monkeypatch, windows)
    found = likely(None)
    assert corners(found) == [(8, 8), (8, 26), (12, 12), (12, 8)]
    np.testing.assert_array_equal(found.variances, [0.7, 0.3, 0.3, 0.3])
    assert np.bincount(found.window).tolist() == [16] * 4
    again = likely(found)
    assert again is found
    assert candidates(monkeypatch, [((4, 8), 5.9)])(None) is None


def test_a_band_is_added_alone_where_it_gains_most(monkeypatch):
    """Gains of windows must be computed anew once the band is in the prior."""
    local = place((416.0, 608.0), 0.5)
    for gain, added in ((10.0, [(1, 1)]), (8.0, [(8, 8)]), (5.0, [(8, 8)])):
        found = candidates(monkeypatch, [((8, 8), 9.0)], ((1, 1), gain))(local)
        assert corners(found)[1:] == added
    found = candidates(monkeypatch, [((8, 8), 1.0)], ((1, 1), 5.0))(local)
    assert found is local


def test_the_band_that_gains_most_leaves_out_what_is_taken():
    """Edges along v and along u: once the first is taken, the other one is found."""
    functions = Functions(SIZE, -1, 18)
    uv = image_points(1500, 6)
    field = 0.9 * np.tanh((uv[:, :1] - 400.0) / 5) * [0.6, -0.8]
    field += 0.7 * np.tanh((uv[:, 1:] - 700.0) / 5) * [0.6, -0.8]
    design = functions(uv) / NOISE
    precision = np.diag(1 / SMOOTH.variance(functions.frequency))
    covariance = np.linalg.inv(design.T @ design + precision)
    mean = covariance @ design.T @ (field / NOISE)
    estimates = SineEstimates.of(precision, mean, covariance[None])
    shown = _ShownBumps.of(functions, estimates)
    taken = np.zeros(len(shown.nodes), dtype=bool)
    band = shown.most_likely_band(taken)
    assert np.abs(shown.nodes[band.rows, 0] - 400).mean() < 60
    assert len(band.rows) >= NODES and band.gain > 20
    assert largest_gain(functions, estimates) >= band.gain
    taken[np.abs(shown.nodes[:, 0] - 400) < 130] = True
    other = shown.most_likely_band(taken)
    assert not taken[other.rows].any() and other.gain < band.gain
    assert np.abs(shown.nodes[other.rows, 1] - 700).mean() < 80
    taken[:] = True
    assert shown.most_likely_band(taken) is None


# ---- ripples


def test_variances_of_ripples_are_the_most_likely_ones():
    functions = Functions(SIZE, -1, 16, absent=tuple(range(8, 14)))
    width = functions.frequency_of_mode
    uv = image_points()
    there = Ripples(width, (*[0.0] * 14, 900.0, 300.0, 100.0))
    sd = np.sqrt(
        there.variance(functions.frequency) + Signal(1.0, 600.0).density(functions.frequency)
    )
    coefficients = np.random.default_rng(3).normal(size=(len(sd), 2)) * sd[:, None]
    information, right = observed(functions, uv, functions(uv) @ coefficients)
    gauge = np.zeros_like(information)
    first = Ripples(width, (*[0.0] * 14, 50.0, 50.0, 50.0))
    prior = Prior(Signal(0.8, 500.0, 1e-3, 200.0, ripples=first), np.zeros(0))
    for _ in range(15):
        prior = most_likely_prior(SeriesEquations(functions, information, right, gauge), prior)
    ripples = prior.signal.ripples
    assert ripples.bands == (14, 15, 16)

    def at(band, factor):
        variances = np.array(ripples.variances)
        variances[band] *= factor
        changed = replace(prior.signal, ripples=replace(ripples, variances=tuple(variances)))
        return evidence(functions, information, right, replace(prior, signal=changed))

    for band in ripples.bands:
        assert at(band, 1.0) > max(at(band, 0.8), at(band, 1.25))


def test_ripples_of_a_series_are_mean_squares_beyond_its_complete_bands():
    functions = Functions(SIZE, 3, 12, absent=(6, 7, 8))
    coefficients = np.random.default_rng(4).normal(size=(2, len(functions)))
    found = ripples_of(functions, coefficients)
    assert found.width == functions.frequency_of_mode
    assert found.bands == (9, 10, 11, 12)
    for band in found.bands:
        own = coefficients[:, functions.trend :][:, functions.band == band]
        assert found.variances[band] == pytest.approx(np.mean(own**2))
    full = Functions(SIZE, 3, 12)
    assert ripples_of(full, np.ones((2, len(full)))) is None


def test_a_plausible_signal_is_found_where_the_likelihood_first_grows_and_then_falls_steeply(
    monkeypatch,
):
    """The search had cycled between a more likely signal and the end of the range."""
    likely = Signal(4.0, 327.0, 1e-3, 200.0)

    def cost(signal, _):
        return 2000 * max(np.log(signal.reach / likely.reach) - 0.03, 0.0) ** 2 - 0.2

    monkeypatch.setattr(signal_module, '_cost', cost)
    step = np.array([0.0, 0.033, 0.0, 0.0, 0.0])
    node = signal_module._node(likely, step, None, 0.0, 1024.0)
    assert 1.5 * np.exp(-0.4) < cost(node, None) < 1.5 * np.exp(0.4)
