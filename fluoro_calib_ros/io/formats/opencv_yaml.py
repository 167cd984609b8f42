# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""OpenCV YAML: camera_matrix, distortion_coefficients, rotation R and translation T of a camera.

The names are those that OpenCV's calibration sample writes (image_width, image_height,
camera_matrix, distortion_coefficients), with R and T of X = R P + t as its stereo sample calls
them. Pixel centres are at integers from (0, 0), v downwards. The file does not say the unit of T.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from ...errors import DataError
from ..access import read_text
from ..documents import check_budget
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

ENDING = '_opencv.yaml'
MATRIX_NAMES = ('camera_matrix', 'Camera_Matrix', 'cameraMatrix', 'K')
DISTORTION_NAMES = ('distortion_coefficients', 'Distortion_Coefficients', 'distCoeffs', 'D')


def recognise(sample: Sample) -> bool:
    """Return whether the file has the first line of OpenCV's file storage."""
    if not sample.lines or not sample.lines[0].startswith('%YAML'):
        return False
    return any(line.split(':')[0] in MATRIX_NAMES for line in sample.lines)


def read(path: Path, settings: FileSettings) -> Content:
    """Read a camera, which is called like the file. Raises DataError."""
    text = read_text(path)
    check_budget('YAML', text, path)  # OpenCV crashes where it is nested deeply
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    except (cv2.error, SystemError):
        raise DataError(f'{path}: this is not a file of OpenCV, or it is damaged') from None
    try:
        return Content(cameras=(_camera(path, storage, settings),))
    except cv2.error:
        raise DataError(f'{path}: this file of OpenCV is damaged') from None
    finally:
        storage.release()


def _camera(path: Path, storage: cv2.FileStorage, settings: FileSettings) -> Camera:
    matrix = _matrix(path, storage, MATRIX_NAMES)
    if matrix is None or matrix.shape != (3, 3):
        raise DataError(f'{path}: there is no camera_matrix of 3 x 3 numbers')
    check_matrix(path, matrix)
    distortion = _matrix(path, storage, DISTORTION_NAMES)
    coefficients: tuple[float, ...] = ()
    if distortion is not None and distortion.any():
        coefficients = tuple(distortion.ravel().tolist())
    width = storage.getNode('image_width')
    height = storage.getNode('image_height')
    size = settings.image_size
    if not width.empty() and not height.empty():
        size = (int(width.real()), int(height.real()))
    name = name_of_file(path, ENDING)
    rotation = _matrix(path, storage, ('R',))
    translation = _matrix(path, storage, ('T', 't'))
    if rotation is None or translation is None:
        return Camera(name, matrix, size, distortion=coefficients)
    if rotation.shape != (3, 3):
        rotation, _ = cv2.Rodrigues(rotation)
    check_rotation(path, rotation)
    if translation.size != 3:
        raise DataError(f'{path}: T has {translation.size} numbers, not 3')
    mm = settings.unit_read(path)
    return Camera(
        name,
        matrix,
        image_size=size,
        rotation=rotation,
        translation_mm=from_units(translation.ravel(), mm),
        distortion=coefficients,
    )


def _matrix(path: Path, storage: cv2.FileStorage, names: tuple[str, ...]) -> np.ndarray | None:
    """Return the first of some matrices that is there. Raises DataError."""
    for name in names:
        node = storage.getNode(name)
        if node.empty():
            continue
        matrix = node.mat()
        if matrix is None or not np.isfinite(matrix).all():
            raise DataError(f'{path}: {name} is not a matrix of finite numbers')
        return np.asarray(matrix, dtype=float)
    return None


def write(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write a file <fluoroscope>_opencv.yaml for each camera into the folder path."""
    mm, notes = settings.unit_or('mm', str(path))
    paths = write_cameras(path, content.cameras, ENDING, lambda camera: _text(camera, mm))
    return Written(paths, notes if any(c.rotation is not None for c in content.cameras) else ())


def _text(camera: Camera, mm: float) -> str:
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


FORMAT = Format(
    'opencv',
    'OpenCV YAML',
    parts=('cameras',),
    recognise=recognise,
    read=read,
    write=write,
    looks_like='%YAML:1.0, camera_matrix',
    says_units=False,
)
