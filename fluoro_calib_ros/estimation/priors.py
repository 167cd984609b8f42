# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Prior distributions of the coefficients of trend and signal of a distortion.

Least-squares collocation (Moritz, "Advanced Physical Geodesy", 1980): the signal is a random field
with a covariance function (see `signal`). This function, and the existence of each term of the
trend, are estimated from the observations by their marginal likelihood (Rasmussen and Williams,
"Gaussian Processes for Machine Learning", 2006, 5.4; for the trend Tipping and Faul, "Fast
marginal likelihood maximisation for sparse Bayesian models", 2003).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from ..correction.series import Functions
from ..correction.terms import ABSENT_VARIANCE, trend_transformation
from ..photogrammetry.noise import SURE
from ..photogrammetry.rotations import inverse_of_positive
from .estimator import GaugeKind, gauge_rows
from .local_signal import LocalSignal, SineEstimates, bumps, largest_gain, with_likely_places
from .parametric import covariance_with_uncertain_terms
from .signal import Signal, SignalEquations, most_likely_signal, plausible_signals, starting_signal

# Standard deviation that fixes the gauge. With three times as much it shows in the standard
# deviation of a correction (5 % of the best, 0.005 px); with a third it damps the steps of the
# adjustment.
GAUGE_SD_PX = 1e-4
# Prior variance of a non-existing trend term, relative to the variance of its estimate.
MIN_RELATIVE_VARIANCE = 1e-3
MAX_VARIANCE = 1e8  # largest prior variance of a trend term
# Ring terms that can exist: radial and spiral of degree 5, radial of degree 7.
RING_TERMS = (0, 1, 4)
# Least square of a ring term, over its variance, to exist. Such a term costs errors beyond the
# calibrated area, where it grows fast; with 1, chance alone would make one in three exist.
RING_EXISTS = SURE**2
# Gain of the logarithm of the likelihood by a place, with the signal of fewer sines, above which
# the signal is estimated again with more sines.
SUSPECTED_GAIN = 2.0
SWEEPS = 3  # updates of the signal in that case, and sweeps over the terms of the trend
RIDGE = 1e-9  # increase of a diagonal, relative to its largest value


@dataclass(frozen=True)
class Prior:
    """Prior of a distortion.

    signal: covariance function of the signal; trend (t,): variances of the trend terms [px^2];
    local: places where the signal has a larger variance, None: there are none.
    """

    signal: Signal
    trend: NDArray[np.float64]
    local: LocalSignal | None = None

    def change(self, other: Prior, functions: Functions) -> float:
        """Return the mean change of the log variances of the signal from another prior."""
        change = self.signal.change(other.signal, functions.frequency)
        if self.local is None:
            return change if other.local is None else np.inf
        return max(change, self.local.change(other.local))


@dataclass(frozen=True)
class SeriesEquations:
    """Normal equations of the coefficients of a series, all other unknowns eliminated."""

    functions: Functions
    information: NDArray[np.float64]  #: (2m, 2m), without a prior
    right: NDArray[np.float64]  #: (2m,)
    gauge: NDArray[np.float64]  #: (2m, 2m) precision matrix of the gauge

    @property
    def with_gauge(self) -> NDArray[np.float64]:
        """Information (2m, 2m) that includes the gauge."""
        return self.information + self.gauge


def starting_prior(functions: Functions, sd: float) -> Prior:
    """Return an initial prior; sd: RMS residual without correction [px]."""
    _, count = trend_transformation(functions.degree, functions.rings)
    signal = starting_signal(0.3 * sd, max(functions.image_size))
    trend = np.full(count, MAX_VARIANCE)
    trend[_first_ring(functions) :] = ABSENT_VARIANCE
    return Prior(signal, trend)


def _first_ring(functions: Functions) -> int:
    """Return the number of the first ring term; each ring has four terms, the last of all."""
    _, count = trend_transformation(functions.degree, functions.rings)
    return count - 4 * functions.rings


def has_rings(functions: Functions, prior: Prior) -> bool:
    """Whether a term of the rings exists."""
    return bool(np.any(prior.trend[_first_ring(functions) :] > ABSENT_VARIANCE))


def prior_precision(functions: Functions, prior: Prior) -> NDArray[np.float64]:
    """Return the precision matrix (2m, 2m) of the coefficients of a series."""
    out = np.zeros((2 * len(functions),) * 2)
    if functions.modes:
        signal = signal_precision(functions, prior)
        for block in _sines(functions):
            out[block, block] = signal
    trend = trend_columns(functions)
    out[np.ix_(trend, trend)] = _trend_precision(functions, prior)
    return out


def signal_precision(functions: Functions, prior: Prior) -> NDArray[np.float64]:
    """Return the precision matrix (s, s) of the coefficients of the sines of u, or of v."""
    variance = prior.signal.variance(functions.frequency)
    if prior.local is None:
        return np.diag(1 / variance)
    base = bumps(functions, prior.local.nodes)
    covariance = (base * prior.local.of_bumps) @ base.T
    covariance[np.diag_indices(len(variance))] += variance
    return inverse_of_positive(covariance)


def _terms_that_can_exist(functions: Functions) -> list[int]:
    """Return the numbers of the terms of the polynomials, and of rings that can exist."""
    _, count = trend_transformation(functions.degree, functions.rings)
    rings = _first_ring(functions)
    return [*range(rings), *(rings + k for k in RING_TERMS if rings + k < count)]


def trend_columns(functions: Functions) -> NDArray[np.int64]:
    """Return the indices of the coefficients of polynomials and rings, those of u first."""
    m = len(functions)
    t = functions.trend
    return np.concatenate([np.arange(t), m + np.arange(t)])


def _sines(functions: Functions) -> list[slice]:
    """Return the slices of the coefficients of the sines of u, and of v."""
    m = len(functions)
    return [slice(axis * m + functions.trend, (axis + 1) * m) for axis in (0, 1)]


def _trend_precision(functions: Functions, prior: Prior) -> NDArray[np.float64]:
    """Return the precision matrix of the trend coefficients; zero for directions of the gauge."""
    to_terms, count = trend_transformation(functions.degree, functions.rings)
    return to_terms[:count].T @ (to_terms[:count] / prior.trend[:, None])


def covariance_of_series(
    functions: Functions,
    prior: Prior,
    coefficients: NDArray[np.float64],
    covariance: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Add the uncertainty of which trend terms exist to the covariance (2m, 2m) of a series.

    coefficients, covariance: (2m, 2m) posterior with this prior. Returns (2m, 2m).
    """
    to_terms, _ = trend_transformation(functions.degree, functions.rings)
    rows = _terms_that_can_exist(functions)
    to_terms_of_both = np.zeros((len(rows), 2 * len(functions)))
    to_terms_of_both[:, trend_columns(functions)] = to_terms[rows]
    return covariance_with_uncertain_terms(
        to_terms_of_both, prior.trend[rows], coefficients, covariance
    )


def covariance_by_signal(equations: SeriesEquations, prior: Prior) -> NDArray[np.float64]:
    """Return the covariance (2m, 2m) that a series gains because its signal is only estimated.

    It is the mean over plausible signals of the covariance with each and of the squared change of
    the coefficients, less the covariance with the most likely signal.
    """
    out = np.zeros_like(equations.information)
    functions = equations.functions
    if not functions.modes:
        return out
    signals = plausible_signals(
        prior.signal, _signal_equations(equations, prior), max(functions.image_size)
    )
    mean, covariance = _posterior(equations, prior)
    for signal in signals:
        new_mean, new_covariance = _posterior(equations, replace(prior, signal=signal))
        change = new_mean - mean
        out += (new_covariance - covariance + np.outer(change, change)) / len(signals)
    return out


def _posterior(
    equations: SeriesEquations, prior: Prior
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return coefficients (2m,) and their covariance (2m, 2m)."""
    precision = equations.with_gauge + prior_precision(equations.functions, prior)
    covariance = inverse_of_positive(precision)
    return covariance @ equations.right, covariance


def gauge_conditions(
    values: NDArray[np.float64],
    uv: NDArray[np.float64],
    interior: NDArray[np.float64],
    kind: GaugeKind = GaugeKind.FULL,
) -> NDArray[np.float64]:
    """Return rows (g, 2m) that keep a series orthogonal to the gauge at image points.

    values: (n, m) functions of the series at the image points. uv: (n, 2) image points [px].
    interior: (3,) xp, yp, c [px]. The products with coefficients have the standard deviation one.
    """
    return gauge_rows(values, uv, interior, kind) / GAUGE_SD_PX


def most_likely_prior(equations: SeriesEquations, prior: Prior) -> Prior:
    """Return a prior with a larger marginal likelihood: signal first, then trend.

    Repeat until the prior does not change. prior: present prior.
    """
    if equations.functions.modes:
        prior = _most_likely_signal(equations, prior)
    return _most_likely_trend(equations, prior)


def _most_likely_signal(equations: SeriesEquations, prior: Prior) -> Prior:
    """Return the prior with an updated signal."""
    functions = equations.functions
    of_signal = _signal_equations(equations, prior)
    signal = most_likely_signal(prior.signal, of_signal, max(functions.image_size))
    local = prior.local
    if local is not None:
        local = _renewed(local, of_signal, signal.variance(functions.frequency))
    return replace(prior, signal=signal, local=local)


def _signal_equations(equations: SeriesEquations, prior: Prior) -> SignalEquations:
    """Return normal equations with all priors except the signal's."""
    functions = equations.functions
    trend = trend_columns(functions)
    right = equations.right
    base = np.asfortranarray(equations.with_gauge)
    base[np.ix_(trend, trend)] += _trend_precision(functions, prior)
    columns = np.setdiff1d(np.arange(len(right)), trend)
    if prior.local is not None:
        base, right = _with_bumps(functions, base, right, prior.local)
    return SignalEquations(functions.frequency, base, right[:, None], columns)


def _with_bumps(
    functions: Functions,
    matrix: NDArray[np.float64],
    right: NDArray[np.float64],
    local: LocalSignal,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Add the heights of the bumps to normal equations as unknowns, those of u first.

    matrix (2m, 2m), right (2m,): of the coefficients. The coefficients of the sines are then those
    of the signal without the bumps.
    """
    base = bumps(functions, local.nodes)
    sines = _sines(functions)
    mixed = np.concatenate([matrix[:, block] @ base for block in sines], axis=1)
    corner = np.concatenate([base.T @ mixed[block] for block in sines])
    size = corner.shape[0]
    corner[np.diag_indices(size)] += 1 / np.tile(local.of_bumps, 2)
    out = np.asfortranarray(np.block([[matrix, mixed], [mixed.T, corner]]))
    return out, np.concatenate([right, *(base.T @ right[block] for block in sines)])


def _renewed(
    local: LocalSignal, equations: SignalEquations, variance: NDArray[np.float64]
) -> LocalSignal | None:
    """Return the places with more likely variances; variance (s,): of the sines."""
    matrix = equations.information.copy(order='F')
    columns = equations.columns
    matrix[columns, columns] += 1 / np.tile(variance, 2)
    size = 2 * len(local.nodes)
    units = np.eye(len(matrix))[:, -size:]
    factor = cho_factor(matrix, lower=True)
    solved = cho_solve(factor, np.concatenate([equations.right, units], axis=1))[-size:]
    mean, heights = solved[:, 0], np.diagonal(solved[:, 1:])
    return local.renewed(mean.reshape(2, -1), heights.reshape(2, -1))


def with_shown_places(
    functions: Functions, values: NDArray[np.float64], observed: NDArray[np.float64], prior: Prior
) -> Prior:
    """Return the prior with places of larger signal variance, as image points show them.

    Orientations are assumed to be known, and the trend to have no prior, so that u and v have the
    same matrices. The signal is estimated again only where a place may be found.

    values: (n, m) functions at the image points, divided by the standard deviation of their noise.
    observed: (n, 2) corrections that they show, divided likewise.
    """
    t = functions.trend
    matrix = values.T @ values
    right = values.T @ observed
    # Terms that the image points do not separate.
    matrix[np.arange(t), np.arange(t)] += RIDGE * np.max(np.diagonal(matrix))

    def estimates(candidate: Prior) -> SineEstimates:
        precision = signal_precision(functions, candidate)
        with_prior = matrix.copy()
        with_prior[t:, t:] += precision
        covariance = inverse_of_positive(with_prior)
        return SineEstimates.of(precision, (covariance @ right)[t:], covariance[None, t:, t:])

    if largest_gain(functions, estimates(prior)) < SUSPECTED_GAIN:
        return prior
    columns = np.arange(t, len(matrix))
    equations = SignalEquations(functions.frequency, matrix, right, columns)
    side = max(functions.image_size)
    for _ in range(SWEEPS):
        prior = replace(prior, signal=most_likely_signal(prior.signal, equations, side))
    return replace(prior, local=with_likely_places(functions, estimates(prior), prior.local))


def with_more_places(equations: SeriesEquations, prior: Prior) -> Prior:
    """Return the prior with more places of larger signal variance, if there are any."""
    functions = equations.functions
    coefficients, covariance = _posterior(equations, prior)
    mean = coefficients.reshape(2, -1).T[functions.trend :]
    covariances = np.stack([covariance[block, block] for block in _sines(functions)])
    estimates = SineEstimates.of(signal_precision(functions, prior), mean, covariances)
    return replace(prior, local=with_likely_places(functions, estimates, prior.local))


def _most_likely_trend(equations: SeriesEquations, prior: Prior) -> Prior:
    """Return the prior with updated variances of the trend terms, one after the other."""
    functions = equations.functions
    to_terms, count = trend_transformation(functions.degree, functions.rings)
    if not count:
        return prior
    matrix, right = _trend_alone(equations, prior)
    from_terms = np.linalg.inv(to_terms)
    matrix = from_terms.T @ matrix @ from_terms
    right = from_terms.T @ right
    variance = prior.trend.copy()
    rings = _first_ring(functions)
    for _ in range(SWEEPS):
        for j in _terms_that_can_exist(functions):
            precision = np.concatenate([1 / variance, np.zeros(len(to_terms) - count)])
            precision[j] = 0
            # The term is estimated without its prior; the expectation of its square is the sum of
            # the variance of the estimate and of the prior.
            c = np.linalg.solve(
                matrix + np.diag(precision), np.stack([right, np.eye(len(right))[j]], axis=1)
            )
            variance[j] = np.clip(
                c[j, 0] ** 2 - c[j, 1], MIN_RELATIVE_VARIANCE * c[j, 1], MAX_VARIANCE
            )
            if j >= rings and c[j, 0] ** 2 < RING_EXISTS * c[j, 1]:
                variance[j] = ABSENT_VARIANCE
    return replace(prior, trend=variance)


def _trend_alone(
    equations: SeriesEquations, prior: Prior
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Eliminate the signal; return information and right side of the trend coefficients."""
    functions = equations.functions
    information = equations.with_gauge
    right = equations.right
    trend = trend_columns(functions)
    sines = np.setdiff1d(np.arange(len(right)), trend)
    if not len(sines):
        return information, right
    signal = information[np.ix_(sines, sines)].copy()
    precision = signal_precision(functions, prior)
    signal[: len(precision), : len(precision)] += precision
    signal[len(precision) :, len(precision) :] += precision
    mixed = information[np.ix_(sines, trend)]
    solved = cho_solve(cho_factor(signal, lower=True), np.column_stack([mixed, right[sines]]))
    reduced = information[np.ix_(trend, trend)] - mixed.T @ solved[:, :-1]
    return reduced, right[trend] - mixed.T @ solved[:, -1]
