"""Where the fluoroscopes stand in the frame of the rig, and how well that is known.

Every reconstructed point stands on it, and every point of a frame shares its errors: so its
covariance is kept whole, from one fluoroscope to the other too.
"""

import hashlib
from dataclasses import dataclass, field, replace

import numpy as np

from ..errors import DataError
from .collinearity import project_with_jacobian
from .rotations import cross_matrix

UNKNOWNS = 9  # of a fluoroscope: T [mm], w [rad], xp, yp, c [px]
SOURCES = ('capture', 'joint calibration')
ORTHOGONAL = 1e-6  # of a rotation matrix: more is no rounding


@dataclass(frozen=True)
class RigOrientation:
    """Interior and exterior orientation of the fluoroscopes of a rig.

    fluoroscopes: their names (F); interior (F, 3) xp, yp, c [px]; rotation (F, 3, 3) rig ->
    sensor; position_mm (F, 3) of the sources in the rig frame; covariance (9F, 9F) of, for each
    fluoroscope in turn, T [mm], w [rad], xp, yp, c [px], with the rotation varied on the left, R
    -> exp([w]x) R, as in collinearity; frame_id: name of the rig frame; source: 'capture' of the
    phantom standing in the rig frame, or 'joint calibration', whose rig frame is the optical frame
    of the first fluoroscope; calibration_ids (F) of the calibrations behind it; stamp_ns of the
    last exposure; exposures: how many are behind it; optical_frame_ids (F): names of the sensor
    frames, <fluoroscope>_optical where they are not given. orientation_id follows from the
    content. Raises DataError for values that are no orientation.
    """

    fluoroscopes: tuple
    interior: np.ndarray
    rotation: np.ndarray
    position_mm: np.ndarray
    covariance: np.ndarray
    frame_id: str
    source: str
    calibration_ids: tuple
    stamp_ns: int = 0
    exposures: int = 1
    optical_frame_ids: tuple = ()
    orientation_id: str = field(init=False)

    def __post_init__(self):
        names = tuple(str(name) for name in self.fluoroscopes)
        count = len(self.fluoroscopes)
        if not names or len(set(names)) < count:
            raise DataError(
                f'rig orientation: the fluoroscopes are {", ".join(names) or "none"}, '
                'and each is to have a name of its own'
            )
        ids = tuple(str(i) for i in self.calibration_ids)
        frames = tuple(str(i) for i in self.optical_frame_ids) or tuple(
            f'{name}_optical' for name in names
        )
        for what, given in (('calibrations', ids), ('optical frames', frames)):
            if len(given) != count:
                raise DataError(f'rig orientation: {count} fluoroscopes, but {len(given)} {what}')
        if self.source not in SOURCES:
            raise DataError(
                f'rig orientation: its source is one of {", ".join(SOURCES)}, not {self.source!r}'
            )
        if not str(self.frame_id):
            raise DataError('rig orientation: the rig frame has no name')
        values = {
            name: _array(self, name, shape)
            for name, shape in (
                ('interior', (count, 3)),
                ('rotation', (count, 3, 3)),
                ('position_mm', (count, 3)),
                ('covariance', (UNKNOWNS * count, UNKNOWNS * count)),
            )
        }
        _check_orientation(names, values['interior'], values['rotation'])
        _check_covariance(values['covariance'])
        values.update(
            fluoroscopes=names,
            calibration_ids=ids,
            optical_frame_ids=frames,
            stamp_ns=int(self.stamp_ns),
            exposures=int(self.exposures),
        )
        for name, value in values.items():
            object.__setattr__(self, name, value)
        object.__setattr__(self, 'orientation_id', f'rig-{self._digest()[:16]}')

    def _digest(self):
        """SHA-256 (hex) of the content."""
        digest = hashlib.sha256()
        for array in (self.interior, self.rotation, self.position_mm, self.covariance):
            digest.update(array.tobytes())
        said = (
            *self.fluoroscopes,
            *self.calibration_ids,
            *self.optical_frame_ids,
            self.frame_id,
            self.source,
            self.stamp_ns,
            self.exposures,
        )
        digest.update('\0'.join(map(str, said)).encode())
        return digest.hexdigest()

    @property
    def sd_mm(self):
        """Standard deviations (F, 3) of the positions [mm]."""
        return self._sd(slice(0, 3))

    @property
    def sd_rad(self):
        """Standard deviations (F, 3) of the rotations about the axes of the sensors [rad]."""
        return self._sd(slice(3, 6))

    @property
    def sd_interior(self):
        """Standard deviations (F, 3) of xp, yp, c [px]."""
        return self._sd(slice(6, 9))

    def _sd(self, columns):
        return np.sqrt(np.diagonal(self.covariance).reshape(-1, UNKNOWNS)[:, columns])

    def number(self, fluoroscope):
        """Number of a fluoroscope by its name. Raises DataError for an unknown one."""
        if fluoroscope not in self.fluoroscopes:
            raise DataError(
                f'rig orientation: there is no fluoroscope {fluoroscope!r}, '
                f'only {", ".join(self.fluoroscopes)}'
            )
        return self.fluoroscopes.index(fluoroscope)

    def subset(self, fluoroscopes):
        """RigOrientation of some of the fluoroscopes, in the order in which they are named. Raises
        DataError.
        """
        rows = [self.number(name) for name in fluoroscopes]
        columns = np.concatenate(
            [np.arange(UNKNOWNS * row, UNKNOWNS * (row + 1)) for row in rows] or [[]]
        ).astype(int)
        return RigOrientation(
            tuple(fluoroscopes),
            self.interior[rows],
            self.rotation[rows],
            self.position_mm[rows],
            self.covariance[np.ix_(columns, columns)],
            self.frame_id,
            self.source,
            tuple(self.calibration_ids[row] for row in rows),
            self.stamp_ns,
            self.exposures,
            tuple(self.optical_frame_ids[row] for row in rows),
        )

    def check_calibrations(self, calibration_ids):
        """Raise DataError where calibrations {fluoroscope: calibration_id} are not those the
        orientation belongs to.
        """
        for name, wanted in zip(self.fluoroscopes, self.calibration_ids):
            if name not in calibration_ids:
                raise DataError(
                    f'rig orientation: there is no calibration of its fluoroscope {name}'
                )
            if calibration_ids[name] != wanted:
                raise DataError(
                    f'rig orientation: it belongs to the calibration {wanted} of fluoroscope {name}, but '
                    f'that at hand is {calibration_ids[name]}; the orientation has to be made anew'
                )

    def root(self):
        """Matrix L (9F, 9F) with L L^T the covariance, which may be singular."""
        sd = np.sqrt(np.diagonal(self.covariance))
        scale = np.where(sd > 0, sd, 1.0)  # mm, rad and px are of very different size
        values, vectors = np.linalg.eigh(self.covariance / np.outer(scale, scale))
        return scale[:, None] * vectors * np.sqrt(np.maximum(values, 0))


def with_datum_of_points(orientation, points_mm):
    """The RigOrientation with its covariance in the datum of points (n, 3) [mm]: their centre and
    attitude are what the rig frame is fixed to.

    A rig frame that was taken from the images themselves is a convention, and where it is held
    matters: held to a sensor whose principal point is uncertain, all points together turn about
    the source. An S-transformation (Baarda, "S-transformations and criterion matrices", Delft
    1973; Foerstner and Wrobel, "Photogrammetric Computer Vision", Springer 2016, 4.5) takes out
    what errors of the orientation move the points together, as a rigid body. Nothing else changes:
    distances and angles have the variances that they had.
    """
    s = datum_transformation(orientation, points_mm)
    covariance = s @ orientation.covariance @ s.T
    return replace(orientation, covariance=(covariance + covariance.T) / 2)


def datum_transformation(orientation, points_mm):
    """Matrix S (9F, 9F) that takes errors of an orientation into the datum of points (n, 3) [mm],
    see with_datum_of_points.
    """
    points = np.asarray(points_mm, dtype=float)
    count = len(orientation.fluoroscopes)
    middle = points.mean(axis=0)
    a = np.empty((len(points), 2 * count, 3))
    b = np.zeros((len(points), 2 * count, UNKNOWNS * count))
    datum = np.zeros((UNKNOWNS * count, 6))
    for f, (r, t, interior) in enumerate(
        zip(orientation.rotation, orientation.position_mm, orientation.interior)
    ):
        rows = slice(2 * f, 2 * f + 2)
        first = UNKNOWNS * f
        _, by_exterior, a[:, rows], by_interior = project_with_jacobian(
            np.broadcast_to(r, (len(points), 3, 3)),
            np.broadcast_to(t, points.shape),
            points,
            interior,
        )
        b[:, rows, first : first + UNKNOWNS] = np.concatenate([by_exterior, by_interior], axis=2)
        # Of the unknowns, when the frame is moved back by a shift and a small rotation about the
        # middle.
        datum[first : first + 3] = np.concatenate([-np.eye(3), cross_matrix(t - middle)], axis=1)
        datum[first + 3 : first + 6, 3:] = r
    turned = a.transpose(0, 2, 1)
    moved = -np.linalg.solve(turned @ a, turned @ b)  # of the points, by the unknowns
    shifts = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    rigid = np.concatenate([shifts, -cross_matrix(points - middle)], axis=2)
    together = np.linalg.lstsq(
        rigid.reshape(-1, 6), moved.reshape(-1, UNKNOWNS * count), rcond=None
    )[0]
    return np.eye(UNKNOWNS * count) + datum @ together


def _array(orientation, name, shape):
    """An array of the orientation, read-only. Raises DataError for another shape and for what is
    not finite.
    """
    value = np.array(getattr(orientation, name), dtype=float)
    if value.shape != shape:
        raise DataError(f'rig orientation: {name} has shape {value.shape}, not {shape}')
    if not np.isfinite(value).all():
        raise DataError(
            f'rig orientation: {name} holds {value[~np.isfinite(value)][0]}, which is not a finite number'
        )
    value.setflags(write=False)
    return value


def _check_orientation(names, interior, rotation):
    off = np.max(np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)), axis=(1, 2))
    for name, (_, _, c), error, sign in zip(names, interior, off, np.linalg.det(rotation)):
        if c <= 0:
            raise DataError(
                f'rig orientation: the principal distance of fluoroscope {name} is {c:g} px'
            )
        if error > ORTHOGONAL or sign < 0:
            raise DataError(
                f'rig orientation: the rotation of fluoroscope {name} is no rotation matrix'
            )


def _check_covariance(covariance):
    sd = np.sqrt(np.maximum(np.diagonal(covariance), 0))
    scale = np.where(sd > 0, sd, 1.0)
    correlation = covariance / np.outer(scale, scale)
    if np.max(np.abs(correlation - correlation.T)) > 1e-6:
        raise DataError('rig orientation: its covariance is not symmetric')
    if np.linalg.eigvalsh(correlation)[0] < -1e-6:
        raise DataError('rig orientation: its covariance has a negative eigenvalue, it is none')
