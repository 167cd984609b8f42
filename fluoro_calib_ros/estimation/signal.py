# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Covariance function of the signal of a distortion, and its estimation.

The signal is the sum of two random fields with covariance functions of Matern's family, the same
for u and v. A long field follows what bends over the image; a short field follows local ripples
that the long field, with one correlation length for all, would smooth away. Standard deviations,
correlation lengths and the smoothness of the long field maximise the marginal likelihood
(Rasmussen and Williams, "Gaussian Processes for Machine Learning", 2006, 5.4) with weak priors.
They are found by Fisher scoring: the slopes and the expected curvature of the likelihood follow
from the posterior means and variances of the coefficients (MacKay, "Bayesian interpolation",
Neural Computation 4, 1992).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack, solve_triangular
from scipy.special import j0

from ..correction.terms import ABSENT_VARIANCE
from .ripples import Ripples

# Smoothness nu of the long field: its range, and the median and the standard deviation of the
# prior of its logarithm. It determines how much of the signal the sines omit.
SMOOTHNESS_RANGE = (1.0, 4.0)
SMOOTHNESS = 3.0
SMOOTHNESS_SD = 0.5
FINE_SMOOTHNESS = 2.5
MIN_SD_PX = 1e-3  # least standard deviation of a field
# Ranges of the correlation lengths, relative to the longer side of the image.
REACH_RANGE = (0.02, 1.0)
FINE_RANGE = (0.012, 0.2)
# Prior of the short field: scale of the inverse of its correlation length, relative to the inverse
# extent of the sines, and scale of its standard deviation [px]. The densities are exponential
# (Fuglstad et al., "Constructing priors that penalize the complexity of Gaussian random fields",
# JASA 114, 2019), so that the field exists only where the observations need it.
FINE_PER_EXTENT = 15.0
FINE_PX = 0.5
# Initial correlation lengths of the long and the short field, relative to the image.
START_REACH = 0.15
START_FINE_REACH = 0.06
START_FINE_SHARE = 0.1  # initial standard deviation of the short field, relative to the long field
MAX_STEP = 0.8  # largest step of the logarithm of a standard deviation or length
STEPS = 4  # steps of Fisher scoring, and of the variances of ripples, in one update
MIN_DETERMINED = 1e-3  # least number of determined coefficients in a sum
# Quadrature over the parameters of the long field, which have these indices. NODE is the distance
# of the two nodes on an axis from the most likely value [standard deviations], for which the nodes
# of three axes have all the weight and the most likely value has none.
LONG_FIELD = [0, 1, 4]
NODE = np.sqrt(3)
NODE_TRIALS = 8  # most iterations for the distance of a node
NODE_TOLERANCE = 0.2  # tolerance of the logarithm of that distance
MIN_RATIO = 0.1  # least ratio of that distance to the previous distance
MIN_RISE = 1e-3  # least increase of the cost
AT_LIMIT = 0.1  # a parameter is fixed if this part of a step leads out of its range
# Largest step from the most likely logarithms. The likelihood is flat where the signal is lost in
# the noise. From 1.5 to 4, NSE of 0.9 to 2 change by 3 %; without distortion, 0.5 falls to 0.2.
FARTHEST = 2.5
# Number of frequencies of a quadrature, and ratio of the highest to the lowest.
QUADRATURE = 120
SHORTEST = 30.0
MIN_GAIN = 0.1  # gain of the logarithm of the likelihood that justifies another step
RIDGE = 0.05  # least damping, added to the expected curvature; fixes parameters of little effect


@dataclass(frozen=True)
class Signal:
    """Standard deviations [px] and correlation lengths [px] of the long and the short field.

    smoothness: nu of the long field. ripples: additional variances of the sines of some bands;
    they are not part of the fields.
    """

    sd: float
    reach: float
    fine_sd: float = 0.0
    fine_reach: float = 1.0
    smoothness: float = SMOOTHNESS
    ripples: Ripples | None = None

    @property
    def fields(self) -> tuple[tuple[float, float, float], ...]:
        """Standard deviation, correlation length and smoothness of each field."""
        long_field = (self.sd, self.reach, self.smoothness)
        fine = (self.fine_sd, self.fine_reach, FINE_SMOOTHNESS)
        return (long_field, fine) if self.fine_sd else (long_field,)

    def density(self, frequency: np.ndarray) -> NDArray[np.float64]:
        """Return the variances (s,) of the coefficients by the fields alone."""
        return np.sum([spectral_density(frequency, *field) for field in self.fields], axis=0)

    def variance(self, frequency: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return prior variances (s,) of the coefficients of sines of frequency (s,) [1/px]."""
        return np.maximum(self.density(frequency) + self.of_ripples(frequency), ABSENT_VARIANCE)

    def of_ripples(self, frequency: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the parts (s,) of these variances that are due to the ripples."""
        if self.ripples is None:
            return np.zeros_like(frequency)
        return self.ripples.variance(frequency)

    def sd_beyond(self, frequency: float) -> float:
        """Return the standard deviation [px] of the signal with larger frequencies [1/px].

        It is the integral of the spectral density of the fields over the plane outside a circle.
        All sines of ripples are in the series.
        """
        variance = 0.0
        for sd, reach, nu in self.fields:
            a = 2 * nu / reach**2
            variance += sd**2 * (a / (a + frequency**2)) ** nu
        return float(np.sqrt(variance))

    def correlation_beyond(
        self, frequency: float, distance: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the correlation (n,) of that part at distances (n,) [px]: its Hankel transform.

        Ripples shorter than the distance of image points hardly show in products of neighbours.
        """
        return correlation_of(self.density, frequency, distance)

    def without_short_field(self, side: float) -> Signal:
        """Return a signal with a very small new short field; side: of the image [px]."""
        return replace(self, fine_sd=MIN_SD_PX, fine_reach=START_FINE_REACH * side)

    def change(self, other: Signal, frequency: NDArray[np.float64]) -> float:
        """Return the mean change of the log variances at frequency (s,) from another signal."""
        ratio = self.variance(frequency) / other.variance(frequency)
        return float(np.mean(np.abs(np.log(ratio))))


def correlation_of(
    density: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    lowest: float,
    distance: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the correlation (n,) at distances (n,) [px] of a field, by a Hankel transform.

    density: spectral density at frequencies [1/px], from the lowest on.
    """
    f = lowest * np.geomspace(1, SHORTEST, QUADRATURE)
    weight = density(f) * f**2  # f df on a geometric grid
    return j0(np.outer(distance, f)) @ weight / np.sum(weight)


def spectral_density(
    frequency: NDArray[np.float64], sd: float, reach: float, nu: float = SMOOTHNESS
) -> NDArray[np.float64]:
    """Return variances (s,) of coefficients of sines, for Matern's covariance in two dimensions.

    frequency (s,) [1/px]; sd, reach [px]; nu: smoothness (Rasmussen and Williams 2006, Eq. 4.15
    for D = 2).
    """
    a = 2 * nu / reach**2
    return sd**2 * 4 * np.pi * nu / a * (a / (a + frequency**2)) ** (nu + 1)


def starting_signal(sd: float, side: float) -> Signal:
    """Return an initial signal; sd: standard deviation of the long field, side [px]."""
    return Signal(sd, START_REACH * side, START_FINE_SHARE * sd, START_FINE_REACH * side)


def _parameters(signal: Signal) -> NDArray[np.float64]:
    """Return the logarithms (5,) of the parameters of a signal."""
    fine = [signal.fine_sd, signal.fine_reach]
    return np.log([signal.sd, signal.reach, *fine, signal.smoothness])


def _slopes(signal: Signal, frequency: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return derivatives (s, 5) of the log variances by the logarithms of the parameters."""
    out = []
    for sd, reach, nu in signal.fields:
        a = 2 * nu / reach**2
        density = spectral_density(frequency, sd, reach, nu)
        part = a / (a + frequency**2)
        by_reach = 2 * (nu + 1) * part - 2 * nu
        by_smoothness = 1 + nu + nu * np.log(part) - (nu + 1) * part
        out += [2 * density, by_reach * density, by_smoothness * density]
    long_slopes, fine_slopes = out[:3], out[3:]
    columns = [*long_slopes[:2], *fine_slopes[:2], long_slopes[2]]
    return np.stack(columns, axis=1) / signal.variance(frequency)[:, None]


@dataclass(frozen=True)
class SignalEquations:
    """Normal equations of all coefficients of a series, with all priors except the signal's.

    They have d = 1 right side and the c = 2 s coefficients of u and v, or d = 2 right sides, of u
    and of v, and the c = s coefficients of either, if u and v have the same matrix.
    """

    frequency: NDArray[np.float64]  #: (s,) frequencies of the sines [1/px]
    information: NDArray[np.float64]  #: (p, p)
    right: NDArray[np.float64]  #: (p, d)
    columns: NDArray[np.int64]  #: (c,) indices of the coefficients of the sines, u first

    @property
    def extent(self) -> float:
        """Size of the rectangle of the sines [px]."""
        return float(np.pi / self.frequency.min())

    def of_columns(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return values (s, ...) of the sines for all of their coefficients (c, ...)."""
        return np.concatenate([values] * (len(self.columns) // len(self.frequency)))

    def of_sines(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return sums (s,) over u and v of values (c, d) of the coefficients."""
        return values.sum(axis=1).reshape(-1, len(self.frequency)).sum(axis=0)


@dataclass(frozen=True)
class _Likelihood:
    """Marginal likelihood of a signal, with the priors of its parameters.

    cost: negative logarithm, without constants; slopes (5,) and curvature (5, 5): by the
    logarithms of the parameters.
    """

    cost: float
    slopes: NDArray[np.float64]
    curvature: NDArray[np.float64]


def most_likely_signal(signal: Signal, coefficients: SignalEquations, side: float) -> Signal:
    """Return a signal with a larger marginal likelihood; side: longer side of the image [px]."""
    updated = _more_likely(signal, coefficients, side)
    if updated.ripples is not None:
        updated = _with_likely_ripples(updated, updated.ripples, coefficients)
    return updated


def _more_likely(signal: Signal, coefficients: SignalEquations, side: float) -> Signal:
    """Return the signal after some steps of Fisher scoring."""
    low, high = _ranges(side)
    point = np.clip(_parameters(signal), low, high)
    current = _likelihood(point, coefficients, ripples=signal.ripples)
    if current is None:
        return signal
    damping = RIDGE
    for _ in range(STEPS):
        step = np.linalg.solve(current.curvature + damping * np.eye(len(point)), -current.slopes)
        step = step / max(1.0, np.max(np.abs(step)) / MAX_STEP)
        trial = np.clip(point + step, low, high)
        proposed = _likelihood(trial, coefficients, current.cost, signal.ripples)
        if proposed is None or proposed.cost > current.cost:
            damping *= 30
            continue
        gain = current.cost - proposed.cost
        point = trial
        current = proposed
        damping = max(RIDGE, damping / 10)
        if gain < MIN_GAIN:
            break
    return _signal(point, signal.ripples)


def plausible_signals(signal: Signal, coefficients: SignalEquations, side: float) -> list[Signal]:
    """Return signals of which any may be the true signal, all with the same weight.

    A mean over them approximates the mean over the posterior of the parameters of the long field
    (3-point Gauss-Hermite quadrature along the principal axes of its curvature). The posterior is
    skewed; in each direction it is scaled by its own decrease (Rue, Martino and Chopin,
    "Approximate Bayesian inference for latent Gaussian models", JRSS B 71, 2009, 6.5).

    signal: the most likely signal; side: longer side of the image [px]. Returns an empty list if
    there is no posterior.
    """
    likelihood = _likelihood(_parameters(signal), coefficients, ripples=signal.ripples)
    if likelihood is None:
        return []
    values, vectors = np.linalg.eigh(likelihood.curvature[np.ix_(LONG_FIELD, LONG_FIELD)])
    out = []
    for value, vector in zip(values, vectors.T):
        step = np.zeros(len(likelihood.slopes))
        step[LONG_FIELD] = vector * min(NODE / np.sqrt(max(value, RIDGE**2)), FARTHEST)
        for direction in (step, -step):
            out.append(_node(signal, direction, coefficients, likelihood.cost, side))
    return out


def _node(
    signal: Signal,
    step: NDArray[np.float64],
    coefficients: SignalEquations,
    cost: float,
    side: float,
) -> Signal:
    """Return the signal along a step (5,) that is as likely as a node of a normal distribution.

    cost: cost of the most likely signal.
    """
    point = _parameters(signal)
    low, high = _ranges(side)
    ahead = point + AT_LIMIT * step
    step = np.where((ahead > high) | (ahead < low), 0.0, step)
    if not step.any():
        return signal
    room = np.where(step > 0, high - point, low - point)[step != 0] / step[step != 0]
    farthest = np.min([*room, FARTHEST / np.max(np.abs(step))])
    scale = min(1.0, farthest)
    node, closest = signal, np.inf
    nearest, furthest = 0.0, np.inf  # scales between which the node is
    for _ in range(NODE_TRIALS):
        tried = _signal(point + scale * step, signal.ripples)
        rise = max(_cost(tried, coefficients) - cost, MIN_RISE)
        ratio = NODE / np.sqrt(2 * rise)  # zero if there is no likelihood
        off = abs(float(np.log(max(ratio, np.finfo(float).tiny))))
        if off < closest:
            node, closest = tried, off
        if closest < NODE_TOLERANCE or (ratio > 1 and scale == farthest):
            break
        nearest, furthest = (scale, furthest) if ratio > 1 else (nearest, scale)
        ahead = min(scale * max(ratio, MIN_RATIO), farthest)
        inside = nearest < ahead < furthest
        scale = ahead if inside else float(np.sqrt(nearest * furthest))
    return node


def _cost(signal: Signal, coefficients: SignalEquations) -> float:
    """Return the cost of the likelihood of a signal; infinite if there is no likelihood."""
    variance = coefficients.of_columns(signal.variance(coefficients.frequency))
    factorised = _factorised(variance, coefficients)
    if factorised is None:
        return np.inf
    return factorised.cost + _cost_of_priors(_parameters(signal), coefficients.extent)


def _signal(at: NDArray[np.float64], ripples: Ripples | None) -> Signal:
    """Return the signal with these logarithms (5,) of its parameters."""
    sd, reach, fine_sd, fine_reach, smoothness = (float(value) for value in np.exp(at))
    return Signal(
        sd, reach, fine_sd=fine_sd, fine_reach=fine_reach, smoothness=smoothness, ripples=ripples
    )


def _with_likely_ripples(
    signal: Signal, ripples: Ripples, coefficients: SignalEquations
) -> Signal:
    """Return the signal with ripples of a larger marginal likelihood (MacKay 1992).

    The variance of a band is the square sum of its coefficients over the number of coefficients
    that the observations determine.
    """
    frequency = coefficients.frequency
    band = ripples.band(frequency)
    for _ in range(STEPS):
        variance = signal.variance(frequency)
        posterior = _posterior(coefficients.of_columns(variance), coefficients)
        if posterior is None:
            return signal
        squares = coefficients.of_sines(posterior.mean**2)
        left = coefficients.of_sines(np.broadcast_to(posterior.variance, posterior.mean.shape))
        determined = np.clip(2 - left / variance, MIN_DETERMINED, 2)
        count = len(ripples.variances)
        sums = [np.bincount(band, a, count)[:count] for a in (squares, determined)]
        fields = signal.density(np.arange(count) * ripples.width)
        values = np.maximum(
            sums[0] / np.maximum(sums[1], MIN_DETERMINED) - fields, ABSENT_VARIANCE
        )
        ripples = ripples.with_variances(values)
        signal = replace(signal, ripples=ripples)
    return signal


def _ranges(side: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return least and largest logarithms (5,) of the parameters; side: of the image [px]."""
    return (
        np.log(
            [
                MIN_SD_PX,
                REACH_RANGE[0] * side,
                MIN_SD_PX,
                FINE_RANGE[0] * side,
                SMOOTHNESS_RANGE[0],
            ]
        ),
        np.log([side, REACH_RANGE[1] * side, side, FINE_RANGE[1] * side, SMOOTHNESS_RANGE[1]]),
    )


@dataclass(frozen=True)
class _Posterior:
    """Posterior of the coefficients of the sines.

    cost: negative logarithm of the marginal likelihood, without constants.
    """

    cost: float
    mean: NDArray[np.float64]  #: (c, d)
    variance: NDArray[np.float64]  #: (c, 1)


@dataclass(frozen=True)
class _Factorised:
    """Normal equations with a prior.

    cost: as in `_Posterior`; factor (p, p): lower triangular; z (p, d): solution with it alone.
    """

    cost: float
    factor: NDArray[np.float64]
    z: NDArray[np.float64]


def _factorised(
    variance: NDArray[np.float64], coefficients: SignalEquations
) -> _Factorised | None:
    """Return the equations for prior variances (c,), or None if they have no solution."""
    columns = coefficients.columns
    matrix = coefficients.information.copy(order='F')
    matrix[columns, columns] += 1 / variance
    factor, info = lapack.dpotrf(matrix, lower=1, overwrite_a=1)
    if info:
        return None
    z = solve_triangular(factor, coefficients.right, lower=True, check_finite=False)
    log_det = np.sum(np.log(np.diagonal(factor))) + np.sum(np.log(variance)) / 2
    cost = z.shape[1] * log_det - np.sum(z**2) / 2
    return _Factorised(float(cost), factor, z) if np.isfinite(cost) else None


def _posterior(
    variance: NDArray[np.float64], coefficients: SignalEquations, limit: float = np.inf
) -> _Posterior | None:
    """Return the posterior for prior variances (c,).

    None if there is no posterior, or its cost exceeds the limit.
    """
    factorised = _factorised(variance, coefficients)
    if factorised is None or factorised.cost > limit:
        return None
    columns = coefficients.columns
    mean = solve_triangular(
        factorised.factor, factorised.z, trans='T', lower=True, check_finite=False
    )
    inverse, info = lapack.dtrtri(factorised.factor, lower=1, overwrite_c=1)
    if info:
        return None
    # Columns are contiguous, and zero above the diagonal.
    squares = np.sum(np.square(inverse, out=inverse), axis=0)
    return _Posterior(factorised.cost, mean[columns], squares[columns, None])


def _likelihood(
    at: NDArray[np.float64],
    coefficients: SignalEquations,
    limit: float = np.inf,
    ripples: Ripples | None = None,
) -> _Likelihood | None:
    """Return the likelihood at logarithms (5,) of the parameters, with given ripples.

    None if there is no likelihood, or its cost exceeds the limit.
    """
    signal = _signal(at, ripples)
    frequency = coefficients.frequency
    variance = signal.variance(frequency)
    of_columns = coefficients.of_columns(variance)
    posterior = _posterior(
        of_columns, coefficients, limit - _cost_of_priors(at, coefficients.extent)
    )
    if posterior is None:
        return None
    slopes = _slopes(signal, frequency)
    squares = coefficients.of_sines(posterior.mean**2 + posterior.variance)
    determined = np.clip(1 - posterior.variance / of_columns[:, None], 0, 1)
    determined = np.broadcast_to(determined**2, posterior.mean.shape)
    likelihood = _Likelihood(
        posterior.cost,
        slopes.T @ (2 - squares / variance) / 2,
        (slopes * coefficients.of_sines(determined)[:, None]).T @ slopes / 2,
    )
    return _with_priors(likelihood, at, coefficients.extent)


def _with_priors(likelihood: _Likelihood, at: NDArray[np.float64], extent: float) -> _Likelihood:
    """Return the posterior of logarithms (5,) of the parameters; extent: of the sines [px]."""
    large, short, rough = _parts_of_priors(at, extent)
    return _Likelihood(
        likelihood.cost + _cost_of_priors(at, extent),
        likelihood.slopes + [-1, 0, large, -short, rough / SMOOTHNESS_SD],
        likelihood.curvature + np.diag([0, 0, large, short, SMOOTHNESS_SD**-2]),
    )


def _cost_of_priors(at: NDArray[np.float64], extent: float) -> float:
    """Return the negative logarithm of the prior density of logarithms (5,) of the parameters.

    The density of the standard deviation of the long field grows with it (Chung et al., "A
    nondegenerate penalized likelihood estimator for variance parameters in multilevel models",
    Psychometrika 78, 2013). Without that, the likelihood of few image points is often largest at
    zero, which would claim that no signal is left.
    """
    large, short, rough = _parts_of_priors(at, extent)
    return large + short + rough**2 / 2 - float(at[0])


def _parts_of_priors(at: NDArray[np.float64], extent: float) -> tuple[float, float, float]:
    """Return scaled size and shortness of the short field, and smoothness of the long field."""
    _, _, fine_sd, fine_reach, smoothness = (float(value) for value in at)
    large = np.exp(fine_sd) / FINE_PX
    short = extent / np.exp(fine_reach) / FINE_PER_EXTENT
    return large, short, (smoothness - np.log(SMOOTHNESS)) / SMOOTHNESS_SD
