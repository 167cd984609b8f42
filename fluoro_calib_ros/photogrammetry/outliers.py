"""Tests of single observations for gross errors: image points, and surveyed coordinates of object
points.

Data snooping (Baarda, "A testing procedure for use in geodetic networks", Netherlands Geodetic
Commission 1968) for observations of two and three coordinates: each is compared with what all
others say of it. Under robust weights the residual of a gross error is tested by its covariance at
full weight, as the adjustment has hardly listened to it: with P = A C_x A^T and weight w the
residual without the observation is (1 - w P / s^2)^-1 r, with covariance s^2 + P (1 - w P /
s^2)^-1 (Foerstner and Wrobel, "Photogrammetric Computer Vision", Springer 2016, 4.6). Where the
scale was estimated along, Pope's test takes the place of chi-square (NOAA TR NOS 65 NGS 1, 1976).
"""

from dataclasses import dataclass

import numpy as np
from scipy import stats

from .collinearity import project_with_jacobian
from .precision import MIN_WEIGHT

SIGNIFICANCE = 0.01  # chance of any false alarm among all image points, and among all targets
CONTROLLED = 0.02  # smallest redundancy of an observation that is tested
MIN_RAYS = 2
ROUNDS = 15  # of the weights of a target's rays


@dataclass(frozen=True)
class Outliers:
    """Observations that fail the test.

    image_point (k,): rows; value (k,) of the statistic and critical_image, above which it lies;
    target (l,): rows of object points; target_value (l,), critical_target; offset_mm (l, 3): where
    the images see it, less the survey; tested: numbers of image points and of targets that could
    be tested.
    """

    image_point: np.ndarray
    value: np.ndarray
    critical_image: float
    target: np.ndarray
    target_value: np.ndarray
    critical_target: float
    offset_mm: np.ndarray
    tested: tuple


def find_outliers(network, adjustment, precise, significance=SIGNIFICANCE):
    """Outliers of an Adjustment with its Precision; significance: chance of any false alarm of
    each test.
    """
    target, critical_target = target_statistics(network, adjustment, precise, significance)
    value, offset, seen = target
    wrong = np.flatnonzero(value > critical_target)
    image, critical_image = image_statistics(network, adjustment, precise, significance)
    # What fits a bead where the images see it is no fault of the images.
    explained = np.isin(network.point, wrong) & (seen <= critical_image)
    found = np.flatnonzero((image > critical_image) & ~explained)
    return Outliers(
        found,
        image[found],
        critical_image,
        wrong,
        value[wrong],
        critical_target,
        offset[wrong],
        (int(np.isfinite(image).sum()), int(np.isfinite(value).sum())),
    )


def image_statistics(network, adjustment, precise, significance=SIGNIFICANCE):
    """Statistics (N,) of the image points, NaN where the redundancy is too small, and their
    critical value.
    """
    noise = adjustment.noise
    weight = np.maximum(adjustment.noise.weight(adjustment.q), MIN_WEIGHT)
    variance = (noise.scale * network.sigma) ** 2
    unit = np.eye(2)
    # C_r = s^2 / w - P, so that this is 1 - w P / s^2.
    part = precise.residual * (weight / variance)[:, None, None]
    tested = np.linalg.eigvalsh(part)[:, 0] > CONTROLLED
    inverse = np.linalg.inv(np.where(tested[:, None, None], part, unit))
    fitted = (unit - part) * (variance / weight)[:, None, None]
    covariance = variance[:, None, None] * unit + fitted @ inverse / noise.information_factor(
        adjustment.q
    )
    without = (inverse @ adjustment.residuals[..., None])[..., 0]
    value = np.einsum('ni,ni->n', without, np.linalg.solve(covariance, without[..., None])[..., 0])
    count = max(int(tested.sum()), 1)
    redundancy = float(precise.redundancy.sum())
    if noise.loss == 'gaussian':
        # The estimated variance without the image point, which has a share of value in it.
        value = value * (redundancy - 2) / np.maximum(redundancy - value, 1e-3 * redundancy)
    critical = 2 * stats.f.isf(significance / count, 2, min(noise.nu, redundancy - 2))
    return np.where(tested, value, np.nan), float(critical)


def target_statistics(network, adjustment, precise, significance=SIGNIFICANCE):
    """Statistics of the targets' surveyed coordinates, and their critical value.

    Each target is intersected from its rays without its survey, with orientations held and their
    uncertainty added to that of the rays. Returns ((n,) values, NaN where there is nothing to
    test, (n, 3) offsets [mm], (N,) statistics of the image points at the intersected targets),
    critical value.
    """
    n = network.shape[2]
    nothing = (np.full(n, np.nan), np.zeros((n, 3)), np.full(len(network.uv), np.inf))
    if network.datum != 'survey':
        return nothing, np.inf
    a, information, r = _rays(network, adjustment, precise)
    offset, covariance, square = _intersected(network, a, information, r, adjustment.noise)
    covariance = covariance + (network.survey_sd_mm**2)[:, None, None] * np.eye(3)
    testable = np.isfinite(offset).all(axis=1)
    value = np.full(n, np.nan)
    value[testable] = np.einsum(
        'ni,ni->n',
        offset[testable],
        np.linalg.solve(covariance[testable], offset[testable][..., None])[..., 0],
    )
    critical = stats.chi2.isf(significance / max(int(testable.sum()), 1), 3)
    return (value, np.where(testable[:, None], offset, 0.0), square), float(critical)


def _rays(network, adjustment, precise):
    """Derivatives (N, 2, 3) by the object points, inverse covariances (N, 2, 2) of the rays with
    their orientations, and residuals (N, 2) at the surveyed coordinates.
    """
    parameters = adjustment.parameters
    e = network.exposure
    _, d_e, a, d_i = project_with_jacobian(*parameters.per_image_point(network))
    r = (
        adjustment.residuals
        - (a @ (network.survey_mm - parameters.points_mm)[network.point][..., None])[..., 0]
    )
    columns = 3 * network.fluoroscope[e][:, None] + np.arange(3)
    mixed = np.take_along_axis(precise.exterior_global[e], columns[:, None, :], axis=2)
    own = precise.interior[network.fluoroscope[e]]
    across = d_e @ mixed @ d_i.transpose(0, 2, 1)
    covariance = (
        d_e @ precise.exterior[e] @ d_e.transpose(0, 2, 1)
        + across
        + across.transpose(0, 2, 1)
        + d_i @ own @ d_i.transpose(0, 2, 1)
    )
    covariance += ((adjustment.noise.scale * network.sigma) ** 2)[:, None, None] * np.eye(2)
    return a, np.linalg.inv(covariance), r


def _intersected(network, a, information, r, noise):
    """Offsets (n, 3) [mm] of the targets by their rays, covariances (n, 3, 3), and squares (N,) of
    the rays' residuals.

    Rays of one target that contradict each other are weighed down; NaN where fewer than two are
    left.
    """
    n = network.shape[2]
    p = network.point
    weight = np.ones(len(p))
    offset = np.zeros((n, 3))
    covariance = np.tile(np.eye(3), (n, 1, 1))
    for _ in range(ROUNDS):
        weighted = (weight[:, None, None] * a.transpose(0, 2, 1)) @ information
        normal = np.zeros((n, 3, 3))
        right = np.zeros((n, 3))
        np.add.at(normal, p, weighted @ a)
        np.add.at(right, p, (weighted @ r[..., None])[..., 0])
        rays = np.bincount(p, weight, n)
        scale = np.sqrt(np.maximum(np.diagonal(normal, axis1=1, axis2=2), 1e-300))
        smallest = np.linalg.eigvalsh(normal / scale[:, :, None] / scale[:, None, :])[:, 0]
        good = (rays > MIN_RAYS - 0.5) & (smallest > 1e-4)
        covariance[good] = np.linalg.inv(normal[good])
        offset[good] = (covariance[good] @ right[good][..., None])[..., 0]
        off = r - (a @ offset[p][..., None])[..., 0]
        square = np.einsum('ni,nij,nj->n', off, information, off)
        weight = noise.weight(square) if noise.loss != 'gaussian' else weight
    contradicting = np.bincount(p, square * weight, n) > stats.chi2.isf(
        1e-3, np.maximum(2 * rays, 1)
    )
    offset[~good | contradicting] = np.nan
    return offset, covariance, square
