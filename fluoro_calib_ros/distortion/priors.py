"""Prior distributions of the coefficients of a distortion's trend and signal.

Least-squares collocation (Moritz, "Advanced Physical Geodesy", 1980): the signal is a random field
with a covariance function, here of Matern's family with nu = 5/2, the same for u and v. Its
standard deviation and correlation length, and for each term of the trend whether it exists, are
estimated from the observations themselves by their marginal likelihood (Rasmussen and Williams,
"Gaussian Processes for Machine Learning", 2006, 5.4; for the trend Tipping and Faul, "Fast
marginal likelihood maximisation for sparse Bayesian models", 2003).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve, lapack, solve_triangular
from scipy.optimize import minimize

from .gauge import gauge_basis
from .series import Functions
from .terms import trend_transformation

MATERN = 2.5
# Standard deviation to which the gauge is held; a much smaller one would damp the steps of the
# adjustment.
GAUGE_SD_PX = 3e-5
MIN_VARIANCE = 1e-10  # of a coefficient of the signal: an amplitude of 1e-8 px
# Prior variance of a trend term that does not exist, relative to that with which it is determined.
MIN_RELATIVE_VARIANCE = 1e-3
MAX_VARIANCE = 1e8  # of a trend term that exists
REACH_RANGE = (0.02, 1.0)  # correlation length relative to the longer side of the image
MIN_SD_PX = 1e-3  # of the signal
SWEEPS = 3  # over the terms of the trend


@dataclass(frozen=True)
class Prior:
    """Prior of a distortion.

    sd: standard deviation of the signal [px]; reach: its correlation length [px]; trend (t,):
    variances of the trend terms [px^2].
    """

    sd: float
    reach: float
    trend: np.ndarray


def starting_prior(functions: Functions, sd: float) -> Prior:
    """Return a prior to start with; sd: RMS residual without correction [px]."""
    _, count = trend_transformation(functions.degree)
    return Prior(0.3 * sd, 0.15 * max(functions.image_size), np.full(count, MAX_VARIANCE))


def spectral_density(frequency: np.ndarray, sd: float, reach: float) -> np.ndarray:
    """Variances (s,) of the coefficients of sines: Matern's covariance in two dimensions.

    frequency (s,) [1/px]; sd, reach [px] (Rasmussen and Williams 2006, Eq. 4.15 for D = 2).
    """
    a = 2 * MATERN / reach**2
    return sd**2 * 4 * np.pi * MATERN * a**MATERN * (a + frequency**2) ** -(MATERN + 1)


def prior_precision(functions: Functions, prior: Prior) -> np.ndarray:
    """Precision matrix (2m, 2m) of the coefficients of a series."""
    m = len(functions)
    t = len(functions.powers)
    out = np.zeros((2 * m, 2 * m))
    if functions.modes:
        signal = 1 / _signal_variance(functions, prior.sd, prior.reach)
        for axis in (0, 1):
            at = axis * m + np.arange(t, m)
            out[at, at] = signal
    at = _trend_columns(functions)
    out[np.ix_(at, at)] = _trend_precision(functions, prior)
    return out


def _signal_variance(functions: Functions, sd: float, reach: float) -> np.ndarray:
    """Prior variances (s,) of the coefficients of the sines."""
    return np.maximum(spectral_density(functions.frequency, sd, reach), MIN_VARIANCE)


def _trend_columns(functions: Functions) -> np.ndarray:
    """Places of the coefficients of the polynomials, those of u first."""
    m = len(functions)
    t = len(functions.powers)
    return np.concatenate([np.arange(t), m + np.arange(t)])


def _trend_precision(functions: Functions, prior: Prior) -> np.ndarray:
    """Precision matrix of the coefficients of the polynomials; zero for what the gauge holds."""
    to_terms, count = trend_transformation(functions.degree)
    return to_terms[:count].T @ (to_terms[:count] / prior.trend[:, None])


def gauge_precision(
    values: np.ndarray, uv: np.ndarray, interior: np.ndarray, interior_held: bool = False
) -> np.ndarray:
    """Precision matrix that keeps a series orthogonal to the gauge at image points.

    Parameters
    ----------
    values : (n, m) ndarray
        Functions of the series at the image points.
    uv : (n, 2) ndarray
        Image points [px].
    interior : (3,) ndarray
        xp, yp, c [px].
    interior_held : bool
        True where the interior orientation is not estimated.

    Returns
    -------
    (2m, 2m) ndarray
    """
    gauge = gauge_basis(uv, interior, interior_held)
    rows = np.concatenate([gauge[:, axis].T @ values for axis in (0, 1)], axis=1) / len(uv)
    return rows.T @ rows / GAUGE_SD_PX**2


def most_likely_prior(
    functions: Functions,
    information: np.ndarray,
    right: np.ndarray,
    gauge: np.ndarray,
    prior: Prior,
) -> Prior:
    """Return a prior with a larger marginal likelihood: signal first, then trend.

    It is to be repeated until the prior does not change.

    Parameters
    ----------
    functions : Functions
    information, right : (2m, 2m) and (2m,) ndarray
        Normal equations of the coefficients without a prior, all other unknowns eliminated.
    gauge : (2m, 2m) ndarray
        Precision matrix of the gauge.
    prior : Prior
        Present prior.

    Returns
    -------
    Prior
    """
    if functions.modes:
        prior = _most_likely_signal(functions, information + gauge, right, prior)
    return _most_likely_trend(functions, information + gauge, right, prior)


def _most_likely_signal(
    functions: Functions, information: np.ndarray, right: np.ndarray, prior: Prior
) -> Prior:
    """Return the prior with renewed standard deviation and correlation length of the signal."""
    side = max(functions.image_size)
    at = _trend_columns(functions)
    base = information.copy(order='F')
    base[np.ix_(at, at)] += _trend_precision(functions, prior)
    m = len(functions)
    t = len(functions.powers)
    signal = np.concatenate([np.arange(t, m), m + np.arange(t, m)])

    def cost(log: np.ndarray) -> float:
        sd, reach = np.exp(log)
        if not (
            REACH_RANGE[0] * side <= reach <= REACH_RANGE[1] * side and MIN_SD_PX <= sd <= side
        ):
            return np.inf
        variance = np.tile(_signal_variance(functions, sd, reach), 2)
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


def _most_likely_trend(
    functions: Functions, information: np.ndarray, right: np.ndarray, prior: Prior
) -> Prior:
    """Return the prior with renewed variances of the trend terms, one after the other."""
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
            # The term is estimated without its prior; its square exceeds its own variance by that
            # of the prior.
            c = np.linalg.solve(
                matrix + np.diag(precision), np.stack([right, np.eye(len(right))[j]], axis=1)
            )
            variance[j] = np.clip(
                c[j, 0] ** 2 - c[j, 1], MIN_RELATIVE_VARIANCE * c[j, 1], MAX_VARIANCE
            )
    return replace(prior, trend=variance)


def _trend_alone(
    functions: Functions, information: np.ndarray, right: np.ndarray, prior: Prior
) -> tuple[np.ndarray, np.ndarray]:
    """Information and right side of the coefficients of the polynomials, the signal eliminated."""
    at = _trend_columns(functions)
    rest = np.setdiff1d(np.arange(len(right)), at)
    if not len(rest):
        return information, right
    signal = information[np.ix_(rest, rest)].copy()
    signal[np.diag_indices(len(rest))] += 1 / np.tile(
        _signal_variance(functions, prior.sd, prior.reach), 2
    )
    mixed = information[np.ix_(rest, at)]
    solved = cho_solve(cho_factor(signal, lower=True), np.column_stack([mixed, right[rest]]))
    reduced = information[np.ix_(at, at)] - mixed.T @ solved[:, :-1]
    return reduced, right[at] - mixed.T @ solved[:, -1]
