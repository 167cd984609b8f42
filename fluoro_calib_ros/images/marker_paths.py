# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Ways of markers in space: place, velocity, and how long ago a place was known."""

from __future__ import annotations

import numpy as np

FORGET_VELOCITY = 0.5
MAX_AGE = 8  # exposures after the last place in space, for which it predicts
MIN_MOVES = 2  # between exposures, that give a velocity


class MarkerPaths:
    """Places and velocities of count markers in space.

    Attributes
    ----------
    xyz_mm : (n, 3) ndarray
        Last places, or where markers moved on to since; NaN where none was known.
    age : (n,) ndarray of int
        Frames since a place was known.
    """

    def __init__(self, count: int) -> None:
        self.xyz_mm = np.full((count, 3), np.nan)
        self.age = np.zeros(count, dtype=int)
        self._velocity = np.zeros((count, 3))
        self._moves = np.zeros(count, dtype=int)

    def predicted(self, frames: int) -> tuple[np.ndarray, np.ndarray]:
        """Places (n, 3) after a number of frames [mm], and which (n,) are to be relied on."""
        now = self.xyz_mm + frames * self._velocity
        good = np.isfinite(now).all(axis=1) & (self._moves >= MIN_MOVES) & (self.age <= MAX_AGE)
        return now, good

    def update(self, xyz_mm: np.ndarray, frames: int) -> None:
        """Take in places (n, 3) after a number of frames [mm], NaN for unknown."""
        now = xyz_mm.copy()
        velocity = (now - self.xyz_mm) / frames
        fresh = np.isfinite(velocity).all(axis=1)
        share = np.where(self._moves > 0, FORGET_VELOCITY, 1.0)[:, None]
        self._velocity[fresh] += (share * (velocity - self._velocity))[fresh]
        self._moves[fresh] += 1
        # A marker without a place in this exposure moves on.
        unknown = ~np.isfinite(now).all(axis=1)
        self.age = np.where(unknown, self.age + frames, 0)
        now[unknown] = (self.xyz_mm + frames * self._velocity)[unknown]
        self.xyz_mm = now
