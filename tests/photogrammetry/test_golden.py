# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Comparison with independent programs: COLMAP's bundle adjuster, scikit-learn's grid search."""

import functools
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rigs import disturbed, small_network
from sklearn.model_selection import GridSearchCV, PredefinedSplit
from sklearn.neighbors import KNeighborsRegressor

from fluoro_calib_ros.correction.neighbours import KnnModel
from fluoro_calib_ros.estimation.calibrate import calibrate
from fluoro_calib_ros.estimation.estimator import exposure_folds
from fluoro_calib_ros.estimation.initial_network import measured_network
from fluoro_calib_ros.estimation.neighbour_regression import CrossValidation
from fluoro_calib_ros.estimation.options import CalibrationOptions
from fluoro_calib_ros.photogrammetry.adjustment import adjust
from fluoro_calib_ros.photogrammetry.noise import Noise
from fluoro_calib_ros.photogrammetry.precision import precision
from fluoro_calib_ros.simulation.rig import Detection, simulate_exposures, virtual_rig

sys.path.append(str(Path(__file__).resolve().parents[2]))  # benchmarks are not installed
from benchmarks.peers import TIGHT, ColmapAdjustment, drop_rarely_seen_points, with_datum

pytestmark = pytest.mark.long


def small_problem():
    """Network, initial values and noise: six exposures of about thirty targets, heavy tails."""
    network, truth = small_network(6, 40, noise_px=0.3, nu=4.0, seed=2, seen=0.8)
    network = replace(network, sigma=np.ones(len(network.uv)))
    return *drop_rarely_seen_points(network, disturbed(truth, degrees=0.2, mm=2.0), 2), Noise(
        'student_t', 0.4, 4.0
    )


@functools.cache
def real_problem():
    """The same for 15 undistorted exposures of about 132 targets, with false matches."""
    rig = virtual_rig(1)
    exposures = simulate_exposures(rig, 15, 1, detection=Detection(beads=(130, 134)))
    frames = [
        replace(frame, uv=uv)
        for frame, uv in zip(exposures.frames['a'], exposures.undistorted['a'])
    ]
    measured = measured_network({'a': frames}, rig.phantom)
    return *drop_rarely_seen_points(measured.network, measured.start, 2), Noise(
        'student_t', 0.22, 5.0
    )


def all_fixed(network):
    """All object points are fixed; exposures share only the interior orientation."""
    return np.ones(len(network.survey_mm), dtype=bool)


def few_fixed(network):
    """Every tenth object point, and those seen in only two exposures, define the datum."""
    return (np.arange(len(network.survey_mm)) % 10 == 0) | (np.bincount(network.point) < 3)


@pytest.mark.parametrize('fixed_points', [all_fixed, few_fixed])
@pytest.mark.parametrize('problem', [small_problem, real_problem])
def test_adjustment_equals_colmap(problem, fixed_points):
    """Cost, unknowns and standard deviations of the interior orientation for Student-t noise."""
    network, start, noise = problem()
    held = fixed_points(network)
    assert held.sum() >= 3 and (held.all() or (~held).sum() > len(held) / 2)
    network = with_datum(network, held)
    ours = adjust(network, start, 0.0, noise, 1e-10)
    assert ours.converged and ours.noise == noise
    assert np.any(~ours.inliers) or problem is small_problem

    colmap = ColmapAdjustment(network, start, noise, held, TIGHT)
    assert colmap.cost(colmap.solve()) == pytest.approx(ours.cost, rel=1e-6)
    theirs = colmap.parameters()
    np.testing.assert_allclose(ours.parameters.interior, theirs.interior, rtol=1e-6)
    np.testing.assert_allclose(ours.parameters.rotation, theirs.rotation, atol=1e-7)
    np.testing.assert_allclose(ours.parameters.position_mm, theirs.position_mm, atol=1e-4)
    np.testing.assert_allclose(ours.parameters.points_mm, theirs.points_mm, atol=1e-4)

    # Without the factor of the Fisher information, ours is that of the weighted normal matrix.
    covariance = noise.information_factor(ours.q) * precision(network, ours).interior[0]
    expected = colmap.interior_covariance()
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), np.sqrt(np.diag(expected)), rtol=1e-6)
    np.testing.assert_allclose(
        covariance, expected, rtol=1e-5, atol=1e-6 * np.diag(expected).max()
    )


@pytest.mark.parametrize('seed', [1, 2])
def test_k_of_a_calibration_equals_grid_search(seed):
    """Values of a real calibration, whole exposures as folds, equal weights."""
    rig = virtual_rig(seed)
    frames = {
        'a': simulate_exposures(rig, 15, seed, detection=Detection(beads=(130, 134))).frames['a']
    }
    run = calibrate(frames, rig.phantom, CalibrationOptions('knn', max_iterations=2)).runs['a']
    network = run.measured.network
    inside = np.flatnonzero(run.trained)
    # Coincident pixels have no defined order among the neighbours, so keep one of them.
    inside = inside[np.sort(np.unique(network.uv[inside], axis=0, return_index=True)[1])]
    uv = network.uv[inside]
    values = (run.after.residuals + run.correction)[inside]
    fold = exposure_folds(network.exposure[inside])
    candidates = np.arange(1, 41)

    search = GridSearchCV(
        KNeighborsRegressor(),
        {'n_neighbors': candidates},
        cv=PredefinedSplit(fold),
        refit=False,
        scoring=lambda model, x, y: -np.sum((y - model.predict(x)) ** 2),
    )
    search.fit(uv, values)
    scores = CrossValidation(KnnModel, uv, fold, candidates).scores(
        values, np.tile(np.eye(2), (len(uv), 1, 1))
    )
    np.testing.assert_allclose(
        scores, -len(np.unique(fold)) * search.cv_results_['mean_test_score'], rtol=1e-9
    )
    assert candidates[np.argmin(scores)] == search.best_params_['n_neighbors']
    assert 1 < candidates[np.argmin(scores)] < 40 and len(uv) > 1700
