# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Projections of points by all fluoroscopes of a rig at once, and their derivatives."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..photogrammetry.rig_orientation import ORIENTATION_SIZE, RigOrientation


class Cameras:
    """The F fluoroscopes of a rig; see `photogrammetry.collinearity` for the formulas."""

    def __init__(self, orientation: RigOrientation) -> None:
        self.interior = orientation.interior
        self.count = len(orientation.fluoroscopes)
        camera = np.zeros((self.count, 3, 3))
        camera[:, 0, 0] = camera[:, 1, 1] = self.interior[:, 2]
        camera[:, :, 2] = np.column_stack([self.interior[:, :2], np.ones(self.count)])
        #: (F, 3, 3), (F, 3): a point P has the homogeneous image coordinates rows P + shift
        self.rows = camera @ orientation.rotation
        self.shift = -(self.rows @ orientation.position_mm[:, :, None])[:, :, 0]
        self._matrix = self.rows.reshape(-1, 3).T.copy()
        self._flat_shift = self.shift.reshape(-1)
        self._uv_rows = self.rows[:, :2]
        self._depth_rows = self.rows[:, 2:]
        #: (F, 9, k): root of the orientation covariance, by independent unknowns of unit variance
        self.root = orientation.covariance_root().reshape(self.count, ORIENTATION_SIZE, -1)

    def image(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return homogeneous image points (..., F, 3) of points (..., 3): u w, v w, depth w."""
        image = points @ self._matrix + self._flat_shift
        return image.reshape(*points.shape[:-1], self.count, 3)

    def by_place(self, uv: NDArray[np.float64], depth: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return derivatives (..., F, 2, 3) of image points uv (..., F, 2) by their places."""
        return (self._uv_rows - uv[..., None] * self._depth_rows) / depth[..., None, None]

    def by_orientation(
        self, uv: NDArray[np.float64], by_place: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return derivatives (..., F, 2, 9) of image points by T, w, xp, yp, c."""
        c = self.interior[:, 2]
        xy = (uv - self.interior[:, :2]) / c[:, None]
        x, y = xy[..., 0], xy[..., 1]
        out = np.zeros((*x.shape, 2, ORIENTATION_SIZE))
        out[..., :3] = -by_place
        out[..., 0, 3] = out[..., 1, 4] = c * x * y
        out[..., 0, 3] *= -1
        out[..., 0, 4] = c * (1 + x * x)
        out[..., 0, 5] = -c * y
        out[..., 1, 3] = -c * (1 + y * y)
        out[..., 1, 5] = c * x
        out[..., 0, 6] = out[..., 1, 7] = 1
        out[..., :, 8] = xy
        return out
