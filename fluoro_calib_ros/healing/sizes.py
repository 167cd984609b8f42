# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Estimate the size of a change from the information of the data.

The parts of a change (the shift and the rotation of a knock) have one size each, in units of the
usual size of such a change. A size has a half-Cauchy prior: flat for small sizes, so that the
smallest size tried does not matter, and with a heavy tail (Gelman, "Prior distributions for
variance parameters in hierarchical models", Bayesian Analysis 1, 2006). The evidence of a change
is the mean over its sizes. With the likeliest size alone, a change of few unknowns would be
preferred to one of many wherever the sizes tried are wrong.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ..correction.series import Functions
from ..photogrammetry.rig_orientation import ORIENTATION_SIZE, RigOrientation

# Units of the sizes of changes: of a knock [mm, rad], and of principal point [px] and principal
# distance [relative].
KNOCK_MM = 10.0
KNOCK_RAD = 0.02
SHIFT_PX = 10.0
FOCUS = 0.01
SIZES = np.geomspace(2.0**-7, 8.0, 11)
MANY = 3  # number of parts of a change from which on only every second size is tried


@dataclass(frozen=True)
class ChangeStatistics:
    """Information of the data on the unknowns of a change, all other unknowns being eliminated.

    Normal equations M (k, k), m (k,) about no change. With the covariance V of the change, its log
    evidence is 1/2 m'(M + V^-1)^-1 m - 1/2 log det(I + MV) (MacKay, "Information Theory,
    Inference, and Learning Algorithms", Cambridge 2003, ch. 28).
    """

    matrix: NDArray[np.float64]
    right: NDArray[np.float64]

    def only(self, rows: NDArray[np.int64]) -> ChangeStatistics:
        """Return the information on some of the unknowns (k,), with no change of the others."""
        return ChangeStatistics(self.matrix[np.ix_(rows, rows)], self.right[rows])

    def with_noise(self, factor: float) -> ChangeStatistics:
        """Return the information if the data scatter more than claimed, by a factor."""
        return ChangeStatistics(self.matrix / factor**2, self.right / factor**2)

    def evidence(self, sd: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the log evidence (...,) of standard deviations (..., k)."""
        whitened, gradient = self._whitened(sd)
        solved = np.linalg.solve(whitened, gradient[..., None])[..., 0]
        log_z = np.sum(gradient * solved, axis=-1) - np.linalg.slogdet(whitened)[1]
        return np.asarray(0.5 * log_z)

    def moments(self, sd: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return second moments (..., k, k) of the unknowns, with standard deviations (..., k)."""
        whitened, gradient = self._whitened(sd)
        covariance = np.linalg.inv(whitened)
        mean = covariance @ gradient[..., None]
        moments = covariance + mean @ np.swapaxes(mean, -1, -2)
        return np.asarray(sd[..., :, None] * moments * sd[..., None, :])

    def mean_moments(
        self, parts: NDArray[np.float64], least: NDArray[np.float64] | float = 0.0
    ) -> NDArray[np.float64]:
        """Return the mean (k, k) of second moments over the sizes of a change; see `sizes`."""
        sizes = self.sizes(parts, least)
        return np.asarray(np.tensordot(sizes.share, self.moments(sizes.sd), axes=1))

    def _whitened(
        self, sd: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return normal equations of unknowns in units of their standard deviations (..., k)."""
        matrix = np.eye(len(self.right)) + sd[..., :, None] * self.matrix * sd[..., None, :]
        return matrix, sd * self.right

    def sizes(self, parts: NDArray[np.float64], least: NDArray[np.float64] | float = 0.0) -> Sizes:
        """Return the sizes of a change with their probabilities.

        parts (p, k): standard deviations of the unknowns for each part of the usual size. least
        (k,): standard deviations without the change.
        """
        step_sizes = SIZES if len(parts) < MANY else SIZES[::2]
        size = np.array(list(product(step_sizes, repeat=len(parts))))
        prior = np.log(size / (1 + size**2)).sum(axis=1)
        sd = np.sqrt(size**2 @ parts**2 + np.square(least))
        log = self.evidence(sd) + prior
        share = np.exp(log - log.max())
        evidence = log.max() + np.log(share.sum()) - np.log(np.exp(prior).sum())
        return Sizes(float(evidence), sd, share / share.sum())


@dataclass(frozen=True)
class Sizes:
    """Sizes of a change with their probabilities."""

    evidence: float  #: log evidence of the change with any size, against no change
    sd: NDArray[np.float64]  #: (S, k) standard deviations of the unknowns
    share: NDArray[np.float64]  #: (S,) probabilities

    @property
    def rms(self) -> NDArray[np.float64]:
        """Standard deviations (k,) of the unknowns: root mean squares over the sizes."""
        return np.sqrt(self.share @ self.sd**2)


def parts_of_knock(orientation: RigOrientation, fluoroscope: int) -> NDArray[np.float64]:
    """Return standard deviations (2, 9F) of the orientation for shift and rotation of a knock."""
    out = np.zeros((2, len(orientation.fluoroscopes), ORIENTATION_SIZE))
    out[0, fluoroscope, :3] = KNOCK_MM
    out[1, fluoroscope, 3:6] = KNOCK_RAD
    return out.reshape(2, -1)


def parts_of_interior(orientation: RigOrientation, fluoroscope: int) -> NDArray[np.float64]:
    """Return standard deviations (2, 9F) for changes of principal point and distance."""
    out = np.zeros((2, len(orientation.fluoroscopes), ORIENTATION_SIZE))
    out[0, fluoroscope, 6:8] = SHIFT_PX
    out[1, fluoroscope, 8] = FOCUS * orientation.interior[fluoroscope, 2]
    return out.reshape(2, -1)


def parts_of_drift(functions: Functions) -> NDArray[np.bool_]:
    """Return which coefficients (3, 2n) are of degrees up to 1, of higher degrees, of waves."""
    waves = np.arange(len(functions)) >= functions.trend
    affine = np.zeros(len(functions), dtype=bool)
    affine[: len(functions.powers)] = [i + j <= 1 for i, j in functions.powers]
    return np.tile(np.stack([affine, ~(affine | waves), waves]), 2)
