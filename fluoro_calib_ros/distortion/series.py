"""Corrections as a series of functions of the observed pixel: polynomials and, for ripples,
products of sines.

A polynomial is enough for what bends over the whole image. What is left is a signal with a
covariance function; on a rectangle somewhat larger than the image it is a series of sines, whose
coefficients are independent and have the spectral density of the covariance function as their
variance (Solin and Saerkkae, "Hilbert space methods for reduced-rank Gaussian process regression",
Statistics and Computing 30, 2020).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.ndimage import map_coordinates

MARGIN = 1.3  # the rectangle of the sines over the image: they vanish at its border
# of a series that is read
MAX_DEGREE = 15
MAX_MODES = 100
SD_GRID = 33  # values of the standard deviation across the image, between which it is interpolated


@dataclass(frozen=True)
class Functions:
    """The functions of a series for an image of image_size (width, height) [px].

    degree of the polynomials, -1: none; modes: sines along the longer side of the image, 0: none.
    Coordinates are those from the middle of the image over half its longer side.
    """

    image_size: tuple
    degree: int
    modes: int = 0

    @cached_property
    def powers(self):
        """Exponents (i, j) of the polynomials x^i y^j."""
        return [(i, j) for i in range(self.degree + 1) for j in range(self.degree + 1 - i)]

    @cached_property
    def _sines(self):
        """Numbers (s, 2) of the half waves along u and v."""
        extent = MARGIN * np.asarray(self.image_size) / max(self.image_size)
        i, j = np.meshgrid(
            np.arange(1, self.modes + 1), np.arange(1, self.modes + 1), indexing='ij'
        )
        keep = np.hypot(i / extent[0], j / extent[1]) <= (self.modes + 0.5) / MARGIN
        return np.stack([i[keep], j[keep]], axis=1)

    @cached_property
    def frequency(self):
        """Angular frequencies (s,) [1/px] of the sines."""
        return np.linalg.norm(np.pi * self._sines / (MARGIN * np.asarray(self.image_size)), axis=1)

    def __len__(self):
        return len(self.powers) + len(self._sines)

    def taken_over(self, other, coefficients):
        """Coefficients (2m,) for these functions from those for others; zero for functions the
        others lack.
        """
        number = {
            tuple(key): k
            for k, key in enumerate([*other.powers, *(('sine', *pair) for pair in other._sines)])
        }
        mine = [
            number.get(tuple(key), -1)
            for key in [*self.powers, *(('sine', *pair) for pair in self._sines)]
        ]
        return np.where(np.asarray(mine) >= 0, coefficients.reshape(2, -1)[:, mine], 0.0).ravel()

    def _coordinates(self, uv):
        return (
            (np.asarray(uv, dtype=float) - (np.asarray(self.image_size) - 1) / 2)
            / (max(self.image_size) / 2)
        ).T

    def __call__(self, uv):
        """Values (n, m) at pixels uv (n, 2): the polynomials, then the sines."""
        x, y = self._coordinates(uv)
        out = np.empty((len(x), len(self)))
        of_x, of_y = (np.vander(a, self.degree + 1, increasing=True) for a in (x, y))
        for column, (i, j) in enumerate(self.powers):
            np.multiply(of_x[:, i], of_y[:, j], out=out[:, column])
        if self.modes:
            half = MARGIN * np.asarray(self.image_size) / 2
            waves = [
                np.sin(
                    np.arange(1, self.modes + 1)
                    * (np.pi / 2 / extent * (a[:, None] * max(self.image_size) / 2 + extent))
                )
                / np.sqrt(extent)
                for a, extent in zip((x, y), half)
            ]
            i, j = self._sines.T - 1
            np.multiply(waves[0][:, i], waves[1][:, j], out=out[:, len(self.powers) :])
        return out


@dataclass(frozen=True)
class Series:
    """A correction: functions with coefficients (2, m), and sd (33, 33) [px] of the correction
    over the image.
    """

    functions: Functions
    coefficients: np.ndarray
    sd: np.ndarray

    def predict(self, uv):
        """Corrections (n, 2) [px] at pixels uv (n, 2)."""
        return self.functions(uv) @ self.coefficients.T

    def sd_at(self, uv):
        """Standard deviations (n,) [px] of the corrections at pixels uv (n, 2), interpolated."""
        place = (
            (np.asarray(uv, dtype=float) + 0.5)
            / np.asarray(self.functions.image_size)
            * (SD_GRID - 1)
        )
        return map_coordinates(self.sd, place[:, ::-1].T, order=1, mode='nearest')


def packed(series):
    """Degree, modes, coefficients (2, m) and sd (33, 33) of a Series as they are sent and saved;
    -1 and 0, and empty arrays, of None.
    """
    if series is None:
        return -1, 0, np.zeros((2, 0)), np.zeros((0, 0))
    return series.functions.degree, series.functions.modes, series.coefficients, series.sd


def unpacked(image_size, degree, modes, coefficients, sd):
    """The Series, or None, of what packed has made of it. Raises ValueError where the parts do not
    fit together.
    """
    coefficients, sd = (np.ascontiguousarray(a, dtype=float) for a in (coefficients, sd))
    if degree == -1 and not modes and not coefficients.size:
        return None
    if not (0 <= degree <= MAX_DEGREE and 0 <= modes <= MAX_MODES):
        raise ValueError(f'a series of degree {degree} with {modes} modes is unknown')
    functions = Functions(tuple(int(s) for s in image_size), int(degree), int(modes))
    if coefficients.shape != (2, len(functions)) or sd.shape != (SD_GRID, SD_GRID):
        raise ValueError(
            f'a series of degree {degree} with {modes} modes has 2 x {len(functions)} coefficients and '
            f'{SD_GRID} x {SD_GRID} standard deviations, not {coefficients.shape} and {sd.shape}'
        )
    if not (np.isfinite(coefficients).all() and np.isfinite(sd).all()):
        raise ValueError('a coefficient of the series, or a standard deviation, is not a number')
    return Series(functions, coefficients, sd)


def sd_grid_pixels(image_size):
    """Pixels (33 * 33, 2) at which the standard deviation of a series is given, row by row, from
    edge to edge.
    """
    u, v = (np.linspace(-0.5, size - 0.5, SD_GRID) for size in image_size)
    return np.stack([a.ravel() for a in np.meshgrid(u, v)], axis=1)


def sd_over_image(functions, covariance):
    """Standard deviations (33, 33) [px] of a series from the covariance (2m, 2m) of its
    coefficients, u first.
    """
    values = functions(sd_grid_pixels(functions.image_size))
    m = len(functions)
    variance = (
        np.einsum('np,np->n', values @ (covariance[:m, :m] + covariance[m:, m:]), values) / 2
    )
    return np.sqrt(np.maximum(variance, 0)).reshape(SD_GRID, SD_GRID)
