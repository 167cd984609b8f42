# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""poses.csv of the command bodies, so that its poses go into the files of other programs."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...errors import DataError
from ...photogrammetry.rotations import matrix_from_quaternion
from ..csv_table import read_blocks
from ..poses import COLUMNS
from .content import Bodies, Content, FileSettings, Format, Sample

POSITION = ('x_mm', 'y_mm', 'z_mm')
QUATERNION = ('qw', 'qx', 'qy', 'qz')
NORM_TOLERANCE = 1e-6


def recognise(sample: Sample) -> bool:
    """Return whether the header is that of poses.csv."""
    return bool(sample.lines) and sample.lines[0].startswith('body,exposure,time_s,x_mm')


def read(path: Path, settings: FileSettings) -> Content:
    """Read the poses of bodies. Raises DataError."""
    cells: list[tuple[str, int, tuple[float, ...]]] = []
    for block in read_blocks(path, COLUMNS):
        numbers = [block.floats_or_nan(name).tolist() for name in (*POSITION, *QUATERNION)]
        cells += zip(block.strings('body'), block.ids('exposure').tolist(), zip(*numbers))
    names = list(dict.fromkeys(body for body, _, _ in cells))
    frame = np.unique([number for _, number, _ in cells])
    values = np.full((len(frame), len(names), 7), np.nan)
    for body, number, numbers_of in cells:
        values[np.searchsorted(frame, number), names.index(body)] = numbers_of
    known = np.isfinite(values).all(axis=2)
    norm = np.linalg.norm(values[..., 3:], axis=2)
    wrong = known & (np.abs(norm - 1) > NORM_TOLERANCE)
    if wrong.any():
        row, column = np.argwhere(wrong)[0]
        raise DataError(
            f'{path}: the quaternion of body {names[column]} in exposure {frame[row]} has a norm '
            f'of {norm[row, column]:g}, not 1'
        )
    rotation = np.full((*known.shape, 3, 3), np.nan)
    rotation[known] = matrix_from_quaternion(values[known][:, 3:])
    place = np.where(known[..., None], values[..., :3], np.nan)
    return Content(bodies=Bodies(tuple(names), frame, rotation, place))


FORMAT = Format(
    'poses',
    'poses of bodies, poses.csv of the command bodies',
    parts=('bodies',),
    recognise=recognise,
    read=read,
    write=None,
    looks_like='body,exposure,time_s,x_mm,y_mm,z_mm,qx,qy,qz,qw,...',
)
