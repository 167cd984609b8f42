# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Corrections as a series of functions of the observed pixel: polynomials and products of sines.

Polynomials describe distortion that bends over the whole image. Their residual is a signal with a
covariance function. On a rectangle somewhat larger than the image such a signal is a series of
sines with independent coefficients, whose variance is the spectral density of the covariance
function (Solin and Saerkkae, "Hilbert space methods for reduced-rank Gaussian process regression",
Statistics and Computing 30, 2020).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from math import comb
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates

from .calibration_record import MAX_DEGREE, MAX_MODES, SD_GRID
from .terms import CUBIC, polynomial_powers, ring_coefficients

MARGIN = 1.3  # size of the rectangle at whose border the sines vanish, relative to the image
RING_DEGREE = CUBIC + 2  # degree of the first radial polynomial beyond a cubic trend
BULK_CHUNK = 2048  # pixels evaluated at once: some milliseconds


@dataclass(frozen=True)
class Functions:
    """Basis functions of a series for an image.

    Their coordinates are relative to the image centre, in units of half the longer side.
    """

    image_size: tuple[int, int]  #: width and height [px]
    degree: int  #: highest degree of the polynomials; -1: none
    modes: int = 0  #: number of sines along the longer side of the image; 0: none
    #: number of radial polynomials R of degrees 5, 7, ... (see `terms.ring_coefficients`), each
    #: with the functions x R(r) / r and y R(r) / r; r is 1 at the corners of the image
    rings: int = 0
    #: bands whose sines are excluded; the band of a sine is its frequency, rounded to a multiple
    #: of the frequency of one half wave along the longer side
    absent: tuple[int, ...] = ()

    @cached_property
    def powers(self) -> list[tuple[int, int]]:
        """Exponents (i, j) of the polynomials x^i y^j."""
        return polynomial_powers(self.degree)

    @cached_property
    def _sines(self) -> NDArray[np.int64]:
        """Numbers (s, 2) of half waves along u and v."""
        extent = MARGIN * np.asarray(self.image_size) / max(self.image_size)
        i, j = np.meshgrid(
            np.arange(1, self.modes + 1), np.arange(1, self.modes + 1), indexing='ij'
        )
        number = MARGIN * np.hypot(i / extent[0], j / extent[1])
        is_kept = number <= self.modes + 0.5
        if self.absent:
            is_kept &= ~np.isin(np.rint(number), self.absent)
        return np.stack([i[is_kept], j[is_kept]], axis=1)

    @cached_property
    def frequency(self) -> NDArray[np.float64]:
        """Angular frequencies (s,) [1/px] of the sines."""
        return np.linalg.norm(np.pi * self._sines / (MARGIN * np.asarray(self.image_size)), axis=1)

    @property
    def frequency_of_mode(self) -> float:
        """Angular frequency [1/px] of one half wave along the longer side."""
        return np.pi / (MARGIN * max(self.image_size))

    @cached_property
    def band(self) -> NDArray[np.int64]:
        """Band (s,) of each sine."""
        return np.rint(self.frequency / self.frequency_of_mode).astype(int)

    @property
    def complete(self) -> int:
        """Number of bands below the first excluded one."""
        return min((self.modes, *(band - 1 for band in self.absent)))

    @property
    def highest(self) -> float:
        """Angular frequency [1/px] up to which no sine is excluded."""
        return (self.complete + 0.5) * self.frequency_of_mode

    def __len__(self) -> int:
        return self.trend + len(self._sines)

    @property
    def trend(self) -> int:
        """Number of functions of the trend: all except the sines."""
        return len(self.powers) + 2 * self.rings

    @property
    def _ring_polynomials(self) -> NDArray[np.float64]:
        """Coefficients (rings, k) of r^0, r^2, r^4, ... in R(r) / r, in the common coordinates."""
        corner = np.hypot(*self.image_size) / max(self.image_size)
        out = np.zeros((self.rings, RING_DEGREE // 2 + self.rings))
        for row, values in enumerate(out):
            coefficients = ring_coefficients(RING_DEGREE + 2 * row)
            values[: len(coefficients)] = coefficients / corner ** (
                2 * np.arange(len(coefficients)) + 1
            )
        return out

    def as_polynomials(
        self, coefficients: NDArray[np.float64]
    ) -> tuple[Functions, NDArray[np.float64]]:
        """Return functions without rings, and their coefficients (2, m) for the same series.

        The rings are expressed as polynomials of their degree.
        """
        if not self.rings:
            return self, coefficients
        degree = RING_DEGREE + 2 * (self.rings - 1)
        out = Functions(self.image_size, degree, self.modes)
        matrix = out.converted(self, coefficients.ravel()).reshape(2, -1)
        number = {power: k for k, power in enumerate(out.powers)}
        for k, polynomial in enumerate(self._ring_polynomials):
            ring = coefficients[:, len(self.powers) + 2 * k :][:, :2]
            for order, factor in enumerate(polynomial):
                for i in range(order + 1):
                    part = factor * comb(order, i)
                    matrix[:, number[2 * i + 1, 2 * (order - i)]] += part * ring[:, 0]
                    matrix[:, number[2 * i, 2 * (order - i) + 1]] += part * ring[:, 1]
        return out, matrix

    def converted(
        self, other: Functions, coefficients: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return coefficients (2m,) for these functions from those for other functions.

        A function that is not among the other functions gets the coefficient 0.
        """
        number = {key: column for column, key in enumerate(other._keys())}
        columns = np.asarray([number.get(key, -1) for key in self._keys()])
        return np.where(columns >= 0, coefficients.reshape(2, -1)[:, columns], 0.0).ravel()

    def as_rings(
        self, coefficients: NDArray[np.float64], degree: int, rings: int
    ) -> tuple[Functions, NDArray[np.float64]]:
        """Return functions with rings, and their coefficients (2, m) for the same series.

        This is the inverse of `as_polynomials`, or the nearest series (least squares) if there is
        none. coefficients (2, n): for these functions, which have no rings.
        """
        out = Functions(self.image_size, degree, self.modes, rings)
        matrix = out.converted(self, coefficients.ravel()).reshape(2, -1)
        if self.degree <= degree:
            return out, matrix
        trend = replace(out, modes=0)
        units = np.eye(out.trend)
        columns = [trend.as_polynomials(unit.reshape(1, -1).repeat(2, axis=0)) for unit in units]
        highest = columns[0][0]
        trend_coefficients = highest.converted(
            replace(self, modes=0), coefficients[:, : self.trend].ravel()
        )
        design = np.stack([values[0] for _, values in columns], axis=1)
        solution = np.linalg.lstsq(design, trend_coefficients.reshape(2, -1).T, rcond=None)[0]
        matrix[:, : out.trend] = solution.T
        return out, matrix

    def _keys(self) -> list[tuple[Any, ...]]:
        """Return unique keys of the functions, in their order."""
        rings = [('ring', k, axis) for k in range(self.rings) for axis in 'xy']
        return [*self.powers, *rings, *(('sine', int(i), int(j)) for i, j in self._sines)]

    def _coordinates(self, uv: ArrayLike) -> NDArray[np.float64]:
        return (
            (np.asarray(uv, dtype=float) - (np.asarray(self.image_size) - 1) / 2)
            / (max(self.image_size) / 2)
        ).T

    def __call__(self, uv: ArrayLike) -> NDArray[np.float64]:
        """Return values (n, m) at pixels uv (n, 2) of the polynomials, the rings, the sines."""
        x, y = self._coordinates(uv)
        out = np.empty((len(x), len(self)))
        x_basis, y_basis = (np.vander(a, self.degree + 1, increasing=True) for a in (x, y))
        for column, (i, j) in enumerate(self.powers):
            np.multiply(x_basis[:, i], y_basis[:, j], out=out[:, column])
        if self.rings:
            squares = np.vander(x * x + y * y, self._ring_polynomials.shape[1], increasing=True)
            rings = squares @ self._ring_polynomials.T
            out[:, len(self.powers) : self.trend : 2] = rings * x[:, None]
            out[:, len(self.powers) + 1 : self.trend : 2] = rings * y[:, None]
        if self.modes:
            x_basis, y_basis = self._waves_of_both(x, y)
            i, j = self._sines.T - 1
            x_basis, y_basis = x_basis.take(i, axis=1), y_basis.take(j, axis=1)
            np.multiply(x_basis, y_basis, out=out[:, self.trend :])
        return out

    def sums_of_sines(
        self, uv: ArrayLike, values: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return sums (s, k) of values (n, k) times sines at uv (n, 2), and sums of their squares.

        The sums of squares of the sines are (s,). Each sine is a product of one along u and one
        along v, so the sines need not be evaluated at every pixel.
        """
        x_basis, y_basis = self._waves_of_both(*self._coordinates(uv))
        i, j = self._sines.T - 1
        sums = [(x_basis.T @ (column[:, None] * y_basis))[i, j] for column in values.T]
        return np.stack(sums, axis=1), (np.square(x_basis).T @ np.square(y_basis))[i, j]

    def _waves_of_both(
        self, x: NDArray[np.float64], y: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return sines (n, modes) along u and along v."""
        extent = MARGIN * np.asarray(self.image_size) / 2
        return self._waves(x, extent[0]), self._waves(y, extent[1])

    def _waves(self, coordinate: NDArray[np.float64], extent: float) -> NDArray[np.float64]:
        """Return sines (n, modes) along an axis; extent: half the side of their rectangle [px]."""
        place = coordinate[:, None] * max(self.image_size) / 2 + extent
        return np.sin(np.arange(1, self.modes + 1) * (np.pi / 2 / extent * place)) / np.sqrt(
            extent
        )


@dataclass(frozen=True)
class Series:
    """Correction expressed as a sum of functions.

    functions: basis functions. coefficients (2, m) [px]: for u and v. sd (33, 33): standard
    deviation of the correction [px], on a regular grid from edge to edge of the image.
    """

    functions: Functions
    coefficients: NDArray[np.float64]
    sd: NDArray[np.float64]

    def plus(self, other: Series) -> Series:
        """Return the sum of this series and another one with independent errors."""
        functions, coefficients = self.functions.as_polynomials(self.coefficients)
        joint = Functions(
            functions.image_size,
            max(functions.degree, other.functions.degree),
            max(functions.modes, other.functions.modes),
        )
        total = joint.converted(functions, coefficients.ravel())
        total += joint.converted(other.functions, other.coefficients.ravel())
        return Series(joint, total.reshape(2, -1), np.hypot(self.sd, other.sd))

    def predict(self, uv: ArrayLike) -> NDArray[np.float64]:
        """Return corrections (n, 2) [px] at pixels uv (n, 2).

        Each function is a product of one along u and one along v, so only a few are evaluated.
        """
        x, y = self.functions._coordinates(uv)
        out = np.zeros((len(x), 2))
        powers, sines = self._by_axes
        vandermonde = (np.vander(a, powers.shape[1], increasing=True) for a in (x, y))
        for coefficients, (x_basis, y_basis) in (
            (powers, vandermonde),
            (sines, self.functions._waves_of_both(x, y)),
        ):
            for column, matrix in zip(out.T, coefficients):
                column += np.einsum('ni,ni->n', x_basis @ matrix, y_basis)
        return out

    @cached_property
    def _by_axes(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Coefficients (2, i, j) of the products along u and v, for powers and for sines."""
        functions, coefficients = self.functions.as_polynomials(self.coefficients)
        powers = np.zeros((2, functions.degree + 1, functions.degree + 1))
        for (i, j), column in zip(functions.powers, coefficients.T):
            powers[:, i, j] = column
        sines = np.zeros((2, functions.modes, functions.modes))
        i, j = functions._sines.T - 1
        sines[:, i, j] = coefficients[:, functions.trend :]
        return powers, sines

    def predict_in_chunks(self, uv: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return corrections (n, 2) [px] at many pixels uv (n, 2), with bounded memory."""
        starts = range(0, max(1, len(uv)), BULK_CHUNK)
        return np.concatenate([self.predict(uv[i : i + BULK_CHUNK]) for i in starts])

    def sd_at(self, uv: ArrayLike) -> NDArray[np.float64]:
        """Return interpolated standard deviations (n,) [px] of the corrections at uv (n, 2)."""
        return at_sd_grid(self.sd, uv, self.functions.image_size)


def without_absent_bands(
    functions: Functions, coefficients: NDArray[np.float64]
) -> tuple[Functions, NDArray[np.float64]]:
    """Exclude the bands of sines whose coefficients are all zero.

    Returns the remaining functions and their coefficients (2, m).
    """
    sizes = np.abs(coefficients[:, functions.trend :]).sum(axis=0)
    present = np.unique(functions.band[sizes > 0])
    absent = tuple(int(band) for band in np.setdiff1d(functions.band, present))
    if not absent or not len(present):
        return functions, coefficients
    out = replace(functions, absent=absent)
    return out, out.converted(functions, coefficients.ravel()).reshape(2, -1)


# Fields of a calibration's record that define a series, in the order of `packed`.
SERIES_FIELDS = ('series_degree', 'series_modes', 'series_coefficients', 'series_sd')


def packed(series: Series | None) -> tuple[int, int, NDArray[np.float64], NDArray[np.float64]]:
    """Return degree, modes, coefficients (2, m) and sd (33, 33) for messages and files.

    Without a series, returns -1, 0 and empty arrays.
    """
    if series is None:
        return -1, 0, np.zeros((2, 0)), np.zeros((0, 0))
    return series.functions.degree, series.functions.modes, series.coefficients, series.sd


def unpacked(
    image_size: tuple[int, int],
    degree: int,
    modes: int,
    coefficients: ArrayLike,
    sd: ArrayLike,
) -> Series | None:
    """Return the Series, or None, that `packed` turned into the arguments.

    Raises ValueError if the arguments do not match.
    """
    coefficients = np.ascontiguousarray(coefficients, dtype=float)
    sd = np.ascontiguousarray(sd, dtype=float)
    if degree == -1 and not modes and not coefficients.size:
        return None
    if not (0 <= degree <= MAX_DEGREE and 0 <= modes <= MAX_MODES):
        raise ValueError(f'a series of degree {degree} with {modes} modes is unknown')
    width, height = image_size
    functions = Functions((int(width), int(height)), int(degree), int(modes))
    if coefficients.shape != (2, len(functions)) or sd.shape != (SD_GRID, SD_GRID):
        raise ValueError(
            f'a series of degree {degree} with {modes} modes has 2 x {len(functions)} '
            f'coefficients and {SD_GRID} x {SD_GRID} standard deviations, '
            f'not {coefficients.shape} and {sd.shape}'
        )
    if not (np.isfinite(coefficients).all() and np.isfinite(sd).all()):
        raise ValueError('a coefficient or a standard deviation of the series is not a number')
    return Series(functions, coefficients, sd)


def at_sd_grid(
    grid: NDArray[np.float64], uv: ArrayLike, image_size: tuple[int, int]
) -> NDArray[np.float64]:
    """Interpolate a grid (33, 33) over an image at pixels uv (n, 2); returns (n,)."""
    place = (np.asarray(uv, dtype=float) + 0.5) / np.asarray(image_size) * (SD_GRID - 1)
    return map_coordinates(grid, place[:, ::-1].T, order=1, mode='nearest')


def sd_grid_pixels(image_size: tuple[int, int]) -> NDArray[np.float64]:
    """Return pixels (33 * 33, 2) of the standard deviations of a series, by rows, edge to edge."""
    u, v = (np.linspace(-0.5, size - 0.5, SD_GRID) for size in image_size)
    return np.stack([a.ravel() for a in np.meshgrid(u, v)], axis=1)


def sd_over_image(functions: Functions, covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return standard deviations (33, 33) [px] of a series.

    covariance (2m, 2m): of its coefficients, those of u first.
    """
    values = functions(sd_grid_pixels(functions.image_size))
    m = len(functions)
    variance = (
        np.einsum('np,np->n', values @ (covariance[:m, :m] + covariance[m:, m:]), values) / 2
    )
    return np.sqrt(np.maximum(variance, 0)).reshape(SD_GRID, SD_GRID)
