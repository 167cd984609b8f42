"""Polynomial trend of a distortion.

A local plane flattens what bends within its reach, and in the alternation with the adjustment the
flattened part is not won back: orientations and object points absorb it. Pincushion, S-shape and
spiral bend over the whole image and are cubic polynomials to first order (Gronenschild, Medical
Physics 24, 1997), so their polynomial is fitted first, and the local planes to what is left.
"""

import numpy as np

DEGREE = {'local_linear': 3}  # of the polynomial of each kind of model; None: there is none


class Trend:
    """Polynomials in two variables up to a degree, centred and scaled by the training pixels uv
    (N, 2).
    """

    def __init__(self, kind, uv):
        degree = DEGREE.get(kind)
        self._powers = (
            []
            if degree is None
            else [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
        )
        self._centre = uv.mean(axis=0) if len(uv) else np.zeros(2)
        self._scale = max(float(np.max(np.abs(uv - self._centre), initial=0.0)), 1.0)

    def __len__(self):
        return len(self._powers)

    def basis(self, uv):
        """Values (n, p) of the polynomials at pixels uv (n, 2)."""
        x, y = ((np.asarray(uv) - self._centre) / self._scale).T
        out = np.empty((len(x), len(self._powers)))
        for column, (i, j) in enumerate(self._powers):
            # Each is an earlier one times x or y.
            if i:
                np.multiply(out[:, self._powers.index((i - 1, j))], x, out=out[:, column])
            elif j:
                np.multiply(out[:, self._powers.index((i, j - 1))], y, out=out[:, column])
            else:
                out[:, column] = 1.0
        return out


def least_squares_map(basis):
    """Matrix (p, N) that turns values at N points into the coefficients of basis (N, p) that fit
    them best.
    """
    return np.linalg.pinv(basis) if basis.shape[1] else np.zeros((0, len(basis)))
