# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Image points predicted by neural networks: DeepLabCut and SLEAP.

DeepLabCut tables, one file a camera: predicted points, or points labelled by hand. They are CSV,
or HDF5 of pandas.

The header has one row each for scorer, body part and coordinate, and for several animals one for
the individual. Rows are frames from 0, or the paths of labelled images, in one cell or in three.
Pixel centres are at integers from (0, 0), v downwards.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import DataError
from ...exposures.frame import Frame
from ..access import atomic_file, write_bytes
from ..csv_table import as_text
from .content import Content, FileSettings, Format, Sample, Written, files_in_folder
from .reader_process import HDF5, hdf5_arrays, require_h5py
from .tables import (
    Row,
    check_row_count,
    default_name,
    frame_of,
    number_text,
    numbered_targets,
    read_table,
    require_width,
    with_sigma_of_likelihood,
)

HEADER = ('scorer', 'individuals', 'bodyparts', 'coords')
SCORER = 'fluoro_calib_ros'
# Least likelihood of a point that is read; default of the setting pcutoff of DeepLabCut, below
# which it neither plots nor evaluates points.
LIKELIHOOD = 0.6
_NUMBER = re.compile(r'\d+')


def read_deeplabcut(path: Path, settings: FileSettings) -> Content:
    """Read image points of one camera, named after the file. Raises DataError."""
    with path.open('rb') as file:
        is_hdf5 = file.read(len(HDF5)) == HDF5
    rows = _rows_of_hdf5(path) if is_hdf5 else read_table(path, ',')
    top_rows = {row.cells[0].lower(): row for row in rows[: len(HEADER)]}
    header = {name: row for name, row in top_rows.items() if name in HEADER}
    frame_rows = rows[len(header) :]
    coords = header.get('coords')
    if coords is None or 'bodyparts' not in header or not frame_rows:
        rows[0].fail('a DeepLabCut table has rows scorer, bodyparts and coords, and then frames')
    require_width([*header.values(), *frame_rows], len(coords.cells), 'the row coords')
    first_column = next(
        (k for k, cell in enumerate(coords.cells) if k and cell), len(coords.cells)
    )
    targets = _body_parts(header, first_column)
    target_id, names = numbered_targets(targets, settings.names.targets)
    fluoroscope = _fluoroscope_of_table(path, settings)
    size = settings.image_size_of(path, fluoroscope)
    frames: dict[int, Frame] = {}
    likelihood: list[NDArray[np.float64]] = []
    unsure_count = 0
    for row in frame_rows:
        values = np.array(row.numbers_or_nan(first_column)).reshape(len(targets), -1)
        seen = np.isfinite(values[:, :2]).all(axis=1)
        if values.shape[1] == 3:
            is_likely = values[:, 2] >= LIKELIHOOD
            unsure_count += np.count_nonzero(seen & ~is_likely)
            seen &= is_likely
        if seen.any():
            number = _frame_number(row, first_column)
            if number in frames:
                row.fail(f'frame {number} is given twice')
            points = (target_id[seen], values[seen, :2])
            frames[number] = frame_of(row.place, fluoroscope, number, *points, size)
            likelihood.append(values[seen, 2] if values.shape[1] == 3 else np.ones(seen.sum()))
    observed = with_sigma_of_likelihood(list(frames.values()), likelihood)
    notes = (
        f'{path}: {unsure_count} points with a likelihood below {LIKELIHOOD} (pcutoff) are not '
        'used',
    )
    return Content(
        observations={fluoroscope: observed} if observed else {},
        names=names,
        notes=notes if unsure_count else (),
    )


def _rows_of_hdf5(path: Path) -> list[Row]:
    """Return the rows that the same table has as CSV. Raises DataError."""
    arrays = hdf5_arrays('deeplabcut', path)
    levels = arrays['columns'].T.tolist()
    # A table of several animals has all headers of HEADER, one of a single animal no individuals.
    names = HEADER if len(levels) == len(HEADER) else (HEADER[0], *HEADER[2:])
    if len(levels) != len(names):
        raise DataError(f'{path}: the columns have {len(levels)} headers, not those of DeepLabCut')
    cells = [[name, *level] for name, level in zip(names, levels)]
    values = [map(number_text, row) for row in arrays['values']]
    cells += [[index, *row] for index, row in zip(arrays['index'].tolist(), values)]
    return [Row(path, line, row) for line, row in enumerate(cells, 1)]


def _body_parts(header: dict[str, Row], first: int) -> list[str]:
    """Return the names of the points in the order of the columns. Raises DataError."""
    coords = header['coords']
    axes = [cell.lower() for cell in coords.cells[first:]]
    group = ['x', 'y', 'likelihood'] if 'likelihood' in axes else ['x', 'y']
    if not axes or axes != group * (len(axes) // len(group)):
        coords.fail(f'the columns are not {", ".join(group)} of one body part after the other')
    parts = header['bodyparts'].cells[first :: len(group)]
    if 'individuals' in header:
        # 'single' marks points that belong to no animal
        animals = header['individuals'].cells[first :: len(group)]
        parts = [p if a == 'single' else f'{a} {p}' for a, p in zip(animals, parts)]
    for name in parts:
        if not name or parts.count(name) > 1:
            header['bodyparts'].fail(f'the body part {name!r} is given twice')
    return parts


def _fluoroscope_of_table(path: Path, settings: FileSettings) -> str:
    """Return the fluoroscope of a file <name>DLC_<network>.csv or CollectedData_<name>.csv."""
    name = path.stem.removeprefix('CollectedData_').split('DLC_')[0].rstrip('_') or path.stem
    return settings.fluoroscope_of(name, path)


def _frame_number(row: Row, first: int) -> int:
    """Return the number of a frame or of a labelled image. Raises DataError."""
    numbers = _NUMBER.findall(Path(row.cells[first - 1]).stem)
    if not numbers:
        row.fail(f'{row.cells[first - 1]!r} is neither a frame nor a numbered image')
    return int(numbers[-1])


def write_deeplabcut(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write a folder with a file <fluoroscope>.csv each, likelihood 1. Raises DataError."""
    observations = content.observations or {}
    files = files_in_folder(path, observations, '.csv')
    for name, frames in observations.items():
        _write_camera(Path(files[name]), frames, content.names.target_names())
    return Written(tuple(files.values()))


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


DEEPLABCUT = Format(
    'deeplabcut',
    'DeepLabCut points',
    parts=('observations',),
    recognise=_is_deeplabcut,
    read=read_deeplabcut,
    write=write_deeplabcut,
    one_camera=True,
)


# Analysis files of SLEAP (HDF5), one file a camera: points of skeletons in frames of a video.
#
# Frames count from 0. Pixel centres are at integers from (0, 0), v downwards.

LEAST_SCORE = 1e-6  # a point with a smaller score would have negligible weight
_OF_VIDEO = re.compile(r'.*\.\d{3}_(?P<video>.+)')  # <project>.<number of the video>_<video>


def read_sleap(path: Path, settings: FileSettings) -> Content:
    """Read image points of one camera, named after the file. Raises DataError."""
    arrays = hdf5_arrays('sleap', path)
    uv = arrays['uv']
    score = arrays['score']
    targets = _nodes(path, arrays)
    if uv.shape != (*score.shape, 2) or score.shape[1] * score.shape[2] != len(targets):
        raise DataError(f'{path}: tracks, point_scores and node_names are of different sizes')
    uv = uv.reshape(len(uv), len(targets), 2)
    score = score.reshape(len(uv), len(targets))
    score = np.where(np.isnan(score), 1.0, score)  # NaN: labelled by hand
    target_id, names = numbered_targets(targets, settings.names.targets)
    fluoroscope = _fluoroscope_of_video(path, settings)
    size = settings.image_size_of(path, fluoroscope)
    placed = np.isfinite(uv).all(axis=2)
    seen = placed & (score > LEAST_SCORE) & (score < 1 / LEAST_SCORE)
    frames = []
    for number in np.flatnonzero(seen.any(axis=1)).tolist():
        points = (target_id[seen[number]], uv[number, seen[number]])
        where = f'{path}, frame {number}'
        frames.append(frame_of(where, fluoroscope, number, *points, size))
    likelihood = [score[frame.number, seen[frame.number]] for frame in frames]
    frames = with_sigma_of_likelihood(frames, likelihood)
    unsure_count = int(np.count_nonzero(placed & ~seen))
    return Content(
        observations={fluoroscope: frames} if frames else {},
        names=names,
        notes=(f'{path}: {unsure_count} points are not used, their score is 0 or no score',)
        if unsure_count
        else (),
    )


def _nodes(path: Path, arrays: dict[str, np.ndarray]) -> list[str]:
    """Return the names of the points: nodes, preceded by the track if there are several tracks."""
    nodes = arrays['nodes'].tolist()
    tracks = arrays['tracks'].tolist()
    count = arrays['uv'].shape[1]
    if count > 1:
        tracks = tracks if len(tracks) == count else [f'track_{k}' for k in range(count)]
        nodes = [f'{track} {node}' for track in tracks for node in nodes]
    if len(set(nodes)) < len(nodes):
        raise DataError(f'{path}: two points have the same name')
    return nodes


def _fluoroscope_of_video(path: Path, settings: FileSettings) -> str:
    """Return the fluoroscope of a file <project>.000_<video>.analysis.h5: its video."""
    name = path.name.removesuffix(path.suffix).removesuffix('.analysis')
    match = _OF_VIDEO.fullmatch(name)
    return settings.fluoroscope_of(match['video'] if match else name, path)


def write_sleap(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write a folder with a file <fluoroscope>.analysis.h5 each. Raises DataError."""
    require_h5py(path)
    observations = content.observations or {}
    files = files_in_folder(path, observations, '.analysis.h5')
    for name, frames in observations.items():
        check_row_count(files[name], max(frame.number for frame in frames))
        write_bytes(files[name], _content_of(frames, content.names.target_names()))
    return Written(tuple(files.values()))


def _content_of(frames: Sequence[Frame], named: dict[int, str]) -> bytes:
    """Return an analysis file of one track, axes in the order of SLEAP, with scores of 1."""
    import h5py

    ids = sorted({int(i) for frame in frames for i in frame.target_id})
    count = 1 + max(frame.number for frame in frames)
    uv = np.full((1, 2, len(ids), count), np.nan)
    for frame in frames:
        uv[0, :, np.searchsorted(ids, frame.target_id), frame.number] = frame.uv
    seen = np.isfinite(uv[:, 0])
    score = np.where(seen, 1.0, np.nan)
    occupied = seen.any(axis=1)
    values = {
        'tracks': uv,
        'track_occupancy': occupied.T.astype(np.uint8),
        'point_scores': score,
        'instance_scores': np.where(occupied, 1.0, np.nan),
        'tracking_scores': np.where(occupied, 1.0, np.nan),
    }
    buffer = io.BytesIO()
    with h5py.File(buffer, 'w') as file:
        for name, array in values.items():
            file.create_dataset(name, data=array, compression='gzip')
        texts = {
            'node_names': [named.get(i, default_name(i)) for i in ids],
            'track_names': ['track_0'],
            'edge_names': [],
        }
        for name, names in texts.items():
            file.create_dataset(name, data=np.array([n.encode() for n in names], dtype='S'))
        file.create_dataset('edge_inds', data=np.zeros((0, 2), dtype=int))
        file['labels_path'] = file['video_path'] = ''
        file['video_ind'] = 0
        file['provenance'] = '{}'
    return buffer.getvalue()


SLEAP = Format(
    'sleap',
    'SLEAP analysis points',
    parts=('observations',),
    recognise=lambda sample: sample.head.startswith(HDF5),
    read=read_sleap,
    write=write_sleap,
    one_camera=True,
)
