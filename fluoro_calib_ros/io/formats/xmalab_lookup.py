# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""XMALab's undistortion lookup table: H rows of the map's columns, then H rows of its rows.

The layout is that of `UndistortionObject::exportData` of XMALab 2.2.7: for every pixel of the
corrected image the column, and then the row, of the observed image that is seen there, as float32;
pixel centres at integers from (0, 0), v downwards, -1 without support. It is what cv2.remap takes.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from ...errors import DataError
from ...limits import MAX_IMAGE_SIDE
from ..access import atomic_file, check_rows, check_safe_name, make_folder, read_text
from .content import Content, FileSettings, Format, Sample, Written, name_of_file
from .text import Row, separator_of

ENDING = '_LUT.csv'
NOWHERE = -1.0
_MIN_COLUMNS = 32  # narrower tables are something else


def recognise(sample: Sample) -> bool:
    """Return whether the first row has as many numbers as an image has columns."""
    cells = sample.first.split(',')[:_MIN_COLUMNS]
    try:
        return len([float(cell) for cell in cells]) == _MIN_COLUMNS
    except ValueError:
        return False


def read(path: Path, settings: FileSettings) -> Content:
    """Read a table, of a fluoroscope that is called like the file. Raises DataError."""
    text = read_text(path)
    check_rows(text, 2 * MAX_IMAGE_SIDE, path)
    lines = [(n, line) for n, line in enumerate(text.splitlines(), 1) if line.strip()]
    if not lines:
        raise DataError(f'{path}: the file has no rows')
    separator = separator_of(text)
    if separator == ';':
        lines = [(n, line.replace(',', '.')) for n, line in lines]
    first = np.array(_numbers(path, *lines[0], separator), dtype=np.float32)
    if len(lines) % 2 or len(lines) < 2:
        raise DataError(
            f'{path}: {len(lines)} rows, but a lookup table has as many for the rows as for the '
            'columns of the map'
        )
    table = np.empty((len(lines), len(first)), dtype=np.float32)
    for index, (number, line) in enumerate(lines):
        values = _numbers(path, number, line, separator)
        if len(values) != len(first):
            raise DataError(
                f'{path}, row {number}: {len(values)} columns, but the first row has {len(first)}'
            )
        table[index] = values
    maps = table.reshape(2, -1, len(first))
    size = (maps.shape[2], maps.shape[1])
    if settings.image_size not in (None, size):
        raise DataError(
            f'{path}: the table is for an image of {size[0]} x {size[1]} px, not of '
            f'{settings.image_size[0]} x {settings.image_size[1]} px'
        )
    maps[:, (maps == NOWHERE).any(axis=0)] = np.nan
    return Content(lookups={name_of_file(path, ENDING): maps})


def _numbers(path: Path, number: int, line: str, separator: str) -> list[float]:
    cells = line.split(separator)
    try:
        return list(map(float, cells))
    except ValueError:
        return Row(path, number, [cell.strip() for cell in cells]).numbers()


def write(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write a file <fluoroscope>_LUT.csv for each fluoroscope into the folder path."""
    for name in content.lookups:
        check_safe_name(name, path)
    make_folder(path)
    paths = []
    for name, maps in content.lookups.items():
        paths.append(os.path.join(path, name + ENDING))
        table = np.where(np.isnan(maps).any(axis=0), np.float32(NOWHERE), maps)
        with atomic_file(paths[-1], 'w') as file:
            for row in table.astype(np.float32).reshape(-1, table.shape[2]).tolist():
                # Nine digits hold a float32.
                file.write(', '.join([f'{value:.9g}' for value in row]) + '\n')
    return Written(tuple(paths))


FORMAT = Format(
    'lut',
    'XMALab undistortion lookup table',
    parts=('lookups',),
    recognise=recognise,
    read=read,
    write=write,
    looks_like='twice as many rows of numbers as the image has',
)
