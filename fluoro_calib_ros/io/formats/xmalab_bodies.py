# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Rigid body transformations of XMALab: 16 columns a body, one row a frame, NaN without pose.

The layout is that of `Trial::saveRigidBodyTransformations` of XMALab 2.2.7: the 4 x 4 matrix that
takes points of the body (a bone's model) to the world, column after column (r11, r21, r31, 0, r12,
and so on, t1, t2, t3, 1), which Maya reads as rows. XMALab calls its columns R11, R12, R13, 01,
R21, and so on, TX, TY, TZ, 1; the column Frame need not be there. The unit is that of the
calibration object, and the file does not say it.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ...errors import DataError
from ..access import atomic_file
from ..csv_table import as_text
from .content import (
    Bodies,
    Content,
    FileSettings,
    Format,
    Sample,
    Written,
    from_units,
    homogeneous,
)
from .text import Row, joined, read_table, require_width

COLUMNS = (
    *('R11', 'R12', 'R13', '01', 'R21', 'R22', 'R23', '02', 'R31', 'R32', 'R33', '03'),
    *('TX', 'TY', 'TZ', '1'),
)
_FIRST = re.compile(r'(?P<body>.+)_R11(?P<filter>_[\d.]+Hz)?')
ROTATION_TOLERANCE = 1e-6  # rounding of 12 digits is far below
LAST_TOLERANCE = 1e-9


def recognise(sample: Sample) -> bool:
    """Return whether the header names the elements of a matrix."""
    return bool(sample.lines) and '_R11' in sample.lines[0] and '_TX' in sample.lines[0]


def read(path: Path, settings: FileSettings) -> Content:
    """Read the poses of rigid bodies. Raises DataError."""
    rows = read_table(path)
    header = rows[0].cells
    first = int(header[0].lower() == 'frame')
    names = _bodies(rows[0], first)
    body = rows[1:]
    if not body:
        raise DataError(f'{path}: the file has a header, but no rows')
    require_width(body, len(header), 'the header')
    mm = settings.unit_read(path)
    frame = [row.whole(0, 'Frame') if first else number for number, row in enumerate(body, 1)]
    values = np.array([row.numbers_or_nan(first) for row in body])
    matrices = values.reshape(len(body), len(names), 4, 4).transpose(0, 1, 3, 2)
    for row, of_row in zip(body, matrices):
        _check(row, of_row, names)
    missing = np.isnan(matrices).any(axis=(2, 3))
    rotation = matrices[..., :3, :3].copy()
    translation = from_units(matrices[..., :3, 3], mm)
    rotation[missing] = np.nan
    translation[missing] = np.nan
    return Content(bodies=Bodies(tuple(names), np.array(frame), rotation, translation))


def _bodies(row: Row, first: int) -> list[str]:
    """Return the names of the bodies of a header. Raises DataError."""
    cells = row.cells[first:]
    if len(cells) % len(COLUMNS):
        row.fail(f'{len(cells)} columns, but a rigid body has {len(COLUMNS)}')
    names = []
    for start in range(0, len(cells), len(COLUMNS)):
        match = _FIRST.fullmatch(cells[start])
        if match is None:
            row.fail(f'the column {cells[start]!r} is not <body>_R11')
        expected = [f'{match["body"]}_{column}{match["filter"] or ""}' for column in COLUMNS]
        given = cells[start : start + len(COLUMNS)]
        for cell, name in zip(given, expected):
            if cell != name:
                row.fail(f'the column {cell!r} should be {name!r}')
        names.append(match['body'] + (match['filter'] or ''))
    return names


def _check(row: Row, matrices: np.ndarray, names: list[str]) -> None:
    """Raise DataError for a matrix (4, 4) that is not a pose."""
    for name, matrix in zip(names, matrices):
        if np.isnan(matrix).any():
            continue
        turn = matrix[:3, :3]
        error = np.abs(turn @ turn.T - np.eye(3)).max()
        if error > ROTATION_TOLERANCE or np.linalg.det(turn) < 0:
            row.fail(f'the matrix of {name} is not a rotation')
        if np.abs(matrix[3] - [0, 0, 0, 1]).max() > LAST_TOLERANCE:
            row.fail(f'the columns 01, 02, 03 and 1 of {name} are not 0, 0, 0 and 1')


def write(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write the poses of rigid bodies, with header and column Frame."""
    bodies = content.bodies
    assert bodies is not None
    mm, notes = settings.unit_or('mm', str(path))
    matrices = homogeneous(bodies, mm)
    header = [
        'Frame',
        *(f'{as_text(name)}_{column}' for name in bodies.names for column in COLUMNS),
    ]
    with atomic_file(path, 'w') as file:
        file.write(','.join(header) + '\n')
        for number, of_frame in zip(bodies.frame.tolist(), matrices):
            file.write(f'{number},{joined(of_frame.transpose(0, 2, 1).ravel())}\n')
    return Written((str(path),), notes)


FORMAT = Format(
    'rigidbody',
    'XMALab rigid body transformations',
    parts=('bodies',),
    recognise=recognise,
    read=read,
    write=write,
    looks_like='Frame,femur_R11,femur_R12,...,femur_TX,femur_TY,femur_TZ,femur_1',
    says_units=False,
)
