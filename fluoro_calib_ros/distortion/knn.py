# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The model `knn`: the mean of the k nearest training corrections (Chow et al., section 3)."""

from __future__ import annotations

import numpy as np

from .base import Smoothness
from .neighbour_model import NeighbourModel
from .neighbours import Neighbourhoods

MIN_CANDIDATE = 3
MAX_CANDIDATE = 100


class KnnModel(NeighbourModel):
    """Mean of the k nearest training corrections, as scikit-learn's KNeighborsRegressor."""

    kind = 'knn'
    description = 'mean of the k nearest residuals'
    smoothness = Smoothness.STEPPED
    min_k = 1
    equal_weights = True

    @classmethod
    def weights(cls, near: Neighbourhoods, k: int) -> np.ndarray:
        """Weights (n, k): 1/k each."""
        return np.full((len(near), k), 1.0 / k)

    @classmethod
    def weights_of_candidates(cls, candidates: np.ndarray, uv: np.ndarray, k: int) -> np.ndarray:
        """Weights (n, c); candidates at the distance of the k-th nearest share its weight."""
        dx = candidates[:, 0] - uv[:, :1]
        dy = candidates[:, 1] - uv[:, 1:]
        distance2 = dx * dx
        distance2 += dy * dy
        kth = np.partition(distance2, k - 1, axis=1)[:, k - 1]
        nearest = (distance2 <= kth[:, None]).astype(float)
        return nearest / nearest.sum(axis=1, keepdims=True)

    @classmethod
    def candidate_k(cls, count: int) -> np.ndarray:
        """Return all k from 3 to 100, or to 40 % of count training points."""
        largest = max(cls.min_k, min(int(count * 0.4), MAX_CANDIDATE))
        return np.arange(min(MIN_CANDIDATE, largest), largest + 1)
