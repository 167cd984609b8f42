# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Points in space: files of XMALab, and TRC.

XMALab: `[Frame,]name_X,name_Y,name_Z,...`, one row a frame, NaN where not seen. The layout is that
of `Trial::save3dPoints` of XMALab 2.2.7. The unit is that of the calibration object, and the file
does not say it. Without the column Frame the first row is frame 1. A filtered export appends the
cut-off frequency to the names, which then belongs to them.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np

from ...errors import DataError
from ...exposures.names import Names, number_names
from ..access import atomic_file, read_text
from ..csv_table import as_text
from .content import (
    UNITS_MM,
    Content,
    FileSettings,
    Format,
    Sample,
    Written,
    from_units,
    in_units,
    points_without_precision,
)
from .tables import (
    Row,
    frame_numbers,
    frames_of,
    joined,
    labels,
    named_targets,
    number_text,
    points_of,
    read_frames,
    require_width,
    write_frames,
)

_COLUMN = re.compile(r'(?P<target>.+)_(?P<axis>[XYZ])', re.IGNORECASE)


def _is_xmalab3d(sample: Sample) -> bool:
    """Return whether the header has triples of columns of a marker."""
    cells = re.split(r'[,;\t]', sample.first)
    cells = cells[cells[0].strip().lower() == 'frame' :]
    return len(cells) >= 3 and all(
        cell.strip().upper().endswith(f'_{axis}') for cell, axis in zip(cells[:3], 'XYZ')
    )


def _read_xmalab3d(path: Path, settings: FileSettings) -> Content:
    """Read points in space. Raises DataError."""
    header, body, first = read_frames(path)
    targets = _targets(header, first)
    require_width(body, 3 * len(targets) + first, 'the header')
    mm = settings.unit_read(path)
    ids = number_names(targets, settings.names.targets)
    frame = frame_numbers(body, first)
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


def _write_xmalab3d(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write points in space, with the column Frame."""
    points = content.points
    assert points is not None
    mm, notes = settings.unit_or('mm', str(path))
    columns = [f'{as_text(name)}_{axis}' for name in labels(content) for axis in 'XYZ']
    write_frames(path, columns, points.frame, in_units(points.xyz_mm, mm))
    return Written((str(path),), notes)


XMALAB3D = Format(
    'xmalab3d',
    'XMALab 3-D points',
    parts=('points',),
    recognise=_is_xmalab3d,
    read=_read_xmalab3d,
    write=_write_xmalab3d,
    looks_like='Frame,bead01_X,bead01_Y,bead01_Z',
    says_units=False,
)


# TRC of Motion Analysis, as OpenSim reads it: points in space, at a constant rate.
#
# Header of five rows: PathFileType, names and values of DataRate, CameraRate, NumFrames,
# NumMarkers, Units, OrigDataRate, OrigDataStartFrame, OrigNumFrames; names of the markers; X1 Y1
# Z1 and so on. Then a row a frame: its number, time [s] and coordinates, between tabulators. Where
# a marker is not seen, OpenSim writes and reads NaN; other programs leave the cell empty, which is
# read, too. TRC has no residuals.

_HEADER_ROWS = 5
TAB = '\t'
_NAMES = (
    *('DataRate', 'CameraRate', 'NumFrames', 'NumMarkers'),
    *('Units', 'OrigDataRate', 'OrigDataStartFrame', 'OrigNumFrames'),
)


def _read_trc(path: Path, settings: FileSettings) -> Content:
    """Read points in space. Raises DataError that names the row."""
    lines = read_text(path).splitlines()
    if len(lines) < _HEADER_ROWS or not lines[0].startswith('PathFileType'):
        raise DataError(f'{path}: this is not a TRC file, it does not begin with PathFileType')
    header = dict(zip(lines[1].split(), lines[2].split()))
    for name in ('DataRate', 'NumMarkers', 'Units'):
        if name not in header:
            raise DataError(f'{path}, row 2: the header has no {name}')
    mm = UNITS_MM[settings.units] if settings.units else UNITS_MM.get(header['Units'].lower())
    if mm is None:
        raise DataError(f'{path}, row 3: the unit is {header["Units"]!r}, give it with --units')
    (rate,) = Row(path, 3, [header['DataRate']]).numbers()
    names = [cell.strip() for cell in lines[3].split('\t')[2:] if cell.strip()]
    count = Row(path, 3, [header['NumMarkers']]).whole(0, 'NumMarkers')
    if len(names) != count or len(set(names)) < count or not rate > 0:
        raise DataError(
            f'{path}, row 4: {len(set(names))} names of {count} markers at {rate:g} Hz'
        )
    frame = []
    xyz = []
    for number, line in enumerate(lines[_HEADER_ROWS:], _HEADER_ROWS + 1):
        if line.strip():
            row = Row(path, number, [cell.strip() for cell in line.split('\t')])
            frame.append(row.whole(0, 'Frame#'))
            xyz.append(_coordinates(row, count))
    if not frame:
        raise DataError(f'{path}: the file has no frames')
    ids = number_names(names, settings.names.targets)
    return Content(
        points=points_without_precision(
            np.array(frame),
            np.array([ids[name] for name in names], dtype=np.int64),
            from_units(np.array(xyz), mm),
            rate,
        ),
        names=Names(named_targets({name: ids[name] for name in names})),
    )


def _coordinates(row: Row, count: int) -> np.ndarray:
    """Return coordinates (count, 3), NaN where a marker is missing."""
    cells = row.cells[2:]
    while len(cells) > 3 * count and not cells[-1]:
        cells = cells[:-1]
    if len(cells) > 3 * count:
        row.fail(f'{len(cells)} coordinates, but there are {count} markers')
    values = Row(row.path, row.line, ['', '', *cells]).numbers_or_nan(2)
    xyz = np.array(values + [math.nan] * (3 * count - len(values))).reshape(count, 3)
    xyz[np.isnan(xyz).any(axis=1)] = np.nan
    return xyz


def _write_trc(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write points in space. Raises DataError."""
    assert content.points is not None
    points = points_of(content.points, frames_of(path, [content.points], settings))
    unit = settings.units or 'mm'
    names = labels(content)
    rate = number_text(points.rate_hz or math.nan)
    frames = str(len(points.frame))
    first = int(points.frame[0])
    values = [rate, rate, frames, str(len(names)), unit, rate, str(first), frames]
    axes = [f'{axis}{number}' for number in range(1, len(names) + 1) for axis in 'XYZ']
    with atomic_file(path, 'w') as file:
        file.write(f'PathFileType\t4\t(X/Y/Z)\t{path.name}\n')
        file.write('\t'.join(_NAMES) + '\n' + '\t'.join(values) + '\n')
        file.write('Frame#\tTime\t' + '\t\t\t'.join(names) + '\t\t\n')
        file.write('\t\t' + '\t'.join(axes) + '\n\n')
        for number, xyz in zip(points.frame.tolist(), in_units(points.xyz_mm, UNITS_MM[unit])):
            time = (number - first) / points.rate_hz
            file.write(f'{number}\t{time!r}\t{joined(xyz.ravel(), TAB)}\n')
    return Written((str(path),), (f'{path}: TRC has no residuals',))


TRC = Format(
    'trc',
    'TRC',
    parts=('points',),
    recognise=lambda sample: sample.first.startswith('PathFileType'),
    read=_read_trc,
    write=_write_trc,
    looks_like='PathFileType  4  (X/Y/Z)',
)
