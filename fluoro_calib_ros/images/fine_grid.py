# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Blurred light behind several beads, on a grid finer than the pixels.

It is not the product of the blurred shadows of each, because light is blurred behind all of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .profile import Profile
from .texture import DTYPE

FINE = 3  # points per pixel

# absorbed(column, x, y): shares (g, c, c) of the light that the beads of a column absorb at
# distances x (g, 1, c) and y (g, c, 1) from their centres [px].
Absorption = Callable[[int, NDArray[np.float32], NDArray[np.float32]], NDArray[np.floating]]


@dataclass(frozen=True)
class Absorbers:
    """Beads in front of windows (g,): k columns, one bead of each window in each."""

    #: (q, g, k, 2), their places at q points of their paths, from the middle of the window [px]
    centre: NDArray[np.float64]
    weight: NDArray[np.float64]  #: (q,), weights of these points
    depth: NDArray[np.float64]  #: (g, k), depths of the shadows, 0 for no bead
    extent_px: NDArray[np.float64]  #: (g, k), distances beyond which they absorb no light
    absorbed: Absorption


class FineGrid:
    """Fine grid in windows of pixels (m, 2), relative to the middle of a window."""

    def __init__(self, offset: NDArray[np.int64], profile: Profile) -> None:
        self._blurs = profile.blurs
        half = int(np.abs(offset).max()) + int(np.ceil(3 * self._blurs[-1][1]))
        self._axis = np.arange(-half * FINE, half * FINE + 1) / FINE
        self._column, self._row = (offset.T + half) * FINE

    def light_behind(self, beads: Absorbers) -> NDArray[np.floating]:
        """Return the blurred light (g, m) behind beads, as a share of that without them."""
        count, columns = beads.depth.shape
        light = np.zeros((count, len(self._axis), len(self._axis)), dtype=DTYPE)
        for weight, centre in zip(beads.weight, beads.centre):
            passed = np.ones_like(light)
            for column in range(columns):
                self._attenuate(passed, beads, column, centre[:, column])
            light += weight * passed
        return np.stack([self._blurred(one) for one in light])

    def _attenuate(
        self,
        passed: NDArray[np.float32],
        beads: Absorbers,
        column: int,
        centre: NDArray[np.float64],
    ) -> None:
        """Attenuate light (g, a, a) by the beads of a column, in squares that contain them."""
        axis = self._axis
        count = min(int(2 * FINE * beads.extent_px[:, column].max()) + 3, len(axis))
        first = np.rint((centre - axis[0]) * FINE).astype(int) - count // 2
        place = np.clip(first, 0, len(axis) - count)[..., None] + np.arange(count)
        x, y = np.moveaxis(axis[place] - centre[..., None], 1, 0).astype(DTYPE)
        share = beads.absorbed(column, x[:, None], y[:, :, None])
        window = np.arange(len(passed))[:, None, None]
        points = window, place[:, 1, :, None], place[:, 0, None]
        passed[points] *= 1 - beads.depth[:, column, None, None] * share

    def _blurred(self, light: NDArray[np.float32]) -> NDArray[np.floating]:
        """Return blurred light (a, a) at the pixels (m,) of a window."""
        smooth = [
            weight * cv2.GaussianBlur(light, (0, 0), FINE * sigma, borderType=cv2.BORDER_REPLICATE)
            for weight, sigma in self._blurs
        ]
        return np.asarray(sum(smooth))[self._row, self._column]
