# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Rays of markers in two views: corrected, intersected, and projected back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..correction.fluoroscope_calibration import FluoroscopeCalibration
from ..photogrammetry.rig_orientation import RigOrientation
from ..reconstruction.intersection import Intersector
from ..reconstruction.reconstruct import IntersectedViews, MatchedViews
from .markers import MarkerFrame

AGREE = 4.0  # standardised epipolar distance up to which two rays belong together
SYSTEMATIC_PX = 0.1  # of a corrected image point, beyond its standard deviation


@dataclass(frozen=True)
class PairExposure:
    """Markers of one exposure in all views, by row of all ids."""

    observed: NDArray[np.float64]  #: (2, n, 2) [px], NaN where a view does not see a marker
    doubtful: NDArray[np.bool_]  #: (2, n)
    intersected: IntersectedViews  #: corrected image points and the places of the markers

    @property
    def corrected(self) -> NDArray[np.float64]:
        """Corrected image points (2, n, 2) [px]."""
        return self.intersected.views.uv

    @property
    def sigma(self) -> NDArray[np.float64]:
        """Standard deviations (2, n) of the corrected image points [px]."""
        return self.intersected.views.sigma

    @property
    def xyz_mm(self) -> NDArray[np.float64]:
        """Places (n, 3) [mm]."""
        return self.intersected.points.xyz_mm

    @property
    def standardised(self) -> NDArray[np.float64]:
        """Epipolar distances (n,) over their standard deviations."""
        return self.intersected.points.standardised

    @property
    def agree(self) -> np.ndarray:
        """Return (n,) whether both rays of a marker meet."""
        return (self.standardised < AGREE) & np.isfinite(self.xyz_mm).all(axis=1)

    @property
    def sure(self) -> np.ndarray:
        """Return (n,) whether both rays of a marker meet, and no view doubts its id."""
        return self.agree & ~self.doubtful.any(axis=0)


class PairRays:
    """Rays of markers in two calibrated views.

    Parameters
    ----------
    calibrations : mapping of str to FluoroscopeCalibration
    orientation : RigOrientation
        That they belong to.
    names : sequence of str
        The two fluoroscopes.
    target_id : (n,) ndarray
        Of all markers, ascending.
    """

    def __init__(
        self,
        calibrations: Mapping[str, FluoroscopeCalibration],
        orientation: RigOrientation,
        names: Sequence[str],
        target_id: np.ndarray,
    ) -> None:
        self._calibrations = calibrations
        self._names = names
        self._target_id = target_id
        self._intersector = Intersector(orientation.subset(names), None)

    def intersect(
        self, views: Mapping[str, MarkerFrame], angles: Mapping[str, float | None]
    ) -> PairExposure:
        """Correct and intersect the markers of an exposure at angles [rad]."""
        n = len(self._target_id)
        observed = np.full((2, n, 2), np.nan)
        corrected = np.full((2, n, 2), np.nan)
        sigma, correction_sd = np.full((2, 2, n), np.nan)
        doubtful = np.zeros((2, n), dtype=bool)
        for view, name in enumerate(self._names):
            found = views[name]
            rows = np.searchsorted(self._target_id, found.target_id)
            observed[view, rows] = found.uv
            u, v, total, sd, _ = self._calibrations[name].correct_arrays(
                found.uv[:, 0].copy(), found.uv[:, 1].copy(), found.sigma, angles.get(name)
            )
            corrected[view, rows] = np.stack([u, v], axis=1)
            sigma[view, rows] = np.hypot(total, SYSTEMATIC_PX)
            correction_sd[view, rows] = np.hypot(sd, SYSTEMATIC_PX)
            doubtful[view, rows] = found.doubtful
        points = self._intersector.intersect(corrected, sigma)
        outside = np.zeros(sigma.shape, dtype=bool)
        matched = MatchedViews(self._target_id, corrected, sigma, correction_sd, outside)
        return PairExposure(observed, doubtful, IntersectedViews(matched, points))

    def exchanged(self, exposure: PairExposure, view: int, rows: Sequence[int]) -> np.ndarray:
        """Standardised epipolar distances (2,) of two markers if a view exchanged them."""
        pair = list(rows)
        uv = exposure.corrected[:, pair].copy()
        sigma = exposure.sigma[:, pair].copy()
        uv[view] = uv[view, ::-1]
        sigma[view] = sigma[view, ::-1]
        return self._intersector.intersect(uv, sigma).standardised

    def project(
        self, view: int, xyz_mm: np.ndarray, angles: Mapping[str, float | None]
    ) -> np.ndarray:
        """Observed pixels (k, 2) of points (k, 3) in the rig frame [mm] at angles [rad].

        They are NaN where a point is.
        """
        name = self._names[view]
        uv = np.full((len(xyz_mm), 2), np.nan)
        known = np.isfinite(xyz_mm).all(axis=1)
        if known.any():
            uv[known] = project_observed(
                self._intersector.orientation,
                view,
                self._calibrations[name],
                xyz_mm[known],
                angles.get(name),
            )
        return uv

    def spread(self, view: int, xyz_mm: np.ndarray, covariance: np.ndarray) -> np.ndarray:
        """Standard deviations (k,) of a coordinate in a view [px] of points (k, 3).

        covariance (k, 3, 3) is that of the points [mm^2].
        """
        rig = self._intersector.orientation
        axes = rig.rotation[view]
        sensor = (xyz_mm - rig.position_mm[view]) @ axes.T
        depth = sensor[:, 2, None, None]
        slope = rig.interior[view, 2] / depth * (axes[:2] - sensor[:, :2, None] / depth * axes[2])
        variance = np.trace(slope @ covariance @ np.swapaxes(slope, 1, 2), axis1=1, axis2=2)
        return np.asarray(np.sqrt(variance / 2))


STEPS = 3  # the correction changes slowly


def project_observed(
    orientation: RigOrientation,
    view: int,
    calibration: FluoroscopeCalibration,
    xyz: np.ndarray,
    angle: float | None = None,
) -> np.ndarray:
    """Observed pixels (k, 2) of points (k, 3) in the rig frame [mm].

    view is the row of the fluoroscope in the orientation; angle that of its C-arm [rad], None
    where it is unknown. The correction is a function of the
    observed pixel, so it is solved for by fixed-point iteration; where it is not defined, it is 0.
    """
    xp, yp, c = orientation.interior[view]
    sensor = (xyz - orientation.position_mm[view]) @ orientation.rotation[view].T
    ideal = sensor[:, :2] * (c / sensor[:, 2:]) + np.array([xp, yp])
    observed = ideal
    for _ in range(STEPS):
        u, v, _, _, _ = calibration.correct_arrays(
            observed[:, 0].copy(), observed[:, 1].copy(), angle=angle
        )
        step = ideal - np.stack([u, v], axis=1)
        observed = observed + np.where(np.isfinite(step), step, 0.0)
    return observed
