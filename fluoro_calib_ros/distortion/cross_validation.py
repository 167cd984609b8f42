"""Choice of k by cross-validation with whole exposures held out (Eq. 2 of Chow et al.)."""

import numpy as np
from scipy.spatial import cKDTree

from .smoothers import MIN_K, Neighbourhoods
from .trend import Trend, least_squares_map

FOLDS = 10
CACHE = 12_000_000  # weights kept between rounds


def candidate_k(kind, count):
    """Values of k that are tried for count training points: all to 100 for knn, in steps of a
    quarter else.
    """
    largest = max(MIN_K[kind], min(int(count * 0.4), 100 if kind == 'knn' else 400))
    if kind == 'knn':
        return np.arange(min(3, largest), largest + 1)
    steps = np.round(10 * 1.25 ** np.arange(17)).astype(int)
    steps = steps[steps <= largest]
    return steps if len(steps) else np.array([largest])


def exposure_folds(exposure, folds=FOLDS):
    """Fold (N,) of each image point: the exposures are dealt out in turn."""
    _, number = np.unique(exposure, return_inverse=True)
    return number % min(folds, number.max() + 1)


class NearestTable:
    """The nearest among points (N, 2) to each of themselves, in order, for choosing among them
    again and again.

    count: how many of them will be asked for; a few more are looked up, for those that are not
    allowed.
    """

    def __init__(self, uv, count):
        self._uv = uv
        _, self._near = cKDTree(uv).query(
            uv, k=np.arange(1, min(len(uv), int(1.3 * count) + 30) + 1)
        )

    def nearest(self, rows, allowed, count):
        """The count nearest allowed (N, True or False) points (n, count) of the points rows (n,),
        in order.
        """
        near = self._near[rows]
        good = allowed[near]
        rank = np.cumsum(good, axis=1)
        out = np.empty((len(rows), count), dtype=np.intp)
        taken = good & (rank <= count)
        full = rank[:, -1] >= count
        out[full] = near[full][taken[full]].reshape(-1, count)
        if not full.all():
            # Near a border of the image, or where a whole exposure is held out: search once more.
            points = np.flatnonzero(allowed)
            _, found = cKDTree(self._uv[points]).query(
                self._uv[rows[~full]], k=np.arange(1, count + 1)
            )
            out[~full] = points[found]
        return out

    def restricted(self, kept):
        """The table of the points kept (N, True or False) alone, numbered anew."""
        other = NearestTable.__new__(NearestTable)
        other._uv = self._uv[kept]
        number = np.cumsum(kept) - 1
        count = int(np.min(np.sum(kept[self._near[kept]], axis=1)))
        other._near = number[self.nearest(np.flatnonzero(kept), kept, count)]
        return other


class CrossValidation:
    """Cross-validation of one kind of model over training points that stay where they are.

    uv (N, 2) [px]; fold (N,) fold of each point; candidates: values of k, ascending; near: a
    NearestTable of uv where there is one already. Neighbours are looked up once, and weights kept
    while they are few: between the rounds only the values change. Raises ValueError for too few
    points.
    """

    def __init__(self, kind, uv, fold, candidates, near=None):
        folds = [np.flatnonzero(fold == f) for f in np.unique(fold)]
        trains = [np.flatnonzero(fold != f) for f in np.unique(fold)]
        candidates = np.asarray(candidates)
        self.kind = kind
        self.candidates = candidates[candidates <= min(len(train) for train in trains)]
        if not len(self.candidates):
            raise ValueError(
                f'{len(uv)} image points are too few for a cross-validation of {kind}'
            )
        self._index = np.empty((len(uv), self.candidates[-1]), dtype=np.intp)
        self._trend = []
        near = NearestTable(uv, self.candidates[-1]) if near is None else near
        basis = Trend(kind, uv).basis(uv)
        for held_out, train in zip(folds, trains):
            allowed = np.ones(len(uv), dtype=bool)
            allowed[held_out] = False
            self._index[held_out] = near.nearest(held_out, allowed, self.candidates[-1])
            self._trend.append((held_out, train, least_squares_map(basis[train])))
        self._basis, self._near = basis, Neighbourhoods(uv[self._index], uv)
        keep = len(uv) * int(np.sum(self.candidates)) <= CACHE and kind != 'knn'
        self._weights = [self._near.weights(kind, k) for k in self.candidates] if keep else None

    def _neighbour_values(self, values):
        """Values less trend at the neighbours, (2, N, K), and the trend (N, 2), both without the
        own fold.
        """
        near = np.empty((2,) + self._index.shape)
        trend = np.zeros_like(values)
        for held_out, train, fit in self._trend:
            coefficients = fit @ values[train]
            left = (values - self._basis @ coefficients).T
            near[:, held_out] = left[:, self._index[held_out]]
            trend[held_out] = self._basis[held_out] @ coefficients
        return near, trend

    def predictions(self, values):
        """Held-out predictions (K, N, 2) for every candidate, of values (N, 2) at the training
        points.
        """
        near, trend = self._neighbour_values(values)
        if self.kind == 'knn':
            # A running mean gives all k at once.
            sums = np.cumsum(near, axis=2)[:, :, self.candidates - 1]
            return trend + (sums / self.candidates).transpose(2, 1, 0)
        weights = self._weights or (self._near.weights(self.kind, k) for k in self.candidates)
        return np.stack(
            [trend + np.einsum('nk,cnk->nc', w, near[:, :, : w.shape[1]]) for w in weights]
        )

    def predictions_for(self, k, values):
        """Held-out predictions (N, 2) with k neighbours, of values (N, 2) at the training points."""
        near, trend = self._neighbour_values(values)
        return trend + np.einsum('nk,cnk->nc', self._near.weights(self.kind, k), near[:, :, :k])

    def scores(self, values, information):
        """G (K,) for every candidate: squared errors weighted with information (N, 2, 2) = C_r^-1."""
        error = values - self.predictions(values)
        return np.sum((error[:, :, None, :] @ information)[:, :, 0] * error, axis=(1, 2))
