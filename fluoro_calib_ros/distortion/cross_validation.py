# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Choice of k by cross-validation with whole exposures held out (Eq. 2 of Chow et al.)."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike

from .neighbours import Neighbourhoods, NeighbourTable
from .smoother import NeighbourSmoother
from .trend import Trend, least_squares_map

MAX_CACHED_WEIGHTS = 12_000_000  # weights that are stored between rounds


class CrossValidation:
    """Cross-validation of a neighbour model over training points that do not move.

    Neighbours are looked up once, and their weights stored as long as they are few: between the
    rounds of a self-calibration only the values change.

    Parameters
    ----------
    model_type : type of NeighbourSmoother
    uv : (N, 2) ndarray
        Training pixels.
    fold : (N,) ndarray of int
        Fold of each training point.
    candidates : (K,) array_like of int
        Values of k, ascending.
    near : NeighbourTable, optional
        Table of uv, where there is one already.
    tested : (T,) ndarray of int, optional
        Training points whose values are predicted; by default all.

    Raises
    ------
    ValueError
        If there are too few points for the smallest candidate.
    """

    def __init__(
        self,
        model_type: type[NeighbourSmoother],
        uv: np.ndarray,
        fold: np.ndarray,
        candidates: ArrayLike,
        near: NeighbourTable | None = None,
        tested: np.ndarray | None = None,
    ) -> None:
        self._tested = np.arange(len(uv)) if tested is None else tested
        numbers = np.unique(fold)
        folds = [np.flatnonzero(fold[self._tested] == f) for f in numbers]
        trains = [np.flatnonzero(fold != f) for f in numbers]
        candidates = np.asarray(candidates)
        self.model_type = model_type
        self.candidates = candidates[candidates <= min(len(train) for train in trains)]
        if not len(self.candidates):
            raise ValueError(
                f'{len(uv)} image points are too few for a cross-validation of {model_type.kind}'
            )
        self._index = np.empty((len(self._tested), self.candidates[-1]), dtype=np.intp)
        self._trend = []
        near = NeighbourTable(uv, self.candidates[-1]) if near is None else near
        basis = Trend(model_type.trend_degree, uv).basis(uv)
        for number, held_out, train in zip(numbers, folds, trains):
            rows = self._tested[held_out]
            self._index[held_out] = near.nearest(rows, fold != number, self.candidates[-1])
            self._trend.append((held_out, train, least_squares_map(basis[train])))
        self._basis = basis
        self._near = Neighbourhoods(uv[self._index], uv[self._tested])
        few = len(self._tested) * int(np.sum(self.candidates)) <= MAX_CACHED_WEIGHTS
        cached = few and not model_type.equal_weights
        self._weights = list(self._all_weights()) if cached else None

    def _all_weights(self) -> Iterable[np.ndarray]:
        """Weights (T, k) for every candidate k."""
        return (self.model_type.weights(self._near, k) for k in self.candidates)

    def _neighbour_values(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values less trend at the neighbours (2, T, K), and trend (T, 2), of the other folds."""
        near = np.empty((2,) + self._index.shape)
        trend = np.zeros((len(self._tested), 2))
        for held_out, train, fit in self._trend:
            coefficients = fit @ values[train]
            remainder = (values - self._basis @ coefficients).T
            near[:, held_out] = remainder[:, self._index[held_out]]
            trend[held_out] = self._basis[self._tested[held_out]] @ coefficients
        return near, trend

    def predictions(self, values: np.ndarray) -> np.ndarray:
        """Held-out predictions (K, T, 2) of values (N, 2), for every candidate."""
        near, trend = self._neighbour_values(values)
        if self.model_type.equal_weights:
            sums = np.cumsum(near, axis=2)[:, :, self.candidates - 1]
            return trend + (sums / self.candidates).transpose(2, 1, 0)
        weights = self._weights or self._all_weights()
        return np.stack(
            [trend + np.einsum('nk,cnk->nc', w, near[:, :, : w.shape[1]]) for w in weights]
        )

    def predictions_for(self, k: int, values: np.ndarray) -> np.ndarray:
        """Held-out predictions (T, 2) of values (N, 2) with k neighbours."""
        near, trend = self._neighbour_values(values)
        weights = self.model_type.weights(self._near, k)
        return trend + np.einsum('nk,cnk->nc', weights, near[:, :, :k])

    def scores(self, values: np.ndarray, information: np.ndarray) -> np.ndarray:
        """G (K,) for every candidate: errors weighted by information (N, 2, 2) = C_r^-1."""
        error = values[self._tested] - self.predictions(values)
        return weighted_square_sum(error, information[self._tested])


def weighted_square_sum(error: np.ndarray, information: np.ndarray) -> np.ndarray:
    """Sums (K,) of e^T W e over errors e (K, N, 2) with weights W (N, 2, 2)."""
    return np.sum((error[:, :, None, :] @ information)[:, :, 0] * error, axis=(1, 2))
