# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Outliers and noise of an adjusted network.

Single image points and surveyed coordinates are tested for gross errors.

Data snooping (Baarda, "A testing procedure for use in geodetic networks", Netherlands Geodetic
Commission 1968) for observations of two and three coordinates: each observation is compared with
its prediction by all others. Under robust weights an adjustment hardly follows a gross error, so
its residual is tested by its covariance at full weight. With P = A C_x A^T and weight w, the
residual without the observation is (1 - w P / s^2)^-1 r, with covariance
s^2 + P (1 - w P / s^2)^-1 (Foerstner and Wrobel, "Photogrammetric Computer Vision", Springer 2016,
4.6). If the scale is estimated from the same residuals, Pope's test replaces chi-square (NOAA TR
NOS 65 NGS 1, 1976).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

from .adjustment import TOLERANCE, Adjustment, adjust, residuals_and_q
from .collinearity import project_with_jacobian
from .elimination import factorize
from .network import Network
from .noise import DEFAULT_NOISE, MIN_REDUNDANCY, Noise
from .normal_equations import MIN_WEIGHT, normal_equations
from .precision import Precision, covariance_blocks, covariance_of_projection
from .unknowns import Parameters

# Probability of any false alarm among all tests: image points, targets, terms.
SIGNIFICANCE = 0.01
FALSE_ALARM = 2e-3  # chance that one test of good observations fails
# Least eigenvalue of the scaled normal matrix of an intersection.
MIN_INTERSECTION_EIGENVALUE = 1e-4
# FALSE_ALARM for a test that says what contradicts what: rays, beads and survey, false matches.
CONTRADICTION = 1e-3


@dataclass(frozen=True)
class Outliers:
    """Observations that fail the test."""

    image_point: NDArray[np.int64]  #: (k,) rows of image points
    value: NDArray[np.float64]  #: (k,) their statistics
    critical_image: float  #: critical value of the image points
    target: NDArray[np.int64]  #: (l,) rows of object points
    target_value: NDArray[np.float64]  #: (l,) their statistics
    critical_target: float  #: critical value of the targets
    #: (l, 3) position of the targets by the images minus their survey
    offset_mm: NDArray[np.float64]
    tested: tuple[int, int]  #: numbers of image points and of targets that could be tested


@dataclass(frozen=True)
class TargetTest:
    """Test of the surveyed coordinates of all targets."""

    value: NDArray[np.float64]  #: (n,) statistics; NaN for a target that cannot be tested
    critical: float  #: critical value
    #: (n, 3) position of the targets by the images minus their survey; zeros if not tested
    offset_mm: NDArray[np.float64]
    #: (N,) statistics of the image points at the intersected targets
    ray_square: NDArray[np.float64]


def find_outliers(network: Network, adjustment: Adjustment, precision: Precision) -> Outliers:
    """Find image points and targets that fail the test."""
    targets = target_statistics(network, adjustment, precision)
    wrong_targets = np.flatnonzero(targets.value > targets.critical)
    image, critical_image = image_statistics(network, adjustment, precision)
    # An image point that fits its target at the position by the images is not at fault.
    explained = np.isin(network.point, wrong_targets) & (targets.ray_square <= critical_image)
    wrong_points = np.flatnonzero((image > critical_image) & ~explained)
    return Outliers(
        image_point=wrong_points,
        value=image[wrong_points],
        critical_image=critical_image,
        target=wrong_targets,
        target_value=targets.value[wrong_targets],
        critical_target=targets.critical,
        offset_mm=targets.offset_mm[wrong_targets],
        tested=(int(np.isfinite(image).sum()), int(np.isfinite(targets.value).sum())),
    )


def image_statistics(
    network: Network,
    adjustment: Adjustment,
    precision: Precision,
    significance: float = SIGNIFICANCE,
) -> tuple[NDArray[np.float64], float]:
    """Return statistics (N,) of the image points, and their critical value.

    A statistic is NaN if the redundancy is too small.
    """
    noise = adjustment.noise
    weight = np.maximum(noise.weight(adjustment.q), MIN_WEIGHT)
    variance = (noise.scale * network.sigma) ** 2
    unit = np.eye(2)
    # C_r = s^2 / w - P, so this is 1 - w P / s^2.
    part = precision.residual * (weight / variance)[:, None, None]
    testable = np.linalg.eigvalsh(part)[:, 0] > MIN_REDUNDANCY
    inverse = np.linalg.inv(np.where(testable[:, None, None], part, unit))
    fitted = (unit - part) * (variance / weight)[:, None, None]
    factor = noise.information_factor(adjustment.q)
    covariance = variance[:, None, None] * unit + fitted @ inverse / factor
    left_out_residuals = (inverse @ adjustment.residuals[..., None])[..., 0]
    standardised = np.linalg.solve(covariance, left_out_residuals[..., None])[..., 0]
    value = np.einsum('ni,ni->n', left_out_residuals, standardised)
    count = max(int(testable.sum()), 1)
    redundancy = float(precision.redundancy.sum())
    if noise.loss == 'gaussian':
        # Use the variance without the contribution of the image point itself.
        value = value * (redundancy - 2) / np.maximum(redundancy - value, 1e-3 * redundancy)
    critical = 2 * _f_limit(significance / count, min(noise.nu, redundancy - 2))
    return np.where(testable, value, np.nan), float(critical)


def _f_limit(probability: float, freedom: float) -> float:
    """Return the value that F of 2 and `freedom` degrees of freedom exceeds with a probability.

    F of 2 and n exceeds x with the probability (1 + 2 x / n)^(-n / 2).
    """
    if not np.isfinite(freedom):
        return -float(np.log(probability))
    return float(freedom / 2 * np.expm1(-2 / freedom * np.log(probability)))


def target_statistics(
    network: Network,
    adjustment: Adjustment,
    precision: Precision,
    significance: float = SIGNIFICANCE,
) -> TargetTest:
    """Test the surveyed coordinates of the targets.

    Each target is intersected from its rays without its survey. The orientations are fixed, and
    their uncertainty is added to that of the rays.
    """
    n = network.n_points
    if network.datum != 'survey':
        no_values = np.full(n, np.nan)
        return TargetTest(
            no_values, np.inf, np.zeros((n, 3)), np.full(network.n_image_points, np.inf)
        )
    rays = _rays_of(network, adjustment, precision)
    offset, covariance, square = _intersect(network, rays, adjustment.noise)
    covariance /= adjustment.noise.information_factor(adjustment.q)
    covariance += (network.survey_sd_mm**2)[:, None, None] * np.eye(3)
    testable = np.isfinite(offset).all(axis=1)
    tested_offset = offset[testable]
    standardised = np.linalg.solve(covariance[testable], tested_offset[..., None])[..., 0]
    value = np.full(n, np.nan)
    value[testable] = np.einsum('ni,ni->n', tested_offset, standardised)
    critical = special.chdtri(3, significance / max(int(testable.sum()), 1))
    return TargetTest(value, float(critical), np.where(testable[:, None], offset, 0.0), square)


@dataclass(frozen=True)
class _Rays:
    """Rays of the image points with the uncertainty of their orientations.

    derivative (N, 2, 3): by the object points; information (N, 2, 2): inverse covariances
    [1/px^2]; residual (N, 2) [px]: at the surveyed coordinates.
    """

    derivative: NDArray[np.float64]
    information: NDArray[np.float64]
    residual: NDArray[np.float64]


def _rays_of(network: Network, adjustment: Adjustment, precision: Precision) -> _Rays:
    """Return the rays of all image points."""
    parameters = adjustment.parameters
    e = network.exposure
    f = network.fluoroscope[e]
    _, d_e, d_p, d_i = project_with_jacobian(*network.per_image_point(parameters))
    shift = (network.survey_mm - parameters.points_mm)[network.point]
    residual = adjustment.residuals - (d_p @ shift[..., None])[..., 0]
    by_interior = np.stack(
        [precision.exterior_global[:, :, columns] for columns in network.layout.interiors]
    )
    mixed = d_e @ by_interior[f, e] @ d_i.transpose(0, 2, 1)
    covariance = (
        d_e @ precision.exterior[e] @ d_e.transpose(0, 2, 1)
        + mixed
        + mixed.transpose(0, 2, 1)
        + d_i @ precision.interior[f] @ d_i.transpose(0, 2, 1)
    )
    variance = (adjustment.noise.scale * network.sigma) ** 2
    covariance += variance[:, None, None] * np.eye(2)
    return _Rays(d_p, np.linalg.inv(covariance), residual)


def _intersect(
    network: Network, rays: _Rays, noise: Noise
) -> tuple[np.ndarray, NDArray[np.float64], NDArray[np.float64]]:
    """Intersect the targets from their rays.

    Returns offsets (n, 3) [mm], their covariances (n, 3, 3) and squares (N,) of the rays'
    residuals. Rays of one target that contradict each other are downweighted; offsets are NaN if
    fewer than two rays remain.
    """
    n = network.n_points
    p = network.point
    a = rays.derivative
    weight = np.ones(len(p))
    offset = np.zeros((n, 3))
    covariance = np.tile(np.eye(3), (n, 1, 1))
    for _ in range(15):  # iterations of reweighting
        weighted = (weight[:, None, None] * a.transpose(0, 2, 1)) @ rays.information
        normal = np.zeros((n, 3, 3))
        right = np.zeros((n, 3))
        np.add.at(normal, p, weighted @ a)
        np.add.at(right, p, (weighted @ rays.residual[..., None])[..., 0])
        count = np.bincount(p, weight, n)
        scale = np.sqrt(np.maximum(np.diagonal(normal, axis1=1, axis2=2), 1e-300))
        smallest = np.linalg.eigvalsh(normal / scale[:, :, None] / scale[:, None, :])[:, 0]
        # two rays, or nearly so by their weights
        determined = (count > 1.5) & (smallest > MIN_INTERSECTION_EIGENVALUE)
        covariance[determined] = np.linalg.inv(normal[determined])
        offset[determined] = (covariance[determined] @ right[determined][..., None])[..., 0]
        residual = rays.residual - (a @ offset[p][..., None])[..., 0]
        square = np.einsum('ni,nij,nj->n', residual, rays.information, residual)
        weight = noise.weight(square) if noise.loss != 'gaussian' else weight
    limit = special.chdtri(np.maximum(2 * count, 1), CONTRADICTION)
    contradicting = np.bincount(p, square * weight, n) > limit
    offset[~determined | contradicting] = np.nan
    return offset, covariance, square


# Estimation of the noise model around the adjustment, by the marginal likelihood of its scale.
#
# Residuals are smaller than the noise, because the unknowns follow it. The difference depends on
# the scale itself: the less the image points weigh, the more the survey determines the object
# points. Adjustment and expected squared errors are therefore updated alternately until the scale
# settles. This is the EM algorithm with the unknowns as missing data (Dempster, Laird and Rubin,
# JRSS B 39, 1977; for variance components in photogrammetry Foerstner and Wrobel, "Photogrammetric
# Computer Vision", Springer 2016, 4.2.4).

# Relative change of the scale at convergence: a hundredth of its standard deviation.
SETTLED = 2e-3
# Tolerance of the adjustments before the last one.
LOOSE = 0.1
# No target is measured better than this. With little redundancy, the scale could vanish.
MIN_NOISE_PX = 0.01
# Share of the image points of an exposure that must not be gross errors if its initial values are
# good: with half of the matches false it is about 0.5, with wrong initial values nearly zero.
MIN_CORE = 0.25


def adjust_and_estimate_noise(
    network: Network,
    start: Parameters,
    correction: NDArray[np.float64] | float = 0.0,
    noise: Noise = DEFAULT_NOISE,
    tolerance: float = TOLERANCE,
) -> Adjustment:
    """Adjust a network and estimate its noise model; see `adjust` for the arguments.

    noise: loss and initial values of the noise model. tolerance: of the last adjustment; earlier
    adjustments have a looser one.

    `converged` of the result is False if adjustment or scale did not settle; `steps` counts the
    last adjustment only. Raises LinAlgError if the network does not determine the unknowns.
    """
    _, q = residuals_and_q(network, start, correction, noise)
    if np.isfinite(q).all():
        noise = _first_noise(network, q * noise.scale**2, noise)
    parameters = start
    settled = False
    for _ in range(40):  # a few are enough
        result = adjust(network, parameters, correction=correction, noise=noise, tolerance=LOOSE)
        parameters = result.parameters
        equations = normal_equations(network, parameters, correction, noise)
        blocks = covariance_blocks(factorize(network, equations))
        last_scale = noise.scale
        projected = covariance_of_projection(network, parameters, blocks)
        noise = estimate_noise(network, result, projected)
        if abs(noise.scale - last_scale) <= SETTLED * last_scale:
            settled = True
            break
    result = adjust(network, parameters, correction=correction, noise=noise, tolerance=tolerance)
    return replace(result, converged=result.converged and settled)


def _first_noise(network: Network, squared: NDArray[np.float64], noise: Noise) -> Noise:
    """Return the noise model at the initial values; squared (N,): squared residuals over sigma.

    Far from the solution, whole exposures may look like gross errors. Gross errors are therefore
    estimated only if every exposure has image points that are not gross errors.
    """
    area = np.prod(np.ptp(network.uv, axis=0)) / np.median(network.sigma) ** 2
    noise = replace(noise, widest=max(float(area), 1.0))
    mixed = noise.estimate_from(squared)
    core = mixed.core_probability(squared / mixed.scale**2)
    share = np.bincount(network.exposure, core) / np.bincount(network.exposure)
    if np.min(share) > MIN_CORE:
        return mixed
    estimated = replace(noise, gross=0.0).estimate_from(squared)
    return replace(estimated, gross=noise.gross)


def estimate_noise(
    network: Network, adjustment: Adjustment, projected: NDArray[np.float64], factor: float = 1.0
) -> Noise:
    """Estimate the noise model from the residuals of an adjustment and covariances of unknowns.

    projected: of these, from covariance_of_projection. factor: information factor near one that
    they do not include.
    """
    noise = adjustment.noise
    variance = (noise.scale * network.sigma) ** 2
    unresolved = np.trace(projected, axis1=1, axis2=2) / (factor * variance)
    new = noise.estimate_from(adjustment.q * noise.scale**2, unresolved)
    return replace(new, scale=max(new.scale, MIN_NOISE_PX / float(np.median(network.sigma))))


def shows_noise(network: Network, noise: Noise, projected: NDArray[np.float64]) -> bool:
    """Return whether the residuals say something about the noise.

    projected: covariances of projections, from covariance_of_projection. If most targets are seen
    once, their object points follow the noise within their survey.
    """
    if network.datum != 'survey':
        return True
    unresolved = np.trace(projected, axis1=1, axis2=2) / (noise.scale * network.sigma) ** 2
    return 1 - float(np.mean(unresolved)) / 2 >= MIN_REDUNDANCY
