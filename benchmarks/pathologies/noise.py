# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Measurement noise, false matches and blind regions of an image."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree


@dataclass(frozen=True)
class Gaussian:
    """Independent Gaussian noise [px]."""

    sd: float = 0.25

    def __call__(self, rng, observed, side):
        return observed + rng.normal(0, self.sd, observed.shape)

    def sds(self, observed):
        """Return standard deviations (n,) of the image points of an exposure [px]."""
        return np.full(len(observed), self.sd)


@dataclass(frozen=True)
class Overlapping:
    """Gaussian noise of beads in images: larger near another bead, with known sd."""

    sd: float = 0.02
    factor: float = 5.0
    near_px: float = 12.0

    def __call__(self, rng, observed, side):
        return observed + rng.normal(0, 1, observed.shape) * self.sds(observed)[:, None]

    def sds(self, observed):
        """Return standard deviations (n,) of the image points of an exposure [px]."""
        distance = cKDTree(observed).query(observed, k=2)[0][:, 1]
        return np.where(distance < self.near_px, self.factor, 1.0) * self.sd


@dataclass(frozen=True)
class StudentT:
    """Noise with Student's t distribution and a given scale [px]."""

    sd: float = 0.2
    nu: float = 3.0

    def __call__(self, rng, observed, side):
        chi = rng.chisquare(self.nu, (len(observed), 1)) / self.nu
        return observed + self.sd * rng.normal(0, 1, observed.shape) / np.sqrt(chi)


@dataclass(frozen=True)
class WholePixels:
    """Gaussian noise, after which coordinates are rounded to whole pixels."""

    gaussian: float = 0.1

    @property
    def sd(self):
        """Standard deviation of noise and rounding [px]."""
        return float(np.sqrt(self.gaussian**2 + 1 / 12))

    def __call__(self, rng, observed, side):
        return np.round(observed + rng.normal(0, self.gaussian, observed.shape))


@dataclass(frozen=True)
class Heteroscedastic:
    """Gaussian noise that grows by a factor from the middle of the image to its rim."""

    sd: float = 0.15
    factor: float = 3.0

    def __call__(self, rng, observed, side):
        r = np.linalg.norm(observed - side / 2, axis=1) / (side / 2)
        sd = self.sd * (1 + (self.factor - 1) * np.minimum(r, 1.4))
        return observed + rng.normal(0, 1, observed.shape) * sd[:, None]


@dataclass(frozen=True)
class ByExposure:
    """Gaussian noise whose standard deviation differs between exposures, within a range [px]."""

    low: float = 0.1
    high: float = 0.6

    @property
    def sd(self):
        """Middle of the range [px]."""
        return float(np.sqrt(self.low * self.high))

    def __call__(self, rng, observed, side):
        sd = np.exp(rng.uniform(np.log(self.low), np.log(self.high)))
        return observed + rng.normal(0, sd, observed.shape)


@dataclass(frozen=True)
class FalseMatches:
    """A fraction of false matches: 'near' ones, 'swapped' ids, or 'anywhere' in the image."""

    share: float = 0.01
    kind: str = 'near'

    def __call__(self, rng, observed, side):
        """Return observed image points (n, 2) with false matches, and a mask (n,) of these."""
        n = len(observed)
        wrong = rng.permutation(n)[: rng.binomial(n, self.share)]
        out = observed.copy()
        if self.kind == 'swapped':
            wrong = wrong[: len(wrong) // 2 * 2]
            out[wrong] = observed[np.roll(wrong, 1)]
        elif self.kind == 'anywhere':
            out[wrong] = rng.uniform(1, side - 2, (len(wrong), 2))
        else:
            for row in wrong:
                order = np.argsort(np.sum((observed - observed[row]) ** 2, axis=1))
                out[row] = observed[order[rng.integers(1, min(6, n))]]
        moved = np.zeros(n, dtype=bool)
        moved[wrong] = True
        return out, moved
