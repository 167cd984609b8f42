# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Orientation of a fluoroscope that is known before the calibration, as from another program.

Any reader can fill it: `KnownOrientation.from_matrices` takes K, R and t of the pinhole camera
x ~ K (R X + t) (Hartley and Zisserman, "Multiple View Geometry", 2nd ed., 2004, 6.1), as OpenCV,
MayaCam and XMALab write them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import DataError
from .rotations import vector_from_matrix

# Exterior orientations that are known beforehand: weighted observations of the adjustment.


@dataclass(frozen=True)
class ExteriorPrior:
    """Exterior orientations of m exposures as observed."""

    rotation: NDArray[np.float64]  #: (m, 3, 3) rotations phantom -> sensor
    position_mm: NDArray[np.float64]  #: (m, 3) positions of the sources
    #: (m, 6) standard deviations of the positions [mm] and of the rotations about the axes of the
    #: sensor [rad]
    sd: NDArray[np.float64]

    @property
    def weights(self) -> NDArray[np.float64]:
        """Weights (m, 6) of the components."""
        return 1 / self.sd**2

    def discrepancies(self, rotation: np.ndarray, position_mm: np.ndarray) -> NDArray[np.float64]:
        """Discrepancies (m, 6) of orientations from the observed ones.

        Those of a rotation R are log(R R0^T), whose derivative by a rotation on the left is the
        unit matrix to first order (Barfoot, "State Estimation for Robotics", 2017, 7.1).
        """
        turned = rotation @ self.rotation.transpose(0, 2, 1)
        return np.concatenate([position_mm - self.position_mm, vector_from_matrix(turned)], axis=1)


MAX_SKEW = 0.05  # of a calibration matrix, and of its ratio of scales, which a correction takes up
MAX_ROTATION_ERROR = 1e-3  # of R^T R from the unit matrix; a file has few digits


@dataclass(frozen=True)
class KnownOrientation:
    """Interior and exterior orientation of a fluoroscope in the frame of the lab.

    Raises DataError for values that are not finite, a principal distance or standard deviation
    that is not positive, and a matrix that is no rotation.

    Attributes
    ----------
    interior : (3,) ndarray
        xp, yp, c [px]; pixel centres are at integers.
    rotation : (3, 3) ndarray
        Rotation lab -> sensor.
    position_mm : (3,) ndarray
        Position of the source in the frame of the lab.
    interior_sd : (3,) sequence of float or None
        Standard deviations of the interior orientation [px]; None: it is fixed.
    exterior_sd : (2,) sequence of float or None
        Standard deviations of each coordinate of the source [mm] and of each angle [rad]; None:
        they are fixed.
    """

    interior: NDArray[np.float64]
    rotation: NDArray[np.float64]
    position_mm: NDArray[np.float64]
    interior_sd: Sequence[float] | None = None
    exterior_sd: Sequence[float] | None = None

    def __post_init__(self) -> None:
        for name, shape in (('interior', (3,)), ('rotation', (3, 3)), ('position_mm', (3,))):
            values = np.array(getattr(self, name), dtype=float)
            if values.shape != shape or not np.isfinite(values).all():
                raise DataError(f'known orientation: {name} is not {shape} finite numbers')
            values.setflags(write=False)
            object.__setattr__(self, name, values)
        if not self.interior[2] > 0:
            raise DataError(
                f'known orientation: the principal distance is {self.interior[2]:g} px, '
                'it must be above 0'
            )
        self._validate_sd('interior_sd', 3)
        self._validate_sd('exterior_sd', 2)
        object.__setattr__(self, 'rotation', _as_rotation(self.rotation))

    def _validate_sd(self, name: str, size: int) -> None:
        values = getattr(self, name)
        if values is None:
            return
        numbers = tuple(float(v) for v in values)
        if len(numbers) != size or not all(0 < v < np.inf for v in numbers):
            raise DataError(f'known orientation: {name} is not {size} numbers above 0')
        object.__setattr__(self, name, numbers)

    @classmethod
    def from_matrices(
        cls,
        matrix: ArrayLike,
        rotation: ArrayLike,
        translation_mm: ArrayLike,
        interior_sd: Sequence[float] | None = None,
        exterior_sd: Sequence[float] | None = None,
    ) -> KnownOrientation:
        """Return the orientation of a camera x ~ K (R X + t).

        Parameters
        ----------
        matrix : (3, 3) array_like
            K [px]. One principal distance is used, the mean of its two scales: the correction that
            is estimated with it takes up the rest.
        rotation : (3, 3) array_like
            R, lab -> sensor: x to the right, y down, z from the source to the image.
        translation_mm : (3,) array_like
            t, the origin of the lab in the sensor frame.
        interior_sd, exterior_sd
            As the attributes.

        Raises
        ------
        DataError
            Also for a K of an image that is skewed or stretched by more than 5 %.
        """
        k = np.array(matrix, dtype=float)
        if k.shape != (3, 3) or not np.isfinite(k).all():
            raise DataError('known orientation: K is not 3 x 3 finite numbers')
        if not (k[0, 0] > 0 and k[1, 1] > 0 and k[2, 2] > 0):
            raise DataError('known orientation: the diagonal of K must be above 0')
        k = k / k[2, 2]
        c = float(np.sqrt(k[0, 0] * k[1, 1]))
        skew = max(abs(k[0, 1]) / c, abs(k[0, 0] / k[1, 1] - 1))
        if np.any(k[[1, 2, 2], [0, 0, 1]] != 0) or skew > MAX_SKEW:
            raise DataError(
                'known orientation: K is not [[c, 0, xp], [0, c, yp], [0, 0, 1]] with one '
                'principal distance c; transpose it if it was written by columns'
            )
        r = _as_rotation(np.array(rotation, dtype=float))
        t = np.asarray(translation_mm, dtype=float)
        if t.shape != (3,):
            raise DataError('known orientation: t is not 3 numbers')
        return cls(np.array([k[0, 2], k[1, 2], c]), r, -r.T @ t, interior_sd, exterior_sd)


def _as_rotation(matrix: np.ndarray) -> np.ndarray:
    """Return the rotation nearest to a matrix of few digits. Raises DataError for any other."""
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        raise DataError('known orientation: R is not 3 x 3 finite numbers')
    if np.abs(matrix.T @ matrix - np.eye(3)).max() > MAX_ROTATION_ERROR:
        raise DataError('known orientation: R is not a rotation, its columns are not orthonormal')
    if np.linalg.det(matrix) < 0:
        raise DataError('known orientation: R is a reflection, its determinant is -1')
    u, _, vt = np.linalg.svd(matrix)
    return u @ vt
