# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The systematic errors of a calibration as the markers show them at the start of a stream."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

NODES = 8  # across an image
# Correlation lengths over the width of the image: of the correction, and of the orientation.
CORRECTION_LENGTH = 0.12
ORIENTATION_LENGTH = 1.0
MIN_VARIANCE_PX2 = 1e-4


class SystematicErrorField:
    """Systematic part of the epipolar residuals of a pair of views, on a grid of nodes.

    Each image has NODES x NODES nodes with bilinear interpolation between them. The prior is what
    the calibration states of its own uncertainty, with the correlation of a correction and of an
    orientation. The values are estimated from the residuals of the start, by marker and block, by
    least-squares collocation.

    Parameters
    ----------
    sizes : sequence
        (2, 2), width and height of both images [px].

    Attributes
    ----------
    mean, covariance : ndarray or None
        (m,) [px] and (m, m) [px^2] of the nodes; None until `estimate` is called.
    """

    def __init__(self, sizes: Sequence[Sequence[int]]) -> None:
        self._sizes = np.asarray(sizes, dtype=float)
        self._nodes = NODES * NODES
        self._normal = np.zeros((2 * self._nodes, 2 * self._nodes))
        self._right = np.zeros(2 * self._nodes)
        self._square_sum = 0.0
        self._count = 0
        self.mean: np.ndarray | None = None
        self.covariance: np.ndarray | None = None

    def interpolation(self, uv: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
        """Nodes (n, 4) and their bilinear weights (n, 4) at pixels uv (n, 2) of image 0 or 1."""
        x = np.clip((uv + 0.5) * ((NODES - 1) / self._sizes[side]), 0, NODES - 1)
        low = np.minimum(x.astype(int), NODES - 2)
        fu, fv = (x - low).T
        first = low[:, 0] + NODES * low[:, 1] + side * self._nodes
        weights = np.stack([(1 - fu) * (1 - fv), fu * (1 - fv), (1 - fu) * fv, fu * fv], axis=1)
        return first[:, None] + np.array([0, 1, NODES, NODES + 1]), weights

    def add(
        self,
        marker: np.ndarray,
        nodes: NDArray[np.float64],
        weights: NDArray[np.float64],
        residual: NDArray[np.float64],
        variance: NDArray[np.float64],
        systematic: NDArray[np.float64],
    ) -> None:
        """Add the residuals of a block; those of one marker count as their mean.

        Parameters
        ----------
        marker : ndarray
            (n,), numbers of the markers from 0.
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

        variance_factor is the variance of the residuals over the predicted one.
        """
        node = np.stack(np.divmod(np.arange(self._nodes), NODES)) / (NODES - 1)
        square = np.sum((node[:, :, None] - node[:, None]) ** 2, axis=0)
        shape = (
            np.exp(-square / (2 * CORRECTION_LENGTH**2))
            + np.exp(-square / (2 * ORIENTATION_LENGTH**2))
        ) / 2
        # Each image gets the whole stated variance, twice of it in total, so that the prior
        # shrinks the estimate as little as possible.
        variance = max(self._square_sum / max(self._count, 1), MIN_VARIANCE_PX2)
        prior = variance * np.kron(np.eye(2), shape + 1e-6 * np.eye(self._nodes))
        gain = np.linalg.solve(np.eye(len(prior)) + prior @ self._normal / variance_factor, prior)
        self.covariance = (gain + gain.T) / 2
        self.mean = self.covariance @ self._right / variance_factor
