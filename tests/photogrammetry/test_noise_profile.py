# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Noise that differs between the centre of an image and its rim."""

import numpy as np
import pytest
from scipy.stats import binom
from sklearn.linear_model import GammaRegressor

from fluoro_calib_ros.correction.fluoroscope_calibration import (
    NoiseProfile,
    packed_profile,
    unpacked_profile,
)
from fluoro_calib_ros.estimation.lack_of_fit import fitted_profile

SIZE = (1024, 768)


def drawn(rng, rim_over_middle, count=2000, nu=np.inf):
    """Image points and mean squared errors; the standard deviation is 0.2 px in the middle."""
    uv = rng.uniform(0, 1, (count, 2)) * SIZE
    square = np.sum((uv - np.array([511.5, 383.5])) ** 2, axis=1) / 512**2
    noise = rng.normal(0, 1, (count, 2))
    if nu < np.inf:
        noise /= np.sqrt(rng.chisquare(nu, count) / nu)[:, None]
    noise *= (0.2 * rim_over_middle**square)[:, None]
    return uv, np.mean(noise**2, axis=1)


@pytest.mark.parametrize('ratio', [0.4, 1.3, 4.0])
def test_profile_is_that_of_a_gamma_regression(ratio):
    """Compare with scikit-learn's regression of the same squares."""
    uv, squares = drawn(np.random.default_rng(6), ratio)
    x = np.sum((uv - np.array([511.5, 383.5])) ** 2, axis=1, keepdims=True) / 512**2
    peer = GammaRegressor(alpha=0, tol=1e-8, solver='newton-cholesky').fit(x, squares)
    found = fitted_profile(uv, squares, SIZE)
    growth = 2 * np.log(found.rim / found.middle)
    assert growth == pytest.approx(peer.coef_[0] * found.reach**2, rel=1e-4)


@pytest.mark.parametrize('nu', [np.inf, 8.0])
@pytest.mark.parametrize('ratio', [0.6, 1.5, 2.5])
def test_rim_is_estimated_without_bias(ratio, nu):
    rng = np.random.default_rng(1)
    found = [fitted_profile(*drawn(rng, ratio, nu=nu), SIZE) for _ in range(20)]
    at_half_side = [(f.rim / f.middle) ** f.reach**-2 for f in found]
    assert np.mean(at_half_side) == pytest.approx(ratio, rel=0.03)


def test_squares_are_as_large_as_claimed_in_the_middle_and_at_the_rim():
    uv, squares = drawn(np.random.default_rng(2), 2.0)
    factors = fitted_profile(uv, squares, SIZE).factors(uv[:, 0], uv[:, 1], SIZE)
    assert np.mean(factors**2) == pytest.approx(1.0, rel=1e-12)
    q = squares / np.mean(squares) / factors**2
    inner = factors < np.median(factors)
    assert np.mean(q[inner]) == pytest.approx(1.0, abs=0.1)
    assert np.mean(q[~inner]) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize('nu', [np.inf, 8.0])
def test_same_noise_everywhere_has_no_profile_but_by_chance(nu):
    """A profile is found in one of 20 images, and then it is slight."""
    rng = np.random.default_rng(3)
    found = [fitted_profile(*drawn(rng, 1.0, nu=nu), SIZE) for _ in range(200)]
    ratios = [f.rim / f.middle for f in found if f is not None]
    assert len(ratios) <= binom.ppf(0.999, 200, 1 / 20)
    assert np.abs(np.log(ratios)).max() < np.log(1.25)


def test_noise_stays_as_it_is_beyond_the_image_points():
    profile = NoiseProfile(0.8, 1.6, 0.9)
    u = 511.5 + 512 * np.array([0.0, 0.9, 1.0, 1.4, np.inf])
    found = profile.factors(u, np.full(5, 383.5), SIZE)
    assert found[0] == 0.8
    np.testing.assert_allclose(found[1:], 1.6, rtol=1e-12)


@pytest.mark.parametrize('count', [0, 5, 99])
def test_few_image_points_show_no_profile(count):
    assert fitted_profile(*drawn(np.random.default_rng(4), 3.0, count), SIZE) is None


def test_a_hundred_image_points_are_enough_for_a_profile():
    found = fitted_profile(*drawn(np.random.default_rng(4), 3.0, 100), SIZE)
    assert 1.5 < found.rim / found.middle < 6


@pytest.mark.parametrize('zeros', [slice(None), slice(100)])
def test_errors_of_zero_show_no_profile(zeros):
    uv, squares = drawn(np.random.default_rng(5), 1.0)
    squares[zeros] = 0
    assert fitted_profile(uv, squares, SIZE) is None


def test_packed_profile_is_the_same():
    profile = NoiseProfile(0.8, 1.6, 0.9)
    assert unpacked_profile(packed_profile(profile)) == profile
    assert unpacked_profile(packed_profile(None)) is None
