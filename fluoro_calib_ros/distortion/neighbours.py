# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Nearest neighbours of image points, and the weights of linear smoothers over them."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

RIDGE = 1e-6  # of the slopes, relative to the kernel weights: collinear neighbours stay harmless


class Neighbourhoods:
    """Offsets from n query points to their K nearest training points, ascending in distance.

    neighbours (n, K, 2) and queries (n, 2) [px].
    """

    def __init__(self, neighbours: np.ndarray, queries: np.ndarray) -> None:
        self.dx = neighbours[:, :, 0] - queries[:, :1]
        self.dy = neighbours[:, :, 1] - queries[:, 1:]
        square = self.dx * self.dx + self.dy * self.dy
        self.cubed_distance = square * np.sqrt(square)

    def __len__(self) -> int:
        return len(self.dx)


def tricube_plane_weights(near: Neighbourhoods, k: int) -> np.ndarray:
    """Weights (n, k) of a plane fitted to the k nearest values with tricube weights.

    The plane is evaluated at the query point (Cleveland, "Robust locally weighted regression",
    Journal of the American Statistical Association 74, 1979).
    """
    # The k-th neighbour sets the bandwidth; among coincident points it stays positive.
    bandwidth3 = np.maximum(near.cubed_distance[:, k - 1 : k], 1e-18)
    kernel = 1 - near.cubed_distance[:, :k] / bandwidth3
    kernel *= kernel * kernel
    equidistant = np.einsum('nk->n', kernel) <= 1e-9  # then all neighbours have the same weight
    if equidistant.any():
        kernel[equidistant] = 1.0
    return plane_weights(near.dx[:, :k], near.dy[:, :k], kernel, bandwidth3[:, 0] ** (2 / 3))


def plane_weights(
    dx: np.ndarray, dy: np.ndarray, kernel: np.ndarray, bandwidth2: np.ndarray
) -> np.ndarray:
    """Weights that evaluate at the origin the plane fitted to values at (dx, dy).

    The weights of a query sum to one and reproduce planes exactly but for the ridge.

    Parameters
    ----------
    dx, dy : (n, k) ndarray
        Offsets of the values from the origin.
    kernel : (n, k) ndarray
        Weights of the values in the fit; overwritten.
    bandwidth2 : (n,) ndarray
        Squared bandwidth, to which the ridge is relative.

    Returns
    -------
    (n, k) ndarray
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
    """The nearest neighbours of points (N, 2) among themselves, in order of distance.

    It is built once and then answers for changing subsets of the points.

    Parameters
    ----------
    uv : (N, 2) ndarray
    count : int
        Number of neighbours that will be asked for. Some more are looked up, so that excluded
        points can be skipped.
    rows : (T,) ndarray of int, optional
        Points whose neighbours will be asked for; by default all.
    """

    def __init__(self, uv: np.ndarray, count: int, rows: np.ndarray | None = None) -> None:
        self._uv = uv
        numbers = np.arange(1, min(len(uv), int(1.3 * count) + 30) + 1)
        if rows is None:
            _, self._near = cKDTree(uv).query(uv, k=numbers)
            return
        self._near = np.empty((len(uv), len(numbers)), dtype=np.intp)
        _, self._near[rows] = cKDTree(uv).query(uv[rows], k=numbers)

    def nearest(self, rows: np.ndarray, allowed: np.ndarray, count: int) -> np.ndarray:
        """Return the count nearest allowed points (n, count) of the points rows (n,), in order.

        allowed : (N,) ndarray of bool
        """
        near = self._near[rows]
        good = allowed[near]
        rank = np.cumsum(good, axis=1)
        out = np.empty((len(rows), count), dtype=np.intp)
        selected = good & (rank <= count)
        full = rank[:, -1] >= count
        out[full] = near[full][selected[full]].reshape(-1, count)
        if not full.all():
            # Near a border of the image, or where a whole exposure is held out: search again.
            points = np.flatnonzero(allowed)
            _, found = cKDTree(self._uv[points]).query(
                self._uv[rows[~full]], k=np.arange(1, count + 1)
            )
            out[~full] = points[found]
        return out

    def restricted(self, selected: np.ndarray) -> NeighbourTable:
        """Return the table of the selected points (N, bool) alone, renumbered."""
        other = NeighbourTable.__new__(NeighbourTable)
        other._uv = self._uv[selected]
        number = np.cumsum(selected) - 1
        count = int(np.min(np.sum(selected[self._near[selected]], axis=1)))
        other._near = number[self.nearest(np.flatnonzero(selected), selected, count)]
        return other
