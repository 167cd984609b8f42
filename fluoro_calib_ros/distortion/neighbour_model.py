# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Neighbour models that a self-calibration fits to the residuals."""

from __future__ import annotations

from .estimation import TrainingPoints
from .neighbour_regression import NeighbourRegression
from .smoother import NeighbourSmoother


class NeighbourModel(NeighbourSmoother):
    """A smoother over the k nearest training corrections, with its regression."""

    @classmethod
    def regression(cls, points: TrainingPoints, k: int | None) -> NeighbourRegression:
        """Fit to the residuals, k by cross-validation with whole exposures held out."""
        return NeighbourRegression(cls, points, k)
