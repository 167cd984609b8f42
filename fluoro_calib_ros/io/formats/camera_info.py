# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""ROS camera_info YAML, as camera_calibration writes it and camera_info_manager reads it.

image_width, image_height, camera_name, camera_matrix {rows, cols, data}, distortion_model,
distortion_coefficients, rectification_matrix, projection_matrix. It is of the interior orientation
only. Pixel centres are at integers from (0, 0), v downwards.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ...errors import DataError
from ..documents import read_yaml
from .anipose import numbers_of
from .content import (
    Camera,
    Content,
    FileSettings,
    Format,
    Sample,
    Written,
    check_matrix,
    write_cameras,
)

ENDING = '_camera_info.yaml'
_MODELS = ('plumb_bob', 'rational_polynomial')


def recognise(sample: Sample) -> bool:
    """Return whether the file has the entries of camera_info, and no first line of OpenCV."""
    if not sample.lines or sample.lines[0].startswith('%YAML'):
        return False
    keys = {line.split(':')[0] for line in sample.lines}
    return {'camera_matrix', 'image_width'} <= keys


def read(path: Path, settings: FileSettings) -> Content:
    """Read a camera. Raises DataError."""
    document = read_yaml(path)
    if not isinstance(document, Mapping):
        raise DataError(f'{path}: this is not a camera_info, it has no entries')
    matrix = _matrix(path, document, 'camera_matrix', (3, 3))
    check_matrix(path, matrix)
    size = [numbers_of(path, document, key, ()) for key in ('image_width', 'image_height')]
    model = document.get('distortion_model', _MODELS[0])
    distortion = np.zeros(0)
    if 'distortion_coefficients' in document:
        distortion = _matrix(path, document, 'distortion_coefficients', None).ravel()
    if distortion.any() and model not in _MODELS:
        raise DataError(f'{path}: the distortion model {model!r} is not supported')
    camera = Camera(
        str(document.get('camera_name', path.stem)),
        matrix,
        (int(size[0]), int(size[1])),
        distortion=tuple(distortion.tolist()) if distortion.any() else (),
    )
    return Content(cameras=(camera,))


def _matrix(
    path: Path, document: Mapping[str, Any], key: str, shape: tuple[int, ...] | None
) -> np.ndarray:
    """Return an entry {rows, cols, data} as an array. Raises DataError."""
    entry = document.get(key)
    if not isinstance(entry, Mapping):
        raise DataError(f'{path}: there is no {key} with rows, cols and data')
    data = numbers_of(f'{path}, {key}', entry, 'data', None)
    rows = entry.get('rows')
    columns = entry.get('cols')
    if type(rows) is not int or type(columns) is not int or data.size != rows * columns:
        raise DataError(f'{path}, {key}: rows {rows}, cols {columns}, but {data.size} numbers')
    if shape not in (None, (rows, columns)):
        raise DataError(f'{path}, {key}: {rows} x {columns} numbers')
    return data.reshape(rows, columns)


def write(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write a file <fluoroscope>_camera_info.yaml for each camera into the folder path."""
    paths = write_cameras(path, content.cameras, ENDING, _text)
    note = f'{path}: camera_info has no position and attitude, only the interior orientation'
    return Written(paths, (note,))


def _text(camera: Camera) -> str:
    width, height = camera.size
    projection = np.column_stack([camera.matrix, np.zeros(3)])
    distortion = camera.distortion or (0.0,) * 5
    document = {
        'image_width': width,
        'image_height': height,
        'camera_name': camera.name,
        'camera_matrix': _entry(camera.matrix),
        'distortion_model': _MODELS[len(distortion) > 5],
        'distortion_coefficients': _entry(np.array([distortion])),
        'rectification_matrix': _entry(np.eye(3)),
        'projection_matrix': _entry(projection),
    }
    return yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=1000)


def _entry(matrix: np.ndarray) -> dict[str, Any]:
    rows, columns = matrix.shape
    return {'rows': rows, 'cols': columns, 'data': matrix.ravel().tolist()}


FORMAT = Format(
    'camera_info',
    'ROS camera_info YAML',
    parts=('cameras',),
    recognise=recognise,
    read=read,
    write=write,
    looks_like='image_width: 1024, camera_matrix: ...',
)
