# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Errors of points in space due to errors of a rig and drifts of its distortion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..photogrammetry.network import DATUM_DEFECT, similarity_directions
from ..photogrammetry.rig_orientation import ORIENTATION_SIZE, RigOrientation
from ..photogrammetry.unknowns import POSE_SIZE
from ..reconstruction.cameras import Cameras
from .rig_adjustment import RigAdjustment, root_of


@dataclass(frozen=True)
class RigErrors:
    """Errors of points due to those of a rig: relative to each other, and common to all."""

    scale: float  #: standard deviation of the scale
    place_mm: float  #: sd of a coordinate, after removing the common rigid motion
    #: RMS distance of the common motion of the points as a rigid body
    common_mm: float


def rig_errors(orientation: RigOrientation, points_mm: NDArray[np.float64]) -> RigErrors:
    """Return the errors of points (n, 3) due to the errors of an orientation.

    The points move by -(A'A)^-1 A'B do (see `intersection`). The scale error is that of the
    best-fit similarity about the centre; the place error is what a rigid motion does not explain.
    """
    image = _Intersected.of(orientation, points_mm)
    return _errors(points_mm, image.moved(image.by_rig) @ orientation.covariance_root())


def drift_errors(
    adjustment: RigAdjustment, covariance: NDArray[np.float64], points_mm: NDArray[np.float64]
) -> tuple[RigErrors, float]:
    """Return the errors of points (n, 3) due to rig and drifts with a covariance (K, K).

    Also returns the RMS distance [mm] by which noise of 1 px moves a point.
    """
    image = _Intersected.of(adjustment.orientation, points_mm)
    functions = adjustment.functions_at(image.uv)
    _, views, count = functions.shape
    by_drift = np.zeros((len(points_mm), views, 2, views, 2, count))
    for f in range(views):
        for axis in range(2):
            by_drift[:, f, axis, f, axis] = functions[:, f]
    derivatives = [image.by_rig, by_drift.reshape(*image.by_rig.shape[:3], -1)]
    rows = np.r_[adjustment.rig, adjustment.drift]
    root = root_of(covariance[np.ix_(rows, rows)])
    noise = np.sqrt(np.mean(np.sum(image.by_uv**2, axis=(1, 2))))
    motions = image.moved(np.concatenate(derivatives, axis=-1)) @ root
    return _errors(points_mm, motions), float(noise)


@dataclass(frozen=True)
class _Intersected:
    """Image points uv (n, F, 2) of points (n, 3), and the dependence of the points on them.

    by_rig (n, F, 2, 9F): derivatives of the image points by the orientation. by_uv (n, 3, 2F):
    derivatives of the points by the image points.
    """

    uv: NDArray[np.float64]
    by_rig: NDArray[np.float64]
    by_uv: NDArray[np.float64]

    @classmethod
    def of(cls, orientation: RigOrientation, points_mm: NDArray[np.float64]) -> _Intersected:
        cameras = Cameras(orientation)
        views = cameras.count
        image = cameras.image(points_mm)
        uv = image[..., :2] / image[..., 2:]
        by_view = cameras.by_place(uv, image[..., 2])
        by_place = by_view.reshape(len(points_mm), -1, 3)
        by_rig = np.zeros((len(points_mm), views, 2, views, ORIENTATION_SIZE))
        by_orientation = cameras.by_orientation(uv, by_view)
        for f in range(views):
            by_rig[:, f, :, f] = by_orientation[:, f]
        transposed = np.swapaxes(by_place, 1, 2)
        by_uv = np.asarray(np.linalg.solve(transposed @ by_place, transposed), dtype=float)
        return cls(np.asarray(uv), by_rig.reshape(*by_rig.shape[:3], -1), by_uv)

    def moved(self, derivatives: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the motion of points (3n, k), from derivatives (n, F, 2, k) of their views."""
        flat = derivatives.reshape(len(self.uv), -1, derivatives.shape[-1])
        return np.asarray(-(self.by_uv @ flat).reshape(-1, flat.shape[2]))


def _errors(points_mm: NDArray[np.float64], moved: NDArray[np.float64]) -> RigErrors:
    """Return errors of points (n, 3) with motions moved (3n, k) by unknowns of unit variance."""
    similarity = similarity_directions(points_mm, points_mm.mean(axis=0)).reshape(-1, DATUM_DEFECT)
    rigid = similarity[:, :POSE_SIZE].copy()
    scale = np.linalg.pinv(similarity)[-1] @ moved
    rigid_part = rigid @ (np.linalg.pinv(rigid) @ moved)
    by_coordinate = (
        np.sqrt(np.mean(np.sum(x**2, axis=1))) for x in (moved - rigid_part, rigid_part)
    )
    place_mm, common_mm = map(float, by_coordinate)
    return RigErrors(
        float(np.sqrt(scale @ scale)), place_mm, common_mm=float(np.sqrt(3)) * common_mm
    )
