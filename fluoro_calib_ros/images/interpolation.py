# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Interpolate the residuals of matched beads over an image.

Simple kriging with the nearest neighbours and Matern's covariance of order 3/2 (Stein,
"Interpolation of Spatial Data", 1999): what the polynomial of a view leaves is smooth, and centres
and survey add noise. The share of the noise, and the size of both, follow from how well matched
beads predict each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .view import TAIL

NEIGHBOURS = 8  # which screen a bead from those farther away
NOISE_SHARES = (0.001, 0.01, 0.1, 1.0)  # variance of the noise over that of the smooth part
SAMPLE = 100  # beads that tell the share
ROUNDS = 2  # of weights: the first one spoils those beside what is far off
FAR = 1e9  # of a bead from others where it has no pixel


@dataclass(frozen=True)
class Interpolation:
    """Residuals of all beads, as matched neighbours in the image have them."""

    value: NDArray[np.float64]  #: (n, 2) [px]
    sd_px: NDArray[np.float64]  #: (n,), of the difference of an observed coordinate from it


def interpolated(
    place: np.ndarray, bead: np.ndarray, residual: np.ndarray, length_px: float
) -> Interpolation:
    """Interpolate residuals (m, 2) of the matched rows bead (m,) of pixels place (n, 2).

    A bead does not take part in its own value, and one that is far off its value counts less for
    others. length_px: distance at which the covariance of the smooth part has fallen to a half.
    """
    kriging = _Kriging.of(np.where(np.isfinite(place), place, FAR) / length_px, bead)
    matched = kriging.chosen(bead)
    sample = np.arange(0, len(bead), max(1, len(bead) // SAMPLE))
    share = _noise_share(matched.chosen(sample), residual, sample)
    noise = np.full(len(bead), share)
    for _ in range(ROUNDS):
        value, variance = matched.at(residual, noise)
        squared = np.sum((residual - value) ** 2, axis=1) / variance
        noise = share * (1 + squared / (TAIL**2 * _scale(squared)))
    value, variance = kriging.at(residual, noise)
    squared = np.sum((residual - value[bead]) ** 2, axis=1) / variance[bead]
    return Interpolation(value, np.sqrt(_scale(squared) * variance))


def _noise_share(kriging: _Kriging, residual: np.ndarray, sample: np.ndarray) -> float:
    """Share of the noise with which a sample of matched beads is predicted best."""

    def lack(share: float) -> float:
        value, _ = kriging.at(residual, np.full(len(residual), share))
        return float(np.median(np.sum((residual[sample] - value) ** 2, axis=1)))

    return min(NOISE_SHARES, key=lack)


def _scale(squared: np.ndarray) -> float:
    """Variance factor of squared lengths (m,) of residuals with two normal coordinates."""
    return max(float(np.median(squared)) / (2 * np.log(2)), np.finfo(float).tiny)


@dataclass(frozen=True)
class _Kriging:
    """Places, and their nearest matched ones other than themselves."""

    near: NDArray[np.int64]  #: (n, k), rows of the matched ones
    covariance: NDArray[np.float64]  #: (n, k, k), of the smooth part at the neighbours
    known: NDArray[np.float64]  #: (n, k), covariance of a place with its neighbours, 0 for its own

    @classmethod
    def of(cls, place: np.ndarray, bead: np.ndarray) -> _Kriging:
        """Return that of places (n, 2), in units of the length of the covariance."""
        count = min(NEIGHBOURS + 1, len(bead))
        _, near = cKDTree(place[bead]).query(place, k=list(range(1, count + 1)))
        other = bead[near] != np.arange(len(place))[:, None]
        neighbour = place[bead[near]]
        known = _matern(neighbour - place[:, None]) * other
        covariance = _matern(neighbour[:, :, None] - neighbour[:, None])
        # What a bead has itself is uncorrelated with all others.
        covariance *= other[:, :, None] & other[:, None] | np.eye(count, dtype=bool)
        return cls(near, covariance, known)

    def chosen(self, rows: np.ndarray) -> _Kriging:
        """Return that of some of the places."""
        return _Kriging(self.near[rows], self.covariance[rows], self.known[rows])

    def at(self, residual: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values (n, 2), and their variances (n,) in units of that of the smooth part.

        noise: (m,) variances of the residuals (m, 2). Variances contain the noise of one more.
        """
        covariance = self.covariance.copy()
        diagonal = np.arange(covariance.shape[1])
        covariance[:, diagonal, diagonal] += noise[self.near]
        weight = np.linalg.solve(covariance, self.known[..., None])[..., 0]
        value = np.einsum('kn,knc->kc', weight, residual[self.near])
        return value, 1 + noise.min() - np.sum(weight * self.known, axis=1)


def _matern(shift: np.ndarray) -> np.ndarray:
    """Matern's covariance of order 3/2 at shifts (..., 2) in units of its length."""
    distance = np.sqrt(3) * np.hypot(shift[..., 0], shift[..., 1])
    return (1 + distance) * np.exp(-distance)
