"""Additional parameters: a correction of the image points that is linear in unknowns of the
adjustment.

The functions are evaluated at observed pixels, so they do not change while the unknowns are
adjusted. A Gaussian prior (mean zero) on their coefficients makes the correction a signal in the
sense of least-squares collocation (Moritz, "Advanced Physical Geodesy", Wichmann 1980, part B).
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.linalg import blas


@dataclass(frozen=True)
class Additional:
    """Additional parameters of one fluoroscope.

    functions (N, m) at its N image points, the same for u and v, each with coefficients of its
    own: p = 2 m, those of u first; or (N, 2, p), with coefficients that u and v share. prior (p,
    p): precision matrix of the coefficients, zeros where nothing is known of them beforehand.
    """

    functions: np.ndarray
    prior: np.ndarray

    @property
    def count(self):
        """Number p of coefficients."""
        return self.functions.shape[-1] * (2 if self.functions.ndim == 2 else 1)

    def _by_axis(self):
        """Functions (N, p or m) of u and of v, and the columns of their coefficients."""
        if self.functions.ndim == 3:
            return [(self.functions[:, axis], slice(None)) for axis in (0, 1)]
        m = self.functions.shape[1]
        return [(self.functions, slice(axis * m, (axis + 1) * m)) for axis in (0, 1)]

    def correction(self, coefficients):
        """Corrections (N, 2) [px] for coefficients (p,)."""
        return np.stack([f @ coefficients[columns] for f, columns in self._by_axis()], axis=1)

    def gram(self, weight):
        """Normal matrix (p, p) of the coefficients for weights (N,) of the image points."""
        out = np.zeros((self.count, self.count))
        if self.functions.ndim == 2:
            m = self.functions.shape[1]
            weighted = np.sqrt(weight)[:, None] * self.functions
            half = blas.dsyrk(
                1.0, weighted.T, lower=1
            )  # in BLAS's order of storage this is the transpose
            out[:m, :m] = half + np.tril(half, -1).T
            out[m:, m:] = out[:m, :m]
            return out
        for f, _ in self._by_axis():
            out += f.T @ (weight[:, None] * f)
        return out

    def transposed(self, values):
        """Sum (p,) of the functions times values (N, 2)."""
        out = np.zeros(self.count)
        for axis, (f, columns) in enumerate(self._by_axis()):
            out[columns] += values[:, axis] @ f
        return out

    def sums(self, index, count, a):
        """Sums (count, q, p) of a^T times functions over the image points that share an index.

        index (N,) from 0 to count - 1; a (N, 2, q) derivatives by other unknowns, with their
        weights.
        """
        n, _, q = a.shape
        out = np.zeros((count * q, self.count))
        rows = (index[:, None] * q + np.arange(q)).ravel()
        starts = np.arange(0, n * q + 1, q)
        for axis, (f, columns) in enumerate(self._by_axis()):
            gather = sparse.csc_matrix((a[:, axis].ravel(), rows, starts), shape=(count * q, n))
            out[:, columns] += gather @ f
        return out.reshape(count, q, -1)

    def variance(self, covariance, part=slice(None)):
        """Covariances (n, 2, 2) [px^2] of the corrections at image points, of that of the
        coefficients (p, p).
        """
        (fu, cu), (fv, cv) = ((f[part], columns) for f, columns in self._by_axis())
        out = np.empty((len(fu), 2, 2))
        for i, (f, columns) in enumerate(((fu, cu), (fv, cv))):
            out[:, i, i] = np.einsum('np,np->n', f @ covariance[columns, columns], f)
        out[:, 0, 1] = out[:, 1, 0] = np.einsum('np,np->n', fu @ covariance[cu, cv], fv)
        return out

    def against(self, other, index, part=slice(None)):
        """Covariances (n, q, 2) of other unknowns with the corrections at image points.

        other (k, q, p): covariances of those unknowns with the coefficients, of which an image
        point has that in row index (n,); part: the image points.
        """
        out = np.empty((len(index), other.shape[1], 2))
        order = np.argsort(index, kind='stable')
        starts = np.flatnonzero(np.diff(index[order], prepend=-1))
        for axis, (f, columns) in enumerate(self._by_axis()):
            f = f[part]
            mixed = other[:, :, columns]
            for rows in np.split(order, starts[1:]):
                out[rows, :, axis] = f[rows] @ mixed[index[rows[0]]].T
        return out
