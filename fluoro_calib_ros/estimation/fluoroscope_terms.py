# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0
"""The terms of one fluoroscope in a collocation: functions, prior, gauge, terms of exposures."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from ..correction.series import Functions, Series, sd_over_image, without_absent_bands
from ..correction.terms import CUBIC
from ..photogrammetry.adjustment import SAME_WEIGHTS_DECREASE
from ..photogrammetry.collinearity import AdditionalParameters
from ..photogrammetry.precision import information_of_additional
from .estimator import (
    AdjustmentProblem,
    TermsOfFluoroscope,
    coefficients_of,
    estimated_terms,
    prior_of_additional,
)
from .exposure_terms import (
    AngleFit,
    ExposureTerms,
    SeriesWithExposures,
    can_be_fitted,
    fit_angles,
    variance_between_exposures,
    without_exposure_terms,
)
from .lack_of_fit import FittedPoints, LeftOut
from .local_signal import correlation_beyond
from .priors import (
    Prior,
    SeriesEquations,
    covariance_by_signal,
    covariance_of_series,
    gauge_conditions,
    has_rings,
    most_likely_prior,
    prior_precision,
    starting_prior,
    with_more_places,
)
from .ripples import ripples_of

if TYPE_CHECKING:
    from ..correction.angle_field import AngleField
    from ..photogrammetry.adjustment import Adjustment
    from ..photogrammetry.elimination import FactorizedNormalMatrix
    from ..photogrammetry.network import Network
    from ..photogrammetry.precision import Precision

RINGS = 2  # radial polynomials of degree 5 and 7, which a curved screen adds at the border
# Least initial standard deviation [px]: residuals of a detector without distortion are only noise.
MIN_START_SD_PX = 0.1
MAX_PLACE_SEARCHES = 4  # most searches for further places
# Mean change of the log variances of the signal below which no correction changes visibly.
SETTLED_PRIOR = 0.3


class FluoroscopeTerms(TermsOfFluoroscope):
    """Trend and signal of one fluoroscope, and the terms of its exposures."""

    prior: Prior

    def __init__(self, problem: AdjustmentProblem, number: int, functions: Functions) -> None:
        super().__init__(problem, number)
        network = problem.network
        self.sigma = network.sigma[self.rows]
        self.exposure = network.exposure[self.rows]
        self.point = network.point[self.rows]
        #: (e,) angles of the C-arm [rad]; empty if unknown
        self.angles = np.zeros(0) if problem.angles is None else problem.angles[number]
        #: (3,) xp, yp, c [px] at the last solution
        self.interior = problem.before.parameters.interior[number]
        self._offset = np.zeros(3)  # last estimate of the interior orientation less self.interior
        self._relaxation = 1.0
        #: terms of the exposures; None: the distortion does not vary
        self.own: ExposureTerms | None = None
        self._angle_fit: AngleFit | None = None
        self.place_searches = MAX_PLACE_SEARCHES  #: searches for further places that are left
        self._use(functions)

    @classmethod
    def first(cls, problem: AdjustmentProblem, number: int, modes: int) -> FluoroscopeTerms:
        """Return initial terms; modes: number of sines, 0: trend without rings or signal."""
        functions = Functions(
            problem.image_sizes[number], CUBIC, modes, rings=RINGS if modes else 0
        )
        out = cls(problem, number, functions)
        inliers = problem.before.residuals[out.rows][problem.before.inliers[out.rows]]
        sd = max(float(np.sqrt(np.mean(inliers**2))), MIN_START_SD_PX)
        out.prior = starting_prior(functions, sd)
        return out

    @classmethod
    def continued(
        cls, problem: AdjustmentProblem, number: int, series: Series, prior: Prior | None
    ) -> tuple[FluoroscopeTerms, NDArray[np.float64]]:
        """Return terms with the functions of an earlier series, and its coefficients (2m,).

        prior: None to estimate it from the series.
        """
        functions = series.functions
        rings = RINGS if functions.modes else 0
        functions, matrix = functions.as_rings(series.coefficients, CUBIC, rings)
        functions, matrix = without_absent_bands(functions, matrix)
        out = cls(problem, number, functions)
        if prior is not None:  # already refined where it was estimated
            out.prior = prior
            out.place_searches = 0
        else:
            out.prior = out._prior_of(matrix, problem.before.noise.scale)
        return out, matrix.ravel()

    def _prior_of(self, matrix: NDArray[np.float64], scale: float) -> Prior:
        """Return the most likely prior for coefficients (2, m); scale: scale of the noise.

        Orientations are assumed to be known, which is accurate enough for an initial value.
        """
        weighted = self.weighted(self.values, scale)
        information = block_diag(*[weighted.T @ weighted] * 2)
        sd = max(float(np.std(self.values @ matrix.T)), MIN_START_SD_PX)
        start = starting_prior(self.functions, sd)
        ripples = ripples_of(self.functions, matrix)
        start = replace(start, signal=replace(start.signal, ripples=ripples))
        right = information @ matrix.ravel()
        return most_likely_prior(
            SeriesEquations(self.functions, information, right, self.gauge), start
        )

    def weighted(self, values: NDArray[np.float64], scale: float) -> NDArray[np.float64]:
        """Divide values (n, k) at image points by the standard deviation of their noise."""
        return values / (scale * self.sigma)[:, None]

    def _use(self, functions: Functions) -> None:
        """Use these functions."""
        self.functions = functions
        self.values = functions(self.uv)  #: (n, m) functions at the image points
        self._gauge_rows = self._gauge_conditions(self.values)
        self._last_equations: SeriesEquations | None = None  # with these functions

    @property
    def gauge(self) -> NDArray[np.float64]:
        """Precision matrix (2m, 2m) of the gauge."""
        return self._gauge_rows.T @ self._gauge_rows

    def gauge_of(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the precision matrix (2m, 2m) of the gauge for values (n, m) of functions."""
        rows = self._gauge_conditions(values)
        return rows.T @ rows

    def _gauge_conditions(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the rows (g, 2m) that fix the gauge for values (n, m) of functions."""
        return gauge_conditions(values, self.uv, self.interior, self.gauge_kind)

    def use_interior(self, estimated: NDArray[np.float64]) -> None:
        """Update the gauge to an estimated interior orientation (3,).

        The estimate depends on the gauge. Where the image points hardly determine the principal
        point, a step of the gauge may move the estimate back and farther. Such steps are relaxed
        (Aitken; Irons and Tuck, "A version of the Aitken accelerator for computer iteration", Int.
        J. Num. Meth. Eng. 1, 1969).
        """
        offset = estimated - self.interior
        change = offset - self._offset
        if self._offset @ offset < 0 and self._offset @ (self._offset + 2 * offset) < 0:
            self._relaxation *= -(self._offset @ change) / (change @ change)
        self.interior = estimated - (1 - self._relaxation) * offset
        self._offset = offset

    def renew_prior(self, equations: SeriesEquations) -> bool:
        """Use a more likely prior, and the gauge about the present interior orientation.

        Where the signal has places of larger variance, search for more of them. Returns whether
        the prior hardly changes.
        """
        last = self.prior
        self.prior = most_likely_prior(equations, last)
        if self.place_searches and self.prior.local is not None:
            self.place_searches -= 1
            self.prior = with_more_places(equations, self.prior)
        self._gauge_rows = self._gauge_conditions(self.values)
        return not self.functions.modes or self.prior.change(last, self.functions) < SETTLED_PRIOR

    @property
    def count(self) -> int:
        """Number of coefficients, including those of the exposures."""
        return 2 * len(self.functions) + (0 if self.own is None else self.own.count)

    @property
    def of_series(self) -> slice:
        """Coefficients of the series; those of the exposures follow."""
        return slice(2 * len(self.functions))

    def additional(self) -> AdditionalParameters:
        """Return the additional parameters: the series, then the terms of the exposures."""
        prior = prior_precision(self.functions, self.prior)
        rows = self._gauge_rows
        if self.own is None:
            return AdditionalParameters(self.values, prior, conditions=rows)
        prior = block_diag(prior, np.diag(self.own.precision))
        rows = np.pad(rows, ((0, 0), (0, self.own.count)))
        return AdditionalParameters(self.values, prior, self.own.functions, rows)

    def correction(self, coefficients: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the corrections (n, 2) [px] of the image points by the series."""
        return self.values @ coefficients[self.of_series].reshape(2, -1).T

    def inliers(self, adjustment: Adjustment) -> FittedPoints:
        """Return the inliers of an adjustment."""
        inliers = adjustment.inliers[self.rows]
        return FittedPoints(
            self.uv[inliers], adjustment.residuals[self.rows][inliers], self.exposure[inliers]
        )

    def functions_with(self, modes: int, prior: Prior) -> Functions:
        """Return functions with all sines up to a number of modes, and with ripples of a prior."""
        ripples = prior.signal.ripples
        bands = ripples.bands if ripples is not None else ()
        highest = max((modes, *bands))
        absent = tuple(b for b in range(modes + 1, highest) if b not in bands)
        return Functions(self.image_size, CUBIC, highest, self.functions.rings, absent)

    def use_modes(self, modes: int, coefficients: NDArray[np.float64]) -> NDArray[np.float64]:
        """Use all sines up to a number of modes, and those of the ripples of the prior.

        Returns the coefficients of the new functions.
        """
        end = self.of_series.stop
        before = self.functions
        self._use(self.functions_with(modes, self.prior))
        series = self.functions.converted(before, coefficients[:end])
        return np.concatenate([series, coefficients[end:]])

    def likely_coefficients(
        self, coefficients: NDArray[np.float64], adjustment: Adjustment
    ) -> NDArray[np.float64]:
        """Return coefficients (p,) of nearly the same corrections that the prior makes likely.

        Where an updated prior excludes a term that the series has used, the other terms follow it,
        with orientations as they are. An adjustment that started without it would lose them.
        """
        prior = prior_precision(self.functions, self.prior)
        series = coefficients[self.of_series]
        expected = len(series) + 2 * SAME_WEIGHTS_DECREASE * len(self.rows)
        if series @ prior @ series < expected:
            return coefficients
        weight = adjustment.noise.weight(adjustment.q[self.rows])
        weighted = np.sqrt(weight)[:, None] * self.weighted(self.values, adjustment.noise.scale)
        information = block_diag(*[weighted.T @ weighted] * 2)
        out = coefficients.copy()
        out[self.of_series] = np.linalg.solve(information + prior, information @ series)
        return out

    def equations(
        self, network: Network, matrix: FactorizedNormalMatrix, solved: NDArray[np.float64]
    ) -> SeriesEquations:
        """Return the normal equations of the series at a solution.

        network: has the terms with their last priors. solved (p,): estimates with these priors.
        """
        prior = prior_of_additional(network, self.number)
        information = information_of_additional(matrix, self.number) - prior
        information *= matrix.information_factor
        right = (information + prior) @ solved
        if self.own is not None:
            information, right = without_exposure_terms(
                information, right, self.own.precision, self.of_series.stop
            )
        self._last_equations = SeriesEquations(self.functions, information, right, self.gauge)
        return self._last_equations

    def series(self, coefficients: NDArray[np.float64], covariance: NDArray[np.float64]) -> Series:
        """Return the series, without the terms of the exposures.

        coefficients: (p,), those of u first. covariance: (p, p).
        """
        functions = self.functions
        sd = sd_over_image(functions, covariance[self.of_series, self.of_series])
        values = coefficients[self.of_series].reshape(2, -1)
        if has_rings(functions, self.prior):
            return Series(*functions.as_polynomials(values), sd)
        without_rings = replace(functions, rings=0, absent=())
        return Series(
            without_rings, without_rings.converted(functions, values.ravel()).reshape(2, -1), sd
        )

    def fitted_series(self, adjustment: Adjustment, precise: Precision) -> Series:
        """See `TermsOfFluoroscope`."""
        fit = self._angle_fit
        if fit is not None:
            return self.series(fit.coefficients, fit.covariance)
        coefficients, covariance = estimated_terms(self.number, adjustment, precise)
        rows = self.of_series
        coefficients = coefficients[rows]
        covariance = covariance_of_series(
            self.functions, self.prior, coefficients, covariance[rows, rows]
        )
        last = self._last_equations
        if last is not None:
            equations = replace(last, gauge=self.gauge)  # about the last interior orientation
            covariance = covariance + covariance_by_signal(equations, self.prior)
        return self.series(coefficients, covariance)

    def fit_angles(self, adjustment: Adjustment, precise: Precision) -> AngleField | None:
        """See `TermsOfFluoroscope`; None: the terms of exposures do not follow the angles."""
        covariance = precise.additional[self.number]
        if self.own is None or covariance is None or not can_be_fitted(self.angles):
            return None
        coefficients = coefficients_of(adjustment)[self.number]
        estimated = SeriesWithExposures(
            self.functions, self.uv, self.own, coefficients, covariance
        )
        self._angle_fit = fit_angles(estimated, self.angles)
        return None if self._angle_fit is None else self._angle_fit.field

    def left_out(self) -> tuple[LeftOut, ...]:
        """Return the signal that the sines omit: of the fields, and of places."""
        functions = self.functions
        if not functions.modes:
            return ()
        signal = self.prior.signal
        local = self.prior.local
        variance = signal.sd_beyond(functions.highest) ** 2
        of_fields = LeftOut(
            lambda uv: np.full(len(uv), variance),
            partial(signal.correlation_beyond, functions.highest),
        )
        if local is None:
            return (of_fields,)
        of_places = LeftOut(
            partial(local.variance_beyond, functions), partial(correlation_beyond, functions)
        )
        return of_fields, of_places

    def variance_between_exposures(
        self, network: Network, adjustment: Adjustment, precise: Precision
    ) -> NDArray[np.float64]:
        """See `TermsOfFluoroscope`."""
        covariance = precise.additional[self.number]
        if self.own is None or covariance is None:
            return super().variance_between_exposures(network, adjustment, precise)
        coefficients = coefficients_of(adjustment)[self.number]
        last = slice(-self.own.count, None)
        remaining = 1.0 if self._angle_fit is None else self._angle_fit.remaining
        return remaining * variance_between_exposures(
            network,
            adjustment,
            self.number,
            terms=self.own,
            coefficients=coefficients[last],
            covariance=covariance[last, last],
        )
