# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Eleven coefficients of the direct linear transformation, one column a camera.

The layout is that of `Project::exportDLT` of XMALab 2.2.7, as DLTdv and Argus read it: eleven rows
L1 to L11, x = (L1 X + L2 Y + L3 Z + L4) / (L9 X + L10 Y + L11 Z + 1), y with L5 to L8
(Abdel-Aziz and Karara, 1971). x and y count from 1, y upwards; the image height turns them into
ours. The unit is that of the calibration object, and the file does not say it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.linalg import rq

from ...errors import DataError
from ..access import write_text
from .content import (
    Camera,
    Content,
    FileSettings,
    Format,
    Sample,
    Written,
    camera_at,
    refuse_distortion,
)
from .text import joined, read_table, require_width

ROWS = 11


def recognise(sample: Sample) -> bool:
    """Return whether the file has eleven rows of as many numbers."""
    if len(sample.lines) != ROWS:
        return False
    try:
        widths = {len([float(cell) for cell in line.split(',')]) for line in sample.lines}
    except ValueError:
        return False
    return len(widths) == 1


def read(path: Path, settings: FileSettings) -> Content:
    """Read the cameras, which are called cam1, cam2, ... unless settings name them.

    Raises DataError, also without the image size.
    """
    rows = read_table(path)
    if len(rows) != ROWS:
        raise DataError(f'{path}: {len(rows)} rows, but there are {ROWS} coefficients of a DLT')
    require_width(rows, len(rows[0].cells), 'the first row')
    if settings.image_size is None:
        raise DataError(
            f'{path}: DLT coefficients do not contain the image size, --image-size WxH is needed'
        )
    mm = settings.unit_read(path)
    columns = np.array([row.numbers() for row in rows]).T
    names = settings.fluoroscopes
    if len(names) != len(columns):
        names = tuple(f'cam{number}' for number in range(1, len(columns) + 1))
    cameras = []
    for name, column in zip(names, columns):
        try:
            cameras.append(_camera(name, column, settings.image_size, mm))
        except ValueError as error:
            raise DataError(f'{path}, {name}: {error}') from None
    return Content(cameras=tuple(cameras))


def _file_pixels(size: tuple[int, int]) -> np.ndarray:
    """Return the matrix (3, 3) from our homogeneous pixels to those of the file."""
    return np.array([[1.0, 0, 1], [0, -1, size[1]], [0, 0, 1]])


def _camera(name: str, coefficients: np.ndarray, size: tuple[int, int], mm: float) -> Camera:
    """Return the camera of the coefficients (11,).

    Source: Hartley and Zisserman, Multiple View Geometry, 2nd edition, section 6.2.4. Raises
    ValueError for coefficients that are not of a camera.
    """
    projection = np.append(coefficients, 1.0).reshape(3, 4)
    projection = np.linalg.inv(_file_pixels(size)) @ projection
    if not np.linalg.det(projection[:, :3]):
        raise ValueError('the coefficients are not those of a camera with a finite position')
    position = -np.linalg.solve(projection[:, :3], projection[:, 3])
    # Points before the camera have a positive depth where the determinant is positive.
    upper, rotation = rq(projection[:, :3] * np.sign(np.linalg.det(projection[:, :3])))
    signs = np.diag(np.sign(np.diag(upper)))
    matrix = upper @ signs
    rotation = signs @ rotation
    matrix = matrix / matrix[2, 2]
    return camera_at(name, matrix, size, rotation, position * mm)


def write(path: Path, content: Content, settings: FileSettings) -> Written:
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
        columns.append((projection / projection[2, 3]).ravel()[:ROWS])
    write_text(path, '\n'.join(map(joined, np.array(columns).T)) + '\n')
    order = ', '.join(camera.name for camera in content.cameras)
    return Written((str(path),), (*notes, f'{path}: the columns are {order}'))


FORMAT = Format(
    'dlt',
    'DLT coefficients',
    parts=('cameras',),
    recognise=recognise,
    read=read,
    write=write,
    looks_like='eleven rows of numbers',
    says_units=False,
)
