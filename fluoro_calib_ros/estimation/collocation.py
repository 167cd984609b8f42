# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The model `collocation`: the adjustment estimates trend and signal of the distortion.

Least-squares collocation (Moritz, "Advanced Physical Geodesy", 1980): the distortion is a cubic
trend plus a random field. Both are unknowns of the adjustment, with priors that are estimated from
the observations (see `priors`). Radial terms of degree 5 and 7 and a spiral of degree 5 join the
trend where the observations make them likely: outside the image points a field returns to zero,
whereas a trend continues.

After each adjustment:

1. Update the variances of the terms of exposures, where there are such terms.
2. Update the prior of each fluoroscope by one step towards the largest marginal likelihood. Where
   the signal has places of larger variance, search for more of them.
3. Set the number of sines to the number that the image points determine with this prior.
4. Once the priors are steady, search the residuals, one after the other, for what the terms cannot
   follow yet: ripples; rejected image points that agree; exposures that differ; places where the
   signal has a larger variance.

A change in step 3 or 4 leads to another adjustment. After two updates that change nothing, the
priors stay fixed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..correction.series import Series
from ..photogrammetry.precision import solved_additional
from .estimator import AdjustedTerms, AdjustmentProblem, coefficients_of
from .exposure_terms import estimates_beside_free_points
from .fluoroscope_terms import FluoroscopeTerms
from .priors import Prior
from .refinements import (
    START_MODES,
    AgreeingOutliers,
    Change,
    Changes,
    NumberOfSines,
    Once,
    Refinement,
    Solution,
    exposure_terms,
    places,
    ripples,
)

if TYPE_CHECKING:
    from ..photogrammetry.adjustment import Adjustment
    from ..photogrammetry.elimination import FactorizedNormalMatrix
    from ..photogrammetry.network import Network

SETTLED_VARIATION = 0.05  # relative change of the RMS variation between exposures
# Number of updates without visible change after which the priors stay fixed. Otherwise noise and
# signal oscillate for long where the correlation length is no longer than the point distance.
STAY_AFTER = 2
# Decrease of F that an adjustment of continued terms may leave: a thirtieth of a sigma.
CONTINUED_TOLERANCE = 1e-3


@dataclass(frozen=True)
class EarlierTerms:
    """Terms of an earlier calibration with more exposures."""

    series: Sequence[Series]  #: by fluoroscope
    priors: Sequence[Prior | None]  #: by fluoroscope; None: estimate the prior from the series
    is_varying: bool  #: whether the distortion differs between exposures


class CollocationTerms(AdjustedTerms):
    """Trend and signal of all fluoroscopes of a network, with their priors.

    modes: initial number of sines along the image; 0: no signal, and a trend without rings (see
    `series.Functions`). earlier: terms to start with instead.
    """

    intermediate_tolerance = 1.0  # loose, because noise and prior still change
    # A third of the standard deviation of the noise of 1000 image points; less remains to change.
    noise_tolerance = 5e-3

    def __init__(
        self,
        problem: AdjustmentProblem,
        modes: int = START_MODES,
        earlier: EarlierTerms | None = None,
    ) -> None:
        self.network = problem.network
        self.parts: list[FluoroscopeTerms] = []
        self._steady_renewals = 0
        if earlier is not None:
            self._continue(problem, earlier)
            return
        for f in range(len(problem.image_sizes)):
            self.parts.append(FluoroscopeTerms.first(problem, f, modes))
        self._start = super().start()
        self._refinements: list[Refinement] = [
            NumberOfSines(),
            Once(ripples),  # before exposure_terms: ripples may be mistaken for such a change
            AgreeingOutliers(),  # likewise, for dents whose image points are rejected
            Once(exposure_terms),
            Once(places),
        ]

    def _continue(self, problem: AdjustmentProblem, earlier: EarlierTerms) -> None:
        """Start with earlier series, and with the most likely priors for them."""
        self.final_tolerance = CONTINUED_TOLERANCE
        start = []
        for f, (series, prior) in enumerate(zip(earlier.series, earlier.priors)):
            part, coefficients = FluoroscopeTerms.continued(problem, f, series, prior)
            self.parts.append(part)
            start.append(coefficients)
        self._start = tuple(start)
        # The ripples of the earlier series stay, and its number of sines is not an initial guess.
        self._refinements = [NumberOfSines(changes=1), AgreeingOutliers()]
        if earlier.is_varying:
            self._refinements.append(Once(exposure_terms))
        if any(prior is None for prior in earlier.priors):
            self._refinements.append(Once(places))

    @property
    def priors(self) -> list[Prior]:
        """Present priors, by fluoroscope."""
        return [part.prior for part in self.parts]

    def start(self) -> tuple[NDArray[np.float64], ...]:
        """Return the initial coefficients, by fluoroscope."""
        return self._start

    def renew(
        self, network: Network, matrix: FactorizedNormalMatrix, adjustment: Adjustment
    ) -> tuple[bool, tuple[NDArray[np.float64], ...]]:
        """Update priors, gauges and functions at a solution.

        Returns whether the priors have settled, and the coefficients to continue with.
        """
        coefficients = coefficients_of(adjustment)
        if self._steady_renewals == STAY_AFTER:
            return True, coefficients
        solution = self._renewed(network, matrix, adjustment)
        for refinement in self._refinements:
            changes = refinement.propose(solution)
            if changes:
                self._steady_renewals = 0
                return False, self._changed(changes, adjustment)
        self._steady_renewals = self._steady_renewals + 1 if solution.is_steady else 0
        return solution.is_steady, tuple(
            part.likely_coefficients(current, adjustment)
            for part, current in zip(self.parts, coefficients)
        )

    def _renewed(
        self, network: Network, matrix: FactorizedNormalMatrix, adjustment: Adjustment
    ) -> Solution:
        """Update gauges, exposure terms and priors; return the solution with its equations."""
        for part, interior in zip(self.parts, adjustment.parameters.interior):
            part.use_interior(interior)
        solved = solved_additional(matrix, network, adjustment)
        self._renew_exposure_terms(network, adjustment)
        equations = [
            part.equations(network, matrix, solution) for part, solution in zip(self.parts, solved)
        ]
        steady = [
            part.renew_prior(part_equations) for part, part_equations in zip(self.parts, equations)
        ]
        return Solution(self.parts, adjustment, equations, all(steady))

    def _renew_exposure_terms(self, network: Network, adjustment: Adjustment) -> None:
        """Update the variances of the terms of exposures."""
        if all(part.own is None for part in self.parts):
            return
        estimates = estimates_beside_free_points(network, adjustment)
        for part, (mean, variance) in zip(self.parts, estimates):
            terms = part.own
            if terms is not None:
                first = part.of_series.stop
                before = terms.size_px
                terms.renew(mean[first:], variance[first:])
                if abs(terms.size_px - before) > SETTLED_VARIATION * before:
                    self._steady_renewals = 0

    def _changed(
        self, changes: Changes, adjustment: Adjustment
    ) -> tuple[NDArray[np.float64], ...]:
        """Change the terms; return the coefficients to continue with."""
        out = []
        for part, current in zip(self.parts, coefficients_of(adjustment)):
            change = changes.get(part.number, Change(part.functions.complete))
            part.prior = change.prior or part.prior
            new = part.use_modes(change.modes, current)
            if change.coefficients is None:
                new = part.likely_coefficients(new, adjustment)
            else:
                new[part.of_series] = change.coefficients
            part.own = change.own or part.own
            out.append(np.pad(new, (0, part.count - len(new))))
        return tuple(out)
