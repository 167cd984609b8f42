# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the formats of cameras have in common: one file a fluoroscope, in a folder."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from ...errors import DataError
from ..access import PathLike, check_safe_name, make_folder
from ..atomic import write_text
from .content import Camera

ROTATION_TOLERANCE = 1e-5  # of rotations that other programs rounded to six digits


def write_cameras(
    folder: Path, cameras: Sequence[Camera], ending: str, text_of: Callable[[Camera], str]
) -> tuple[str, ...]:
    """Write a file <camera><ending> for each camera into a folder, after all texts are made.

    Returns the paths. Raises DataError.
    """
    texts = {}
    for camera in cameras:
        check_safe_name(camera.name, folder)
        texts[os.path.join(folder, camera.name + ending)] = text_of(camera)
    make_folder(folder)
    for path, text in texts.items():
        write_text(path, text)
    return tuple(texts)


def name_of_file(path: Path, ending: str) -> str:
    """Return the name of the camera that a file is of: the file's without its ending."""
    return path.name[: -len(ending)] if path.name.endswith(ending) else path.stem


def check_rotation(where: object, rotation: np.ndarray) -> None:
    """Raise DataError for a matrix (3, 3) that is not a rotation."""
    error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if not error <= ROTATION_TOLERANCE:
        raise DataError(f'{where}: the matrix is not a rotation, its rows are not orthonormal')
    if np.linalg.det(rotation) < 0:
        raise DataError(f'{where}: the matrix is not a rotation, it mirrors')


def check_matrix(where: object, matrix: np.ndarray) -> None:
    """Raise DataError for a matrix (3, 3) that is not a camera matrix."""
    if not (matrix[0, 0] > 0 and matrix[1, 1] > 0):
        raise DataError(f'{where}: the focal lengths in the camera matrix are not above 0')
    if np.abs(matrix[2] - [0, 0, 1]).max() > 0 or matrix[1, 0]:
        raise DataError(f'{where}: this is not a camera matrix, its last row must be 0,0,1')


def refuse_distortion(path: PathLike, camera: Camera, title: str) -> None:
    """Raise DataError for a camera with distortion, for a format that cannot hold it."""
    if camera.is_distorted:
        raise DataError(
            f'{path}: camera {camera.name} has a distortion, which {title} cannot contain'
        )


def common_focal_length(path: PathLike, camera: Camera, title: str) -> float:
    """Return the principal distance of a camera with square pixels. Raises DataError."""
    fx = float(camera.matrix[0, 0])
    fy = float(camera.matrix[1, 1])
    if camera.matrix[0, 1] or abs(fx - fy) > 1e-9 * fx:
        raise DataError(
            f'{path}: camera {camera.name} has pixels that are not square (fx {fx:g}, fy {fy:g}), '
            f'which {title} cannot contain'
        )
    return fx
