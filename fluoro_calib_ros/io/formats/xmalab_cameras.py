# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Cameras of XMALab: MayaCam 2.0 and 1.0, DLT coefficients, undistortion lookup table.

MayaCam 2.0 contains camera matrix, rotation and translation of one camera. The layout is that of
`Camera::saveMayaCamVersion2` of XMALab 2.2.7 and `Camera::loadMayaCam2` of Autoscoper, which reads
values by line number: 1 `image size`, 2 width,height, 5 to 7 the camera matrix, 10 to 12 the
rotation, 15 to 17 the translation. Comments and other blank lines are not allowed. Pixel centres
are at integers from (0, 0), v downwards; X = R P + t. The translation has the unit of the
calibration object (often mm), which the file does not state. The camera applies to corrected
images; XMALab may add a block `undistortion` with eight coefficients of OpenCV, which Autoscoper
does not read.

XMALab's undistortion lookup table has H rows of column coordinates, then H rows of row
coordinates. The layout is that of `UndistortionObject::exportData` of XMALab 2.2.7: for every
pixel of the corrected image the column, and then the row, of the corresponding pixel of the
observed image, as float32; pixel centres at integers from (0, 0), v downwards, -1 without support.
cv2.remap takes the same map.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import rq
from scipy.spatial.transform import Rotation

from ...errors import DataError, quoted
from ...limits import MAX_IMAGE_SIDE
from ..access import atomic_file, check_rows, read_text, write_text
from .content import (
    Y_UP_TO_DOWN,
    Camera,
    Content,
    FileSettings,
    Format,
    Sample,
    Written,
    camera_at,
    check_matrix,
    check_rotation,
    files_in_folder,
    from_units,
    in_units,
    name_of_file,
    refuse_distortion,
    write_cameras,
)
from .tables import (
    Row,
    are_numbers,
    joined,
    number_text,
    read_table,
    require_width,
    separator_of,
)

_MAYACAM2 = '_MayaCam2.txt'
_TITLES = {1: 'image size', 4: 'camera matrix', 9: 'rotation', 14: 'translation'}


def _read_mayacam2(path: Path, settings: FileSettings) -> Content:
    """Read a camera, named after the file. Raises DataError that names the line."""
    lines = read_text(path).splitlines()
    for number, title in _TITLES.items():
        if _line(path, lines, number).strip() != title:
            raise DataError(
                f'{path}, row {number}: {quoted(_line(path, lines, number))} is where MayaCam '
                f'2.0 has the line {title!r}'
            )
    width, height = _numbers(path, lines, 2, 2)
    if not (width > 0 and height > 0 and width == int(width) and height == int(height)):
        raise DataError(f'{path}, row 2: {width:g} x {height:g} px is not an image size')
    matrix = np.array([_numbers(path, lines, number, 3) for number in (5, 6, 7)])
    rotation = np.array([_numbers(path, lines, number, 3) for number in (10, 11, 12)])
    translation = np.array([_numbers(path, lines, number, 1)[0] for number in (15, 16, 17)])
    check_matrix(f'{path}, row 5', matrix)
    check_rotation(f'{path}, row 10', rotation)
    distortion: tuple[float, ...] = ()
    if len(lines) >= 19 and _line(path, lines, 19).strip() == 'undistortion':
        distortion = tuple(_numbers(path, lines, number, 1)[0] for number in range(20, 28))
    camera = Camera(
        name_of_file(path, _MAYACAM2),
        matrix,
        image_size=(int(width), int(height)),
        rotation=rotation,
        translation_mm=from_units(translation, settings.unit_read(path)),
        distortion=distortion,
    )
    return Content(cameras=(camera,))


def _line(path: Path, lines: list[str], number: int) -> str:
    if number > len(lines):
        raise DataError(f'{path}: the file ends at row {len(lines)}, MayaCam 2.0 has 17 rows')
    return lines[number - 1]


def _numbers(path: Path, lines: list[str], number: int, count: int) -> list[float]:
    """Return the numbers of a line. Raises DataError unless there are `count` of them."""
    cells = [cell.strip() for cell in _line(path, lines, number).split(',')]
    row = Row(path, number, cells)
    if len(cells) != count:
        row.fail(f'{len(cells)} numbers, but MayaCam 2.0 has {count} here')
    return row.numbers()


def _write_mayacam2(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write a file <fluoroscope>_MayaCam2.txt for each camera into the folder path."""
    mm, notes = settings.unit_or('mm', str(path))
    paths = write_cameras(
        path, content.cameras, _MAYACAM2, lambda camera: _mayacam2_text(camera, mm)
    )
    return Written(paths, notes)


def _mayacam2_text(camera: Camera, mm: float) -> str:
    rotation, translation = camera.pose
    width, height = camera.size
    lines = [
        'image size',
        f'{width},{height}',
        '',
        'camera matrix',
        *map(joined, camera.matrix),
        '',
        'rotation',
        *map(joined, rotation),
        '',
        'translation',
        *map(number_text, in_units(translation, mm)),
    ]
    if camera.is_distorted:
        padded = [*camera.distortion, *[0.0] * 8][:8]  # k1, k2, p1, p2, k3 to k6 of OpenCV
        lines += ['', 'undistortion', *map(number_text, padded)]
    return '\n'.join(lines) + '\n'


MAYACAM2 = Format(
    'mayacam2',
    'MayaCam 2.0',
    parts=('cameras',),
    recognise=lambda sample: sample.first == 'image size',
    read=_read_mayacam2,
    write=_write_mayacam2,
    says_units=False,
)


# MayaCam 1.0: five rows of three numbers; read only.
#
# The layout is that of `Camera::getMayaCam` of XMALab 2.2.7 and `Camera::loadMayaCam1` of
# Autoscoper: position of the source; angles x, y, z [degrees] of the camera's axes in the world,
# turned about z, then y, then x; position of the film plane (derived, not read); principal point
# u0, v0 and -c [px], counted from 1, v upwards; scale, width, height (0: 1024). The camera looks
# along -z, y upwards. The file does not state the unit of lengths, that of the calibration object.

_MAYACAM1 = '_MayaCam.csv'


def _read_mayacam1(path: Path, settings: FileSettings) -> Content:
    """Read a camera, named after the file. Raises DataError that names the row."""
    rows = read_table(path)
    if len(rows) != 5:
        raise DataError(f'{path}: {len(rows)} rows, but MayaCam 1.0 has 5')
    require_width(rows, 3, 'MayaCam 1.0')
    position, angles, _, (u0, v0, z), (_, width, height) = (row.numbers() for row in rows)
    for value in (width, height):
        if value < 0 or value != int(value):
            rows[4].fail(f'{value:g} px is not a side of an image')
    size = (int(width) or 1024, int(height) or 1024)
    if not z:
        rows[3].fail('the principal distance is 0')
    # Columns: axes x, y, z of the camera in the world; extrinsic rotations about x, y and z.
    axes = Rotation.from_euler('xyz', angles, degrees=True).as_matrix()
    matrix = np.array([[abs(z), 0, u0 - 1], [0, abs(z), size[1] - 1 - (v0 - 1)], [0, 0, 1]])
    camera = camera_at(
        name_of_file(path, _MAYACAM1),
        matrix,
        size,
        (axes @ Y_UP_TO_DOWN).T,
        from_units(np.array(position), settings.unit_read(path)),
    )
    return Content(cameras=(camera,))


MAYACAM1 = Format(
    'mayacam1',
    'MayaCam 1.0',
    parts=('cameras',),
    recognise=lambda sample: are_numbers(sample.lines, 5, 3),
    read=_read_mayacam1,
    write=None,
    says_units=False,
)


# Eleven coefficients of the direct linear transformation, one column a camera.
#
# The layout is that of `Project::exportDLT` of XMALab 2.2.7, as DLTdv and Argus read it: eleven
# rows L1 to L11, x = (L1 X + L2 Y + L3 Z + L4) / (L9 X + L10 Y + L11 Z + 1), y with L5 to L8
# (Abdel-Aziz and Karara, 1971). x and y count from 1, y upwards; the image height converts them to
# ours. DLTdv8 and easyWand6 count y downwards. Such a file is recognised: with y taken as upwards,
# the origin, where L12 is 1, would lie behind every camera. Lengths have the unit of the
# calibration object, which the file does not state.


def _read_dlt(path: Path, settings: FileSettings) -> Content:
    """Read the cameras, which are named cam1, cam2, ... unless settings name them.

    Raises DataError, also without the image size.
    """
    rows = read_table(path)
    if len(rows) != 11:
        raise DataError(f'{path}: {len(rows)} rows, but there are 11 coefficients of a DLT')
    require_width(rows, len(rows[0].cells), 'the first row')
    mm = settings.unit_read(path)
    columns = np.array([row.numbers() for row in rows]).T
    names = settings.fluoroscopes
    if len(names) != len(columns):
        names = tuple(f'cam{number}' for number in range(1, len(columns) + 1))
    ones = np.ones((len(columns), 1))
    projections = np.concatenate([columns, ones], axis=1).reshape(-1, 3, 4)
    downwards = bool((np.linalg.det(projections[:, :, :3]) > 0).all())
    cameras = []
    for name, projection in zip(names, projections):
        size = settings.image_size_of(path, name)
        to_pixels = np.linalg.inv(_file_pixels(size, downwards))
        try:
            cameras.append(_dlt_camera(name, to_pixels @ projection, size, mm))
        except ValueError as error:
            raise DataError(f'{path}, {name}: {error}') from None
    note = (
        f'{path}: rows are counted downwards, as in DLTdv8: otherwise the origin would be behind '
        'the cameras'
    )
    return Content(cameras=tuple(cameras), notes=(note,) if downwards else ())


def _file_pixels(size: tuple[int, int], downwards: bool = False) -> NDArray[np.float64]:
    """Return the matrix (3, 3) from our homogeneous pixels to those of the file."""
    if downwards:
        return np.array([[1.0, 0, 1], [0, 1, 1], [0, 0, 1]])
    return np.array([[1.0, 0, 1], [0, -1, size[1]], [0, 0, 1]])


def _dlt_camera(
    name: str, projection: NDArray[np.float64], size: tuple[int, int], mm: float
) -> Camera:
    """Return the camera of a matrix (3, 4) from homogeneous coordinates to our pixels.

    Source: Hartley and Zisserman, Multiple View Geometry, 2nd edition, section 6.2.4. Raises
    ValueError if the matrix does not represent a camera.
    """
    if not np.linalg.det(projection[:, :3]):
        raise ValueError('the coefficients are not those of a camera with a finite position')
    position = -np.linalg.solve(projection[:, :3], projection[:, 3])
    # Points in front of the camera have a positive depth if the determinant is positive.
    upper, rotation = rq(projection[:, :3] * np.sign(np.linalg.det(projection[:, :3])))
    signs = np.diag(np.sign(np.diag(upper)))
    matrix = upper @ signs
    rotation = signs @ rotation
    matrix = matrix / matrix[2, 2]
    return camera_at(name, matrix, size, rotation, position * mm)


def _write_dlt(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write the coefficients of all cameras, in their order."""
    mm, notes = settings.unit_or('mm', str(path))
    columns = []
    for camera in content.cameras:
        refuse_distortion(path, camera, 'a DLT')
        rotation, translation = camera.pose
        pose = np.column_stack([rotation, translation / mm])
        projection = _file_pixels(camera.size) @ camera.matrix @ pose
        if not abs(projection[2, 3]) > 0:
            raise DataError(
                f'{path}: the origin lies in the plane of the source of {camera.name}, a DLT with '
                'eleven coefficients does not exist'
            )
        columns.append((projection / projection[2, 3]).ravel()[:-1])
    write_text(path, '\n'.join(map(joined, np.array(columns).T)) + '\n')
    order = ', '.join(camera.name for camera in content.cameras)
    return Written((str(path),), (*notes, f'{path}: the columns are {order}'))


DLT = Format(
    'dlt',
    'DLT coefficients',
    parts=('cameras',),
    recognise=lambda sample: are_numbers(sample.lines, 11),
    read=_read_dlt,
    write=_write_dlt,
    says_units=False,
)


ENDING = '_LUT.csv'
NOWHERE = -1.0  # value of XMALab for pixels without support
_MIN_COLUMNS = 32  # a table with fewer columns is not a lookup table


def recognise(sample: Sample) -> bool:
    """Return whether the first row is long enough to be a row of an image."""
    cells = sample.first.split(',')[:_MIN_COLUMNS]
    return are_numbers([','.join(cells)], 1, _MIN_COLUMNS)


def read(path: Path, settings: FileSettings) -> Content:
    """Read a table; the fluoroscope is named after the file. Raises DataError."""
    text = read_text(path)
    check_rows(text, 2 * MAX_IMAGE_SIDE, path)
    if not text.strip():
        raise DataError(f'{path}: the file has no rows')
    separator = separator_of(text)
    plain = io.StringIO(text.replace(',', '.') if separator == ';' else text)
    try:
        table = np.loadtxt(plain, np.float32, delimiter=separator, comments=None, ndmin=2)
    except ValueError:
        rows = read_table(path)
        require_width(rows, len(rows[0].cells), 'the first row')
        table = np.array([row.numbers() for row in rows], dtype=np.float32)
    if len(table) % 2:
        raise DataError(
            f'{path}: {len(table)} rows, but a lookup table has as many for the rows as for the '
            'columns of the map'
        )
    maps = table.reshape(2, -1, table.shape[1])
    size = (maps.shape[2], maps.shape[1])
    name = name_of_file(path, ENDING)
    expected = settings.size_of(name) or size
    if expected != size:
        raise DataError(
            f'{path}: the table is for an image of {size[0]} x {size[1]} px, not of '
            f'{expected[0]} x {expected[1]} px'
        )
    maps[:, (maps == NOWHERE).any(axis=0)] = np.nan
    return Content(lookups={name: maps})


def write(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write a file <fluoroscope>_LUT.csv for each fluoroscope into the folder path."""
    paths = files_in_folder(path, content.lookups, ENDING)
    for name, maps in content.lookups.items():
        table = np.where(np.isnan(maps).any(axis=0), np.float32(NOWHERE), maps)
        with atomic_file(paths[name], 'w') as file:
            for row in table.astype(np.float32).reshape(-1, table.shape[2]).tolist():
                # Nine significant digits represent a float32 exactly.
                file.write(', '.join([f'{value:.9g}' for value in row]) + '\n')
    return Written(tuple(paths.values()))


LOOKUP = Format(
    'lut',
    'XMALab undistortion lookup table',
    parts=('lookups',),
    recognise=recognise,
    read=read,
    write=write,
)
