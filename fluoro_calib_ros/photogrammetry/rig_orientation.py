# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Orientation of all fluoroscopes of a rig in its frame, with its covariance.

Every reconstructed point depends on it, and all points of a frame share its errors. The covariance
is therefore complete, including that between fluoroscopes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..brief import brief_repr
from ..errors import DataError
from .collinearity import project_with_jacobian
from .rotations import (
    cross_matrix,
    is_rotation,
    matrix_from_quaternion,
    nearest_rotation,
    quaternion_from_matrix,
    vector_from_matrix,
)
from .unknowns import INTERIOR_SIZE, POSE_SIZE

# Unknowns of a fluoroscope: T [mm], w [rad], xp, yp, c [px].
ORIENTATION_SIZE = POSE_SIZE + INTERIOR_SIZE
SOURCES = ('capture', 'joint calibration', 'healing')
# Largest rounding error: of a rotation matrix (from orthogonality), of the symmetry of a
# correlation matrix, and of an eigenvalue.
ROUNDING = 1e-6
MAX_VALUE = 1e15  # largest position [mm], interior orientation [px] or covariance
# Precision of `rounded`: far coarser than a rounding error, far finer than a standard deviation.
DIGITS = 40  # binary digits of positions and covariances
QUATERNION_STEP = 2.0**-44  # step of the quaternion components of attitudes


@dataclass(frozen=True)
class RigOrientation:
    """Interior and exterior orientation of the F fluoroscopes of a rig.

    Raises DataError for invalid values.

    Attributes
    ----------
    fluoroscopes : tuple of str
        Names of the fluoroscopes.
    interior : (F, 3) ndarray
        xp, yp, c [px].
    rotation : (F, 3, 3) ndarray
        Rotations rig -> sensor.
    position_mm : (F, 3) ndarray
        Positions of the sources in the rig frame.
    covariance : (9F, 9F) ndarray
        Covariance of T [mm], w [rad], xp, yp, c [px] of each fluoroscope in turn. Rotations are
        varied from the left, R -> exp([w]x) R, as in collinearity.
    frame_id : str
        Name of the rig frame.
    source : {'capture', 'joint calibration', 'healing'}
        'capture': the phantom defines the rig frame. 'joint calibration': the rig frame is the
        optical frame of the first fluoroscope. 'healing': the rig frame is that of an earlier
        orientation, which was changed.
    calibration_ids : tuple of str
        Calibrations that the orientation belongs to.
    stamp_ns : int
        Time of the last exposure.
    exposures : int
        Number of exposures that the orientation was determined from.
    optical_frame_ids : tuple of str
        Names of the sensor frames, by default <fluoroscope>_optical.
    orientation_id : str
        Digest of the content.
    """

    __repr__ = brief_repr

    fluoroscopes: tuple[str, ...]
    interior: NDArray[np.float64]
    rotation: NDArray[np.float64]
    position_mm: NDArray[np.float64]
    covariance: NDArray[np.float64]
    frame_id: str
    source: str
    calibration_ids: tuple[str, ...]
    stamp_ns: int = 0
    exposures: int = 1
    optical_frame_ids: tuple[str, ...] = ()
    orientation_id: str = field(init=False)

    def __post_init__(self) -> None:
        names = tuple(str(name) for name in self.fluoroscopes)
        ids = tuple(str(i) for i in self.calibration_ids)
        frames = tuple(str(i) for i in self.optical_frame_ids)
        frames = frames or tuple(f'{name}_optical' for name in names)
        self._check_names(names, ids, frames)
        count = len(names)
        size = ORIENTATION_SIZE * count
        arrays = {
            'interior': self._array('interior', (count, 3)),
            'rotation': self._array('rotation', (count, 3, 3)),
            'position_mm': self._array('position_mm', (count, 3)),
            'covariance': self._array('covariance', (size, size)),
        }
        _check_orientation(names, arrays['interior'], arrays['rotation'])
        _check_covariance(arrays['covariance'])
        for name, array in arrays.items():
            object.__setattr__(self, name, array)
        object.__setattr__(self, 'fluoroscopes', names)
        object.__setattr__(self, 'calibration_ids', ids)
        object.__setattr__(self, 'optical_frame_ids', frames)
        object.__setattr__(self, 'stamp_ns', int(self.stamp_ns))
        object.__setattr__(self, 'exposures', int(self.exposures))
        object.__setattr__(self, 'orientation_id', f'rig-{self._digest()[:16]}')

    def _check_names(
        self, names: tuple[str, ...], ids: tuple[str, ...], frames: tuple[str, ...]
    ) -> None:
        """Raise DataError for names that are not unique, incomplete or unknown."""
        count = len(names)
        if not names or len(set(names)) < count:
            raise DataError(
                f'rig orientation: the fluoroscopes are {", ".join(names) or "none"}, but each '
                'needs a unique name'
            )
        for label, values in (('calibrations', ids), ('optical frames', frames)):
            if len(values) != count:
                raise DataError(
                    f'rig orientation: {count} fluoroscopes, but {len(values)} {label}'
                )
        if self.source not in SOURCES:
            raise DataError(
                f'rig orientation: its source must be one of {", ".join(SOURCES)}, not '
                f'{self.source!r}'
            )
        if not str(self.frame_id):
            raise DataError('rig orientation: the rig frame has no name')

    def _array(self, name: str, shape: tuple[int, ...]) -> NDArray[np.float64]:
        """Return a read-only copy of an array. Raises DataError for a wrong shape or value."""
        value = np.array(getattr(self, name), dtype=float)
        if value.shape != shape:
            raise DataError(f'rig orientation: {name} has shape {value.shape}, not {shape}')
        finite = np.isfinite(value)
        if not finite.all():
            raise DataError(
                f'rig orientation: {name} holds {value[~finite][0]}, which is not a finite number'
            )
        if (np.abs(value) > MAX_VALUE).any():
            raise DataError(f'rig orientation: {name} holds a value above {MAX_VALUE:g}')
        value.setflags(write=False)
        return value

    def _digest(self) -> str:
        """Return the SHA-256 (hex) of the content."""
        digest = hashlib.sha256()
        for array in (self.interior, self.rotation, self.position_mm, self.covariance):
            digest.update(array.tobytes())
        words = (
            *self.fluoroscopes,
            *self.calibration_ids,
            *self.optical_frame_ids,
            self.frame_id,
            self.source,
            self.stamp_ns,
            self.exposures,
        )
        digest.update('\0'.join(map(str, words)).encode())
        return digest.hexdigest()

    @property
    def sd_mm(self) -> NDArray[np.float64]:
        """Standard deviations (F, 3) of the positions [mm]."""
        return self._sd(slice(0, 3))

    @property
    def sd_rad(self) -> NDArray[np.float64]:
        """Standard deviations (F, 3) of the rotations about the axes of the sensors [rad]."""
        return self._sd(slice(3, 6))

    def _sd(self, columns: slice) -> NDArray[np.float64]:
        return np.sqrt(np.diagonal(self.covariance).reshape(-1, ORIENTATION_SIZE)[:, columns])

    def index(self, fluoroscope: str) -> int:
        """Return the index of a fluoroscope. Raises DataError for an unknown name."""
        if fluoroscope not in self.fluoroscopes:
            raise DataError(
                f'rig orientation: there is no fluoroscope {fluoroscope!r}, '
                f'only {", ".join(self.fluoroscopes)}'
            )
        return self.fluoroscopes.index(fluoroscope)

    def covariance_rows(self, indices: Sequence[int]) -> NDArray[np.int64]:
        """Return the rows (9k,) of k fluoroscopes in the covariance, from their indices."""
        first = ORIENTATION_SIZE * np.asarray(indices, dtype=int)
        return (first[:, None] + np.arange(ORIENTATION_SIZE)).ravel()

    def subset(self, fluoroscopes: Sequence[str]) -> RigOrientation:
        """Return the orientation of some fluoroscopes, in the given order. Raises DataError."""
        indices = [self.index(name) for name in fluoroscopes]
        rows = self.covariance_rows(indices)
        return replace(
            self,
            fluoroscopes=tuple(fluoroscopes),
            interior=self.interior[indices],
            rotation=self.rotation[indices],
            position_mm=self.position_mm[indices],
            covariance=self.covariance[np.ix_(rows, rows)],
            calibration_ids=tuple(self.calibration_ids[i] for i in indices),
            optical_frame_ids=tuple(self.optical_frame_ids[i] for i in indices),
        )

    def rounded(self) -> RigOrientation:
        """Return the orientation with values that survive a change of units.

        A message has metres and quaternions, so its values differ from these in the last bits.
        Because the values are rounded to coarser steps, far below any standard deviation, both
        sides recover the same values and the same id. Rounding again changes nothing.
        """
        return replace(
            self,
            rotation=_rounded_rotation(self.rotation),
            position_mm=_to_digits(self.position_mm),
            covariance=_to_digits(self.covariance),
        )

    def check_calibrations(self, calibration_ids: Mapping[str, str]) -> None:
        """Raise DataError unless the orientation belongs to calibrations {fluoroscope: id}."""
        for name, expected in zip(self.fluoroscopes, self.calibration_ids):
            if name not in calibration_ids:
                raise DataError(
                    f'rig orientation: there is no calibration of its fluoroscope {name}'
                )
            if calibration_ids[name] != expected:
                raise DataError(
                    f'rig orientation: it belongs to the calibration {expected} of fluoroscope '
                    f'{name}, but the present one is {calibration_ids[name]}; '
                    'the orientation has to be determined again'
                )

    def covariance_root(self) -> NDArray[np.float64]:
        """Return L (9F, 9F) such that L L^T is the covariance, which may be singular."""
        sd = np.sqrt(np.diagonal(self.covariance))
        scale = np.where(sd > 0, sd, 1.0)  # mm, rad and px differ by orders of magnitude
        values, vectors = np.linalg.eigh(self.covariance / np.outer(scale, scale))
        return scale[:, None] * vectors * np.sqrt(np.maximum(values, 0))


def with_datum_of_points(orientation: RigOrientation, points_mm: ArrayLike) -> RigOrientation:
    """Return the orientation with its covariance in the datum of points (n, 3) [mm].

    Centre and attitude of the points then define the rig frame. A rig frame derived from the
    images themselves is a convention, and the choice matters: relative to a sensor with an
    uncertain principal point, all points rotate together about the source. An S-transformation
    (Baarda, "S-transformations and criterion matrices", Delft 1973; Foerstner and Wrobel,
    "Photogrammetric Computer Vision", Springer 2016, 4.5) removes the part of the errors that
    moves the points together as a rigid body. Variances of distances and angles do not change.
    """
    s = datum_transformation(orientation, points_mm)
    covariance = s @ orientation.covariance @ s.T
    return replace(orientation, covariance=(covariance + covariance.T) / 2).rounded()


def datum_transformation(orientation: RigOrientation, points_mm: ArrayLike) -> NDArray[np.float64]:
    """Return S (9F, 9F) that transforms errors of an orientation into the datum of points.

    points_mm: (n, 3), see with_datum_of_points.
    """
    points = np.asarray(points_mm, dtype=float)
    count = len(orientation.fluoroscopes)
    size = ORIENTATION_SIZE * count
    centre = points.mean(axis=0)
    by_points = np.empty((len(points), 2 * count, 3))
    by_orientation = np.zeros((len(points), 2 * count, size))
    frame_motion = np.zeros((size, 6))
    for f, (r, t, interior) in enumerate(
        zip(orientation.rotation, orientation.position_mm, orientation.interior)
    ):
        rows = slice(2 * f, 2 * f + 2)
        columns = orientation.covariance_rows([f])
        _, by_exterior, by_points[:, rows], by_interior = project_with_jacobian(
            r, t, points, interior
        )
        by_orientation[:, rows, columns[0] : columns[-1] + 1] = np.concatenate(
            [by_exterior, by_interior], axis=2
        )
        # Change of the unknowns if the frame is moved back by a shift and a small rotation about
        # the centre.
        frame_motion[columns[:3]] = np.concatenate([-np.eye(3), cross_matrix(t - centre)], axis=1)
        frame_motion[columns[3:6], 3:] = r
    transposed = by_points.transpose(0, 2, 1)
    points_by_orientation = -np.linalg.solve(transposed @ by_points, transposed @ by_orientation)
    shifts = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    rigid = np.concatenate([shifts, -cross_matrix(points - centre)], axis=2)
    common_motion = np.linalg.lstsq(
        rigid.reshape(-1, 6), points_by_orientation.reshape(-1, size), rcond=None
    )[0]
    return np.eye(size) + frame_motion @ common_motion


def _check_orientation(
    names: Sequence[str], interior: NDArray[np.float64], rotation: np.ndarray
) -> None:
    """Raise DataError for a negative principal distance or an invalid rotation matrix."""
    for name, (_, _, c), is_valid in zip(names, interior, is_rotation(rotation, ROUNDING)):
        if c <= 0:
            raise DataError(
                f'rig orientation: the principal distance of fluoroscope {name} is {c:g} px'
            )
        if not is_valid:
            raise DataError(
                f'rig orientation: the rotation of fluoroscope {name} is not a rotation matrix'
            )


def _to_steps(values: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    """Round to multiples of a step, which is a power of two."""
    return np.round(values / step) * step + 0.0  # + 0.0: no negative zero


def _to_digits(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Round to DIGITS binary digits."""
    mantissa, exponent = np.frexp(values)
    return np.ldexp(_to_steps(mantissa, 2.0**-DIGITS), exponent)


def _rounded_rotation(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Round the quaternions of rotation matrices (F, 3, 3) to QUATERNION_STEP.

    The first large component is computed from the other three, so that the norm is one.
    """
    q = quaternion_from_matrix(rotation)
    rows = np.arange(len(q))
    largest = np.argmax(np.abs(q) > 0.43, axis=1)  # at least one component is 0.5 or more
    q = np.where(q[rows, largest] < 0, -1.0, 1.0)[:, None] * q
    q = _to_steps(q, QUATERNION_STEP)
    q[rows, largest] = 0.0
    q[rows, largest] = np.sqrt(1.0 - (q[:, 0] ** 2 + q[:, 1] ** 2 + q[:, 2] ** 2 + q[:, 3] ** 2))
    return matrix_from_quaternion(q)


def _check_covariance(covariance: NDArray[np.float64]) -> None:
    """Raise DataError unless a matrix is symmetric and positive semi-definite."""
    sd = np.sqrt(np.maximum(np.diagonal(covariance), 0))
    scale = np.where(sd > 0, sd, 1.0)
    correlation = covariance / np.outer(scale, scale)
    if np.max(np.abs(correlation - correlation.T)) > ROUNDING:
        raise DataError('rig orientation: its covariance is not symmetric')
    if np.linalg.eigvalsh(correlation)[0] < -ROUNDING:
        raise DataError('rig orientation: its covariance has a negative eigenvalue')


# Orientation of a fluoroscope known before the calibration, for example from another program.
#
# Any reader can provide it: `KnownOrientation.from_matrices` takes K, R and t of the pinhole
# camera x ~ K (R X + t) (Hartley and Zisserman, "Multiple View Geometry", 2nd ed., 2004, 6.1), as
# OpenCV, MayaCam and XMALab write them.

# Exterior orientations known beforehand are weighted observations of the adjustment.


@dataclass(frozen=True)
class ExteriorPrior:
    """Observed exterior orientations of m exposures."""

    rotation: NDArray[np.float64]  #: (m, 3, 3) rotations phantom -> sensor
    position_mm: NDArray[np.float64]  #: (m, 3) positions of the sources
    #: (m, 6) standard deviations of the positions [mm] and of the rotations about the axes of the
    #: sensor [rad]
    sd: NDArray[np.float64]

    @property
    def weights(self) -> NDArray[np.float64]:
        """Weights (m, 6) of the components."""
        return 1 / self.sd**2

    def discrepancies(
        self, rotation: NDArray[np.float64], position_mm: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the discrepancies (m, 6) of orientations from the observed orientations.

        For a rotation R they are log(R R0^T), whose derivative by a rotation from the left is the
        unit matrix to first order (Barfoot, "State Estimation for Robotics", 2017, 7.1).
        """
        relative = rotation @ self.rotation.transpose(0, 2, 1)
        return np.concatenate(
            [position_mm - self.position_mm, vector_from_matrix(relative)], axis=1
        )


MAX_SKEW = 0.05  # of a calibration matrix, and of its ratio of scales; the correction absorbs them


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

    __repr__ = brief_repr

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
            K [px]. The principal distance is the geometric mean of its two scales; the correction
            that is estimated with it absorbs the difference.
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


def _as_rotation(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation nearest to a matrix of few digits. Raises DataError for any other."""
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        raise DataError('known orientation: R is not 3 x 3 finite numbers')
    if is_rotation(-matrix):
        raise DataError('known orientation: R is a reflection, its determinant is -1')
    if not is_rotation(matrix):
        raise DataError('known orientation: R is not a rotation, its columns are not orthonormal')
    return nearest_rotation(matrix)
