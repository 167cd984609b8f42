# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Points in space where the rays of round shadows of several views meet.

All pairs of shadows of every two views whose rays meet (epipolar distance) are intersected, and
joined by shadows of further views that lie on the point. A point of fewer views is discarded if
points of more views explain all its shadows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..correction.fluoroscope_calibration import CorrectedPoints
from ..photogrammetry.rig_orientation import RigOrientation
from ..reconstruction.epipolar import EpipolarGeometry
from ..reconstruction.intersection import OK, OUTSIDE, IntersectedPoints
from .marker_motion import SHADOW_SD_PX
from .marker_rays import AGREE, CalibratedRig, RayFit


@dataclass(frozen=True)
class ShadowPoints:
    """Points in space where rays of shadows meet."""

    xyz: NDArray[np.float64]  #: (n, 3) [mm]
    variance: NDArray[np.float64]  #: (n,), variance in the direction in which it is largest [mm^2]
    shadow: NDArray[np.int64]  #: (n, F), row of the shadow in each view, -1 if there is none


def all_among(shadow: NDArray[np.int64], others: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return whether all shadows (n, F) of points are also shadows (k, F) of other points."""
    among = [np.isin(column, other_column) for column, other_column in zip(shadow.T, others.T)]
    return np.asarray((np.column_stack(among) | (shadow < 0)).all(axis=1))


def shadow_points(shadows: Sequence[NDArray[np.float64]], rig: CalibratedRig) -> ShadowPoints:
    """Return the points where rays of shadows (k, 2) of all views [px] meet."""
    names = rig.orientation.fluoroscopes
    rays = _Rays(
        [
            rig.calibrations[name].correct(uv, angle=rig.angles.get(name))
            for name, uv in zip(names, shadows)
        ],
        rig.orientation,
    )
    shadow = rays.pairs()
    points, agree = rays.intersect(shadow)
    shadow, xyz = shadow[agree], points.xyz_mm[agree]
    for view in range(len(names)):
        open_rows = np.flatnonzero(shadow[:, view] < 0)
        place = rig.project(view, xyz[open_rows])
        is_before = np.isfinite(place).all(axis=1)
        open_rows = open_rows[is_before]
        if not len(open_rows) or not len(shadows[view]):
            continue
        _, nearest = cKDTree(shadows[view]).query(place[is_before])
        extended = shadow[open_rows]
        extended[:, view] = nearest
        points, agree = rays.intersect(extended)
        shadow[open_rows[agree]] = extended[agree]
        xyz[open_rows[agree]] = points.xyz_mm[agree]
    kept = _explaining(shadow)
    shadow, xyz = shadow[kept], xyz[kept]
    return ShadowPoints(xyz, rays.variance(shadow), shadow)


def _explaining(shadow: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return rows (k,) of distinct points that are needed to explain shadows (n, F)."""
    _, first = np.unique(shadow, axis=0, return_index=True)
    rows = np.sort(first)
    count = (shadow[rows] >= 0).sum(axis=1)
    keep = np.ones(len(rows), dtype=bool)
    for rays in range(shadow.shape[1], 2, -1):
        supported = shadow[rows[keep & (count >= rays)]]
        keep &= (count >= rays) | ~all_among(shadow[rows], supported)
    return rows[keep]


class _Rays:
    """Rays of corrected shadows of all views."""

    def __init__(self, corrected: Sequence[CorrectedPoints], orientation: RigOrientation) -> None:
        self._corrected = corrected
        self._orientation = orientation
        self._fit = RayFit(orientation)

    def pairs(self) -> NDArray[np.int64]:
        """Return rows (n, F) of the pairs of shadows whose rays meet, -1 for other views."""
        names = self._orientation.fluoroscopes
        out = [np.zeros((0, len(names)), dtype=np.int64)]
        for view_a, view_b in combinations(range(len(names)), 2):
            views = self._corrected[view_a], self._corrected[view_b]
            a, b = np.indices((len(views[0].uv), len(views[1].uv))).reshape(2, -1)
            uv = np.stack([views[0].uv[a], views[1].uv[b]])
            sigma = np.hypot(np.stack([views[0].sigma[a], views[1].sigma[b]]), SHADOW_SD_PX)
            geometry = EpipolarGeometry(self._orientation, names[view_a], names[view_b])
            rays = geometry.residuals(uv[0], uv[1], sigma[0], sigma[1])
            meeting = np.abs(rays.residual) < AGREE * rays.sd_total
            shadow = np.full((np.count_nonzero(meeting), len(names)), -1)
            shadow[:, view_a] = a[meeting]
            shadow[:, view_b] = b[meeting]
            out.append(shadow)
        return np.concatenate(out)

    def intersect(self, shadow: NDArray[np.int64]) -> tuple[IntersectedPoints, NDArray[np.bool_]]:
        """Intersect shadows (n, F); return the points, and whether (n,) all their rays meet."""
        uv = self._uv(shadow)
        sigma = np.full(uv.shape[:2], np.nan)
        for view, (corrected, row) in enumerate(zip(self._corrected, shadow.T)):
            has_shadow = row >= 0
            sigma[view, has_shadow] = np.hypot(corrected.sigma[row[has_shadow]], SHADOW_SD_PX)
        points, misfit = self._fit.intersect(uv, sigma)
        agree = np.isin(points.status, (OK, OUTSIDE)) & ((misfit < AGREE) | (shadow.T < 0)).all(
            axis=0
        )
        return points, agree

    def variance(self, shadow: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return variances (n,) of points of shadows (n, F) in their largest direction [mm^2].

        Errors of orientation and correction are excluded: they hardly differ within a body.
        """
        uv = self._uv(shadow)
        points, _ = self._fit.intersect(uv, np.full(uv.shape[:2], SHADOW_SD_PX))
        return np.asarray(np.linalg.eigvalsh(points.covariance_noise)[:, -1])

    def _uv(self, shadow: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return corrected image points (F, n, 2) [px], NaN if there is no shadow."""
        uv = np.full((shadow.shape[1], len(shadow), 2), np.nan)
        for view, (corrected, row) in enumerate(zip(self._corrected, shadow.T)):
            has_shadow = row >= 0
            uv[view, has_shadow] = corrected.uv[row[has_shadow]]
        return uv
