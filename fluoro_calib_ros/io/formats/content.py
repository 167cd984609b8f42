# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Contents of files of other programs, in the conventions of this package."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import DataError
from ...exposures.frame import Frames
from ...exposures.names import Names
from ...exposures.phantom import Phantom
from ...photogrammetry.rotations import TAKEN_TOLERANCE, is_rotation
from ..access import PathLike, check_safe_name, make_folder, write_text

# Converts camera axes from x right, y up, z backwards to x right, y down, z forwards.
Y_UP_TO_DOWN = np.diag([1.0, -1.0, -1.0])
UNITS_MM = {'mm': 1.0, 'cm': 10.0, 'm': 1000.0}
# Attributes of a Content, as named in messages.
PARTS = {
    'observations': 'image points',
    'survey': 'a phantom',
    'cameras': 'cameras',
    'stations': 'exterior orientations',
    'points': '3-D points',
    'bodies': 'poses of rigid bodies',
    'lookups': 'lookup tables of the distortion',
    'grids': 'points of a distortion grid',
}


def from_units(values: NDArray[np.float64], mm: float) -> NDArray[np.float64]:
    """Convert lengths in a unit of `mm` millimetres to mm; decimal digits are kept."""
    return _shifted(values, mm, 1)


def in_units(values_mm: NDArray[np.float64], mm: float) -> NDArray[np.float64]:
    """Convert lengths from mm to a unit of `mm` millimetres; decimal digits are kept."""
    return _shifted(values_mm, mm, -1)


def _shifted(values: NDArray[np.float64], mm: float, sign: int) -> NDArray[np.float64]:
    """Move the decimal point: 11.39205 cm are 113.9205 mm, not 113.92050000000002."""
    values = np.asarray(values, dtype=float)
    digits = sign * round(math.log10(mm))
    if not digits:
        return values
    scaled = [float(Decimal(repr(value)).scaleb(digits)) for value in values.ravel().tolist()]
    return np.array(scaled).reshape(values.shape)


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: the model of a fluoroscope after correction of its images."""

    name: str
    #: (3, 3), camera matrix [px]; for a fluoroscope [[c, 0, xp], [0, c, yp], [0, 0, 1]]
    matrix: NDArray[np.float64]
    image_size: tuple[int, int] | None = None  #: width and height [px]
    #: (3, 3), world -> sensor; None if the format has no exterior orientation
    rotation: NDArray[np.float64] | None = None
    translation_mm: NDArray[np.float64] | None = None  #: (3,), t of X_sensor = rotation P + t
    #: coefficients of OpenCV's model (k1, k2, p1, p2, k3, ...); empty without distortion
    distortion: tuple[float, ...] = ()

    @property
    def pose(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Rotation (3, 3) and translation (3,) [mm] of X_sensor = R X + t. Raises DataError."""
        if self.rotation is None or self.translation_mm is None:
            raise DataError(
                f'camera {self.name} has no position and attitude, which this format needs: '
                'orient the rig, or choose an exposure of the calibration with --exposure N'
            )
        return self.rotation, self.translation_mm

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [px]. Raises DataError if unknown."""
        if self.image_size is None:
            raise DataError(
                f'camera {self.name}: the source does not contain the image size, --image-size '
                'WxH is needed'
            )
        return self.image_size

    @property
    def is_distorted(self) -> bool:
        """Whether any coefficient of the distortion is nonzero."""
        return any(self.distortion)


def camera_at(
    name: str,
    matrix: NDArray[np.float64],
    image_size: tuple[int, int] | None,
    rotation: NDArray[np.float64],
    position_mm: np.ndarray,
) -> Camera:
    """Return the Camera with its source at position_mm (3,)."""
    return Camera(name, matrix, image_size, rotation, -rotation @ position_mm)


@dataclass(frozen=True)
class Station:
    """Exterior orientation of a fluoroscope in an exposure: X = rotation (P - position_mm)."""

    fluoroscope: str
    exposure: int
    rotation: NDArray[np.float64]
    position_mm: NDArray[np.float64]


@dataclass(frozen=True)
class Points:
    """3-D points over time; NaN where a point was not seen."""

    frame: NDArray[np.int64]  #: (m,), numbers of the frames, ascending
    target_id: NDArray[np.int64]  #: (n,)
    xyz_mm: NDArray[np.float64]  #: (m, n, 3)
    #: (m, n), standard deviation of the position: root of the sum of its three variances; NaN if
    #: unknown
    sd_mm: NDArray[np.float64]
    #: (m, n), RMS of the image residuals; NaN if unknown
    residual_px: NDArray[np.float64]
    rate_hz: float | None = None  #: frames per second; None if unknown


def points_without_precision(
    frame: NDArray[np.int64],
    target_id: NDArray[np.int64],
    xyz_mm: NDArray[np.float64],
    rate_hz: float | None = None,
) -> Points:
    """Return Points whose standard deviations and residuals are unknown."""
    unknown = np.full(xyz_mm.shape[:2], np.nan)
    return Points(
        frame, target_id, xyz_mm=xyz_mm, sd_mm=unknown, residual_px=unknown, rate_hz=rate_hz
    )


@dataclass(frozen=True)
class Bodies:
    """Poses of rigid bodies over time, P_world = R P_body + t; NaN where unknown."""

    names: tuple[str, ...]
    frame: NDArray[np.int64]  #: (m,)
    rotation: NDArray[np.float64]  #: (m, b, 3, 3)
    translation_mm: NDArray[np.float64]  #: (m, b, 3)
    rate_hz: float | None = None  #: frames per second; None if unknown


def pose_parts(
    matrices: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Split 4 x 4 matrices (m, b, 4, 4), one of which is missing if it has a NaN.

    Returns rotations (m, b, 3, 3) and translations (m, b, 3), NaN where missing, and a mask (m, b)
    of matrices that are not rotations.
    """
    missing = np.asarray(np.isnan(matrices).any(axis=(2, 3)))[..., None, None]
    known = np.where(missing, np.eye(4), matrices)
    is_invalid = ~is_rotation(known[..., :3, :3], TAKEN_TOLERANCE)
    parts = np.where(missing, np.nan, matrices)
    return parts[..., :3, :3], parts[..., :3, 3], is_invalid


def homogeneous(bodies: Bodies, mm: float = 1.0) -> NDArray[np.float64]:
    """Return the poses of bodies as matrices (m, b, 4, 4), lengths in units of mm."""
    matrices = np.zeros((*bodies.rotation.shape[:2], 4, 4))
    matrices[..., :3, :3] = bodies.rotation
    matrices[..., :3, 3] = in_units(bodies.translation_mm, mm)
    matrices[..., 3, 3] = 1.0
    matrices[np.isnan(matrices).any(axis=(2, 3))] = np.nan
    return matrices


@dataclass(frozen=True)
class Content:
    """Content of a file; missing parts are None or empty."""

    observations: Frames | None = None  #: image points by fluoroscope
    survey: Phantom | None = None
    cameras: tuple[Camera, ...] = ()
    stations: tuple[Station, ...] = ()
    points: Points | None = None
    bodies: Bodies | None = None
    #: by fluoroscope, the observed column and row of every pixel of the corrected image [px], NaN
    #: without support
    lookups: Mapping[str, np.ndarray] = field(default_factory=dict)
    #: by fluoroscope, the observed u, v and the reference u, v of points of a distortion grid
    grids: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    names: Names = field(default_factory=Names)  #: the names in the file
    notes: tuple[str, ...] = ()  #: notes to the user about the conversion
    #: by fluoroscope, the id of the calibration that corrected the observations; empty if they are
    #: uncorrected
    corrected_by: Mapping[str, str] = field(default_factory=dict)

    @property
    def parts(self) -> list[str]:
        """Names of the attributes that are not empty."""
        return [name for name in PARTS if has_content(getattr(self, name))]


def has_content(part: Any) -> bool:
    """Return whether a part of a Content is present."""
    return part is not None and (not isinstance(part, (tuple, Mapping)) or len(part) > 0)


@dataclass(frozen=True)
class FileSettings:
    """Settings by the user for facts that a file does not contain.

    Attributes
    ----------
    image_size : (int, int) or None
        Width and height [px] of all fluoroscopes.
    units : {'mm', 'cm', 'm'} or None
        Unit of lengths in the file; None: the unit stated by the file or its format.
    one_based : bool
        Whether pixel coordinates in the file start at 1.
    y_up : bool
        Whether image rows are counted upwards in the file.
    phantom_sd_mm : float or None
        Standard deviation of the bead coordinates if the file has none.
    trial : str or None
        Trial of an XMALab project.
    rate_hz : float or None
        Frames per second of 3-D points.
    names : Names
        Names with known ids.
    fluoroscopes : tuple of str
        Names for cameras that a file only numbers.
    wanted : tuple of str
        Parts to read from a file with several parts, names of PARTS.
    decisions : path-like or None
        Table of a person's decisions on doubtful image points and exposures of the file.
    sizes : mapping of str to (int, int)
        Width and height [px] by fluoroscope, where image_size is None: those of calibrations.
    """

    image_size: tuple[int, int] | None = None
    units: str | None = None
    one_based: bool = False
    y_up: bool = False
    phantom_sd_mm: float | None = None
    trial: str | None = None
    rate_hz: float | None = None
    names: Names = field(default_factory=Names)
    fluoroscopes: tuple[str, ...] = ()
    wanted: tuple[str, ...] = tuple(PARTS)
    decisions: PathLike | None = None
    sizes: Mapping[str, tuple[int, int]] = field(default_factory=dict)

    def fluoroscope_of(self, name: str, where: object) -> str:
        """Return the fluoroscope of a file that names its only camera. Raises DataError."""
        if len(self.fluoroscopes) == 1:
            return self.fluoroscopes[0]
        fluoroscope = self.names.fluoroscopes.get(name, name)
        check_safe_name(fluoroscope, where)
        return fluoroscope

    def size_of(self, fluoroscope: str) -> tuple[int, int] | None:
        """Return the image size of a fluoroscope, None if unknown; a common one is that of all."""
        sizes = set(self.sizes.values())
        common = sizes.pop() if len(sizes) == 1 else None
        return self.image_size or common or self.sizes.get(fluoroscope)

    def image_size_of(self, where: object, fluoroscope: str) -> tuple[int, int]:
        """Return the image size for a file that has none. Raises DataError if it is not set."""
        size = self.size_of(fluoroscope)
        if size is not None:
            return size
        if self.sizes:
            names = list(self.sizes)
            raise DataError(
                f'{where}: there is no calibration of fluoroscope {fluoroscope!r}, only of '
                f'{", ".join(names)}, whose images are of different size; name the cameras of the '
                f'file with --fluoroscopes {",".join(names)}'
            )
        raise DataError(
            f'{where}: this format does not contain the image size, --image-size WxH is needed '
            '(in Python image_size of read_source)'
        )

    def unit_read(self, where: object) -> float:
        """Return the unit in mm for a file that does not state it. Raises DataError if not set."""
        if self.units is None:
            raise DataError(
                f'{where}: this format does not state the unit of its lengths, --units '
                f'{"|".join(UNITS_MM)} is needed'
            )
        return UNITS_MM[self.units]

    def unit_stated(self, where: object, unit: str) -> float:
        """Return the unit in mm, that of the user or else of the file. Raises DataError."""
        mm = UNITS_MM.get(self.units or unit)
        if mm is None:
            raise DataError(f'{where} is {unit!r}, give it with --units')
        return mm

    def unit_or(self, default: str, subject: str) -> tuple[float, tuple[str, ...]]:
        """Return the unit in mm, and a note if it is the default of the format."""
        if self.units is not None:
            return UNITS_MM[self.units], ()
        note = (
            f'{subject}: lengths in {default}, as the format does not state a unit; change it '
            'with --units'
        )
        return UNITS_MM[default], (note,)


@dataclass(frozen=True)
class Written:
    """Files that were written, and notes to the user about them."""

    paths: tuple[str, ...]
    notes: tuple[str, ...] = ()


# Interface between the formats of other programs and the rest of the package.

Reader = Callable[[Path, FileSettings], Content]
Writer = Callable[[Path, Content, FileSettings], Written]


@dataclass(frozen=True)
class Sample:
    """Name and beginning of a file, by which formats recognise it."""

    path: Path
    head: bytes  #: first bytes of the file
    #: first lines that are not blank, without surrounding blanks; empty for a binary file
    lines: list[str]

    @property
    def suffix(self) -> str:
        """Suffix of the name in lower case, with the dot."""
        return self.path.suffix.lower()

    @property
    def first(self) -> str:
        """First line that is not blank, '' for a binary file."""
        return self.lines[0] if self.lines else ''

    @property
    def keys(self) -> set[str]:
        """Words before the first colon of each line: keys of a YAML file."""
        return {line.split(':')[0] for line in self.lines}


@dataclass(frozen=True)
class Format:
    """A file format."""

    kind: str  #: name on the command line
    title: str  #: name in messages
    parts: tuple[str, ...]  #: possible contents, names of `content.PARTS`
    recognise: Callable[[Sample], bool]  #: returns whether a Sample has the format
    #: reads a Content, raises DataError; None if the format is only written
    read: Reader | None
    #: writes a part of a Content, raises DataError; None if the format is only read
    write: Writer | None
    says_units: bool = True  #: whether the format states the unit of its lengths, or has none
    one_camera: bool = False  #: whether a file of image points contains a single fluoroscope


# Helpers of the camera formats that have one file for each fluoroscope in a folder.


def files_in_folder(folder: Path, names: Iterable[str], ending: str) -> dict[str, str]:
    """Create a folder; return the paths of its files <fluoroscope><ending>. Raises DataError."""
    names = list(names)
    for name in names:
        check_safe_name(name, folder)
    make_folder(folder)
    return {name: os.path.join(folder, name + ending) for name in names}


def write_cameras(
    folder: Path, cameras: Sequence[Camera], ending: str, text_of: Callable[[Camera], str]
) -> tuple[str, ...]:
    """Write a file for each camera into a folder, once all texts are complete.

    Returns the paths. Raises DataError.
    """
    texts = {camera.name: text_of(camera) for camera in cameras}
    paths = files_in_folder(folder, texts, ending)
    for name, path in paths.items():
        write_text(path, texts[name])
    return tuple(paths.values())


def name_of_file(path: Path, ending: str) -> str:
    """Return the camera name of a file: the file name without its ending."""
    return path.name[: -len(ending)] if path.name.endswith(ending) else path.stem


def check_rotation(where: object, rotation: NDArray[np.float64]) -> None:
    """Raise DataError for a matrix (3, 3) that is not a rotation."""
    if is_rotation(-rotation, TAKEN_TOLERANCE):
        raise DataError(f'{where}: the matrix is not a rotation, it mirrors')
    if not is_rotation(rotation, TAKEN_TOLERANCE):
        raise DataError(f'{where}: the matrix is not a rotation, its rows are not orthonormal')


def check_matrix(where: object, matrix: NDArray[np.float64]) -> None:
    """Raise DataError for a matrix (3, 3) that is not a camera matrix."""
    if not (matrix[0, 0] > 0 and matrix[1, 1] > 0):
        raise DataError(f'{where}: the focal lengths in the camera matrix are not above 0')
    if np.abs(matrix[2] - [0, 0, 1]).max() > 0 or matrix[1, 0]:
        raise DataError(f'{where}: this is not a camera matrix, its last row must be 0,0,1')


def refuse_distortion(path: PathLike, camera: Camera, title: str) -> None:
    """Raise DataError for a camera with distortion, which the format cannot represent."""
    if camera.is_distorted:
        raise DataError(
            f'{path}: camera {camera.name} has a distortion, which {title} cannot contain'
        )


def common_focal_length(path: PathLike, camera: Camera, title: str) -> float:
    """Return the principal distance of a camera with square pixels. Raises DataError otherwise."""
    fx = float(camera.matrix[0, 0])
    fy = float(camera.matrix[1, 1])
    if camera.matrix[0, 1] or abs(fx - fy) > 1e-9 * fx:
        raise DataError(
            f'{path}: camera {camera.name} has pixels that are not square (fx {fx:g}, fy {fy:g}), '
            f'which {title} cannot contain'
        )
    return fx
