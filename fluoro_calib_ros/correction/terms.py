# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Terms of parametric distortion models as polynomials of the image coordinates.

Radial and decentring terms after Brown, "Close-range camera calibration", Photogrammetric
Engineering 37, 1971; affinity and shear after El-Hakim, 1986 (both in Luhmann et al., "Close-Range
Photogrammetry and 3D Imaging", 2014, 3.3); spiral, S-shape and higher polynomials are those of
image intensifiers (Gronenschild, Medical Physics 24, 1997; Lichti et al., IEEE Trans. Med. Imaging
34, 2015).
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from math import comb, factorial

import numpy as np
from numpy.typing import NDArray

HIGHEST = 7  # degree of the highest term
CUBIC = 3  # degree of the cubic trend
QUINTIC = 5  # highest degree of a change between exposures
# Variance [px^2] of a term that is absent. Its amplitude of 1e-4 px is negligible; 1e-12 makes
# normal matrices singular.
ABSENT_VARIANCE = 1e-8

Part = tuple[int, int, int, float]  # (axis, i, j, factor): factor x^i y^j in u (axis 0) or v (1)


def polynomial_powers(degree: int) -> list[tuple[int, int]]:
    """Return exponents (i, j) of the polynomials x^i y^j."""
    return [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]


def polynomial_coefficients(degree: int, parts: Iterable[Part]) -> NDArray[np.float64]:
    """Return coefficients (2, m) of a term as polynomials up to a degree."""
    number = {power: k for k, power in enumerate(polynomial_powers(degree))}
    out = np.zeros((2, len(number)))
    for axis, i, j, factor in parts:
        out[axis, number[i, j]] += factor
    return out


def _radial(order: int) -> list[Part]:
    """Return the term r^(2 order) (x, y)."""
    parts = [(2 * k, 2 * (order - k), float(comb(order, k))) for k in range(order + 1)]
    return [(0, i + 1, j, f) for i, j, f in parts] + [(1, i, j + 1, f) for i, j, f in parts]


def _spiral(order: int) -> list[Part]:
    """Return the term r^(2 order) (-y, x)."""
    return [(1 - axis, i, j, -f if axis else f) for axis, i, j, f in _radial(order)]


def _plain(degree: int) -> dict[str, list[Part]]:
    """Return the terms x^i y^j of one degree, each in u and in v."""
    return {
        f'{axis}: x{i}y{degree - i}': [('uv'.index(axis), i, degree - i, 1.0)]
        for axis in 'uv'
        for i in range(degree + 1)
    }


GAUGE: dict[str, list[Part]] = {
    'shift u': [(0, 0, 0, 1.0)],
    'shift v': [(1, 0, 0, 1.0)],
    'scale': _radial(0),
    'turn': _spiral(0),
    'tilt u': [(0, 2, 0, 1.0), (1, 1, 1, 1.0)],
    'tilt v': [(0, 1, 1, 1.0), (1, 0, 2, 1.0)],
}
AFFINE: dict[str, list[Part]] = {
    'affinity': [(0, 1, 0, 1.0), (1, 0, 1, -1.0)],
    'shear': [(0, 0, 1, 1.0), (1, 1, 0, 1.0)],
}
DECENTRING: dict[str, list[Part]] = {
    'decentring u': [(0, 2, 0, 3.0), (0, 0, 2, 1.0), (1, 1, 1, 2.0)],
    'decentring v': [(1, 0, 2, 3.0), (1, 2, 0, 1.0), (0, 1, 1, 2.0)],
}
# Plain terms that complete a degree together with gauge, decentring, radial and spiral terms.
SQUARES: dict[str, list[Part]] = {'u: x0y2': [(0, 0, 2, 1.0)], 'v: x2y0': [(1, 2, 0, 1.0)]}
CUBES: dict[str, list[Part]] = {
    'S-shape u': [(0, 0, 3, 1.0)],
    'S-shape v': [(1, 3, 0, 1.0)],
    **{
        name: parts
        for name, parts in _plain(3).items()
        if name in ('u: x3y0', 'u: x1y2', 'u: x2y1', 'v: x2y1')
    },
}
# The 31 terms of the expert model: radial 1 to 3, spiral 1 and 2, decentring, affinity and shear,
# then terms of degree two to five.
EXPERT: dict[str, list[Part]] = {
    'radial 1': _radial(1),
    'radial 2': _radial(2),
    'radial 3': _radial(3),
    'spiral 1': _spiral(1),
    'spiral 2': _spiral(2),
    **DECENTRING,
    **AFFINE,
    **SQUARES,
    **CUBES,
    **_plain(4),
    **{
        name: parts
        for name, parts in _plain(5).items()
        if name in ('u: x0y5', 'u: x5y0', 'v: x0y5', 'v: x5y0')
    },
}


def expert_terms(with_gauge: bool = False) -> tuple[list[str], NDArray[np.float64]]:
    """Return names of the 31 terms, and coefficients (31, 2, m) as polynomials of degree 7.

    with_gauge: append the six terms of the gauge, for orientations that are known.
    """
    terms = {**EXPERT, **GAUGE} if with_gauge else EXPERT
    return list(terms), np.stack(
        [polynomial_coefficients(HIGHEST, parts) for parts in terms.values()]
    )


def cubic_terms() -> dict[str, list[Part]]:
    """Return the 14 terms that complete the gauge to all polynomials of degree 3."""
    return {
        'radial 1': _radial(1),
        'spiral 1': _spiral(1),
        **DECENTRING,
        **AFFINE,
        **SQUARES,
        **CUBES,
    }


def ring_coefficients(degree: int) -> NDArray[np.float64]:
    """Return coefficients (k,) of r^0, r^2, r^4, ... in R(r) / r for a radial polynomial R.

    R is Zernike's of azimuthal order one and odd degree, so that R(r) / r (x, y) is orthogonal
    over the unit disc to the same terms of lower degree (Born and Wolf, "Principles of Optics",
    7th ed., 9.2.1).
    """
    half = (degree - 1) // 2
    out = np.zeros(half + 1)
    for k in range(half + 1):
        number = (-1) ** k * factorial(degree - k)
        out[half - k] = number / (factorial(k) * factorial(half + 1 - k) * factorial(half - k))
    return out


@cache
def trend_transformation(degree: int, rings: int = 0) -> tuple[NDArray[np.float64], int]:
    """Return the matrix (2t, 2t) from coefficients of the trend to terms, and their number.

    The coefficients are those of `series.Functions` for u, then for v. The terms that are not
    gauge come first, and only they are counted: 14 of the polynomials, then for each ring the
    radial one, the spiral, and two like affinity and shear. degree: 3, or -1 without a trend.
    """
    if degree < 0:
        return np.zeros((0, 0)), 0
    terms = cubic_terms()
    cubic = [
        polynomial_coefficients(degree, parts) for parts in [*terms.values(), *GAUGE.values()]
    ]
    m = cubic[0].shape[1]
    columns = np.zeros((2 * m + 4 * rings, 2, m + 2 * rings))
    first = len(terms)
    last = first + 4 * rings
    columns[:first, :, :m] = cubic[:first]
    columns[last:, :, :m] = cubic[first:]
    for k in range(rings):
        # Factors of x R / r and y R / r in u and in v.
        pairs = [[(1, 0), (0, 1)], [(0, -1), (1, 0)], [(1, 0), (0, -1)], [(0, 1), (1, 0)]]
        column = m + 2 * k
        columns[first + 4 * k : first + 4 * k + 4, :, column : column + 2] = pairs
    return np.linalg.inv(columns.reshape(len(columns), -1).T), last
