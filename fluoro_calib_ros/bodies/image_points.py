# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Image points of bodies, sorted by body and marker, and their derivatives at given poses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ..photogrammetry.rig_orientation import RigOrientation
from ..reconstruction.cameras import Cameras
from ..reconstruction.intersection import OK, OUTSIDE
from ..reconstruction.reconstruct import IntersectedViews
from .body import by_pose


@dataclass(frozen=True)
class ImagePoints:
    """Image points (B, M, F): uv, variances of noise and of correction, and whether seen."""

    uv: NDArray[np.float64]
    noise: NDArray[np.float64]
    correction: NDArray[np.float64]
    seen: NDArray[np.bool_]


@dataclass(frozen=True)
class Linear:
    """Image points at a pose: residuals (..., F, 2) and derivatives by place (..., F, 2, 3)."""

    residual: NDArray[np.float64]
    by_place: NDArray[np.float64]
    by_orientation: Callable[[], NDArray[np.float64]]  # (..., F, 2, 9), by T, w, xp, yp, c
    by_pose: NDArray[np.float64]  # (..., 3, 6), derivatives D of places with respect to the pose
    valid: NDArray[np.bool_]  # (..., F), whether seen, and the marker in front of the source


class BodyCameras(Cameras):
    """Fluoroscopes of a rig and their views of the markers of bodies.

    target_id: (B, M) markers of B bodies; -1 pads bodies with fewer markers.
    """

    def __init__(self, orientation: RigOrientation, target_id: NDArray[np.int64]) -> None:
        super().__init__(orientation)
        self.target_id = target_id
        self._ids: NDArray[np.integer] | None = None
        self._rows = np.zeros(0, dtype=int)

    def sorted(self, exposure: IntersectedViews) -> ImagePoints:
        """Sort the image points of an exposure by bodies and their markers."""
        views = exposure.views
        ids = views.target_id
        if self._ids is None or len(ids) != len(self._ids) or (ids != self._ids).any():
            order = np.argsort(ids)
            positions = np.searchsorted(ids[order], self.target_id.ravel())
            known = np.append(ids[order], -2)[positions] == self.target_id.ravel()  # -1 is padding
            self._rows = np.where(known, np.append(order, -1)[positions], len(ids))
            self._ids = ids
        shape = (*self.target_id.shape, self.count)
        # One additional row for markers that are not present.
        padded = np.full((self.count, len(ids) + 1, 4), np.nan)
        padded[:, :-1, :2] = views.uv
        padded[:, :-1, 2] = views.sigma
        padded[:, :-1, 3] = views.correction_sd
        dropped = exposure.points.dropped_view
        with_dropped = np.flatnonzero(dropped >= 0)
        padded[dropped[with_dropped].astype(int), with_dropped] = np.nan
        sorted_ = padded[:, self._rows].transpose(1, 0, 2).reshape(*shape, 4)
        seen = np.isfinite(sorted_).all(axis=-1)
        sorted_ = np.where(seen[..., None], sorted_, 0.0)
        total = sorted_[..., 2] ** 2
        correction = np.minimum(sorted_[..., 3] ** 2, 0.99 * total)
        noise = np.where(seen, total - correction, 1.0)
        return ImagePoints(sorted_[..., :2], noise, correction, seen)

    def places(self, exposure: IntersectedViews) -> NDArray[np.float64]:
        """Return places (B, M, 3) [mm] of markers in the last sorted exposure; NaN if unknown."""
        points = exposure.points
        intersected = (points.status == OK) | (points.status == OUTSIDE)
        xyz = np.concatenate(
            [np.where(intersected[:, None], points.xyz_mm, np.nan), [[np.nan] * 3]]
        )
        return xyz[self._rows].reshape(*self.target_id.shape, 3)


def linear_at(
    cameras: Cameras,
    xyz: NDArray[np.float64],
    pose: tuple[NDArray[np.float64], NDArray[np.float64]],
    uv: NDArray[np.float64],
    seen: NDArray[np.bool_],
) -> Linear:
    """Return residuals and derivatives of image points uv (..., M, F, 2) at given poses.

    xyz (..., M, 3): markers relative to the centre of their body. pose: rotations (..., 3, 3) and
    centres (..., 3). seen (..., M, F).
    """
    rotation, centre = pose
    arm = xyz @ np.swapaxes(rotation, -1, -2)
    image = cameras.image(arm + centre[..., None, :])
    depth = np.where(image[..., 2] > 0, image[..., 2], np.nan)
    predicted = np.where(depth[..., None] > 0, image[..., :2] / depth[..., None], 0.0)
    by_place = cameras.by_place(predicted, depth)
    valid = seen & np.isfinite(depth)
    residual = np.where(valid[..., None], uv - predicted, 0.0)
    by_place = np.where(valid[..., None, None], by_place, 0.0)
    by_orientation = partial(cameras.by_orientation, predicted, by_place)
    return Linear(residual, by_place, by_orientation, by_pose(arm), valid)
