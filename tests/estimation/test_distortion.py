# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Correction models, the choice of k, the gauge and the regression step."""

from dataclasses import replace

import numpy as np
import pytest
import rigs
from rigs import create_model
from scipy.spatial import ConvexHull, Delaunay
from scipy.spatial.transform import Rotation
from sklearn.model_selection import GridSearchCV, GroupKFold, PredefinedSplit
from sklearn.neighbors import KNeighborsRegressor

from fluoro_calib_ros.correction.calibration_record import SD_GRID
from fluoro_calib_ros.correction.neighbours import (
    KnnModel,
    LocalLinearModel,
    Neighbourhoods,
    NeighbourTable,
    Trend,
    least_squares_map,
)
from fluoro_calib_ros.correction.registry import MODELS, no_correction
from fluoro_calib_ros.correction.series import Functions, Series
from fluoro_calib_ros.estimation.estimator import (
    GaugeKind,
    TrainingPoints,
    exposure_folds,
    gauge_basis,
    gauge_coefficients,
    gauge_rows,
    interior_about,
)
from fluoro_calib_ros.estimation.neighbour_regression import CrossValidation, NeighbourRegression
from fluoro_calib_ros.photogrammetry.collinearity import project
from fluoro_calib_ros.photogrammetry.noise import INLIER_Q
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector

SIZE = (640, 480)


def training(n=600, seed=0, noise=0.2):
    """Training pixels on an image of SIZE, and corrections with noise."""
    rng = np.random.default_rng(seed)
    uv = rng.uniform(-0.5, np.array(SIZE) - 0.5, (n, 2))
    return uv, 5 * np.sin(uv / 90) + rng.normal(0, noise, uv.shape)


def pixels(n=2000, seed=1):
    """Pixels of the image: random, the corners, the edge, and cell borders of every cell size."""
    rng = np.random.default_rng(seed)
    uv = rng.uniform(-0.5, np.array(SIZE) - 0.5, (n, 2))
    uv[: n // 4] = np.clip(np.round(uv[: n // 4] / 8) * 8 - 0.5, -0.5, np.array(SIZE) - 0.5)
    uv[n // 4 : n // 3, 0] = -0.5
    uv[n // 3 : n // 2, 1] = SIZE[1] - 0.5
    corners = np.array(
        [[-0.5, -0.5], [SIZE[0] - 0.5, -0.5], [-0.5, SIZE[1] - 0.5], np.array(SIZE) - 0.5]
    )
    return np.concatenate([uv, corners])


def random_information(rng, n):
    """Positive definite matrices (n, 2, 2)."""
    a = rng.normal(size=(n, 2, 2))
    return a @ a.transpose(0, 2, 1) + 0.5 * np.eye(2)


# ---- models


@pytest.mark.parametrize('k', [1, 2, 7, 40])
def test_knn_equals_scikit_learn(k):
    uv, duv = training()
    query = pixels()
    theirs = KNeighborsRegressor(k).fit(uv, duv).predict(query)
    np.testing.assert_allclose(
        create_model('knn', k, uv, duv).predict(query), theirs, rtol=0, atol=1e-12
    )


@pytest.mark.parametrize('k', [6, 20, 150])
def test_local_linear_equals_a_weighted_least_squares_plane_for_each_pixel(k):
    """On the remainder of a cubic polynomial: tricube weights, bandwidth to the k-th neighbour."""
    uv, duv = training()
    query = pixels(200)
    powers = [(i, j) for i in range(4) for j in range(4 - i)]

    def cubic(at):
        x = (at - uv.mean(axis=0)) / 300
        return np.stack([x[:, 0] ** i * x[:, 1] ** j for i, j in powers], axis=1)

    coefficients = np.linalg.lstsq(cubic(uv), duv, rcond=None)[0]
    left = duv - cubic(uv) @ coefficients
    expected = cubic(query) @ coefficients
    norms2 = np.empty(len(query))
    for row, q in enumerate(query):
        distance = np.linalg.norm(uv - q, axis=1)
        near = np.argsort(distance)[:k]
        weight = np.sqrt((1 - (distance[near] / distance[near[-1]]) ** 3) ** 3)
        a = np.column_stack([np.ones(k), (uv[near] - q) / distance[near[-1]]])
        at_query = np.linalg.pinv(weight[:, None] * a)[0] * weight
        expected[row] += at_query @ left[near]
        norms2[row] = np.sum(at_query**2)
    model = create_model('local_linear', k, uv, duv, noise_px=2.0)
    # The ridge that makes collinear neighbours harmless is a millionth of the weights.
    wide = k > 6  # five points determine a plane, sometimes badly
    error = np.abs(model.predict(query) - expected).max(axis=1)
    assert (np.max(error) if wide else np.quantile(error, 0.9)) < 1e-3
    if wide:
        np.testing.assert_allclose(model.evaluate(query).sd, 2 * np.sqrt(norms2), rtol=1e-3)


@pytest.mark.parametrize('k', [6, 30, 200])
def test_local_planes_reproduce_planes_beyond_the_edge(k):
    """Without the trend, the weights sum to one and have zero first moment about the pixel."""
    uv, _ = training()
    query = np.concatenate([pixels(100), [[-40.0, -40.0], [700.0, 500.0]]])
    order = np.argsort(np.linalg.norm(uv[None] - query[:, None], axis=2), axis=1)[:, :k]
    weights = LocalLinearModel.weights(Neighbourhoods(uv[order], query), k)
    np.testing.assert_allclose(weights.sum(axis=1), 1, rtol=1e-9)
    reach = np.linalg.norm(uv[order[:, -1]] - query, axis=1)
    plane = np.einsum('nk,nkc->nc', weights, uv[order])
    assert np.median(np.abs(plane - query) / reach[:, None]) < 1e-5
    if k > 6:
        assert np.max(np.abs(plane - query) / reach[:, None]) < 1e-2


def test_local_linear_reproduces_cubic_polynomials():
    """The trend reproduces cubic polynomials exactly, wherever the pixel lies."""
    uv, _ = training(noise=0)
    rng = np.random.default_rng(3)
    coefficients = rng.normal(size=(10, 2))

    def field(at):
        x, y = (at.T - 200) / 300
        return (
            np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=1) @ coefficients
        )

    query = np.concatenate([pixels(300), [[-60.0, -60.0], [760.0, 520.0]]])
    for k in (6, 25, 300):
        model = create_model('local_linear', k, uv, field(uv))
        np.testing.assert_allclose(model.predict(query), field(query), rtol=0, atol=1e-9)


def test_knn_has_no_trend_and_local_linear_a_cubic_one():
    """The mean of neighbours is the model of the paper, which has no trend."""
    assert KnnModel.trend_degree == -1 and len(Trend(-1, training()[0])) == 0
    assert len(Trend(LocalLinearModel.trend_degree, training()[0])) == 10
    assert least_squares_map(np.zeros((5, 0))).shape == (0, 5)


def test_local_linear_is_better_than_the_mean_at_the_edge():
    """Without noise: the mean of neighbours on one side is biased, the plane is not."""
    uv, duv = training(noise=0)
    corner = np.array([[0.0, 0.0], [639.0, 479.0], [0.0, 479.0], [639.0, 0.0]])
    error = {
        kind: np.abs(
            create_model(kind, 20, uv, duv).predict(corner) - 5 * np.sin(corner / 90)
        ).mean()
        for kind in ('knn', 'local_linear')
    }
    assert error['local_linear'] < 0.25 * error['knn']


def test_no_correction_is_zero_and_has_no_outside():
    found = no_correction().evaluate(pixels(50))
    assert not found.duv.any() and not found.sd.any() and not found.outside.any()


@pytest.mark.parametrize(
    'arguments, said',
    [
        (
            ('spline', 5, np.zeros((9, 2)), np.zeros((9, 2))),
            'one of none, knn, local_linear, parametric, hybrid, collocation, lookup, '
            "not 'spline'",
        ),
        (
            ('knn', 10, np.zeros((9, 2)), np.zeros((9, 2))),
            'knn with k = 10 is not possible with 9 training points',
        ),
        (('knn', 0, np.zeros((9, 2)), np.zeros((9, 2))), 'knn with k = 0 is not possible'),
        (
            ('local_linear', 5, np.zeros((9, 2)), np.zeros((9, 2))),
            'local_linear with k = 5 is not possible',
        ),
        (
            ('knn', 1, np.zeros((0, 2)), np.zeros((0, 2))),
            'k = 1 is not possible with 0 training points',
        ),
        (('knn', 2, np.zeros((9, 2)), np.zeros((8, 2))), '9 training points, but 8 corrections'),
        (('knn', 2, np.full((9, 2), np.nan), np.zeros((9, 2))), 'is not a number'),
        (('knn', 2, np.zeros((9, 2)), np.full((9, 2), np.inf)), 'is not a number'),
    ],
)
def test_impossible_model_is_refused(arguments, said):
    with pytest.raises(ValueError, match=said):
        create_model(*arguments)


def test_outside_is_beyond_the_convex_hull():
    rng = np.random.default_rng(4)
    uv = rng.normal([320, 240], 60, (300, 2))
    model = create_model('knn', 3, uv, np.zeros((300, 2)))
    query = pixels()
    wanted = Delaunay(uv).find_simplex(query) < 0
    assert 100 < wanted.sum() < len(query) - 100
    np.testing.assert_array_equal(model.outside(query), wanted)
    inner = uv[np.setdiff1d(np.arange(300), ConvexHull(uv).vertices)]
    assert not model.outside(inner).any()


def test_training_points_on_a_line_enclose_nothing():
    """Every pixel is outside, and predictions stay finite."""
    line = np.column_stack([np.linspace(0, 600, 80), np.linspace(0, 400, 80)])
    model = create_model('local_linear', 12, line, np.sin(line / 50))
    found = model.evaluate(pixels(100))
    assert found.outside.all() and np.isfinite(found.duv).all() and np.isfinite(found.sd).all()


@pytest.mark.parametrize('kind, k', [('knn', 9), ('local_linear', 40)])
def test_standard_deviations_against_monte_carlo(kind, k):
    """Predictions scatter by their standard deviation, to which bias_px is added.

    There are 150 draws of noise in the training values: 2 % for each of 40 predictions and two
    coordinates.
    """
    uv, duv = training(noise=0)
    query = np.random.default_rng(5).uniform([60, 60], [580, 420], (40, 2))
    rng = np.random.default_rng(6)
    found = np.array(
        [
            create_model(kind, k, uv, duv + rng.normal(0, 0.3, duv.shape)).predict(query)
            for _ in range(150)
        ]
    )
    scatter = np.sqrt(found.var(axis=0).mean(axis=1))
    sd = create_model(kind, k, uv, duv, noise_px=0.3).evaluate(query).sd
    assert np.mean(scatter / sd) == pytest.approx(1, abs=0.03)
    np.testing.assert_allclose(scatter / sd, 1, atol=0.15)
    with_bias = create_model(kind, k, uv, duv, noise_px=0.3, bias_px=0.4).evaluate(query).sd
    np.testing.assert_allclose(with_bias, np.hypot(sd, 0.4), rtol=1e-12)


# ---- choice of k


@pytest.mark.parametrize('weighted', [False, True])
def test_scores_of_knn_equal_a_loop_with_scikit_learn(weighted):
    """G for every k with whole exposures as folds, errors weighted by C_r^-1."""
    uv, duv = training(300)
    rng = np.random.default_rng(9)
    information = random_information(rng, 300) if weighted else np.tile(np.eye(2), (300, 1, 1))
    exposure = np.sort(rng.integers(0, 12, 300))
    fold = exposure_folds(exposure, 5)
    candidates = np.arange(1, 30)
    scores = CrossValidation(KnnModel, uv, fold, candidates).scores(duv, information)
    for k, score in zip(candidates, scores):
        total = 0.0
        for f in range(5):
            out = fold == f
            error = duv[out] - KNeighborsRegressor(int(k)).fit(uv[~out], duv[~out]).predict(
                uv[out]
            )
            total += np.einsum('na,nab,nb', error, information[out], error)
        assert score == pytest.approx(total, rel=1e-10)


def test_k_of_knn_is_that_of_grid_search():
    """With the same folds and no weights, k and scores equal those of GridSearchCV."""
    uv, duv = training(300, noise=1.0)
    groups = np.random.default_rng(10).integers(0, 12, 300)
    fold = np.empty(300, dtype=int)
    for number, (_, out) in enumerate(GroupKFold(6).split(uv, groups=groups)):
        fold[out] = number
    candidates = np.arange(1, 41)

    def scorer(estimator, x, y):
        return -np.sum((y - estimator.predict(x)) ** 2)

    search = GridSearchCV(
        KNeighborsRegressor(),
        {'n_neighbors': candidates},
        cv=PredefinedSplit(fold),
        scoring=scorer,
    )
    search.fit(uv, duv)
    scores = CrossValidation(KnnModel, uv, fold, candidates).scores(
        duv, np.tile(np.eye(2), (300, 1, 1))
    )
    np.testing.assert_allclose(scores / 6, -search.cv_results_['mean_test_score'], rtol=1e-10)
    best = candidates[np.argmin(scores)]
    assert best == search.best_params_['n_neighbors'] and 1 < best < 40


def test_scores_of_local_linear_equal_a_loop_with_models():
    """The trend is fitted to the other folds, too: nothing of a held-out exposure is used."""
    uv, duv = training(300)
    rng = np.random.default_rng(11)
    information = random_information(rng, 300)
    fold = exposure_folds(np.repeat(np.arange(15), 20), 5)
    candidates = [10, 24, 60]
    validation = CrossValidation(LocalLinearModel, uv, fold, candidates)
    held_out = np.empty((3, 300, 2))
    for f in range(5):
        out = fold == f
        for number, k in enumerate(candidates):
            held_out[number, out] = create_model('local_linear', k, uv[~out], duv[~out]).predict(
                uv[out]
            )
    np.testing.assert_allclose(validation.predictions(duv), held_out, rtol=0, atol=1e-8)
    np.testing.assert_allclose(validation.predictions_for(24, duv), held_out[1], rtol=0, atol=1e-8)
    error = duv - held_out
    np.testing.assert_allclose(
        validation.scores(duv, information),
        np.einsum('kna,nab,knb->k', error, information, error),
        rtol=1e-8,
    )


def test_folds_hold_whole_exposures():
    exposure = np.random.default_rng(12).integers(0, 23, 500) * 7 + 3
    fold = exposure_folds(exposure)
    assert set(fold) == set(range(10))
    for number in np.unique(exposure):
        assert len(set(fold[exposure == number])) == 1
    per_fold = [len(set(exposure[fold == f])) for f in range(10)]
    assert max(per_fold) - min(per_fold) <= 1
    assert set(exposure_folds(np.array([4, 4, 9, 9]))) == {0, 1}, 'fewer exposures than folds'


def test_candidates_are_limited_by_the_training_points():
    assert KnnModel.candidate_k(2000).tolist() == list(range(3, 101))
    assert KnnModel.candidate_k(50).tolist() == list(range(3, 21))
    steps = LocalLinearModel.candidate_k(2000)
    assert steps[0] == 10 and 300 < steps[-1] <= 400 and (np.diff(steps) > 0).all()
    assert LocalLinearModel.candidate_k(20).tolist() == [8]
    # A fold may have fewer points than a candidate k needs: that candidate is skipped.
    uv, _ = training(30)
    assert CrossValidation(KnnModel, uv, np.arange(30) % 2, [5, 15, 16]).candidates.tolist() == [
        5,
        15,
    ]
    with pytest.raises(ValueError, match='too few for a cross-validation'):
        CrossValidation(KnnModel, uv, np.arange(30) % 2, [16])


# ---- gauge


def test_interior_in_the_gauge_about_another_principal_point():
    """A rotated sensor with a far principal point is the same camera with another correction."""
    axis = np.linspace(0, 1023, 12)
    uv = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    near = np.array([500.0, 530.0, 3800.0])
    far = np.array([-300.0, 1300.0, 3600.0])
    turned = np.column_stack([(uv - near[:2]) / near[2], np.ones(len(uv))])
    turned = turned @ matrix_from_vector([0.2, 0.2, 0.01]).T
    correction = uv - far[:2] - far[2] * turned[:, :2] / turned[:, 2:]
    found = interior_about(near[:2], uv, correction, far)
    assert found == pytest.approx(near, abs=1e-4)
    with pytest.raises(ValueError, match=r'no orientation|finite|NaN'):
        interior_about(near[:2], uv, correction + np.nan, far)


def test_gauge_is_the_effect_of_a_change_of_orientation():
    """To first order, of changes of xp, yp, c and sensor rotations common to all exposures."""
    network, truth = rigs.small_network(exposures=5, targets=40)
    rotation, position, points, interior = network.per_image_point(truth)
    uv = project(rotation, position, points, interior)
    basis = gauge_basis(uv, truth.interior[0])
    assert np.linalg.matrix_rank(basis.reshape(-1, 6)) == 6
    x, y = (uv - truth.interior[0, :2]).T
    changes = [
        project(rotation, position, points, interior + d) - uv for d in np.diag([0.1, 0.1, 0.5])
    ]
    changes += [
        project(matrix_from_vector(w) @ rotation, position, points, interior) - uv
        for w in np.eye(3) * 1e-6
    ]
    for number, change in enumerate(changes):
        coefficients = gauge_coefficients(uv, change, truth.interior[0])
        left = change - basis @ coefficients
        assert np.max(np.abs(left)) < 1e-5 * np.max(np.abs(change)), number
    # Each change has its own component of the gauge, as the docstring of gauge_basis states.
    wanted = [
        np.column_stack([np.ones_like(x), 0 * x]),
        np.column_stack([0 * x, np.ones_like(x)]),
        np.column_stack([x, y]),
        np.column_stack([x * y, y * y]),
        np.column_stack([x * x, x * y]),
        np.column_stack([-y, x]),
    ]
    shifts = {
        3: 1,
        4: 0,
    }  # a rotation about the rows shifts the image down, one about the columns to the right
    for number, (change, want) in enumerate(zip(changes, wanted)):
        a = np.column_stack(
            [want.ravel()] + ([wanted[shifts[number]].ravel()] if number in shifts else [])
        )
        left = change.ravel() - a @ np.linalg.lstsq(a, change.ravel(), rcond=None)[0]
        assert np.max(np.abs(left)) < 1e-5 * np.max(np.abs(change)), number


# ---- the regression step


def regression_of(kind, uv, exposure, gauge=GaugeKind.FULL, k=None):
    """The regression step of a neighbour model."""
    return NeighbourRegression(MODELS[kind], TrainingPoints(uv, exposure, SIZE, gauge), k)


def regressor_and_values(kind='local_linear', gauge=GaugeKind.FULL, k=None, n=600):
    uv, duv = training(n)
    exposure = np.repeat(np.arange(15), n // 15)
    return regression_of(kind, uv, exposure, gauge, k), duv


def chosen(kind='local_linear', gauge=GaugeKind.FULL, k=None):
    """A regression step after its first choice, with 20 outliers, and its values."""
    regressor, values = regressor_and_values(kind, gauge, k)
    q = np.ones(len(values))
    q[::30] = 2 * INLIER_Q
    values[::30] += 500
    regressor.choose(values, q, np.tile(np.eye(2), (len(values), 1, 1)))
    return regressor, values


@pytest.mark.parametrize('kind', [GaugeKind.FULL, GaugeKind.TREND, GaugeKind.TURNS])
def test_the_gauge_is_fixed_in_small_images_as_in_large_ones(kind):
    """A loose tilt of an image of 128 px had made the principal point five times less certain."""
    rng = np.random.default_rng(7)
    uv, values = rng.uniform(0, 1024, (300, 2)), rng.normal(size=(300, 12))
    interior = np.array([480.0, 530, 4100])
    rows = gauge_rows(values, uv, interior, kind)
    for factor in (0.125, 4.0):
        scaled = gauge_rows(values, factor * uv, factor * interior, kind)
        np.testing.assert_allclose(scaled, rows, rtol=1e-6, atol=1e-9 * np.abs(rows).max())


@pytest.mark.parametrize('kind', ['knn', 'local_linear'])
def test_regression_smooths_as_its_model_predicts(kind):
    """The fit uses inliers only and is evaluated at all image points; outliers have no effect."""
    regressor, values = chosen(kind)
    inside = regressor.inliers
    np.testing.assert_array_equal(inside, np.arange(600) % 30 != 0)
    plain = create_model(kind, regressor.k, regressor.points.uv[inside], values[inside])
    np.testing.assert_allclose(
        regressor.smooth(values), plain.predict(regressor.points.uv), rtol=0, atol=1e-9
    )
    np.testing.assert_allclose(
        regressor.model(values).predict(regressor.points.uv),
        plain.predict(regressor.points.uv),
        atol=1e-9,
    )
    assert np.abs(regressor.smooth(values)).max() < 10


def test_model_beside_a_series_is_the_sum_of_both():
    regressor, values = chosen('hybrid')
    coefficients = np.array([[1.0, 30.0, -20.0], [-2.0, 10.0, 40.0]])
    series = Series(Functions(SIZE, 1), coefficients, np.zeros((SD_GRID, SD_GRID)))
    uv = regressor.points.uv
    found = regressor.model(values, series).predict(uv)
    np.testing.assert_allclose(found, regressor.smooth(values) + series.predict(uv), atol=1e-9)


def test_chosen_k_has_the_smallest_score():
    regressor, values = chosen('knn')
    inside = regressor.inliers
    validation = CrossValidation(
        KnnModel,
        regressor.points.uv[inside],
        exposure_folds(regressor.points.exposure[inside]),
        KnnModel.candidate_k(int(inside.sum())),
    )
    scores = validation.scores(values[inside], np.tile(np.eye(2), (int(inside.sum()), 1, 1)))
    assert regressor.k == validation.candidates[np.argmin(scores)] and regressor.changed
    assert regressor.score == pytest.approx(scores.min(), rel=1e-12)


def test_given_k_is_kept():
    for kind in ('knn', 'local_linear'):
        assert chosen(kind, k=17)[0].k == 17


def test_changes_are_reported_and_inliers_have_hysteresis():
    """An outlier returns only when well inside the limit; a repeated round changes nothing."""
    regressor, values = chosen()
    information = np.tile(np.eye(2), (600, 1, 1))
    q = np.where(np.arange(600) % 30 == 0, 2 * INLIER_Q, 1.0)
    regressor.choose(values, q, information)
    assert not regressor.changed
    # near the limit, and well inside
    q[0] = 0.8 * INLIER_Q
    q[30] = 0.4 * INLIER_Q
    values[[0, 30]] -= 500
    regressor.choose(values, q, information)
    assert regressor.changed and not regressor.inliers[0] and regressor.inliers[30]
    with pytest.raises(
        ValueError, match=r'^10 inliers are too few for the correction model, 60 are needed'
    ):
        regressor.choose(values, np.where(np.arange(600) < 11, q, 2 * INLIER_Q), information)


@pytest.mark.parametrize('gauge', [GaugeKind.FULL, GaugeKind.TURNS])
@pytest.mark.parametrize('kind', ['knn', 'local_linear'])
def test_fitted_correction_is_made_orthogonal_to_the_gauge(kind, gauge):
    """To shift, scale and sensor rotations; only to the rotations while the interior orientation
    is fixed.
    """
    interior = np.array([320.0, 240.0, 2000.0])
    regressor, values = chosen(kind, gauge)
    inside = regressor.inliers
    size = [
        np.abs(
            gauge_coefficients(
                regressor.points.uv[inside], regressor.smooth(v)[inside], interior, gauge
            )
        ).max()
        for v in (values, regressor.without_gauge(values, interior))
    ]
    assert size[0] > 0.3 and size[1] < (1e-9 if kind == 'local_linear' else 2e-2) * size[0]


def test_scale_is_part_of_the_correction_while_the_interior_orientation_is_held():
    """The model then learns an error of the principal distance; otherwise the adjustment estimates
    it.
    """
    interior = np.array([320.0, 240.0, 2000.0])
    for gauge, part in ((GaugeKind.TURNS, 1.0), (GaugeKind.FULL, 0.0)):
        regressor, _ = chosen(gauge=gauge)
        scale = 0.01 * (regressor.points.uv - interior[:2])
        kept = regressor.smooth(regressor.without_gauge(scale, interior))
        np.testing.assert_allclose(
            kept - kept.mean(axis=0), part * (scale - scale.mean(axis=0)), atol=0.05
        )


@pytest.mark.parametrize('kind', ['knn', 'local_linear'])
def test_noise_and_bias_of_a_model_are_estimated(kind):
    """Noise of 0.3 px on a plane field gives hardly any bias, a short wave a clear one."""
    rng = np.random.default_rng(13)
    uv = rng.uniform(-0.5, np.array(SIZE) - 0.5, (1500, 2))
    exposure = np.repeat(np.arange(15), 100)
    information = np.tile(np.eye(2), (1500, 1, 1))
    q = np.zeros(1500)
    regressor = regression_of(kind, uv, exposure, False, 40)
    flat = rng.normal(0, 0.3, uv.shape)
    regressor.choose(flat, q, information)
    model = regressor.model(flat)
    assert model.noise_px == pytest.approx(0.3, rel=0.05) and model.bias_px < 0.06
    waves = flat + np.sin(uv / 12)
    regressor.choose(waves, q, information)
    assert regressor.model(waves).bias_px > 0.1


def test_copy_with_other_noise_keeps_the_predictions():
    """replace() keeps the training points: predictions stay, standard deviations scale."""
    model = create_model('local_linear', 20, *training(), noise_px=0.1)
    twice = replace(model, noise_px=0.2)
    query = pixels(50)
    np.testing.assert_array_equal(twice.predict(query), model.predict(query))
    np.testing.assert_allclose(twice.evaluate(query).sd, 2 * model.evaluate(query).sd, rtol=1e-12)


def test_neighbour_table_equals_a_search_among_the_allowed_points():
    """Sorted by distance, also where few points are allowed and after a restriction."""
    uv, _ = training(400)
    rng = np.random.default_rng(14)
    table = NeighbourTable(uv, 12)
    for share in (1.0, 0.8, 0.1):
        allowed = rng.random(400) < share
        rows = rng.permutation(400)[:90]
        near = np.argsort(
            np.where(allowed, np.linalg.norm(uv[rows, None] - uv[None], axis=2), np.inf), axis=1
        )[:, :12]
        np.testing.assert_array_equal(table.nearest(rows, allowed, 12), near)
    kept = rng.random(400) < 0.7
    smaller = table.restricted(kept)
    all_of_it = np.ones(int(kept.sum()), dtype=bool)
    near = np.argsort(np.linalg.norm(uv[kept][:, None] - uv[kept][None], axis=2), axis=1)[:, :30]
    np.testing.assert_array_equal(smaller.nearest(np.arange(kept.sum()), all_of_it, 30), near)


def test_impossible_k_is_refused():
    for kind, k in (('local_linear', 5), ('knn', 581)):
        with pytest.raises(
            ValueError, match=f'{kind} with k = {k} is not possible with 580 inliers'
        ):
            chosen(kind, k=k)


def test_turns_of_the_gauge_are_what_a_camera_sees_that_turns():
    interior = np.array([480.0, 530.0, 2000.0])
    uv = np.random.default_rng(5).uniform(0, 1024, (200, 2))
    rays = np.column_stack([(uv - interior[:2]) / interior[2], np.ones(len(uv))])
    basis = gauge_basis(uv, interior, GaugeKind.TURNS).reshape(2 * len(uv), -1)
    for axis in np.eye(3):
        turned = rays @ Rotation.from_rotvec(1e-6 * axis).as_matrix().T
        moved = interior[:2] + interior[2] * turned[:, :2] / turned[:, 2:] - uv
        left = moved.ravel() - basis @ np.linalg.lstsq(basis, moved.ravel())[0]
        assert np.abs(left).max() < 1e-5 * np.abs(moved).max()
