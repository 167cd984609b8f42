# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Distortion that differs between exposures: low-order terms of each exposure.

The magnetic field about an image intensifier, and so its distortion, changes with the angle of a
C-arm. The change is smooth: the 14 terms of the cubic trend, without what the orientation of an
exposure absorbs, describe it (Gronenschild, Medical Physics 26, 1999). A field across the axis
shifts a pixel by r^4 too: where the residuals show more, the terms reach degree 5
(docs/how_good/real_radiographs.md: cubic terms leave 0.058 px of a real C-arm, quartic 0.028,
quintic 0.025, noise 0.021). Their coefficients are random effects with mean zero (Robinson, "That
BLUP is a good thing", Statistical Science 6, 1991).
The variance of each term over the exposures is the one with the largest marginal likelihood
(MacKay, Neural Computation 4, 1992), and vanishes where nothing changes.

A change of the principal distance hardly differs from a change of the distance of the source. Its
variance over the exposures may be estimated many times too small, and its stated standard
deviation with it. Terms of the interior orientation change about as much as the other terms do.
The prior of their variances is therefore inverse chi squared with a few degrees of freedom, about
the mean variance of the other terms (Smyth, "Linear models and empirical Bayes methods",
Statistical Applications in Genetics and Molecular Biology 3, 2004). Their variances are the
posterior means (Gelman et al., "Bayesian Data Analysis", 2013, 2.6), so that their uncertainty
enlarges the stated standard deviations.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..correction.angle_field import PAIRS, AngleField, harmonics
from ..correction.calibration_record import HARMONICS, ORDERS, SD_GRID, VARIANCES
from ..correction.series import Functions, sd_grid_pixels
from ..correction.terms import (
    ABSENT_VARIANCE,
    CUBIC,
    GAUGE,
    cubic_terms,
    polynomial_powers,
    trend_transformation,
)
from ..photogrammetry.adjustment import Adjustment
from ..photogrammetry.collinearity import (
    AdditionalParameters,
    GroupedFunctions,
    project_with_jacobian,
)
from ..photogrammetry.elimination import factorize
from ..photogrammetry.network import Network
from ..photogrammetry.noise import Noise
from ..photogrammetry.normal_equations import normal_equations
from ..photogrammetry.precision import information_of_additional, solved_additional
from ..photogrammetry.rotations import inverse_of_positive
from ..photogrammetry.unknowns import INTERIOR_SIZE, POSE_SIZE
from .estimator import GaugeKind, gauge_basis

TERMS = len(cubic_terms())  # number of terms of the cubic trend without the gauge
# Square sum of the terms over its expectation for independent residuals above which the distortion
# varies. Object points and the common distortion absorb a part of the residuals: constant
# distortions have 0.4 to 0.8 (docs/how_good/pathologies.md).
VARYING = 0.85
# Prior degrees of freedom of the variances of a change of the interior orientation: the number of
# exposures that the other terms count as. Variances of the terms of a smooth field scatter so.
LIKE_OTHERS = 4
MIN_OBSERVATIONS = 3  # for each unknown of an exposure whose terms are tested
MIN_POINTS = MIN_OBSERVATIONS * (TERMS + POSE_SIZE) // 2  # image points, for cubic terms


@dataclass(frozen=True)
class Variation:
    """Change of a distortion between exposures."""

    #: square sum of the terms of all exposures over its expectation for independent residuals
    chi2_per_dof: float
    size_px: float  #: RMS of a coordinate of the change [px], less the contribution of noise
    noise_px: float  #: standard deviation of a coordinate after a fit of the terms [px]

    @property
    def is_varying(self) -> bool:
        """Whether the residuals show a change."""
        return self.chi2_per_dof > VARYING


def exposure_functions(
    uv: NDArray[np.float64],
    image_size: tuple[int, int],
    interior: NDArray[np.float64],
    with_interior: bool = False,
    kind: GaugeKind = GaugeKind.FULL,
    degree: int = CUBIC,
) -> NDArray[np.float64]:
    """Return values (N, 2, t) of the terms at pixels uv (N, 2), orthogonal and of RMS one.

    The first 14 are cubic; degree 5 adds 22. They are orthogonal to the gauge about interior (3,),
    which orientations absorb. with_interior: add three terms for a change of the interior
    orientation, which is the part of the gauge that a rotation of the sensor does not absorb. kind
    TREND: the first complete the gauge to all cubic polynomials, as the gauge of the series
    requires; the sum of a series and of orthogonal terms could be a tilt, and nothing else
    determines the tilt of targets parallel to the image.
    """
    to_terms, count = trend_transformation(CUBIC)
    as_polynomials = np.linalg.inv(to_terms)[:, :count].reshape(2, -1, count)
    values = np.einsum('nm,amt->nat', Functions(image_size, CUBIC)(uv), as_polynomials)
    gauge = gauge_basis(uv, interior)
    apart = gauge_basis(uv, interior, GaugeKind.NONE) if kind is GaugeKind.TREND else gauge
    q = _orthogonal(apart, values)
    if degree > CUBIC:
        q = np.hstack(
            [q, _orthogonal(np.dstack([gauge, values]), _higher(uv, image_size, degree))]
        )
    if with_interior:
        turns = gauge_basis(uv, interior, GaugeKind.TURNS).reshape(2 * len(uv), -1)
        turns = np.linalg.qr(turns)[0]
        flat = gauge.reshape(2 * len(uv), -1)
        remainder = flat - turns @ (turns.T @ flat)
        q = np.hstack([q, np.linalg.svd(remainder, full_matrices=False)[0][:, :INTERIOR_SIZE]])
    return q.reshape(len(uv), 2, -1) * np.sqrt(2 * len(uv))


def _orthogonal(
    others: NDArray[np.float64], functions: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return an orthonormal basis (2 n, t) of functions (n, 2, t), orthogonal to others (n, 2, k).

    It is that of Gram and Schmidt, in the order of the functions.
    """
    columns = np.dstack([others, functions]).reshape(2 * len(functions), -1)
    return np.linalg.qr(columns)[0][:, others.shape[2] :]


def _higher(
    uv: NDArray[np.float64], image_size: tuple[int, int], degree: int
) -> NDArray[np.float64]:
    """Return the polynomials (n, 2, t) beyond cubic ones, for u and then for v."""
    functions = Functions(image_size, degree)
    values = functions(uv)[:, np.sum(functions.powers, axis=1) > CUBIC]
    zeros = np.zeros_like(values)
    return np.stack([np.hstack([values, zeros]), np.hstack([zeros, values])], axis=1)


def is_determined(exposure: NDArray[np.int64], fewest: int) -> bool:
    """Return whether at least `fewest` of the exposures (n,) have enough image points."""
    return int(np.sum(np.unique(exposure, return_counts=True)[1] >= MIN_POINTS)) >= fewest


def variation(
    residuals: NDArray[np.float64],
    exposure: NDArray[np.int64],
    functions: NDArray[np.float64],
    first: int = 0,
) -> Variation:
    """Return the change of the distortion that residuals show.

    residuals (n, 2) [px] of inliers, their exposures (n,), and the values (n, 2, t) of
    `exposure_functions`. first: term from which on they are tested, beside those before. The noise
    variance is that of the residuals after a fit of the terms.
    """
    fewest = MIN_OBSERVATIONS * (functions.shape[2] + POSE_SIZE) // 2
    explained = 0.0
    unexplained = 0.0
    dof = 0
    dof_left = 0
    points = 0
    for number in np.unique(exposure):
        rows = exposure == number
        if rows.sum() < fewest:
            continue
        a = functions[rows].reshape(-1, functions.shape[2])
        q, _ = np.linalg.qr(a)
        squares = (q.T @ residuals[rows].ravel()) ** 2
        explained += float(np.sum(squares[first:]))
        unexplained += float(np.sum(residuals[rows] ** 2) - np.sum(squares))
        dof += a.shape[1] - first
        dof_left += len(a) - a.shape[1] - POSE_SIZE
        points += len(a)
    if not dof or unexplained <= 0:
        return Variation(0.0, 0.0, 0.0)
    noise = unexplained / dof_left
    excess = max(explained - VARYING * dof * noise, 0.0)
    size = float(np.sqrt(excess / points))
    return Variation(explained / (dof * noise), size, float(np.sqrt(noise)))


class ExposureTerms:
    """Terms of every exposure of a fluoroscope as additional parameters.

    Coefficients are ordered exposure by exposure. size_px: initial RMS of a coordinate of the
    change [px]. degree: of the polynomials.
    """

    def __init__(
        self,
        functions: NDArray[np.float64],
        exposure: NDArray[np.int64],
        size_px: float,
        degree: int = CUBIC,
    ) -> None:
        self.degree = degree
        numbers, place = np.unique(exposure, return_inverse=True)
        self.exposures = len(numbers)
        #: functions at the image points; the groups are the exposures
        self.functions = GroupedFunctions(functions, place)
        count = functions.shape[2]
        #: (t,) variance of the coefficients of each term over the exposures [px^2]; t: 14 or 36,
        #: and 3 for a change of the interior orientation
        self.variance = np.full(count, max(size_px**2 / count, ABSENT_VARIANCE))

    @property
    def count(self) -> int:
        """Number of coefficients."""
        return self.functions.count

    @property
    def precision(self) -> NDArray[np.float64]:
        """Prior precisions (t e,) of the coefficients."""
        return np.tile(1 / self.variance, self.exposures)

    @property
    def size_px(self) -> float:
        """RMS of a coordinate of the change [px]."""
        return float(np.sqrt(np.sum(self.variance)))

    def renew(self, mean: NDArray[np.float64], posterior: NDArray[np.float64]) -> None:
        """Update the variances from coefficients (t e,) and their posterior variances (t e,)."""
        mean = mean.reshape(self.exposures, -1)
        posterior = posterior.reshape(self.exposures, -1)
        determined = np.clip(1 - posterior / self.variance, 1e-6, 1).sum(axis=0)
        squares = np.sum(mean**2, axis=0)
        typical = np.sum(squares[:TERMS]) / np.sum(determined[:TERMS])
        polynomials = 2 * len(polynomial_powers(self.degree)) - len(GAUGE)
        is_interior = np.arange(len(squares)) >= polynomials
        squares = squares + LIKE_OTHERS * typical * is_interior
        # The mean of inverse chi squared has two degrees of freedom less.
        exposures = determined + (LIKE_OTHERS - 2) * is_interior
        self.variance = np.maximum(squares / exposures, ABSENT_VARIANCE)


def without_exposure_terms(
    information: NDArray[np.float64],
    right: NDArray[np.float64],
    precision: NDArray[np.float64],
    count: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Eliminate all but the first coefficients; return information (c, c) and right side (c,).

    precision (p - c,): prior precisions of the eliminated coefficients.
    """
    eliminated = information[count:, count:] + np.diag(precision)
    mixed = information[count:, :count]
    solved = np.linalg.solve(eliminated, np.column_stack([mixed, right[count:]]))
    reduced = information[:count, :count] - mixed.T @ solved[:, :-1]
    return reduced, right[:count] - mixed.T @ solved[:, -1]


# Robustness of the terms of exposures (see `exposure_terms`) against common errors of the survey.
#
# Errors of the survey are assumed to be independent. Common errors, such as of a sheet that is
# bent or has shrunk in one direction, look like terms that change as the phantom is turned,
# because such terms are more likely than errors of so many points. Object points must not lend the
# terms their likelihood. The variances of the terms are therefore estimated with nearly free
# object points, by restricted likelihood (Patterson and Thompson, "Recovery of inter-block
# information when block sizes are unequal", Biometrika 58, 1971). The difference to expect of a
# later exposure is the size of the part that neither orientations nor object points absorb, a
# variance component by the method of moments (Searle, Casella and McCulloch, "Variance
# Components", Wiley 1992, chapter 5).

NEARLY_FREE = 10.0  # factor of the standard deviations of the survey


def estimates_beside_free_points(
    network: Network, adjustment: Adjustment
) -> tuple[tuple[NDArray[np.float64], NDArray[np.float64]], ...]:
    """Return coefficients (p,) and their variances (p,) by fluoroscope, with nearly free points.

    network: has additional parameters for each fluoroscope; it is linearised at the adjustment.
    Raises numpy.linalg.LinAlgError where it does not determine the coefficients.
    """
    free = replace(network, survey_sd_mm=NEARLY_FREE * network.survey_sd_mm)
    factor = adjustment.noise.information_factor(adjustment.q)
    equations = normal_equations(free, adjustment.parameters, 0.0, adjustment.noise, factor)
    matrix = factorize(free, equations)
    means = solved_additional(matrix, free, adjustment)
    informations = (information_of_additional(matrix, f) for f in range(len(means)))
    return tuple(
        (mean, np.diagonal(np.linalg.inv(information)))
        for mean, information in zip(means, informations)
    )


def variance_between_exposures(
    network: Network,
    adjustment: Adjustment,
    f: int,
    terms: ExposureTerms,
    coefficients: NDArray[np.float64],
    covariance: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return variances [px^2] of terms of exposures, less what orientations absorb.

    Parameters
    ----------
    network : Network
    adjustment : Adjustment
        Adjustment of the network.
    f : int
        Number of the fluoroscope.
    terms : ExposureTerms
        Terms of the exposures of this fluoroscope.
    coefficients : (p,) ndarray
        Estimated coefficients of the terms [px].
    covariance : (p, p) ndarray
        Their covariance.

    Returns
    -------
    (i,) ndarray
        Variances of the inliers among the image points of the fluoroscope.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where the network does not determine orientations and object points.
    """
    variance = np.tile(terms.variance, terms.exposures)
    information = _information(network, adjustment, f, terms)
    expected = float(variance @ np.diagonal(information))
    if not expected > 0:
        return np.zeros(int(adjustment.inliers[network.rows(f)].sum()))
    estimated = float(coefficients @ information @ coefficients + np.sum(information * covariance))
    return estimated / expected * _variances_left(network, adjustment, f, terms)


def _information(
    network: Network, adjustment: Adjustment, f: int, terms: ExposureTerms
) -> NDArray[np.float64]:
    """Return the information (p, p) of the terms if only orientations and points are unknown."""
    additional: list[AdditionalParameters | None] = [None] * network.n_fluoroscopes
    start: list[NDArray[np.float64] | None] = [None] * network.n_fluoroscopes
    no_functions = np.zeros((len(network.rows(f)), 0))
    additional[f] = AdditionalParameters(no_functions, np.diag(terms.precision), terms.functions)
    start[f] = np.zeros(terms.count)
    fixed_network = replace(
        network,
        sigma=np.where(adjustment.inliers, network.sigma, np.inf),  # outliers have no weight
        interior_free=np.zeros(network.n_fluoroscopes, dtype=bool),
        additional=tuple(additional),
    )
    parameters = replace(adjustment.parameters, additional=tuple(start))
    equations = normal_equations(
        fixed_network, parameters, 0.0, Noise('gaussian', adjustment.noise.scale)
    )
    matrix = factorize(fixed_network, equations)
    return information_of_additional(matrix, f) - np.diag(terms.precision)


def _variances_left(
    network: Network, adjustment: Adjustment, f: int, terms: ExposureTerms
) -> NDArray[np.float64]:
    """Return expected squares (i,) [px^2] of terms at inliers, less what orientations absorb."""
    rows = network.rows(f)
    inliers = adjustment.inliers[rows]
    _, by_exterior, _, _ = project_with_jacobian(*network.per_image_point(adjustment.parameters))
    exposure = network.exposure[rows]
    squares = np.zeros(len(rows))
    for number in np.unique(exposure):
        selected = inliers & (exposure == number)
        values = terms.functions.values[selected].reshape(2 * int(selected.sum()), -1)
        # Scale the six unknowns so that they matter alike.
        absorbed = by_exterior[rows[selected]].reshape(len(values), -1)
        absorbed = absorbed / np.linalg.norm(absorbed, axis=0)
        remainder = values - absorbed @ np.linalg.lstsq(absorbed, values, rcond=None)[0]
        squares[selected] = (remainder**2 @ terms.variance).reshape(-1, 2).mean(axis=1)
    return squares[inliers]


# Estimation of a distortion that changes with the angle of a C-arm.
#
# The terms that the adjustment estimates for every exposure are a function of the angle, a sum of
# its harmonics (see `angle_field`), plus a random difference. All coefficients are random effects
# whose variances have the largest marginal likelihood (MacKay, "Bayesian interpolation", Neural
# Computation 4, 1992).

MIN_SPREAD = np.deg2rad(2)  # least RMS spread of the angles
STEPS = 60  # most iterations of the variances
SETTLED = 1e-3  # relative change of the variances at convergence
MIN_SHARE = 0.05  # of the variance between exposures that the angle must explain to be a cause


@dataclass(frozen=True)
class Effects:
    """Coefficients of the harmonics of all terms of exposures, harmonic by harmonic."""

    mean: NDArray[np.float64]  #: (q,) [px]
    covariance: NDArray[np.float64]  #: (q, q)
    mixed: NDArray[np.float64]  #: (c, q) covariance of the series coefficients with the effects


@dataclass(frozen=True)
class AngleFit:
    """A series and its terms of exposures, once the terms are a function of the angle."""

    field: AngleField
    coefficients: NDArray[np.float64]  #: (c,) coefficients of the series, those of u first [px]
    covariance: NDArray[np.float64]  #: (c, c)
    remaining: float  #: share of the variance between exposures that the angle does not explain
    effects: Effects  #: effects from which the field is made


@dataclass(frozen=True)
class SeriesWithExposures:
    """Estimated coefficients of a series, followed by those of terms of exposures."""

    functions: Functions  #: functions of the series
    uv: NDArray[np.float64]  #: (N, 2) image points to whose exposures the terms belong [px]
    terms: ExposureTerms
    coefficients: NDArray[np.float64]  #: (p,) [px]
    covariance: NDArray[np.float64]  #: (p, p)


def can_be_fitted(angles: NDArray[np.float64]) -> bool:
    """Return whether the angles (e,) [rad] of exposures are known, enough, and spread."""
    if len(angles) < HARMONICS or not np.isfinite(angles).all():
        return False
    return bool(np.sqrt(np.mean(np.var(harmonics(angles)[:, :2], axis=0))) > MIN_SPREAD)


def fit_angles(estimated: SeriesWithExposures, angles: NDArray[np.float64]) -> AngleFit | None:
    """Return series and terms as a function of the angles (e,) [rad] of the exposures.

    None if the angles do not explain the terms, or the terms are not determined.
    """
    with suppress(np.linalg.LinAlgError):
        return _fit(estimated, angles)
    return None


def _fit(estimated: SeriesWithExposures, angles: NDArray[np.float64]) -> AngleFit | None:
    """Compute `fit_angles`; raises LinAlgError."""
    h = harmonics(angles) - harmonics(angles).mean(axis=0)
    c = 2 * len(estimated.functions)
    term_covariance = estimated.covariance[c:, c:]
    precision = np.linalg.inv(term_covariance)
    precision = (precision + precision.T) / 2
    effects = _Effects(estimated.terms, h)
    mean, covariance = effects.estimate(
        precision - np.diag(estimated.terms.precision), precision @ estimated.coefficients[c:]
    )
    if effects.explained(h) < MIN_SHARE:
        return None
    # A change of the terms changes the series by their covariance.
    by_terms = np.linalg.solve(term_covariance, estimated.covariance[c:, :c]).T
    change = effects.design @ mean - estimated.coefficients[c:]
    reduction = term_covariance - effects.design @ covariance @ effects.design.T
    series_covariance = estimated.covariance[:c, :c] - by_terms @ reduction @ by_terms.T
    count = effects.count
    mixed = by_terms @ effects.design @ covariance[:, :count]
    field_effects = Effects(mean[:count], covariance[:count, :count], mixed)
    return AngleFit(
        field_of(estimated, angles, field_effects),
        estimated.coefficients[:c] + by_terms @ change,
        series_covariance,
        1 - effects.explained(h),
        field_effects,
    )


class _Effects:
    """Coefficients of the harmonics of every term, then the remainder of it in every exposure.

    The variances of the terms keep their proportions over the exposures. One factor for each order
    of the harmonics, and one for the random remainder, are estimated from all terms.
    """

    def __init__(self, exposure_terms: ExposureTerms, h: NDArray[np.float64]) -> None:
        terms = len(exposure_terms.variance)
        self.design = np.hstack([np.kron(h, np.eye(terms)), np.eye(len(h) * terms)])
        self.count = HARMONICS * terms
        order_of_harmonic = np.repeat(np.arange(HARMONICS) // 2, terms)
        self._factor_of = np.append(order_of_harmonic, np.full(len(h) * terms, ORDERS))
        size = float(np.mean(h**2))
        unit = np.append(np.full(self.count, 1 / size), np.ones(len(h) * terms))
        self._unit = unit * np.tile(exposure_terms.variance, HARMONICS + len(h))
        self._factors = np.full(ORDERS + 1, 1 / (ORDERS + 1))

    @property
    def _variance(self) -> NDArray[np.float64]:
        return np.maximum(self._factors[self._factor_of] * self._unit, ABSENT_VARIANCE)

    def estimate(
        self, information: NDArray[np.float64], right: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return mean and covariance of all effects, with the most likely variances.

        information, right: normal equations of the terms of the exposures, without their prior.
        """
        matrix = self.design.T @ information @ self.design
        vector = self.design.T @ right
        for _ in range(STEPS):
            variance = self._variance
            covariance = inverse_of_positive(matrix + np.diag(1 / variance))
            mean = covariance @ vector
            determined = np.clip(1 - np.diagonal(covariance) / variance, 1e-6, 1)
            squares = np.bincount(self._factor_of, mean**2 / self._unit)
            last = self._factors
            self._factors = squares / np.bincount(self._factor_of, determined)
            if np.max(np.abs(self._factors - last)) < SETTLED * np.max(self._factors):
                break
        covariance = inverse_of_positive(matrix + np.diag(1 / self._variance))
        return covariance @ vector, covariance

    def explained(self, h: NDArray[np.float64]) -> float:
        """Return the share of the variance between exposures that harmonics h (e, 4) explain."""
        variance = self._variance
        harmonic_variance = variance[: self.count].reshape(HARMONICS, -1).sum(axis=1)
        by_angle = float(np.mean(h**2, axis=0) @ harmonic_variance)
        at_random = float(variance[self.count :].sum()) / len(h)
        return by_angle / (by_angle + at_random)


def field_of(
    estimated: SeriesWithExposures, angles: NDArray[np.float64], effects: Effects
) -> AngleField:
    """Return the field of the effects of angles (e,) [rad] on estimated terms."""
    size = estimated.functions.image_size
    powers = Functions(size, estimated.terms.degree)
    values = powers(estimated.uv)
    term_values = estimated.terms.functions.values
    # This solution is exact, because the terms are polynomials.
    to_powers = [np.linalg.lstsq(values, term_values[:, axis], rcond=None)[0] for axis in (0, 1)]
    by_harmonic = effects.mean.reshape(HARMONICS, -1)
    coefficients = np.stack([by_harmonic @ matrix.T for matrix in to_powers], axis=1)
    pixels = sd_grid_pixels(size)
    series = estimated.functions(pixels)
    terms = [powers(pixels) @ matrix for matrix in to_powers]
    m = series.shape[1]
    count = by_harmonic.shape[1]
    cross = effects.mixed.reshape(2, m, HARMONICS, count)
    pairs = effects.covariance.reshape(HARMONICS, count, HARMONICS, count)
    with_series = [
        np.mean(
            [np.sum((series @ cross[axis, :, j]) * terms[axis], axis=1) for axis in (0, 1)], axis=0
        )
        for j in range(HARMONICS)
    ]
    with_each_other = [
        np.mean([np.sum((t @ pairs[j, :, k]) * t, axis=1) for t in terms], axis=0)
        for j, k in PAIRS
    ]
    grids = np.stack([*with_series, *with_each_other]).reshape(VARIANCES, SD_GRID, SD_GRID)
    return AngleField(size, angles, coefficients, grids)
