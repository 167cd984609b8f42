# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What is known of markers from image to image: motion, depth of the shadow, images unseen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .marker_motion import Motion

SHADOW_SD_PX = 0.35  # of the place of a shadow before it is measured
DEPTH_SD = 1.0  # of the depth of a marker that is not known yet
KNOWN_DEPTH_SD = 0.15
DEPTH_MEMORY = 0.9


@dataclass(frozen=True)
class MeasuredMarkers:
    """Shadows of n markers in one image, by row."""

    measured: NDArray[np.bool_]  #: (n,), the other values say nothing where it is False
    uv: NDArray[np.float64]  #: (n, 2), centres [px]
    sigma: NDArray[np.float64]  #: (n,), standard deviation of a coordinate [px]
    depth: NDArray[np.float64]  #: (n,)
    #: (n,), the shadow of another marker reaches into that of the marker
    overlapped: NDArray[np.bool_]
    free: NDArray[np.float64]  #: (k, 2), shadows that no marker has [px]

    @classmethod
    def nothing(cls, count: int) -> MeasuredMarkers:
        """Return the result of an image in which none of the markers is seen."""
        nowhere = np.zeros(count, dtype=bool)
        none = np.zeros(count)
        uv = np.zeros((count, 2))
        return cls(nowhere, uv, sigma=none, depth=none, overlapped=nowhere, free=np.zeros((0, 2)))


@dataclass
class MarkerStates:
    """What is known of n markers, by row."""

    motion: Motion
    #: (n,), of the shadow, 1 for that of a typical marker
    depth: NDArray[np.float64]
    depth_sd: NDArray[np.float64]
    unseen: NDArray[np.int64]  #: (n,), images since a marker was measured

    @classmethod
    def start(cls, motion: Motion, unseen: np.ndarray) -> MarkerStates:
        """Return the states of markers whose depth is not known."""
        n = len(unseen)
        return cls(motion, depth=np.ones(n), depth_sd=np.full(n, DEPTH_SD), unseen=unseen)

    @property
    def shadow_variance(self) -> np.ndarray:
        """Variances (n,) of a coordinate of a shadow less that of the prediction [px^2]."""
        return self.motion.variance + SHADOW_SD_PX**2

    def advance(self, frames: int, led: np.ndarray | None) -> None:
        """Predict all markers; led (n,) are those whose velocity follows that of others."""
        self.motion.predict(frames, led)
        self.unseen += 1

    def update(self, found: MeasuredMarkers, frames: int) -> None:
        """Take in the markers that were measured, frames after the image before."""
        rows = np.flatnonzero(found.measured)
        self.motion.update(rows, found.uv[rows], found.sigma[rows], frames)
        self.unseen[rows] = 0
        # The depth of a shadow is that of its marker alone.
        free = rows[~found.overlapped[rows]]
        first = self.depth_sd[free] > KNOWN_DEPTH_SD
        memory = np.where(first, 0.0, DEPTH_MEMORY)
        self.depth[free] = memory * self.depth[free] + (1 - memory) * found.depth[free]
        self.depth_sd[free] = KNOWN_DEPTH_SD

    def exchange(self, one: int, other: int) -> None:
        """Exchange the states of two markers."""
        self.motion.exchange(one, other)
        for values in (self.depth, self.depth_sd, self.unseen):
            values[[one, other]] = values[[other, one]]

    def forget(self, row: int, unseen: int) -> None:
        """Forget where a marker is, as if it had not been measured for a number of images."""
        self.motion.scatter(row)
        self.unseen[row] = unseen
