# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Noise of image coordinates that differs between the middle of the image and its rim.

Blur, shading and oblique shadows make the noise of most cameras and detectors larger towards the
rim, a correction magnifies it where it stretches the image, and distortions that differ between
exposures do so most at the rim. The logarithm of the variance is a linear function of the squared
distance from the middle: multiplicative heteroscedasticity (Harvey, Econometrica 44, 1976),
estimated as a gamma regression of the squares by quasi-likelihood (McCullagh and Nelder,
"Generalized Linear Models", 1989, 10.3).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

MIN_POINTS = 100
# Gain of deviance over the dispersion from which a profile is taken. Chance exceeds it in one of
# 20 images (chi squared with one degree of freedom), with factors that hardly differ from one.
MIN_GAIN = 4.0
MIN_DISPERSION = 0.1
MIN_SQUARE = 1e-6  # of the mean: the logarithm of a zero would count for ever
MAX_FACTOR = 10.0  # of the rim over the middle, or the inverse
REACH_QUANTILE = 0.99
# Steps of the regression: at most so many, of so much, and the one at which it ends.
MAX_STEPS = 100
MAX_STEP = 1.0
MIN_STEP = 1e-6


@dataclass(frozen=True)
class NoiseProfile:
    """Factors of the standard deviation of image coordinates over an image.

    Attributes
    ----------
    middle, rim : float
        Factors in the middle of the image, and at the rim and beyond. The mean of their squares
        over the image points is one.
    reach : float
        Distance of the rim from the middle, in halves of the longer side: no image points are
        known beyond.
    """

    middle: float
    rim: float
    reach: float

    def factors(self, u: np.ndarray, v: np.ndarray, image_size: tuple[int, int]) -> np.ndarray:
        """Return the factors (n,) at pixels u, v (n,)."""
        square = np.minimum(_square_distance(u, v, image_size), self.reach**2)
        square *= math.log(self.rim / self.middle) / self.reach**2
        return self.middle * np.exp(square)

    def packed(self) -> np.ndarray:
        """Return middle, rim and reach (3,), for files and messages."""
        return np.array([self.middle, self.rim, self.reach])


def packed_profile(profile: NoiseProfile | None) -> np.ndarray:
    """Return a profile as an array (3,) for files and messages, (0,) for None."""
    return np.zeros(0) if profile is None else profile.packed()


def unpacked_profile(values: np.ndarray) -> NoiseProfile | None:
    """Return the profile that `packed_profile` made an array of.

    Raises ValueError for arrays of another length, and for factors that no image has.
    """
    if not len(values):
        return None
    if len(values) != 3:
        raise ValueError(f'its noise profile has {len(values)} values, 3 are expected')
    middle, rim, reach = np.asarray(values, dtype=float).tolist()
    valid = min(middle, rim, reach) > 0 and max(middle, rim, reach) < np.inf
    if not valid or not 1 / MAX_FACTOR**2 < middle / rim < MAX_FACTOR**2:
        raise ValueError('its noise profile has factors that no image has')
    return NoiseProfile(middle, rim, reach)


def fitted_profile(
    uv: np.ndarray, squares: np.ndarray, image_size: tuple[int, int]
) -> NoiseProfile | None:
    """Return the profile that squares of errors show, None where they are the same everywhere.

    Parameters
    ----------
    uv : (n, 2) ndarray
        Image points [px].
    squares : (n,) ndarray
        Squared error of a coordinate of each [px^2], mean of both.
    image_size : tuple of int
        Width and height [px].

    Returns
    -------
    NoiseProfile or None
    """
    mean = float(np.mean(squares)) if len(squares) else 0.0
    if len(uv) < MIN_POINTS or not mean > 0:
        return None
    square = _square_distance(uv[:, 0], uv[:, 1], image_size)
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


def _square_distance(u: np.ndarray, v: np.ndarray, image_size: tuple[int, int]) -> np.ndarray:
    """Squares (n,) of distances from the middle of an image, in halves of its longer side."""
    width, height = image_size
    half = max(width, height) / 2
    x = (u - (width - 1) / 2) / half
    y = (v - (height - 1) / 2) / half
    with np.errstate(over='ignore'):  # no image has such pixels
        x *= x
        y *= y
        x += y
    return x
