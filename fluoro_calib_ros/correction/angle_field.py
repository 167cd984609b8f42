# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Distortion that changes with the angle of a C-arm.

The magnetic field along the axis of an image intensifier is the field of the earth as seen by the
rotating C-arm: its components are cosines and sines of the angle. The magnetisation of the arm
itself adds the second harmonic (Fahrig et al., "Three-dimensional computed tomographic
reconstruction using a C-arm mounted XRII: correction of image intensifier distortion", Medical
Physics 24, 1997). The correction is that of a calibration plus a sum of these harmonics, reduced
by their mean over the exposures, each with a field of its own (see `exposure_terms`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .calibration_record import DEGREES, HARMONICS, ORDERS, SD_GRID, TERMS, VARIANCES
from .series import Functions, Series, at_sd_grid, sd_grid_pixels

PAIRS = [(j, k) for j in range(HARMONICS) for k in range(j, HARMONICS)]
MAX_DISTANCE = np.deg2rad(15)  # maximum angle to the nearest calibrated angle [rad]


def harmonics(angle: ArrayLike) -> NDArray[np.float64]:
    """Return cosines and sines (..., 4) of angles (...) [rad], ordered by harmonic."""
    multiple = np.asarray(angle, dtype=float)[..., None] * np.arange(1, ORDERS + 1)
    waves = np.stack([np.cos(multiple), np.sin(multiple)], axis=-1)
    return waves.reshape(*waves.shape[:-2], HARMONICS)


@dataclass(frozen=True)
class _Change:
    """Change of a correction at an angle."""

    #: (k, 2, t) of the functions, for u and v: first the change, then fields of its uncertainty
    coefficients: NDArray[np.float64]
    variance: NDArray[np.float64]  #: (33, 33) on the grid of the standard deviation [px^2]


@dataclass(frozen=True)
class AngleField:
    """Change of a correction with the angle, relative to its mean over the exposures.

    Raises ValueError for arrays of unexpected shape and for values that are not finite.
    """

    image_size: tuple[int, int]  #: width and height [px]
    angles: NDArray[np.float64]  #: (e,) angles of the exposures [rad]
    #: (4, 2, t) fields of the harmonics less their means: coefficients of polynomials of the pixel
    #: of degree 3 or 5 for u and v, in the order and coordinates of `series.Functions` [px]
    coefficients: NDArray[np.float64]
    #: (14, 33, 33) on the grid of the standard deviation of a series [px^2]: covariances of the
    #: angle-independent correction with each harmonic, then covariances of the pairs of harmonics
    variances: NDArray[np.float64]

    def __post_init__(self) -> None:
        shapes: dict[str, list[tuple[int, ...]]] = {
            'angles': [(len(self.angles),)],
            'coefficients': [(HARMONICS, 2, terms) for terms in TERMS],
            'variances': [(VARIANCES, SD_GRID, SD_GRID)],
        }
        for name, possible in shapes.items():
            values = np.ascontiguousarray(getattr(self, name), dtype=float)
            if values.shape not in possible or not values.size:
                raise ValueError(f'{name} of an angle field have shape {values.shape}')
            if not np.isfinite(values).all():
                raise ValueError(f'{name} of an angle field are not all finite')
            object.__setattr__(self, name, values)

    @cached_property
    def _functions(self) -> Functions:
        return Functions(self.image_size, DEGREES[TERMS.index(self.coefficients.shape[-1])])

    @cached_property
    def _mean(self) -> NDArray[np.float64]:
        return harmonics(self.angles).mean(axis=0)

    @cached_property
    def _spread(self) -> NDArray[np.float64]:
        """Mean products (4, 4) over the exposures of the harmonics less their means."""
        h = harmonics(self.angles) - self._mean
        return h.T @ h / len(h)

    @property
    def range(self) -> tuple[float, float]:
        """Smallest and largest angle of the exposures [rad]."""
        return float(self.angles.min()), float(self.angles.max())

    @property
    def size_px(self) -> float:
        """RMS of a coordinate of the change over the image and the exposures [px]."""
        fields = self._functions(sd_grid_pixels(self.image_size)) @ self.coefficients.transpose(
            0, 2, 1
        )
        square = np.einsum('jna,jk,kna->', fields, self._spread, fields)
        return float(np.sqrt(square / (2 * fields.shape[1])))

    def covers(self, angle: ArrayLike) -> np.ndarray:
        """Return whether angles (...) [rad] are near a calibrated one; True for unknown (NaN)."""
        angle = np.asarray(angle, dtype=float)
        distance = np.abs(np.angle(np.exp(1j * (angle[..., None] - self.angles))))
        return ~(distance.min(axis=-1) > MAX_DISTANCE)

    def nearest_common(self, other: AngleField) -> float:
        """Return the angle [rad] of these exposures that is nearest to one of another field."""
        turn = np.exp(1j * self.angles)[:, None] / np.exp(1j * other.angles)
        return float(self.angles[np.argmin(np.abs(np.angle(turn)).min(axis=1))])

    def change(
        self, uv: ArrayLike, angle: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the change of a correction and of its variance at an angle.

        uv: (n, 2) observed pixels. angle: one or (n,) [rad]; NaN where it is unknown: the
        correction is then the mean over the exposures, and its variance includes the effect of the
        angle. Returns (n, 2) to be added to the correction [px] and (n,) to be added to the
        variance of each coordinate [px^2]; it can be negative.
        """
        uv = np.asarray(uv, dtype=float).reshape(-1, 2)
        angles = np.asarray(angle, dtype=float)
        if angles.ndim == 0:
            return self._change_at(uv, float(angles))
        duv = np.zeros_like(uv)
        variance = np.zeros(len(uv))
        for value in np.unique(angles):
            rows = np.isnan(angles) if np.isnan(value) else angles == value
            duv[rows], variance[rows] = self._change_at(uv[rows], float(value))
        return duv, variance

    def duv(self, uv: NDArray[np.float64], angle: float) -> NDArray[np.float64]:
        """Return the change (n, 2) [px] of a correction at a known angle [rad], at uv (n, 2)."""
        return self._values(uv, self._known(angle).coefficients)[:, 0]

    def added_to(self, series: Series, angle: float) -> Series:
        """Return a series with the change at an angle [rad] added, and its standard deviations."""
        weights = harmonics(angle) - self._mean
        change = np.tensordot(weights, self.coefficients, axes=1)
        degree = max(series.functions.degree, self._functions.degree)
        functions = replace(series.functions, degree=degree)
        _, variance = self._change_at(sd_grid_pixels(self.image_size), angle)
        coefficients = functions.converted(series.functions, series.coefficients.ravel())
        coefficients += functions.converted(self._functions, change.ravel())
        return Series(
            functions,
            coefficients.reshape(2, -1),
            np.sqrt(np.maximum(series.sd**2 + variance.reshape(series.sd.shape), 0)),
        )

    def _change_at(
        self, uv: NDArray[np.float64], angle: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        change = self._unknown if np.isnan(angle) else self._known(angle)
        values = self._values(uv, change.coefficients)
        variance = at_sd_grid(change.variance, uv, self.image_size)
        if values.shape[1] > 1:  # there are fields of uncertainty
            variance = variance + np.einsum('nka,nka->n', values[:, 1:], values[:, 1:]) / 2
        return values[:, 0], variance

    def _known(self, angle: float) -> _Change:
        """Return the change at an angle; cache the last one, as arms stand still."""
        last = self.__dict__.get('_last')
        if last is None or last[0] != angle:
            weights = harmonics(angle) - self._mean
            last = angle, self._change(weights, np.outer(weights, weights), weights[None])
            self.__dict__['_last'] = last  # one assignment, safe for other threads
        change: _Change = last[1]
        return change

    @cached_property
    def _unknown(self) -> _Change:
        """The change at an unknown angle: zero, with the scatter over all exposures."""
        size, axes = np.linalg.eigh(self._spread)
        roots = axes.T * np.sqrt(np.maximum(size, 0))[:, None]
        weights = np.zeros(HARMONICS)
        return self._change(weights, self._spread, np.vstack([weights, roots]))

    def _change(
        self,
        weights: NDArray[np.float64],
        products: NDArray[np.float64],
        fields: NDArray[np.float64],
    ) -> _Change:
        """Return a change from weights of the harmonics, their products, and weights of fields."""
        j, k = np.transpose(PAIRS)
        factors = np.concatenate([2 * weights, products[j, k] * np.where(j == k, 1, 2)])
        coefficients = np.tensordot(fields, self.coefficients, axes=1)
        variance = np.tensordot(factors, self.variances, axes=1)
        return _Change(coefficients, variance)

    def _values(
        self, uv: NDArray[np.float64], coefficients: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return values (n, k, 2) of k fields from their coefficients (k, 2, t)."""
        flat = coefficients.reshape(-1, coefficients.shape[-1])
        return (self._functions(uv) @ flat.T).reshape(len(uv), *coefficients.shape[:2])


def packed_angles(
    field: AngleField | None,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return angles (e,), coefficients (4, 2, t) and variances (14, 33, 33) for files, messages.

    Returns empty arrays for None.
    """
    if field is None:
        return np.zeros(0), np.zeros((0, 2, 0)), np.zeros((0, 0, 0))
    return field.angles, field.coefficients, field.variances


def unpacked_angles(
    image_size: tuple[int, int],
    angles: NDArray[np.float64],
    coefficients: NDArray[np.float64],
    variances: NDArray[np.float64],
) -> AngleField | None:
    """Return the AngleField, or None, that `packed_angles` turned into the arguments.

    Raises ValueError if the arguments do not match.
    """
    if not (np.size(angles) or np.size(coefficients) or np.size(variances)):
        return None
    return AngleField(image_size, angles, coefficients, variances)


def note_on_angles(
    name: str,
    field: AngleField | None,
    angles: Sequence[float | None],
    items: str = 'frames',
    consequence: str = 'they get the mean over the angles, with its larger standard deviation',
) -> str:
    """Return a note on unknown (None) angles of a fluoroscope and their consequence, or ''."""
    unknown = sum(angle is None for angle in angles)
    if field is None or not unknown:
        return ''
    return (
        f'the correction of fluoroscope {name} depends on the angle of the C-arm, which is '
        f'unknown for {unknown} of {len(angles)} {items}: {consequence}'
    )
