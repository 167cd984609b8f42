# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Regression step of a self-calibration for neighbour models."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..correction.neighbours import (
    Neighbourhoods,
    NeighbourModel,
    NeighbourTable,
    Trend,
    least_squares_map,
)
from ..correction.series import Series
from .estimator import (
    RegressionStep,
    TrainingPoints,
    exposure_folds,
    gauge_basis,
    gauge_coefficients,
    require_training,
)

# Choice of k by cross-validation with whole exposures held out (Eq. 2 of Chow et al.).

MAX_CACHED_WEIGHTS = 12_000_000  # most weights to store between rounds


class CrossValidation:
    """Cross-validation of a neighbour model over fixed training points.

    Neighbours are searched once, and their weights stored if there are few: between the rounds of
    a self-calibration only the values change.

    Parameters
    ----------
    model_type : type of NeighbourModel
    uv : (N, 2) ndarray
        Training pixels.
    fold : (N,) ndarray of int
        Fold of each training point.
    candidates : (K,) array_like of int
        Values of k, ascending.
    near : NeighbourTable, optional
        Table of uv, if it exists already.
    tested : (T,) ndarray of int, optional
        Training points whose values are predicted; by default all.

    Raises
    ------
    ValueError
        If there are too few points for the smallest candidate.
    """

    def __init__(
        self,
        model_type: type[NeighbourModel],
        uv: NDArray[np.float64],
        fold: NDArray[np.int64],
        candidates: ArrayLike,
        near: NeighbourTable | None = None,
        tested: NDArray[np.int64] | None = None,
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
        fits_in_memory = len(self._tested) * int(np.sum(self.candidates)) <= MAX_CACHED_WEIGHTS
        is_cached = fits_in_memory and not model_type.equal_weights
        self._weights = list(self._all_weights()) if is_cached else None

    def _all_weights(self) -> Iterable[NDArray[np.float64]]:
        """Yield the weights (T, k) for every candidate k."""
        return (self.model_type.weights(self._near, k) for k in self.candidates)

    def _neighbour_values(
        self, values: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return values less trend at neighbours (2, T, K), and trend (T, 2), by other folds."""
        neighbour_values = np.empty((2,) + self._index.shape)
        trend = np.zeros((len(self._tested), 2))
        for held_out, train, fit in self._trend:
            coefficients = fit @ values[train]
            remainder = (values - self._basis @ coefficients).T
            neighbour_values[:, held_out] = remainder[:, self._index[held_out]]
            trend[held_out] = self._basis[self._tested[held_out]] @ coefficients
        return neighbour_values, trend

    def predictions(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return held-out predictions (K, T, 2) of values (N, 2), for every candidate."""
        neighbour_values, trend = self._neighbour_values(values)
        if self.model_type.equal_weights:
            sums = np.cumsum(neighbour_values, axis=2)[:, :, self.candidates - 1]
            return trend + (sums / self.candidates).transpose(2, 1, 0)
        weights = self._weights or self._all_weights()
        return np.stack(
            [
                trend + np.einsum('nk,cnk->nc', w, neighbour_values[:, :, : w.shape[1]])
                for w in weights
            ]
        )

    def predictions_for(self, k: int, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return held-out predictions (T, 2) of values (N, 2) with k neighbours."""
        neighbour_values, trend = self._neighbour_values(values)
        weights = self.model_type.weights(self._near, k)
        return trend + np.einsum('nk,cnk->nc', weights, neighbour_values[:, :, :k])

    def scores(
        self, values: NDArray[np.float64], information: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return G (K,) of every candidate: errors weighted by information (N, 2, 2) = C_r^-1."""
        error = values[self._tested] - self.predictions(values)
        return weighted_square_sum(error, information[self._tested])


def weighted_square_sum(
    error: NDArray[np.float64], information: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the sums (K,) of e^T W e over errors e (K, N, 2) with weights W (N, 2, 2)."""
    return np.sum((error[:, :, None, :] @ information)[:, :, 0] * error, axis=(1, 2))


MIN_GAIN = 1e-3  # relative gain in G for which k is changed
SEARCH_FACTOR = 2.0  # k is first searched within this factor of the last one


class NeighbourRegression(RegressionStep[NeighbourModel]):
    """A neighbour model of one fluoroscope through the rounds of a self-calibration.

    The image points do not move, so neighbours are searched again only when the inliers change.

    k: number of neighbours; None: chosen by cross-validation.
    """

    def __init__(
        self, model_type: type[NeighbourModel], points: TrainingPoints, k: int | None = None
    ) -> None:
        super().__init__(points)
        self.model_type = model_type
        self._given_k = k
        self._table: NeighbourTable | None = None
        self._trend = (
            None
            if points.trend is None
            else np.einsum('nm,ab->nabm', points.trend, np.eye(2)).reshape(len(points.uv), 2, -1)
        )

    def choose(
        self, values: NDArray[np.float64], q: NDArray[np.float64], information: NDArray[np.float64]
    ) -> None:
        """Update the inliers, and choose k by its score; see `RegressionStep.choose`."""
        before = self.k
        inliers = self._updated_inliers(q)
        if self.changed:
            self._set_inliers(inliers)
        scores = self._validation.scores(values[inliers], information[inliers])
        best = int(np.argmin(scores))
        while self._given_k is None and self._at_border(best):
            self.k = int(self._validation.candidates[best])
            self._set_inliers(inliers)
            scores = self._validation.scores(values[inliers], information[inliers])
            best = int(np.argmin(scores))
        current = np.flatnonzero(self._validation.candidates == self.k)
        if len(current) and scores[current[0]] <= scores[best] * (1 + MIN_GAIN):
            best = int(current[0])
        self.k = int(self._validation.candidates[best])
        self.score = float(scores[best])
        self.changed = self.changed or before != self.k
        if self.changed:
            self._prepare_smoothing(inliers)

    def _prepare_smoothing(self, inliers: NDArray[np.bool_]) -> None:
        """Find the k nearest inliers of all image points, and their weights."""
        uv = self.points.uv
        assert self._table is not None
        self._index = self._table.nearest(np.arange(len(uv)), inliers, self.k)
        self._weights = self.model_type.weights(Neighbourhoods(uv[self._index], uv), self.k)
        self._basis = Trend(self.model_type.trend_degree, uv[inliers]).basis(uv)
        self._trend_fit = least_squares_map(self._basis[inliers])

    def _set_inliers(self, inliers: NDArray[np.bool_]) -> None:
        """Prepare the cross-validation with the inliers. Raises ValueError for too few."""
        count = int(inliers.sum())
        require_training(count)
        given_k = self._given_k
        if given_k is not None and not self.model_type.min_k <= given_k <= count:
            raise ValueError(
                f'{self.model_type.kind} with k = {given_k} is not possible with {count} inliers'
            )
        self.inliers = inliers
        candidates = self.model_type.candidate_k(count) if given_k is None else np.array([given_k])
        if self._table is None:
            self._table = NeighbourTable(self.points.uv, candidates[-1])
        self._all_candidates = candidates
        if given_k is None and self.k:  # k changes little from round to round
            close = (candidates >= self.k / SEARCH_FACTOR) & (candidates <= self.k * SEARCH_FACTOR)
            candidates = candidates[close]
        self._validation = CrossValidation(
            self.model_type,
            self.points.uv[inliers],
            exposure_folds(self.points.exposure[inliers]),
            candidates,
            self._table.restricted(inliers),
        )

    def _at_border(self, best: int) -> bool:
        """Whether the best candidate is first or last of those tried, but not of all."""
        tried_k = self._validation.candidates
        possible_k = self._all_candidates
        at_start = best == 0 and tried_k[0] > possible_k[0]
        at_end = best == len(tried_k) - 1 and len(tried_k) > 1 and tried_k[-1] < possible_k[-1]
        return bool(at_start or at_end)

    def smooth(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Fit values (N, 2) [px] at the inliers; return the corrections (N, 2) at all points."""
        trend = self._basis @ (self._trend_fit @ values[self.inliers])
        remainder = values - trend
        smoothed = [
            np.einsum('nk,nk->n', self._weights, remainder[:, axis][self._index])
            for axis in (0, 1)
        ]
        return trend + np.stack(smoothed, axis=1)

    def without_gauge(
        self, values: NDArray[np.float64], interior: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Change values (N, 2) so that their fitted correction is orthogonal to the gauge."""
        if self._trend is None:
            basis = gauge_basis(self.points.uv, interior, self.points.gauge)
        else:
            basis = self._trend
        if not basis.shape[2]:
            return values
        for _ in range(self.model_type.gauge_passes):
            fitted = self.smooth(values)[self.inliers]
            values = values - basis @ self._part_in(basis, fitted, interior)
        return values

    def _part_in(
        self,
        basis: NDArray[np.float64],
        fitted: NDArray[np.float64],
        interior: NDArray[np.float64],
    ) -> np.ndarray:
        """Return the gauge coefficients of corrections (i, 2) fitted at the inliers."""
        if self._trend is None:
            uv = self.points.uv[self.inliers]
            return gauge_coefficients(uv, fitted, interior, self.points.gauge)
        flat = basis[self.inliers].reshape(-1, basis.shape[2])
        return np.linalg.lstsq(flat, fitted.reshape(-1), rcond=None)[0]

    def model(self, values: NDArray[np.float64], series: Series | None = None) -> NeighbourModel:
        """Return the correction model of values (N, 2), with its noise and bias.

        For a linear smoother S without bias, E|y - S y|^2 = s^2 (1 - 2 tr(S)/N + tr(S S')/N)
        (Hastie, Tibshirani and Friedman, "The Elements of Statistical Learning", 2009, 5.5). At a
        held-out point, the noise of the point and of the prediction add up; an excess over their
        sum is bias.
        """
        inside = self.inliers
        error2 = np.mean((values[inside] - self.smooth(values)[inside]) ** 2)
        norm2 = np.mean(np.sum(self._weights[inside] ** 2, axis=1))
        is_itself = self._index == np.arange(len(self._index))[:, None]
        trace = np.mean(np.sum(self._weights * is_itself, axis=1)[inside])
        noise2 = error2 / max(1 - 2 * trace + norm2, 0.1)
        held_out = self._validation.predictions_for(self.k, values[inside])
        bias2 = np.mean((values[inside] - held_out) ** 2) - noise2 * (1 + norm2)
        uv = self.points.uv[inside]
        duv = values[inside]
        return self.model_type(
            self.k,
            uv,
            duv if series is None else duv + series.predict(uv),
            noise_px=float(np.sqrt(noise2)),
            bias_px=float(np.sqrt(max(bias2, 0.0))),
            series=series,
        )
