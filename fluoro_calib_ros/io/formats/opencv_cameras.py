# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Cameras with OpenCV's distortion model: OpenCV YAML, Anipose and ROS camera_info.

OpenCV YAML contains camera_matrix, distortion_coefficients, R and T of a camera. The names are
those that OpenCV's calibration sample writes (image_width, image_height, camera_matrix,
distortion_coefficients), with R and T of X = R P + t named as in its stereo sample. Pixel centres
are at integers from (0, 0), v downwards. The file does not state the unit of T.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from ...errors import DataError
from ...photogrammetry.rotations import matrix_from_vector, vector_from_matrix
from ..access import PathLike, read_text, write_text
from ..documents import check_yaml, numbers_of, read_toml, read_yaml
from .content import (
    Camera,
    Content,
    FileSettings,
    Format,
    Written,
    check_matrix,
    check_rotation,
    from_units,
    in_units,
    name_of_file,
    write_cameras,
)

_OPENCV = '_opencv.yaml'
MATRIX_NAMES = ('camera_matrix', 'Camera_Matrix', 'cameraMatrix', 'K')
DISTORTION_NAMES = ('distortion_coefficients', 'Distortion_Coefficients', 'distCoeffs', 'D')


def _read_opencv(path: Path, settings: FileSettings) -> Content:
    """Read a camera, named after the file. Raises DataError."""
    text = read_text(path)
    check_yaml(text, path)  # OpenCV crashes on deep nesting
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    except (cv2.error, SystemError):
        raise DataError(f'{path}: this is not a file of OpenCV, or it is damaged') from None
    try:
        return Content(cameras=(_opencv_camera(path, storage, settings),))
    except cv2.error:
        raise DataError(f'{path}: this file of OpenCV is damaged') from None
    finally:
        storage.release()


def _opencv_camera(path: Path, storage: cv2.FileStorage, settings: FileSettings) -> Camera:
    matrix = _node_matrix(path, storage, MATRIX_NAMES)
    if matrix is None or matrix.shape != (3, 3):
        raise DataError(f'{path}: there is no camera_matrix of 3 x 3 numbers')
    check_matrix(path, matrix)
    distortion = _node_matrix(path, storage, DISTORTION_NAMES)
    if distortion is None or not distortion.any():
        distortion = np.zeros(0)
    coefficients = tuple(distortion.ravel().tolist())
    width = storage.getNode('image_width')
    height = storage.getNode('image_height')
    name = name_of_file(path, _OPENCV)
    size = settings.size_of(name)
    if not width.empty() and not height.empty():
        size = (int(width.real()), int(height.real()))
    camera = Camera(name, matrix, size, distortion=coefficients)
    rotation = _node_matrix(path, storage, ('R',))
    translation = _node_matrix(path, storage, ('T', 't'))
    if rotation is None or translation is None:
        return camera
    if rotation.shape != (3, 3):
        rotation, _ = cv2.Rodrigues(rotation)
    check_rotation(path, rotation)
    if translation.size != 3:
        raise DataError(f'{path}: T has {translation.size} numbers, not 3')
    translation_mm = from_units(translation.ravel(), settings.unit_read(path))
    return replace(camera, rotation=rotation, translation_mm=translation_mm)


def _node_matrix(
    path: Path, storage: cv2.FileStorage, names: tuple[str, ...]
) -> NDArray[np.float64] | None:
    """Return the first matrix with one of the names, None if there is none. Raises DataError."""
    for name in names:
        node = storage.getNode(name)
        if node.empty():
            continue
        matrix = node.mat()
        if matrix is None or not np.isfinite(matrix).all():
            raise DataError(f'{path}: {name} is not a matrix of finite numbers')
        return np.asarray(matrix, dtype=float)
    return None


def _write_opencv(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write a file <fluoroscope>_opencv.yaml for each camera into the folder path."""
    mm, notes = settings.unit_or('mm', str(path))
    paths = write_cameras(path, content.cameras, _OPENCV, lambda camera: _opencv_text(camera, mm))
    return Written(paths, notes if any(c.rotation is not None for c in content.cameras) else ())


def _opencv_text(camera: Camera, mm: float) -> str:
    storage = cv2.FileStorage(
        '.yaml', cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | cv2.FILE_STORAGE_FORMAT_YAML
    )
    if camera.image_size is not None:
        storage.write('image_width', camera.image_size[0])
        storage.write('image_height', camera.image_size[1])
    storage.write('camera_matrix', camera.matrix)
    storage.write('distortion_coefficients', np.array([camera.distortion or (0.0,) * 5]).T)
    if camera.rotation is not None:
        rotation, translation = camera.pose
        storage.write('R', rotation)
        storage.write('T', in_units(translation, mm).reshape(3, 1))
    return storage.releaseAndGetString()


OPENCV = Format(
    'opencv',
    'OpenCV YAML',
    parts=('cameras',),
    recognise=lambda sample: (
        sample.first.startswith('%YAML') and bool(sample.keys & set(MATRIX_NAMES))
    ),
    read=_read_opencv,
    write=_write_opencv,
    says_units=False,
)


# Anipose calibration.toml: one table [cam_0], [cam_1], ... a camera, with rotation vectors.
#
# The layout is that of `CameraGroup.dump` of aniposelib: name, size (width, height), matrix,
# distortions (OpenCV), rotation (Rodrigues vector) and translation of X = R P + t, metadata.
# Pixels are those of OpenCV. Lengths have the unit of the calibration board, which the file does
# not state.


def _read_anipose(path: Path, settings: FileSettings) -> Content:
    """Read the cameras. Raises DataError."""
    document = read_toml(path)
    tables = {key: document[key] for key in sorted(document) if key != 'metadata'}
    if not tables or not all(isinstance(t, Mapping) and 'matrix' in t for t in tables.values()):
        raise DataError(
            f'{path}: this is not a calibration of Anipose, it has no tables [cam_0], [cam_1] '
            'with a matrix'
        )
    mm = settings.unit_read(path)
    cameras = tuple(
        _anipose_camera(f'{path}, [{key}]', table, mm) for key, table in tables.items()
    )
    return Content(cameras=cameras)


def _anipose_camera(where: str, table: Mapping[str, Any], mm: float) -> Camera:
    if table.get('fisheye'):
        raise DataError(f'{where}: fisheye cameras are not supported')
    matrix = numbers_of(where, table, 'matrix', (3, 3))
    check_matrix(where, matrix)
    size = _size(where, numbers_of(where, table, 'size', (2,)))
    distortion = numbers_of(where, table, 'distortions').ravel()
    return Camera(
        str(table.get('name', where)),
        matrix,
        image_size=size,
        rotation=matrix_from_vector(numbers_of(where, table, 'rotation', (3,))),
        translation_mm=from_units(numbers_of(where, table, 'translation', (3,)), mm),
        distortion=tuple(distortion.tolist()) if distortion.any() else (),
    )


def _size(where: object, values: NDArray[np.float64]) -> tuple[int, int]:
    """Return width and height of an image. Raises DataError unless they are whole and above 0."""
    width, height = values.tolist()
    if not (values > 0).all() or (values % 1).any():
        raise DataError(
            f'{where}: the image size {width:g} x {height:g} px is not of whole numbers above 0'
        )
    return int(width), int(height)


def _write_anipose(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write all cameras into one file."""
    mm, notes = settings.unit_or('mm', str(path))
    lines = []
    for number, camera in enumerate(content.cameras):
        rotation, translation = camera.pose
        distortion = camera.distortion or (0.0,) * 5
        lines += [
            f'[cam_{number}]',
            f'name = {_quoted(path, camera.name)}',
            f'size = {list(camera.size)}',
            f'matrix = {camera.matrix.tolist()}',
            f'distortions = {list(distortion)}',
            f'rotation = {vector_from_matrix(rotation).tolist()}',
            f'translation = {in_units(translation, mm).tolist()}',
            '',
        ]
    lines += ['[metadata]', 'adjusted = false']
    write_text(path, '\n'.join(lines) + '\n')
    return Written((str(path),), notes)


def _quoted(path: PathLike, name: str) -> str:
    if not name.isprintable():
        raise DataError(f'{path}: a camera cannot be called {name!r} in this format')
    escaped = name.replace('\\', '\\\\').replace('"', '\\"')
    return f'"{escaped}"'


ANIPOSE = Format(
    'anipose',
    'Anipose calibration',
    parts=('cameras',),
    recognise=lambda sample: (
        sample.suffix == '.toml' and any(line.startswith('[') for line in sample.lines)
    ),
    read=_read_anipose,
    write=_write_anipose,
    says_units=False,
)


# ROS camera_info YAML, as camera_calibration writes it and camera_info_manager reads it.
#
# image_width, image_height, camera_name, camera_matrix {rows, cols, data}, distortion_model,
# distortion_coefficients, rectification_matrix, projection_matrix. It contains the interior
# orientation only. Pixel centres are at integers from (0, 0), v downwards.

_CAMERA_INFO = '_camera_info.yaml'
_MODELS = ('plumb_bob', 'rational_polynomial')


def _read_camera_info(path: Path, settings: FileSettings) -> Content:
    """Read a camera. Raises DataError."""
    document = read_yaml(path)
    if not isinstance(document, Mapping):
        raise DataError(f'{path}: this is not a camera_info, it has no entries')
    matrix = _entry_matrix(path, document, 'camera_matrix', (3, 3))
    check_matrix(path, matrix)
    size = [numbers_of(path, document, key, ()) for key in ('image_width', 'image_height')]
    image_size = _size(path, np.array(size))
    model = document.get('distortion_model', _MODELS[0])
    distortion = np.zeros(0)
    if 'distortion_coefficients' in document:
        distortion = _entry_matrix(path, document, 'distortion_coefficients', None).ravel()
    if distortion.any() and model not in _MODELS:
        raise DataError(f'{path}: the distortion model {model!r} is not supported')
    camera = Camera(
        str(document.get('camera_name', path.stem)),
        matrix,
        image_size,
        distortion=tuple(distortion.tolist()) if distortion.any() else (),
    )
    return Content(cameras=(camera,))


def _entry_matrix(
    path: Path, document: Mapping[str, Any], key: str, shape: tuple[int, ...] | None
) -> NDArray[np.float64]:
    """Return an entry {rows, cols, data} as an array. Raises DataError."""
    entry = document.get(key)
    if not isinstance(entry, Mapping):
        raise DataError(f'{path}: there is no {key} with rows, cols and data')
    data = numbers_of(f'{path}, {key}', entry, 'data')
    rows = entry.get('rows')
    columns = entry.get('cols')
    if type(rows) is not int or type(columns) is not int or data.size != rows * columns:
        raise DataError(f'{path}, {key}: rows {rows}, cols {columns}, but {data.size} numbers')
    if shape not in (None, (rows, columns)):
        raise DataError(f'{path}, {key}: {rows} x {columns} numbers')
    return data.reshape(rows, columns)


def _write_camera_info(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write a file <fluoroscope>_camera_info.yaml for each camera into the folder path."""
    paths = write_cameras(path, content.cameras, _CAMERA_INFO, _camera_info_text)
    note = f'{path}: camera_info has no position and attitude, only the interior orientation'
    return Written(paths, (note,))


def _camera_info_text(camera: Camera) -> str:
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


def _entry(matrix: NDArray[np.float64]) -> dict[str, Any]:
    rows, columns = matrix.shape
    return {'rows': rows, 'cols': columns, 'data': matrix.ravel().tolist()}


CAMERA_INFO = Format(
    'camera_info',
    'ROS camera_info YAML',
    parts=('cameras',),
    recognise=lambda sample: (
        not sample.first.startswith('%YAML') and {'camera_matrix', 'image_width'} <= sample.keys
    ),
    read=_read_camera_info,
    write=_write_camera_info,
)
