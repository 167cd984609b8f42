# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The model `knn`: the mean of the k nearest training corrections (Chow et al., section 3)."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from .base import Correction, CorrectionModel, Smoothness
from .series import BULK_CHUNK
from .terms import polynomial_powers

# Nearest training points of very many pixels, block by block.
#
# Let r be the distance of the k-th nearest training point from the centre of a block, and e half
# the diagonal of the block. By the triangle inequality, the k nearest training points of all its
# pixels are within r + 2e of the centre. One search therefore serves some 200 pixels. Every numpy
# call takes only some ten microseconds, so a stream in the same process is not delayed.

BLOCK = 200  # pixels per block
MIN_BLOCK = 9  # minimum number of pixels per block, where training points are dense
BLOCKS_PER_QUERY = 32  # blocks per call of scipy
MAX_AT_ONCE = 2_000_000  # maximum number of candidates per query, and of weights, to bound memory
# Work in candidates of a pixel: per block, and per neighbour in the search from its centre.
WORK_OF_BLOCK = 5000
WORK_OF_NEIGHBOUR = 10


def blocks_with_candidates(
    tree: cKDTree, uv: NDArray[np.float64], k: int, most: int
) -> Iterator[tuple[NDArray[np.int64], list[int] | None]]:
    """Yield blocks of pixels uv (n, 2) and the training points that contain their k nearest.

    tree contains the training points. Each block is given as rows of pixels and rows of training
    points; the latter are None if there are more than most, such as where many coincide.
    """
    per_query = int(np.clip(MAX_AT_ONCE // min(tree.n, most), 1, BLOCKS_PER_QUERY))
    for batch, centre, radius in _circles(tree, uv, k, per_query):
        if tree.n <= most:
            yield from zip(batch, tree.query_ball_point(centre, radius))
            continue
        has_few = tree.query_ball_point(centre, radius, return_length=True) <= most
        candidates = iter(
            tree.query_ball_point(centre[has_few], radius[has_few]) if has_few.any() else ()
        )
        for block, is_few in zip(batch, has_few):
            yield block, next(candidates) if is_few else None


def work_of_blocks(tree: cKDTree, uv: NDArray[np.float64], k: int, limit: float) -> int:
    """Return the number of candidates summed over pixels uv (n, 2), plus the work per block.

    Counting stops above the limit.
    """
    total = 0
    for batch, centre, radius in _circles(tree, uv, k, BLOCKS_PER_QUERY):
        counts = tree.query_ball_point(centre, radius, return_length=True)
        total += sum(len(block) * int(count) for block, count in zip(batch, counts))
        total += len(batch) * (WORK_OF_BLOCK + WORK_OF_NEIGHBOUR * k)
        if total > limit:
            break
    return total


def _circles(
    tree: cKDTree, uv: NDArray[np.float64], k: int, per_query: int
) -> Iterator[tuple[list[NDArray[np.int64]], NDArray[np.float64], NDArray[np.float64]]]:
    """Yield per_query blocks at a time, with centres and radii of their circles of candidates."""
    reach = np.median(tree.query(uv[:: len(uv) // 32 + 1], k=[k])[0])  # for a sample of pixels
    blocks = _blocks(uv, reach)
    for start in range(0, len(blocks), per_query):
        batch = blocks[start : start + per_query]
        low = np.array([np.min(uv[block], axis=0) for block in batch])
        high = np.array([np.max(uv[block], axis=0) for block in batch])
        centre = (low + high) / 2
        diagonal = np.linalg.norm(high - low, axis=1)
        kth = tree.query(centre, k=[k])[0][:, 0]
        yield batch, centre, (kth + diagonal) * (1 + 1e-9) + 1e-9


def _blocks(uv: NDArray[np.float64], reach: float) -> list[NDArray[np.int64]]:
    """Return rows of pixels uv (n, 2) that are close together, about BLOCK of them each.

    reach: distance of the k-th nearest training point [px]. Blocks that are larger than this would
    have many more candidates than k, and are divided.
    """
    low = uv.min(axis=0)
    high = uv.max(axis=0)
    spacing = np.sqrt(np.prod(high - low + 1) / len(uv))
    side = min(np.sqrt(BLOCK) * spacing, max(reach, np.sqrt(MIN_BLOCK) * spacing))
    column, row = ((uv - low) / side).astype(np.intp).T
    block = row * (column.max() + 1) + column
    order = np.argsort(block, kind='stable')
    border = np.flatnonzero(np.diff(block[order])) + 1
    return [
        part[i : i + 2 * BLOCK]
        for part in np.split(order, border)
        for i in range(0, len(part), 2 * BLOCK)
    ]


# Nearest neighbours of image points, and the weights of linear smoothers over them.

RIDGE = 1e-6  # on the slopes, relative to the kernel weights; handles collinear neighbours


class Neighbourhoods:
    """Offsets from n query points to their K nearest training points, sorted by distance.

    neighbours (n, K, 2) and queries (n, 2) [px].
    """

    def __init__(self, neighbours: NDArray[np.float64], queries: NDArray[np.float64]) -> None:
        self.dx = neighbours[:, :, 0] - queries[:, :1]
        self.dy = neighbours[:, :, 1] - queries[:, 1:]
        square = self.dx * self.dx + self.dy * self.dy
        self.cubed_distance = square * np.sqrt(square)

    def __len__(self) -> int:
        return len(self.dx)


def tricube_plane_weights(near: Neighbourhoods, k: int) -> NDArray[np.float64]:
    """Return weights (n, k) of a plane fitted to the k nearest values with tricube weights.

    The plane is evaluated at the query point (Cleveland, "Robust locally weighted regression",
    Journal of the American Statistical Association 74, 1979).
    """
    # The k-th neighbour sets the bandwidth; the minimum keeps it positive for coincident points.
    bandwidth3 = np.maximum(near.cubed_distance[:, k - 1 : k], 1e-18)
    kernel = 1 - near.cubed_distance[:, :k] / bandwidth3
    kernel *= kernel * kernel
    equidistant = np.einsum('nk->n', kernel) <= 1e-9  # then all neighbours get the same weight
    if equidistant.any():
        kernel[equidistant] = 1.0
    return plane_weights(near.dx[:, :k], near.dy[:, :k], kernel, bandwidth3[:, 0] ** (2 / 3))


def plane_weights(
    dx: NDArray[np.float64],
    dy: NDArray[np.float64],
    kernel: NDArray[np.float64],
    bandwidth2: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the weights that evaluate, at the origin, the plane fitted to values at (dx, dy).

    The weights of a query sum to one and reproduce planes exactly, except for the ridge.

    dx, dy: (n, k) offsets of the values from the origin. kernel: (n, k) weights of the values in
    the fit; overwritten. bandwidth2: (n,) squared bandwidth, to which the ridge is relative.
    Returns (n, k).
    """
    wx = kernel * dx
    wy = kernel * dy
    s0, sx, sy = (np.einsum('nk->n', w) for w in (kernel, wx, wy))
    ridge = RIDGE * s0 * bandwidth2
    sxx = np.einsum('nk,nk->n', wx, dx) + ridge
    syy = np.einsum('nk,nk->n', wy, dy) + ridge
    sxy = np.einsum('nk,nk->n', wx, dy)
    # First column of the inverse of the moment matrix [[s0, sx, sy], [sx, sxx, sxy],
    # [sy, sxy, syy]].
    a = sxx * syy - sxy * sxy
    b = sxy * sy - sx * syy
    c = sx * sxy - sxx * sy
    scale = 1 / (s0 * a + sx * b + sy * c)
    wx *= (b * scale)[:, None]
    wy *= (c * scale)[:, None]
    kernel *= (a * scale)[:, None]
    kernel += wx
    kernel += wy
    return kernel


class NeighbourTable:
    """Nearest neighbours of points (N, 2) among themselves, sorted by distance.

    The table is built once and can then be queried for varying subsets of the points.

    uv: (N, 2) points. count: maximum number of neighbours per query; some more are stored, so that
    excluded points can be skipped. rows: (T,) points to be queried; by default all.
    """

    def __init__(
        self, uv: NDArray[np.float64], count: int, rows: NDArray[np.int64] | None = None
    ) -> None:
        self._uv = uv
        numbers = np.arange(1, min(len(uv), int(1.3 * count) + 30) + 1)
        if rows is None:
            _, self._near = cKDTree(uv).query(uv, k=numbers)
            return
        self._near = np.empty((len(uv), len(numbers)), dtype=np.intp)
        _, self._near[rows] = cKDTree(uv).query(uv[rows], k=numbers)

    def nearest(
        self, rows: NDArray[np.int64], allowed: NDArray[np.bool_], count: int
    ) -> NDArray[np.int64]:
        """Return the count nearest allowed points (n, count) of the points rows (n,), in order.

        allowed : (N,) ndarray of bool
        """
        neighbours = self._near[rows]
        usable = allowed[neighbours]
        rank = np.cumsum(usable, axis=1)
        out = np.empty((len(rows), count), dtype=np.intp)
        selected = usable & (rank <= count)
        is_full = rank[:, -1] >= count
        out[is_full] = neighbours[is_full][selected[is_full]].reshape(-1, count)
        if not is_full.all():
            # Near the image border, or where a whole exposure is excluded: search again.
            points = np.flatnonzero(allowed)
            _, nearest = cKDTree(self._uv[points]).query(
                self._uv[rows[~is_full]], k=np.arange(1, count + 1)
            )
            out[~is_full] = points[nearest]
        return out

    def restricted(self, selected: NDArray[np.bool_]) -> NeighbourTable:
        """Return the table of the selected points (N, bool) only, renumbered."""
        restricted = NeighbourTable.__new__(NeighbourTable)
        restricted._uv = self._uv[selected]
        number = np.cumsum(selected) - 1
        count = int(np.min(np.sum(selected[self._near[selected]], axis=1)))
        restricted._near = number[self.nearest(np.flatnonzero(selected), selected, count)]
        return restricted


# Polynomial trend of a distortion, fitted to the training corrections.


class Trend:
    """Polynomials in two variables, centred and scaled by the training pixels.

    degree: highest degree; -1: no polynomials. uv (N, 2): training pixels.
    """

    def __init__(self, degree: int, uv: NDArray[np.float64]) -> None:
        self._degree = degree
        self._powers = np.array(polynomial_powers(degree), dtype=int).reshape(-1, 2)
        self._centre = uv.mean(axis=0) if len(uv) else np.zeros(2)
        self._scale = max(float(np.max(np.abs(uv - self._centre), initial=0.0)), 1.0)

    def __len__(self) -> int:
        return len(self._powers)

    def basis(self, uv: ArrayLike) -> NDArray[np.float64]:
        """Return values (n, p) of the polynomials at pixels uv (n, 2)."""
        x, y = ((np.asarray(uv) - self._centre) / self._scale).T
        x_basis, y_basis = (np.vander(a, self._degree + 1, increasing=True) for a in (x, y))
        i, j = self._powers.T
        return np.asarray(x_basis[:, i] * y_basis[:, j])


def least_squares_map(basis: np.ndarray) -> NDArray[np.float64]:
    """Return the matrix (p, N) from N values to least-squares coefficients of a basis (N, p)."""
    return np.linalg.pinv(basis) if basis.shape[1] else np.zeros((0, len(basis)))


# Models that predict a weighted sum of the k nearest training corrections.

MAX_CANDIDATES = 50  # candidates per neighbour; distinct points never have more


class NeighbourModel(CorrectionModel):
    """Linear smoother: a global part plus a weighted sum of the k nearest values.

    The global part is a polynomial trend fitted here, or a series estimated in the adjustment. The
    neighbours smooth its residuals at the training points. A subclass defines the `weights`;
    cross-validation, standard deviations and the lookup grid follow from them.
    """

    smoothness = Smoothness.KINKED
    min_k: ClassVar[int]
    trend_degree: ClassVar[int] = -1  # degree of the polynomial trend; -1: none
    equal_weights: ClassVar[bool] = False  # all weights are 1/k; running means yield all k
    gauge_passes: ClassVar[int] = 3  # a smoother reproduces the gauge only approximately

    tree: cKDTree
    trend: Trend
    trend_coefficients: NDArray[np.float64]
    remainder: NDArray[np.float64]

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
    def weights(cls, near: Neighbourhoods, k: int) -> NDArray[np.float64]:
        """Return weights (n, k) of the k nearest training values in the predictions."""

    @classmethod
    def weights_of_candidates(
        cls, candidates: NDArray[np.float64], uv: NDArray[np.float64], k: int
    ) -> NDArray[np.float64]:
        """Return weights (n, c) of candidates (c, 2) at uv (n, 2); zero except for the k nearest.

        The lookup grid is built with this method. Override it in a subclass that need not sort.
        """
        distance2 = np.sum((candidates - uv[:, None]) ** 2, axis=2)
        index = np.argsort(distance2, axis=1, kind='stable')[:, :k]
        out = np.zeros(distance2.shape)
        weights = cls.weights(Neighbourhoods(candidates[index], uv), k)
        np.put_along_axis(out, index, weights, axis=1)
        return out

    @classmethod
    def candidate_k(cls, count: int) -> NDArray[np.int64]:
        """Return the values of k to try for count training points, in steps of a quarter."""
        largest = max(cls.min_k, min(int(count * 0.4), 400))
        steps = np.round(10 * 1.25 ** np.arange(17)).astype(int)
        steps = steps[steps <= largest]
        return steps if len(steps) else np.array([largest])

    def predict(self, uv: ArrayLike) -> NDArray[np.float64]:
        """Return corrections (n, 2) [px] at pixels uv (n, 2)."""
        return self._predict_with_norm(uv)[0]

    def evaluate(self, uv: ArrayLike) -> Correction:
        """Return the Correction at pixels uv (n, 2), with standard deviations."""
        duv, norm2 = self._predict_with_norm(uv)
        uv = np.asarray(uv, dtype=float).reshape(-1, 2)
        return Correction(duv, self._sd(norm2, uv), self.outside(uv))

    def standard_deviation(self, uv: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return standard deviations (n,) [px] of the predictions at pixels uv (n, 2)."""
        return self.evaluate(uv).sd

    def evaluate_in_bulk(self, uv: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return du, dv and standard deviation (3, n) [px] at many pixels uv (n, 2)."""
        out = np.zeros((3, len(uv)))
        norm2 = np.zeros(len(uv))
        max_candidates = MAX_CANDIDATES * (self.k + 1)
        for block, candidates in blocks_with_candidates(self.tree, uv, self.k, max_candidates):
            if candidates is None:
                predicted, norm2[block] = self._local_part(uv[block])
                out[:2, block] = predicted.T
                continue
            rows = max(1, MAX_AT_ONCE // len(candidates))
            for start in range(0, len(block), rows):
                batch = block[start : start + rows]
                weights = self.weights_of_candidates(self.train_uv[candidates], uv[batch], self.k)
                for axis, remainder in enumerate(self.remainder[candidates].T):
                    out[axis, batch] = np.einsum('nk,k->n', weights, remainder)
                norm2[batch] = np.einsum('nk,nk->n', weights, weights)
        for start in range(0, len(uv), BULK_CHUNK):
            part = slice(start, start + BULK_CHUNK)
            out[:2, part] += self._global_part(uv[part]).T
            out[2, part] = self._sd(norm2[part], uv[part])
        return out

    def bulk_work(self, uv: NDArray[np.float64], limit: float) -> float:
        """Return the work of `evaluate_in_bulk`: candidates of neighbours, and functions."""
        return super().bulk_work(uv, limit) + work_of_blocks(self.tree, uv, self.k, limit)

    def _global_part(self, uv: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the trend or series (n, 2) [px] at pixels uv (n, 2)."""
        if self.series is None:
            return self.trend.basis(uv) @ self.trend_coefficients
        return self.series.predict_in_chunks(uv)

    def _predict_with_norm(self, uv: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return corrections (n, 2) [px] and the squared norms (n,) of their weights."""
        uv = np.asarray(uv, dtype=float).reshape(-1, 2)
        duv, norm2 = self._local_part(uv)
        return duv + self._global_part(uv), norm2

    def _local_part(
        self, uv: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the contribution of the neighbours (n, 2) [px] and squared weight norms (n,)."""
        duv = np.zeros_like(uv)
        norm2 = np.zeros(len(uv))
        size = max(1, MAX_AT_ONCE // self.k)
        for start in range(0, len(uv), size):
            part = slice(start, start + size)
            _, index = self.tree.query(uv[part], k=np.arange(1, self.k + 1))
            weights = self.weights(Neighbourhoods(self.tree.data[index], uv[part]), self.k)
            duv[part] = np.einsum('nk,nkc->nc', weights, self.remainder[index])
            norm2[part] = np.einsum('nk,nk->n', weights, weights)
        return duv, norm2


# The model `local_linear`: a cubic trend, and local planes fitted to its residuals.
#
# Where all neighbours are on one side, as at the border of an image, a local plane has no bias,
# but the mean of the neighbours has. However, a plane flattens curvature within its neighbourhood.
# In the alternation with the adjustment the flattened part is lost: orientations and object points
# absorb it. Pincushion, S-shape and spiral distortion bend over the whole image and are cubic
# polynomials to first order (Gronenschild, Medical Physics 24, 1997), so a cubic is fitted first.


def _distances(
    candidates: NDArray[np.float64], uv: NDArray[np.float64], k: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return offsets (n, c) in u and v, squared distances, and the k-th smallest of these (n,)."""
    dx = candidates[:, 0] - uv[:, :1]
    dy = candidates[:, 1] - uv[:, 1:]
    distance2 = dx * dx
    distance2 += dy * dy
    return dx, dy, distance2, np.partition(distance2, k - 1, axis=1)[:, k - 1]


class LocalLinearModel(NeighbourModel):
    """Cubic trend plus a plane fitted to the k nearest residuals with tricube weights."""

    kind = 'local_linear'
    description = 'cubic trend, and planes fitted to the k nearest residuals'
    min_k = 6
    trend_degree = 3
    gauge_passes = 1  # the trend reproduces the gauge

    @classmethod
    def weights(cls, near: Neighbourhoods, k: int) -> NDArray[np.float64]:
        """Return weights (n, k) of the plane fitted with tricube weights."""
        return tricube_plane_weights(near, k)

    @classmethod
    def weights_of_candidates(
        cls, candidates: NDArray[np.float64], uv: NDArray[np.float64], k: int
    ) -> NDArray[np.float64]:
        """Return weights (n, c); 0 for candidates as far as the k-th nearest or farther."""
        dx, dy, distance2, kth = _distances(candidates, uv, k)
        ratio = distance2 / np.maximum(kth, 1e-12)[:, None]
        np.minimum(ratio, 1, out=ratio)
        kernel = np.sqrt(ratio)
        kernel *= ratio
        np.subtract(1, kernel, out=kernel)
        kernel *= kernel * kernel
        equidistant = np.einsum('nk->n', kernel) <= 1e-9  # then all neighbours get the same weight
        if equidistant.any():
            kernel[equidistant] = distance2[equidistant] <= kth[equidistant, None]
        return plane_weights(dx, dy, kernel, kth)


# The model `hybrid`: a cubic trend in the adjustment, and local planes fitted to its residuals.


class HybridModel(LocalLinearModel):
    """Polynomial series from the adjustment plus local planes."""

    kind = 'hybrid'
    description = 'cubic trend in the adjustment, and planes fitted to the k nearest residuals'
    has_series = True
    trend_degree = -1
    gauge_passes = 3


class KnnModel(NeighbourModel):
    """Mean of the k nearest training corrections, like scikit-learn's KNeighborsRegressor."""

    kind = 'knn'
    description = 'mean of the k nearest residuals'
    smoothness = Smoothness.STEPPED
    min_k = 1
    equal_weights = True

    @classmethod
    def weights(cls, near: Neighbourhoods, k: int) -> NDArray[np.float64]:
        """Return weights (n, k), all equal to 1/k."""
        return np.full((len(near), k), 1.0 / k)

    @classmethod
    def weights_of_candidates(
        cls, candidates: NDArray[np.float64], uv: NDArray[np.float64], k: int
    ) -> NDArray[np.float64]:
        """Return weights (n, c), equal for candidates at most as far as the k-th nearest."""
        *_, distance2, kth = _distances(candidates, uv, k)
        nearest = (distance2 <= kth[:, None]).astype(float)
        return nearest / nearest.sum(axis=1, keepdims=True)

    @classmethod
    def candidate_k(cls, count: int) -> NDArray[np.int64]:
        """Return all k from 3 to 100, or to 40 % of count training points."""
        largest = max(cls.min_k, min(int(count * 0.4), 100))
        return np.arange(min(3, largest), largest + 1)
