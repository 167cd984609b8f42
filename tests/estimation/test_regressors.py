# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The regressors: scikit-learn's checks, agreement with the models, and user-defined ones."""

import inspect
import json
import unittest
from dataclasses import replace

import numpy as np
import pytest
import rigs
from sklearn.linear_model import LinearRegression
from sklearn.model_selection import GroupKFold, cross_val_predict, cross_val_score
from sklearn.neighbors import KNeighborsRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import PolynomialFeatures
from sklearn.tree import DecisionTreeRegressor

from fluoro_calib_ros.correction.neighbours import KnnModel, LocalLinearModel
from fluoro_calib_ros.correction.registry import (
    MODELS,
    LookupModel,
    grid_nodes,
    hull_corners,
    model_from_values,
)
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation.calibrate import calibrate
from fluoro_calib_ros.estimation.estimator import gauge_coefficients
from fluoro_calib_ros.estimation.neighbour_regression import CrossValidation
from fluoro_calib_ros.estimation.options import CalibrationOptions, regressor_name, resolve_model
from fluoro_calib_ros.estimation.regressors import KnnRegressor, LocalLinearRegressor
from fluoro_calib_ros.io.calibration import load_calibration, save_calibration
from fluoro_calib_ros.io.calibration_request import read_options
from fluoro_calib_ros.io.observations import write_observations_csv
from fluoro_calib_ros.io.phantom import write_phantom

SIZE = (640, 480)
REGRESSORS = [(KnnModel, KnnRegressor), (LocalLinearModel, LocalLinearRegressor)]

# Neighbours are counted, not weighted: a sample of weight 2 is one, two samples are two.
COUNTED = 'k is a number of samples, whatever their weights'
EXPECTED_FAILURES = {
    KnnRegressor: {
        'check_sample_weight_equivalence_on_dense_data': COUNTED,
        'check_sample_weight_equivalence_on_sparse_data': COUNTED,
    },
    LocalLinearRegressor: {'check_sample_weight_equivalence_on_dense_data': COUNTED},
}


def training(n=600, seed=0, noise=0.2):
    """Training pixels on an image of SIZE, corrections with noise, and 15 exposures."""
    rng = np.random.default_rng(seed)
    uv = rng.uniform(-0.5, np.array(SIZE) - 0.5, (n, 2))
    return uv, 5 * np.sin(uv / 90) + rng.normal(0, noise, uv.shape), np.arange(n) % 15


def failed_checks_of_old_version(regressor):
    """Names of the scikit-learn checks that an estimator fails."""
    from sklearn.utils.estimator_checks import check_estimator

    failed = set()
    for estimator, check in check_estimator(regressor(), generate_only=True):
        try:
            check(estimator)
        except unittest.SkipTest:
            pass
        except AssertionError:
            failed.add(check.func.__name__)
    return failed


@pytest.mark.parametrize('regressor', [KnnRegressor, LocalLinearRegressor])
def test_regressors_pass_check_estimator(regressor):
    from sklearn.utils.estimator_checks import check_estimator  # slow to load

    if 'expected_failed_checks' not in inspect.signature(check_estimator).parameters:
        failed = failed_checks_of_old_version(regressor)  # before scikit-learn 1.6
        assert failed <= {'check_sample_weights_invariance'}
        return
    results = check_estimator(
        regressor(), expected_failed_checks=EXPECTED_FAILURES[regressor], on_skip=None
    )
    failed = {r['check_name'] for r in results if r['status'] == 'xfail'}
    assert failed == set(EXPECTED_FAILURES[regressor]), 'an exception is not needed any more'
    assert sum(r['status'] == 'passed' for r in results) > 40


@pytest.mark.parametrize('model, regressor', REGRESSORS)
@pytest.mark.parametrize('k', [7, 40])
def test_regressor_and_model_give_the_same_numbers(model, regressor, k):
    uv, duv, _ = training()
    query = np.random.default_rng(1).uniform(-30, 650, (500, 2))
    fitted = regressor(n_neighbors=k).fit(uv, duv)
    np.testing.assert_allclose(
        fitted.predict(query), model(k, uv, duv).predict(query), rtol=0, atol=1e-6
    )


@pytest.mark.parametrize('k', [1, 5, 60])
@pytest.mark.parametrize('options', [{}, {'weights': 'distance'}, {'metric': 'manhattan'}])
def test_the_faster_search_gives_the_numbers_of_scikit_learn(k, options):
    uv, duv, _ = training()
    query = np.random.default_rng(2).uniform(-30, 650, (500, 2))
    ours = KnnRegressor(k, **options).fit(uv, duv)
    theirs = KNeighborsRegressor(k, **options).fit(uv, duv)
    assert (ours._scipy_tree is not None) == (not options)
    np.testing.assert_allclose(ours.predict(query), theirs.predict(query), rtol=0, atol=1e-12)


@pytest.mark.parametrize('regressor', [KnnRegressor, LocalLinearRegressor])
def test_sample_of_weight_zero_is_ignored(regressor):
    uv, duv, _ = training()
    weight = np.random.default_rng(3).choice([0.0, 2.0], len(uv))
    weighted = regressor(10).fit(uv, duv, sample_weight=weight)
    rest = regressor(10).fit(uv[weight > 0], duv[weight > 0])
    np.testing.assert_allclose(weighted.predict(uv), rest.predict(uv), rtol=0, atol=1e-9)


def test_neighbours_count_by_their_sample_weights():
    """Compare means, trend and planes with weighted least squares."""
    uv, duv, _ = training(200)
    rng = np.random.default_rng(8)
    weight = rng.uniform(0.2, 3.0, 200)
    query = rng.uniform(0, SIZE, (20, 2))
    mean = KnnRegressor(9).fit(uv, duv, sample_weight=weight).predict(query)
    plane = LocalLinearRegressor(40, 1).fit(uv, duv, sample_weight=weight).predict(query)
    basis = np.column_stack([np.ones(200), uv])
    root = np.sqrt(weight)[:, None]
    trend = np.linalg.lstsq(root * basis, root * duv, rcond=None)[0]
    for row, at in enumerate(query):
        distance = np.linalg.norm(uv - at, axis=1)
        near = np.argsort(distance)[:9]
        np.testing.assert_allclose(mean[row], np.average(duv[near], axis=0, weights=weight[near]))
        near = np.argsort(distance)[:40]
        kernel = (1 - (distance[near] / distance[near[-1]]) ** 3) ** 3 * weight[near]
        own = np.sqrt(kernel)[:, None]
        left = duv[near] - basis[near] @ trend
        fit = np.linalg.lstsq(own * np.column_stack([np.ones(40), uv[near] - at]), own * left)[0]
        expected = np.append(1.0, at) @ trend + fit[0]
        np.testing.assert_allclose(plane[row], expected, atol=1e-4)


def test_regressors_of_one_output_and_of_few_samples():
    uv, duv, _ = training(50)
    for regressor in (KnnRegressor, LocalLinearRegressor):
        both = regressor(7).fit(uv, duv).predict(uv)
        one = regressor(7).fit(uv, duv[:, 0]).predict(uv)
        np.testing.assert_allclose(one, both[:, 0], atol=1e-9)
    few = LocalLinearRegressor(90, None).fit(uv, duv)
    assert few.n_neighbors_ == 50 and np.isfinite(few.predict(uv)).all()
    with pytest.raises(ValueError):
        KnnRegressor(51).fit(uv, duv).predict(uv)
    with pytest.raises(ValueError, match='n_neighbors must be at least 1, not 0'):
        LocalLinearRegressor(0).fit(uv, duv)
    alike = LocalLinearRegressor(4, None).fit(
        np.array([[0, 1], [1, 0], [0, -1], [-1.0, 0]]), duv[:4]
    )
    np.testing.assert_allclose(alike.predict([[0.0, 0.0]]), duv[:4].mean(axis=0, keepdims=True))


@pytest.mark.parametrize('model, regressor', REGRESSORS)
def test_cross_validation_with_whole_exposures_held_out(model, regressor):
    """cross_val_predict with GroupKFold gives the predictions of our cross-validation."""
    uv, duv, exposure = training(300)
    fold = np.empty(300, dtype=int)
    for number, (_, held_out) in enumerate(GroupKFold(5).split(uv, groups=exposure)):
        fold[held_out] = number
    theirs = cross_val_predict(regressor(20), uv, duv, groups=exposure, cv=GroupKFold(5))
    ours = CrossValidation(model, uv, fold, [20]).predictions(duv)[0]
    np.testing.assert_allclose(theirs, ours, rtol=0, atol=1e-6)
    scores = cross_val_score(
        regressor(20),
        uv,
        duv,
        groups=exposure,
        cv=GroupKFold(5),
        scoring='neg_mean_squared_error',
    )
    expected = [np.mean((duv - ours)[fold == number] ** 2) for number in range(5)]
    np.testing.assert_allclose(-scores, expected, rtol=1e-6)


# ---- the lookup model


def lookup_model(size=(100, 60)):
    """A model with a grid of values of a bilinear function, calibrated on a part of it."""
    rng = np.random.default_rng(4)
    inside = rng.uniform([20, 10], [70, 50], (200, 2))
    uv = np.concatenate([grid_nodes(size), hull_corners(inside)])
    duv = np.stack([0.1 * uv[:, 0] - 2, 0.01 * uv[:, 0] + 0.2 * uv[:, 1]], axis=1)
    return LookupModel(0, uv, duv, 0.3, 0.1), inside


def test_lookup_is_bilinear_and_keeps_the_calibrated_area():
    model, inside = lookup_model()
    query = np.random.default_rng(5).uniform(-0.5, [99.5, 59.5], (400, 2))
    expected = np.stack([0.1 * query[:, 0] - 2, 0.01 * query[:, 0] + 0.2 * query[:, 1]], axis=1)
    np.testing.assert_allclose(model.predict(query), expected, atol=1e-9)
    np.testing.assert_array_equal(
        model.outside(query), KnnModel(1, inside, np.zeros_like(inside)).outside(query)
    )
    assert (model.evaluate(query).sd == 0.1).all()
    again = model_from_values(model.to_values(), (100, 60))
    assert again.predict(query).tobytes() == model.predict(query).tobytes()


@pytest.mark.parametrize('change', ['no points', 'shuffled', 'one column', 'uneven'])
def test_lookup_without_a_grid_is_refused(change):
    model, _ = lookup_model()
    uv = model.train_uv.copy()
    if change == 'no points':
        uv = uv[:0]
    if change == 'shuffled':
        uv = np.random.default_rng(6).permutation(uv)
    if change == 'one column':
        uv[:, 0] = 5.0
    if change == 'uneven':
        uv[uv[:, 0] == uv[1, 0], 0] += 1.0
    with pytest.raises(ValueError, match='lookup do not begin with a grid'):
        replace(model, train_uv=uv, train_duv=np.zeros_like(uv))


# ---- a user's own regressor


def cubic():
    """A regressor as a user would write it."""
    return make_pipeline(PolynomialFeatures(5), LinearRegression())


def calibrated_with(model, **options):
    frames = {'a': rigs.exposures()['a'][:8]}
    return calibrate(frames, rigs.rig().phantom, CalibrationOptions(model, **options))


@pytest.mark.long
def test_calibration_with_a_user_regressor(tmp_path):
    """It converges, is orthogonal to the gauge, and is saved as a lookup grid."""
    result = calibrated_with(cubic())
    calibration = result.calibrations['a']
    run = result.runs['a']
    assert result.converged and calibration.model.kind == 'lookup'
    without = rigs.calibrated('a', 8, model='none').calibrations['a']
    assert calibration.rmse_after.max() < 0.5 * without.rmse_after.max()
    assert 0 < calibration.model.bias_px < calibration.model.noise_px < 0.5
    uv = run.measured.network.uv
    np.testing.assert_allclose(calibration.model.predict(uv), run.correction, atol=1e-9)
    part = gauge_coefficients(
        uv[run.trained], run.correction[run.trained], run.after.parameters.interior[0]
    )
    assert np.max(np.abs(part)) < 0.01  # fitted values are several px
    loaded = load_calibration(save_calibration(str(tmp_path), calibration))
    assert loaded.calibration_id == calibration.calibration_id
    query = np.random.default_rng(7).uniform(-0.5, 1023.5, (3000, 2))
    for exact in (False, True):
        ours = calibration.correct(query, exact=exact)
        theirs = loaded.correct(query, exact=exact)
        assert ours.uv.tobytes() == theirs.uv.tobytes()
        assert ours.status.tobytes() == theirs.status.tobytes()
    inside = KnnModel(1, uv[run.trained], np.zeros_like(uv[run.trained]))
    np.testing.assert_array_equal(loaded.model.outside(query), inside.outside(query))
    assert 0 < loaded.model.outside(query).mean() < 0.5
    assert loaded.grid.error_px < 1e-9 and loaded.grid.cell_px == 8


@pytest.mark.long
def test_random_regressor_gives_reproducible_results():
    """A single-output regressor with random_state=None is seeded, and fitted once per output."""
    regressor = DecisionTreeRegressor(max_features=1, min_samples_leaf=10)
    one, other = (calibrated_with(regressor, max_iterations=1).calibrations['a'] for _ in range(2))
    assert one.calibration_id == other.calibration_id
    assert regressor.random_state is None


def test_user_regressor_is_named_by_module_and_class():
    found = resolve_model('sklearn.tree:DecisionTreeRegressor')
    assert isinstance(found, DecisionTreeRegressor)
    assert resolve_model('knn') == 'knn'
    assert isinstance(resolve_model('test_regressors:cubic'), type(cubic()))
    assert CalibrationOptions(found).to_document()['model'] == regressor_name(found)


@pytest.mark.parametrize(
    'name, message',
    [
        ('no_such_module:Class', "model 'no_such_module:Class' cannot be imported"),
        ('sklearn.tree:Nothing', 'cannot be imported'),
        (':Class', 'cannot be imported'),
        ('sklearn.multioutput:MultiOutputRegressor', 'cannot be made without arguments'),
        ('collections:OrderedDict', 'is not a scikit-learn regressor'),
    ],
)
def test_name_that_is_no_regressor_is_refused(name, message):
    with pytest.raises(ValueError, match=message):
        resolve_model(name)


def test_names_of_classes_are_refused_from_files_and_messages(tmp_path):
    """Class names would run code chosen by the author of the file or message."""
    with pytest.raises(ValueError, match='only on the command line and in Python') as error:
        CalibrationOptions('sklearn.tree:DecisionTreeRegressor')
    assert '\n' not in str(error.value)
    path = tmp_path / 'options.json'
    path.write_text(
        '{"format_version": 1, "options": {"model": "sklearn.tree:DecisionTreeRegressor"}, '
        '"joint": false, "principal_distance": null}'
    )
    with pytest.raises(DataError, match='only on the command line and in Python'):
        read_options(path)


@pytest.mark.parametrize('model', [DecisionTreeRegressor, 5, None, {}])
def test_model_that_is_no_regressor_is_refused(model):
    with pytest.raises(ValueError, match='model must be a name or a scikit-learn regressor'):
        CalibrationOptions(model)


def test_options_with_a_regressor_exclude_k():
    with pytest.raises(ValueError, match='k is a number of neighbours'):
        CalibrationOptions(cubic(), k=5)
    with pytest.raises(ValueError, match='max_iterations'):
        CalibrationOptions(cubic(), max_iterations=0)


def test_lookup_cannot_be_selected():
    assert 'lookup' in MODELS
    with pytest.raises(ValueError, match='model must be one of'):
        CalibrationOptions('lookup')


def test_command_calibrates_with_a_user_regressor(tmp_path, capsys):
    """The result folder stores its name; reading the folder never runs it."""
    write_observations_csv(tmp_path / 'points.csv', {'a': rigs.exposures()['a'][:6]})
    write_phantom(tmp_path / 'phantom.csv', rigs.rig().phantom)
    source = ['--phantom', tmp_path / 'phantom.csv', '--image-size', '1024x1024']
    command = [
        'calibrate',
        tmp_path / 'points.csv',
        *source,
        '--out',
        tmp_path / 'result',
        '--fast',
    ]
    status = rigs.run(*command, '--model', 'test_regressors:cubic', '--max-iterations', 2)
    assert status == 0, capsys.readouterr().err
    assert load_calibration(str(tmp_path / 'result' / 'a.calibration.npz')).model.kind == 'lookup'
    options = json.loads((tmp_path / 'result' / 'options.json').read_text())['options']
    assert options['model'] == 'sklearn.pipeline:Pipeline'
    capsys.readouterr()
    assert rigs.run('validate', tmp_path / 'result') == 1
    said = capsys.readouterr().err
    assert 'only on the command line and in Python' in said and said.count('\n') == 1
    assert rigs.run(*command, '--model', 'test_regressors:nothing') == 2
    assert 'cannot be imported' in capsys.readouterr().err
    assert rigs.run(*command, '--model', 'splines') == 2
    assert 'choose from auto, none, knn' in capsys.readouterr().err
