# Copyright 2026 fluoro_calib_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Additional parameters: a correction of the image points that is linear in its coefficients.

The coefficients are unknowns of the adjustment. The functions are evaluated at observed pixels, so
they do not change while the unknowns are adjusted. A Gaussian prior (mean zero) on the
coefficients makes the correction a signal in the sense of least-squares collocation (Moritz,
"Advanced Physical Geodesy", Wichmann 1980, part B).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.linalg import blas

ALL = slice(None)


@dataclass(frozen=True)
class AdditionalParameters:
    """Functions and prior of the additional parameters of one fluoroscope.

    Attributes
    ----------
    functions : (N, k) or (N, 2, p) ndarray
        Values of the functions at the N image points of the fluoroscope. (N, k): the same
        functions for u and v with separate coefficients, p = 2 k, those of u first. (N, 2, p):
        coefficients shared by u and v.
    prior : (p, p) ndarray
        Precision matrix of the coefficients; zeros for no prior.
    """

    functions: np.ndarray
    prior: np.ndarray

    @property
    def count(self) -> int:
        """Number p of coefficients."""
        return self.functions.shape[-1] * (2 if self.functions.ndim == 2 else 1)

    @cached_property
    def _contiguous(self) -> np.ndarray:
        """Functions (2, N, p) of u and v: strided products take four times as long."""
        return np.ascontiguousarray(self.functions.transpose(1, 0, 2))

    def _by_axis(self) -> list[tuple[np.ndarray, slice]]:
        """Functions (N, p or k) of u and of v, and the columns of their coefficients."""
        if self.functions.ndim == 3:
            return [(self._contiguous[axis], ALL) for axis in (0, 1)]
        k = self.functions.shape[1]
        return [(self.functions, slice(axis * k, (axis + 1) * k)) for axis in (0, 1)]

    def correction(self, coefficients: np.ndarray) -> np.ndarray:
        """Corrections (N, 2) [px] for coefficients (p,)."""
        return np.stack([f @ coefficients[columns] for f, columns in self._by_axis()], axis=1)

    def normal_matrix(self, weight: np.ndarray) -> np.ndarray:
        """Normal matrix (p, p) of the coefficients for weights (N,) of the image points."""
        out = np.zeros((self.count, self.count))
        if self.functions.ndim == 2:
            k = self.functions.shape[1]
            weighted = np.sqrt(weight)[:, None] * self.functions
            # BLAS stores by columns, so the transpose needs no copy.
            lower = blas.dsyrk(1.0, weighted.T, lower=1)
            out[:k, :k] = lower + np.tril(lower, -1).T
            out[k:, k:] = out[:k, :k]
            return out
        lower = out.T
        for f, _ in self._by_axis():
            weighted = np.sqrt(weight)[:, None] * f
            lower = blas.dsyrk(1.0, weighted.T, beta=1.0, c=lower, lower=1, overwrite_c=1)
        return lower + np.tril(lower, -1).T

    def right_side(self, values: np.ndarray) -> np.ndarray:
        """Sum (p,) over the image points of the functions times values (N, 2)."""
        out = np.zeros(self.count)
        for axis, (f, columns) in enumerate(self._by_axis()):
            out[columns] += values[:, axis] @ f
        return out

    def grouped_products(self, index: np.ndarray, count: int, a: np.ndarray) -> np.ndarray:
        """Sums (count, q, p) of a^T times functions over image points with the same index.

        index (N,) from 0 to count - 1; a (N, 2, q) weighted derivatives by other unknowns.
        """
        n, _, q = a.shape
        out = np.zeros((count * q, self.count))
        rows = (index[:, None] * q + np.arange(q)).ravel()
        starts = np.arange(0, n * q + 1, q)
        for axis, (f, columns) in enumerate(self._by_axis()):
            gather = sparse.csc_matrix((a[:, axis].ravel(), rows, starts), shape=(count * q, n))
            out[:, columns] += gather @ f
        return out.reshape(count, q, -1)

    def correction_covariance(self, covariance: np.ndarray, part: slice = ALL) -> np.ndarray:
        """Covariances (n, 2, 2) [px^2] of the corrections at image points `part`.

        covariance (p, p) of the coefficients.
        """
        (fu, cu), (fv, cv) = ((f[part], columns) for f, columns in self._by_axis())
        out = np.empty((len(fu), 2, 2))
        for i, (f, columns) in enumerate(((fu, cu), (fv, cv))):
            out[:, i, i] = np.einsum('np,np->n', f @ covariance[columns, columns], f)
        out[:, 0, 1] = np.einsum('np,np->n', fu @ covariance[cu, cv], fv)
        out[:, 1, 0] = out[:, 0, 1]
        return out

    def cross_covariance(
        self, covariance: np.ndarray, index: np.ndarray, part: slice = ALL
    ) -> np.ndarray:
        """Covariances (n, q, 2) of other unknowns with the corrections at image points `part`.

        covariance (k, q, p) of k sets of other unknowns with the coefficients; index (n,) of the
        set that belongs to each image point.
        """
        out = np.empty((len(index), covariance.shape[1], 2))
        order = np.argsort(index, kind='stable')
        starts = np.flatnonzero(np.diff(index[order], prepend=-1)).tolist()
        groups = list(zip(starts, [*starts[1:], len(order)], index[order][starts].tolist()))
        for axis, (f, columns) in enumerate(self._by_axis()):
            ordered = f[part][order]
            mixed = covariance[:, :, columns]
            found = np.empty((len(index), covariance.shape[1]))
            for start, stop, group in groups:
                np.matmul(ordered[start:stop], mixed[group].T, out=found[start:stop])
            out[order, :, axis] = found
        return out
