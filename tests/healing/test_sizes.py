# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Size of a change, estimated from the data."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from fluoro_calib_ros.healing.sizes import SIZES, ChangeStatistics


def told_of(change, design, noise, rng):
    """Information on a change (k,) from observations with derivatives design (n, k)."""
    observed = design @ change + rng.normal(0, noise, len(design))
    return ChangeStatistics(design.T @ design / noise**2, design.T @ observed / noise**2), observed


def test_evidence_is_the_density_of_the_observations():
    """Relative to the density without a change, by scipy's normal distribution."""
    rng = np.random.default_rng(1)
    design = rng.normal(size=(12, 3))
    told, observed = told_of(np.array([0.3, -0.2, 0.5]), design, 0.1, rng)
    sd = np.array([[0.5, 0.5, 0.1], [0.01, 2.0, 1.0]])
    noise = 0.01 * np.eye(12)
    expected = [
        multivariate_normal.logpdf(observed, cov=noise + (design * one**2) @ design.T)
        - multivariate_normal.logpdf(observed, cov=noise)
        for one in sd
    ]
    np.testing.assert_allclose(told.evidence(sd), expected)


def test_evidence_of_any_size_is_a_mean_over_sizes_of_the_parts():
    rng = np.random.default_rng(2)
    design = rng.normal(size=(12, 3))
    told, _ = told_of(np.array([0.3, -0.2, 0.05]), design, 0.1, rng)
    parts = np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    weight = SIZES / (1 + SIZES**2)
    total = 0.0
    for a, of_a in zip(SIZES, weight):
        for b, of_b in zip(SIZES, weight):
            total += of_a * of_b * np.exp(told.evidence(np.array([a, a, b])))
    assert told.sizes(parts).evidence == pytest.approx(np.log(total / weight.sum() ** 2))


def test_sizes_and_moments_are_those_of_the_change():
    """A well-determined part has its true size; an undetermined part may have any size."""
    rng = np.random.default_rng(3)
    design = np.column_stack([rng.normal(size=(200, 20)), np.zeros((200, 20))])
    change = np.r_[rng.normal(0, 0.25, 20), np.zeros(20)]
    told, _ = told_of(change, design, 0.01, rng)
    parts = np.repeat(np.eye(2), 20, axis=1)
    rms = told.sizes(parts).rms
    assert rms[:20] == pytest.approx(0.25, rel=0.5)
    weight = SIZES / (1 + SIZES**2)
    assert rms[20:] == pytest.approx(np.sqrt(weight @ SIZES**2 / weight.sum()))
    moments = told.mean_moments(parts)
    np.testing.assert_allclose(moments[:20, :20], np.outer(change, change)[:20, :20], atol=0.01)
    np.testing.assert_allclose(np.diagonal(moments)[20:], rms[20:] ** 2)


def test_observations_that_scatter_more_tell_less():
    told = ChangeStatistics(np.diag([4.0, 9.0]), np.array([2.0, 3.0]))
    half = told.with_noise(2.0)
    np.testing.assert_allclose(half.matrix, told.matrix / 4)
    np.testing.assert_allclose(half.right, told.right / 4)
    np.testing.assert_allclose(told.only(np.array([1])).matrix, [[9.0]])
