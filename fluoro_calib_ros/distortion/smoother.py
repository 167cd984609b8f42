# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Models that predict a weighted sum of the k nearest training corrections."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from .base import BULK_CHUNK, Correction, CorrectionModel, Smoothness
from .blocks import blocks_with_candidates, work_of_blocks
from .neighbours import Neighbourhoods
from .trend import Trend, least_squares_map

WEIGHTS_CHUNK = 2_000_000  # weights computed at once, to bound the memory
MAX_CANDIDATES = 50  # for each neighbour; more are never found among distinct points


class NeighbourSmoother(CorrectionModel):
    """A linear smoother: a global part plus weights times the k nearest values.

    The global part is a polynomial trend fitted here, or a series that was estimated in the
    adjustment; the neighbours smooth what it leaves of the training corrections. A subclass gives
    the `weights`. Cross-validation, standard deviations and the lookup grid follow from them.
    """

    smoothness = Smoothness.KINKED
    min_k: ClassVar[int]
    trend_degree: ClassVar[int | None] = None  # of the polynomial trend; None: there is none
    equal_weights: ClassVar[bool] = False  # weights are 1/k: a running mean gives all k at once
    gauge_passes: ClassVar[int] = 3  # a smoother reproduces the gauge only approximately

    tree: cKDTree
    trend: Trend
    trend_coefficients: np.ndarray
    remainder: np.ndarray

    def _prepare(self) -> None:
        uv = self.train_uv
        trend = Trend(self.trend_degree, uv)
        basis = trend.basis(uv)
        coefficients = least_squares_map(basis) @ self.train_duv
        remainder = self.train_duv - basis @ coefficients
        if self.series is not None:
            remainder = remainder - self.series.predict(uv)
        self._set(
            tree=cKDTree(uv),
            trend=trend,
            trend_coefficients=coefficients,
            remainder=remainder,
        )

    @classmethod
    @abstractmethod
    def weights(cls, near: Neighbourhoods, k: int) -> np.ndarray:
        """Weights (n, k) of the k nearest training values in the predictions."""

    @classmethod
    def weights_of_candidates(cls, candidates: np.ndarray, uv: np.ndarray, k: int) -> np.ndarray:
        """Weights (n, c) of candidates (c, 2) at pixels uv (n, 2); zero but for the k nearest.

        The lookup grid is built with it. A subclass overrides it where it need not sort.
        """
        distance2 = np.sum((candidates - uv[:, None]) ** 2, axis=2)
        index = np.argsort(distance2, axis=1, kind='stable')[:, :k]
        out = np.zeros(distance2.shape)
        weights = cls.weights(Neighbourhoods(candidates[index], uv), k)
        np.put_along_axis(out, index, weights, axis=1)
        return out

    @classmethod
    def candidate_k(cls, count: int) -> np.ndarray:
        """Values of k that are tried for count training points, in steps of a quarter."""
        largest = max(cls.min_k, min(int(count * 0.4), 400))
        steps = np.round(10 * 1.25 ** np.arange(17)).astype(int)
        steps = steps[steps <= largest]
        return steps if len(steps) else np.array([largest])

    def predict(self, uv: ArrayLike) -> np.ndarray:
        """Corrections (n, 2) [px] at pixels uv (n, 2)."""
        return self._predict_with_norm(uv)[0]

    def evaluate(self, uv: ArrayLike) -> Correction:
        """Return the Correction at pixels uv (n, 2), with standard deviations."""
        duv, norm2 = self._predict_with_norm(uv)
        uv = np.asarray(uv, dtype=float).reshape(-1, 2)
        return Correction(duv, self._sd(norm2, uv), self.outside(uv))

    def standard_deviation(self, uv: np.ndarray) -> np.ndarray:
        """Standard deviations (n,) [px] of the predictions at pixels uv (n, 2)."""
        return self.evaluate(uv).sd

    def evaluate_in_bulk(self, uv: np.ndarray) -> np.ndarray:
        """Return du, dv and standard deviation (3, n) [px] at many pixels uv (n, 2)."""
        out = np.zeros((3, len(uv)))
        norm2 = np.zeros(len(uv))
        most = MAX_CANDIDATES * (self.k + 1)
        for block, near in blocks_with_candidates(self.tree, uv, self.k, most):
            if near is None:
                predicted, norm2[block] = self._local_part(uv[block])
                out[:2, block] = predicted.T
                continue
            rows = max(1, WEIGHTS_CHUNK // len(near))
            for start in range(0, len(block), rows):
                some = block[start : start + rows]
                weights = self.weights_of_candidates(self.train_uv[near], uv[some], self.k)
                for axis, remainder in enumerate(self.remainder[near].T):
                    out[axis, some] = np.einsum('nk,k->n', weights, remainder)
                norm2[some] = np.einsum('nk,nk->n', weights, weights)
        for start in range(0, len(uv), BULK_CHUNK):
            part = slice(start, start + BULK_CHUNK)
            out[:2, part] += self._global_part(uv[part]).T
            out[2, part] = self._sd(norm2[part], uv[part])
        return out

    def bulk_work(self, uv: np.ndarray, limit: float) -> float:
        """Return the work of `evaluate_in_bulk`: candidates of neighbours, and functions."""
        return super().bulk_work(uv, limit) + work_of_blocks(self.tree, uv, self.k, limit)

    def _global_part(self, uv: np.ndarray) -> np.ndarray:
        """Trend or series (n, 2) [px] at pixels uv (n, 2)."""
        if self.series is None:
            return self.trend.basis(uv) @ self.trend_coefficients
        return self.series.predict_in_chunks(uv)

    def _predict_with_norm(self, uv: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Corrections (n, 2) [px] and the squared norms (n,) of their weights."""
        uv = np.asarray(uv, dtype=float).reshape(-1, 2)
        duv, norm2 = self._local_part(uv)
        return duv + self._global_part(uv), norm2

    def _local_part(self, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What the neighbours add to the global part (n, 2) [px], and the norms as above."""
        duv = np.zeros_like(uv)
        norm2 = np.zeros(len(uv))
        size = max(1, WEIGHTS_CHUNK // self.k)
        for start in range(0, len(uv), size):
            part = slice(start, start + size)
            _, index = self.tree.query(uv[part], k=np.arange(1, self.k + 1))
            weights = self.weights(Neighbourhoods(self.tree.data[index], uv[part]), self.k)
            duv[part] = np.einsum('nk,nkc->nc', weights, self.remainder[index])
            norm2[part] = np.einsum('nk,nk->n', weights, weights)
        return duv, norm2
