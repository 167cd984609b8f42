# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The model `local_linear`: a cubic trend, and local planes fitted to what it leaves.

A local plane has no bias where all neighbours are on one side, as at the rim of an image, where
the mean of them has. It flattens what bends within its reach, though, and in the alternation with
the adjustment the flattened part is lost: orientations and object points absorb it. Pincushion,
S-shape and spiral bend over the whole image and are cubic polynomials to first order
(Gronenschild, Medical Physics 24, 1997), so that polynomial is fitted first.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from .neighbour_model import NeighbourModel
from .neighbours import Neighbourhoods, plane_weights, tricube_plane_weights


class LocalLinearModel(NeighbourModel):
    """Cubic trend plus a plane fitted to the k nearest remainders with tricube weights."""

    kind = 'local_linear'
    description = 'cubic trend, and planes fitted to the k nearest residuals'
    min_k = 6
    trend_degree: ClassVar[int | None] = 3
    gauge_passes = 1  # the trend reproduces the gauge

    @classmethod
    def weights(cls, near: Neighbourhoods, k: int) -> np.ndarray:
        """Weights (n, k) of the plane fitted with tricube weights."""
        return tricube_plane_weights(near, k)

    @classmethod
    def weights_of_candidates(cls, candidates: np.ndarray, uv: np.ndarray, k: int) -> np.ndarray:
        """Weights (n, c); a candidate as far as the k-th nearest or farther has the weight 0."""
        dx = candidates[:, 0] - uv[:, :1]
        dy = candidates[:, 1] - uv[:, 1:]
        distance2 = dx * dx
        distance2 += dy * dy
        kth = np.partition(distance2, k - 1, axis=1)[:, k - 1]
        ratio = distance2 / np.maximum(kth, 1e-12)[:, None]
        np.minimum(ratio, 1, out=ratio)
        kernel = np.sqrt(ratio)
        kernel *= ratio
        np.subtract(1, kernel, out=kernel)
        kernel *= kernel * kernel
        equidistant = np.einsum('nk->n', kernel) <= 1e-9  # then all have the same weight
        if equidistant.any():
            kernel[equidistant] = distance2[equidistant] <= kth[equidistant, None]
        return plane_weights(dx, dy, kernel, kth)
