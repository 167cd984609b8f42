# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""XMALab 2-D points: `name_cam1_X,name_cam1_Y,name_cam2_X,...`, one row a frame.

The layout is that of `Trial::save2dPoints` and `load2dPoints` of XMALab 2.2.7: pixel centres at
integers from (0, 0), v downwards, NaN where a marker is not seen. Variants are chosen in its
dialogue and not visible in the file: pixels counted from 1 (one_based), rows counted upwards
(y_up). DLTdv names the points pt1, pt2, ... and counts from 1, before version 8 upwards. Argus
writes `name_cam_1_x` and counts upwards. A further variant begins with the columns cam<n>_offset;
XMALab writes their header without the separating commas. The exposure is the row number, counted
from 1, unless there is a column Frame.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...exposures.frame import Frame, points_on_image
from ..access import atomic_file
from ..csv_table import as_text
from .content import Content, FileSettings, Format, Written
from .tables import (
    Row,
    check_labels,
    check_row_count,
    default_name,
    frame_numbers,
    frame_of,
    joined,
    numbered_targets,
    read_frames,
    require_width,
)

COLUMN = re.compile(r'(?P<target>.+)_cam_?(?P<camera>\d+)_(?P<axis>[XY])', re.IGNORECASE)
_OFFSET = re.compile(r'cam\d+_offset', re.IGNORECASE)


def read(path: Path, settings: FileSettings) -> Content:
    """Read image points. Raises DataError."""
    top, rows, first_column = read_frames(path)
    header, offsets = _header(top, first_column)
    require_width(rows, len(header) + offsets + first_column, 'the header')
    cameras = sorted({camera for _, camera in header})
    column_id, names = numbered_targets([name for name, _ in header[::2]], settings.names.targets)
    labels = _labels(cameras, settings)
    frames: dict[str, list[Frame]] = {labels[camera]: [] for camera in cameras}
    column_camera = np.array([camera for _, camera in header[::2]])
    sizes = {camera: settings.image_size_of(path, labels[camera]) for camera in cameras}
    column_size = np.array([sizes[camera] for camera in column_camera.tolist()])
    for number, row in zip(frame_numbers(rows, first_column), rows):
        _check_offsets(row, first_column, offsets)
        uv = _pixels(row.numbers_or_nan(first_column + offsets), settings, column_size)
        _check_point(row, uv, column_size, header)
        for camera in cameras:
            used = (column_camera == camera) & ~np.isnan(uv).any(axis=1)
            if used.any():
                name = labels[camera]
                points = (column_id[used], uv[used])
                frames[name].append(frame_of(row.place, name, number, *points, sizes[camera]))
    return Content(
        observations={name: view_frames for name, view_frames in frames.items() if view_frames},
        names=names,
        notes=_origin_notes(path, top, settings),
    )


def _origin_notes(path: Path, header: Row, settings: FileSettings) -> tuple[str, ...]:
    """Return advice about the pixel origin if the column names suggest another program."""
    if settings.one_based or settings.y_up:
        return ()
    last_column = header.cells[-1]
    if re.fullmatch(r'pt\d+_cam\d+_Y', last_column):
        return (f'{path}: for files of DLTdv8 add --one-based, of DLTdv5 to 7 --one-based --y-up',)
    return (
        (f'{path}: for files of Argus add --y-up',)
        if re.search(r'_cam_\d+_y$', last_column)
        else ()
    )


def _header(row: Row, first: int) -> tuple[list[tuple[str, int]], int]:
    """Return target and camera of every column of points, and the number of offset columns.

    Raises DataError unless columns come in pairs of X and Y, each pair once.
    """
    cells = row.cells[first:]
    offsets = 0
    while cells and _OFFSET.match(cells[0]):  # XMALab omits the commas between them
        offsets += 1
        remainder = cells[0][_OFFSET.match(cells[0]).end() :]  # type: ignore[union-attr]
        cells = ([remainder] if remainder else []) + cells[1:]
    matches = [COLUMN.fullmatch(cell) for cell in cells]
    for cell, match in zip(cells, matches):
        if match is None:
            row.fail(f'the column {cell!r} is not <name>_cam<number>_X or _Y')
    columns = [
        (m['target'], int(m['camera']), m['axis'].upper()) for m in matches if m is not None
    ]
    for x, y in zip(columns[::2], [*columns[1::2], ('', 0, '')]):
        if x[:2] != y[:2] or (x[2], y[2]) != ('X', 'Y'):
            row.fail(f'the column {x[0]}_cam{x[1]}_X is not followed by {x[0]}_cam{x[1]}_Y')
    pairs = [column[:2] for column in columns]
    for pair in pairs[::2]:
        if pairs.count(pair) > 2:
            row.fail(f'{pair[0]}_cam{pair[1]} is given twice')
    return pairs, offsets


def _labels(cameras: Sequence[int], settings: FileSettings) -> dict[int, str]:
    """Return the fluoroscope of each numbered camera."""
    fluoroscopes = settings.fluoroscopes
    camera_names = {camera: f'cam{camera}' for camera in cameras}
    if len(fluoroscopes) == len(cameras) and not set(fluoroscopes) & set(camera_names.values()):
        return dict(zip(cameras, fluoroscopes))
    known_names = settings.names.fluoroscopes
    return {camera: known_names.get(name, name) for camera, name in camera_names.items()}


def _check_offsets(row: Row, first: int, offsets: int) -> None:
    """Raise DataError for cameras with a time offset, which DLTdv allows."""
    if offsets and any(Row(row.path, row.line, row.cells[first : first + offsets]).numbers()):
        row.fail('the cameras are offset against each other in time: export them without offset')


def _pixels(
    values: Sequence[float], settings: FileSettings, size: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Convert to our pixels (n, 2), NaN where either coordinate is missing.

    size: (n, 2), width and height of the image of each point [px].
    """
    uv = np.array(values).reshape(-1, 2)
    if settings.one_based:
        uv = uv - 1.0
    if settings.y_up:
        uv[:, 1] = size[:, 1] - 1 - uv[:, 1]
    uv[np.isnan(uv).any(axis=1)] = np.nan
    return uv


def _check_point(
    row: Row, uv: NDArray[np.float64], size: NDArray[np.int64], header: Sequence[tuple[str, int]]
) -> None:
    """Raise DataError for a point off the image."""
    is_off_image = ~points_on_image(uv, size) & ~np.isnan(uv).any(axis=1)
    if is_off_image.any():
        index = int(np.argmax(is_off_image))
        target, camera = header[2 * index]
        row.fail(
            f'the point ({uv[index, 0]:g}, {uv[index, 1]:g}) of {target} in cam{camera} is '
            f'outside the image of {size[index, 0]} x {size[index, 1]} px'
        )


def write(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write image points: one column pair a target and camera, one row an exposure, from 1 on."""
    observations = content.observations or {}
    cameras = camera_order(list(observations))
    target_names = content.names.target_names()
    frames = {name: {f.number: f for f in observations[name]} for name in cameras}
    numbers = sorted({number for view_frames in frames.values() for number in view_frames})
    ids = sorted(
        {
            int(i)
            for view_frames in frames.values()
            for f in view_frames.values()
            for i in f.target_id
        }
    )
    labels = [target_names.get(i, default_name(i)) for i in ids]
    shift = int(numbers[0] == 0)
    check_row_count(path, numbers[-1], shift)
    check_labels(path, labels, ',;\t')
    with atomic_file(path, 'w') as file:
        file.write(
            ','.join(
                f'{as_text(name)}_cam{camera}_{axis}'
                for name in labels
                for camera in range(1, len(cameras) + 1)
                for axis in 'XY'
            )
            + '\n'
        )
        for number in range(1 - shift, numbers[-1] + 1):
            table = np.full((len(ids), len(cameras), 2), np.nan)
            for column, name in enumerate(cameras):
                if number in frames[name]:
                    frame = frames[name][number]
                    table[np.searchsorted(ids, frame.target_id), column] = _file_pixels(
                        frame, settings
                    )
            file.write(joined(table.ravel()) + '\n')
    notes = [f'cam{i} is fluoroscope {name}' for i, name in enumerate(cameras, 1)]
    notes = [] if [f'cam{i}' for i in range(1, len(cameras) + 1)] == cameras else notes
    if shift:
        notes.append('exposure 0 is row 1, exposure 1 is row 2 and so on')
    return Written((str(path),), tuple(notes))


def _file_pixels(frame: Frame, settings: FileSettings) -> NDArray[np.float64]:
    """Convert the image points of a frame to pixels (n, 2) in the convention of the file."""
    uv = np.array(frame.uv, dtype=float)
    if settings.y_up:
        uv[:, 1] = frame.image_size[1] - 1 - uv[:, 1]
    return uv + 1.0 if settings.one_based else uv


def camera_order(names: Sequence[str]) -> list[str]:
    """Return fluoroscopes sorted by the number in their names; unsorted if not all have one."""
    matches = [re.fullmatch(r'\D*(\d+)', name) for name in names]
    numbers = [int(match[1]) for match in matches if match is not None]
    if len(numbers) < len(names) or len(set(numbers)) < len(numbers):
        return list(names)
    return [name for _, name in sorted(zip(numbers, names))]


FORMAT = Format(
    'xmalab2d',
    'XMALab 2-D points',
    parts=('observations',),
    recognise=lambda sample: re.search(r'_cam_?\d+_[XY]\b', sample.first, re.I) is not None,
    read=read,
    write=write,
)
