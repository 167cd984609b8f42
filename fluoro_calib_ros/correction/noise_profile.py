# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Noise of image coordinates that differs between the middle of the image and its border.

The logarithm of the variance is a linear function of the squared distance from the middle:
multiplicative heteroscedasticity (Harvey, Econometrica 44, 1976).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MAX_FACTOR = 10.0  # of the border over the middle, or the inverse


@dataclass(frozen=True)
class NoiseProfile:
    """Factors of the standard deviation of image coordinates over an image."""

    #: factors in the middle of the image, and at the border and beyond; the mean of their squares
    #: over the image points is one
    middle: float
    rim: float
    #: distance of the border from the middle, in halves of the longer side: no image points are
    #: known beyond
    reach: float

    def factors(
        self, u: np.ndarray, v: np.ndarray, image_size: tuple[int, int]
    ) -> NDArray[np.float64]:
        """Return the factors (n,) at pixels u, v (n,)."""
        square = np.minimum(square_distance(u, v, image_size), self.reach**2)
        square *= math.log(self.rim / self.middle) / self.reach**2
        return self.middle * np.exp(square)

    def packed(self) -> NDArray[np.float64]:
        """Return middle, border and reach (3,), for files and messages."""
        return np.array([self.middle, self.rim, self.reach])


def packed_profile(profile: NoiseProfile | None) -> NDArray[np.float64]:
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


def square_distance(u: np.ndarray, v: np.ndarray, image_size: tuple[int, int]) -> np.ndarray:
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
