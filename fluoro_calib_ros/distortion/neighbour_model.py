# Copyright 2026 fluoro_calib_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

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
