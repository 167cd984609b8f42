# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""XMALab 3-D points: `[Frame,]name_X,name_Y,name_Z,...`, one row a frame, NaN where not seen.

The layout is that of `Trial::save3dPoints` of XMALab 2.2.7. The unit is that of the calibration
object, and the file does not say it. Without the column Frame the first row is frame 1. A filtered
export appends the cut-off frequency to the names, which then belongs to them.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ...errors import DataError
from ...exposures.names import Names, number_names
from ..access import atomic_file
from ..csv_table import as_text
from .content import (
    Content,
    FileSettings,
    Format,
    Sample,
    Written,
    from_units,
    in_units,
    points_without_precision,
)
from .frames_of_points import default_name, named_targets
from .text import Row, joined, read_table, require_width

_COLUMN = re.compile(r'(?P<target>.+)_(?P<axis>[XYZ])', re.IGNORECASE)


def recognise(sample: Sample) -> bool:
    """Return whether the header has triples of columns of a marker."""
    if not sample.lines:
        return False
    cells = re.split(r'[,;\t]', sample.lines[0])
    cells = cells[cells[0].strip().lower() == 'frame' :]
    return len(cells) >= 3 and all(
        cell.strip().upper().endswith(f'_{axis}') for cell, axis in zip(cells[:3], 'XYZ')
    )


def read(path: Path, settings: FileSettings) -> Content:
    """Read points in space. Raises DataError."""
    rows = read_table(path)
    first = int(rows[0].cells[0].lower() == 'frame')
    targets = _targets(rows[0], first)
    body = rows[1:]
    if not body:
        raise DataError(f'{path}: the file has a header, but no rows')
    require_width(body, 3 * len(targets) + first, 'the header')
    mm = settings.unit_read(path)
    ids = number_names(targets, settings.names.targets)
    frame = [row.whole(0, 'Frame') if first else number for number, row in enumerate(body, 1)]
    for before, row, number in zip(frame, body[1:], frame[1:]):
        if number <= before:
            row.fail(f'frame {number} comes after frame {before}')
    values = np.array([row.numbers_or_nan(first) for row in body])
    xyz = from_units(values.reshape(len(body), -1, 3), mm)
    xyz[np.isnan(xyz).any(axis=2)] = np.nan
    target_id = np.array([ids[name] for name in targets], dtype=np.int64)
    points = points_without_precision(np.array(frame), target_id, xyz, settings.rate_hz)
    named = Names(named_targets({name: ids[name] for name in targets}))
    return Content(points=points, names=named)


def _targets(row: Row, first: int) -> list[str]:
    """Return the names of the targets of a header. Raises DataError."""
    found = []
    for cell, axis in zip(row.cells[first:], 'XYZ' * len(row.cells)):
        match = _COLUMN.fullmatch(cell)
        if match is None or match['axis'].upper() != axis:
            row.fail(f'the column {cell!r} is not <name>_{axis}')
        found.append(match['target'])
    targets = found[::3]
    if len(found) % 3 or found != [name for name in targets for _ in 'XYZ']:
        row.fail('the columns are not triples <name>_X,<name>_Y,<name>_Z')
    for name in targets:
        if targets.count(name) > 1:
            row.fail(f'the target {name} is given twice')
    return targets


def write(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write points in space, with the column Frame."""
    points = content.points
    assert points is not None
    mm, notes = settings.unit_or('mm', str(path))
    named = content.names.target_names()
    labels = [named.get(i, default_name(i)) for i in points.target_id.tolist()]
    header = ['Frame', *(f'{as_text(name)}_{axis}' for name in labels for axis in 'XYZ')]
    with atomic_file(path, 'w') as file:
        file.write(','.join(header) + '\n')
        for number, xyz in zip(points.frame.tolist(), in_units(points.xyz_mm, mm)):
            file.write(f'{number},{joined(xyz.ravel())}\n')
    return Written((str(path),), notes)


FORMAT = Format(
    'xmalab3d',
    'XMALab 3-D points',
    parts=('points',),
    recognise=recognise,
    read=read,
    write=write,
    looks_like='Frame,bead01_X,bead01_Y,bead01_Z',
    says_units=False,
)
