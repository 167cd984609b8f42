# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Estimate where in the image the noise is larger.

Blur, shading and oblique shadows make the noise of most cameras and detectors larger towards the
border, a correction magnifies it where it stretches the image, and distortions that differ between
exposures do so most at the border. The profile is estimated as a gamma regression of the squares
by quasi-likelihood (McCullagh and Nelder, "Generalized Linear Models", 1989, 10.3).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..correction.noise_profile import MAX_FACTOR, NoiseProfile, square_distance

MIN_POINTS = 100
# Gain of deviance over the dispersion from which a profile is taken. Chance exceeds it in one of
# 20 images (chi squared with one degree of freedom), with factors that hardly differ from one.
MIN_GAIN = 4.0
MIN_DISPERSION = 0.1
MIN_SQUARE = 1e-6  # of the mean: the logarithm of a zero would count for ever
REACH_QUANTILE = 0.99
# Steps of the regression: at most so many, of so much, and the one at which it ends.
MAX_STEPS = 100
MAX_STEP = 1.0
MIN_STEP = 1e-6


def fitted_profile(
    uv: NDArray[np.float64], squares: NDArray[np.float64], image_size: tuple[int, int]
) -> NoiseProfile | None:
    """Return the profile that squares of errors show, None where they are the same everywhere.

    uv: (n, 2) image points [px]. squares: (n,) squared error of a coordinate of each [px^2], mean
    of both. image_size: width and height [px].
    """
    mean = float(np.mean(squares)) if len(squares) else 0.0
    if len(uv) < MIN_POINTS or not mean > 0:
        return None
    square = square_distance(uv[:, 0], uv[:, 1], image_size)
    y = np.maximum(squares / mean, MIN_SQUARE)
    y /= np.mean(y)
    slope, expected = _gamma_regression(square, y)
    # Two coordinates are chi squared with two degrees of freedom: a dispersion of one.
    dispersion = float(np.mean((y / expected - 1) ** 2))
    gain = -2 * float(np.sum(np.log(expected)))  # of deviance; the mean of y / expected is one
    if gain < MIN_GAIN * max(dispersion, MIN_DISPERSION):
        return None
    reach = float(np.sqrt(np.quantile(square, REACH_QUANTILE)))
    limit = 2 * np.log(MAX_FACTOR)
    growth = float(np.clip(slope * reach**2, -limit, limit))
    middle = float(np.mean(np.exp(growth * np.minimum(square / reach**2, 1))) ** -0.5)
    return NoiseProfile(middle, middle * float(np.exp(growth / 2)), reach)


def _gamma_regression(x: np.ndarray, y: np.ndarray) -> tuple[float, np.ndarray]:
    """Slope of the logarithm of the expectation of y (n,) over x (n,), and the expectations (n,).

    Fisher scoring: with a logarithmic link, all weights are one (McCullagh and Nelder, 8.4).
    """
    x = x - np.mean(x)
    square = max(float(x @ x), MIN_SQUARE)
    slope = 0.0
    for _ in range(MAX_STEPS):
        expected = np.exp(slope * x)
        expected *= np.mean(y / expected)
        step = float(x @ (y / expected)) / square
        slope += float(np.clip(step, -MAX_STEP, MAX_STEP))
        if abs(step) < MIN_STEP:
            break
    return slope, expected
