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

"""The model `hybrid`: a cubic trend in the adjustment, local planes on what it leaves."""

from __future__ import annotations

from .collocation import CollocationTerms
from .estimation import AdjustedTerms, AdjustmentProblem
from .local_linear import LocalLinearModel


class HybridModel(LocalLinearModel):
    """Series of polynomials from the adjustment plus local planes."""

    kind = 'hybrid'
    description = 'cubic trend in the adjustment, and planes fitted to the k nearest residuals'
    has_series = True
    trend_degree = None
    gauge_passes = 3

    @classmethod
    def adjusted_terms(cls, problem: AdjustmentProblem) -> AdjustedTerms:
        """The cubic trend."""
        return CollocationTerms(problem, modes=0)
