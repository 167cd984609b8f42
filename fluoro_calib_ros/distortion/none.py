# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The model `none`: it corrects nothing."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .base import CorrectionModel
from .estimation import RegressionStep, TrainingPoints
from .series import Series


class NoCorrection(CorrectionModel):
    """The model that corrects nothing: zero everywhere, and nothing is outside."""

    kind = 'none'
    description = 'no correction'
    corrects = False
    keeps_training_points = False

    def predict(self, uv: ArrayLike) -> np.ndarray:
        """Zeros (n, 2)."""
        return np.zeros_like(np.asarray(uv, dtype=float).reshape(-1, 2))

    def outside(self, uv: ArrayLike) -> np.ndarray:
        """False (n,): there is no calibrated area to leave."""
        return np.zeros(len(np.asarray(uv)), dtype=bool)

    @classmethod
    def regression(cls, points: TrainingPoints, k: int | None) -> NoRegression:
        """Only the inliers are looked for."""
        return NoRegression(points)


class NoRegression(RegressionStep[NoCorrection]):
    """The regression step of the model that corrects nothing."""

    iterates = False

    def choose(self, values: np.ndarray, q: np.ndarray, information: np.ndarray) -> None:
        """Update the inliers and sum up their weighted residuals."""
        self.inliers = self._updated_inliers(q)
        inside = values[self.inliers]
        self.score = float(np.einsum('na,nab,nb', inside, information[self.inliers], inside))

    def without_gauge(self, values: np.ndarray, interior: np.ndarray) -> np.ndarray:
        """Return the values."""
        return values

    def smooth(self, values: np.ndarray) -> np.ndarray:
        """Return zeros (N, 2)."""
        return np.zeros_like(values)

    def model(self, values: np.ndarray, series: Series | None = None) -> NoCorrection:
        """Return the model that corrects nothing."""
        return no_correction()


def no_correction() -> NoCorrection:
    """Return the model that corrects nothing."""
    return NoCorrection(0, np.zeros((0, 2)), np.zeros((0, 2)))
