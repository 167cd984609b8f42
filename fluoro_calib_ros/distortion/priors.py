"""Trend and signal of a distortion: what is known of their coefficients before the adjustment.

Least-squares collocation (Moritz, "Advanced Physical Geodesy", 1980): the signal is a random field
with a covariance function, here of Matern's family with nu = 5/2, the same for u and v. Its
standard deviation and reach, and for each term of the trend whether it is there at all, are
estimated from the observations themselves by their marginal likelihood (Rasmussen and Williams,
"Gaussian Processes for Machine Learning", 2006, 5.4; for the trend Tipping and Faul, "Fast
marginal likelihood maximisation for sparse Bayesian models", 2003).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve, lapack, solve_triangular
from scipy.optimize import minimize

from .gauge import gauge_basis
from .terms import trend_transformation

MATERN = 2.5
GAUGE_SD_PX = (
    3e-5  # to which the gauge is held; a much smaller one would damp the steps of the adjustment
)
MIN_VARIANCE = 1e-10  # of a coefficient of the signal: an amplitude of 1e-8 px
NOT_THERE = (
    1e-3  # variance of a trend term that is not there, over that with which it is determined
)
MAX_VARIANCE = 1e8  # of a trend term that is taken to be there
REACH_RANGE = (0.02, 1.0)  # of the longer side of the image
MIN_SD_PX = 1e-3  # of the signal
SWEEPS = 3  # over the terms of the trend


@dataclass(frozen=True)
class Prior:
    """Standard deviation sd [px] and reach [px] of the signal, and variances (t,) [px^2] of the
    trend terms.
    """

    sd: float
    reach: float
    trend: np.ndarray


def starting_prior(functions, sd):
    """A Prior to start with, for residuals of standard deviation sd [px] without any correction."""
    _, count = trend_transformation(functions.degree)
    return Prior(0.3 * sd, 0.15 * max(functions.image_size), np.full(count, MAX_VARIANCE))


def spectral_density(frequency, sd, reach):
    """Variances (s,) of the coefficients of sines: Matern's covariance in two dimensions.

    frequency (s,) [1/px], sd [px], reach [px] (Rasmussen and Williams 2006, Eq. 4.15 for D = 2).
    """
    a = 2 * MATERN / reach**2
    return sd**2 * 4 * np.pi * MATERN * a**MATERN * (a + frequency**2) ** -(MATERN + 1)


def prior_precision(functions, prior):
    """Precision matrix (2m, 2m) of the coefficients of a series under a Prior."""
    m = len(functions)
    t = len(functions.powers)
    out = np.zeros((2 * m, 2 * m))
    if functions.modes:
        signal = 1 / np.maximum(
            spectral_density(functions.frequency, prior.sd, prior.reach), MIN_VARIANCE
        )
        for axis in (0, 1):
            at = axis * m + np.arange(t, m)
            out[at, at] = signal
    at = _trend_columns(functions)
    out[np.ix_(at, at)] = _trend_precision(functions, prior)
    return out


def _trend_columns(functions):
    m = len(functions)
    t = len(functions.powers)
    return np.concatenate([np.arange(t), m + np.arange(t)])


def _trend_precision(functions, prior):
    """Precision matrix of the polynomials' coefficients: variances of the terms, none for what the
    gauge holds.
    """
    to_terms, count = trend_transformation(functions.degree)
    return to_terms[:count].T @ (to_terms[:count] / prior.trend[:, None])


def gauge_precision(values, uv, interior, interior_held=False):
    """Precision matrix (2m, 2m) that keeps a series with values (n, m) of its functions at pixels
    uv (n, 2) orthogonal to the gauge there.
    """
    gauge = gauge_basis(uv, interior, interior_held)
    rows = np.concatenate([gauge[:, axis].T @ values for axis in (0, 1)], axis=1) / len(uv)
    return rows.T @ rows / GAUGE_SD_PX**2


def most_likely_prior(functions, information, right, gauge, prior):
    """A Prior with larger marginal likelihood than that given: signal, then trend; to be repeated
    until it stays.

    information (2m, 2m) and right side (2m,) of the coefficients, all other unknowns eliminated
    and without any prior; gauge (2m, 2m) its precision matrix.
    """
    if functions.modes:
        prior = _most_likely_signal(functions, information + gauge, right, prior)
    return _most_likely_trend(functions, information + gauge, right, prior)


def _most_likely_signal(functions, information, right, prior):
    """The Prior with sd and reach of the signal renewed."""
    side = max(functions.image_size)
    at = _trend_columns(functions)
    base = information.copy(order='F')
    base[np.ix_(at, at)] += _trend_precision(functions, prior)
    m = len(functions)
    t = len(functions.powers)
    signal = np.concatenate([np.arange(t, m), m + np.arange(t, m)])

    def cost(log):
        sd, reach = np.exp(log)
        if not (
            REACH_RANGE[0] * side <= reach <= REACH_RANGE[1] * side and MIN_SD_PX <= sd <= side
        ):
            return np.inf
        variance = np.tile(
            np.maximum(spectral_density(functions.frequency, sd, reach), MIN_VARIANCE), 2
        )
        matrix = base.copy(order='F')
        matrix[signal, signal] += 1 / variance
        factor, failed = lapack.dpotrf(matrix, lower=1, overwrite_a=1)
        if failed:
            return np.inf
        z = solve_triangular(factor, right, lower=True, check_finite=False)
        return np.sum(np.log(np.diagonal(factor))) + np.sum(np.log(variance)) / 2 - z @ z / 2

    start = np.log(
        [
            max(prior.sd, 2 * MIN_SD_PX),
            np.clip(prior.reach, 1.1 * REACH_RANGE[0] * side, 0.9 * REACH_RANGE[1] * side),
        ]
    )
    simplex = start + np.array([[0, 0], [0.4, 0], [0, 0.3]])
    found = minimize(
        cost,
        start,
        method='Nelder-Mead',
        options={'initial_simplex': simplex, 'xatol': 0.05, 'fatol': 0.05, 'maxfev': 40},
    )
    return replace(prior, sd=float(np.exp(found.x[0])), reach=float(np.exp(found.x[1])))


def _most_likely_trend(functions, information, right, prior):
    """The Prior with the variances of the trend terms renewed, one after the other."""
    to_terms, count = trend_transformation(functions.degree)
    if not count:
        return prior
    matrix, right = _trend_alone(functions, information, right, prior)
    back = np.linalg.inv(to_terms)
    matrix = back.T @ matrix @ back
    right = back.T @ right
    variance = prior.trend.copy()
    for _ in range(SWEEPS):
        for j in range(count):
            precision = np.concatenate([1 / variance, np.zeros(len(to_terms) - count)])
            precision[j] = 0
            # The term is estimated once without prior; beyond its own variance, its square is the
            # prior's.
            c = np.linalg.solve(
                matrix + np.diag(precision), np.stack([right, np.eye(len(right))[j]], axis=1)
            )
            variance[j] = np.clip(c[j, 0] ** 2 - c[j, 1], NOT_THERE * c[j, 1], MAX_VARIANCE)
    return replace(prior, trend=variance)


def _trend_alone(functions, information, right, prior):
    """Information and right side of the polynomials' coefficients with the signal eliminated."""
    at = _trend_columns(functions)
    rest = np.setdiff1d(np.arange(len(right)), at)
    if not len(rest):
        return information, right
    signal = information[np.ix_(rest, rest)].copy()
    signal[np.diag_indices(len(rest))] += 1 / np.tile(
        np.maximum(spectral_density(functions.frequency, prior.sd, prior.reach), MIN_VARIANCE), 2
    )
    mixed = information[np.ix_(rest, at)]
    solved = cho_solve(cho_factor(signal, lower=True), np.column_stack([mixed, right[rest]]))
    return information[np.ix_(at, at)] - mixed.T @ solved[:, :-1], right[at] - mixed.T @ solved[
        :, -1
    ]
