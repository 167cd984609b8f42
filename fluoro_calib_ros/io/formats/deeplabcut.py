# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""DeepLabCut tables, one file a camera: predicted points, and points labelled by hand.

The header has a row each for scorer, body part and coordinate, with several animals one for the
individual, too. Rows are frames from 0, or the paths of labelled images, in one cell or in three.
Pixel centres are at integers from (0, 0), v downwards. The table is CSV, or HDF5 of pandas.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...errors import DataError
from ...exposures.frame import Frame, points_on_image
from ...exposures.names import Names, number_names
from ..access import atomic_file, check_safe_name, make_folder
from ..csv_table import as_text
from .content import Content, FileSettings, Format, Sample, Written
from .reader_process import HDF5, hdf5_arrays
from .tables import (
    Row,
    default_name,
    named_targets,
    number_text,
    read_table,
    require_width,
    with_sigma_of_likelihood,
)

HEADER = ('scorer', 'individuals', 'bodyparts', 'coords')
SCORER = 'fluoro_calib_ros'
# Points that DeepLabCut itself neither plots nor evaluates: the default of its setting pcutoff.
LIKELIHOOD = 0.6
_NUMBER = re.compile(r'\d+')


def read(path: Path, settings: FileSettings) -> Content:
    """Read image points of one camera, named after the file. Raises DataError."""
    with path.open('rb') as file:
        is_hdf5 = file.read(len(HDF5)) == HDF5
    rows = _rows_of_hdf5(path) if is_hdf5 else read_table(path, ',')
    header = {row.cells[0].lower(): row for row in rows[: len(HEADER)] if _is_header(row)}
    body = rows[len(header) :]
    coords = header.get('coords')
    if coords is None or 'bodyparts' not in header or not body:
        rows[0].fail('a DeepLabCut table has rows scorer, bodyparts and coords, and then frames')
    require_width([*header.values(), *body], len(coords.cells), 'the row coords')
    first = next((k for k, cell in enumerate(coords.cells) if k and cell), len(coords.cells))
    targets = _targets(header, first)
    ids = number_names(targets, settings.names.targets)
    target_id = np.array([ids[name] for name in targets], dtype=np.int64)
    size = settings.image_size_of(path)
    fluoroscope = _fluoroscope(path, settings)
    frames: dict[int, Frame] = {}
    likelihood: list[np.ndarray] = []
    unsure = 0
    for row in body:
        values = np.array(row.numbers_or_nan(first)).reshape(len(targets), -1)
        seen = np.isfinite(values[:, :2]).all(axis=1)
        if values.shape[1] == 3:
            likely = values[:, 2] >= LIKELIHOOD
            unsure += np.count_nonzero(seen & ~likely)
            seen &= likely
        uv = values[seen, :2]
        if not points_on_image(uv, size).all():
            row.fail(f'a point is off the image of {size[0]} x {size[1]} px')
        if seen.any():
            number = _frame_number(row, first)
            if number in frames:
                row.fail(f'frame {number} is given twice')
            frame_id = f'{fluoroscope}_optical'
            frames[number] = Frame(
                fluoroscope, number, target_id[seen], uv, size, frame_id=frame_id
            )
            likelihood.append(values[seen, 2] if values.shape[1] == 3 else np.ones(len(uv)))
    observed = with_sigma_of_likelihood(list(frames.values()), likelihood)
    notes = (
        f'{path}: {unsure} points with a likelihood below {LIKELIHOOD} (pcutoff) are not used',
    )
    return Content(
        observations={fluoroscope: observed} if observed else {},
        names=Names(named_targets({name: ids[name] for name in targets})),
        notes=notes if unsure else (),
    )


def _rows_of_hdf5(path: Path) -> list[Row]:
    """Return the rows that a file has as CSV. Raises DataError."""
    arrays = hdf5_arrays('deeplabcut', path)
    levels = arrays['columns'].T.tolist()
    # A table of several animals has the headers of HEADER, that of a single one no individuals.
    names = HEADER if len(levels) == len(HEADER) else (HEADER[0], *HEADER[2:])
    if len(levels) != len(names):
        raise DataError(f'{path}: the columns have {len(levels)} headers, not those of DeepLabCut')
    cells = [[name, *level] for name, level in zip(names, levels)]
    values = [map(number_text, row) for row in arrays['values']]
    cells += [[index, *row] for index, row in zip(arrays['index'].tolist(), values)]
    return [Row(path, line, row) for line, row in enumerate(cells, 1)]


def _is_header(row: Row) -> bool:
    return row.cells[0].lower() in HEADER


def _targets(header: dict[str, Row], first: int) -> list[str]:
    """Return the names of the points, in the order of the columns. Raises DataError."""
    coords = header['coords']
    axes = [cell.lower() for cell in coords.cells[first:]]
    group = ['x', 'y', 'likelihood'] if 'likelihood' in axes else ['x', 'y']
    if not axes or axes != group * (len(axes) // len(group)):
        coords.fail(f'the columns are not {", ".join(group)} of one body part after the other')
    parts = header['bodyparts'].cells[first :: len(group)]
    if 'individuals' in header:
        # 'single' are the points that belong to no animal
        animals = header['individuals'].cells[first :: len(group)]
        parts = [p if a == 'single' else f'{a} {p}' for a, p in zip(animals, parts)]
    for name in parts:
        if not name or parts.count(name) > 1:
            header['bodyparts'].fail(f'the body part {name!r} is given twice')
    return parts


def _fluoroscope(path: Path, settings: FileSettings) -> str:
    """Return the fluoroscope of a file: <name>DLC_<network>.csv, CollectedData_<name>.csv."""
    name = path.stem.removeprefix('CollectedData_').split('DLC_')[0].rstrip('_') or path.stem
    return settings.fluoroscope_of(name, path)


def _frame_number(row: Row, first: int) -> int:
    """Return the number of a frame, or of a labelled image. Raises DataError."""
    numbers = _NUMBER.findall(Path(row.cells[first - 1]).stem)
    if not numbers:
        row.fail(f'{row.cells[first - 1]!r} is neither a frame nor a numbered image')
    return int(numbers[-1])


def write(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write a folder with a file <fluoroscope>.csv each, with likelihood 1. Raises DataError."""
    observations = content.observations or {}
    for name in observations:
        check_safe_name(name, path)
    make_folder(path)
    named = content.names.target_names()
    written = tuple(str(path / f'{name}.csv') for name in observations)
    for file, frames in zip(written, observations.values()):
        _write_camera(Path(file), frames, named)
    return Written(written)


def _write_camera(path: Path, frames: Sequence[Frame], named: dict[int, str]) -> None:
    ids = sorted({int(i) for frame in frames for i in frame.target_id})
    names = [as_text(named.get(i, default_name(i))) for i in ids]
    with atomic_file(path, 'w') as file:
        writer = csv.writer(file, lineterminator='\n')
        writer.writerow(['scorer'] + [SCORER] * 3 * len(ids))
        writer.writerow(['bodyparts', *(name for name in names for _ in range(3))])
        writer.writerow(['coords'] + ['x', 'y', 'likelihood'] * len(ids))
        for frame in frames:
            values = np.full((len(ids), 3), np.nan)
            values[np.searchsorted(ids, frame.target_id)] = np.column_stack(
                [frame.uv, np.ones(len(frame.uv))]
            )
            cells = ['' if np.isnan(v) else number_text(v) for v in values.ravel()]
            writer.writerow([frame.number, *cells])


def _is_deeplabcut(sample: Sample) -> bool:
    if sample.head.startswith(HDF5):
        return b'pandas_type' in sample.head
    is_table = any(line.lower().startswith('coords,') for line in sample.lines[: len(HEADER)])
    return is_table and sample.first.lower().startswith('scorer,')


FORMAT = Format(
    'deeplabcut',
    'DeepLabCut points',
    parts=('observations',),
    recognise=_is_deeplabcut,
    read=read,
    write=write,
    looks_like='scorer,DLC_resnet50,DLC_resnet50,DLC_resnet50',
    one_camera=True,
)
