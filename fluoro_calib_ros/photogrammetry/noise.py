"""Noise models of image points: Student-t, Huber and Gaussian, with their scale estimated.

An image point has D = 2 coordinates with one scale. q = |r|^2 / (scale * sigma)^2 is its
normalised squared residual. Beside the core of the distribution a share of gross errors (false
matches) can be estimated, spread evenly over a wide area: where they are left to the tails of the
Student-t they make them heavy, and the efficient use of the good image points is lost. Sources:
Lange, Little and Taylor, "Robust statistical modeling using the t distribution", JASA 1989
(weights, information); Liu and Rubin, "ML estimation of the t distribution using EM and its
extensions, ECM and ECME", Statistica Sinica 1995 (scale and degrees of freedom); Fraley and
Raftery, "Model-based clustering, discriminant analysis, and density estimation", JASA 2002, 3.1
(even background); Huber, "Robust Statistics", Wiley 1981.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar

LOSSES = ('student_t', 'huber', 'gaussian')
HUBER_DELTA = 1.345  # 95 % efficiency at the Gaussian (Huber 1981)
# Below 3 the likelihood rewards fitting some image points exactly at the cost of the rest; beyond
# 200 a t distribution cannot be told from a Gaussian.
NU_RANGE = (3.0, 200.0)
# of gross errors, in squares of scale * sigma; a factor of ten moves the border by 0.4 sigma
GROSS_AREA = 1e6
GROSS_RANGE = (1e-5, 0.4)
MIN_REDUNDANCY = 0.05  # below it a residual tells nothing of the noise
# 0.9999 quantile of chi-square with two degrees of freedom: about four sigma of each coordinate.
INLIER_Q = -2 * np.log(1e-4)


@dataclass(frozen=True)
class Noise:
    """Distribution of the image noise.

    loss 'student_t', 'huber' or 'gaussian'; scale [px], or a factor of sigma where sigma is given;
    nu degrees of freedom of the Student-t (infinite for the others); gross: share of gross errors
    beside the Student-t, 0: there are none, and none are looked for. Raises ValueError for an
    unknown loss.
    """

    loss: str = 'student_t'
    scale: float = 1.0
    nu: float = 5.0
    gross: float = 0.0

    def __post_init__(self):
        if self.loss not in LOSSES:
            raise ValueError(f'loss is one of {", ".join(LOSSES)}, not {self.loss!r}')
        if self.loss != 'student_t':
            object.__setattr__(self, 'nu', np.inf)
            object.__setattr__(self, 'gross', 0.0)
        elif not np.isfinite(self.nu):  # of a calibration with another loss
            object.__setattr__(self, 'nu', NU_RANGE[1])

    def weight(self, q):
        """Weights (n,) of iteratively reweighted least squares at normalised squared residuals q
        (n,).
        """
        if self.loss == 'student_t':
            return self.core(q) * (self.nu + 2) / (self.nu + q)
        if self.loss == 'huber':
            return np.minimum(1.0, HUBER_DELTA / np.sqrt(np.maximum(q, 1e-300)))
        return np.ones_like(q)

    def core(self, q):
        """Probability (n,) that an image point is no gross error."""
        if not self.gross:
            return np.ones_like(q)
        background = self.gross / (1 - self.gross) * 2 * np.pi / GROSS_AREA
        return 1 / (
            1 + background * np.exp(np.minimum((self.nu + 2) / 2 * np.log1p(q / self.nu), 700.0))
        )

    def cost(self, q, sigma):
        """Negative log-likelihood of image points with normalised squared residuals q (n,) and
        sigma (n,).
        """
        if self.loss == 'student_t':
            # ln of the bivariate t density; its constant is Gamma(nu/2 + 1)/(Gamma(nu/2) nu pi) =
            # 1/(2 pi).
            value = (self.nu + 2) / 2 * np.log1p(q / self.nu)
            constant = 2 * np.pi
            if self.gross:
                value = -np.logaddexp(
                    np.log1p(-self.gross) - value, np.log(self.gross * constant / GROSS_AREA)
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

    def information_factor(self, q):
        """Fisher information over the expected weighted normal matrix.

        The weighted normal matrix of a robust fit is optimistic. For the t with D = 2 the factor
        is (nu+2)/(nu+4) (Lange et al. 1989); for Huber it is that of the sandwich covariance, from
        q (n,).
        """
        if self.loss == 'student_t':
            return (self.nu + 2) / (self.nu + 4)
        if self.loss == 'gaussian':
            return 1.0
        w = self.weight(q)
        slope = np.where(q <= HUBER_DELTA**2, 1.0, w / 2)  # w + q dw/dq
        return float(np.mean(slope) ** 2 / (np.mean(w * w * q) / 2 * np.mean(w)))

    def inliers(self, q):
        """True (n,) where an image point belongs to the core of the distribution."""
        return q <= INLIER_Q

    def estimated(self, squared, open_part=0.0):
        """The noise model with scale and, for Student-t, nu and the share of gross errors
        estimated (ECME).

        squared (n,) squared residuals |r|^2 / sigma^2 of the image points. open_part (n,) or a
        number: the unknowns of the adjustment are missing data, and the expected square of an
        error is that of its residual and of what the unknowns leave open, tr(A C A^T) / sigma^2 =
        open_part scale^2; for a point of weight one it is two less twice its redundancy number.
        """
        squared = np.maximum(np.asarray(squared, dtype=float), 1e-300)
        open_part = np.broadcast_to(open_part, squared.shape)
        if self.loss == 'student_t':
            return self._most_likely(squared, open_part)
        redundancy = np.maximum(1 - open_part / 2, MIN_REDUNDANCY)
        if self.loss == 'gaussian':
            return replace(self, scale=float(np.sqrt(np.sum(squared) / (2 * np.sum(redundancy)))))
        return replace(
            self,
            scale=float(
                np.sqrt(_weighted_median(squared / redundancy, redundancy) / (2 * np.log(2)))
            ),
        )

    def _most_likely(self, squared, open_part):
        """Student-t with scale, nu and share of gross errors; open_part (n,): expected q beside
        the residual's.
        """
        now = self
        scale2 = self.scale**2
        for _ in range(50):
            before = scale2
            nu = now.nu
            for _ in range(100):  # steps in the scale are cheap beside the search for nu
                q = squared / scale2 + open_part
                core = now.core(q)
                if now.gross:
                    now = replace(now, gross=float(np.clip(1 - np.mean(core), *GROSS_RANGE)))
                w = core * (nu + 2) / (nu + q)
                scale2, last = float(np.dot(w, q) / (2 * np.sum(core))) * scale2, scale2
                if abs(scale2 - last) <= 1e-6 * last:
                    break
            now = replace(
                now,
                scale=float(np.sqrt(scale2)),
                nu=_most_likely_nu(squared / scale2 + open_part, core),
            )
            if abs(scale2 - before) <= 1e-4 * before and abs(now.nu - nu) <= 1e-3 * nu:
                break
        return now


def _weighted_median(values, weights):
    """Median of values (n,) with weights (n,)."""
    order = np.argsort(values)
    sums = np.cumsum(weights[order])
    return values[order][np.searchsorted(sums, sums[-1] / 2)]


def _most_likely_nu(q, share):
    """Degrees of freedom that maximise the weighted likelihood of bivariate t variables with
    squared norms q.
    """

    def cost(log_nu):
        nu = np.exp(log_nu)
        return (nu + 2) / 2 * np.dot(share, np.log1p(q / nu))

    found = minimize_scalar(
        cost, bounds=np.log(NU_RANGE), method='bounded', options={'xatol': 1e-3}
    )
    return float(np.exp(found.x))
