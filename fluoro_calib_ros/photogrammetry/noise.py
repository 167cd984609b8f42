"""Noise models of image points: Student-t, Huber and Gaussian, with their scale estimated.

An image point has D = 2 coordinates with one scale. q = |r|^2 / (scale * sigma)^2 is its normalised
squared residual. Sources: Lange, Little and Taylor, "Robust statistical modeling using the t
distribution", JASA 1989 (weights, information); Liu and Rubin, "ML estimation of the t distribution using
EM and its extensions, ECM and ECME", Statistica Sinica 1995 (scale and degrees of freedom); Huber, "Robust
Statistics", Wiley 1981.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar

LOSSES = ('student_t', 'huber', 'gaussian')
HUBER_DELTA = 1.345   # 95 % efficiency at the Gaussian (Huber 1981)
# Below 3 the likelihood rewards fitting some image points exactly at the cost of the rest; beyond 200 a
# t distribution cannot be told from a Gaussian.
NU_RANGE = (3.0, 200.0)
SMALLEST_REDUNDANCY = 0.05   # below it a residual tells nothing of the noise
# 0.9999 quantile of chi-square with two degrees of freedom: about four sigma of each coordinate.
INLIER_Q = -2 * np.log(1e-4)


@dataclass(frozen=True)
class Noise:
    """Distribution of the image noise.

    loss 'student_t', 'huber' or 'gaussian'; scale [px], or a factor of sigma where sigma is given; nu
    degrees of freedom of the Student-t (infinite for the others). Raises ValueError for an unknown loss.
    """

    loss: str = 'student_t'
    scale: float = 1.0
    nu: float = 5.0

    def __post_init__(self):
        if self.loss not in LOSSES:
            raise ValueError(f'loss is one of {", ".join(LOSSES)}, not {self.loss!r}')
        if self.loss != 'student_t':
            object.__setattr__(self, 'nu', np.inf)
        elif not np.isfinite(self.nu):   # of a calibration with another loss
            object.__setattr__(self, 'nu', NU_RANGE[1])

    def weight(self, q):
        """Weights (n,) of iteratively reweighted least squares at normalised squared residuals q (n,)."""
        if self.loss == 'student_t':
            return (self.nu + 2) / (self.nu + q)
        if self.loss == 'huber':
            return np.minimum(1.0, HUBER_DELTA / np.sqrt(np.maximum(q, 1e-300)))
        return np.ones_like(q)

    def cost(self, q, sigma):
        """Negative log-likelihood of image points with normalised squared residuals q (n,) and sigma (n,)."""
        if self.loss == 'student_t':
            # ln of the bivariate t density; its constant is Gamma(nu/2 + 1)/(Gamma(nu/2) nu pi) = 1/(2 pi).
            value, constant = (self.nu + 2) / 2 * np.log1p(q / self.nu), 2 * np.pi
        elif self.loss == 'huber':
            inside = q <= HUBER_DELTA ** 2
            value = np.where(inside, q / 2, HUBER_DELTA * np.sqrt(q) - HUBER_DELTA ** 2 / 2)
            constant = 2 * np.pi * (1 + np.exp(-HUBER_DELTA ** 2 / 2) / HUBER_DELTA ** 2)
        else:
            value, constant = q / 2, 2 * np.pi
        return float(np.sum(value) + len(q) * np.log(constant) + 2 * np.sum(np.log(self.scale * sigma)))

    def information_factor(self, q):
        """Fisher information over the expected weighted normal matrix.

        The weighted normal matrix of a robust fit is optimistic. For the t with D = 2 the factor is
        (nu+2)/(nu+4) (Lange et al. 1989); for Huber it is that of the sandwich covariance, from q (n,).
        """
        if self.loss == 'student_t':
            return (self.nu + 2) / (self.nu + 4)
        if self.loss == 'gaussian':
            return 1.0
        w = self.weight(q)
        slope = np.where(q <= HUBER_DELTA ** 2, 1.0, w / 2)   # w + q dw/dq
        return float(np.mean(slope) ** 2 / (np.mean(w * w * q) / 2 * np.mean(w)))

    def inliers(self, q):
        """True (n,) where an image point belongs to the core of the distribution."""
        return q <= INLIER_Q

    def estimated(self, squared, redundancy=1.0):
        """The noise model with scale and, for Student-t, nu estimated (ECME).

        squared (n,) squared residuals |r|^2 / sigma^2 of the image points; redundancy: redundancy number of
        each (n,) or of all. A residual is smaller than the noise by the square root of its redundancy number,
        and tells that much less of the noise: it is enlarged by the one and weighted with the other.
        """
        share = np.broadcast_to(np.maximum(redundancy, SMALLEST_REDUNDANCY), np.shape(squared))
        squared = np.maximum(np.asarray(squared, dtype=float) / share, 1e-300)
        if self.loss == 'gaussian':
            return replace(self, scale=float(np.sqrt(np.average(squared, weights=share) / 2)))
        if self.loss == 'huber':
            return replace(self, scale=float(np.sqrt(_weighted_median(squared, share) / (2 * np.log(2)))))
        scale2, nu = self.scale ** 2, self.nu
        total = 2 * np.sum(share)
        for _ in range(50):
            before = scale2
            for _ in range(10):   # steps in the scale are cheap beside the search for nu
                w = (nu + 2) / (nu + squared / scale2)
                scale2, last = float(np.dot(share, w * squared) / total), scale2
                if abs(scale2 - last) <= 1e-5 * last:
                    break
            nu, last = _most_likely_nu(squared / scale2, share), nu
            if abs(scale2 - before) <= 1e-4 * before and abs(nu - last) <= 1e-3 * last:
                break
        return replace(self, scale=float(np.sqrt(scale2)), nu=nu)


def _weighted_median(values, weights):
    """Median of values (n,) with weights (n,)."""
    order = np.argsort(values)
    sums = np.cumsum(weights[order])
    return values[order][np.searchsorted(sums, sums[-1] / 2)]


def _most_likely_nu(q, share):
    """Degrees of freedom that maximise the weighted likelihood of bivariate t variables with squared norms q."""
    def cost(log_nu):
        nu = np.exp(log_nu)
        return (nu + 2) / 2 * np.dot(share, np.log1p(q / nu))
    found = minimize_scalar(cost, bounds=np.log(NU_RANGE), method='bounded', options={'xatol': 1e-3})
    return float(np.exp(found.x))
