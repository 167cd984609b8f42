# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The noise around markers is that of their windows: processed images have another in shadows."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from fluoro_calib_ros.images.light import Noise, line_of_variance
from fluoro_calib_ros.images.marker_fit import MarkerGuess, fit_markers, noise_of_markers
from fluoro_calib_ros.images.marker_intensity import FilteredImage, LightWindows, learn_start
from fluoro_calib_ros.images.profile import Profile

SPACING = 36.0
SIDE = 6
SIZE = round(SPACING * (SIDE + 1))
MARKER = Profile(1.6, 0.7, 3.0, 0.05)
NEAR = 8  # pixels on each side of a marker, beyond which its shadow is nothing
OPEN = 210.0
DARKEST = 0.5  # light at the left edge, over that at the right
GAIN = 0.14


def places(rng: np.random.Generator) -> np.ndarray:
    """Return places (n, 2) of markers in a square pattern, anywhere within their pixels."""
    grid = np.stack(np.meshgrid(*2 * (np.arange(1, SIDE + 1) * SPACING,)), axis=-1).reshape(-1, 2)
    return grid + rng.uniform(-0.5, 0.5, grid.shape)


def picture(rng: np.random.Generator, uv: np.ndarray, sharpening: float) -> np.ndarray:
    """Return an image of 8 bits with photon noise, after an unsharp mask."""
    light = np.tile(OPEN * np.linspace(DARKEST, 1, SIZE), (SIZE, 1))
    for place in uv:
        low = np.rint(place).astype(int) - NEAR
        v, u = np.mgrid[: 2 * NEAR + 1, : 2 * NEAR + 1] + (low - place)[::-1, None, None]
        near = np.s_[low[1] : low[1] + 2 * NEAR + 1, low[0] : low[0] + 2 * NEAR + 1]
        light[near] *= 1 - MARKER.shadow(np.hypot(u, v).ravel())[0].reshape(u.shape)
    grey = light + rng.normal(size=light.shape) * np.sqrt(GAIN * light)
    grey += sharpening * (grey - cv2.GaussianBlur(grey, (0, 0), 3.0))
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


@pytest.mark.parametrize('sharpening', [0.0, 0.7, 1.5, 3.0])
def test_centres_are_as_precise_as_their_sigma_says_in_sharpened_images(sharpening):
    rng = np.random.default_rng(8)
    normalised = []
    for _ in range(4):
        uv = places(rng)
        image = picture(rng, uv, sharpening)
        start = learn_start(FilteredImage(image), np.arange(len(uv)), uv)
        windows = LightWindows(image, start.look)
        noise = noise_of_markers(windows, uv, start.profile, start.noise)
        guess = MarkerGuess.standing(uv)
        beads = fit_markers(windows, guess, start.profile, noise, {})
        assert beads.measured.all()
        normalised.append((beads.uv - uv) / beads.sigma[:, None])
    assert 0.8 < np.sqrt(np.mean(np.square(normalised))) < 1.25


def test_few_pixels_do_not_change_the_noise():
    rng = np.random.default_rng(9)
    uv = places(rng)
    image = picture(rng, uv, 0.0)
    start = learn_start(FilteredImage(image), np.arange(len(uv)), uv)
    windows = LightWindows(image, start.look)
    assert noise_of_markers(windows, uv[:4], start.profile, start.noise) is start.noise
    found = noise_of_markers(windows, uv, start.profile, start.noise)
    level = np.array([0.4, 1.0]) * OPEN
    assert found.variance(level) == pytest.approx(GAIN * level, rel=0.4)
    assert found.correlation is start.noise.correlation


def test_line_of_a_variance_is_that_of_the_deviations():
    rng = np.random.default_rng(10)
    level = rng.uniform(10, 200, 60_000)
    true = Noise(5.0, 0.2, np.ones((1, 1)))
    deviation = np.abs(rng.normal(size=level.shape)) * np.sqrt(true.variance(level))
    constant, gain = line_of_variance(level, deviation)
    assert constant == pytest.approx(5.0, rel=0.3)
    assert gain == pytest.approx(0.2, rel=0.05)
