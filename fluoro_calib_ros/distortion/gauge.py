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
the interior orientation is held, only the turns are left, with their shifts: (-y, x), (c + x x/c,
x y/c), (x y/c, c + y y/c).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

UNIT_PX = 512.0  # of the image coordinates in the basis; any fixed length would do


def gauge_basis(uv: ArrayLike, interior: np.ndarray, interior_held: bool = False) -> np.ndarray:
    """Basis (n, 2, g) of the gauge at pixels uv (n, 2), scaled to about one; interior (3,) [px].

    g is 6, or 3 where the interior orientation is held.
    """
    x, y = (np.asarray(uv) - interior[:2]).T / UNIT_PX
    one = np.ones_like(x)
    zero = np.zeros_like(x)
    if interior_held:
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
    uv: ArrayLike, fitted: np.ndarray, interior: np.ndarray, interior_held: bool = False
) -> np.ndarray:
    """Coefficients (g,) of the part of fitted corrections that is in the gauge.

    Parameters
    ----------
    uv : (n, 2) array_like
        Pixels.
    fitted : (n, 2) ndarray
        Corrections there [px].
    interior : (3,) ndarray
        xp, yp, c [px].
    interior_held : bool
        True where the interior orientation is not estimated.

    Returns
    -------
    (g,) ndarray
    """
    basis = gauge_basis(uv, interior, interior_held)
    return np.linalg.lstsq(basis.reshape(-1, basis.shape[2]), fitted.reshape(-1), rcond=None)[0]
