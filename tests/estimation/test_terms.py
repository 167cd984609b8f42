# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Terms of a distortion in the adjustment: equations, changes, refinements and series."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import rigs
from scipy.linalg import block_diag

from fluoro_calib_ros.correction.series import Functions, Series
from fluoro_calib_ros.estimation import refinements
from fluoro_calib_ros.estimation.collocation import CollocationTerms, EarlierTerms
from fluoro_calib_ros.estimation.estimator import (
    AdjustmentProblem,
    GaugeKind,
    coefficients_of,
    exposure_folds,
    gauge_basis,
    gauge_coefficients,
    gauge_rows,
    interior_about,
)
from fluoro_calib_ros.estimation.exposure_terms import ExposureTerms, exposure_functions
from fluoro_calib_ros.estimation.fluoroscope_terms import MIN_START_SD_PX, FluoroscopeTerms
from fluoro_calib_ros.estimation.lack_of_fit import FittedPoints
from fluoro_calib_ros.estimation.parametric import ExpertTerms, StepwiseTerms
from fluoro_calib_ros.estimation.priors import Prior, covariance_of_series, prior_precision
from fluoro_calib_ros.estimation.refinements import (
    GAP_FROM,
    LOCAL_MODES,
    START_MODES,
    AgreeingOutliers,
    Change,
    Solution,
    places,
    ripples,
)
from fluoro_calib_ros.estimation.ripples import Ripples
from fluoro_calib_ros.estimation.self_calibration import adjust_with_terms
from fluoro_calib_ros.estimation.signal import Signal
from fluoro_calib_ros.photogrammetry.adjustment import adjust
from fluoro_calib_ros.photogrammetry.elimination import factorize
from fluoro_calib_ros.photogrammetry.noise import Noise
from fluoro_calib_ros.photogrammetry.normal_equations import normal_equations
from fluoro_calib_ros.photogrammetry.precision import precision, solved_additional

SIZE = (1024, 1024)
NOISE = Noise('gaussian', 0.3)


def zeros_of(terms):
    """Coefficients of no correction, by fluoroscope."""
    return tuple(np.zeros(part.count) for part in terms.parts)


def problem_of(network, before, gauge=GaugeKind.FULL):
    count = network.n_fluoroscopes
    return AdjustmentProblem(network, [SIZE] * count, before, (gauge,) * count)


def case(modes=6, fluoroscopes=1, exposures=6, targets=50, **options):
    """A small network, its adjustment, and terms of collocation for it."""
    network, truth = rigs.small_network(exposures, targets, fluoroscopes, **options)
    before = adjust(network, truth, noise=NOISE)
    return network, before, CollocationTerms(problem_of(network, before), modes)


def with_own(terms, size_px=0.5):
    """Give each fluoroscope terms of its exposures."""
    for part in terms.parts:
        functions = exposure_functions(part.uv, SIZE, part.interior)
        part.own = ExposureTerms(functions, part.exposure, size_px)


def solved(network, before, terms):
    """Network with the terms, its adjustment and its factorized normal matrix."""
    varying = terms.with_additional(network)
    parameters = replace(before.parameters, additional=zeros_of(terms))
    after = adjust(varying, parameters, noise=NOISE)
    return (
        varying,
        after,
        factorize(varying, normal_equations(varying, after.parameters, 0.0, NOISE)),
    )


# ---- gauge


@pytest.mark.parametrize('kind', GaugeKind)
def test_rows_of_the_gauge_give_its_part_of_a_series(kind):
    rng = np.random.default_rng(1)
    uv = rng.uniform(0, 1024, (300, 2))
    interior = np.array([480.0, 530.0, 2000.0])
    values = Functions(SIZE, 3, 4)(uv)
    ratios = []
    for _ in range(2):
        coefficients = rng.normal(size=(2, values.shape[1]))
        field = values @ coefficients.T
        found = gauge_rows(values, uv, interior, kind) @ coefficients.ravel()
        if kind is GaugeKind.TREND:
            expected = gauge_coefficients(uv, field, interior, kind)
        else:
            expected = np.einsum('nag,na->g', gauge_basis(uv, interior, kind), field) / len(uv)
        ratios.append(found / expected)
    # The rows have the unit of the extent of the points.
    np.testing.assert_allclose(ratios[0], ratios[1], rtol=1e-6)
    assert (np.abs(np.log(ratios[0])) < 0.1).all()


def test_gauge_of_a_cubic_trend_is_that_of_the_best_cubic_polynomial():
    """Affinity and decentring are not part of the gauge, though not orthogonal to it."""
    rng = np.random.default_rng(2)
    interior = np.array([480.0, 530.0, 2000.0])
    uv = rng.uniform(0, 700, (400, 2))  # not centred on the principal point
    x, y = (uv - interior[:2]).T / 512
    brown = np.stack([x * (x * x + y * y) + 3 * x * x + y * y, y * (x * x + y * y) + 2 * x * y], 1)
    affine = np.stack([x + 0.3 * y, -y + 0.3 * x], axis=1)
    part = np.array([0.5, -0.2, 1.5, 0.3, -0.4, 0.7])
    field = brown + affine + gauge_basis(uv, interior) @ part
    found = gauge_coefficients(uv, field, interior, GaugeKind.TREND)
    np.testing.assert_allclose(found, part, atol=1e-9)
    assert np.abs(gauge_coefficients(uv, field, interior) - part).max() > 0.1


def test_no_orientation_is_about_another_point_where_image_points_come_to_lie_behind():
    """The corrections mirror the image."""
    axis = np.linspace(0, 1023, 8)
    uv = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    interior = np.array([511.5, 511.5, 1000.0])
    with pytest.raises(ValueError, match='no orientation'):
        interior_about(np.array([1111.5, 511.5]), uv, 2 * (uv - 511.5), interior)


def test_image_points_of_a_single_exposure_are_dealt_out():
    assert exposure_folds(np.full(7, 4), 3).tolist() == [0, 1, 2, 0, 1, 2, 0]
    assert exposure_folds(np.array([4, 4, 9, 2, 9]), 2).tolist() == [1, 1, 0, 0, 0]


# ---- equations of the terms of one fluoroscope


@pytest.mark.parametrize('own', [False, True])
def test_equations_of_a_series_are_those_of_all_unknowns_without_its_prior(own):
    """Solving them with another prior gives the result of the adjustment with that prior."""
    network, before, terms = case(modes=4, fluoroscopes=2)
    if own:
        with_own(terms)
    varying, after, matrix = solved(network, before, terms)
    found = solved_additional(matrix, varying, after)
    part = terms.parts[1]
    equations = part.equations(varying, matrix, found[1])
    stronger = replace(part.prior, signal=Signal(0.05, 300.0))
    precision_of = prior_precision(part.functions, stronger) + part.gauge
    expected = np.linalg.solve(equations.information + precision_of, equations.right)
    part.prior = stronger
    varying, after, matrix = solved(network, before, terms)
    again = solved_additional(matrix, varying, after)[1][part.of_series]
    scale = np.abs(again).max()
    np.testing.assert_allclose(expected / scale, again / scale, atol=2e-3)
    assert np.abs(found[1][part.of_series] - again).max() > 0.05 * scale


def test_equations_have_the_part_of_the_weights_that_is_information():
    network, before, terms = case(modes=0)
    varying, _, matrix = solved(network, before, terms)
    part = terms.parts[0]
    zero = np.zeros(part.count)
    plain = part.equations(varying, matrix, zero)
    reduced = part.equations(varying, replace(matrix, information_factor=0.8), zero)
    np.testing.assert_allclose(reduced.information, 0.8 * plain.information)
    ones = np.ones(part.count)
    right = part.equations(varying, matrix, ones).right
    prior = varying.additional[0].precision
    np.testing.assert_allclose(right, (plain.information + prior) @ ones, rtol=1e-6)


def test_terms_start_with_the_noise_of_the_residuals_but_no_less():
    network, truth = rigs.small_network(4, 40, noise_px=2.0)
    before = adjust(network, truth, noise=Noise('gaussian', 2.0))
    uv = network.uv.copy()
    problem = problem_of(network, before)
    part = FluoroscopeTerms.first(problem, 0, 4)
    inliers = before.inliers
    rms = np.sqrt(np.mean(before.residuals[inliers] ** 2))
    assert part.prior.signal.sd == pytest.approx(0.3 * rms)
    quiet = replace(problem, before=replace(before, residuals=0 * uv))
    assert FluoroscopeTerms.first(quiet, 0, 4).prior.signal.sd == pytest.approx(
        0.3 * MIN_START_SD_PX
    )
    assert FluoroscopeTerms.first(quiet, 0, 4).functions.rings == 2
    assert FluoroscopeTerms.first(quiet, 0, 0).functions.rings == 0


def test_values_are_weighted_by_the_noise_of_their_points():
    network, _, terms = case(modes=0)
    part = terms.parts[0]
    values = np.ones((len(part.uv), 3))
    np.testing.assert_allclose(part.weighted(values, 0.5)[:, 1], 2.0 / network.sigma)


def test_terms_continue_an_earlier_series_with_its_most_likely_prior():
    network, before, _ = case()
    functions = Functions(SIZE, 3, 12, absent=(5, 6, 7, 8))
    rng = np.random.default_rng(3)
    short = functions.band > 8
    sd = np.where(short, 20.0, np.sqrt(Signal(1.0, 300.0).variance(functions.frequency)))
    coefficients = np.concatenate(
        [rng.normal(0, 2.0, (2, 10)), sd * rng.normal(size=(2, len(sd)))], axis=1
    )
    every = Functions(SIZE, 3, 12)
    whole = every.converted(functions, coefficients.ravel()).reshape(2, -1)
    series = Series(every, whole, np.zeros((33, 33)))
    problem = problem_of(network, before)
    part, found = FluoroscopeTerms.continued(problem, 0, series, None)
    assert part.functions == replace(functions, rings=2)
    np.testing.assert_allclose(part.correction(found), series.predict(part.uv), atol=1e-9)
    assert part.prior.signal.ripples.bands == (9, 10, 11, 12)
    given = Prior(Signal(0.4, 200.0), np.ones(22))
    same, _ = FluoroscopeTerms.continued(problem, 0, series, given)
    assert same.prior is given
    polynomial = Series(Functions(SIZE, 3), rng.normal(size=(2, 10)), np.zeros((33, 33)))
    plain, found = FluoroscopeTerms.continued(problem, 0, polynomial, given)
    assert plain.functions.rings == 0
    np.testing.assert_allclose(plain.correction(found), polynomial.predict(plain.uv), atol=1e-9)


def test_series_of_terms_is_without_those_of_exposures_and_with_its_uncertain_terms():
    network, before, terms = case(modes=4)
    with_own(terms)
    varying, after, _ = solved(network, before, terms)
    precise = precision(varying, after)
    part = terms.parts[0]
    coefficients = after.parameters.additional[0]
    end = 2 * len(part.functions)
    assert part.of_series == slice(end) and part.count == end + part.own.count
    found = terms.parts[0].fitted_series(after, precise)
    uv = part.uv[:40]
    field = part.functions(uv) @ coefficients[:end].reshape(2, -1).T
    # Rings that do not exist are excluded.
    np.testing.assert_allclose(found.predict(uv), field, atol=1e-3)
    assert found.functions.degree == 3
    covariance = covariance_of_series(
        part.functions, part.prior, coefficients[:end], precise.additional[0][:end, :end]
    )
    design = block_diag(*[part.functions(np.array([[511.5, 511.5]]))] * 2)
    sd = np.sqrt(np.trace(design @ covariance @ design.T) / 2)
    assert found.sd_at(np.array([[511.5, 511.5]]))[0] == pytest.approx(sd, rel=1e-6)
    part.prior.trend[14] = 1.0
    assert terms.parts[0].fitted_series(after, precise).functions.degree == 7
    with pytest.raises(ValueError, match='no terms were estimated for fluoroscope number 0'):
        part.fitted_series(after, replace(precise, additional=(None,)))


def test_functions_have_the_bands_of_ripples_beside_their_complete_ones():
    _, _, terms = case(modes=6)
    part = terms.parts[0]
    width = part.functions.frequency_of_mode
    signal = replace(part.prior.signal, ripples=Ripples(width, (*[0.0] * 11, 3.0, 4.0)))
    prior = replace(part.prior, signal=signal)
    assert part.functions_with(8, prior).absent == (9, 10)
    assert part.functions_with(8, prior).modes == 12
    assert (
        part.functions_with(14, prior).absent == () and part.functions_with(14, prior).modes == 14
    )
    assert part.functions_with(9, part.prior) == replace(part.functions, modes=9)
    rng = np.random.default_rng(5)
    before = rng.normal(size=part.count)
    field = part.correction(before)
    part.prior = prior
    after = part.use_modes(8, before)
    assert len(after) == part.count and part.functions.absent == (9, 10)
    np.testing.assert_allclose(part.correction(after), field, atol=1e-9)


def test_what_terms_leave_out_is_their_signal_beyond_the_complete_sines():
    _, _, terms = case(modes=6)
    part = terms.parts[0]
    part.prior = replace(part.prior, signal=Signal(0.8, 150.0))
    (left,) = part.left_out()
    highest = part.functions.highest
    expected = part.prior.signal.sd_beyond(highest) ** 2
    np.testing.assert_allclose(left.variance(part.uv[:2]), [expected] * 2)
    distance = np.array([0.0, 20.0, 50.0])
    np.testing.assert_allclose(
        left.correlation(distance), part.prior.signal.correlation_beyond(highest, distance)
    )
    network, before, flat = case(modes=0)
    assert flat.parts[0].left_out() == ()
    zeros = flat.parts[0].variance_between_exposures(
        network, before, SimpleNamespace(additional=(None,))
    )
    assert zeros.tolist() == [0.0] * before.inliers.sum()


def test_variance_between_exposures_is_that_of_their_terms():
    network, before, terms = case(modes=0, fluoroscopes=2, free=False)
    rng = np.random.default_rng(6)
    with_own(terms)
    part = terms.parts[1]
    drawn = rng.normal(0, np.sqrt(np.tile(part.own.variance, part.own.exposures)))
    uv = network.uv.copy()
    uv[part.rows] += rigs.values_by_exposure(part.own) @ drawn
    network = replace(network, uv=uv)
    varying, after, _ = solved(network, before, terms)
    precise = precision(varying, after)
    found = terms.parts[1].variance_between_exposures(varying, after, precise)
    assert len(found) == after.inliers[part.rows].sum()
    assert 0.5 < np.mean(found) / np.mean((rigs.values_by_exposure(part.own) @ drawn) ** 2) < 1.3
    part._angle_fit = SimpleNamespace(remaining=0.25)
    less = terms.parts[1].variance_between_exposures(varying, after, precise)
    np.testing.assert_allclose(less, 0.25 * found)


# ---- changes of the terms


class Proposed:
    """A refinement that proposes changes once."""

    def __init__(self, changes):
        self.changes = changes

    def propose(self, solution):
        changes, self.changes = self.changes, {}
        return changes


def test_a_change_of_the_terms_continues_with_the_same_correction():
    network, before, terms = case(modes=5, fluoroscopes=2)
    varying, after, matrix = solved(network, before, terms)
    functions = exposure_functions(terms.parts[1].uv, SIZE, terms.parts[1].interior)
    own = ExposureTerms(functions, terms.parts[1].exposure, 0.3)
    signal = Signal(0.3, 222.0)
    given = np.arange(1.0, 1.0 + 2 * len(terms.parts[0].functions_with(4, terms.parts[0].prior)))
    wide = Prior(Signal(3.0, 222.0), np.ones(22))
    changes = {
        0: Change(4, Prior(signal, np.ones(22)), coefficients=given),
        1: Change(7, wide, own=own),
    }
    terms._refinements = [Proposed(changes)]
    fields = [part.correction(c) for part, c in zip(terms.parts, coefficients_of(after))]
    settled, coefficients = terms.renew(varying, matrix, after)
    assert not settled
    assert [part.functions.modes for part in terms.parts] == [4, 7]
    assert terms.parts[0].prior.signal is signal and terms.parts[1].own is own
    assert coefficients[0].tolist() == given.tolist()
    np.testing.assert_allclose(terms.parts[1].correction(coefficients[1]), fields[1], atol=1e-9)
    assert len(coefficients[1]) == terms.parts[1].count
    assert not coefficients[1][terms.parts[1].of_series.stop :].any()
    assert [part.own for part in terms.parts] == [None, own]


def test_other_terms_follow_what_the_prior_excludes():
    """A radial term of 1.5 px is given up: the sines take over, and the correction stays."""
    _, before, terms = case(modes=16, exposures=8, targets=300)
    part = terms.parts[0]
    signal = Signal(1.0, 300.0)
    part.prior = replace(part.prior, signal=signal)  # whose trend has no rings
    coefficients = np.zeros(part.count)
    radial = [len(part.functions.powers), len(part.functions) + len(part.functions.powers) + 1]
    coefficients[radial] = 1.5
    field = part.correction(coefficients)
    found = part.likely_coefficients(coefficients, before)
    assert np.abs(found[radial]).max() < 1e-3
    change = part.correction(found) - field
    assert np.sqrt(np.mean(change**2)) < 0.1 * np.sqrt(np.mean(field**2))
    assert part.likely_coefficients(found, before) is found


def test_terms_of_exposures_stay_where_the_series_is_given_anew():
    """Agreeing rejected image points may be found after terms of exposures were added."""
    network, before, terms = case(modes=5)
    part = terms.parts[0]
    functions = exposure_functions(part.uv, SIZE, part.interior)
    part.own = ExposureTerms(functions, part.exposure, 0.3)
    terms._start = zeros_of(terms)
    varying, after, matrix = solved(network, before, terms)
    present = coefficients_of(after)[0]
    given = np.arange(1.0, 1.0 + 2 * len(part.functions_with(4, part.prior)))
    terms._refinements = [Proposed({0: Change(4, coefficients=given)})]
    _, (coefficients,) = terms.renew(varying, matrix, after)
    end = part.of_series.stop
    assert coefficients[:end].tolist() == given.tolist()
    assert np.abs(coefficients[end:]).max() > 0.01
    assert coefficients[end:].tolist() == present[-part.own.count :].tolist()
    assert len(coefficients) == part.count == terms.with_additional(network).additional[0].count


def test_priors_stay_after_two_renewals_that_change_nothing():
    network, before, terms = case(modes=4)
    terms._refinements = []
    settled = []
    for _ in range(15):
        varying, after, matrix = solved(network, before, terms)
        last = terms.priors[0]
        settled.append(terms.renew(varying, matrix, after)[0])
    assert settled[-3:] == [True] * 3 and not settled[0]
    first = settled.index(True)
    assert all(settled[first:])
    assert terms.priors[0] is last  # the prior is not updated any more


def test_terms_of_an_earlier_calibration_start_with_its_series():
    network, before, _ = case(fluoroscopes=2)
    rng = np.random.default_rng(7)
    functions = Functions(SIZE, 3, 6)
    series = [
        Series(functions, rng.normal(0, 3.0, (2, len(functions))), np.zeros((33, 33)))
        for _ in range(2)
    ]
    given = Prior(Signal(0.4, 200.0), np.ones(22))
    terms = CollocationTerms(
        problem_of(network, before), earlier=EarlierTerms(series, [given, None], True)
    )
    for part, own, start in zip(terms.parts, series, terms.start()):
        np.testing.assert_allclose(part.correction(start), own.predict(part.uv), atol=1e-6)
    assert terms.priors[0] is given and terms.priors[1] is not given
    assert terms.final_tolerance == 1e-3
    assert [part.place_searches for part in terms.parts] == [0, 4]
    kinds = [type(one).__name__ for one in terms._refinements]
    assert kinds == ['NumberOfSines', 'AgreeingOutliers', 'Once', 'Once']
    plain = CollocationTerms(
        problem_of(network, before), earlier=EarlierTerms(series, [given, given], False)
    )
    assert [type(one).__name__ for one in plain._refinements] == kinds[:2]


# ---- refinements by residuals


def plane_wave(uv, wavelength):
    return np.sin(2 * np.pi / wavelength * (uv @ [0.6, 0.8]))[:, None] * [0.6, -0.4]


def solution_with(terms, network, before, residuals, coefficients=None):
    """A steady solution with given residuals (N, 2) and coefficients."""
    additional = coefficients or zeros_of(terms)
    q = np.sum(residuals**2, axis=1) / (0.3 * network.sigma) ** 2
    after = replace(
        before,
        residuals=residuals,
        q=q,
        parameters=replace(before.parameters, additional=additional),
    )
    return Solution(terms.parts, after, [None] * len(terms.parts), True)


def many_points(modes):
    """Terms of a network with many image points."""
    network, truth = rigs.small_network(12, 160, seen=0.9, seed=2)
    network = replace(network, sigma=np.ones(len(network.uv)))
    before = adjust(network, truth, noise=NOISE)
    return network, before, CollocationTerms(problem_of(network, before), modes)


def test_ripples_of_residuals_are_proposed_beside_the_complete_sines():
    network, before, terms = many_points(10)
    noise = np.random.default_rng(8).normal(0, 0.1, network.uv.shape)
    assert not ripples(solution_with(terms, network, before, noise))
    residuals = plane_wave(network.uv, 110.0) + noise
    (change,) = ripples(solution_with(terms, network, before, residuals)).values()
    band = 2 * 1.3 * 1024 / 110.0
    found = change.prior.signal.ripples
    assert min(found.bands) < band < max(found.bands) and change.modes == 10
    assert change.prior.signal.sd == terms.parts[0].prior.signal.sd


def test_ripples_that_sines_have_followed_are_proposed_in_their_place():
    """Sines beyond those of a smooth field are removed; its short part starts anew."""
    network, before, terms = many_points(28)
    part = terms.parts[0]
    rng = np.random.default_rng(9)
    noise = rng.normal(0, 0.05, network.uv.shape)
    long = part.functions.band <= GAP_FROM
    wave = plane_wave(network.uv, 110.0)
    values = part.functions(part.uv)
    ridge = 1e-4 * np.eye(values.shape[1])
    followed = np.linalg.solve(values.T @ values + ridge, values.T @ (0.8 * wave)).T
    followed[:, part.functions.trend :][:, long] += rng.normal(0, 40.0, (2, long.sum()))
    residuals = wave - values @ (followed * np.r_[np.ones(part.functions.trend), ~long]).T + noise
    start = solution_with(terms, network, before, residuals, (followed.ravel(),))
    (change,) = ripples(start).values()
    found = change.prior.signal
    band = 2 * 1.3 * 1024 / 110.0
    assert change.modes == GAP_FROM
    assert min(found.ripples.bands) < band < max(found.ripples.bands)
    assert len(found.ripples.bands) < 9 and found.fine_sd == pytest.approx(1e-3)
    whole = found.ripples
    alone = refinements._shown_ripples(
        part, part.inliers(start.adjustment), wave + noise, GAP_FROM
    ).alone()
    for b in range(int(band), int(band) + 2):
        assert whole.variances[b] == pytest.approx(alone.variances[b], rel=0.15)


def dent(uv, place, size_px=(3.0, -2.0)):
    square = np.sum((uv - place) ** 2, axis=1, keepdims=True)
    return np.exp(-square / (2 * 45.0**2)) * size_px


def test_a_place_that_residuals_show_is_proposed_with_its_sines():
    network, before, terms = many_points(12)
    part = terms.parts[0]
    noise = np.random.default_rng(10).normal(0, 0.1, network.uv.shape)
    assert not places(solution_with(terms, network, before, noise))
    middle = np.median(network.uv, axis=0)
    # The correction already contains a part of the dent.
    values = part.functions(part.uv)
    whole = dent(network.uv, middle, (0.9, -0.6))
    followed = np.linalg.lstsq(values, whole, rcond=1e-6)[0].T
    residuals = whole - values @ followed.T + noise
    changes = places(solution_with(terms, network, before, residuals, (followed.ravel(),)))
    change = changes[0]
    local = change.prior.local
    own = local.nodes[local.of_bumps > 0.5 * local.variances.max()]
    assert np.linalg.norm(own.mean(axis=0) - middle) < 80
    assert change.modes == LOCAL_MODES


def test_places_are_looked_for_with_the_weights_of_the_adjustment(monkeypatch):
    rng = np.random.default_rng(12)
    uv, residuals = rng.uniform(0, 600, (9, 2)), rng.normal(size=(9, 2))
    q, sigma = rng.uniform(0, 3, 9), rng.uniform(0.5, 2, 9)
    inside = np.arange(9) != 4
    adjustment = SimpleNamespace(
        noise=NOISE,
        q=q[::-1],
        inliers=inside[::-1],
        residuals=residuals[::-1],
        parameters=SimpleNamespace(additional=(0.01,)),
    )
    part = SimpleNamespace(
        number=0,
        functions=Functions((640, 640), -1, 4),
        rows=np.arange(9)[::-1],
        sigma=sigma,
        uv=uv,
        prior='given',
        correction=lambda coefficients: coefficients * uv,
    )
    told = []

    def shown(functions, weighted, observed, prior):
        told.append((functions, weighted, observed, prior))
        return SimpleNamespace(local=None)

    monkeypatch.setattr(refinements, 'with_shown_places', shown)
    solution = SimpleNamespace(adjustment=adjustment, parts=[part])
    assert not places(solution)
    ((functions, weighted, observed, prior),) = told
    assert functions.modes == LOCAL_MODES and prior == 'given'
    root = np.sqrt(NOISE.weight(q)) / (NOISE.scale * sigma)
    np.testing.assert_allclose(observed, ((residuals + 0.01 * uv) * root[:, None])[inside])
    np.testing.assert_allclose(weighted, (functions(uv) * root[:, None])[inside])


@cache
def rejected_dent(far=False):
    """Terms, and a solution that rejects the image points of a dent."""
    network, before, terms = many_points(12)
    middle = np.median(network.uv, axis=0)
    residuals = np.random.default_rng(11).normal(0, 0.1, network.uv.shape)
    near = np.linalg.norm(network.uv - middle, axis=1) < 45
    residuals[near] += [40.0, -30.0] if far else [3.0, -4.0]
    return near, terms, solution_with(terms, network, before, residuals)


def test_rejected_points_that_agree_are_followed_once():
    near, terms, there = rejected_dent()
    assert not there.adjustment.inliers[near].any()
    refinement = AgreeingOutliers()
    assert refinement.propose(replace(there, is_steady=False)) == {}
    (change,) = refinement.propose(there).values()
    assert change.modes == LOCAL_MODES
    part = terms.parts[0]
    functions = part.functions_with(LOCAL_MODES, change.prior)
    coefficients = change.coefficients
    assert len(coefficients) == 2 * len(functions)
    field = functions(part.uv) @ coefficients.reshape(2, -1).T
    assert np.sqrt(np.mean((field - [3.0, -4.0])[near] ** 2)) < 1.2
    away = np.linalg.norm(part.uv - np.median(part.uv, axis=0), axis=1) > 200
    assert np.sqrt(np.mean(field[away] ** 2)) < 0.3
    assert refinement.propose(there) == {}


def test_points_that_were_restored_before_are_no_evidence_for_another():
    near, terms, there = rejected_dent()
    refinement = AgreeingOutliers()
    assert refinement.propose(there)
    network = terms.network
    distance = np.linalg.norm(network.uv - np.median(network.uv, axis=0), axis=1)
    residuals = there.adjustment.residuals.copy()
    residuals[np.argmin(np.where(near, np.inf, distance))] = [3.0, -4.0]
    again = solution_with(terms, network, there.adjustment, residuals)
    assert np.sum(again.adjustment.inliers != there.adjustment.inliers) == 1
    assert refinement.propose(again) == {}


def test_rejected_points_far_beyond_any_correction_are_no_error_of_it():
    """They are off by forty standard deviations."""
    _, _, there = rejected_dent(far=True)
    assert AgreeingOutliers().propose(there) == {}


def test_what_is_followed_is_the_posterior_with_the_proposed_prior():
    near, terms, there = rejected_dent()
    part = terms.parts[0]
    values = there.adjustment.residuals
    used = np.ones(len(near), dtype=bool)
    used[::7] = False
    prior, found = refinements._followed(part, 15, values, used, 0.3)
    functions = part.functions_with(15, prior)
    design = functions(part.uv[used]) / 0.3
    gauge = part.gauge_of(functions(part.uv))
    normal = block_diag(*[design.T @ design] * 2) + prior_precision(functions, prior) + gauge
    right = (design.T @ values[used] / 0.3).T.ravel()
    expected = np.linalg.solve(normal, right)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(found / scale, expected / scale, atol=1e-5)
    assert prior.local is not None


def test_terms_of_exposures_that_follow_an_angle_have_those_of_the_interior():
    """Modes do not exceed the initial number; one exposure, or too many, get no terms."""
    rng = np.random.default_rng(12)
    exposures = 8
    uv = rng.uniform(0, 1024, (100 * exposures, 2))
    exposure = np.repeat(np.arange(exposures), 100)
    interior = np.array([511.5, 511.5, 4000.0])
    functions = exposure_functions(uv, SIZE, interior)
    change = rng.normal(0, 0.3, (exposures, 14))
    residuals = np.einsum('nak,nk->na', functions, change[exposure])
    residuals += rng.normal(0, 0.1, uv.shape)

    def proposed(angles, modes, numbers=exposure):
        part = SimpleNamespace(
            number=0,
            uv=uv,
            image_size=SIZE,
            interior=interior,
            rows=np.arange(len(uv)),
            exposure=numbers,
            angles=angles,
            gauge_kind=GaugeKind.FULL,
            functions=SimpleNamespace(complete=modes),
            inliers=lambda adjustment: FittedPoints(uv, residuals, numbers),
        )
        there = SimpleNamespace(parts=[part], adjustment=None)
        return refinements.exposure_terms(there).get(0)

    known = proposed(np.linspace(-1, 1, exposures), 10)
    assert known.own.count == 17 * exposures and known.modes == 10
    unknown = proposed(np.full(exposures, np.nan), 40)
    assert unknown.own.count == 14 * exposures
    assert unknown.modes == START_MODES
    assert proposed(np.zeros(0), 40, np.arange(len(uv)) // 13) is None
    assert proposed(np.zeros(0), 40, np.zeros(len(uv), dtype=int)) is None


# ---- expert terms


def bent(network, field):
    return replace(network, uv=network.uv + field(network.uv))


def radial_and_spiral(uv):
    x, y = ((uv - 511.5) / 512).T
    square = (x * x + y * y)[:, None]
    return 4.0 * square * np.stack([x, y], axis=1) + 2.0 * square * np.stack([-y, x], axis=1)


def stepwise(network, before, gauge=GaugeKind.FULL):
    terms = StepwiseTerms(problem_of(network, before, gauge))
    _, after, converged = adjust_with_terms(network, before, terms, 40, lambda *_: None)
    return terms, after, converged


def test_expert_terms_of_a_distortion_are_selected():
    network, truth = rigs.small_network(8, 70, noise_px=0.2)
    network = replace(network, sigma=np.ones(len(network.uv)))
    network = bent(network, radial_and_spiral)
    before = adjust(network, truth, noise=Noise('student_t', 0.3, 20.0))
    terms, after, converged = stepwise(network, before)
    names = {name for name, there in zip(terms.names, terms.parts[0].selected) if there}
    assert converged and {'radial 1', 'spiral 1'} <= names and len(names) <= 4
    coefficients = after.parameters.additional[0]
    assert not np.abs(coefficients[~terms.parts[0].selected]).max() > 1e-6
    covariance = np.diag(np.where(terms.parts[0].selected, 1e-2, 0.0))
    series = terms.parts[0].fitted_series(after, SimpleNamespace(additional=(covariance,)))
    error = series.predict(network.uv) - radial_and_spiral(network.uv)
    flat = gauge_basis(network.uv, after.parameters.interior[0]).reshape(error.size, -1)
    left = error.ravel() - flat @ np.linalg.lstsq(flat, error.ravel(), rcond=None)[0]
    assert np.sqrt(np.mean(left**2)) < 0.06
    drawn = np.random.default_rng(13).normal(0, 0.1, (3000, 31)) * terms.parts[0].selected
    at = np.array([[511.5, 511.5], [255.5, 767.5]])
    values = np.einsum(
        'nm,pam->pna',
        terms.parts[0].functions(at),
        terms.parts[0].to_polynomials.reshape(31, 2, -1),
    )
    scatter = np.sqrt(np.mean(np.var(np.einsum('kp,pna->kna', drawn, values), axis=0), axis=1))
    np.testing.assert_allclose(series.sd_at(at), scatter, rtol=0.05)


def test_terms_of_no_distortion_are_hardly_any():
    network, truth = rigs.small_network(8, 70, noise_px=0.2, seed=5)
    before = adjust(network, truth, noise=Noise('student_t', 0.3, 20.0))
    terms, _, _ = stepwise(network, before)
    assert terms.parts[0].selected.sum() <= 1


@pytest.mark.parametrize('gauge, count', [(GaugeKind.FULL, 31), (GaugeKind.NONE, 37)])
def test_expert_terms_are_without_the_gauge_unless_orientations_are_known(gauge, count):
    network, truth = rigs.small_network(4, 60)
    before = adjust(network, truth, noise=NOISE)
    terms = StepwiseTerms(problem_of(network, before, gauge))
    values = terms.parts[0].values
    assert values.shape == (len(network.uv), 2, count) and len(terms.names) == count
    basis = gauge_basis(network.uv, before.parameters.interior[0]).reshape(values.shape[0] * 2, -1)
    part = np.linalg.lstsq(basis, values.reshape(len(basis), -1), rcond=None)[0]
    orthogonal = np.abs(part[:, :31]).max() < 1e-9
    assert orthogonal == (gauge is GaugeKind.FULL)
    functions = terms.parts[0].functions(network.uv)
    for t in (0, 7, 30):
        matrix = terms.parts[0].to_polynomials[t].reshape(2, -1)
        np.testing.assert_allclose(functions @ matrix.T, values[:, :, t], atol=1e-9)
    assert [len(c) for c in terms.start()] == [count]


def test_terms_that_were_not_estimated_have_no_series():
    network, truth = rigs.small_network(4, 60)
    before = adjust(network, truth, noise=NOISE)
    terms = StepwiseTerms(problem_of(network, before))
    zero, covariance = terms.start()[0], np.eye(31)
    for given, known in ((None, covariance), (zero, None)):
        after = SimpleNamespace(parameters=SimpleNamespace(additional=(given,)))
        with pytest.raises(ValueError, match='no terms were estimated for fluoroscope number 0'):
            terms.parts[0].fitted_series(after, SimpleNamespace(additional=(known,)))


def expert_step(network, before, selected):
    """Terms with a selection, and the inputs of a step at their solution."""
    terms = StepwiseTerms(problem_of(network, before))
    terms.parts[0].selected[selected] = True
    varying, after, matrix = solved(network, before, terms)
    return terms, varying, after, matrix


def test_a_term_that_is_not_significant_is_rejected_for_good():
    network, truth = rigs.small_network(8, 70, noise_px=0.2)
    network = replace(bent(network, radial_and_spiral), sigma=np.ones(len(network.uv)))
    before = adjust(network, truth, noise=NOISE)
    terms, varying, after, matrix = expert_step(network, before, [0, 3, 12])
    own = precision(varying, after).additional[0][np.ix_([0, 3, 12], [0, 3, 12])]
    t = np.abs(after.parameters.additional[0][[0, 3, 12]]) / np.sqrt(np.diagonal(own))
    assert t[:2].min() > 10 and t[2] < 3.5
    settled, _ = terms.renew(varying, matrix, after)
    assert not settled
    assert np.flatnonzero(terms.parts[0].selected).tolist() == [0, 3]
    assert np.flatnonzero(terms.parts[0]._rejected).tolist() == [12]


def test_the_term_with_the_largest_statistic_is_added():
    """That term raises the likelihood most once it is estimated with those selected."""
    network, truth = rigs.small_network(8, 70, noise_px=0.2)
    network = replace(bent(network, radial_and_spiral), sigma=np.ones(len(network.uv)))
    before = adjust(network, truth, noise=NOISE)
    terms, varying, after, matrix = expert_step(network, before, [0])
    terms.renew(varying, matrix, after)
    (added,) = np.setdiff1d(np.flatnonzero(terms.parts[0].selected), [0])
    costs = {}
    for one in (added, *(k for k in (3, 4, 12, 20) if k != added)):
        costs[one] = solved(network, before, expert_step(network, before, [0, one])[0])[1].cost
    assert min(costs, key=costs.get) == added


def test_change_by_a_term_is_that_of_the_adjustment_with_it(monkeypatch):
    """The selected terms and all other unknowns adapt to it."""
    network, truth = rigs.small_network(8, 70, noise_px=0.2)
    network = replace(bent(network, radial_and_spiral), sigma=np.ones(len(network.uv)))
    before = adjust(network, truth, noise=NOISE)
    selected = [0, 8, 12]
    terms, varying, after, matrix = expert_step(network, before, selected)
    tried = []

    def improves(self, result, change, t):
        tried.append((change, t))
        return True

    monkeypatch.setattr(ExpertTerms, '_improves', improves)
    monkeypatch.setattr(ExpertTerms, '_remove_insignificant', lambda *_: False)
    assert not terms.renew(varying, matrix, after)[0]
    (added,) = np.setdiff1d(np.flatnonzero(terms.parts[0].selected), selected)
    more = solved(network, before, expert_step(network, before, [*selected, added])[0])
    field = [one.additional_correction(r.parameters) for one, r, _ in ((varying, after, 0), more)]
    ((change, t),) = tried
    assert np.abs(change - (field[1] - field[0])).max() < 0.02 * np.abs(change).max()
    own = precision(*more[:2]).additional[0][added, added]
    assert abs(t) == pytest.approx(
        abs(more[1].parameters.additional[0][added]) / np.sqrt(own), rel=0.01
    )
    assert 2 * (after.cost - more[1].cost) == pytest.approx(t**2, rel=0.02)


def test_trend_of_residuals_is_their_product_with_those_about():
    network, truth = rigs.small_network(4, 40)
    before = adjust(network, truth, noise=NOISE)
    terms = StepwiseTerms(problem_of(network, before))
    rng = np.random.default_rng(14)
    residuals = rng.normal(size=network.uv.shape)
    core = rng.random(len(residuals)) < 0.8
    inside = residuals * core[:, None]
    total = 0.0
    for i, at in enumerate(network.uv):
        near = np.argsort(np.linalg.norm(network.uv - at, axis=1))[1:9]
        total += inside[i] @ inside[near].mean(axis=0)
    assert terms.parts[0]._trend(residuals, core) == pytest.approx(total / len(residuals))


def test_a_significant_term_stays_if_it_reduces_the_rmse_or_the_trend():
    network, truth = rigs.small_network(8, 70)
    before = adjust(network, truth, noise=NOISE)
    terms = StepwiseTerms(problem_of(network, before))
    wave = np.sin(network.uv / 100.0)
    noise = np.random.default_rng(15).normal(0, 0.3, network.uv.shape)
    after = replace(before, residuals=wave + noise)
    square = np.sum(after.q[after.inliers])
    small, large = (np.sqrt(square * (1 - (1 - part) ** 2)) for part in (0.9e-3, 1.1e-3))
    assert terms.parts[0]._improves(after, wave, small)  # reduces the trend
    assert not terms.parts[0]._improves(after, -wave, small)
    assert terms.parts[0]._improves(after, -wave, large)  # reduces the RMSE
