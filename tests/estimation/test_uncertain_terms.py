# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Standard deviations include the uncertainty as to which terms of a trend exist."""

import numpy as np
import pytest
from scipy.integrate import quad

from fluoro_calib_ros.estimation.parametric import (
    covariance_with_uncertain_terms,
    squared_error_of_kept,
)


def most_likely_kept(ratio):
    """Kept fraction of an estimate, with the prior variance of the largest likelihood."""
    return np.maximum(1 - 1 / np.maximum(ratio**2, 1e-9), 1e-3)


def by_definition(ratio, kept):
    """Expected squared error of the kept fraction, by adaptive quadrature over the prior."""

    def likelihood(k):
        return np.sqrt(k) * np.exp(-k * ratio**2 / 2)

    def integral(function):
        points = [min(1.0, c / (ratio**2 + 1)) for c in (0.1, 1, 10)]
        return quad(lambda k: likelihood(k) * function(k), 0, 1, points=points, limit=200)[0]

    there = integral(lambda k: 1 - k + ratio**2 * (1 - k - kept) ** 2)
    absent = np.exp(-(ratio**2) / 2)
    return (there + absent * (ratio * kept) ** 2) / (integral(lambda k: 1.0) + absent)


@pytest.mark.parametrize('ratio', [0.0, 0.3, 1.0, -2.5, 6.0, 40.0, 3000.0])
@pytest.mark.parametrize('kept', [1e-3, 0.5, 1.0])
def test_expected_error_is_that_of_quadrature(ratio, kept):
    found = squared_error_of_kept(np.array([ratio]), np.array([kept]))
    assert found == pytest.approx(by_definition(ratio, kept), rel=1e-6)


@pytest.mark.parametrize('size', [0.0, 0.5, 1.0, 2.0, 3.0, 5.0, 10.0])
def test_expected_errors_are_those_of_a_monte_carlo(size):
    estimate = size + np.random.default_rng(5).standard_normal(20_000)
    kept = most_likely_kept(estimate)
    error = np.mean((kept * estimate - size) ** 2)
    expected = np.maximum(squared_error_of_kept(estimate, kept), kept)
    assert 0.75 < error / np.mean(expected) < 1.4


def test_variances_with_a_known_prior_are_too_small_for_weak_terms():
    estimate = 1.0 + np.random.default_rng(6).standard_normal(20_000)
    kept = most_likely_kept(estimate)
    assert np.mean((kept * estimate - 1.0) ** 2) / np.mean(kept) > 2.5


def posterior(truth, variance, rng):
    """Mean and covariance of coefficients that are observed through mixed equations."""
    design = rng.normal(size=(40, len(truth)))
    observed = design @ truth + rng.normal(size=40)
    covariance = np.linalg.inv(design.T @ design + np.diag(1 / variance))
    return covariance @ design.T @ observed, covariance


def test_strong_terms_keep_their_covariance():
    variance = np.full(4, 1e4)
    mean, covariance = posterior(np.full(4, 100.0), variance, np.random.default_rng(7))
    found = covariance_with_uncertain_terms(np.eye(4), variance, mean, covariance)
    assert found == pytest.approx(covariance, rel=1e-2, abs=1e-4 * covariance.max())


def test_an_absent_term_is_uncertain_with_all_that_depends_on_it():
    variance = np.array([1e4, 1e4, 1e-5])
    mean, covariance = posterior(np.array([30.0, 50.0, 0.0]), variance, np.random.default_rng(8))
    found = covariance_with_uncertain_terms(np.eye(3), variance, mean, covariance)
    assert found[2, 2] > 100 * covariance[2, 2]
    assert found[0, 0] > covariance[0, 0]
    assert np.linalg.eigvalsh(found).min() > 0
