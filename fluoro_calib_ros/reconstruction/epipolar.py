# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Epipolar check: do two image points belong to one point in space?

x_b^T E x_a = 0 with E = [s]x Q, Q = R_b R_a^T and s = R_b (T_a - T_b) [mm], where the image points
are directions x in the sensor frames (Hartley and Zisserman, "Multiple View Geometry", 2nd ed.,
2004, 9.6). The residual is the first-order geometric (Sampson) distance (11.4.3 there), with its
sign, and its standard deviation follows by propagation of covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import DataError
from ..photogrammetry.rig_orientation import ORIENTATION_SIZE, RigOrientation
from ..photogrammetry.rotations import cross_matrix

MIN_BASE = 1e-6  # distance of the sources over their distance from the origin of the rig


@dataclass(frozen=True)
class EpipolarResiduals:
    """Distances of n pairs of image points from their epipolar constraint.

    NaN where an image point or its sigma is NaN.
    """

    residual: NDArray[np.float64]  #: (n,) signed [px]
    #: (n,) standard deviation of the residual by the image points alone (sigma) [px]
    sd: NDArray[np.float64]
    sd_total: NDArray[np.float64]  #: (n,) the same with the orientation of the rig [px]
    #: (n, 2) unit normals of the epipolar lines in both images, in the direction in which the
    #: residual grows
    normal_a: NDArray[np.float64]
    normal_b: NDArray[np.float64]
    #: (n,) change of the residual when an image point is shifted by one pixel along that normal;
    #: factor_a^2 + factor_b^2 = 1
    factor_a: NDArray[np.float64]
    factor_b: NDArray[np.float64]


class EpipolarGeometry:
    """Epipolar geometry of two fluoroscopes of a rig, built once for all frames.

    a, b: names of the fluoroscopes. Raises DataError for an unknown fluoroscope, and for two
    sources in one place.
    """

    def __init__(self, orientation: RigOrientation, a: str, b: str) -> None:
        rows = [orientation.index(a), orientation.index(b)]
        r_a, r_b = orientation.rotation[rows]
        position_a, position_b = orientation.position_mm[rows]
        size = np.max(np.linalg.norm(orientation.position_mm[rows], axis=1))
        if np.linalg.norm(position_a - position_b) <= MIN_BASE * size:
            raise DataError(
                f'fluoroscopes {a} and {b} have their sources in one place, '
                'so they have no epipolar geometry'
            )
        self.fluoroscopes = (a, b)
        self._interior = orientation.interior[rows]
        relative_rotation = r_b @ r_a.T
        shift = r_b @ (position_a - position_b)
        self.essential = cross_matrix(shift) @ relative_rotation  #: (3, 3), the matrix E [mm]
        columns = orientation.covariance_rows(rows)
        covariance = orientation.covariance[np.ix_(columns, columns)]
        derivative = _essential_jacobian(relative_rotation, shift, r_b, self._interior[:, 2])
        self._covariance = derivative @ covariance @ derivative.T

    def residuals(
        self, uv_a: ArrayLike, uv_b: ArrayLike, sigma_a: ArrayLike, sigma_b: ArrayLike
    ) -> EpipolarResiduals:
        """Residuals of corrected image points uv_a and uv_b (n, 2) [px].

        sigma_a and sigma_b (n,), or a number for all: standard deviations of their coordinates
        [px].
        """
        x_a = _directions(uv_a, self._interior[0])
        x_b = _directions(uv_b, self._interior[1])
        line_b = x_a @ self.essential.T
        line_a = x_b @ self.essential
        c_a, c_b = self._interior[:, 2]
        slope_a = line_a[:, :2] / c_a
        slope_b = line_b[:, :2] / c_b
        square_a = np.sum(slope_a * slope_a, axis=1)
        square_b = np.sum(slope_b * slope_b, axis=1)
        norm2 = square_a + square_b
        norm = np.sqrt(norm2)
        length_a = np.sqrt(square_a)
        length_b = np.sqrt(square_b)
        by_image = square_a * np.square(sigma_a) + square_b * np.square(sigma_b)
        # The constraint is linear in E; its nine terms are the products of the coordinates.
        terms = (x_b[:, :, None] * x_a[:, None, :]).reshape(-1, 9)
        by_rig = np.sum((terms @ self._covariance) * terms, axis=1)
        return EpipolarResiduals(
            residual=np.sum(x_b * line_b, axis=1) / norm,
            sd=np.sqrt(by_image / norm2),
            sd_total=np.sqrt((by_image + by_rig) / norm2),
            normal_a=slope_a / length_a[:, None],
            normal_b=slope_b / length_b[:, None],
            factor_a=length_a / norm,
            factor_b=length_b / norm,
        )


def _directions(uv: ArrayLike, interior: np.ndarray) -> np.ndarray:
    """Directions (n, 3) in the sensor frame, z = 1, of image points (n, 2) [px]."""
    uv = np.asarray(uv, dtype=float).reshape(-1, 2)
    out = np.ones((len(uv), 3))
    out[:, :2] = (uv - interior[:2]) / interior[2]
    return out


def _essential_jacobian(
    relative_rotation: np.ndarray, shift: np.ndarray, r_b: np.ndarray, c: np.ndarray
) -> np.ndarray:
    """Derivatives (9, 18) of the elements of E, row by row, by T, w, xp, yp, c of a and of b.

    Those by the interior orientation hold for E as it acts on the present directions. A changed
    interior orientation maps a direction x to M x, where to first order
    M = 1 - (dc, 0, dxp; 0, dc, dyp; 0, 0, 0)/c.
    """
    cross = cross_matrix(shift)
    units = cross_matrix(np.eye(3))
    essential = cross @ relative_rotation
    # By T_a; by T_b it is the negative.
    by_position = np.stack([cross_matrix(column) @ relative_rotation for column in r_b.T])
    by_rotation_a = -essential @ units
    by_rotation_b = cross_matrix(units @ shift) @ relative_rotation
    by_rotation_b = by_rotation_b + cross @ units @ relative_rotation
    m = np.zeros((3, 3, 3))  # dM/d(xp, yp, c) times -c
    m[0, 0, 2] = 1
    m[1, 1, 2] = 1
    m[2, 0, 0] = 1
    m[2, 1, 1] = 1
    by_interior_a = -essential @ m / c[0]
    by_interior_b = -m.transpose(0, 2, 1) @ essential / c[1]
    rows = [by_position, by_rotation_a, by_interior_a, -by_position, by_rotation_b, by_interior_b]
    return np.concatenate(rows).reshape(2 * ORIENTATION_SIZE, 9).T
