# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Estimate a change of the rig from the rays of an alarm, as an addition to its covariance.

The unknowns of the rig have changed by d. Epipolar residuals are r = -J d + noise. A cause, such
as a knock, of size s is a normal prior of d with covariance s^2 D (see healing.sizes). With the
normal equations N = J'WJ and g = -J'Wr, a cause of a given size has posterior mean m and
covariance P and evidence Z,

    P = (N + (s^2 D)^-1)^-1,  m = P g,  log Z = 1/2 g'Pg - 1/2 log det(I + s^2 N D).

Points are still intersected with the rig as it was calibrated, so d is its error. The second
moment of d is added to the covariance of the rig: the mean of m m' + P over causes and sizes,
weighted by Z. In directions that the rays do not determine, along epipolar lines, it is that of a
change as large as in the determined ones. Unexplained residuals increase the noise of image
points.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..healing.sizes import ChangeStatistics, parts_of_interior, parts_of_knock
from ..photogrammetry.noise import CERTAIN, NORMAL_MEDIAN
from ..photogrammetry.rig_orientation import ORIENTATION_SIZE, RigOrientation
from ..reconstruction.epipolar import EpipolarGeometry
from ..rows import chosen_rows, joined_rows
from .drift_charts import EpipolarObservations

WINDOW = 8  # newest blocks from which a change is estimated
SIZES = np.geomspace(2.0**-7, 4.0, 10)  # sizes of a change, relative to a knock
# Ratio of the variances of the median and the mean of normal errors.
MEDIAN_VARIANCE = np.pi / 2
ITERATIONS = 10
NU = 4.0  # degrees of freedom of the t distribution that weights residuals
# Consecutive blocks, with a minimum number of markers and most rays apart, that show a knock.
KNOCKED_BLOCKS = 2
MIN_MARKERS = 3


@dataclass(frozen=True)
class Addition:
    """Addition to the errors of a rig and of its image points."""

    covariance: NDArray[np.float64]  #: (9F, 9F)
    image_sd: float  #: standard deviation of each image coordinate [px]
    miss: float  #: RMS of the distances by which rays miss each other [px]


@dataclass(frozen=True)
class _Rays:
    """Residuals (n,) of pairs of rays, and their derivatives (n, 9F) with respect to the rig."""

    residual: NDArray[np.float64]
    noise: NDArray[np.float64]  # variance
    systematic: NDArray[np.float64]  # variance of the constant part
    by_rig: NDArray[np.float64]
    is_apart: NDArray[np.bool_]  # whether the rays miss each other


class RigChange:
    """Collects the rays of the newest blocks, and estimates a change from them.

    pairs: indices of the fluoroscopes of each pair, and their geometry.
    """

    def __init__(
        self, orientation: RigOrientation, pairs: Sequence[tuple[int, int, EpipolarGeometry]]
    ) -> None:
        self._orientation = orientation
        self._pairs = tuple(pairs)
        self._hypotheses = _hypotheses(orientation)
        self._open: list[list[EpipolarObservations]] = [[] for _ in self._pairs]
        self._blocks: deque[_Rays] = deque(maxlen=WINDOW)
        self._has_met = False
        self.blocks_apart = 0  #: consecutive blocks whose rays are apart

    def add(self, number: int, observations: EpipolarObservations) -> None:
        """Add the image points of a pair in an exposure."""
        is_finite = np.isfinite(observations.residual)
        self._open[number].append(chosen_rows(observations, is_finite))

    def close(self) -> None:
        """End a block."""
        parts = [
            self._median(number, joined_rows(collected))
            for number, collected in enumerate(self._open)
            if collected
        ]
        self._open = [[] for _ in self._pairs]
        if not parts:
            return
        rays = joined_rows(parts)
        if len(rays.residual) < MIN_MARKERS:
            return
        self._blocks.append(rays)
        is_apart = bool(rays.is_apart.mean() > 0.5)
        self.blocks_apart = self.blocks_apart + 1 if is_apart else 0
        self._has_met |= not is_apart

    @property
    def share_apart(self) -> float:
        """Share of the rays of a knocked rig that miss each other; 0 without a knock.

        If rays have never met, they are confused, or belong to another rig.
        """
        if not self._has_met or self.blocks_apart < KNOCKED_BLOCKS:
            return 0.0
        return float(self._blocks[-1].is_apart.mean())

    def _median(self, number: int, observations: EpipolarObservations) -> _Rays:
        """Return the median residual per marker in a block, which is robust to false matches."""
        order = np.lexsort((observations.residual, observations.target_id))
        target_id = observations.target_id[order]
        _, first, count = np.unique(target_id, return_index=True, return_counts=True)
        rays = chosen_rows(observations, order[first + count // 2])
        i, j, geometry = self._pairs[number]
        derivative = np.zeros((len(rays), ORIENTATION_SIZE * len(self._orientation.fluoroscopes)))
        columns_of_pair = self._orientation.covariance_rows([i, j])
        derivative[:, columns_of_pair] = geometry.by_orientation(*rays.uv)
        return _Rays(
            rays.residual,
            MEDIAN_VARIANCE * rays.noise / count,
            rays.systematic,
            derivative,
            np.abs(rays.residual) > CERTAIN * rays.sd_total,
        )

    def addition(self, blocks: int) -> Addition | None:
        """Return the addition from this many newest blocks, at most WINDOW; None without any."""
        newest = list(self._blocks)[-max(blocks, 1) :]
        if not newest:
            return None
        rays = joined_rows(newest)
        # The systematic error of a stationary marker does not average out.
        variance = rays.noise + len(newest) * rays.systematic
        broad = np.sqrt(np.sum([sd**2 for sd in self._hypotheses], axis=0)) * SIZES[-1]
        design = rays.by_rig * broad
        factor, weight = _weights(design, rays.residual, variance)
        normal = rays.by_rig.T @ (rays.by_rig * weight[:, None])
        right = -rays.by_rig.T @ (weight * rays.residual)
        statistics = ChangeStatistics(normal, right)
        moments = np.zeros((len(self._hypotheses), len(SIZES), *normal.shape))
        evidence = []
        for moments_of_sizes, sd in zip(moments, self._hypotheses):
            rows = np.flatnonzero(sd)
            selected = statistics.only(rows)
            sizes = SIZES[:, None] * sd[rows]
            moments_of_sizes[:, rows[:, None], rows] = selected.moments(sizes)
            evidence.append(selected.evidence(sizes))
        share = np.exp(np.array(evidence) - np.max(evidence))
        covariance = np.tensordot(share / share.sum(), moments, axes=2)
        return Addition(
            (covariance + covariance.T) / 2,
            float(np.sqrt(max(factor - 1, 0.0) * np.median(variance))),
            float(np.sqrt(np.mean(np.minimum(rays.residual**2, _cap(rays.residual))))),
        )


def _cap(residual: NDArray[np.float64]) -> float:
    """Return the square of a residual above which it counts as false in a mean."""
    return float(9 * np.median(residual**2) / NORMAL_MEDIAN**2)


def _hypotheses(orientation: RigOrientation) -> list[NDArray[np.float64]]:
    """Return standard deviations (9F,) of a knock, and of source against detector, by view.

    With two views, only the orientation of one relative to the other is observable.
    """
    views = len(orientation.fluoroscopes)
    out = []
    for f in range(views):
        if views > 2 or f > 0:
            out.append(np.linalg.norm(parts_of_knock(orientation, f), axis=0))
        out.append(np.linalg.norm(parts_of_interior(orientation, f), axis=0))
    return out


def _weights(
    design: NDArray[np.float64], residual: NDArray[np.float64], variance: NDArray[np.float64]
) -> tuple[float, NDArray[np.float64]]:
    """Return the factor of the variance, at least 1, and the weights (n,) of residuals (n,).

    design (n, K): derivatives with respect to unknowns of unit variance. Weights are those of a t
    distribution (Lange, Little and Taylor, JASA 84, 1989).
    """
    weight = 1 / variance
    factor = 1.0
    unit = np.eye(design.shape[1])
    for _ in range(ITERATIONS):
        normal = design.T @ (design * weight[:, None]) + unit
        inverse = np.linalg.inv(normal)
        remainder = residual - design @ (inverse @ (design.T @ (weight * residual)))
        squares = remainder**2 / variance
        free = max(len(remainder) - len(unit) + float(np.trace(inverse)), 1.0)
        factor = max(1.0, float(np.median(squares)) / NORMAL_MEDIAN**2 * len(remainder) / free)
        weight = (NU + 1) / (NU + squares / factor) / (variance * factor)
    return factor, weight
