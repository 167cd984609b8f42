# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""3-D points: files of XMALab, C3D (c3d.org) and TRC.

C3D is read and written with ezc3d: points in mm, rotations, rate and names. The residual of a C3D
point has the unit of the points: it is the low byte of its fourth word times POINT:SCALE, and the
word is negative for a missing point (c3d.org, "The C3D File Format, User Guide"). It is written as
the standard deviation of the position, the root of the sum of its variances in x, y and z [mm]; 0
if unknown. C3D stores coordinates as float32, and residuals in 255 steps. Poses of bodies are the
4 x 4 matrices, body -> world, of the group ROTATION.

XMALab: `[Frame,]name_X,name_Y,name_Z,...`, one row a frame, NaN where not seen. The layout is that
of `Trial::save3dPoints` of XMALab 2.2.7. Coordinates have the unit of the calibration object,
which the file does not state. Without the column Frame the first row is frame 1. A filtered export
appends the cut-off frequency to the names; it is kept as part of them.
"""

from __future__ import annotations

import math
import os
import re
import struct
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import DataError
from ..access import atomic_file, read_bytes, read_text, write_bytes
from ..csv_table import as_text
from .content import (
    UNITS_MM,
    Bodies,
    Content,
    FileSettings,
    Format,
    Points,
    Sample,
    Written,
    from_units,
    homogeneous,
    in_units,
    points_without_precision,
    pose_parts,
)
from .reader_process import arrays_apart
from .tables import (
    Row,
    ascending_frames,
    at_all_frames,
    check_labels,
    frames_of,
    joined,
    labels,
    number_text,
    numbered_targets,
    read_frames,
    require_width,
    write_frames,
)

MAX_FRAME = 65535  # the header stores frame numbers as uint16
# Header from byte 2 on: points, analog values, first and last frame, scale factor, first block of
# the data.
_HEADER = struct.Struct('<4H2xfH')
BLOCK = 512  # bytes


def _ezc3d() -> Any:
    try:
        import ezc3d
    except ImportError:
        raise DataError(
            'C3D files need the package ezc3d, which is not installed: pip install ezc3d'
        ) from None
    return ezc3d


def read_c3d(path: Path, settings: FileSettings) -> Content:
    """Read 3-D points and poses of bodies. Raises DataError."""
    _check_size(path, read_bytes(path))
    _ezc3d()
    arrays = arrays_apart('c3d', path, 'C3D')
    if not arrays['xyz'].size and not arrays['rotations'].size:
        raise DataError(f'{path}: the file has no points')
    content = _points(path, arrays, settings) if arrays['xyz'].size else Content()
    if arrays['rotations'].size:
        content = replace(content, bodies=_bodies(path, arrays, settings))
    return content


def _points(path: Path, arrays: dict[str, np.ndarray], settings: FileSettings) -> Content:
    """Return the points of a file. Raises DataError."""
    names = arrays['labels'].tolist()
    xyz = arrays['xyz']
    residual = arrays['residual']
    mm = settings.unit_stated(f'{path}: the unit of the points', str(arrays['unit']))
    names = names[: xyz.shape[1]]
    if len(set(names)) < xyz.shape[1]:
        raise DataError(f'{path}: {xyz.shape[1]} points, but {len(set(names))} different names')
    target_id, content_names = numbered_targets(names, settings.names.targets)
    xyz = np.where((residual < 0)[..., None], np.nan, xyz * mm)
    xyz[np.isnan(xyz).any(axis=2)] = np.nan
    sd = np.where(residual > 0, residual * mm, np.nan)
    points = Points(
        int(arrays['first']) + np.arange(len(xyz)),
        target_id,
        xyz_mm=xyz,
        sd_mm=sd,
        residual_px=np.full(sd.shape, np.nan),
        rate_hz=float(arrays['rate']),
    )
    return Content(points=points, names=content_names)


def _bodies(path: Path, arrays: dict[str, np.ndarray], settings: FileSettings) -> Bodies:
    """Return the rotations of a file as bodies. Raises DataError."""
    matrices = arrays['rotations']
    names = arrays['rotation_labels'].tolist()[: matrices.shape[1]]
    if len(set(names)) < matrices.shape[1]:
        raise DataError(
            f'{path}: {matrices.shape[1]} rotations, but {len(set(names))} different names'
        )
    unit = str(arrays['rotation_unit'] or arrays['unit'])
    mm = settings.unit_stated(f'{path}: the unit of the points', unit)
    rotation, translation, is_invalid = pose_parts(matrices)
    first_frame = int(arrays['first'])
    if is_invalid.any():
        row, column = np.argwhere(is_invalid)[0]
        raise DataError(
            f'{path}, frame {first_frame + row}: the matrix of {names[column]} is not a rotation'
        )
    return Bodies(
        tuple(names),
        first_frame + np.arange(len(matrices)),
        rotation,
        translation * mm,
        rate_hz=float(arrays['rotation_rate']),
    )


def _check_size(path: Path, content: bytes) -> None:
    """Raise DataError for a file that is not C3D or is shorter than its header states.

    The header is that of c3d.org; it is evaluated only for the number format of Intel processors.
    """
    if content[1:2] != b'P':
        raise DataError(f'{path}: this is not a C3D file')
    if len(content) < BLOCK:
        raise DataError(f'{path}: this C3D file is truncated')
    start = (content[0] - 1) * BLOCK
    if content[start + 3 : start + 4] != bytes([84]):  # number format of Intel processors
        return
    points, analog, first, last, scale, data = _HEADER.unpack_from(content, 2)
    values = (last - first + 1) * (4 * points + analog)
    if last < MAX_FRAME and (data - 1) * BLOCK + values * (4 if scale < 0 else 2) > len(content):
        raise DataError(f'{path}: this C3D file is truncated, or its header is damaged')


def write_c3d(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write 3-D points and poses of bodies. Raises DataError."""
    frames = frames_of(path, [p for p in (content.points, content.bodies) if p], settings)
    last = frames.first + frames.count - 1
    if not 1 <= frames.first <= last <= MAX_FRAME:
        raise DataError(
            f'{path}: frames {frames.first} to {last}, but C3D counts from 1 to {MAX_FRAME}'
        )
    unit = settings.units or 'mm'
    file = _ezc3d().c3d()
    parameters = file['parameters']['POINT']
    parameters['UNITS']['value'] = [unit]
    parameters['RATE']['value'] = [frames.rate_hz]
    file['header']['points']['first_frame'] = frames.first - 1
    file['data']['points'] = np.zeros((4, 0, frames.count))
    if content.points is not None:
        parameters['LABELS']['value'] = labels(content)
        _add_points(file, at_all_frames(content.points, frames), UNITS_MM[unit])
    if content.bodies is not None:
        matrices = homogeneous(at_all_frames(content.bodies, frames), UNITS_MM[unit])
        file.add_parameter('ROTATION', 'LABELS', list(content.bodies.names))
        file.add_parameter('ROTATION', 'RATE', [frames.rate_hz])
        file.add_parameter('ROTATION', 'UNITS', [unit])
        file['data']['rotations'] = matrices.transpose(2, 3, 1, 0)
    write_bytes(path, _bytes_of(file, path))
    return Written((str(path),))


def _add_points(file: Any, points: Points, mm: float) -> None:
    """Add points of all frames to a file, in a unit of `mm` millimetres, with their residuals."""
    missing = np.asarray(np.isnan(points.xyz_mm).any(axis=2))
    xyz = np.where(missing[..., None], 0.0, points.xyz_mm / mm)
    homogeneous_xyz = np.concatenate([xyz, np.ones((*xyz.shape[:2], 1))], axis=2)
    sd = np.nan_to_num(points.sd_mm / mm)
    step = max(float(sd.max(initial=0.0)) / 255, 1e-6)
    file['parameters']['POINT']['SCALE']['value'] = [-step]
    file['data']['points'] = homogeneous_xyz.transpose(2, 1, 0)
    file['data']['meta_points']['residuals'] = np.where(missing, -1.0, sd).T[None]


def _bytes_of(file: Any, path: Path) -> bytes:
    """Return a C3D file as bytes; ezc3d writes only to files, and its exceptions have no type."""
    with TemporaryDirectory() as folder:
        temporary = Path(folder) / 'points.c3d'
        try:
            file.write(os.fspath(temporary))
            content = bytearray(temporary.read_bytes())
        except Exception as error:
            raise DataError(f'{path}: cannot be written ({error})') from None
    # ezc3d writes a scale of -1 into the header; readers such as py-c3d refuse a file in which it
    # differs from the parameter. ezc3d also writes residuals into the byte of the camera mask,
    # where large values have the sign of a missing point.
    (scale,) = file['parameters']['POINT']['SCALE']['value']
    struct.pack_into('<f', content, 12, scale)
    *_, data = _HEADER.unpack_from(content, 2)
    residual = file['data']['meta_points']['residuals'][0].T
    words = np.frombuffer(content, '<f4', 4 * residual.size, (data - 1) * BLOCK)
    words[3::4] = np.where(residual < 0, -1.0, np.round(residual / -scale)).ravel()
    return bytes(content)


C3D = Format(
    'c3d',
    'C3D',
    parts=('points', 'bodies'),
    recognise=lambda sample: sample.suffix == '.c3d' and sample.head[1:2] == b'P',
    read=read_c3d,
    write=write_c3d,
)


_COLUMN = re.compile(r'(?P<target>.+)_(?P<axis>[XYZ])', re.IGNORECASE)


def _is_xmalab3d(sample: Sample) -> bool:
    """Return whether the header begins with the three columns of a marker."""
    cells = re.split(r'[,;\t]', sample.first)
    cells = cells[cells[0].strip().lower() == 'frame' :]
    return len(cells) >= 3 and all(
        cell.strip().upper().endswith(f'_{axis}') for cell, axis in zip(cells[:3], 'XYZ')
    )


def _read_xmalab3d(path: Path, settings: FileSettings) -> Content:
    """Read 3-D points. Raises DataError."""
    header, rows, first_column = read_frames(path)
    targets = _targets(header, first_column)
    require_width(rows, 3 * len(targets) + first_column, 'the header')
    mm = settings.unit_read(path)
    target_id, content_names = numbered_targets(targets, settings.names.targets)
    frame = ascending_frames(rows, first_column)
    values = np.array([row.numbers_or_nan(first_column) for row in rows])
    xyz = from_units(values.reshape(len(rows), -1, 3), mm)
    xyz[np.isnan(xyz).any(axis=2)] = np.nan
    points = points_without_precision(frame, target_id, xyz, settings.rate_hz)
    return Content(points=points, names=content_names)


def _targets(row: Row, first: int) -> list[str]:
    """Return the names of the targets in a header. Raises DataError."""
    names = []
    for cell, axis in zip(row.cells[first:], 'XYZ' * len(row.cells)):
        match = _COLUMN.fullmatch(cell)
        if match is None or match['axis'].upper() != axis:
            row.fail(f'the column {cell!r} is not <name>_{axis}')
        names.append(match['target'])
    targets = names[::3]
    if len(names) % 3 or names != [name for name in targets for _ in 'XYZ']:
        row.fail('the columns are not triples <name>_X,<name>_Y,<name>_Z')
    for name in targets:
        if targets.count(name) > 1:
            row.fail(f'the target {name} is given twice')
    return targets


def _write_xmalab3d(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write 3-D points, with the column Frame."""
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
    says_units=False,
)


# TRC of Motion Analysis, as OpenSim reads it: 3-D points at a constant rate.
#
# The header has five rows: PathFileType; names and values of DataRate, CameraRate, NumFrames,
# NumMarkers, Units, OrigDataRate, OrigDataStartFrame, OrigNumFrames; names of the markers; X1 Y1
# Z1 and so on. Then follows one row a frame: its number, time [s] and coordinates, separated by
# tabulators. Where a marker is not seen, OpenSim writes and reads NaN; other programs leave the
# cell empty, which is read, too. TRC has no residuals.

_HEADER_ROWS = 5  # header rows of a TRC file
TAB = '\t'
_NAMES = (
    *('DataRate', 'CameraRate', 'NumFrames', 'NumMarkers'),
    *('Units', 'OrigDataRate', 'OrigDataStartFrame', 'OrigNumFrames'),
)


def _read_trc(path: Path, settings: FileSettings) -> Content:
    """Read 3-D points. Raises DataError that names the row."""
    lines = read_text(path).splitlines()
    if len(lines) < _HEADER_ROWS or not lines[0].startswith('PathFileType'):
        raise DataError(f'{path}: this is not a TRC file, it does not begin with PathFileType')
    header = dict(zip(lines[1].split(), lines[2].split()))
    for name in ('DataRate', 'NumMarkers', 'Units'):
        if name not in header:
            raise DataError(f'{path}, row 2: the header has no {name}')
    mm = settings.unit_stated(f'{path}, row 3: the unit', header['Units'].lower())
    (rate,) = Row(path, 3, [header['DataRate']]).numbers()
    names = [cell.strip() for cell in lines[3].split('\t')[2:] if cell.strip()]
    count = Row(path, 3, [header['NumMarkers']]).whole(0, 'NumMarkers')
    if len(names) != count or len(set(names)) < count or not rate > 0:
        raise DataError(
            f'{path}, row 4: {len(set(names))} names of {count} markers at {rate:g} Hz'
        )
    rows = [
        Row(path, number, [cell.strip() for cell in line.split('\t')])
        for number, line in enumerate(lines[_HEADER_ROWS:], _HEADER_ROWS + 1)
        if line.strip()
    ]
    if not rows:
        raise DataError(f'{path}: the file has no frames')
    stated = header.get('NumFrames', str(len(rows)))
    target_id, content_names = numbered_targets(names, settings.names.targets)
    xyz_mm = from_units(np.array([_coordinates(row, count) for row in rows]), mm)
    return Content(
        points=points_without_precision(ascending_frames(rows, 1), target_id, xyz_mm, rate),
        names=content_names,
        notes=(f'{path}: the header states {stated} frames, the file has {len(rows)}',)
        if Row(path, 3, [stated]).whole(0, 'NumFrames') != len(rows)
        else (),
    )


def _coordinates(row: Row, count: int) -> NDArray[np.float64]:
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
    """Write 3-D points. Raises DataError."""
    assert content.points is not None
    points = at_all_frames(content.points, frames_of(path, [content.points], settings))
    unit = settings.units or 'mm'
    names = labels(content)
    check_labels(path, names, '\t')
    rate = number_text(points.rate_hz or math.nan)
    frames = str(len(points.frame))
    first_frame = int(points.frame[0])
    values = [rate, rate, frames, str(len(names)), unit, rate, str(first_frame), frames]
    axes = [f'{axis}{number}' for number in range(1, len(names) + 1) for axis in 'XYZ']
    with atomic_file(path, 'w') as file:
        file.write(f'PathFileType\t4\t(X/Y/Z)\t{path.name}\n')
        file.write('\t'.join(_NAMES) + '\n' + '\t'.join(values) + '\n')
        file.write('Frame#\tTime\t' + '\t\t\t'.join(names) + '\t\t\n')
        file.write('\t\t' + '\t'.join(axes) + '\n\n')
        for number, xyz in zip(points.frame.tolist(), in_units(points.xyz_mm, UNITS_MM[unit])):
            time = (number - first_frame) / points.rate_hz
            file.write(f'{number}\t{time!r}\t{joined(xyz.ravel(), TAB)}\n')
    return Written((str(path),), (f'{path}: TRC has no residuals',))


TRC = Format(
    'trc',
    'TRC',
    parts=('points',),
    recognise=lambda sample: sample.first.startswith('PathFileType'),
    read=_read_trc,
    write=_write_trc,
)
