# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Background of a window beyond a polynomial: edges of plates, bone, letters.

It is a sum of cosines whose power decreases with the cube of their frequency, as that of
radiographs of tissue does, and of any edge averaged over its directions (Burgess, Jacobson and
Judy, "Human observer detection experiments with mammograms and power-law noise", Med. Phys. 28,
2001). There is one unknown, the strength, estimated by restricted maximum likelihood (Patterson
and Thompson, Biometrika 58, 1971). The cosines are eliminated from the normal equations, so a
standard deviation contains what the background leaves open.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

HIGHEST = 9  # half waves across a window
EXPONENT = 3.0
# Ratios of the variance of the background to that of the noise that are compared. Steps of a
# factor of 2 change a standard deviation by less than a quarter of what the ratio itself leaves
# open.
RATIOS = 2.0 ** np.arange(-4, 13)


class Cosines:
    """Cosines on the pixels of a window, and their variances.

    offset (m, 2): pixels, from the middle of the window [px].
    """

    def __init__(self, offset: np.ndarray, dtype: type[np.floating]) -> None:
        half = float(np.abs(offset).max()) + 0.5
        x, y = (offset.T + half) * (np.pi / (2 * half))
        number = np.array(
            [
                (i, j)
                for i, j in product(range(HIGHEST + 1), repeat=2)
                if 0 < i * i + j * j <= HIGHEST**2
            ]
        )
        self.waves = (
            np.cos(np.outer(number[:, 0], x)) * np.cos(np.outer(number[:, 1], y))
        ).astype(dtype)
        power = np.sum(number**2, axis=1) ** (-EXPONENT / 2)
        # Of one unit of strength a pixel has one unit of variance.
        self.variance = power / (power @ np.mean(self.waves**2, axis=1))

    def strengths(
        self, relative: np.ndarray, jacobian: np.ndarray, weight: np.ndarray, residual: np.ndarray
    ) -> NDArray[np.float64]:
        """Estimate the variances (g,) of the backgrounds of windows, 0 for none.

        Parameters
        ----------
        relative : (g, m) ndarray
            Light behind the beads, as a fraction of that without them.
        jacobian : (g, u, m) ndarray
            Derivatives of the light by the unknowns that are estimated with it.
        weight, residual : (g, m) ndarray
        """
        waves = (relative[:, None] * self.waves) * np.sqrt(self.variance)[:, None]
        both = np.concatenate([jacobian, waves, residual[:, None]], axis=1).astype(float)
        products = (both * weight[:, None]) @ np.swapaxes(both, 1, 2)
        unknowns = jacobian.shape[1]
        known = products[:, :unknowns, :unknowns]
        diagonal = np.arange(unknowns)
        known[:, diagonal, diagonal] *= 1 + 1e-9
        known[:, diagonal, diagonal] += 1e-12
        cross = products[:, :unknowns, unknowns:]
        left = products[:, unknowns:, unknowns:] - np.swapaxes(cross, 1, 2) @ np.linalg.solve(
            known, cross
        )
        values, vectors = np.linalg.eigh(left[:, :-1, :-1])
        seen = (np.swapaxes(vectors, 1, 2) @ left[:, :-1, -1:])[..., 0] ** 2
        noise = 1 / np.maximum(np.mean(weight, axis=1), 1e-12)
        strength = RATIOS * noise[:, None]
        factor = 1 + strength[..., None] * np.maximum(values, 0)[:, None]
        gain = np.sum(strength[..., None] * seen[:, None] / factor - np.log(factor), axis=2)
        best = np.argmax(gain, axis=1)
        rows = np.arange(len(best))
        return np.where(gain[rows, best] > 0, strength[rows, best], 0.0)

    def eliminated(
        self,
        strength: NDArray[np.float64],
        relative: np.ndarray,
        jacobian: np.ndarray,
        weight: np.ndarray,
        residual: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what the backgrounds take from normal equations, right sides and squared sums.

        strength (g,) is positive; the other arguments are those of `strengths`.
        """
        waves = relative[:, None] * self.waves
        weighted = waves * weight.astype(waves.dtype)[:, None]
        inner = (weighted @ np.swapaxes(waves, 1, 2)).astype(float)
        diagonal = np.arange(len(self.variance))
        inner[:, diagonal, diagonal] += 1 / (strength[:, None] * self.variance)
        both = np.concatenate([jacobian, residual[:, None].astype(jacobian.dtype)], axis=1)
        cross = (weighted @ np.swapaxes(both, 1, 2)).astype(float)
        taken = np.swapaxes(cross, 1, 2) @ np.linalg.solve(inner, cross)
        return taken[:, :-1, :-1], taken[:, :-1, -1], taken[:, -1, -1]
