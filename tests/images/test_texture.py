# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Backgrounds of windows beyond a polynomial: eliminated as by a covariance, and estimated."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares

from fluoro_calib_ros.images.background import Background
from fluoro_calib_ros.images.profile import Profile
from fluoro_calib_ros.images.texture import Cosines, window_offsets

OFFSET = window_offsets(8.0)
COSINES = Cosines(OFFSET, np.float64)
PIXELS = len(OFFSET)


def windows(count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return light behind beads (g, m), derivatives (g, 7, m) and weights (g, m)."""
    rng = np.random.default_rng(seed)
    x, y = OFFSET.T / 8
    relative = np.broadcast_to(1 - 0.5 * np.exp(-4 * (x * x + y * y)), (count, PIXELS))
    background = np.stack([np.ones(PIXELS), x, y, x * x, x * y, y * y]) * relative[0]
    jacobian = np.stack([np.vstack([background, rng.normal(size=PIXELS)]) for _ in range(count)])
    return relative, jacobian, rng.uniform(0.5, 2.0, (count, PIXELS))


def test_elimination_is_weighting_by_the_covariance_of_the_background():
    relative, jacobian, weight = windows(2, 1)
    residual = np.random.default_rng(2).normal(size=(2, PIXELS))
    strength = np.array([0.7, 20.0])
    taken = COSINES.eliminated(
        strength, relative=relative, jacobian=jacobian, weight=weight, residual=residual
    )
    expected = COSINES.expected(strength, relative, weight=weight, residual=residual)
    for k in range(2):
        waves = relative[k] * COSINES.waves
        covariance = np.diag(1 / weight[k])
        covariance += strength[k] * (waves.T * COSINES.variance) @ waves
        inverse = np.linalg.inv(covariance)
        left = (jacobian[k] * weight[k]) @ jacobian[k].T - taken[0][k]
        right = jacobian[k] @ (weight[k] * residual[k]) - taken[1][k]
        squared = residual[k] @ (weight[k] * residual[k]) - taken[2][k]
        assert left == pytest.approx(jacobian[k] @ inverse @ jacobian[k].T, rel=1e-6)
        assert right == pytest.approx(jacobian[k] @ inverse @ residual[k], rel=1e-6, abs=1e-6)
        assert squared == pytest.approx(residual[k] @ inverse @ residual[k], rel=1e-6)
        shared = strength[k] * (COSINES.waves.T * COSINES.variance) @ waves
        assert expected[k] == pytest.approx(shared @ inverse @ residual[k], rel=1e-6, abs=1e-6)


@pytest.mark.parametrize('true', [1.0, 30.0])
def test_strengths_are_those_of_the_backgrounds(true):
    relative, jacobian, weight = windows(200, 3)
    rng = np.random.default_rng(4)
    amplitude = rng.normal(size=(200, len(COSINES.variance))) * np.sqrt(true * COSINES.variance)
    residual = relative * (amplitude @ COSINES.waves) + rng.normal(size=relative.shape) / np.sqrt(
        weight
    )
    spectra = COSINES.spectra(relative, jacobian=jacobian, weight=weight, residual=residual)
    assert np.median(spectra.strengths(1.0).variance) == pytest.approx(true, rel=0.5)


def test_noise_alone_has_no_background():
    relative, jacobian, weight = windows(200, 5)
    residual = np.random.default_rng(6).normal(size=relative.shape) / np.sqrt(weight)
    spectra = COSINES.spectra(relative, jacobian=jacobian, weight=weight, residual=residual)
    assert np.count_nonzero(spectra.strengths(1.0).variance) <= 2


@pytest.mark.parametrize('scale', [0.5, 4.0])
def test_backgrounds_of_some_windows_are_found_whatever_the_noise(scale):
    relative, jacobian, weight = windows(200, 7)
    rng = np.random.default_rng(8)
    residual = rng.normal(size=relative.shape) / np.sqrt(weight) * np.sqrt(scale)
    amplitude = rng.normal(size=(60, len(COSINES.variance)))
    amplitude *= np.sqrt(30.0 * scale * COSINES.variance)
    residual[:60] += relative[:60] * (amplitude @ COSINES.waves)
    spectra = COSINES.spectra(relative, jacobian=jacobian, weight=weight, residual=residual)
    found = spectra.strengths(1.0).variance
    # In units of the noise variance that the weights imply.
    assert np.log2(np.median(found[:60]) / 30.0) == pytest.approx(0, abs=1)
    assert np.count_nonzero(found[:60]) >= 54
    assert np.count_nonzero(found[60:] > 0.2) <= 3


def test_a_background_that_is_as_likely_as_none_has_part_of_its_strength():
    relative, jacobian, weight = windows(400, 9)
    rng = np.random.default_rng(10)
    residual = rng.normal(size=relative.shape) / np.sqrt(weight)
    amplitude = rng.normal(size=(200, len(COSINES.variance))) * np.sqrt(COSINES.variance)
    residual[:200] += relative[:200] * (amplitude @ COSINES.waves)
    spectra = COSINES.spectra(relative, jacobian=jacobian, weight=weight, residual=residual)
    found = spectra.strengths(1.0).variance
    given = spectra.strengths_at(1.0, 1.0).variance
    partly = (found > 0) & (found < 0.6 * given)
    assert np.count_nonzero(partly[:200]) > 20
    # No more is missing on average than is found where there is nothing.
    assert np.mean(found) == pytest.approx(0.5, rel=0.3)


def test_slow_waves_of_correlated_noise_are_no_background():
    relative, jacobian, weight = windows(200, 9)
    rng = np.random.default_rng(10)
    side = 2 * int(OFFSET.max()) + 1
    white = rng.normal(size=(200, side + 2, side + 2))
    rows, columns = (OFFSET - OFFSET.min()).T[::-1]
    summed = sum(white[:, i : i + side, j : j + side] for i in range(3) for j in range(3)) / 3
    residual = summed[:, rows, columns] / np.sqrt(weight)
    spectra = COSINES.spectra(relative, jacobian=jacobian, weight=weight, residual=residual)
    assert np.count_nonzero(spectra.strengths(1.0).variance) > 150
    assert np.count_nonzero(spectra.strengths(9.0).variance) <= 2


@pytest.mark.parametrize('direction', [0.0, 0.6])
def test_a_straight_edge_has_more_evidence_than_a_background_without_direction(direction):
    relative, jacobian, weight = windows(100, 11)
    rng = np.random.default_rng(12)
    across = OFFSET @ [np.cos(direction), np.sin(direction)]
    edge = 8 * np.maximum(across - rng.uniform(-4, 4, 100)[:, None], 0)
    residual = relative * edge + rng.normal(size=relative.shape) / np.sqrt(weight)

    def evidence(cosines):
        spectra = cosines.spectra(relative, jacobian=jacobian, weight=weight, residual=residual)
        return spectra.strengths_at(1.0, 1.0).evidence

    without = evidence(COSINES)
    assert np.mean(evidence(Cosines(OFFSET, np.float64, direction)) > without) > 0.9
    # In a wrong direction it has not.
    assert np.mean(evidence(Cosines(OFFSET, np.float64, direction + 1.0)) > without) < 0.1


# ---- backgrounds


def test_a_large_step_is_one_of_the_light():
    """The logarithm of a line is no line; its polynomial is the best one of degree 2."""
    background = Background(2, OFFSET, 8.0)
    background.start(np.array([100.0, 200.0]), np.array([50.0, 100.0]), 0.2)
    assert background.light == pytest.approx([100, 200])
    assert np.allclose(background.direct(np.arange(2)).T, [90, 180], rtol=1e-5)
    step = np.zeros((2, 6))
    step[0, 1] = 63.0  # the light at the border changes by 70 %
    step[1, 2] = 1.0
    terms = background.changed(np.arange(2), step)
    x = OFFSET[:, 0] / 8
    slope, curvature = np.linalg.lstsq(
        np.stack([x, x * x, np.ones_like(x), OFFSET[:, 1] ** 2], axis=1), np.log(1 + 0.7 * x)
    )[0][:2]
    assert terms[0, [1, 3]] == pytest.approx([slope, curvature], abs=1e-3)
    assert terms[1] == pytest.approx([np.log(180), 0, 1 / 180, 0, 0, 0])


def test_direct_light_is_at_least_a_tenth_in_the_dark():
    background = Background(1, OFFSET, 8.0)
    background.start(np.array([10.0]), np.array([500.0]), 0.1)
    assert np.exp(background.terms[0, 0]) == pytest.approx(1.0)
    assert background.light == pytest.approx([10.0])


def test_blur_draws_a_shadow_towards_less_light():
    """Compare with a shadow in an exponential background that is blurred numerically."""
    axis = np.arange(-400, 401) / 20
    slope = 0.08
    light = np.exp(slope * axis) * (1 - 0.5 * (np.abs(axis) < 3))
    kernel = np.exp(-0.5 * (axis / 1.5) ** 2)
    blurred = np.convolve(light, kernel / kernel.sum(), mode='same')
    inside = np.abs(axis) < 8
    shadow = 1 - blurred[inside] / np.exp(slope * axis[inside] + 0.5 * slope**2 * 1.5**2)
    seen = (shadow * axis[inside]).sum() / shadow.sum()
    background = Background(1, OFFSET, 8.0)
    background.terms[0, 1] = slope * 8
    assert background.slope(np.zeros((1, 2)))[0] == pytest.approx([slope, 0])
    assert seen == pytest.approx(-slope * 1.5**2, abs=2e-3)


@pytest.mark.parametrize('sharpening', [0.0, 1.5])
def test_mask_shifts_a_shadow_less_than_its_variance(sharpening):
    """Compare with a fit to a shadow in an exponential background, sharpened numerically."""
    profile = Profile(7.0, 1.0, 0.9, sharpening=sharpening, mask_px=3.0)
    fine, half, slope = 5, 24, 0.01
    axis = np.arange(-half * fine, half * fine + 1) / fine
    x, y = np.meshgrid(axis, axis)
    raw = np.exp(slope * x) * (1 - profile.absorbed(x * x + y * y))
    image = sum(
        weight * cv2.GaussianBlur(raw, (0, 0), fine * sigma, borderType=cv2.BORDER_REPLICATE)
        for weight, sigma in profile.blurs
    )
    inside = x * x + y * y < 14**2
    x, y, image = x[inside], y[inside], image[inside]

    def misclosure(unknowns):
        place, depth, *light = unknowns
        shadow, _ = profile.shadow(np.hypot(x - place, y))
        plane = light[0] + light[1] * x + light[2] * x * x + light[3] * y * y
        return np.exp(plane) * (1 - depth * shadow) - image

    seen = least_squares(misclosure, [0, 1, 0, slope, 0, 0], x_scale='jac').x[0]
    blurred, masked = profile.drawn_px2
    assert blurred == pytest.approx(1 + 1 / 12)
    assert seen == pytest.approx(-slope * (blurred + masked), rel=0.1)
    assert (masked == 0) == (sharpening == 0)


def test_mask_amplifies_short_waves():
    """The variance of a wave is multiplied by the squared gain of the mask at its frequency."""
    plain = Cosines(OFFSET, np.float64)
    masked = Cosines(OFFSET, np.float64, mask=(1.5, 3.0))
    half = np.abs(OFFSET).max() + 0.5
    gain = np.sqrt(masked.variance / plain.variance)
    # The first waves are one and two half waves along y: frequencies in radians per pixel.
    expected = [1 + 1.5 * (1 - np.exp(-4.5 * (n * np.pi / (2 * half)) ** 2)) for n in (1, 2)]
    assert gain[1] / gain[0] == pytest.approx(expected[1] / expected[0])


@pytest.mark.parametrize('angle', [-1.2, 0.3, 1.0])
def test_light_changes_most_across_an_edge_whether_it_slopes_or_bends(angle):
    background = Background(2, OFFSET, 8.0)
    a, b = np.cos(angle), np.sin(angle)
    background.terms[0, 1:3] = 0.4 * a, 0.4 * b
    background.terms[1, 3:] = a * a, 2 * a * b, b * b
    found = background.steepest(np.arange(2))
    assert np.abs(np.sin(found - angle)).max() < 1e-9
