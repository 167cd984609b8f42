# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The gauge between a free correction and the orientation of the sensor.

A correction that can reproduce what a change of interior and exterior orientation does to the
image competes with them. To first order these changes move an image point (x, y) = (u - xp,
v - yp) by

    (1, 0), (0, 1)                    principal point,
    (x, y)                            principal distance,
    (-y, x)                           turn of the sensor about its axis,
    (x x, x y)/c, (x y, y y)/c        turn of the sensor about its rows and columns, less a shift

(derivatives of the collinearity condition; the last three are common to all exposures and leave
sources and object points where they are). The fitted correction is kept orthogonal to them. Where
the interior orientation is fixed, only the turns are left, with their shifts: (-y, x), (c + x x/c,
x y/c), (x y/c, c + y y/c). Where the exterior orientations are known too, nothing competes.

Flat targets parallel to the image show neither principal distance nor principal point, and any
distance of the source takes up a scale. Where these are given, they are those of a distortion
without shift, scale and tilt, such as that of Brown: the part in the gauge vanishes of the cubic
polynomial that fits the correction best, not of the correction as a whole.
"""

from __future__ import annotations

from enum import Enum

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares

from ..correction.terms import CUBIC, cubic_terms, polynomial_coefficients, polynomial_powers
from ..photogrammetry.rotations import matrix_from_vector


class GaugeKind(Enum):
    """What the orientation can express, and a correction must not.

    FULL: interior orientation and turns. TREND: the same, where the interior orientation is given
    as that of a cubic distortion, and the exposures do not show it. TURNS: the interior
    orientation is fixed, and its errors are learned by the correction. NONE: the exterior
    orientations are known too.
    """

    FULL = 'full'
    TREND = 'trend'
    TURNS = 'turns'
    NONE = 'none'


UNIT_PX = 512.0  # of the image coordinates in the basis; any fixed length would do
TURN_STEP = 1e-3  # rad, as large as a pixel of the principal point for the search of both


def gauge_basis(
    uv: ArrayLike, interior: np.ndarray, kind: GaugeKind = GaugeKind.FULL
) -> NDArray[np.float64]:
    """Basis (n, 2, g) of the gauge at pixels uv (n, 2), scaled to about one; interior (3,) [px].

    g is 3 for the turns, 0 for none, else 6.
    """
    x, y = (np.asarray(uv) - interior[:2]).T / UNIT_PX
    one = np.ones_like(x)
    zero = np.zeros_like(x)
    if kind is GaugeKind.NONE:
        return np.zeros((len(x), 2, 0))
    if kind is GaugeKind.TURNS:
        square = (UNIT_PX / interior[2]) ** 2
        columns = [
            (-y, x),
            (one + square * x * x, square * x * y),
            (square * x * y, one + square * y * y),
        ]
    else:
        columns = [(one, zero), (zero, one), (x, y), (-y, x), (x * x, x * y), (x * y, y * y)]
    return np.stack([np.stack(column, axis=1) for column in columns], axis=2)


def gauge_coefficients(
    uv: ArrayLike,
    fitted: NDArray[np.float64],
    interior: NDArray[np.float64],
    kind: GaugeKind = GaugeKind.FULL,
) -> NDArray[np.float64]:
    """Coefficients (g,) of the part of fitted corrections that is in the gauge.

    uv: (n, 2) pixels. fitted: (n, 2) corrections there [px]. interior: (3,) xp, yp, c [px].
    Returns (g,).
    """
    basis = gauge_basis(uv, interior, kind)
    if kind is GaugeKind.TREND:
        basis = np.concatenate([basis, _cubic_terms(uv, interior)], axis=2)
    count = 6 if kind is GaugeKind.TREND else basis.shape[2]
    flat = basis.reshape(-1, basis.shape[2])
    coefficients = np.linalg.lstsq(flat, fitted.reshape(-1), rcond=None)[0][:count]
    return np.asarray(coefficients, dtype=np.float64)


def gauge_rows(
    values: np.ndarray, uv: np.ndarray, interior: np.ndarray, kind: GaugeKind = GaugeKind.FULL
) -> np.ndarray:
    """Rows (g, 2m) whose products with the coefficients of a series vanish without a gauge part.

    values (n, m): functions of the series at pixels uv (n, 2); interior (3,) [px]. The
    coefficients are those of u, then those of v.
    """
    basis = gauge_basis(uv, interior, kind)
    count = basis.shape[2]
    if kind is GaugeKind.TREND:
        basis = np.concatenate([basis, _cubic_terms(uv, interior)], axis=2)
        flat = basis.reshape(-1, basis.shape[2])
        solved = np.linalg.solve(flat.T @ flat, flat.T)[:count]
        basis = solved.T.reshape(len(uv), 2, count) * len(uv)
    rows = [basis[:, axis].T @ values for axis in (0, 1)]
    return np.concatenate(rows, axis=1) / len(uv)


def _cubic_terms(uv: ArrayLike, interior: np.ndarray) -> np.ndarray:
    """Terms (n, 2, 14) that complete the gauge to all cubic polynomials about (xp, yp)."""
    x, y = (np.asarray(uv) - interior[:2]).T / UNIT_PX
    powers = np.stack([x**i * y**j for i, j in polynomial_powers(CUBIC)], axis=1)
    terms = [polynomial_coefficients(CUBIC, parts) for parts in cubic_terms().values()]
    return np.stack([powers @ term.T for term in terms], axis=2)


def interior_about(
    centre: NDArray[np.float64],
    uv: NDArray[np.float64],
    correction: NDArray[np.float64],
    interior: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Interior orientation (3,) [px] in the gauge about another principal point.

    A sensor that is turned by R and has another camera matrix K' sees the same rays where the
    corrected image is that of the homography K' R K^-1 (Hartley and Zisserman, "Multiple View
    Geometry", 2003, 8.4). To second order, a turn with its shift d of the principal point
    stretches the image by d^2/c^2: a correction with a large affine part is orthogonal to the
    gauge about a near principal point, and about far ones, with which it may be smaller.

    Parameters
    ----------
    centre : (2,) ndarray
        The other principal point [px].
    uv : (n, 2) ndarray
        Pixels.
    correction : (n, 2) ndarray
        Corrections there [px].
    interior : (3,) ndarray
        xp, yp, c [px] that belong to these corrections.

    Returns
    -------
    (3,) ndarray

    Raises
    ------
    ValueError
        If there is none: the corrections are no numbers, or image points come to lie behind.
    """
    rays = np.column_stack([(uv - correction - interior[:2]) / interior[2], np.ones(len(uv))])
    reference = np.array([*centre, interior[2]])

    def misclosure(x: np.ndarray) -> np.ndarray:
        turned = rays @ matrix_from_vector(x[3:]).T
        if not (turned[:, 2] > 0).all():
            raise ValueError('no orientation about this principal point')
        ideal = x[:2] + x[2] * turned[:, :2] / turned[:, 2:]
        return gauge_coefficients(uv, uv - ideal, reference)

    start = np.concatenate([interior, np.zeros(3)])
    scale = [1.0, 1.0, 1.0, TURN_STEP, TURN_STEP, TURN_STEP]
    return least_squares(misclosure, start, x_scale=scale).x[:3]
