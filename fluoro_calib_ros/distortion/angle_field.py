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

"""Distortion that changes with the angle of a C-arm.

The magnetic field along the axis of an image intensifier is that of the earth, turned with the
C-arm: its components are cosines and sines of the angle; what the arm itself magnetises adds the
second harmonic (Fahrig et al., "Three-dimensional computed tomographic reconstruction using a
C-arm mounted XRII: correction of image intensifier distortion", Medical Physics 24, 1997). The
terms that the adjustment estimates of every exposure (see `exposure_terms`) are therefore a
function of the angle, a sum of these harmonics less their mean over the exposures, plus what
differs at random. All coefficients are random effects whose variances have the largest marginal
likelihood (MacKay, "Bayesian interpolation", Neural Computation 4, 1992).
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import lapack
from scipy.ndimage import map_coordinates

from .exposure_terms import MIN_VARIANCE, TREND_DEGREE, ExposureTerms
from .series import SD_GRID, Functions, Series, sd_grid_pixels

ORDERS = 2  # harmonics of the angle
HARMONICS = 2 * ORDERS
PAIRS = [(j, k) for j in range(HARMONICS) for k in range(j, HARMONICS)]
VARIANCES = HARMONICS + len(PAIRS)
MAX_DISTANCE = np.deg2rad(15)  # of an angle from the next one that was calibrated
MIN_ANGLES = 4  # with different fields, to tell them from chance
MIN_SPREAD = np.deg2rad(2)  # of the angles
MIN_SIZE = 1e-6  # mean square of the harmonics
TERMS = (TREND_DEGREE + 1) * (TREND_DEGREE + 2) // 2  # of a polynomial of two variables
# Of the arrays that `packed_angles` gives; None: as many as there are exposures.
PACKED_SHAPES = (None, (HARMONICS, 2, TERMS), (VARIANCES, SD_GRID, SD_GRID))
STEPS = 60  # of the variances
SETTLED = 1e-3  # relative change of the variances
MIN_SHARE = 0.05  # of what differs between exposures that the angle explains, else it is no cause


def harmonics(angle: ArrayLike) -> np.ndarray:
    """Cosines and sines (..., 4) of angles (...) [rad], by order."""
    multiple = np.asarray(angle, dtype=float)[..., None] * np.arange(1, ORDERS + 1)
    both = np.stack([np.cos(multiple), np.sin(multiple)], axis=-1)
    return both.reshape(*both.shape[:-2], HARMONICS)


@dataclass(frozen=True)
class _Change:
    """What an angle adds to a correction.

    Attributes
    ----------
    coefficients : (4, k, 2, 4) ndarray
        Of x^i y^j, in the order i, field, u or v, j: the change, then fields of what is unknown.
    variance : (33, 33) ndarray
        On the grid of the standard deviation [px^2].
    scatters : bool
        Whether there are fields of what is unknown.
    """

    coefficients: np.ndarray
    variance: np.ndarray
    scatters: bool


@dataclass(frozen=True)
class AngleField:
    """Change of a correction with the angle, relative to its mean over the exposures.

    Attributes
    ----------
    image_size : (int, int)
        Width and height [px].
    angles : (e,) ndarray
        Angles of the exposures [rad].
    coefficients : (4, 2, 10) ndarray
        Of each harmonic less its mean: those of cubic polynomials of the pixel for u and v, in
        the order and coordinates of `series.Functions` [px].
    variances : (14, 33, 33) ndarray
        On the grid of the standard deviation of a series [px^2]: covariances of the correction
        without angle and each harmonic, then those of pairs of harmonics.

    Raises
    ------
    ValueError
        For arrays of other shapes, or values that are not finite.
    """

    image_size: tuple[int, int]
    angles: np.ndarray
    coefficients: np.ndarray
    variances: np.ndarray

    def __post_init__(self) -> None:
        shapes = {
            'angles': (len(self.angles),),
            'coefficients': (HARMONICS, 2, len(self._functions)),
            'variances': (VARIANCES, SD_GRID, SD_GRID),
        }
        for name, shape in shapes.items():
            values = np.ascontiguousarray(getattr(self, name), dtype=float)
            if values.shape != shape or not values.size:
                raise ValueError(f'{name} of an angle field have shape {values.shape}')
            if not np.isfinite(values).all():
                raise ValueError(f'{name} of an angle field are not all finite')
            object.__setattr__(self, name, values)

    @cached_property
    def _functions(self) -> Functions:
        return Functions(self.image_size, TREND_DEGREE)

    @cached_property
    def _mean(self) -> np.ndarray:
        return harmonics(self.angles).mean(axis=0)

    @cached_property
    def _spread(self) -> np.ndarray:
        """Mean products (4, 4) of the harmonics over the exposures, less their mean."""
        h = harmonics(self.angles) - self._mean
        return h.T @ h / len(h)

    @property
    def range(self) -> tuple[float, float]:
        """Least and largest angle of the exposures [rad]."""
        return float(self.angles.min()), float(self.angles.max())

    @property
    def size_px(self) -> float:
        """RMS of a coordinate of the change, over the image and the exposures [px]."""
        fields = self._functions(sd_grid_pixels(self.image_size)) @ self.coefficients.transpose(
            0, 2, 1
        )
        square = np.einsum('jna,jk,kna->', fields, self._spread, fields)
        return float(np.sqrt(square / (2 * fields.shape[1])))

    def covers(self, angle: ArrayLike) -> np.ndarray:
        """Whether angles (...) [rad] are near a calibrated one; True where unknown (NaN)."""
        angle = np.asarray(angle, dtype=float)
        distance = np.abs(np.angle(np.exp(1j * (angle[..., None] - self.angles))))
        return ~(distance.min(axis=-1) > MAX_DISTANCE)

    def nearest_common(self, other: AngleField) -> float:
        """Angle [rad] of these exposures that is nearest to one of another field."""
        turn = np.exp(1j * self.angles)[:, None] / np.exp(1j * other.angles)
        return float(self.angles[np.argmin(np.abs(np.angle(turn)).min(axis=1))])

    def change(self, uv: ArrayLike, angle: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Return what an angle adds to a correction and to its variance.

        Parameters
        ----------
        uv : (n, 2) array_like
            Observed pixels.
        angle : float or (n,) array_like
            Angle [rad]. NaN: it is unknown, the correction is the mean over the exposures, and
            its variance holds what the angle changes.

        Returns
        -------
        duv : (n, 2) ndarray
            To be added to the correction [px].
        variance : (n,) ndarray
            To be added to the variance of each coordinate [px^2]; it can be negative.
        """
        uv = np.asarray(uv, dtype=float).reshape(-1, 2)
        angles = np.asarray(angle, dtype=float)
        if angles.ndim == 0:
            return self._change_at(uv, float(angles))
        duv = np.zeros_like(uv)
        variance = np.zeros(len(uv))
        for value in np.unique(angles[~np.isnan(angles)]):
            rows = angles == value
            duv[rows], variance[rows] = self._change_at(uv[rows], float(value))
        rows = np.isnan(angles)
        duv[rows], variance[rows] = self._change_at(uv[rows], np.nan)
        return duv, variance

    def added_to(self, series: Series, angle: float) -> Series:
        """Return a series at an angle [rad], with its standard deviations there."""
        weights = harmonics(angle) - self._mean
        change = np.tensordot(weights, self.coefficients, axes=1)
        functions = series.functions
        _, variance = self._change_at(sd_grid_pixels(self.image_size), angle)
        return Series(
            functions,
            series.coefficients
            + functions.converted(self._functions, change.ravel()).reshape(2, -1),
            np.sqrt(np.maximum(series.sd**2 + variance.reshape(series.sd.shape), 0)),
        )

    def _change_at(self, uv: np.ndarray, angle: float) -> tuple[np.ndarray, np.ndarray]:
        found = self._unknown if np.isnan(angle) else self._known(angle)
        values = self._values(uv, found.coefficients)
        variance = self._at(uv, found.variance)
        if found.scatters:
            variance = variance + np.einsum('nka,nka->n', values[:, 1:], values[:, 1:]) / 2
        return values[:, 0], variance

    def _known(self, angle: float) -> _Change:
        """Return the change at an angle; that of the last one is kept: arms stand still."""
        last = self.__dict__.get('_last')
        if last is None or last[0] != angle:
            weights = harmonics(angle) - self._mean
            last = angle, self._change(weights, np.outer(weights, weights), weights[None])
            self.__dict__['_last'] = last  # as a whole, for other threads
        found: _Change = last[1]
        return found

    @cached_property
    def _unknown(self) -> _Change:
        """The change at an unknown angle: none, and the scatter over all exposures."""
        size, axes = np.linalg.eigh(self._spread)
        roots = axes.T * np.sqrt(np.maximum(size, 0))[:, None]
        weights = np.zeros(HARMONICS)
        return self._change(weights, self._spread, np.vstack([weights, roots]))

    def _change(self, weights: np.ndarray, products: np.ndarray, fields: np.ndarray) -> _Change:
        """Return a change from weights of the harmonics, their products, and those of fields."""
        j, k = np.transpose(PAIRS)
        factors = np.concatenate([2 * weights, products[j, k] * np.where(j == k, 1, 2)])
        coefficients = np.tensordot(fields, self.coefficients, axes=1)
        square = np.zeros((TREND_DEGREE + 1, *coefficients.shape[:2], TREND_DEGREE + 1))
        for term, (x, y) in enumerate(self._functions.powers):
            square[x, :, :, y] = coefficients[:, :, term]
        variance = np.tensordot(factors, self.variances, axes=1)
        return _Change(square, variance, len(fields) > 1)

    def _values(self, uv: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
        """Values (n, k, 2) of k fields, from the coefficients of a `_Change`."""
        side = max(self.image_size) / 2
        powers = np.empty((TREND_DEGREE + 1, len(uv), 2))
        powers[0] = 1
        powers[1] = (uv - (np.asarray(self.image_size) - 1) / 2) / side
        for order in range(2, TREND_DEGREE + 1):
            np.multiply(powers[order - 1], powers[1], out=powers[order])
        by_y = powers[:, :, 0].T @ coefficients.reshape(TREND_DEGREE + 1, -1)
        by_y = by_y.reshape(len(uv), *coefficients.shape[1:])
        return np.einsum('nkay,yn->nka', by_y, powers[:, :, 1])

    def _at(self, uv: np.ndarray, grid: np.ndarray) -> np.ndarray:
        """Values (n,) of a grid (33, 33) over the image at pixels uv (n, 2), interpolated."""
        place = (uv + 0.5) / np.asarray(self.image_size) * (SD_GRID - 1)
        return map_coordinates(grid, place[:, ::-1].T, order=1, mode='nearest')


def packed_angles(field: AngleField | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return angles (e,), coefficients (4, 2, 10) and variances (14, 33, 33), as they are saved.

    No field gives empty arrays.
    """
    if field is None:
        return np.zeros(0), np.zeros((0, 2, 0)), np.zeros((0, 0, 0))
    return field.angles, field.coefficients, field.variances


def unpacked_angles(
    image_size: tuple[int, int],
    angles: np.ndarray,
    coefficients: np.ndarray,
    variances: np.ndarray,
) -> AngleField | None:
    """Return the AngleField, or None, from which `packed_angles` made the arguments.

    Raises ValueError if the parts do not belong together.
    """
    if not (np.size(angles) or np.size(coefficients) or np.size(variances)):
        return None
    return AngleField(image_size, angles, coefficients, variances)


@dataclass(frozen=True)
class AngleFit:
    """A series and the terms of exposures, once these are a function of the angle.

    Attributes
    ----------
    field : AngleField
    coefficients : (c,) ndarray
        Of the series, those of u first [px].
    covariance : (c, c) ndarray
    remaining : float
        Share of the variance between exposures that the angle does not explain.
    """

    field: AngleField
    coefficients: np.ndarray
    covariance: np.ndarray
    remaining: float


@dataclass(frozen=True)
class SeriesWithExposures:
    """Estimated coefficients of a series, and after them those of terms of exposures.

    Attributes
    ----------
    functions : Functions
        Of the series.
    uv : (N, 2) ndarray
        Image points to whose exposures the terms belong [px].
    terms : ExposureTerms
    coefficients : (p,) ndarray
        [px]
    covariance : (p, p) ndarray
    """

    functions: Functions
    uv: np.ndarray
    terms: ExposureTerms
    coefficients: np.ndarray
    covariance: np.ndarray


def can_be_fitted(angles: np.ndarray) -> bool:
    """Whether angles (e,) [rad] of exposures are known, enough, and not all alike."""
    if len(angles) < MIN_ANGLES or not np.isfinite(angles).all():
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
    field = _field(estimated, angles, mean[:count], covariance[:count, :count], mixed)
    return AngleFit(
        field,
        estimated.coefficients[:c] + by_terms @ moved,
        of_series,
        1 - effects.explained(h),
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
        size = max(float(np.mean(h**2)), MIN_SIZE)
        unit = np.append(np.full(self.count, 1 / size), np.ones(len(h) * terms))
        self._unit = unit * np.tile(own.variance, HARMONICS + len(h))
        self._factors = np.full(ORDERS + 1, 1 / (ORDERS + 1))

    @property
    def _variance(self) -> np.ndarray:
        return np.maximum(self._factors[self._factor_of] * self._unit, MIN_VARIANCE)

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


def _field(
    estimated: SeriesWithExposures,
    angles: np.ndarray,
    mean: np.ndarray,
    covariance: np.ndarray,
    mixed: np.ndarray,
) -> AngleField:
    """Field of harmonics with coefficients mean (q,) and their covariance (q, q).

    mixed (c, q): covariance with the coefficients of the series.
    """
    size = estimated.functions.image_size
    cubic = Functions(size, TREND_DEGREE)
    values = cubic(estimated.uv)
    of_terms = estimated.terms.functions.values
    # Terms are cubic polynomials: this solution is exact.
    to_cubic = [np.linalg.lstsq(values, of_terms[:, axis], rcond=None)[0] for axis in (0, 1)]
    effects = mean.reshape(HARMONICS, -1)
    coefficients = np.stack([effects @ matrix.T for matrix in to_cubic], axis=1)
    pixels = sd_grid_pixels(size)
    series = estimated.functions(pixels)
    terms = [cubic(pixels) @ matrix for matrix in to_cubic]
    m = series.shape[1]
    count = effects.shape[1]
    cross = mixed.reshape(2, m, HARMONICS, count)
    pairs = covariance.reshape(HARMONICS, count, HARMONICS, count)
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
