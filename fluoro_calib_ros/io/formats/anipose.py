# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Anipose calibration.toml: a table [cam_0], [cam_1], ... a camera, with rotation vectors.

The layout is that of `CameraGroup.dump` of aniposelib: name, size (width, height), matrix,
distortions (OpenCV), rotation (Rodrigues vector) and translation of X = R P + t, metadata. Pixels
are those of OpenCV. The unit is that of the calibration board, and the file does not say it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import DataError
from ...photogrammetry.rotations import matrix_from_vector, vector_from_matrix
from ..access import PathLike, write_text
from ..documents import read_toml
from .content import (
    Camera,
    Content,
    FileSettings,
    Format,
    Sample,
    Written,
    check_matrix,
    from_units,
    in_units,
)


def recognise(sample: Sample) -> bool:
    """Return whether the file is TOML with tables of cameras."""
    if sample.suffix != '.toml':
        return False
    return any(line.startswith('[') for line in sample.lines)


def read(path: Path, settings: FileSettings) -> Content:
    """Read the cameras. Raises DataError."""
    document = read_toml(path)
    tables = {key: document[key] for key in sorted(document) if key != 'metadata'}
    if not tables or not all(isinstance(t, Mapping) and 'matrix' in t for t in tables.values()):
        raise DataError(
            f'{path}: this is not a calibration of Anipose, it has no tables [cam_0], [cam_1] '
            'with a matrix'
        )
    mm = settings.unit_read(path)
    cameras = tuple(_camera(f'{path}, [{key}]', table, mm) for key, table in tables.items())
    return Content(cameras=cameras)


def _camera(where: str, table: Mapping[str, Any], mm: float) -> Camera:
    if table.get('fisheye'):
        raise DataError(f'{where}: fisheye cameras are not supported')
    matrix = numbers_of(where, table, 'matrix', (3, 3))
    check_matrix(where, matrix)
    size = numbers_of(where, table, 'size', (2,))
    distortion = numbers_of(where, table, 'distortions', None).ravel()
    return Camera(
        str(table.get('name', where)),
        matrix,
        image_size=(int(size[0]), int(size[1])),
        rotation=matrix_from_vector(numbers_of(where, table, 'rotation', (3,))),
        translation_mm=from_units(numbers_of(where, table, 'translation', (3,)), mm),
        distortion=tuple(distortion.tolist()) if distortion.any() else (),
    )


def numbers_of(
    where: object, table: Mapping[str, Any], key: str, shape: tuple[int, ...] | None
) -> np.ndarray:
    """Return an entry of a document as an array of finite numbers. Raises DataError."""
    try:
        value = np.array(table[key], dtype=float)
    except KeyError:
        raise DataError(f'{where}: there is no {key}') from None
    except (TypeError, ValueError, OverflowError):
        raise DataError(f'{where}: {key} does not consist of numbers') from None
    if shape is not None and value.shape != shape:
        raise DataError(f'{where}: {key} has {value.shape} numbers, not {shape}')
    if not np.isfinite(value).all():
        raise DataError(f'{where}: {key} has a number that is not finite')
    return value


def write(path: Path, content: Content, settings: FileSettings) -> Written:
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


FORMAT = Format(
    'anipose',
    'Anipose calibration',
    parts=('cameras',),
    recognise=recognise,
    read=read,
    write=write,
    looks_like='[cam_0] with a matrix',
    says_units=False,
)
