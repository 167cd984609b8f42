"""Choice of k by cross-validation with whole exposures held out (Eq. 2 of Chow et al.)."""

import numpy as np
from scipy.spatial import cKDTree

from .smoothers import SMALLEST_K, Neighbourhoods
from .trend import Trend, least_squares_map

FOLDS = 10
CACHE = 12_000_000   # weights kept between rounds


def candidate_k(kind, count):
    """Values of k that are tried for count training points: all to 100 for knn, in steps of a quarter else."""
    largest = max(SMALLEST_K[kind], min(int(count * 0.4), 100 if kind == 'knn' else 400))
    if kind == 'knn':
        return np.arange(min(3, largest), largest + 1)
    steps = np.round(10 * 1.25 ** np.arange(17)).astype(int)
    steps = steps[steps <= largest]
    return steps if len(steps) else np.array([largest])


def exposure_folds(exposure, folds=FOLDS):
    """Fold (N,) of each image point: the exposures are dealt out in turn."""
    _, number = np.unique(exposure, return_inverse=True)
    return number % min(folds, number.max() + 1)


class CrossValidation:
    """Cross-validation of one kind of model over training points that stay where they are.

    uv (N, 2) [px]; fold (N,) fold of each point; candidates: values of k, ascending. Neighbours are looked
    up once, and weights kept while they are few: between the rounds only the values change. Raises
    ValueError for too few points.
    """

    def __init__(self, kind, uv, fold, candidates):
        folds = [np.flatnonzero(fold == f) for f in np.unique(fold)]
        trains = [np.flatnonzero(fold != f) for f in np.unique(fold)]
        candidates = np.asarray(candidates)
        self.kind, self.candidates = kind, candidates[candidates <= min(len(train) for train in trains)]
        if not len(self.candidates):
            raise ValueError(f'{len(uv)} image points are too few for a cross-validation of {kind}')
        self._index, self._trend = np.empty((len(uv), self.candidates[-1]), dtype=np.intp), []
        basis = Trend(kind, uv).basis(uv)
        for held_out, train in zip(folds, trains):
            _, near = cKDTree(uv[train]).query(uv[held_out], k=np.arange(1, self.candidates[-1] + 1))
            self._index[held_out] = train[near]
            self._trend.append((held_out, train, least_squares_map(basis[train])))
        self._basis, self._near = basis, Neighbourhoods(uv[self._index], uv)
        keep = len(uv) * int(np.sum(self.candidates)) <= CACHE and kind != 'knn'
        self._weights = [self._near.weights(kind, k) for k in self.candidates] if keep else None

    def _neighbour_values(self, values):
        """Values less trend at the neighbours, (2, N, K), and the trend (N, 2), both without the own fold."""
        near, trend = np.empty((2,) + self._index.shape), np.zeros_like(values)
        for held_out, train, fit in self._trend:
            coefficients = fit @ values[train]
            left = (values - self._basis @ coefficients).T
            near[:, held_out] = left[:, self._index[held_out]]
            trend[held_out] = self._basis[held_out] @ coefficients
        return near, trend

    def predictions(self, values):
        """Held-out predictions (K, N, 2) for every candidate, of values (N, 2) at the training points."""
        near, trend = self._neighbour_values(values)
        if self.kind == 'knn':
            # A running mean gives all k at once.
            sums = np.cumsum(near, axis=2)[:, :, self.candidates - 1]
            return trend + (sums / self.candidates).transpose(2, 1, 0)
        weights = self._weights or (self._near.weights(self.kind, k) for k in self.candidates)
        return np.stack([trend + np.einsum('nk,cnk->nc', w, near[:, :, :w.shape[1]]) for w in weights])

    def predictions_for(self, k, values):
        """Held-out predictions (N, 2) with k neighbours, of values (N, 2) at the training points."""
        near, trend = self._neighbour_values(values)
        return trend + np.einsum('nk,cnk->nc', self._near.weights(self.kind, k), near[:, :, :k])

    def scores(self, values, information):
        """G (K,) for every candidate: squared errors weighted with information (N, 2, 2) = C_r^-1."""
        error = values - self.predictions(values)
        return np.sum((error[:, :, None, :] @ information)[:, :, 0] * error, axis=(1, 2))
