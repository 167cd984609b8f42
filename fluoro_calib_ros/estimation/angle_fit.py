# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Estimation of a distortion that changes with the angle of a C-arm.

The terms that the adjustment estimates of every exposure (see `exposure_terms`) are a function of
the angle, a sum of its harmonics (see `angle_field`), plus what differs at random. All
coefficients are random effects whose variances have the largest marginal likelihood (MacKay,
"Bayesian interpolation", Neural Computation 4, 1992).
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from ..correction.angle_field import PAIRS, AngleField, harmonics
from ..correction.calibration_record import HARMONICS, ORDERS, SD_GRID, VARIANCES
from ..correction.series import Functions, sd_grid_pixels
from ..correction.terms import ABSENT_VARIANCE, CUBIC
from .exposure_terms import ExposureTerms

MIN_SPREAD = np.deg2rad(2)  # of the angles
STEPS = 60  # of the variances
SETTLED = 1e-3  # relative change of the variances
MIN_SHARE = 0.05  # of what differs between exposures that the angle explains, else it is no cause


@dataclass(frozen=True)
class Effects:
    """Coefficients of the harmonics of all terms of exposures, harmonic by harmonic."""

    mean: NDArray[np.float64]  #: (q,) [px]
    covariance: NDArray[np.float64]  #: (q, q)
    mixed: NDArray[np.float64]  #: (c, q) covariance of the coefficients of the series with these


@dataclass(frozen=True)
class AngleFit:
    """A series and the terms of exposures, once these are a function of the angle."""

    field: AngleField
    coefficients: NDArray[np.float64]  #: (c,) of the series, those of u first [px]
    covariance: NDArray[np.float64]  #: (c, c)
    remaining: float  #: share of the variance between exposures that the angle does not explain
    effects: Effects  #: of which the field is made


@dataclass(frozen=True)
class SeriesWithExposures:
    """Estimated coefficients of a series, and after them those of terms of exposures."""

    functions: Functions  #: of the series
    uv: NDArray[np.float64]  #: (N, 2) image points to whose exposures the terms belong [px]
    terms: ExposureTerms
    coefficients: NDArray[np.float64]  #: (p,) [px]
    covariance: NDArray[np.float64]  #: (p, p)


def can_be_fitted(angles: np.ndarray) -> bool:
    """Whether angles (e,) [rad] of exposures are known, enough, and not all alike."""
    if len(angles) < HARMONICS or not np.isfinite(angles).all():
        return False
    return bool(np.sqrt(np.mean(np.var(harmonics(angles)[:, :2], axis=0))) > MIN_SPREAD)


def fit_angles(estimated: SeriesWithExposures, angles: np.ndarray) -> AngleFit | None:
    """Return series and terms as a function of the angles (e,) [rad] of the exposures.

    None where they do not explain the terms, or the terms are not determined.
    """
    with suppress(np.linalg.LinAlgError):
        return _fit(estimated, angles)
    return None


def _fit(estimated: SeriesWithExposures, angles: np.ndarray) -> AngleFit | None:
    """See `fit_angles`; raises LinAlgError."""
    h = harmonics(angles) - harmonics(angles).mean(axis=0)
    c = 2 * len(estimated.functions)
    own = estimated.covariance[c:, c:]
    precision = np.linalg.inv(own)
    precision = (precision + precision.T) / 2
    effects = _Effects(estimated.terms, h)
    mean, covariance = effects.estimate(
        precision - np.diag(estimated.terms.precision), precision @ estimated.coefficients[c:]
    )
    if effects.explained(h) < MIN_SHARE:
        return None
    # What changes of the terms changes the series as their covariance says.
    by_terms = np.linalg.solve(own, estimated.covariance[c:, :c]).T
    moved = effects.design @ mean - estimated.coefficients[c:]
    lost = own - effects.design @ covariance @ effects.design.T
    of_series = estimated.covariance[:c, :c] - by_terms @ lost @ by_terms.T
    count = effects.count
    mixed = by_terms @ effects.design @ covariance[:, :count]
    of_field = Effects(mean[:count], covariance[:count, :count], mixed)
    return AngleFit(
        field_of(estimated, angles, of_field),
        estimated.coefficients[:c] + by_terms @ moved,
        of_series,
        1 - effects.explained(h),
        of_field,
    )


class _Effects:
    """Coefficients of the harmonics of every term, then what differs of it in every exposure.

    The terms keep the proportions of their variances over the exposures. One factor for each order
    of the harmonics, and one for what is random, are estimated from all terms.
    """

    def __init__(self, own: ExposureTerms, h: np.ndarray) -> None:
        terms = len(own.variance)
        self.design = np.hstack([np.kron(h, np.eye(terms)), np.eye(len(h) * terms)])
        self.count = HARMONICS * terms
        of_harmonics = np.repeat(np.arange(HARMONICS) // 2, terms)
        self._factor_of = np.append(of_harmonics, np.full(len(h) * terms, ORDERS))
        size = float(np.mean(h**2))
        unit = np.append(np.full(self.count, 1 / size), np.ones(len(h) * terms))
        self._unit = unit * np.tile(own.variance, HARMONICS + len(h))
        self._factors = np.full(ORDERS + 1, 1 / (ORDERS + 1))

    @property
    def _variance(self) -> np.ndarray:
        return np.maximum(self._factors[self._factor_of] * self._unit, ABSENT_VARIANCE)

    def estimate(
        self, information: np.ndarray, right: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Mean and covariance of all effects, with the most likely variances.

        information, right: normal equations of the terms of the exposures, without their prior.
        """
        matrix = self.design.T @ information @ self.design
        vector = self.design.T @ right
        for _ in range(STEPS):
            variance = self._variance
            root = _inverse_root(matrix + np.diag(1 / variance))
            mean = root.T @ (root @ vector)
            determined = np.clip(1 - np.sum(root**2, axis=0) / variance, 1e-6, 1)
            squares = np.bincount(self._factor_of, mean**2 / self._unit)
            last = self._factors
            self._factors = squares / np.bincount(self._factor_of, determined)
            if np.max(np.abs(self._factors - last)) < SETTLED * np.max(self._factors):
                break
        root = _inverse_root(matrix + np.diag(1 / self._variance))
        covariance = root.T @ root
        return covariance @ vector, covariance

    def explained(self, h: np.ndarray) -> float:
        """Share of the variance between exposures that harmonics h (e, 4) explain."""
        variance = self._variance
        of_harmonics = variance[: self.count].reshape(HARMONICS, -1).sum(axis=1)
        by_angle = float(np.mean(h**2, axis=0) @ of_harmonics)
        at_random = float(variance[self.count :].sum()) / len(h)
        return by_angle / (by_angle + at_random)


def _inverse_root(matrix: np.ndarray) -> np.ndarray:
    """Lower triangular matrix R with the inverse R^T R of a positive definite matrix."""
    factor = np.asfortranarray(np.linalg.cholesky(matrix))
    root, failed = lapack.dtrtri(factor, lower=1, overwrite_c=1)
    if failed:
        raise np.linalg.LinAlgError('the terms of the exposures are not determined')
    return root


def field_of(estimated: SeriesWithExposures, angles: np.ndarray, effects: Effects) -> AngleField:
    """Field of the effects of angles (e,) [rad] on estimated terms."""
    size = estimated.functions.image_size
    cubic = Functions(size, CUBIC)
    values = cubic(estimated.uv)
    of_terms = estimated.terms.functions.values
    # Terms are cubic polynomials: this solution is exact.
    to_cubic = [np.linalg.lstsq(values, of_terms[:, axis], rcond=None)[0] for axis in (0, 1)]
    by_harmonic = effects.mean.reshape(HARMONICS, -1)
    coefficients = np.stack([by_harmonic @ matrix.T for matrix in to_cubic], axis=1)
    pixels = sd_grid_pixels(size)
    series = estimated.functions(pixels)
    terms = [cubic(pixels) @ matrix for matrix in to_cubic]
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
