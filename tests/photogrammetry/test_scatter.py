# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Gross error limits follow the observed scatter, but only if it exceeds the stated one."""

import numpy as np
import pytest

from fluoro_calib_ros.photogrammetry.noise import (
    MAX_WIDENING,
    ObservedScatter,
    widening,
    widening_by_group,
)

MEDIAN = 0.6745  # median of absolute standard normal errors
LIMIT = 4 / MEDIAN


def errors(rng, count, factor=1.0, false=0.0):
    """Absolute normal errors, a share of them replaced by false matches."""
    size = factor * np.abs(rng.normal(size=count))
    wrong = rng.random(count) < false
    size[wrong] = np.abs(rng.normal(0, 40, int(wrong.sum())))
    return size / MEDIAN


@pytest.mark.parametrize('count', [5, 15, 60, 1000])
@pytest.mark.parametrize('false', [0.0, 0.2])
def test_limit_stays_where_errors_are_as_stated(count, false):
    rng = np.random.default_rng(count)
    found = [widening(errors(rng, count, 1.0, false), LIMIT) for _ in range(300)]
    assert np.mean(np.array(found) > 1) < 0.02
    assert max(found) < 1.5


@pytest.mark.parametrize('factor', [1.5, 2.0])
def test_true_errors_are_kept_where_sigma_is_understated(factor):
    rng = np.random.default_rng(1)
    found = widening(errors(rng, 1000, factor, 0.1), LIMIT)
    true = errors(rng, 100_000, factor)
    assert np.mean(true > LIMIT) > 0.005
    assert np.mean(true > found * LIMIT) < 0.001


def test_error_in_common_is_no_scatter():
    """All errors are twice the standard deviation of a rig orientation."""
    size = np.full(500, 2 / MEDIAN)
    assert widening(size, LIMIT, common=1.0) == 1.0
    assert widening(size, LIMIT) > 1.5


@pytest.mark.parametrize('common', [0.2, 0.5, 0.8])
def test_variance_in_common_counts_for_what_it_is(common):
    """A common error of up to three of its standard deviations is explained by chance."""
    count = 10**5  # large enough that the median is known well
    size = np.full(count, 2.9)
    chance = (1 - common) + common * 3.0**2
    assert widening(size, LIMIT, common) == pytest.approx(max(1, 2.9 / chance**0.5), rel=0.01)


def test_limit_is_bounded():
    assert widening(np.full(500, 30.0), 40.0) == MAX_WIDENING


def test_groups_have_factors_of_their_own():
    rng = np.random.default_rng(2)
    group = np.repeat([4, 0, 2], 400)
    size = np.concatenate([errors(rng, 400), errors(rng, 400, 2.0), errors(rng, 400)])
    order = rng.permutation(len(size))
    found = widening_by_group(size[order], LIMIT, group[order])
    assert (found[group[order] == 0] > 1.4).all()
    assert (found[group[order] != 0] == 1).all()
    assert widening_by_group(np.zeros(0), LIMIT, np.zeros(0, dtype=int)).shape == (0,)


def test_scatter_of_a_recording_is_that_of_its_latest_points():
    rng = np.random.default_rng(3)
    scatter = ObservedScatter()
    factors = []
    for factor in (1.0, 2.0, 1.0):
        for _ in range(150):
            scatter.add(errors(rng, 20, factor), np.full(20, 0.05), LIMIT)
        factors.append(scatter.factor)
    assert factors[1] > 1.4
    assert factors[0] == factors[2] == 1.0
    scatter.add(np.zeros(0), np.zeros(0), LIMIT)
    assert scatter.factor == 1.0
