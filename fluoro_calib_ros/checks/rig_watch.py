# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The drift watch of an oriented rig: turns corrected views into its observations.

It separates the noise of an image point from the error of its correction: the one is new in every
frame, the other stays the same at a place and does not average out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ..photogrammetry.rig_orientation import RigOrientation
from ..reconstruction.epipolar import EpipolarGeometry
from ..reconstruction.intersection import OK, IntersectedPoints
from .cluster_watch import Cluster
from .drift_observations import EpipolarObservations, PointObservations
from .drift_options import DriftOptions, DriftState
from .drift_watch import DriftWatch

# A residual above FALSE_MATCH_SD standard deviations and FALSE_MATCH_PX more is that of a false
# match. Up to there it may be that of a drift, even if the intersection rejects it.
FALSE_MATCH_SD = 4.0
FALSE_MATCH_PX = 3.0


class RigDriftWatch:
    """Drift watch of one RigOrientation; a new orientation needs a new one.

    Parameters
    ----------
    orientation : RigOrientation
    image_sizes : mapping of str to tuple of int
        Width and height of the images by fluoroscope [px].
    options : DriftOptions, optional
    clusters : sequence of Cluster
    rate_hz : float
        Largest number of exposures to examine per second.

    Raises
    ------
    ValueError
        As DriftWatch.
    DataError
        For a rig with two sources in one place.
    """

    def __init__(
        self,
        orientation: RigOrientation,
        image_sizes: Mapping[str, tuple[int, int]],
        options: DriftOptions | None = None,
        clusters: Sequence[Cluster] = (),
        rate_hz: float = 120.0,
    ) -> None:
        names = orientation.fluoroscopes
        self._names = names
        self._pairs = [
            (i, j, EpipolarGeometry(orientation, names[i], names[j]))
            for i, j in combinations(range(len(names)), 2)
        ]
        sizes = {name: image_sizes[name] for name in names}
        self._watch = DriftWatch(sizes, options, clusters, orientation)
        # Stamps jitter: a stream at this very rate must not lose any exposure.
        self._min_interval_ns = round(0.9e9 / rate_hz)
        self._last_ns: int | None = None
        self._has_clusters = bool(clusters)

    @property
    def options(self) -> DriftOptions:
        """Options of the watch."""
        return self._watch.options

    @property
    def state(self) -> DriftState:
        """Present state."""
        return self._watch.state

    @property
    def watched_s(self) -> float:
        """Time after the start in which a drift could have been detected somewhere [s]."""
        return self._watch.watched_s

    def is_due(self, stamp_ns: int) -> bool:
        """Whether an exposure with this stamp is to be examined."""
        last = self._last_ns
        return last is None or not 0 <= stamp_ns - last < self._min_interval_ns

    def add_exposure(
        self,
        stamp_ns: int,
        target_id: NDArray[np.int64],
        uv: NDArray[np.float64],
        sigma: NDArray[np.float64],
        correction_sd: NDArray[np.float64],
        points: IntersectedPoints,
    ) -> DriftState:
        """Add an exposure and return the state.

        Parameters
        ----------
        stamp_ns : int
        target_id : ndarray
            (n,)
        uv : ndarray
            (F, n, 2), corrected pixels, NaN where a fluoroscope does not see a target.
        sigma, correction_sd : ndarray
            (F, n), standard deviations of the corrected pixels, and of the correction alone [px].
        points : IntersectedPoints
        """
        self._last_ns = stamp_ns
        noise2 = np.maximum(sigma * sigma - correction_sd * correction_sd, 0)
        for i, j, geometry in self._pairs:
            found = geometry.residuals(uv[i], uv[j], sigma[i], sigma[j])
            noise = found.factor_a**2 * noise2[i] + found.factor_b**2 * noise2[j]
            limit = FALSE_MATCH_SD * found.sd_total + FALSE_MATCH_PX
            good = np.flatnonzero(np.abs(found.residual) <= limit)
            observations = EpipolarObservations(
                target_id[good],
                uv[i][good],
                uv_b=uv[j][good],
                residual=found.residual[good],
                sd_noise=np.sqrt(noise[good]),
                sd_systematic=np.sqrt(np.maximum(found.sd_total**2 - noise, 0))[good],
                normal_a=found.normal_a[good],
                normal_b=found.normal_b[good],
                factor_a=found.factor_a[good],
                factor_b=found.factor_b[good],
            )
            self._watch.add_residuals(stamp_ns, self._names[i], self._names[j], observations)
        if self._has_clusters:
            noise_fraction = _mean_where_finite(noise2 / (sigma * sigma))
            covariance = points.covariance_noise * noise_fraction[:, None, None]
            good = np.flatnonzero(points.status == OK)
            self._watch.add_points(
                stamp_ns,
                PointObservations(
                    target_id[good],
                    points.xyz_mm[good],
                    covariance[good],
                    uv[:, good],
                    correction_sd[:, good],
                ),
            )
        return self.state


def _mean_where_finite(values: np.ndarray) -> np.ndarray:
    """Means (n,) of the finite values (F, n) of every column, 0 where there are none."""
    finite = np.isfinite(values)
    return np.where(finite, values, 0).sum(axis=0) / np.maximum(finite.sum(axis=0), 1)
