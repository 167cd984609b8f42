# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The collinearity condition of an X-ray image, and its derivatives.

X = R (P - T);  u = xp + c X/Z,  v = yp + c Y/Z: Eq. 1 of Chow et al. turned by 180 degrees about
x, so that z points from the source to the image. P is the object point [mm], T the source [mm], R
the rotation phantom -> sensor, (xp, yp, c) the interior orientation [px]. A rotation is varied on
the left, R -> exp([w]x) R, so that dX/dw = -[X]x.
"""

import numpy as np
from numpy.typing import NDArray

from .rotations import cross_matrix


def to_sensor(
    rotation: np.ndarray, position: np.ndarray, points: np.ndarray
) -> NDArray[np.float64]:
    """Points in the sensor frame (n, 3) [mm].

    rotation (n, 3, 3) phantom -> sensor; position and points (n, 3) [mm].
    """
    return np.matmul(rotation, (points - position)[..., None])[..., 0]


def project(
    rotation: NDArray[np.float64],
    position: NDArray[np.float64],
    points: NDArray[np.float64],
    interior: NDArray[np.float64],
) -> np.ndarray:
    """Image points (n, 2) [px] of object points; NaN for a point that is not before the source.

    Parameters
    ----------
    rotation : (n, 3, 3) ndarray
        Rotation phantom -> sensor for each point.
    position : (n, 3) ndarray
        Position of the source for each point [mm].
    points : (n, 3) ndarray
        Object points [mm].
    interior : (n, 3) or (3,) ndarray
        xp, yp, c [px].
    """
    x = to_sensor(rotation, position, points)
    z = np.where(x[:, 2] > 0, x[:, 2], np.nan)
    interior = np.broadcast_to(interior, (len(x), 3))
    return interior[:, :2] + interior[:, 2:] * x[:, :2] / z[:, None]


def project_with_jacobian(
    rotation: np.ndarray, position: np.ndarray, points: np.ndarray, interior: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Image points and their derivatives; parameters as in `project`.

    Returns
    -------
    uv : (n, 2) ndarray
        Image points [px].
    d_exterior : (n, 2, 6) ndarray
        Derivatives by T [mm] and w [rad].
    d_point : (n, 2, 3) ndarray
        Derivatives by P [mm].
    d_interior : (n, 2, 3) ndarray
        Derivatives by xp, yp, c.
    """
    x = to_sensor(rotation, position, points)
    z = np.where(x[:, 2] > 0, x[:, 2], np.nan)
    interior = np.broadcast_to(interior, (len(x), 3))
    c = interior[:, 2]
    ratio = x[:, :2] / z[:, None]
    uv = interior[:, :2] + c[:, None] * ratio

    d_sensor = np.zeros((len(x), 2, 3))
    d_sensor[:, 0, 0] = c / z
    d_sensor[:, 1, 1] = c / z
    d_sensor[:, :, 2] = -(c / z)[:, None] * ratio
    d_point = d_sensor @ rotation
    d_exterior = np.concatenate([-d_point, -(d_sensor @ cross_matrix(x))], axis=2)
    d_interior = np.zeros((len(x), 2, 3))
    d_interior[:, 0, 0] = 1.0
    d_interior[:, 1, 1] = 1.0
    d_interior[:, :, 2] = ratio
    return uv, d_exterior, d_point, d_interior
