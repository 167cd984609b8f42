# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""MayaCam 2.0: camera matrix, rotation and translation of one camera, for XMALab and Autoscoper.

The layout is that of `Camera::saveMayaCamVersion2` of XMALab 2.2.7 and `Camera::loadMayaCam2` of
Autoscoper, which reads values by the number of the line: 1 `image size`, 2 width,height, 5 to 7
the camera matrix, 10 to 12 the rotation, 15 to 17 the translation; comments and other blank lines
are not allowed. Pixel centres are at integers from (0, 0), v downwards; X = R P + t. The unit of
the translation is that of the calibration object (often mm), and the file does not say it. The
camera is that of corrected images; XMALab may add a block `undistortion` with eight coefficients
of OpenCV, which Autoscoper does not read.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...errors import DataError
from ..access import read_text
from .content import (
    Camera,
    Content,
    FileSettings,
    Format,
    Sample,
    Written,
    check_matrix,
    check_rotation,
    from_units,
    in_units,
    name_of_file,
    write_cameras,
)
from .text import Row, joined, number_text

ENDING = '_MayaCam2.txt'
_TITLES = {1: 'image size', 4: 'camera matrix', 9: 'rotation', 14: 'translation'}
_UNDISTORTION = 19  # line of its title
_COEFFICIENTS = 8


def recognise(sample: Sample) -> bool:
    """Return whether the first line is the title of MayaCam 2.0."""
    return bool(sample.lines) and sample.lines[0] == 'image size'


def read(path: Path, settings: FileSettings) -> Content:
    """Read a camera, which is called like the file. Raises DataError that names the line."""
    lines = read_text(path).splitlines()
    for number, title in _TITLES.items():
        if _line(path, lines, number).strip() != title:
            raise DataError(
                f'{path}, row {number}: {_line(path, lines, number)[:40]!r} stands where MayaCam '
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
    if len(lines) >= _UNDISTORTION and lines[_UNDISTORTION - 1].strip() == 'undistortion':
        numbers = range(_UNDISTORTION + 1, _UNDISTORTION + 1 + _COEFFICIENTS)
        distortion = tuple(_numbers(path, lines, number, 1)[0] for number in numbers)
    camera = Camera(
        name_of_file(path, ENDING),
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
    """Return the numbers of a line. Raises DataError for another count of them."""
    cells = [cell.strip() for cell in _line(path, lines, number).split(',')]
    row = Row(path, number, cells)
    if len(cells) != count:
        row.fail(f'{len(cells)} numbers, but MayaCam 2.0 has {count} here')
    return row.numbers()


def write(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write a file <fluoroscope>_MayaCam2.txt for each camera into the folder path."""
    mm, notes = settings.unit_or('mm', str(path))
    paths = write_cameras(path, content.cameras, ENDING, lambda camera: _text(camera, mm))
    return Written(paths, notes)


def _text(camera: Camera, mm: float) -> str:
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
        padded = [*camera.distortion, *[0.0] * _COEFFICIENTS][:_COEFFICIENTS]
        lines += ['', 'undistortion', *map(number_text, padded)]
    return '\n'.join(lines) + '\n'


FORMAT = Format(
    'mayacam2',
    'MayaCam 2.0',
    parts=('cameras',),
    recognise=recognise,
    read=read,
    write=write,
    looks_like='image size, 1024,1024, (blank), camera matrix, ...',
    says_units=False,
)
