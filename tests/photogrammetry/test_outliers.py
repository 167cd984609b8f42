# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Outlier tests: few false alarms on clean data, and detection of gross errors."""

from dataclasses import replace

import numpy as np
import pytest
import rigs
from scipy import stats
from threadpoolctl import threadpool_limits

from fluoro_calib_ros.photogrammetry.adjustment import adjust
from fluoro_calib_ros.photogrammetry.collinearity import project
from fluoro_calib_ros.photogrammetry.noise import Noise
from fluoro_calib_ros.photogrammetry.outliers import (
    _f_limit,
    adjust_and_estimate_noise,
    find_outliers,
    image_statistics,
    target_statistics,
)
from fluoro_calib_ros.photogrammetry.precision import precision
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector

SHAPE = dict(exposures=10, targets=60, noise_px=0.25)


@pytest.fixture(autouse=True, scope='module')
def one_thread():
    with threadpool_limits(1):
        yield


def adjusted(network, truth, loss='student_t'):
    result = adjust_and_estimate_noise(network, truth, noise=Noise(loss))
    return result, precision(network, result)


@pytest.mark.parametrize('loss', ['gaussian', 'student_t', 'huber'])
@pytest.mark.long
def test_false_alarms_on_clean_data(loss):
    """At 1 % per network, 20 networks raise hardly any; statistics match their quantiles."""
    alarms = 0
    image = []
    target = []
    for seed in range(20):
        network, truth = rigs.small_network(seed=seed, **SHAPE)
        result, precise = adjusted(network, truth, loss)
        found = find_outliers(network, result, precise)
        alarms += len(found.image_point) + len(found.target)
        value, critical = image_statistics(
            network, result, precise, 0.05 * np.isfinite(result.q).sum()
        )
        image.append(np.mean(value > critical))
        targets = target_statistics(network, result, precise, 0.05 * len(network.survey_mm))
        target.append(np.mean(targets.value > targets.critical))
    assert alarms <= 2
    assert np.mean(image) == pytest.approx(0.05, abs=0.02)
    assert np.mean(target) == pytest.approx(0.05, abs=0.025)


def test_statistics_of_targets_are_those_of_their_distribution_with_long_tails():
    """With 3 degrees of freedom, the weighted normal matrix promises 1.4 times too much."""
    rng = np.random.default_rng(2)
    noise = Noise('student_t', 0.25, 3.0)
    values = []
    for seed in range(8):
        network, truth = rigs.small_network(seed=seed, **SHAPE)
        tails = np.sqrt(rng.chisquare(noise.nu, len(network.uv)) / noise.nu)
        error = noise.scale * rng.normal(size=network.uv.shape) / tails[:, None]
        uv = project(*network.per_image_point(truth)) + error
        network = replace(network, uv=uv, sigma=np.ones(len(uv)))
        result = adjust(network, truth, noise=noise)
        values.append(target_statistics(network, result, precision(network, result)).value)
    assert np.nanmean(values) == pytest.approx(3, abs=0.3)


@pytest.mark.parametrize('loss', ['gaussian', 'student_t', 'huber'])
def test_gross_error_of_two_pixels_is_found(loss):
    found_rows = 0
    others = 0
    for seed in range(8):
        network, truth = rigs.small_network(seed=seed, **SHAPE)
        rng = np.random.default_rng(seed)
        uv = project(*network.per_image_point(truth)) + rng.normal(0, 0.25, network.uv.shape)
        row = int(rng.integers(len(uv)))
        uv[row] += 2.0 * np.array([np.cos(seed), np.sin(seed)])
        network = replace(network, uv=uv, sigma=np.ones(len(uv)))
        result, precise = adjusted(network, truth, loss)
        found = find_outliers(network, result, precise)
        found_rows += row in found.image_point
        others += len(found.image_point) - (row in found.image_point) + len(found.target)
    assert found_rows >= 7 and others <= 1


@pytest.mark.parametrize('loss', ['gaussian', 'student_t'])
def test_bead_moved_by_two_millimetres_is_found(loss):
    hits = 0
    others = 0
    for seed in range(6):
        network, truth = rigs.small_network(seed=seed, **SHAPE)
        survey = network.survey_mm.copy()
        offset = np.random.default_rng(seed).normal(size=3)
        offset *= 2.0 / np.linalg.norm(offset)
        survey[7] += offset
        network = replace(network, survey_mm=survey)
        result, precise = adjusted(network, truth, loss)
        found = find_outliers(network, result, precise)
        hits += 7 in found.target
        others += np.sum(found.target != 7)
        if 7 in found.target:
            np.testing.assert_allclose(found.offset_mm[found.target == 7][0], -offset, atol=0.8)
    assert hits == 6 and others <= 1


def test_surveys_of_a_free_network_are_not_tested():
    network, truth = rigs.small_network(**SHAPE, seen=1.0)
    network = replace(network, datum='inner')
    result, precise = adjusted(network, truth)
    assert not len(find_outliers(network, result, precise).target)


def test_limits_of_the_f_distribution_are_those_of_scipy():
    for freedom in (3.0, 5.0, 37.5, 1e5):
        for probability in (0.3, 1e-3, 1e-8):
            assert _f_limit(probability, freedom) == pytest.approx(
                stats.f.isf(probability, 2, freedom), rel=1e-7
            )
    assert _f_limit(1e-3, np.inf) == pytest.approx(stats.chi2.isf(1e-3, 2) / 2)


def with_false_matches(network, share, seed):
    """The network with a share of its image points placed anywhere in an image of 1024 px."""
    rng = np.random.default_rng(seed)
    false = rng.random(network.n_image_points) < share
    uv = np.where(false[:, None], rng.uniform(0, 1023, network.uv.shape), network.uv)
    return replace(network, uv=uv), false


@pytest.mark.parametrize('seed', range(4))
def test_nearly_half_of_the_matches_false_are_not_taken_for_noise(seed):
    network, truth = rigs.small_network(exposures=12, targets=100, noise_px=0.25, seed=seed)
    network, false = with_false_matches(network, 0.48, seed)
    start = rigs.disturbed(truth, seed, degrees=0.1, mm=2.0)
    result = adjust_and_estimate_noise(network, start, noise=Noise(gross=0.01))
    assert 0.2 < result.noise.scale < 0.3
    assert np.mean(result.inliers == ~false) > 0.99


@pytest.mark.parametrize('seed', range(3))
def test_exposures_with_wrong_start_values_are_no_false_matches(seed):
    network, truth = rigs.small_network(exposures=8, targets=60, noise_px=0.25, seed=seed)
    network, false = with_false_matches(network, 0.1, seed)
    rotation = truth.rotation.copy()
    rotation[2:5] = matrix_from_vector(np.deg2rad([6.0, -6.0, 6.0])) @ rotation[2:5]
    start = replace(truth, rotation=rotation)
    result = adjust_and_estimate_noise(network, start, noise=Noise(gross=0.01))
    assert np.mean(result.inliers == ~false) > 0.99
