# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""poses.csv of the command bodies, so that its poses go into the files of other programs."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...errors import DataError
from ...exposures.phantom import first_repeated
from ...photogrammetry.rotations import matrix_from_quaternion
from ..csv_table import read_blocks
from ..poses import COLUMNS as ALL_COLUMNS
from .content import Bodies, Content, FileSettings, Format, Sample
from .frames_of_points import NS, rate_of

COLUMNS = ALL_COLUMNS[:10]  # the poses without standard deviations, as the truth has them
NORM_TOLERANCE = 1e-6  # of a quaternion: rounding of nine digits is far below


def recognise(sample: Sample) -> bool:
    """Return whether the header is that of poses.csv."""
    return bool(sample.lines) and sample.lines[0].startswith(','.join(COLUMNS))


def read(path: Path, settings: FileSettings) -> Content:
    """Read the poses of bodies. Raises DataError that names the row."""
    blocks = list(read_blocks(path, COLUMNS))
    body = np.array([name for block in blocks for name in block.strings('body')])
    frame = np.concatenate([block.ids('exposure') for block in blocks])
    line = np.concatenate([block.lines for block in blocks])
    seconds, *columns = (
        np.concatenate([block.floats_or_nan(name) for block in blocks]) for name in COLUMNS[2:]
    )
    values = np.column_stack(columns)
    for block in blocks:
        for name in COLUMNS[3:]:
            block.require(name, ~np.isinf(block.floats_or_nan(name)), 'not a finite number')
    names = list(dict.fromkeys(body.tolist()))
    frames, row = np.unique(frame, return_inverse=True)
    column = np.array([names.index(name) for name in body.tolist()])
    repeated = first_repeated(row * len(names) + column)
    if repeated is not None:
        first, second = repeated
        raise DataError(
            f'{path}, row {line[second]}: exposure {frame[second]} of {body[second]} is already '
            f'given in row {line[first]}'
        )
    known = ~np.isnan(values).any(axis=1)
    wrong = known & ~(np.abs(np.linalg.norm(values[:, 3:], axis=1) - 1) < NORM_TOLERANCE)
    if wrong.any():
        raise DataError(
            f'{path}, row {line[np.argmax(wrong)]}: the quaternion does not have length one'
        )
    shape = (len(frames), len(names), 3)
    translation = np.full(shape, np.nan)
    rotation = np.full((*shape, 3), np.nan)
    at = row[known], column[known]
    translation[at] = values[known, :3]
    rotation[at] = matrix_from_quaternion(values[known][:, [6, 3, 4, 5]])
    rate = rate_of(frame, seconds * NS)
    return Content(bodies=Bodies(tuple(names), frames, rotation, translation, rate))


FORMAT = Format(
    'poses',
    'poses of bodies, poses.csv of the command bodies',
    parts=('bodies',),
    recognise=recognise,
    read=read,
    write=None,
    looks_like=','.join(COLUMNS),
)
