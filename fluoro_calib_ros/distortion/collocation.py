# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The model `collocation`: trend and signal estimated in the adjustment.

Least-squares collocation (Moritz, "Advanced Physical Geodesy", 1980): the distortion is a cubic
trend plus a random field, both among the unknowns of the adjustment, with priors that are
estimated from the observations (see `priors`). Radial terms of degree 5 and 7 and a spiral of
degree 5 join the trend where the observations make them likely: beyond the image points a field
returns to zero, and a trend goes on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import block_diag

from ..photogrammetry.additional_parameters import AdditionalParameters
from ..photogrammetry.precision import information_of_additional, solved_additional
from .angle_field import AngleField
from .angle_fit import AngleFit, SeriesWithExposures, can_be_fitted, fit_angles
from .estimation import AdjustedTerms, AdjustmentProblem, coefficients_of, prior_of_additional
from .exposure_terms import (
    ExposureTerms,
    exposure_functions,
    variation,
    without_exposure_terms,
)
from .exposure_variance import estimates_beside_free_points, variance_between_exposures
from .local_signal import correlation_beyond
from .misfit import (
    LARGEST_SD,
    FittedPoints,
    LeftOut,
    LeftOutInPlaces,
    areas_of_rejected,
    has_common_error,
)
from .priors import (
    Prior,
    covariance_of_series,
    gauge_precision,
    has_rings,
    most_likely_prior,
    prior_precision,
    starting_prior,
    with_more_places,
    with_shown_places,
)
from .ripples import Ripples, ripples_of, shown_ripples
from .series import Functions, Series, sd_over_image, without_absent_bands
from .series_model import SeriesModel

if TYPE_CHECKING:
    from ..photogrammetry.adjustment import Adjustment
    from ..photogrammetry.elimination import FactorizedNormalMatrix
    from ..photogrammetry.network import Network
    from ..photogrammetry.precision import Precision

TREND_DEGREE = 3  # pincushion, S-shape and spiral are cubic to first order (Gronenschild 1997)
RINGS = 2  # radial polynomials of degree 5 and 7: what a lens or a curved screen adds at the rim
START_MODES = 16  # half waves along the image, until the signal is known
MIN_MODES = 10
TAKEN_BACK_MODES = 24  # to start with where rejected image points agree; more may follow
LOCAL_MODES = 24  # that tell the bumps of a place where the signal varies more
# Bands up to which a smooth field has its sines where others of few bands follow ripples.
GAP_FROM = 12
MAX_PLACE_SEARCHES = 4  # for more such places, beside those that there are
MAX_MODES = 30  # the time grows with the sixth power
# Prior variance times information of a sine below which the image points say nothing about it.
NEGLIGIBLE = 0.2
FEWER_MODES = 0.75  # part of the present modes from which fewer are worth a change
MODE_CHANGES = 3  # at most
# Mean change of the logarithms of the variances of the signal that changes no correction visibly.
SETTLED_PRIOR = 0.3
# Times that a short field is searched, in renewals without visible change, and sines along the
# image up to which it is: more of them have found one.
MAX_SEARCHES = 3
SEARCHED_MODES = 20
SETTLED_VARIATION = 0.05  # relative change of the size of what differs between exposures
MAX_VARYING_EXPOSURES = 60  # of a fluoroscope that can have terms of their own, to limit the time
# Renewals without visible change after which the priors are held. Noise and signal would otherwise
# swing about their solution for long where the signal is as short as the distance of the points.
HELD_AFTER = 2
MIN_START_SD_PX = 0.1
# Decrease of F that terms which continue an earlier calibration may leave: a thirtieth of a sigma.
CONTINUED_TOLERANCE = 1e-3


class CollocationModel(SeriesModel):
    """Cubic polynomials and a random field of sines, estimated in the adjustment."""

    kind = 'collocation'
    description = 'cubic trend and random field in the adjustment'

    @classmethod
    def adjusted_terms(cls, problem: AdjustmentProblem) -> AdjustedTerms:
        """Trend and signal."""
        return CollocationTerms(problem)


@dataclass(frozen=True)
class EarlierTerms:
    """Terms of an earlier calibration with more exposures.

    Attributes
    ----------
    series : sequence of Series
        By fluoroscope.
    priors : sequence of Prior or None
        Priors by fluoroscope; None: to be estimated from the series.
    is_varying : bool
        Whether the distortion differs between exposures.
    """

    series: Sequence[Series]
    priors: Sequence[Prior | None]
    is_varying: bool


class CollocationTerms(AdjustedTerms):
    """Trend and signal of all fluoroscopes of a network, and their priors.

    modes: number of sines along the image to start with; 0: there is no signal, and the trend has
    no rings (see `series.Functions`). earlier: what to start with instead.
    """

    intermediate_tolerance = 1.0  # noise and prior still change
    # A third of the standard deviation of the noise of 1000 image points; what is left is less.
    noise_tolerance = 5e-3

    def __init__(
        self,
        problem: AdjustmentProblem,
        modes: int = START_MODES,
        earlier: EarlierTerms | None = None,
    ) -> None:
        before = problem.before
        self.network = problem.network
        self.gauge_kinds = problem.gauges
        self.sizes = problem.image_sizes
        self.angles = problem.angles or [np.zeros(0)] * len(self.sizes)
        self.interior = before.parameters.interior
        self.functions: list[Functions] = []
        self.priors: list[Prior] = []
        self.gauges: list[np.ndarray] = []
        self.values: list[np.ndarray] = []
        self.exposure_terms: list[ExposureTerms | None] = [None] * len(self.sizes)
        self._angle_fits: list[AngleFit | None] = [None] * len(self.sizes)
        self._variation_tested = modes == 0
        self._ripples_searched = modes == 0
        self._mode_changes = 0
        self._settled = 0
        self._searches = [0] * len(self.sizes)
        self._places_searched = modes == 0
        self._place_searches = [0] * len(self.sizes)
        self._start = self.zeros()
        if earlier is not None:
            self._continue(earlier, before)
            return
        for f, size in enumerate(self.sizes):
            rows = self.network.rows(f)
            core = before.residuals[rows][before.inliers[rows]]
            self._set_functions(f, Functions(size, TREND_DEGREE, modes, RINGS if modes else 0))
            sd = max(float(np.sqrt(np.mean(core**2))), MIN_START_SD_PX)
            self.priors.append(starting_prior(self.functions[f], sd))
        self._start = self.zeros()

    def _continue(self, earlier: EarlierTerms, before: Adjustment) -> None:
        """Start with earlier series, and with the priors that are most likely for them."""
        self._variation_tested = not earlier.is_varying
        self._ripples_searched = True  # those of the earlier series are kept
        self.final_tolerance = CONTINUED_TOLERANCE
        self._places_searched = all(prior is not None for prior in earlier.priors)
        self._mode_changes = 1  # those of the earlier series are not the first
        start = []
        for f, (series, prior) in enumerate(zip(earlier.series, earlier.priors)):
            functions = series.functions
            rings = RINGS if functions.modes else 0
            functions, matrix = functions.as_rings(series.coefficients, TREND_DEGREE, rings)
            functions, matrix = without_absent_bands(functions, matrix)
            self._set_functions(f, functions)
            if prior is None:
                prior = self._prior_of(f, matrix, before.noise.scale)
            else:
                self._searches[f] = MAX_SEARCHES  # done where this prior was estimated
                self._place_searches[f] = MAX_PLACE_SEARCHES
            self.priors.append(prior)
            start.append(matrix.ravel())
        self._start = tuple(start)

    def _prior_of(self, f: int, matrix: np.ndarray, scale: float) -> Prior:
        """Prior of fluoroscope f that is most likely for coefficients (2, m); scale: of the noise.

        Orientations are taken to be known, which is near enough to start with.
        """
        rows = self.network.rows(f)
        weighted = self.values[f] / (scale * self.network.sigma[rows])[:, None]
        information = block_diag(*[weighted.T @ weighted] * 2)
        coefficients = matrix.ravel()
        sd = max(float(np.std(self.values[f] @ matrix.T)), MIN_START_SD_PX)
        start = starting_prior(self.functions[f], sd)
        ripples = ripples_of(self.functions[f], matrix)
        start = replace(start, signal=replace(start.signal, ripples=ripples))
        return most_likely_prior(
            self.functions[f], information, information @ coefficients, self.gauges[f], start
        )

    def start(self) -> tuple[np.ndarray, ...]:
        """Coefficients to start with, by fluoroscope."""
        return self._start

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
        additional = tuple(self._additional(f) for f in range(len(self.functions)))
        return replace(network, additional=additional)

    def _additional(self, f: int) -> AdditionalParameters:
        """Additional parameters of fluoroscope f: the series, then the terms of its exposures."""
        prior = prior_precision(self.functions[f], self.priors[f]) + self.gauges[f]
        own = self.exposure_terms[f]
        if own is None:
            return AdditionalParameters(self.values[f], prior)
        prior = block_diag(prior, np.diag(own.precision))
        return AdditionalParameters(self.values[f], prior, own.functions)

    def zeros(self) -> tuple[np.ndarray, ...]:
        """Coefficients of no correction, by fluoroscope."""
        return tuple(
            np.zeros(2 * len(functions) + (0 if own is None else own.count))
            for functions, own in zip(self.functions, self.exposure_terms)
        )

    def series(self, f: int, coefficients: np.ndarray, covariance: np.ndarray) -> Series:
        """Return the series of fluoroscope f, without the terms of its exposures.

        coefficients (p,), those of u first, and their covariance (p, p).
        """
        functions = self.functions[f]
        own = slice(2 * len(functions))
        sd = sd_over_image(functions, covariance[own, own])
        values = coefficients[own].reshape(2, -1)
        if has_rings(functions, self.priors[f]):
            return Series(*functions.as_polynomials(values), sd)
        plain = replace(functions, rings=0, absent=())
        return Series(plain, plain.converted(functions, values.ravel()).reshape(2, -1), sd)

    def fit_angles(self, f: int, adjustment: Adjustment, precise: Precision) -> AngleField | None:
        """See `AdjustedTerms`."""
        own = self.exposure_terms[f]
        covariance = precise.additional[f]
        angles = self.angles[f]
        if own is None or covariance is None or not can_be_fitted(angles):
            return None
        estimated = SeriesWithExposures(
            self.functions[f],
            self.network.uv[self.network.rows(f)],
            own,
            coefficients_of(adjustment)[f],
            covariance,
        )
        fit = fit_angles(estimated, angles)
        self._angle_fits[f] = fit
        return None if fit is None else fit.field

    def fitted_series(self, f: int, adjustment: Adjustment, precise: Precision) -> Series:
        """See `AdjustedTerms`; beside a field of the angle, that which belongs to it."""
        fit = self._angle_fits[f]
        if fit is not None:
            return self.series(f, fit.coefficients, fit.covariance)
        covariance = precise.additional[f]
        if covariance is None:
            raise ValueError(f'no terms were estimated for fluoroscope number {f}')
        functions = self.functions[f]
        own = slice(2 * len(functions))
        coefficients = coefficients_of(adjustment)[f][own]
        covariance = covariance_of_series(
            functions, self.priors[f], coefficients, covariance[own, own]
        )
        return self.series(f, coefficients, covariance)

    def left_out(self, f: int) -> LeftOut | None:
        """The signal beyond the sines of fluoroscope f."""
        functions = self.functions[f]
        if not functions.modes:
            return None
        signal = self.priors[f].signal
        highest = functions.highest
        local = self.priors[f].local
        places = None
        if local is not None:
            places = LeftOutInPlaces(
                partial(local.variance_beyond, functions), partial(correlation_beyond, functions)
            )
        correlation = partial(signal.correlation_beyond, highest)
        return LeftOut(signal.sd_beyond(highest), correlation, places)

    def variance_between_exposures(
        self, f: int, network: Network, adjustment: Adjustment, precise: Precision
    ) -> np.ndarray:
        """See `AdjustedTerms`."""
        own = self.exposure_terms[f]
        covariance = precise.additional[f]
        if own is None or covariance is None:
            return super().variance_between_exposures(f, network, adjustment, precise)
        last = slice(-own.count, None)
        fit = self._angle_fits[f]
        return (1.0 if fit is None else fit.remaining) * variance_between_exposures(
            network,
            adjustment,
            f,
            own,
            coefficients_of(adjustment)[f][last],
            covariance[last, last],
        )

    def renew(
        self, network: Network, matrix: FactorizedNormalMatrix, adjustment: Adjustment
    ) -> tuple[bool, tuple[np.ndarray, ...]]:
        """Renew priors, gauges and the numbers of modes at a solution.

        Returns whether the priors have settled, and the coefficients with which to continue.
        """
        coefficients = coefficients_of(adjustment)
        if self._settled == HELD_AFTER:
            return True, coefficients
        self.interior = adjustment.parameters.interior
        solved = solved_additional(matrix, network, adjustment)
        self._renew_exposure_terms(network, adjustment)
        found = [
            self._renew_prior(f, network, matrix, solved[f]) for f in range(len(self.functions))
        ]
        modes = [modes for modes, _ in found]
        present_modes = [functions.complete for functions in self.functions]
        if modes != present_modes and self._mode_changes < MODE_CHANGES:
            self._mode_changes += 1
            self._settled = 0
            return False, self._with_modes(modes, coefficients)
        settled = all(steady for _, steady in found)
        if settled and not self._ripples_searched:
            # Ripples may pass for a change between exposures.
            self._ripples_searched = True
            ripple_modes = self._add_ripples(adjustment, coefficients)
            if ripple_modes is not None:
                return False, self._with_modes(ripple_modes, coefficients)
        if settled and not self._variation_tested:
            self._variation_tested = True
            if self._add_exposure_terms(adjustment):
                self._mode_changes = 0  # what varied may have passed for ripples
                fewer = [min(number, START_MODES) for number in present_modes]
                coefficients = self._with_modes(fewer, coefficients)
                zeros = self.zeros()
                return False, tuple(
                    np.concatenate([old, new[len(old) :]]) for old, new in zip(coefficients, zeros)
                )
            found_short = self._add_sines(adjustment, coefficients)
            if found_short is not None:
                return False, found_short
        if settled and not self._places_searched:
            self._places_searched = True
            place_modes = self._add_places(adjustment, coefficients)
            if place_modes is not None:
                self._settled = 0
                return False, self._with_modes(place_modes, coefficients)
        self._settled = self._settled + 1 if settled else 0
        return settled, coefficients

    def _add_sines(
        self, adjustment: Adjustment, coefficients: tuple[np.ndarray, ...]
    ) -> tuple[np.ndarray, ...] | None:
        """Use all sines where residuals show what the present ones are too long for.

        They do so by an error that is common to all exposures, or by rejected image points that
        agree. Returns the coefficients for them, None where the residuals show nothing.
        """
        modes = []
        present = [functions.complete for functions in self.functions]
        taken_back = [self._agreeing(f, adjustment) for f in range(len(self.functions))]
        corrections = self._corrections(coefficients)
        for f, functions in enumerate(self.functions):
            missing = functions.complete < MAX_MODES and (
                len(taken_back[f]) > 0 or has_common_error(self._fitted_points(f, adjustment))
            )
            wanted = TAKEN_BACK_MODES if len(taken_back[f]) else MAX_MODES
            modes.append(max(wanted, functions.complete) if missing else functions.complete)
            if missing:
                signal = self.priors[f].signal.with_short_field(max(self.sizes[f]))
                self.priors[f] = replace(self.priors[f], signal=signal)
        if modes == present and not any(len(rows) for rows in taken_back):
            return None
        out = list(self._with_modes(modes, coefficients))
        for f, rows in enumerate(taken_back):
            if len(rows):
                own = self.network.rows(f)
                used = adjustment.inliers[own]
                used[rows] = True
                values = adjustment.residuals[own] + corrections[f]
                out[f] = self._followed(f, values, used, adjustment.noise.scale)
        return tuple(out)

    def _add_places(
        self, adjustment: Adjustment, coefficients: tuple[np.ndarray, ...]
    ) -> list[int] | None:
        """Add places where the signal varies more.

        Returns the modes that they need, None where there are none.
        """
        modes = []
        added = False
        corrections = self._corrections(coefficients)
        for f, functions in enumerate(self.functions):
            fine = replace(functions, modes=max(LOCAL_MODES, functions.modes))
            rows = self.network.rows(f)
            used = adjustment.inliers[rows]
            rows = rows[used]
            noise = adjustment.noise.scale * self.network.sigma[rows]
            root = (np.sqrt(adjustment.noise.weight(adjustment.q[rows])) / noise)[:, None]
            observed = adjustment.residuals[rows] + corrections[f][used]
            values = fine(self.network.uv[rows])
            found = with_shown_places(fine, values * root, observed * root, self.priors[f])
            if found.local is not None:
                self.priors[f] = found
                added = True
            modes.append(functions.complete if found.local is None else fine.complete)
        return modes if added else None

    def _corrections(self, coefficients: tuple[np.ndarray, ...]) -> list[np.ndarray]:
        """Corrections (n, 2) [px] of the image points of each fluoroscope by the series."""
        return [
            values @ own[: 2 * values.shape[1]].reshape(2, -1).T
            for values, own in zip(self.values, coefficients)
        ]

    def _agreeing(self, f: int, adjustment: Adjustment) -> np.ndarray:
        """Rows, of those of fluoroscope f, of rejected image points that agree."""
        rows = self.network.rows(f)
        noise = adjustment.noise.scale * self.network.sigma[rows]
        small = np.sum(adjustment.residuals[rows] ** 2, axis=1) < (LARGEST_SD * noise) ** 2
        rejected = np.flatnonzero(~adjustment.inliers[rows] & small)
        at = rows[rejected]
        points = FittedPoints(
            self.network.uv[at], adjustment.residuals[at], self.network.exposure[at]
        )
        areas = areas_of_rejected(
            points,
            self.network.point[at],
            self.network.uv[rows[adjustment.inliers[rows]]],
            self.sizes[f],
        )
        found = [area.rows for area in areas if area.size_px > area.limit_px]
        return rejected[np.unique(np.concatenate(found))] if found else rejected[:0]

    def _followed(self, f: int, values: np.ndarray, used: np.ndarray, scale: float) -> np.ndarray:
        """Coefficients that follow the values (n, 2) [px] of the image points that are used (n,).

        The robust adjustment goes on from there: at a solution that rejects image points they have
        no weight, however many they are. Orientations are taken to be known, which is near enough
        to start with. scale: of the noise.
        """
        rows = self.network.rows(f)
        weighted = self.values[f] / (scale * self.network.sigma[rows])[:, None]
        weighted = weighted * used[:, None]
        information = block_diag(*[weighted.T @ weighted] * 2)
        observed = values / (scale * self.network.sigma[rows])[:, None]
        right = (weighted.T @ observed).T.ravel()
        prior = most_likely_prior(
            self.functions[f], information, right, self.gauges[f], self.priors[f], True
        )
        self.priors[f] = prior
        precision = information + self.gauges[f] + prior_precision(self.functions[f], prior)
        return np.linalg.solve(precision, right)

    def _add_ripples(
        self, adjustment: Adjustment, coefficients: tuple[np.ndarray, ...]
    ) -> list[int] | None:
        """Add ripples in few bands of frequencies.

        Residuals show them, or what the sines of these bands have already followed, with all
        others that are as short. Returns the modes beside the ripples, None where there are none.
        """
        modes = []
        added = False
        for f, functions in enumerate(self.functions):
            points = self._fitted_points(f, adjustment)
            signal = self.priors[f].signal
            modes.append(functions.complete)
            found = self._shown_ripples(f, points, points.residuals, functions.complete)
            if found is None and functions.complete > GAP_FROM and signal.ripples is None:
                short = np.concatenate([np.zeros(functions.trend), functions.band > GAP_FROM])
                own = coefficients[f][: 2 * len(functions)].reshape(2, -1) * short
                followed = points.residuals + functions(points.uv) @ own.T
                found = self._shown_ripples(f, points, followed, GAP_FROM)
                found = None if found is None else found.alone()
                if found is not None:
                    signal = signal.without_short_field(max(self.sizes[f]))
                    modes[f] = GAP_FROM
            if found is not None:
                signal = replace(signal, ripples=found.joined(signal.ripples))
                self.priors[f] = replace(self.priors[f], signal=signal)
                added = True
        return modes if added else None

    def _shown_ripples(
        self, f: int, points: FittedPoints, values: np.ndarray, complete: int
    ) -> Ripples | None:
        """Ripples of fluoroscope f that values (n, 2) [px] show beyond the complete bands."""
        return shown_ripples(self.sizes[f], points.uv, values, points.exposure, complete)

    def _fitted_points(self, f: int, adjustment: Adjustment) -> FittedPoints:
        """Inliers of fluoroscope f."""
        rows = self.network.rows(f)
        rows = rows[adjustment.inliers[rows]]
        return FittedPoints(
            self.network.uv[rows], adjustment.residuals[rows], self.network.exposure[rows]
        )

    def _renew_exposure_terms(self, network: Network, adjustment: Adjustment) -> None:
        """Renew the variances of the terms of exposures."""
        if all(own is None for own in self.exposure_terms):
            return
        estimates = estimates_beside_free_points(network, adjustment)
        for own, functions, (mean, variance) in zip(
            self.exposure_terms, self.functions, estimates
        ):
            if own is not None:
                end = slice(2 * len(functions), None)
                before = own.size_px
                own.renew(mean[end], variance[end])
                if abs(own.size_px - before) > SETTLED_VARIATION * before:
                    self._settled = 0

    def _renew_prior(
        self, f: int, network: Network, matrix: FactorizedNormalMatrix, coefficients: np.ndarray
    ) -> tuple[int, bool]:
        """Renew the prior of fluoroscope f; return the modes it needs and whether it is steady."""
        functions = self.functions[f]
        last = self.priors[f]
        present = prior_of_additional(network, f)
        information = information_of_additional(matrix, f) - present
        information *= matrix.information_factor
        right = (information + present) @ coefficients
        own = self.exposure_terms[f]
        if own is not None:
            information, right = without_exposure_terms(
                information, right, own.precision, 2 * len(functions)
            )

        def renewed(prior: Prior, search: bool) -> Prior:
            gauge = self.gauges[f]
            return most_likely_prior(functions, information, right, gauge, prior, search)

        prior = renewed(last, False)
        change = prior.change(last, functions) if functions.modes else 0.0
        cheap = 0 < functions.modes <= SEARCHED_MODES
        if cheap and change < SETTLED_PRIOR and self._searches[f] < MAX_SEARCHES:
            self._searches[f] += 1
            prior = renewed(last, True)
            change = prior.change(last, functions)
        if prior.local is not None and self._place_searches[f] < MAX_PLACE_SEARCHES:
            self._place_searches[f] += 1
            prior = with_more_places(functions, information, right, self.gauges[f], prior)
            change = prior.change(last, functions)
        self.priors[f] = prior
        self.gauges[f] = self._gauge(f)
        if not functions.modes:
            return 0, True
        return self._modes(f, information), change < SETTLED_PRIOR

    def _add_exposure_terms(self, adjustment: Adjustment) -> bool:
        """Add terms of the exposures where the residuals show that they differ; True if any."""
        for f, size in enumerate(self.sizes):
            rows = self.network.rows(f)
            functions = exposure_functions(self.network.uv[rows], size, self.interior[f])
            exposure = self.network.exposure[rows]
            core = adjustment.inliers[rows]
            found = variation(adjustment.residuals[rows][core], exposure[core], functions[core])
            if found.is_varying and len(np.unique(exposure)) <= MAX_VARYING_EXPOSURES:
                if can_be_fitted(self.angles[f]):
                    functions = exposure_functions(
                        self.network.uv[rows], size, self.interior[f], with_interior=True
                    )
                self.exposure_terms[f] = ExposureTerms(functions, exposure, found.size_px)
        return any(own is not None for own in self.exposure_terms)

    def _modes(self, f: int, information: np.ndarray) -> int:
        """Number of modes with which the image points of fluoroscope f can tell the signal.

        information (2m, 2m) of its coefficients without prior.
        """
        functions = self.functions[f]
        if not functions.modes:
            return 0
        m = len(functions)
        complete = functions.complete
        level = float(np.mean(np.diagonal(information)[functions.trend : m]))
        numbers = np.arange(MIN_MODES, MAX_MODES + 1)
        variance = self.priors[f].signal.density(numbers * functions.frequency_of_mode)
        enough = numbers[variance * level < NEGLIGIBLE]
        wanted = int(enough[0]) if len(enough) else MAX_MODES
        if self.priors[f].local is not None:
            wanted = max(wanted, LOCAL_MODES)
        kept = FEWER_MODES * complete <= wanted <= complete
        return complete if kept and self._mode_changes else wanted

    def _with_modes(
        self, modes: list[int], coefficients: tuple[np.ndarray, ...]
    ) -> tuple[np.ndarray, ...]:
        """Use all sines up to these numbers of modes, and those of ripples.

        Returns the coefficients for them.
        """
        out = []
        for f, functions in enumerate(self.functions):
            ripples = self.priors[f].signal.ripples
            bands = ripples.bands if ripples is not None else ()
            highest = max((modes[f], *bands))
            absent = tuple(b for b in range(modes[f] + 1, highest) if b not in bands)
            self._set_functions(
                f, Functions(self.sizes[f], TREND_DEGREE, highest, functions.rings, absent)
            )
            end = 2 * len(functions)
            series = self.functions[f].converted(functions, coefficients[f][:end])
            out.append(np.concatenate([series, coefficients[f][end:]]))
        return tuple(out)
