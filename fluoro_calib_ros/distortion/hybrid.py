# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

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
