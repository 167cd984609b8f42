# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The collinearity condition of an X-ray image, and its derivatives.

X = R (P - T);  u = xp + c X/Z,  v = yp + c Y/Z: Eq. 1 of Chow et al. rotated by 180 degrees about
x, so that z points from the source to the image. P is the object point [mm], T the source [mm], R
the rotation phantom -> sensor, (xp, yp, c) the interior orientation [px]. A rotation is varied
from the left, R -> exp([w]x) R, so that dX/dw = -[X]x.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import blas

from .rotations import cross_matrix, mirror_lower


def to_sensor(
    rotation: NDArray[np.float64], position: NDArray[np.float64], points: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return points in the sensor frame (n, 3) [mm].

    rotation (n, 3, 3) phantom -> sensor; position and points (n, 3) [mm]. A single rotation (3, 3)
    and position (3,) apply to all points.
    """
    return np.matmul(rotation, (points - position)[..., None])[..., 0]


def project(
    rotation: NDArray[np.float64],
    position: NDArray[np.float64],
    points: NDArray[np.float64],
    interior: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return image points (n, 2) [px]; NaN for an object point that is not before the source.

    Parameters
    ----------
    rotation : (n, 3, 3) or (3, 3) ndarray
        Rotation phantom -> sensor for each point, or for all.
    position : (n, 3) or (3,) ndarray
        Position of the source for each point, or for all [mm].
    points : (n, 3) ndarray
        Object points [mm].
    interior : (n, 3) or (3,) ndarray
        xp, yp, c [px].
    """
    x = to_sensor(rotation, position, points)
    z = np.where(x[:, 2] > 0, x[:, 2], np.nan)
    interior = np.broadcast_to(interior, (len(x), 3))
    return interior[:, :2] + interior[:, 2:] * x[:, :2] / z[:, None]


def project_with_jacobian(
    rotation: NDArray[np.float64],
    position: NDArray[np.float64],
    points: NDArray[np.float64],
    interior: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return image points and their derivatives; parameters as in `project`.

    Returns
    -------
    uv : (n, 2) ndarray
        Image points [px].
    d_exterior : (n, 2, 6) ndarray
        Derivatives by T [mm] and w [rad].
    d_point : (n, 2, 3) ndarray
        Derivatives by P [mm].
    d_interior : (n, 2, 3) ndarray
        Derivatives by xp, yp, c.
    """
    x = to_sensor(rotation, position, points)
    z = np.where(x[:, 2] > 0, x[:, 2], np.nan)
    interior = np.broadcast_to(interior, (len(x), 3))
    c = interior[:, 2]
    ratio = x[:, :2] / z[:, None]
    uv = interior[:, :2] + c[:, None] * ratio

    d_sensor = np.zeros((len(x), 2, 3))
    d_sensor[:, 0, 0] = c / z
    d_sensor[:, 1, 1] = c / z
    d_sensor[:, :, 2] = -(c / z)[:, None] * ratio
    d_point = d_sensor @ rotation
    d_exterior = np.concatenate([-d_point, -(d_sensor @ cross_matrix(x))], axis=2)
    d_interior = np.zeros((len(x), 2, 3))
    d_interior[:, 0, 0] = 1.0
    d_interior[:, 1, 1] = 1.0
    d_interior[:, :, 2] = ratio
    return uv, d_exterior, d_point, d_interior


# Additional parameters: a correction of the image points that is linear in its coefficients.
#
# The coefficients are unknowns of the adjustment. The functions are evaluated at observed pixels,
# so they do not change during the adjustment. A Gaussian prior (mean zero) on the coefficients
# makes the correction a signal in the sense of least-squares collocation (Moritz, "Advanced
# Physical Geodesy", Wichmann 1980, part B).

ALL = slice(None)


@dataclass(frozen=True)
class GroupedFunctions:
    """Additional functions with separate coefficients in every group of image points.

    values (N, 2, t): functions at the image points, shared by u and v; group (N,): group of each
    image point, ascending from 0. Coefficients are ordered group by group.
    """

    values: NDArray[np.float64]
    group: NDArray[np.int64]

    @property
    def count(self) -> int:
        """Number of coefficients."""
        return (int(self.group[-1]) + 1) * self.values.shape[2]

    def split(self, of_coefficients: NDArray[np.float64]) -> NDArray[np.float64]:
        """Reshape values (..., count) of the coefficients to (..., groups, t)."""
        return of_coefficients.reshape(*of_coefficients.shape[:-1], -1, self.values.shape[2])


@dataclass(frozen=True)
class _Ordered:
    """Functions (N, k) of image points ordered by an index, and the rows where it changes."""

    index: NDArray[np.int64]
    order: NDArray[np.int64] | slice
    functions: NDArray[np.float64]
    groups: list[tuple[int, int, int]]


@dataclass(frozen=True)
class AdditionalParameters:
    """Functions and prior of the additional parameters of one fluoroscope."""

    #: (N, 2, p) values of the functions at the N image points of the fluoroscope. (N, k): the same
    #: functions for u and v with separate coefficients, p = 2 k, those of u first. (N, 2, p):
    #: coefficients shared by u and v
    functions: NDArray[np.float64]
    prior: NDArray[np.float64]  #: (P, P) precision matrix of the coefficients; zeros for no prior
    #: with functions (N, k): functions of groups of image points, whose coefficients are the last
    grouped: GroupedFunctions | None = None
    #: (g, P) rows whose products with the coefficients have zero mean and unit variance too. Rows
    #: that fix a gauge have large products with parts of the coefficients, which cancel out only
    #: as long as they are not squared.
    conditions: NDArray[np.float64] | None = None

    @cached_property
    def precision(self) -> NDArray[np.float64]:
        """Precision matrix (P, P) of the prior with its conditions."""
        rows = self.conditions
        return self.prior if rows is None else self.prior + rows.T @ rows

    def pull(self, coefficients: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the derivatives (P,) of half the penalty of coefficients (P,)."""
        out = self.prior @ coefficients
        if self.conditions is not None:
            out += self.conditions.T @ (self.conditions @ coefficients)
        return out

    def penalty(self, coefficients: NDArray[np.float64]) -> float:
        """Return the normalised square of coefficients (P,) by the prior."""
        square = float(coefficients @ self.prior @ coefficients)
        if self.conditions is not None:
            square += float(np.sum((self.conditions @ coefficients) ** 2))
        return square

    @property
    def _common(self) -> int:
        """Number of coefficients that are common to all image points."""
        return self.functions.shape[-1] * (2 if self.functions.ndim == 2 else 1)

    @property
    def count(self) -> int:
        """Number P of coefficients."""
        return self._common + (0 if self.grouped is None else self.grouped.count)

    @cached_property
    def _contiguous(self) -> NDArray[np.float64]:
        """Contiguous functions (2, N, p) of u and v; strided products take four times as long."""
        return np.ascontiguousarray(self.functions.transpose(1, 0, 2))

    def _by_axis(self) -> list[tuple[NDArray[np.float64], slice]]:
        """Return functions (N, p or k) of u and of v, and the columns of their coefficients."""
        if self.functions.ndim == 3:
            return [(self._contiguous[axis], ALL) for axis in (0, 1)]
        k = self.functions.shape[1]
        return [(self.functions, slice(axis * k, (axis + 1) * k)) for axis in (0, 1)]

    def correction(self, coefficients: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the corrections (N, 2) [px] for coefficients (P,)."""
        common = coefficients[: self._common]
        out = np.stack([f @ common[columns] for f, columns in self._by_axis()], axis=1)
        if self.grouped is not None:
            point_coefficients = self.grouped.split(coefficients[self._common :])[
                self.grouped.group
            ]
            out += (self.grouped.values @ point_coefficients[:, :, None])[:, :, 0]
        return out

    def normal_matrix(self, weight: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the normal matrix (P, P) of the coefficients for weights (N,) of image points."""
        out = np.zeros((self.count, self.count))
        if self.functions.ndim == 2:
            k = self.functions.shape[1]
            if k:  # BLAS reports empty matrices as an error
                weighted = np.sqrt(weight)[:, None] * self.functions
                # BLAS stores by columns, so the transpose needs no copy.
                lower = blas.dsyrk(1.0, weighted.T, lower=1)
                out[:k, :k] = mirror_lower(lower)
                out[k : 2 * k, k : 2 * k] = out[:k, :k]
            if self.grouped is not None:
                self._add_grouped(self.grouped, weight, out)
            return out
        lower = out.T
        for f, _ in self._by_axis():
            weighted = np.sqrt(weight)[:, None] * f
            lower = blas.dsyrk(1.0, weighted.T, beta=1.0, c=lower, lower=1, overwrite_c=1)
        return mirror_lower(lower)

    def _add_grouped(
        self, grouped: GroupedFunctions, weight: NDArray[np.float64], out: NDArray[np.float64]
    ) -> None:
        """Fill in the rows and columns of functions of groups in a normal matrix."""
        weighted = weight[:, None, None] * grouped.values
        groups = int(grouped.group[-1]) + 1
        products = self.grouped_products(grouped.group, groups, weighted)
        rows = products.reshape(grouped.count, self.count)
        out[self._common :] = rows
        out[: self._common, self._common :] = rows[:, : self._common].T

    def right_side(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the sum (P,) over the image points of the functions times values (N, 2)."""
        out = np.zeros(self.count)
        for axis, (f, columns) in enumerate(self._by_axis()):
            out[: self._common][columns] += values[:, axis] @ f
        if self.grouped is not None:
            products = (values[:, None] @ self.grouped.values)[:, 0]
            np.add.at(self.grouped.split(out[self._common :]), self.grouped.group, products)
        return out

    def _ordered(self, index: NDArray[np.int64]) -> _Ordered:
        """Return functions (N, k) ordered by an index (N,); cache the last unordered index."""
        cached: _Ordered | None = self.__dict__.get('_kept')
        if cached is not None and np.array_equal(cached.index, index):
            return cached
        steps = np.diff(index)
        if np.all(steps >= 0):
            return _Ordered(index, ALL, self.functions, _groups(index))
        order = np.argsort(index, kind='stable')
        ordered = _Ordered(index, order, self.functions[order], _groups(index[order]))
        self.__dict__['_kept'] = ordered
        return ordered

    def grouped_products(
        self, index: NDArray[np.int64], count: int, a: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return sums (count, q, P) of a^T times functions over image points with the same index.

        index (N,) from 0 to count - 1; a (N, 2, q): weighted derivatives by other unknowns.
        """
        n, _, q = a.shape
        out = np.zeros((count, q, self.count))
        if self.functions.ndim == 2:
            k = self.functions.shape[1]
            ordered = self._ordered(index)
            stacked = a.reshape(n, 2 * q)[ordered.order]
            for start, stop, group in ordered.groups:
                product = stacked[start:stop].T @ ordered.functions[start:stop]
                out[group, :, :k] = product[:q]
                out[group, :, k : 2 * k] = product[q:]
        else:
            rows = (index[:, None] * q + np.arange(q)).ravel()
            starts = np.arange(0, n * q + 1, q)
            flat = out.reshape(count * q, -1)
            for axis in (0, 1):
                shape = (count * q, n)
                summation = sparse.csc_matrix((a[:, axis].ravel(), rows, starts), shape=shape)
                flat += summation @ self._contiguous[axis]
        if self.grouped is not None:
            functions = self.grouped
            groups = int(functions.group[-1]) + 1
            products = (a.transpose(0, 2, 1) @ functions.values).reshape(n, -1)
            pairs = index * groups + functions.group
            summation = sparse.csc_matrix(
                (np.ones(n), pairs, np.arange(n + 1)), shape=(count * groups, n)
            )
            sums = (summation @ products).reshape(count, groups, q, -1)
            out[:, :, self._common :] = sums.transpose(0, 2, 1, 3).reshape(count, q, -1)
        return out

    def correction_covariance(
        self, covariance: NDArray[np.float64], part: slice = ALL
    ) -> NDArray[np.float64]:
        """Return covariances (n, 2, 2) [px^2] of the corrections at image points `part`.

        covariance (P, P): of the coefficients.
        """
        (fu, cu), (fv, cv) = ((f[part], columns) for f, columns in self._by_axis())
        common = covariance[: self._common, : self._common]
        out = np.empty((len(fu), 2, 2))
        for i, (f, columns) in enumerate(((fu, cu), (fv, cv))):
            out[:, i, i] = np.einsum('np,np->n', f @ common[columns, columns], f)
        out[:, 0, 1] = np.einsum('np,np->n', fu @ common[cu, cv], fv)
        out[:, 1, 0] = out[:, 0, 1]
        if self.grouped is not None:
            out += self._grouped_covariance(self.grouped, covariance, part)
        return out

    def _grouped_covariance(
        self, grouped: GroupedFunctions, covariance: NDArray[np.float64], part: slice
    ) -> NDArray[np.float64]:
        """Return the part (n, 2, 2) of group functions in the covariances of the corrections."""
        values = grouped.values[part]
        group = grouped.group[part]
        t = grouped.values.shape[2]
        rows = covariance[self._common :]
        with_common = rows[:, : self._common].reshape(-1, t, self._common)
        mixed = values @ self._common_cross_covariance(with_common, group, part)
        groups = np.arange(len(with_common))
        blocks = rows[:, self._common :].reshape(len(groups), t, len(groups), t)
        blocks = blocks[groups, :, groups]
        return (
            mixed + mixed.transpose(0, 2, 1) + values @ blocks[group] @ values.transpose(0, 2, 1)
        )

    def cross_covariance(
        self, covariance: NDArray[np.float64], index: NDArray[np.int64], part: slice = ALL
    ) -> NDArray[np.float64]:
        """Return covariances (n, q, 2) of other unknowns with the corrections at points `part`.

        covariance (k, q, P): of k sets of other unknowns with the coefficients; index (n,): set
        that belongs to each image point.
        """
        out = self._common_cross_covariance(covariance[:, :, : self._common], index, part)
        if self.grouped is not None:
            by_group = self.grouped.split(covariance[:, :, self._common :])
            covariance_of_point = by_group[index, :, self.grouped.group[part]]
            out += covariance_of_point @ self.grouped.values[part].transpose(0, 2, 1)
        return out

    def _common_cross_covariance(
        self, covariance: NDArray[np.float64], index: NDArray[np.int64], part: slice
    ) -> NDArray[np.float64]:
        """Return covariances (n, q, 2) as `cross_covariance`, of the common functions alone."""
        sets, q, _ = covariance.shape
        n = len(index)
        order = np.argsort(index, kind='stable')
        groups = _groups(index[order])
        out = np.empty((n, q, 2))
        if self.functions.ndim == 2:
            k = self.functions.shape[1]
            f = self.functions[part]
            f = f if np.all(np.diff(order) == 1) else f[order]
            flat = covariance.reshape(sets, 2 * q, k)  # of every unknown, u first
            products = np.empty((n, 2 * q))
            for start, stop, group in groups:
                np.matmul(f[start:stop], flat[group].T, out=products[start:stop])
            out[order] = products.reshape(n, q, 2)
            return out
        for axis in (0, 1):
            ordered = self._contiguous[axis][part][order]
            axis_product = np.empty((n, q))
            for start, stop, group in groups:
                np.matmul(ordered[start:stop], covariance[group].T, out=axis_product[start:stop])
            out[order, :, axis] = axis_product
        return out


def _groups(index: NDArray[np.int64]) -> list[tuple[int, int, int]]:
    """Return (first row, row after the last, value) for each value of an ascending index (n,)."""
    starts = np.flatnonzero(np.diff(index, prepend=-1)).tolist()
    return list(zip(starts, [*starts[1:], len(index)], index[starts].tolist()))
