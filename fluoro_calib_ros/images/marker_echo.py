# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Earlier images in an image: recursive filters against noise, lag of the detector.

A marker that moves then has a faint shadow where it was before, which attracts its centre. The
shares of earlier images are estimated from these shadows, in all images together.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..photogrammetry.noise import CERTAIN
from .marker_motion import FORGET, Motion

ECHOES = 2  # earlier images whose shares in an image are observed
# Share from which an earlier image counts. Images without any show up to 0.03, as their shutter is
# given, and a share of 0.05 shifts a marker by no more than 0.025 of its motion between images.
LEAST_ECHO = 0.05


class Echo:
    """Shares of the images before in an image, such as by a recursive filter or detector lag."""

    def __init__(self) -> None:
        self.shares = np.zeros(0)  #: (k,), latest image first
        self._matrix = np.zeros((ECHOES, ECHOES))
        self._right = np.zeros(ECHOES)
        self._uv: list[NDArray[np.float64]] = []  # centres (n, 2) in the last images

    def before(self, rows: NDArray[np.int64], motion: Motion, frames: int) -> NDArray[np.float64]:
        """Return centres (k, m, 2) of markers in the images before, measured or predicted.

        frames: number of frames since the last image.
        """
        out = []
        for number in range(ECHOES):
            uv = motion.uv[rows] - (frames + number) * motion.velocity[rows]
            if number < len(self._uv):
                uv = np.where(np.isfinite(self._uv[number][rows]), self._uv[number][rows], uv)
            out.append(uv)
        return np.stack(out)

    def add(self, uv: NDArray[np.float64]) -> None:
        """Note centres (n, 2) in an image, NaN for markers that are not measured."""
        self._uv = [uv, *self._uv][:ECHOES]

    def observe(
        self, matrix: NDArray[np.float64], right: NDArray[np.float64], factor: float
    ) -> None:
        """Add normal equations of changes of the shares, whose noise is larger by a factor."""
        if len(self._uv) < ECHOES:
            return
        now = np.append(self.shares, np.zeros(ECHOES - len(self.shares)))
        self._matrix = FORGET * self._matrix + matrix
        self._right = FORGET * self._right + right + matrix @ now
        if np.linalg.cond(self._matrix) > 1e6:
            return
        covariance = np.linalg.inv(self._matrix)
        shares = covariance @ self._right
        sd = factor * np.sqrt(np.diag(covariance))
        counts = (shares > LEAST_ECHO) & (shares > CERTAIN * sd)
        self.shares = np.maximum(shares, 0) if counts[0] else np.zeros(0)
