"""The model `none`: it corrects nothing."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .base import CorrectionModel
from .estimation import NoRegression, RegressionStep, TrainingPoints


class NoCorrection(CorrectionModel):
    """The model that corrects nothing: zero everywhere, and nothing is outside."""

    kind = 'none'
    description = 'no correction'
    keeps_training_points = False

    def predict(self, uv: ArrayLike) -> np.ndarray:
        """Zeros (n, 2)."""
        return np.zeros_like(np.asarray(uv, dtype=float).reshape(-1, 2))

    def outside(self, uv: ArrayLike) -> np.ndarray:
        """False (n,): there is no calibrated area to leave."""
        return np.zeros(len(np.asarray(uv)), dtype=bool)

    @classmethod
    def regression(cls, points: TrainingPoints, k: int | None) -> RegressionStep:
        """Only the inliers are looked for."""
        return NoRegression(points)


def no_correction() -> NoCorrection:
    """Return the model that corrects nothing."""
    return NoCorrection(0, np.zeros((0, 2)), np.zeros((0, 2)))
