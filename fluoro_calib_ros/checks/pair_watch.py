# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Evidence of a drift of either image from the epipolar residuals of a pair of views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .drift_charts import MEMORY, Block, DriftOptions, EpipolarObservations, ImageAreas

LAGS = (1, 2, 4)  # frame lags at which the noise of a marker is compared
MAX_CORRELATION = 0.97  # maximum for the noise of a marker in successive frames
NUGGET = 0.35  # fraction of the systematic standard deviation that the nodes cannot represent


@dataclass(frozen=True)
class PairBlock(Block):
    """Statistics of a block of epipolar residuals.

    The four series are: image a and image b against the calibration, then image a and image b
    against the start.
    """

    #: (2, A, 2) sums of the normals of the epipolar lines in both images
    normals: NDArray[np.float64]

    @classmethod
    def empty(cls, areas: int) -> PairBlock:
        """Return a block of zeros."""
        score, information, systematic = np.zeros((3, 4, areas))
        enough = np.zeros((4, areas), dtype=bool)
        return cls(score, information, systematic, enough, np.zeros((2, areas, 2)))


class PairWatch:
    """Converts the epipolar residuals of one pair of views into statistics, block by block.

    sizes: (2, 2), width and height of both images [px].
    """

    def __init__(
        self, sizes: Sequence[Sequence[int]], areas: ImageAreas, options: DriftOptions
    ) -> None:
        self._sizes = sizes
        self._areas = areas
        self._options = options
        self.field = SystematicErrorField(sizes)
        self._squares = np.zeros(len(LAGS))  # half the sums of squared differences at the lags
        self._count = 0.0
        self._frames = 0.0

    def stretch(self) -> float:
        """Return the variance of a long sum of blocks over that of differences of two blocks.

        The noise of a marker is modelled as a white part w plus an autoregression of variance s
        with correlation r between successive frames. Half the mean squared differences over 1, 2
        and 4 frames, in which a marker hardly moves, are V1 = w + s (1 - r), V2 = w + s (1 - r^2)
        and V4 = w + s (1 - r^4), hence (V4 - V2)/(V2 - V1) = r (1 + r).
        """
        if not self._count:
            return 1.0
        v1, v2, v4 = self._squares / self._count
        # three standard deviations: not significant
        if v2 - v1 <= 6 * v1 / np.sqrt(self._count) or v4 <= v2:
            return 1.0
        r = (np.sqrt(1 + 4 * (v4 - v2) / (v2 - v1)) - 1) / 2
        r = min(float(r), MAX_CORRELATION)
        s = min((v2 - v1) / (r * (1 - r)), v1 / (1 - r))
        n = max(self._frames / self._count, 1.0)
        long_run = (1 + r) / (1 - r)
        # Variance of means of n values and covariance of two successive means, times n.
        variance = long_run - 2 * r * (1 - r**n) / (n * (1 - r) ** 2)
        shared = r * (1 - r**n) ** 2 / (n * (1 - r) ** 2)
        white = v1 - s * (1 - r)
        return max(1.0, (white + s * long_run) / (white + s * (variance - shared)))

    def _update_correlation(
        self, marker: NDArray[np.int64], standardised: NDArray[np.float64]
    ) -> None:
        """Add the differences of standardised residuals (n,) of markers (n,), in frame order."""
        order = np.argsort(marker, kind='stable')
        marker = marker[order]
        z = standardised[order]
        first = np.flatnonzero(marker[LAGS[-1] :] == marker[: -LAGS[-1]])
        if not len(first):
            return
        decay = 1 - 1 / MEMORY
        self._squares = decay * self._squares + [
            np.sum((z[first + lag] - z[first]) ** 2) / 2 for lag in LAGS
        ]
        self._frames = decay * self._frames + len(first) * len(marker) / (marker[-1] + 1)
        self._count = decay * self._count + len(first)

    def block(self, observations: EpipolarObservations) -> PairBlock:
        """Return the statistics of the usable observations of a block; at least one is needed.

        Until the field of systematic errors is estimated, the residuals are added to it, and the
        series against the start equal those against the calibration.
        """
        options = self._options
        _, marker = np.unique(observations.target_id, return_inverse=True)
        variance = observations.noise
        sd = np.sqrt(variance)
        systematic = np.sqrt(observations.systematic)
        interpolations = [
            self.field.interpolation(uv, side) for side, uv in enumerate(observations.uv)
        ]
        nodes = np.concatenate([nodes for nodes, _ in interpolations], axis=1)
        weights = np.concatenate([weights for _, weights in interpolations], axis=1)
        limit = (
            options.clip * sd
            + options.band_calibration * systematic
            + options.tolerance_px
            + 2 * options.step_px
        )
        absolute = np.clip(observations.residual, -limit, limit)
        self._update_correlation(marker, absolute / sd)
        mean = self.field.mean
        if mean is not None:
            reference = np.sum(mean[nodes] * weights, axis=1)
            relative = np.clip(observations.residual - reference, -limit, limit)
        else:
            self.field.add(
                marker, nodes, weights, residual=absolute, variance=variance, systematic=systematic
            )
            relative = absolute
        out = PairBlock.empty(len(self._areas))
        residuals = np.stack([absolute, relative])
        for side in (0, 1):
            cell = self._areas.cell(observations.uv[side], self._sizes[side])
            self._fill_side(
                out, side, observations=observations, residuals=residuals, cell=cell, marker=marker
            )
            if mean is not None:
                weight = observations.factor[side] / variance
                unknown = self._unknown_variance(cell, nodes, weights * weight[:, None])
                nugget = NUGGET * out.systematic[side]
                with np.errstate(divide='ignore', invalid='ignore'):
                    unknown = unknown / out.information[side] ** 2
                out.systematic[2 + side] = np.sqrt(unknown + nugget**2)
        return out

    def _fill_side(
        self,
        out: PairBlock,
        side: int,
        observations: EpipolarObservations,
        residuals: NDArray[np.float64],
        cell: NDArray[np.int64],
        marker: NDArray[np.int64],
    ) -> None:
        """Fill in the series of one image.

        residuals (2, n): against the calibration and against the start [px]; cell (n,) and marker
        (n,): of each observation.
        """
        areas = self._areas
        factor = observations.factor[side]
        weight = factor / observations.noise
        columns = [
            weight * residuals[0],
            weight * residuals[1],
            weight * factor,
            weight * np.sqrt(observations.systematic),
            *observations.normal[side].T,
        ]
        sums = self._area_sums(cell, np.stack(columns))
        rows = [side, 2 + side]
        out.score[rows] = sums[:2]
        out.information[rows] = sums[2]
        with np.errstate(divide='ignore', invalid='ignore'):
            out.systematic[side] = sums[3] / sums[2]
        out.normals[side] = sums[4:].T
        is_in_cell = np.zeros((areas.n**2, marker.max() + 1))
        is_in_cell[cell, marker] = 1
        markers = ((areas.member @ is_in_cell) > 0).sum(axis=1)
        out.enough[rows] = markers >= self._options.min_markers

    def _area_sums(
        self, cell: NDArray[np.int64], columns: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return sums (k, A) of columns (k, n) over the areas, for rows in cells (n,)."""
        size = self._areas.n**2
        k = len(columns)
        index = cell + size * np.arange(k)[:, None]
        sums = np.bincount(index.ravel(), columns.ravel(), k * size).reshape(k, size)
        return sums @ self._areas.member.T

    def _unknown_variance(
        self, cell: NDArray[np.int64], nodes: NDArray[np.int64], weights: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the variance (A,) of weighted sums of residuals due to errors of the field."""
        covariance = np.asarray(self.field.covariance)
        size = len(covariance)
        index = cell[:, None] * size + nodes
        sums = np.bincount(index.ravel(), weights.ravel(), self._areas.n**2 * size)
        sums = self._areas.member @ sums.reshape(-1, size)
        return np.maximum(np.sum((sums @ covariance) * sums, axis=1), 0)


NODES = 8  # number of nodes across an image
# Correlation lengths of the correction and of the orientation, over the image width.
CORRECTION_LENGTH = 0.12
ORIENTATION_LENGTH = 1.0
MIN_VARIANCE_PX2 = 1e-4


class SystematicErrorField:
    """Systematic part of the epipolar residuals of a pair of views, on a grid of nodes.

    Each image has NODES x NODES nodes with bilinear interpolation between them. The prior is the
    uncertainty that the calibration states, with the correlation of a correction and of an
    orientation. The values are estimated from the residuals of the start, by marker and block, by
    least-squares collocation.

    sizes: (2, 2), width and height of both images [px].
    """

    def __init__(self, sizes: Sequence[Sequence[int]]) -> None:
        self._sizes = np.asarray(sizes, dtype=float)
        self._nodes = NODES * NODES
        self._normal = np.zeros((2 * self._nodes, 2 * self._nodes))
        self._right = np.zeros(2 * self._nodes)
        self._square_sum = 0.0
        self._count = 0
        #: (m,) [px] and (m, m) [px^2] of the nodes; None before `estimate` is called
        self.mean: NDArray[np.float64] | None = None
        self.covariance: NDArray[np.float64] | None = None

    def interpolation(
        self, uv: NDArray[np.float64], side: int
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return nodes (n, 4) and their bilinear weights (n, 4) at uv (n, 2) of image 0 or 1."""
        x = np.clip((uv + 0.5) * ((NODES - 1) / self._sizes[side]), 0, NODES - 1)
        corner = np.minimum(x.astype(int), NODES - 2)
        fu, fv = (x - corner).T
        first = corner[:, 0] + NODES * corner[:, 1] + side * self._nodes
        weights = np.stack([(1 - fu) * (1 - fv), fu * (1 - fv), (1 - fu) * fv, fu * fv], axis=1)
        return first[:, None] + np.array([0, 1, NODES, NODES + 1]), weights

    def add(
        self,
        marker: NDArray[np.int64],
        nodes: NDArray[np.int64],
        weights: NDArray[np.float64],
        residual: NDArray[np.float64],
        variance: NDArray[np.float64],
        systematic: NDArray[np.float64],
    ) -> None:
        """Add the residuals of a block; those of a marker enter as their mean.

        Parameters
        ----------
        marker : ndarray
            (n,), indices of the markers from 0.
        nodes, weights : ndarray
            (n, 8), from `interpolation` in both images.
        residual, variance : ndarray
            (n,), residuals [px] and variances of their noise [px^2].
        systematic : ndarray
            (n,), systematic standard deviations [px].
        """
        count = np.bincount(marker)
        markers = len(count)
        size = 2 * self._nodes
        index = marker[:, None] * size + nodes
        sums = np.bincount(index.ravel(), weights.ravel(), markers * size)
        rows = sums.reshape(markers, size) / count[:, None]
        weight = count**2 / np.bincount(marker, variance)
        self._normal += rows.T @ (rows * weight[:, None])
        self._right += rows.T @ (weight * np.bincount(marker, residual) / count)
        self._square_sum += float(systematic @ systematic)
        self._count += len(systematic)

    def estimate(self, variance_factor: float) -> None:
        """Set mean and covariance.

        variance_factor: ratio of the actual and the predicted variance of the residuals.
        """
        node = np.stack(np.divmod(np.arange(self._nodes), NODES)) / (NODES - 1)
        square = np.sum((node[:, :, None] - node[:, None]) ** 2, axis=0)
        shape = (
            np.exp(-square / (2 * CORRECTION_LENGTH**2))
            + np.exp(-square / (2 * ORIENTATION_LENGTH**2))
        ) / 2
        # Each image gets the full stated variance, twice the variance in total, so that the prior
        # shrinks the estimate as little as possible.
        variance = max(self._square_sum / max(self._count, 1), MIN_VARIANCE_PX2)
        prior = variance * np.kron(np.eye(2), shape + 1e-6 * np.eye(self._nodes))
        gain = np.linalg.solve(np.eye(len(prior)) + prior @ self._normal / variance_factor, prior)
        self.covariance = (gain + gain.T) / 2
        self.mean = self.covariance @ self._right / variance_factor
