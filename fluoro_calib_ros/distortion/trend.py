# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Polynomial trend of a distortion, fitted to the training corrections."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike


class Trend:
    """Polynomials in two variables, centred and scaled by the training pixels.

    degree: the highest, None: there are no polynomials; uv (N, 2): training pixels.
    """

    def __init__(self, degree: int | None, uv: np.ndarray) -> None:
        self._powers = (
            []
            if degree is None
            else [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
        )
        self._centre = uv.mean(axis=0) if len(uv) else np.zeros(2)
        self._scale = max(float(np.max(np.abs(uv - self._centre), initial=0.0)), 1.0)

    def __len__(self) -> int:
        return len(self._powers)

    def basis(self, uv: ArrayLike) -> np.ndarray:
        """Values (n, p) of the polynomials at pixels uv (n, 2)."""
        x, y = ((np.asarray(uv) - self._centre) / self._scale).T
        out = np.empty((len(x), len(self._powers)))
        for column, (i, j) in enumerate(self._powers):
            # Each polynomial is an earlier one times x or y.
            if i:
                np.multiply(out[:, self._powers.index((i - 1, j))], x, out=out[:, column])
            elif j:
                np.multiply(out[:, self._powers.index((i, j - 1))], y, out=out[:, column])
            else:
                out[:, column] = 1.0
        return out


def least_squares_map(basis: np.ndarray) -> np.ndarray:
    """Matrix (p, N) from values at N points to the least-squares coefficients of basis (N, p)."""
    return np.linalg.pinv(basis) if basis.shape[1] else np.zeros((0, len(basis)))
