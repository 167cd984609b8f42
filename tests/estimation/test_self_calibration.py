# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""From networks to results: rounds, choice of models, image point noise, and figures."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import rigs
from sklearn.linear_model import LinearRegression
from sklearn.model_selection import PredefinedSplit, cross_val_predict
from sklearn.tree import DecisionTreeRegressor

from fluoro_calib_ros.correction.neighbours import KnnModel, LocalLinearModel
from fluoro_calib_ros.correction.registry import NoCorrection
from fluoro_calib_ros.correction.series import Functions
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation import alternation, self_calibration
from fluoro_calib_ros.estimation import calibrate as calibrating
from fluoro_calib_ros.estimation.alternation import Regressions, _information
from fluoro_calib_ros.estimation.calibrate import (
    _calibrated_group,
    _image_noise,
    adjust_with_calibrations,
    calibrate_part,
    calibrate_request,
)
from fluoro_calib_ros.estimation.estimator import (
    GaugeKind,
    TrainingPoints,
    exposure_folds,
    gauge_basis,
)
from fluoro_calib_ros.estimation.initial_network import (
    EarlierCalibration,
    StartValues,
    adjusted_with_precision,
)
from fluoro_calib_ros.estimation.neighbour_regression import CrossValidation, NeighbourRegression
from fluoro_calib_ros.estimation.options import (
    CalibrationOptions,
    CalibrationRequest,
    UserRegression,
)
from fluoro_calib_ros.estimation.self_calibration import (
    NoRegression,
    _Job,
    estimator_of,
    self_calibrate,
)
from fluoro_calib_ros.findings import Finding, Kind
from fluoro_calib_ros.photogrammetry.adjustment import adjust
from fluoro_calib_ros.photogrammetry.noise import INLIER_Q, Noise
from fluoro_calib_ros.photogrammetry.precision import geometric_redundancy, precision

SIZE = (640, 480)
INTERIOR = np.array([330.0, 230.0, 2000.0])
PHANTOM = rigs.rig().phantom


def training(count=450, seed=1, noise=0.2):
    rng = np.random.default_rng(seed)
    uv = rng.uniform(0, 1, (count, 2)) * SIZE
    return uv, np.arange(count) % 15, 3 * np.sin(uv / 60) + rng.normal(0, noise, uv.shape)


def step_of(kind, k=None, seed=1, gauge=GaugeKind.FULL, trend=None):
    uv, exposure, values = training(seed=seed)
    return NeighbourRegression(kind, TrainingPoints(uv, exposure, SIZE, gauge, trend), k), values


def chosen(step, values, out=()):
    """Let a step choose k and inliers; out: rows of outliers."""
    q = np.ones(len(values))
    q[list(out)] = 2 * INLIER_Q
    step.choose(values, q, np.tile(np.eye(2), (len(values), 1, 1)))
    return step


# ---- regression between adjustments


@pytest.mark.parametrize('kind', [KnnModel, LocalLinearModel])
def test_noise_of_a_linear_smoother_is_that_of_its_residuals_and_trace(kind):
    """The smoother matrix, by columns (Hastie et al. 2009, 5.5); bias from held-out values."""
    step, values = step_of(kind, 25)
    out = np.arange(0, 450, 45)
    values[out] += 90.0
    chosen(step, values, out)
    inside = step.inliers
    assert inside.sum() == 440
    rows = np.flatnonzero(inside)
    matrix = np.empty((440, 440))
    for column, row in enumerate(rows):
        unit = np.zeros_like(values)
        unit[row] = 1.0
        smoothed = step.smooth(unit)
        np.testing.assert_allclose(smoothed[:, 0], smoothed[:, 1], atol=1e-12)
        matrix[:, column] = smoothed[inside, 0]
    weights = step._weights[inside]
    error2 = np.mean((values[inside] - matrix @ values[inside]) ** 2)
    own = step._index[inside] == rows[:, None]
    trace = np.mean(np.sum(weights * own, axis=1))
    norm2 = np.mean(np.sum(weights**2, axis=1))
    noise2 = error2 / (1 - 2 * trace + norm2)
    found = step.model(values)
    assert found.noise_px == pytest.approx(np.sqrt(noise2))
    if kind is KnnModel:  # without a trend, trace and norm equal those of the whole matrix
        assert trace == pytest.approx(np.trace(matrix) / 440)
        assert norm2 == pytest.approx(np.sum(matrix**2) / 440)
    validation = CrossValidation(
        kind, step.points.uv[inside], exposure_folds(step.points.exposure[inside]), [25]
    )
    held_out = validation.predictions(values[inside])[0]
    bias2 = np.mean((values[inside] - held_out) ** 2) - noise2 * (1 + norm2)
    assert found.bias_px == pytest.approx(np.sqrt(max(bias2, 0)))
    np.testing.assert_array_equal(found.train_uv, step.points.uv[inside])
    np.testing.assert_array_equal(found.train_duv, values[inside])


def test_k_is_looked_for_beyond_that_of_the_last_round():
    """From few to many neighbours and back, with different inliers in every round."""
    step, rough = step_of(KnnModel)
    rng = np.random.default_rng(2)
    noisy = rng.normal(0, 3.0, rough.shape)
    for number, values in enumerate((rough, noisy, rough)):
        chosen(step, values, [number])
        inside = step.inliers
        validation = CrossValidation(
            KnnModel,
            step.points.uv[inside],
            exposure_folds(step.points.exposure[inside]),
            KnnModel.candidate_k(int(inside.sum())),
        )
        scores = validation.scores(values[inside], np.tile(np.eye(2), (int(inside.sum()), 1, 1)))
        assert step.score == pytest.approx(scores.min(), rel=2e-3)
        k = validation.candidates[np.argmin(scores)]
        assert step.k == k or scores[validation.candidates == step.k][0] < 1.001 * scores.min()
        assert (step.k > 40) == (values is noisy)


def test_k_stays_where_another_gains_less_than_a_thousandth():
    step, values = step_of(KnnModel)
    chosen(step, values)
    best = step.k
    step.k = best + 1
    scores = step._validation.scores(values, np.tile(np.eye(2), (len(values), 1, 1)))
    at = {int(k): s for k, s in zip(step._validation.candidates, scores)}
    expected = best + 1 if at[best + 1] <= at[best] * 1.001 else best
    chosen(step, values)
    assert step.k == expected
    step.k = 3
    chosen(step, values)
    assert step.k == best and step.changed


def test_correction_beside_estimated_terms_is_orthogonal_to_all_of_them():
    uv, exposure, values = training()
    trend = Functions(SIZE, 3)(uv)
    points = TrainingPoints(uv, exposure, SIZE, GaugeKind.FULL, trend)
    step = chosen(NeighbourRegression(LocalLinearModel, points, 40), values)
    before = trend.T @ step.smooth(values)
    after = trend.T @ step.smooth(step.without_gauge(values, INTERIOR))
    assert np.abs(after).max() < 1e-6 * np.abs(before).max()
    free = TrainingPoints(uv, exposure, SIZE, GaugeKind.NONE)
    step = chosen(NeighbourRegression(LocalLinearModel, free, 40), values)
    assert step.without_gauge(values, INTERIOR) is values


def test_held_out_predictions_of_some_points_are_those_of_all():
    uv, exposure, values = training()
    fold = exposure_folds(exposure)
    tested = np.arange(5, 450, 7)
    for kind in (KnnModel, LocalLinearModel):
        every = CrossValidation(kind, uv, fold, [12, 30])
        some = CrossValidation(kind, uv, fold, [12, 30], tested=tested)
        np.testing.assert_allclose(
            some.predictions(values), every.predictions(values)[:, tested], atol=1e-9
        )
        np.testing.assert_allclose(
            some.predictions_for(30, values), every.predictions_for(30, values)[tested], atol=1e-9
        )
        information = np.random.default_rng(3).normal(size=(450, 2, 2))
        information = information @ information.transpose(0, 2, 1)
        error = (values - every.predictions(values))[:, tested]
        np.testing.assert_allclose(
            some.scores(values, information),
            np.einsum('kna,nab,knb->k', error, information[tested], error),
        )


def test_no_regression_counts_the_weighted_residuals_of_inliers():
    uv, exposure, values = training()
    step = NoRegression(TrainingPoints(uv, exposure, SIZE, GaugeKind.FULL))
    rng = np.random.default_rng(4)
    information = rng.normal(size=(450, 2, 2))
    q = np.ones(450)
    q[:9] = 2 * INLIER_Q
    step.choose(values, q, information)
    expected = sum(v @ w @ v for v, w in zip(values[9:], information[9:]))
    assert step.score == pytest.approx(expected) and step.inliers.sum() == 441
    assert not step.smooth(values).any() and step.without_gauge(values, INTERIOR) is values
    assert isinstance(step.model(values), NoCorrection) and not step.iterates


class FakeStep:
    """A regression step that halves values and reports given figures."""

    iterates = False

    def __init__(self, k, score, changed):
        self.k = k
        self.given = score
        self.changed = changed
        self.seen = None

    def choose(self, values, q, information):
        if self.given < 0:
            raise ValueError('too few')
        self.seen = values, q, information
        self.score = self.given
        self.inliers = q < 1

    def without_gauge(self, values, interior):
        return values + interior[0]

    def smooth(self, values):
        return values / 2

    def model(self, values, series):
        return values, series


def test_regressions_of_all_fluoroscopes_are_one_smoother():
    network, _ = rigs.small_network(3, 20, 2)
    measured = SimpleNamespace(network=network)
    steps = {'a': FakeStep(5, 10.0, False), 'b': FakeStep(7, 3.0, True)}
    both = Regressions(measured, steps)
    rng = np.random.default_rng(5)
    values, q = rng.normal(size=network.uv.shape), rng.uniform(0, 2, len(network.uv))
    information = rng.normal(size=(len(q), 2, 2))
    assert both.choose(values, q, information) == (13.0, True)
    rows = network.rows(1)
    for given, all_of in zip(steps['b'].seen, (values, q, information)):
        np.testing.assert_array_equal(given, all_of[rows])
    assert both.k == {'a': 5, 'b': 7} and not both.iterate
    np.testing.assert_array_equal(both.inliers(), q < 1)
    np.testing.assert_array_equal(both.smooth(values), values / 2)
    interior = np.array([[1.0, 0, 0], [30.0, 0, 0]])
    moved = both.without_gauge(values, interior) - values
    np.testing.assert_allclose(moved[network.rows(0)], 1.0)
    np.testing.assert_allclose(moved[rows], 30.0)
    parts = [
        SimpleNamespace(fitted_series=lambda after, precise, f=f: f'series {f}') for f in (0, 1)
    ]
    terms = SimpleNamespace(parts=parts)
    models = both.models(values, terms, None, None)
    np.testing.assert_array_equal(models['b'][0], values[rows])
    assert models['b'][1] == 'series 1' and both.models(values, None, None, None)['a'][1] is None
    steps['b'].changed = False
    assert both.choose(values, q, information)[1] is False
    steps['b'].iterates = True
    assert both.iterate
    steps['b'].given = -1.0
    with pytest.raises(DataError, match='fluoroscope b: too few'):
        both.choose(values, q, information)


def test_information_is_that_of_the_residuals_of_an_adjustment():
    network, truth = rigs.small_network(4, 30)
    after = adjust(network, truth, noise=Noise('student_t', 0.3, 9.0))
    information, noise = _information(network, after, np.zeros_like(network.uv))
    expected = np.linalg.inv(precision(network, after).residual)
    np.testing.assert_allclose(information, expected, rtol=1e-6)
    assert noise.scale == pytest.approx(0.3, rel=0.2)


@pytest.mark.parametrize('model', ['knn', 'hybrid'])
def test_correction_of_rounds_is_that_of_their_model_and_estimated_terms(model):
    result = rigs.calibrated('a', 6, model=model, max_iterations=2)
    run = result.runs['a']
    network = run.measured.network
    np.testing.assert_allclose(
        run.models['a'].predict(network.uv)[run.trained], run.correction[run.trained], atol=1e-6
    )
    estimated = network.additional_correction(run.after.parameters)
    assert estimated.any() == (model == 'hybrid')
    np.testing.assert_allclose(run.solved.correction, run.correction - estimated)
    core = run.trained
    change = [one.change for one in run.history]
    assert len(run.history) == 2 and change[1] < change[0] and not run.converged
    assert run.after.noise.scale < 0.4 * run.before.noise.scale
    assert run.history[1].k['a'] == run.models['a'].k
    rmse = np.sqrt(np.mean(run.after.residuals[run.after.inliers] ** 2, axis=0))
    np.testing.assert_allclose(result.fluoroscopes['a'].rmse_after, rmse)
    assert core.sum() > 0.9 * len(core)


def test_a_calibration_whose_last_adjustment_does_not_converge_has_not_converged(monkeypatch):
    def unconverged(*arguments, **options):
        after, precise = adjusted_with_precision(*arguments, **options)
        return replace(after, converged=False), precise

    monkeypatch.setattr(alternation, 'adjusted_with_precision', unconverged)
    frames = {'a': rigs.exposures()['a'][:6]}
    options = CalibrationOptions(model='none')
    assert not calibrating.calibrate(frames, rigs.rig().phantom, options).converged


# ---- user-defined regressors


def user_step(regressor, gauge=GaugeKind.FULL):
    uv, exposure, values = training()
    step = UserRegression(regressor, TrainingPoints(uv, exposure, SIZE, gauge))
    step.without_gauge(values, INTERIOR)
    return chosen(step, values, range(0, 450, 50)), values


def features(uv):
    return (uv - [319.5, 239.5]) / 320


def test_score_of_a_user_regressor_is_that_of_held_out_exposures():
    step, values = user_step(DecisionTreeRegressor(max_depth=4, random_state=1))
    inside = step.inliers
    uv = features(step.points.uv[inside])
    held_out = cross_val_predict(
        DecisionTreeRegressor(max_depth=4, random_state=1),
        uv,
        values[inside],
        cv=PredefinedSplit(exposure_folds(step.points.exposure[inside], 5)),
    )
    error = values[inside] - held_out
    assert step.score == pytest.approx(np.sum(error**2))
    fitted = step.smooth(values)
    model = step.model(values)
    np.testing.assert_allclose(model.predict(step.points.uv), fitted, atol=1e-9)
    inner = np.mean((values - fitted)[inside] ** 2)
    outer = np.mean(error**2)
    assert model.noise_px == pytest.approx(np.sqrt((inner + outer) / 2))
    assert model.bias_px == pytest.approx(np.sqrt(max((outer - inner) / 2, 0)))


def test_score_of_a_user_regressor_of_one_exposure_is_that_of_held_out_points():
    uv, _, values = training()
    points = TrainingPoints(uv, np.zeros(len(uv), dtype=int), SIZE, GaugeKind.FULL)
    step = chosen(UserRegression(LinearRegression(), points), values, range(0, 450, 50))
    inside = step.inliers
    split = PredefinedSplit(np.arange(inside.sum()) % 5)
    held_out = cross_val_predict(
        LinearRegression(), features(uv[inside]), values[inside], cv=split
    )
    assert step.score == pytest.approx(np.sum((values[inside] - held_out) ** 2))


@pytest.mark.parametrize('gauge', [GaugeKind.FULL, GaugeKind.NONE])
def test_correction_of_a_user_regressor_is_without_gauge(gauge):
    step, values = user_step(LinearRegression(), gauge)
    inside = step.inliers
    uv = step.points.uv[inside]
    plain = LinearRegression().fit(features(uv), values[inside]).predict(features(step.points.uv))
    fitted = step.smooth(values)
    if gauge is GaugeKind.NONE:
        np.testing.assert_allclose(fitted, plain, atol=1e-9)
        return
    basis = gauge_basis(step.points.uv, INTERIOR, gauge)
    flat = basis[inside].reshape(-1, 6)
    share = np.linalg.lstsq(flat, plain[inside].ravel(), rcond=None)[0]
    np.testing.assert_allclose(fitted, plain - basis @ share, atol=0.02)
    # Request the first of two fits again, with the gauge of its own round.
    step.without_gauge(values, INTERIOR + [100.0, 0, 0])
    step.smooth(values + 1.0)
    np.testing.assert_array_equal(step.model(values).predict(step.points.uv), fitted)


# ---- selection of the calibrated models


class FakeJobs:
    """Stand-in that records model runs instead of calibrating."""

    def __init__(self, monkeypatch, better=None):
        self.made = []
        monkeypatch.setattr(self_calibration, 'better_model', lambda run, terms: better)
        monkeypatch.setattr(
            self_calibration, '_adjusted_without_correction', lambda measured, options: None
        )
        monkeypatch.setattr(
            self_calibration, 'with_errors_by', lambda one, other, gauges: (one, other)
        )
        monkeypatch.setattr(_Job, 'by_model', lambda job, source, progress: self.run(source.kind))
        monkeypatch.setattr(_Job, 'by_collocation', lambda job, progress: self.collocation())
        self.error = None

    def run(self, kind):
        self.made.append(kind)
        return kind

    def collocation(self):
        if self.error:
            raise self.error
        return self.run('reference'), None

    def of(self, model):
        network, truth = rigs.small_network(3, 20)
        measured = SimpleNamespace(
            network=network, start=truth, fluoroscopes=('a',), known={}, untilted=()
        )
        module_replace = self_calibration.replace
        self_calibration.replace = lambda one, **changes: (
            SimpleNamespace(**{**vars(one), **changes})
            if isinstance(one, SimpleNamespace)
            else module_replace(one, **changes)
        )
        constrained = self_calibration.with_constraints
        self_calibration.with_constraints = lambda measured, options: measured
        try:
            return self_calibrate(measured, CalibrationOptions(model))
        finally:
            self_calibration.replace = module_replace
            self_calibration.with_constraints = constrained


def test_other_models_state_their_errors_by_collocation(monkeypatch):
    jobs = FakeJobs(monkeypatch)
    assert jobs.of('knn') == ('reference', 'knn')
    assert jobs.of('collocation') == 'collocation' and jobs.of('none') == 'none'
    assert jobs.made == ['knn', 'reference', 'collocation', 'none']
    jobs.error = DataError('not enough')
    assert jobs.of('knn') == 'knn'


def test_automatic_choice_is_collocation_unless_another_is_better(monkeypatch):
    jobs = FakeJobs(monkeypatch)
    assert jobs.of('auto') == 'reference'
    jobs = FakeJobs(monkeypatch, 'local_linear')
    assert jobs.of('auto') == ('reference', 'local_linear')


def test_estimators_are_those_of_selectable_models():
    assert estimator_of('collocation').kind == 'collocation'
    assert estimator_of('knn').kind == 'knn' and estimator_of('none').kind == 'none'
    assert estimator_of(LinearRegression()).kind == 'lookup'
    for name in ('lookup', 'auto', 'spline'):
        with pytest.raises(ValueError, match='correction model must be one of'):
            estimator_of(name)


# ---- calibrations and their figures


def grouped(monkeypatch, misfits, exposures=6):
    """The frames used in each repetition of a calibration, and the function that runs it."""
    made = []
    frames = {
        'a': [SimpleNamespace(number=n) for n in range(exposures)],
        'b': [SimpleNamespace(number=n) for n in range(exposures)],
    }
    left = list(misfits)

    def measured_network(frames, phantom, **more):
        made.append({name: [f.number for f in of_one] for name, of_one in frames.items()})
        return SimpleNamespace(excluded=('few',))

    def plain(one, **changes):
        return SimpleNamespace(**{**vars(one), **changes})

    monkeypatch.setattr(calibrating, 'measured_network', measured_network)
    monkeypatch.setattr(
        calibrating, 'self_calibrate', lambda measured, *rest: SimpleNamespace(measured=measured)
    )
    monkeypatch.setattr(calibrating, 'replace', plain)
    monkeypatch.setattr(calibrating, 'exposures_that_do_not_fit', lambda run: left.pop(0))
    request = CalibrationRequest({}, PHANTOM)
    run = _calibrated_group(request, frames, None, None)
    return made, run.measured.excluded


def test_exposures_that_do_not_fit_are_excluded_and_the_rest_calibrated_again(monkeypatch):
    made, excluded = grouped(monkeypatch, [{('a', 2): 'one'}, {('b', 4): 'other'}, {}])
    assert made[0] == {'a': [0, 1, 2, 3, 4, 5], 'b': [0, 1, 2, 3, 4, 5]}
    assert made[1] == {'a': [0, 1, 3, 4, 5], 'b': [0, 1, 2, 3, 4, 5]}
    assert made[2] == {'a': [0, 1, 3, 4, 5], 'b': [0, 1, 2, 3, 5]}
    assert excluded == ('one', 'other', 'few')


def test_so_many_exposures_remain_that_a_calibration_is_possible(monkeypatch):
    made, excluded = grouped(monkeypatch, [{('a', 2): 'one'}], exposures=3)
    assert len(made) == 1 and excluded == ('few',)
    made, excluded = grouped(monkeypatch, [{('a', 2): 'one'}, {}], exposures=4)
    assert len(made) == 2 and excluded == ('one', 'few')


def test_a_calibration_is_repeated_at_most_twice(monkeypatch):
    made, excluded = grouped(monkeypatch, [{('a', n): n} for n in range(9)], exposures=12)
    assert len(made) == 3
    assert excluded == (0, 1, 'few')  # those that the last calibration does not use


def noise_of(loss, nu, between=None):
    """Noise of the image points of the second of two fluoroscopes, its run, and its inliers."""
    network, truth = rigs.small_network(4, 60, 2)
    after = adjust(network, truth, noise=Noise(loss, 0.3, nu))
    precise = precision(network, after)
    measured = SimpleNamespace(network=network, image_size=((1024, 1024),) * 2)
    run = SimpleNamespace(
        after=after,
        precision=precise,
        measured=measured,
        between_exposures={} if between is None else {'b': between},
    )
    rows = network.rows(1)
    rows = rows[after.inliers[rows]]
    return _image_noise(run, 1, 'b'), run, rows


@pytest.mark.parametrize('loss, nu', [('student_t', 8.0), ('student_t', 120.0), ('gaussian', 5.0)])
def test_noise_of_image_points_is_that_of_residuals_over_their_redundancy(loss, nu):
    """With heavy tails, the redundancy is the geometric one."""
    found, run, rows = noise_of(loss, nu)
    square = np.mean(run.after.residuals[rows] ** 2, axis=1)
    if nu == 8.0:
        network = run.measured.network
        redundancy = geometric_redundancy(network, run.after.parameters, run.after.noise)
    else:
        redundancy = run.precision.redundancy.mean(axis=1)
    assert found.sd == pytest.approx(np.sqrt(square.sum() / redundancy[rows].sum()))
    assert noise_of('huber', 5.0)[0].sd == pytest.approx(0.3 * np.sqrt(2.5), rel=0.25)


def test_noise_of_image_points_has_what_exposures_differ():
    plain, _, rows = noise_of('gaussian', 5.0)
    between = np.linspace(0.1, 0.5, len(rows))
    found, _, _ = noise_of('gaussian', 5.0, between)
    assert found.sd**2 == pytest.approx(plain.sd**2 + between.mean())


def test_figures_of_a_calibration_are_those_of_its_adjustment():
    result = rigs.calibrated('a', 6, model='none')
    run = result.runs['a']
    figures = result.fluoroscopes['a']
    precise = run.precision
    np.testing.assert_allclose(figures.interior_sd, np.sqrt(np.diagonal(precise.interior[0])))
    for j, one in enumerate(figures.exposures):
        sd = np.sqrt(np.diagonal(precise.exterior[j]))
        np.testing.assert_array_equal(one.sd_mm, sd[:3])
        np.testing.assert_array_equal(one.sd_rad, sd[3:])
        assert one.exposure == run.measured.frames[j].number
        np.testing.assert_array_equal(one.position_mm, run.after.parameters.position_mm[j])
    assert figures.observations == len(run.after.q)
    assert figures.inliers == run.after.inliers.sum() < figures.observations
    calibration = result.calibrations['a']
    assert (calibration.observations, calibration.inliers) == (
        figures.observations,
        figures.inliers,
    )
    assert calibration.stamp_ns == max(f.stamp_ns for f in rigs.exposures()['a'][:6])
    starts = result.starts
    rotation, position = starts.exterior['a', 2]
    np.testing.assert_allclose(rotation, run.after.parameters.rotation[1], atol=1e-12)
    np.testing.assert_array_equal(position, run.after.parameters.position_mm[1])
    np.testing.assert_array_equal(starts.interior['a'], figures.interior)
    assert result.used_exposures == {'a': {1, 2, 3, 4, 5, 6}}
    assert (result.targets.covariance == run.claims.points).all()
    assert not run.solved.correction.any()


def test_a_part_of_a_calibration_has_the_noise_of_the_whole():
    whole = rigs.calibrated('a', 6, max_iterations=2)
    run = whole.runs['a']
    request = CalibrationRequest(
        {'a': rigs.exposures()['a'][:4]}, PHANTOM, CalibrationOptions(max_iterations=4)
    )
    earlier = EarlierCalibration(
        {'a': run.models['a'].series},
        frozenset(),
        run.after.noise,
        run.measured.target_id,
        run.after.parameters.points_mm,
    )
    starts = StartValues(whole.starts.interior, whole.starts.exterior, earlier)
    found = calibrate_part(request, starts, whole.calibrations)['a']
    calibration = whole.calibrations['a']
    assert (found.image_sd, found.noise_profile) == (
        calibration.image_sd,
        calibration.noise_profile,
    )
    assert found.exposures == 4 and found.model.kind == 'collocation'
    uv = rigs.exposures()['a'][1].uv
    difference = found.model.predict(uv) - calibration.model.predict(uv)
    flat = gauge_basis(uv, found.interior).reshape(2 * len(uv), -1)
    left = difference.ravel() - flat @ np.linalg.lstsq(flat, difference.ravel(), rcond=None)[0]
    assert np.sqrt(np.mean(left**2)) < 1.0
    assert set(earlier.priors) == {'a'}
    assert found.rmse_after.max() < 0.6


def test_an_adjustment_with_starts_has_no_residuals_without_correction():
    calibrations = rigs.calibrated('a', 6, max_iterations=2).calibrations
    frames = {'a': rigs.exposures()['a'][6:9]}
    whole = adjust_with_calibrations(frames, PHANTOM, calibrations)
    again = adjust_with_calibrations(frames, PHANTOM, calibrations, starts=whole.starts)
    one, other = (job.fluoroscopes['a'] for job in (whole, again))
    assert np.isfinite(one.rmse_before).all() and np.isnan(other.rmse_before).all()
    np.testing.assert_allclose(one.rmse_after, other.rmse_after, rtol=1e-4)
    for a, b in zip(one.exposures, other.exposures):
        np.testing.assert_allclose(a.position_mm, b.position_mm, atol=0.05)
        assert (b.sd_mm < a.sd_mm).all()  # excludes the uncertainty of the interior
    sd = np.sqrt(np.diagonal(calibrations['a'].interior_covariance))
    np.testing.assert_allclose(one.interior_sd, sd, rtol=0.05)
    assert not other.interior_sd.any()
    np.testing.assert_array_equal(
        whole.solved['a'].fixed[0], calibrations['a'].interior_covariance
    )
    assert (one.rmse_before > 3 * one.rmse_after).all()


def test_options_that_exclude_each_other_are_refused():
    frames = rigs.exposures()
    soft = CalibrationOptions(relative_orientation='soft')
    with pytest.raises(ValueError, match='needs the joint adjustment'):
        calibrate_request(CalibrationRequest(frames, PHANTOM, soft))
    known = {'a': object()}
    for options in (soft, CalibrationOptions(datum='inner')):
        with pytest.raises(ValueError, match='known orientations exclude'):
            calibrate_request(
                CalibrationRequest(frames, PHANTOM, options, True, known_orientations=known)
            )


def test_findings_of_all_groups_are_in_the_result():
    """So are those of separate adjustments, such as excluded exposures."""
    frames = {name: list(of_one[:5]) for name, of_one in rigs.exposures().items()}
    for name, n in (('a', 1), ('b', 3)):
        small = frames[name][n].rows(np.arange(len(frames[name][n].uv)) < 11)
        frames[name][n] = small
    result = calibrate_request(
        CalibrationRequest(frames, PHANTOM, CalibrationOptions(model='none'))
    )
    places = [(f.place.fluoroscopes, f.place.exposures) for f in result.findings]
    assert places == [(('a',), (2,)), (('b',), (4,))]
    assert all(isinstance(f, Finding) and f.kind is Kind.FEW_TARGETS for f in result.findings)
    points, _ = result.outliers
    assert {p['fluoroscope'] for p in points} <= {'a', 'b'}
    assert [s.fluoroscopes for s in result.statistics] == [('a',), ('b',)]
    assert len(result.residuals.uv) == sum(s.image_points for s in result.statistics)
    assert list(result.history) == list(result.runs) == ['a', 'b']
