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

"""Covariance function of the signal of a distortion, and its estimation.

The signal is the sum of two random fields with covariance functions of Matern's family, nu = 5/2,
the same for u and v: a long one for what bends over the image, a short one for the local ripples
that the first, with one correlation length for all, would smooth away. Their standard deviations
and correlation lengths are those of the largest marginal likelihood (Rasmussen and Williams,
"Gaussian Processes for Machine Learning", 2006, 5.4), found by Fisher scoring: the slopes and
the expected curvature of the likelihood follow from the posterior means and variances of the
coefficients (MacKay, "Bayesian interpolation", Neural Computation 4, 1992).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack, solve_triangular
from scipy.special import j0

MATERN = 2.5
MIN_VARIANCE = 1e-10  # of a coefficient of the signal: an amplitude of 1e-8 px
MIN_SD_PX = 1e-3  # of a field
# Ranges of the correlation lengths relative to the longer side of the image.
REACH_RANGE = (0.02, 1.0)
FINE_RANGE = (0.012, 0.2)
START_REACH = 0.15
START_FINE_REACH = 0.06
START_FINE_SHARE = 0.1  # of the standard deviation of the long field
RIPPLES_PX = 0.2  # standard deviation of ripples that residuals show, to start with
RIPPLES_REACH = 0.03
MAX_STEP = 0.8  # of the logarithm of a standard deviation or length
STEPS = 4  # of the likelihood in one renewal
# Frequencies of a quadrature, from the lowest to so many times it.
QUADRATURE = 120
SHORTEST = 30.0
MIN_GAIN = 0.1  # of the logarithm of the likelihood that is worth another step
RIDGE = 0.05  # least damping: added to the expected curvature, it keeps what hardly matters


@dataclass(frozen=True)
class Signal:
    """Standard deviations [px] and correlation lengths [px] of the long and the short field."""

    sd: float
    reach: float
    fine_sd: float = 0.0
    fine_reach: float = 1.0

    def variance(self, frequency: np.ndarray) -> np.ndarray:
        """Prior variances (s,) of the coefficients of sines of frequency (s,) [1/px]."""
        out = spectral_density(frequency, self.sd, self.reach)
        if self.fine_sd:
            out = out + spectral_density(frequency, self.fine_sd, self.fine_reach)
        return np.maximum(out, MIN_VARIANCE)

    def sd_beyond(self, frequency: float) -> float:
        """Standard deviation [px] of the part of the signal with larger frequencies [1/px].

        It is the integral of the spectral density over the plane outside of a circle.
        """
        variance = 0.0
        for sd, reach in ((self.sd, self.reach), (self.fine_sd, self.fine_reach)):
            a = 2 * MATERN / reach**2
            variance += sd**2 * (a / (a + frequency**2)) ** MATERN
        return float(np.sqrt(variance))

    def correlation_beyond(self, frequency: float, distance: np.ndarray) -> np.ndarray:
        """Correlation (n,) of that part at distances (n,) [px]: its Hankel transform.

        Ripples shorter than the distance of image points hardly show in products of neighbours.
        """
        f = frequency * np.geomspace(1, SHORTEST, QUADRATURE)
        density = spectral_density(f, self.sd, self.reach)
        if self.fine_sd:
            density = density + spectral_density(f, self.fine_sd, self.fine_reach)
        weight = density * f**2  # f df on a geometric grid
        return j0(np.outer(distance, f)) @ weight / np.sum(weight)

    def with_ripples(self, side: float) -> Signal:
        """Return a signal with a short field to start with; side: of the image [px]."""
        return Signal(self.sd, self.reach, RIPPLES_PX, RIPPLES_REACH * side)

    def change(self, other: Signal, frequency: np.ndarray) -> float:
        """Mean change of the logarithms of the variances at frequency (s,) from another signal."""
        ratio = self.variance(frequency) / other.variance(frequency)
        return float(np.mean(np.abs(np.log(ratio))))


def spectral_density(frequency: np.ndarray, sd: float, reach: float) -> np.ndarray:
    """Variances (s,) of the coefficients of sines: Matern's covariance in two dimensions.

    frequency (s,) [1/px]; sd, reach [px] (Rasmussen and Williams 2006, Eq. 4.15 for D = 2).
    """
    a = 2 * MATERN / reach**2
    return sd**2 * 4 * np.pi * MATERN * a**MATERN * (a + frequency**2) ** -(MATERN + 1)


def starting_signal(sd: float, side: float) -> Signal:
    """Return a signal to start with; sd: standard deviation of the long field, side [px]."""
    return Signal(sd, START_REACH * side, START_FINE_SHARE * sd, START_FINE_REACH * side)


def _slopes(signal: Signal, frequency: np.ndarray) -> np.ndarray:
    """Derivatives (s, 4) of the logarithms of the variances by those of the parameters."""
    parts = []
    for sd, reach in ((signal.sd, signal.reach), (signal.fine_sd, signal.fine_reach)):
        a = 2 * MATERN / reach**2
        density = spectral_density(frequency, sd, reach)
        by_reach = -2 * MATERN + 2 * (MATERN + 1) * a / (a + frequency**2)
        parts += [2 * density, by_reach * density]
    return np.stack(parts, axis=1) / signal.variance(frequency)[:, None]


@dataclass(frozen=True)
class _Likelihood:
    """Marginal likelihood of a signal.

    cost: its negative logarithm, without constants; slopes (4,) and curvature (4, 4) by the
    logarithms of the parameters.
    """

    cost: float
    slopes: np.ndarray
    curvature: np.ndarray


def most_likely_signal(
    signal: Signal,
    frequency: np.ndarray,
    information: np.ndarray,
    right: np.ndarray,
    columns: np.ndarray,
    side: float,
) -> Signal:
    """Return a signal with a larger marginal likelihood.

    Parameters
    ----------
    signal : Signal
        Present one.
    frequency : (s,) ndarray
        Frequencies of the sines [1/px].
    information, right : (p, p) and (p,) ndarray
        Normal equations of all coefficients, with every prior but that of the signal.
    columns : (2 s,) ndarray of int
        Places of the coefficients of the sines, those of u first.
    side : float
        Longer side of the image [px].

    Returns
    -------
    Signal
    """
    low = np.log([MIN_SD_PX, REACH_RANGE[0] * side, MIN_SD_PX, FINE_RANGE[0] * side])
    high = np.log([side, REACH_RANGE[1] * side, side, FINE_RANGE[1] * side])
    at = np.clip(np.log([signal.sd, signal.reach, signal.fine_sd, signal.fine_reach]), low, high)
    here = _likelihood(at, frequency, information, right, columns)
    if here is None:
        return signal
    damping = RIDGE
    for _ in range(STEPS):
        step = np.linalg.solve(here.curvature + damping * np.eye(4), -here.slopes)
        step = step / max(1.0, np.max(np.abs(step)) / MAX_STEP)
        trial = np.clip(at + step, low, high)
        there = _likelihood(trial, frequency, information, right, columns)
        if there is None or there.cost > here.cost:
            damping *= 30
            continue
        gain = here.cost - there.cost
        at = trial
        here = there
        damping = max(RIDGE, damping / 10)
        if gain < MIN_GAIN:
            break
    return Signal(*(float(value) for value in np.exp(at)))


def _likelihood(
    at: np.ndarray,
    frequency: np.ndarray,
    information: np.ndarray,
    right: np.ndarray,
    columns: np.ndarray,
) -> _Likelihood | None:
    """Return the likelihood at logarithms (4,) of the parameters; None where it has none."""
    signal = Signal(*np.exp(at))
    variance = np.tile(signal.variance(frequency), 2)
    matrix = information.copy(order='F')
    matrix[columns, columns] += 1 / variance
    factor, failed = lapack.dpotrf(matrix, lower=1, overwrite_a=1)
    if failed:
        return None
    z = solve_triangular(factor, right, lower=True, check_finite=False)
    cost = np.sum(np.log(np.diagonal(factor))) + np.sum(np.log(variance)) / 2 - z @ z / 2
    inverse, failed = lapack.dtrtri(factor, lower=1)
    if failed or not np.isfinite(cost):
        return None
    inverse = np.tril(inverse)
    mean = (z @ inverse)[columns]
    square = np.einsum('ij,ij->j', inverse, inverse)[columns]  # posterior variances
    slopes = np.tile(_slopes(signal, frequency), (2, 1))
    determined = np.clip(1 - square / variance, 0, 1)
    return _Likelihood(
        float(cost),
        slopes.T @ (1 - (mean**2 + square) / variance) / 2,
        (slopes * (determined**2)[:, None]).T @ slopes / 2,
    )
