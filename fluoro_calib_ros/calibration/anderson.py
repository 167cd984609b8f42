# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Anderson acceleration of a fixed-point iteration.

Walker and Ni, "Anderson acceleration for fixed-point iterations", SIAM Journal on Numerical
Analysis 49, 2011.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

RELATIVE_RANK = 1e-6  # singular values of the differences below that part of the largest are zero


class Anderson:
    """Mixes the last iterates of x -> f(x) so that the residual f(x) - x becomes smallest.

    depth: number of earlier iterates used. The iterates are arrays of one shape.
    """

    def __init__(self, depth: int = 8) -> None:
        self._depth = depth
        self.restart()

    def restart(self) -> None:
        """Forget the earlier iterates: the map has changed."""
        self._x: list[np.ndarray] = []
        self._f: list[np.ndarray] = []

    def next(
        self, x: np.ndarray, f: np.ndarray, counted: np.ndarray | slice = slice(None)
    ) -> np.ndarray:
        """Return the next iterate from the present one x and its image f.

        counted: entries whose residual is minimised.
        """
        self._x = (self._x + [x])[-self._depth - 1 :]
        self._f = (self._f + [f])[-self._depth - 1 :]
        if len(self._x) == 1:
            return f
        residual = [(b - a)[counted].ravel() for a, b in zip(self._x, self._f)]
        d_residual = np.stack([b - a for a, b in pairwise(residual)], axis=1)
        # Columns are scaled and small singular values dropped: late differences are nearly
        # parallel.
        scale = np.maximum(np.linalg.norm(d_residual, axis=0), 1e-300)
        gamma, *_ = np.linalg.lstsq(d_residual / scale, residual[-1], rcond=RELATIVE_RANK)
        return f - sum(g * (b - a) for g, a, b in zip(gamma / scale, self._f, self._f[1:]))
