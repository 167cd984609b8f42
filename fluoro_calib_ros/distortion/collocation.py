"""The model `collocation`: trend and signal estimated in the adjustment.

Least-squares collocation (Moritz, "Advanced Physical Geodesy", 1980): the distortion is a cubic
trend plus a random field, both among the unknowns of the adjustment, with priors that are
estimated from the observations (see `priors`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..photogrammetry.additional_parameters import AdditionalParameters
from ..photogrammetry.precision import information_of_additional
from .estimation import AdjustedTerms, AdjustmentProblem, coefficients_of, prior_of_additional
from .priors import Prior, gauge_precision, most_likely_prior, prior_precision, starting_prior
from .series import Functions, Series, sd_over_image
from .series_model import SeriesModel

if TYPE_CHECKING:
    from ..photogrammetry.adjustment import Adjustment
    from ..photogrammetry.elimination import FactorizedNormalMatrix
    from ..photogrammetry.network import Network

TREND_DEGREE = 3  # pincushion, S-shape and spiral are cubic to first order (Gronenschild 1997)
START_MODES = 18  # half waves along the image, until the signal is known
MIN_MODES = 10
MAX_MODES = 30  # the time grows with the sixth power
# Prior variance times information of a sine below which the image points say nothing about it.
NEGLIGIBLE = 0.1
FEWER_MODES = 0.75  # part of the present modes from which fewer are worth a change
MODE_CHANGES = 3  # at most
SETTLED_PRIOR = (
    0.3  # mean change of the logarithms of the variances that changes no correction visibly
)
MIN_START_SD_PX = 0.1


class CollocationModel(SeriesModel):
    """Cubic polynomials and a random field of sines, estimated in the adjustment."""

    kind = 'collocation'
    description = 'cubic trend and random field in the adjustment'

    @classmethod
    def adjusted_terms(cls, problem: AdjustmentProblem) -> AdjustedTerms:
        """Trend and signal."""
        return CollocationTerms(problem)


class CollocationTerms(AdjustedTerms):
    """Trend and signal of all fluoroscopes of a network, and their priors.

    modes: number of sines along the image to start with; 0: there is no signal.
    """

    intermediate_tolerance = 1.0  # noise and prior still change

    def __init__(self, problem: AdjustmentProblem, modes: int = START_MODES) -> None:
        before = problem.before
        self.network = problem.network
        self.gauge_kinds = problem.gauges
        self.sizes = problem.image_sizes
        self.interior = before.parameters.interior
        self.functions: list[Functions] = []
        self.priors: list[Prior] = []
        self.gauges: list[np.ndarray] = []
        self.values: list[np.ndarray] = []
        self._mode_changes = 0
        for f, size in enumerate(self.sizes):
            rows = self.network.rows(f)
            core = before.residuals[rows][before.inliers[rows]]
            self._set_functions(f, Functions(size, TREND_DEGREE, modes))
            sd = max(float(np.sqrt(np.mean(core**2))), MIN_START_SD_PX)
            self.priors.append(starting_prior(self.functions[f], sd))

    def _set_functions(self, f: int, functions: Functions) -> None:
        """Use these functions for fluoroscope f."""
        self.functions[f : f + 1] = [functions]
        self.values[f : f + 1] = [functions(self.network.uv[self.network.rows(f)])]
        self.gauges[f : f + 1] = [self._gauge(f)]

    def _gauge(self, f: int) -> np.ndarray:
        uv = self.network.uv[self.network.rows(f)]
        return gauge_precision(self.values[f], uv, self.interior[f], self.gauge_kinds[f])

    def with_additional(self, network: Network) -> Network:
        """Return the network with the terms under their present priors."""
        additional = tuple(
            AdditionalParameters(values, prior_precision(functions, prior) + gauge)
            for values, functions, prior, gauge in zip(
                self.values, self.functions, self.priors, self.gauges
            )
        )
        return replace(network, additional=additional)

    def zeros(self) -> tuple[np.ndarray, ...]:
        """Coefficients of no correction, by fluoroscope."""
        return tuple(np.zeros(2 * len(functions)) for functions in self.functions)

    def series(self, f: int, coefficients: np.ndarray, covariance: np.ndarray) -> Series:
        """Return the series of fluoroscope f.

        coefficients (2m,), those of u first, and their covariance (2m, 2m).
        """
        functions = self.functions[f]
        sd = np.hypot(sd_over_image(functions, covariance), self._sd_beyond(f))
        return Series(functions, coefficients.reshape(2, -1), sd)

    def _sd_beyond(self, f: int) -> float:
        """Standard deviation [px] of the part of the signal that the series leaves out."""
        functions = self.functions[f]
        return self.priors[f].signal.sd_beyond(functions.highest) if functions.modes else 0.0

    def renew(
        self, network: Network, matrix: FactorizedNormalMatrix, adjustment: Adjustment
    ) -> tuple[bool, tuple[np.ndarray, ...]]:
        """Renew priors, gauges and the numbers of modes at a solution.

        Returns whether the priors have settled, and the coefficients with which to continue.
        """
        settled = True
        coefficients = coefficients_of(adjustment)
        self.interior = adjustment.parameters.interior
        modes = []
        for f, functions in enumerate(self.functions):
            last = self.priors[f]
            present = prior_of_additional(network, f)
            information = information_of_additional(matrix, f) - present
            right = (information + present) @ coefficients[f]
            now = most_likely_prior(functions, information, right, self.gauges[f], last)
            self.priors[f] = now
            self.gauges[f] = self._gauge(f)
            if functions.modes:
                change = now.signal.change(last.signal, functions.frequency)
                settled &= change < SETTLED_PRIOR
            modes.append(self._modes(f, information))
        present_modes = [functions.modes for functions in self.functions]
        if modes == present_modes or self._mode_changes == MODE_CHANGES:
            return settled, coefficients
        self._mode_changes += 1
        return False, self._with_modes(modes, coefficients)

    def _modes(self, f: int, information: np.ndarray) -> int:
        """Number of modes with which the image points of fluoroscope f can tell the signal.

        information (2m, 2m) of its coefficients without prior.
        """
        functions = self.functions[f]
        if not functions.modes:
            return 0
        m = len(functions)
        level = float(np.mean(np.diagonal(information)[len(functions.powers) : m]))
        numbers = np.arange(MIN_MODES, MAX_MODES + 1)
        variance = self.priors[f].signal.variance(numbers * functions.frequency_of_mode)
        enough = numbers[variance * level < NEGLIGIBLE]
        wanted = int(enough[0]) if len(enough) else MAX_MODES
        kept = FEWER_MODES * functions.modes <= wanted <= functions.modes
        return functions.modes if kept and self._mode_changes else wanted

    def _with_modes(
        self, modes: list[int], coefficients: tuple[np.ndarray, ...]
    ) -> tuple[np.ndarray, ...]:
        """Use these numbers of modes; return the coefficients for them."""
        out = []
        for f, functions in enumerate(self.functions):
            self._set_functions(f, Functions(self.sizes[f], TREND_DEGREE, modes[f]))
            out.append(self.functions[f].converted(functions, coefficients[f]))
        return tuple(out)
