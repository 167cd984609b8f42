# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Noise models of image points: Student-t, Huber and Gaussian, with estimation of their scale.

An image point has D = 2 coordinates with a common scale. q = r^T r / (scale * sigma)^2 is its
normalised squared residual. In addition to the core of the distribution, a share of gross errors
(false matches) can be estimated, spread evenly over a wide area. If they are left to the tails of
the Student-t instead, they make the tails heavy, and good image points are no longer used
efficiently. Sources: Lange, Little and Taylor, "Robust statistical modeling using the t
distribution", JASA 1989 (weights, information); Liu and Rubin, "ML estimation of the t
distribution using EM and its extensions, ECM and ECME", Statistica Sinica 1995 (scale and degrees
of freedom); Fraley and Raftery, "Model-based clustering, discriminant analysis, and density
estimation", JASA 2002, 3.1 (uniform background); Huber, "Robust Statistics", Wiley 1981.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize_scalar
from scipy.special import ndtri

# Scatter of normalised errors beyond their stated standard deviations, for limits of gross errors.
#
# A limit in standard deviations rejects true observations if these are stated too small. The scale
# of the errors is therefore observed robustly: it is the median of the errors within the limit,
# over the median of the stated distribution. The limit follows the scale until it is steady, from
# the stated scale upwards, so that gross errors beyond it do not count (trimmed scale by
# iteration: Rousseeuw and Leroy, "Robust Regression and Outlier Detection", 1987, 5.1). Only an
# excess over chance widens a limit: if the errors are as stated, the factor is 1.

# Standard deviations that chance seldom exceeds in a single comparison, and that it hardly ever
# exceeds (6 in 100,000) in a comparison that accuses, excludes, or is made many times.
SURE = 3.0
CERTAIN = 4.0
NORMAL_MEDIAN = float(ndtri(0.75))  # median of the absolute value of a standard normal variable
# Relative standard deviation of the median of n absolute normal errors, times the root of n:
# 1 / (2 f(m) m) with the density f at the median m. For lengths of two-coordinate errors it is
# 0.72, but tails can be heavy.
MEDIAN_SD = np.sqrt(2 * np.pi) * np.exp(NORMAL_MEDIAN**2 / 2) / (4 * NORMAL_MEDIAN)
MAX_WIDENING = 2.0  # a larger factor has another cause than the stated standard deviations
MIN_ERRORS = 12  # fewer errors determine no scale
WINDOW = 2000  # number of latest errors of a recording to use
RENEWED = 0.1  # part of these errors after which the factor is computed again


def trimmed_scale(size: NDArray[np.float64], limit: float) -> tuple[float, int]:
    """Return the scale, at least 1, of the errors that are not gross, and their number.

    size, limit: as in `widening`. With fewer than MIN_ERRORS such errors, returns 1 and 0.
    """
    size = size[np.isfinite(size)]
    scale = 1.0
    count = 0
    while True:
        inside = size[size <= limit * scale]
        if len(inside) < MIN_ERRORS:
            return 1.0, 0
        if len(inside) <= count:  # the number never decreases
            return scale, count
        count = len(inside)
        scale = max(1.0, float(np.median(inside)))


def widening(size: NDArray[np.float64], limit: float, common: float = 0.0) -> float:
    """Return the factor, at least 1, by which errors scatter more than stated and than by chance.

    size: (n,) absolute errors over their expected median. limit: size beyond which an error is
    gross. common: part of the stated variance that is common to all errors; it may be far off in
    all of them, and still be as stated.
    """
    scale, count = trimmed_scale(size, limit)
    if not count:
        return 1.0
    chance = (1 - common) * (1 + SURE * MEDIAN_SD / np.sqrt(count)) ** 2 + common * SURE**2
    return float(np.clip(scale / np.sqrt(chance), 1.0, MAX_WIDENING))


def widening_by_group(
    size: NDArray[np.float64], limit: float, group: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the factors (n,) of errors (n,) by group (n,), such as an exposure."""
    out = np.ones(len(size))
    order = np.argsort(group, kind='stable')
    starts = np.flatnonzero(np.diff(group[order], prepend=-1))
    for rows in np.split(order, starts[1:]):
        out[rows] = widening(size[rows], limit)
    return out


class ObservedScatter:
    """Factor by which the latest errors of a recording scatter more than stated."""

    def __init__(self) -> None:
        self.factor = 1.0
        self._latest: deque[tuple[NDArray[np.float64], NDArray[np.float64]]] = deque()
        self._count = 0
        self._new = 0

    def add(self, size: NDArray[np.float64], common: NDArray[np.float64], limit: float) -> None:
        """Add errors and their common parts (n,), defined as in `widening`."""
        self._latest.append((size, common))
        self._count += len(size)
        self._new += len(size)
        while self._count - len(self._latest[0][0]) >= WINDOW:
            self._count -= len(self._latest.popleft()[0])
        if self._new >= RENEWED * self._count:
            self._new = 0
            sizes = np.concatenate([a for a, _ in self._latest])
            share = np.concatenate([b for _, b in self._latest])
            known = np.isfinite(share)
            mean = float(np.mean(share[known])) if known.any() else 0.0
            self.factor = widening(sizes, limit, mean)


LOSSES = ('student_t', 'huber', 'gaussian')
HUBER_DELTA = 1.345  # 95 % efficiency at the Gaussian (Huber 1981)
# Below 3, the likelihood rewards an exact fit of some image points at the expense of others.
# Above 200, a t distribution cannot be distinguished from a Gaussian.
NU_RANGE = (3.0, 200.0)
# Area over which gross errors are spread, in squares of scale * sigma, unless the image is
# smaller. A factor of ten moves the border between core and gross errors by 0.4 sigma.
GROSS_AREA = 1e6
# Range of the share of gross errors.
GROSS_RANGE = (1e-5, 0.4)
# Least redundancy of an image point: with less, its residual says nothing about the noise.
MIN_REDUNDANCY = 0.05
# 0.9999 quantile of chi-square with two degrees of freedom: about four sigma of each coordinate.
INLIER_Q = -2 * np.log(1e-4)
# Largest share of the true image points that may lie beyond the limit if the tails are heavy.
MAX_REJECTED = 1e-3
# Least degrees of freedom that widen the limit, to about six sigma: heavier tails may also come
# from a wrong model or many false matches.
MIN_TAIL_NU = 8.0
# Iterations of the estimation of the Student-t, and relative changes at convergence. Steps of the
# scale are cheap compared with the search for nu.
MAX_STEPS = 100
NU_TOLERANCE = 1e-3
SCALE_TOLERANCE = 1e-4
SCALE_STEP_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Noise:
    """Distribution of the image noise.

    Raises ValueError for an unknown loss.
    """

    loss: str = 'student_t'  #: {'student_t', 'huber', 'gaussian'}
    scale: float = 1.0  #: scale [px], or a factor of sigma if sigma is given
    nu: float = 5.0  #: degrees of freedom of the Student-t; infinite for other losses
    #: share of gross errors in addition to the Student-t; 0: none, and none are estimated
    gross: float = 0.0
    #: largest area over which gross errors can be spread, in squares of the unit of scale
    widest: float = np.inf

    def __post_init__(self) -> None:
        if self.loss not in LOSSES:
            raise ValueError(f'loss must be one of {", ".join(LOSSES)}, not {self.loss!r}')
        if self.loss != 'student_t':
            object.__setattr__(self, 'nu', np.inf)
            object.__setattr__(self, 'gross', 0.0)
        elif not np.isfinite(self.nu):  # from a calibration with another loss
            object.__setattr__(self, 'nu', NU_RANGE[1])

    def weight(self, q: np.ndarray) -> NDArray[np.float64]:
        """Return weights (n,) of iteratively reweighted least squares for normalised squares q."""
        if self.loss == 'student_t':
            return self.core_probability(q) * (self.nu + 2) / (self.nu + q)
        if self.loss == 'huber':
            return np.minimum(1.0, HUBER_DELTA / np.sqrt(np.maximum(q, 1e-300)))
        return np.ones_like(q)

    @property
    def _gross_area(self) -> float:
        """Area over which gross errors are spread, in squares of scale * sigma."""
        return float(min(GROSS_AREA, self.widest / self.scale**2))

    def core_probability(self, q: np.ndarray) -> NDArray[np.float64]:
        """Return the probability (n,) that an image point is not a gross error."""
        if not self.gross:
            return np.ones_like(q)
        background = self.gross / (1 - self.gross) * 2 * np.pi / self._gross_area
        exponent = np.minimum((self.nu + 2) / 2 * np.log1p(q / self.nu), 700.0)
        return 1 / (1 + background * np.exp(exponent))

    def cost(self, q: NDArray[np.float64], sigma: NDArray[np.float64]) -> float:
        """Return the negative log-likelihood of image points with squares q (n,), sigma (n,)."""
        if self.loss == 'student_t':
            # Logarithm of the bivariate t density; its constant is Gamma(nu/2 + 1)/(Gamma(nu/2) nu
            # pi) = 1/(2 pi).
            value = (self.nu + 2) / 2 * np.log1p(q / self.nu)
            constant = 2 * np.pi
            if self.gross:
                value = -np.logaddexp(
                    np.log1p(-self.gross) - value, np.log(self.gross * constant / self._gross_area)
                )
        elif self.loss == 'huber':
            inside = q <= HUBER_DELTA**2
            value = np.where(inside, q / 2, HUBER_DELTA * np.sqrt(q) - HUBER_DELTA**2 / 2)
            constant = 2 * np.pi * (1 + np.exp(-(HUBER_DELTA**2) / 2) / HUBER_DELTA**2)
        else:
            value = q / 2
            constant = 2 * np.pi
        return float(
            np.sum(value) + len(q) * np.log(constant) + 2 * np.sum(np.log(self.scale * sigma))
        )

    def information_factor(self, q: NDArray[np.float64]) -> float:
        """Return the Fisher information over the expected weighted normal matrix.

        The weighted normal matrix of a robust fit is optimistic. For the t with D = 2 the factor
        is (nu+2)/(nu+4) (Lange et al. 1989). For Huber it is that of the sandwich covariance, from
        the normalised squares q (n,).
        """
        if self.loss == 'student_t':
            return (self.nu + 2) / (self.nu + 4)
        if self.loss == 'gaussian':
            return 1.0
        w = self.weight(q)
        slope = np.where(q <= HUBER_DELTA**2, 1.0, w / 2)  # w + q dw/dq
        return float(np.mean(slope) ** 2 / (np.mean(w * w * q) / 2 * np.mean(w)))

    def inliers(self, q: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return True (n,) for image points in the core of the distribution."""
        return q <= INLIER_Q

    @property
    def median(self) -> float:
        """Median of the normalised square of image points that are not gross errors.

        P(q > x) = (1 + x/nu)^(-nu/2) for D = 2.
        """
        if not np.isfinite(self.nu):
            return float(2 * np.log(2))
        return float(self.nu * np.expm1(2 / self.nu * np.log(2)))

    @property
    def limit(self) -> float:
        """Normalised square beyond which an image point is considered a gross error.

        It is about four sigma. For heavier tails, as of a Student-t with few degrees of freedom,
        it is the quantile that rejects MAX_REJECTED of the true points:
        P(q > x) = (1 + x/nu)^(-nu/2) for D = 2, with nu of at least MIN_TAIL_NU.
        """
        if self.loss != 'student_t':
            return float(INLIER_Q)
        nu = max(self.nu, MIN_TAIL_NU)
        tail = nu * (MAX_REJECTED ** (-2 / nu) - 1)
        return float(max(INLIER_Q, tail))

    def accepts(self, q: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return True (n,) for image points that are not gross errors by this noise model."""
        return (q <= self.limit) & (self.core_probability(q) >= 0.5)

    def estimate_from(self, squared: ArrayLike, unresolved: ArrayLike = 0.0) -> Noise:
        """Estimate the scale and, for Student-t, nu and the share of gross errors.

        ECME, starting from this model. The unknowns of the adjustment are missing data: the square
        to expect of an error is that of its residual plus what the unknowns leave unresolved.

        squared: (n,) squared residuals r^T r / sigma^2 of the image points. unresolved: (n,) tr(A
        C A^T) / (scale * sigma)^2 of each image point; for a point of weight one it is two minus
        twice its redundancy number.
        """
        values: NDArray[np.float64] = np.maximum(np.asarray(squared, dtype=float), 1e-300)
        missing = np.broadcast_to(np.asarray(unresolved, dtype=float), values.shape)
        if self.loss == 'student_t':
            return self._estimate_student_t(values, missing)
        redundancy = np.maximum(1 - missing / 2, MIN_REDUNDANCY)
        if self.loss == 'gaussian':
            variance = np.sum(values) / (2 * np.sum(redundancy))
        else:
            median = _weighted_median(values / redundancy, redundancy)
            variance = median / (2 * np.log(2))  # median of chi-square, two degrees of freedom
        return replace(self, scale=float(np.sqrt(variance)))

    def _estimate_student_t(
        self, squared: NDArray[np.float64], unresolved: NDArray[np.float64]
    ) -> Noise:
        """Estimate scale, nu and share of gross errors of a Student-t."""
        noise = self
        variance = self.scale**2
        for _ in range(MAX_STEPS):
            nu = noise.nu
            before = variance
            noise, variance, core = noise._estimate_variance(variance, squared, unresolved)
            q = squared / variance + unresolved
            noise = replace(noise, scale=float(np.sqrt(variance)), nu=_estimate_nu(q, core))
            settled = abs(variance - before) <= SCALE_TOLERANCE * before
            if settled and abs(noise.nu - nu) <= NU_TOLERANCE * nu:
                break
        return noise

    def _estimate_variance(
        self, variance: float, squared: NDArray[np.float64], unresolved: NDArray[np.float64]
    ) -> tuple[Noise, float, NDArray[np.float64]]:
        """Estimate share of gross errors, variance and core probabilities (n,) for present nu."""
        noise = self
        nu = self.nu
        for _ in range(MAX_STEPS):
            q = squared / variance + unresolved
            noise = replace(noise, scale=float(np.sqrt(variance)))
            core = noise.core_probability(q)
            if noise.gross:
                noise = replace(noise, gross=float(np.clip(1 - np.mean(core), *GROSS_RANGE)))
            w = core * (nu + 2) / (nu + q)
            last = variance
            variance = float(np.dot(w, q) / (2 * np.sum(core))) * variance
            if abs(variance - last) <= SCALE_STEP_TOLERANCE * last:
                break
        return noise, variance, core


DEFAULT_NOISE = Noise()


def _weighted_median(values: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
    """Return the median of values (n,) with weights (n,)."""
    order = np.argsort(values)
    sums = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(sums, sums[-1] / 2)])


def _estimate_nu(q: NDArray[np.float64], share: NDArray[np.float64]) -> float:
    """Estimate nu of bivariate t variables with squared norms q (n,) and weights share (n,)."""

    def cost(log_nu: float) -> float:
        nu = np.exp(log_nu)
        return float((nu + 2) / 2 * np.dot(share, np.log1p(q / nu)))

    optimum = minimize_scalar(
        cost, bounds=np.log(NU_RANGE), method='bounded', options={'xatol': 1e-3}
    )
    return float(np.exp(optimum.x))
