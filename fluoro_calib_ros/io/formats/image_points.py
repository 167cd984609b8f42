# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Image points of other programs: XMALab, DeepLabCut and SLEAP.

XMALab 2-D points: `name_cam1_X,name_cam1_Y,name_cam2_X,...`, one row a frame.

The layout is that of `Trial::save2dPoints` and `load2dPoints` of XMALab 2.2.7: pixel centres at
integers from (0, 0), v downwards, NaN where a marker is not seen. Variants are chosen in its
dialogue and not visible in the file: pixels counted from 1 (one_based), rows counted upwards
(y_up). DLTdv names the points pt1, pt2, ... and counts from 1, before version 8 upwards. Argus
writes `name_cam_1_x` and counts upwards. A further variant begins with the columns cam<n>_offset;
XMALab writes their header without the separating commas. The exposure is the row number, counted
from 1, unless there is a column Frame.
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
from ...exposures.frame import Frame, points_on_image
from ..access import atomic_file, write_bytes
from ..csv_table import as_text
from .content import Content, FileSettings, Format, Sample, Written, files_in_folder
from .reader_process import HDF5, hdf5_arrays, require_h5py
from .tables import (
    Row,
    check_labels,
    check_row_count,
    default_name,
    frame_numbers,
    frame_of,
    joined,
    number_text,
    numbered_targets,
    read_frames,
    read_table,
    require_width,
    with_sigma_of_likelihood,
)

_COLUMN = re.compile(r'(?P<target>.+)_cam_?(?P<camera>\d+)_(?P<axis>[XY])', re.IGNORECASE)
_OFFSET = re.compile(r'cam\d+_offset', re.IGNORECASE)


def read_xmalab(path: Path, settings: FileSettings) -> Content:
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
        given = Row(row.path, row.line, row.cells[first_column : first_column + offsets])
        if any(given.numbers()):
            row.fail(
                'the cameras are offset against each other in time: export them without offset'
            )
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
    matches = [_COLUMN.fullmatch(cell) for cell in cells]
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


def write_xmalab(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write image points: one column pair a target and camera, one row an exposure, from 1 on."""
    observations = content.observations or {}
    cameras = camera_order(list(observations))
    target_names = content.names.target_names()
    frames = {name: {f.number: f for f in observations[name]} for name in cameras}
    numbers = sorted({number for view_frames in frames.values() for number in view_frames})
    ids = _ids([f for view_frames in frames.values() for f in view_frames.values()])
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


def _ids(frames: Sequence[Frame]) -> list[int]:
    """Return the ids of all targets, ascending."""
    return sorted({int(i) for frame in frames for i in frame.target_id})


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


XMALAB2D = Format(
    'xmalab2d',
    'XMALab 2-D points',
    parts=('observations',),
    recognise=lambda sample: re.search(r'_cam_?\d+_[XY]\b', sample.first, re.I) is not None,
    read=read_xmalab,
    write=write_xmalab,
)


# DeepLabCut tables, one file a camera: predicted points, or points labelled by hand. They are CSV,
# or HDF5 of pandas.
#
# The header has one row each for scorer, body part and coordinate, and for several animals one for
# the individual. Rows are frames from 0, or the paths of labelled images, in one cell or in three.
# Pixel centres are at integers from (0, 0), v downwards.

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
    # The file is called <name>DLC_<network>.csv or CollectedData_<name>.csv.
    name = path.stem.removeprefix('CollectedData_').split('DLC_')[0].rstrip('_') or path.stem
    fluoroscope = settings.fluoroscope_of(name, path)
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
    ids = _ids(frames)
    names = [as_text(named.get(i, default_name(i))) for i in ids]
    check_labels(path, names, '')
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
    # The file is called <project>.000_<video>.analysis.h5.
    name = path.name.removesuffix(path.suffix).removesuffix('.analysis')
    match = _OF_VIDEO.fullmatch(name)
    fluoroscope = settings.fluoroscope_of(match['video'] if match else name, path)
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

    ids = _ids(frames)
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
