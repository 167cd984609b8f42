"""Epipolar check: do two image points belong to one point in space?

x_b^T E x_a = 0 with E = [s]x Q, Q = R_b R_a^T and s = R_b (T_a - T_b) [mm], of the image points as
directions x in the sensor frames (Hartley and Zisserman, "Multiple View Geometry", 2nd ed., 2004,
9.6). What is told is the first-order geometric (Sampson) distance, 11.4.3 there, with its sign and
with its standard deviation by the law of propagation.
"""

from dataclasses import dataclass

import numpy as np

from ..errors import DataError
from ..photogrammetry.rig_orientation import ORIENTATION_SIZE
from ..photogrammetry.rotations import cross_matrix

MIN_BASE = 1e-6  # distance of the sources over their distance from the rig's origin


@dataclass(frozen=True)
class EpipolarResiduals:
    """Distances of n pairs of image points from their epipolar constraint.

    residual (n,) signed [px]; sd (n,) of it from the image points alone (sigma), and sd_total (n,)
    with the orientation of the rig too; normal_a and normal_b (n, 2): unit normals of the epipolar
    lines in both images, in the direction in which the residual grows; factor_a and factor_b (n,):
    change of the residual when an image point is shifted by one pixel along that normal.
    factor_a^2 + factor_b^2 = 1. NaN where an image point or its sigma is NaN.
    """

    residual: np.ndarray
    sd: np.ndarray
    sd_total: np.ndarray
    normal_a: np.ndarray
    normal_b: np.ndarray
    factor_a: np.ndarray
    factor_b: np.ndarray


class EpipolarGeometry:
    """Epipolar geometry of fluoroscopes a and b (names) of a RigOrientation, built once for all
    frames.

    essential (3, 3): E [mm]. Raises DataError for an unknown fluoroscope, and for sources in one
    place.
    """

    def __init__(self, orientation, a, b):
        rows = [orientation.index(a), orientation.index(b)]
        r_a, r_b = orientation.rotation[rows]
        between = orientation.position_mm[rows[0]] - orientation.position_mm[rows[1]]
        size = np.max(np.linalg.norm(orientation.position_mm[rows], axis=1))
        if np.linalg.norm(between) <= MIN_BASE * size:
            raise DataError(
                f'fluoroscopes {a} and {b} have their sources in one place, they have no epipolar geometry'
            )
        self.fluoroscopes = (a, b)
        self._interior = orientation.interior[rows]
        turn = r_b @ r_a.T
        shift = r_b @ between
        self.essential = cross_matrix(shift) @ turn
        columns = orientation.covariance_rows(rows)
        derivative = _derivative(turn, shift, r_b, self._interior[:, 2])
        self._covariance = (
            derivative @ orientation.covariance[np.ix_(columns, columns)] @ derivative.T
        )

    def residuals(self, uv_a, uv_b, sigma_a, sigma_b):
        """EpipolarResiduals of corrected image points uv_a and uv_b (n, 2) [px].

        sigma_a and sigma_b (n,) or numbers: standard deviations of their coordinates [px].
        """
        x_a, x_b = (
            self._directions(uv, interior) for uv, interior in zip((uv_a, uv_b), self._interior)
        )
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
        image = square_a * np.square(sigma_a) + square_b * np.square(sigma_b)
        # The constraint is linear in E, its nine terms the products of the coordinates.
        terms = (x_b[:, :, None] * x_a[:, None, :]).reshape(-1, 9)
        of_rig = np.sum((terms @ self._covariance) * terms, axis=1)
        return EpipolarResiduals(
            np.sum(x_b * line_b, axis=1) / norm,
            np.sqrt(image / norm2),
            np.sqrt((image + of_rig) / norm2),
            slope_a / length_a[:, None],
            slope_b / length_b[:, None],
            length_a / norm,
            length_b / norm,
        )

    @staticmethod
    def _directions(uv, interior):
        """Directions (n, 3) in the sensor frame, z = 1, of image points (n, 2) [px]."""
        uv = np.asarray(uv, dtype=float).reshape(-1, 2)
        out = np.ones((len(uv), 3))
        out[:, :2] = (uv - interior[:2]) / interior[2]
        return out


def _derivative(turn, shift, r_b, c):
    """Derivatives (9, 18) of the nine elements of E, row by row, by T, w, xp, yp, c of a and of b.

    Those by the interior orientation are of E as it acts on the directions that the present one
    gives: x of another is M x, with M = 1 - (dc, 0, dxp; 0, dc, dyp; 0, 0, 0)/c to first order.
    """
    cross = cross_matrix(shift)
    units = cross_matrix(np.eye(3))
    essential = cross @ turn
    of_shift = np.stack(
        [cross_matrix(column) @ turn for column in r_b.T]
    )  # by T_a; by T_b the opposite
    by_w_a = -essential @ units
    by_w_b = cross_matrix(units @ shift) @ turn + cross @ units @ turn
    m = np.zeros((3, 3, 3))  # dM/d(xp, yp, c) times -c
    m[0, 0, 2] = m[1, 1, 2] = m[2, 0, 0] = m[2, 1, 1] = 1
    by_i_a = -essential @ m / c[0]
    by_i_b = -m.transpose(0, 2, 1) @ essential / c[1]
    every = np.concatenate([of_shift, by_w_a, by_i_a, -of_shift, by_w_b, by_i_b])
    return every.reshape(2 * ORIENTATION_SIZE, 9).T


def epipolar_residuals(orientation, a, b, uv_a, uv_b, sigma_a, sigma_b):
    """EpipolarResiduals of fluoroscopes a and b (names) of a RigOrientation, as
    EpipolarGeometry.residuals.

    For many frames of one orientation an EpipolarGeometry is to be kept.
    """
    return EpipolarGeometry(orientation, a, b).residuals(uv_a, uv_b, sigma_a, sigma_b)
