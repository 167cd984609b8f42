# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Read a C3D or HDF5 file in a separate process: `python -m ...reader_process KIND PATH`.

ezc3d and HDF5 trust what a file states about itself: damage can make them crash or exhaust the
memory. Standard output is an .npz of arrays. For C3D: labels, unit, rate, first, xyz (m, n, 3),
residual (m, n), and rotation_labels, rotation_unit, rotation_rate, rotations (m, b, 4, 4). For an
analysis file of SLEAP: uv (m, t, n, 2) and score (m, t, n) by frame, track and node, and the names
nodes and tracks. For a file of DeepLabCut: columns (n, levels), index (m,) and values (m, n).
"""

from __future__ import annotations

import importlib.util
import io
import json
import os
import pickletools
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import DataError
from ...processes import run_module, watch_parent

HDF5 = b'\x89HDF\r\n\x1a\n'  # signature of HDF5 files
# Limit of the address space [bytes]: base, plus a multiple of the file size, at most the maximum.
BASE_MEMORY = 3 * 2**30
MEMORY_OF_BYTE = 100
MAX_MEMORY = 8 * 2**30


def labels_of(parameters: Any) -> list[str]:
    """Return all point names: one parameter contains 255, the others follow in LABELS2, ..."""
    labels = list(parameters['LABELS']['value'])
    number = 2
    while f'LABELS{number}' in parameters:
        labels += parameters[f'LABELS{number}']['value']
        number += 1
    return [str(label).strip() for label in labels]


def c3d_arrays(path: str) -> dict[str, Any]:
    """Return the arrays of a C3D file."""
    import ezc3d

    file = ezc3d.c3d(path)
    parameters = file['parameters']['POINT']
    header = file['header']['points']
    # A file without rotations has neither the group nor matrices.
    group = file['parameters'].get('ROTATION', {})
    rotations = np.asarray(file['data']['rotations'], dtype=float)
    xyz = np.asarray(file['data']['points'], dtype=float)[:3].transpose(2, 1, 0)

    def of_group(name: str, default: Any) -> Any:
        values = group[name]['value'] if name in group else []
        return values[0] if len(values) else default

    return {
        'rotation_labels': np.array(labels_of(group) if 'LABELS' in group else [], dtype=str),
        'rotation_unit': str(of_group('UNITS', '')).strip(),
        'rotation_rate': float(of_group('RATE', header['frame_rate'])),
        'rotations': rotations.reshape(4, 4, *rotations.shape[2:]).transpose(3, 2, 0, 1),
        'labels': np.array(labels_of(parameters), dtype=str),
        'unit': str(parameters['UNITS']['value'][0]).strip(),
        'rate': float(header['frame_rate']),
        'first': int(header['first_frame']) + 1,
        'xyz': xyz,
        'residual': _residuals(path, xyz, float(parameters['SCALE']['value'][0])),
    }


def _residuals(path: str, xyz: NDArray[np.float64], scale: float) -> NDArray[np.float64]:
    """Return the residuals (m, n) of the points of a C3D file, -1 for missing points.

    The residual is the low byte of the fourth word of a point. ezc3d 1.7.2 returns the high byte,
    which is the camera mask.
    """
    content = Path(path).read_bytes()
    analog, data = (int.from_bytes(content[offset : offset + 2], 'little') for offset in (4, 16))
    frames, points, _ = xyz.shape
    width = 4 * points + analog
    kind = '<f4' if scale < 0 else '<i2'
    values = np.frombuffer(content, kind, frames * width, (data - 1) * 512)
    if scale < 0 and content[(content[0] - 1) * 512 + 3] == 85:  # DEC floating-point format
        values = values.view('<u2').reshape(-1, 2)[:, ::-1].copy().view('<f4') / 4
    words = values.reshape(frames, width)[:, 3 : 4 * points : 4]
    steps = np.where(words >= 0, words, -1).astype(np.int64)
    return np.where(steps < 0, -1.0, (steps & 0xFF) * abs(scale))


# Tables that pandas has stored as HDF5, read without pandas.
#
# pandas pickles the column names of a table with protocol 0. Loading a pickle may run arbitrary
# code. Therefore its instructions are interpreted one by one, and only those are accepted that
# make lists and tuples of texts and numbers.

VALUES = 'values_block_0'  # block of columns of the same type, as in a table of coordinates
_VALUES = ('UNICODE', 'STRING', 'INT', 'LONG')
_MAKERS: dict[str, Callable[[list[Any]], Any]] = {'LIST': list, 'TUPLE': tuple}
_MARK = object()


def texts(values: Any) -> list[str]:
    """Return HDF5 values as texts: bytes decoded, numbers converted."""
    return [v.decode() if isinstance(v, bytes) else str(v) for v in values]


def table_arrays(group: Any) -> dict[str, Any]:
    """Return columns (n, levels), index (m,) and values (m, n) of a table in a group.

    Raises ValueError unless it is a table of numbers whose columns have several headers.
    """
    kind = texts([group.attrs['pandas_type']])[0]
    if kind == 'frame_table':
        columns, index, values = _appendable(group)
    elif kind == 'frame':
        columns, index, values = _fixed(group)
    else:
        raise ValueError(f'it is a {kind} of pandas, not a table')
    if columns.ndim != 2 or values.shape != (len(index), len(columns)):
        raise ValueError('its columns need several headers each, and numbers of one kind')
    return {'columns': columns, 'index': index, 'values': values}


def _appendable(group: Any) -> tuple[NDArray[np.str_], NDArray[np.str_], NDArray[np.float64]]:
    table = group['table']
    if set(table.dtype.names) != {'index', VALUES}:
        raise ValueError('its columns are not of one kind')
    rows = table[:]
    (_, columns), *other_axes = literal(bytes(group.attrs['non_index_axes']))
    if other_axes:
        raise ValueError('it has more than two axes')
    return np.array(columns, dtype=str), np.array(texts(rows['index'])), rows[VALUES].astype(float)


def _fixed(group: Any) -> tuple[NDArray[np.str_], NDArray[np.str_], NDArray[np.float64]]:
    if int(group.attrs['nblocks']) != 1:
        raise ValueError('its columns are not of one kind')
    columns = np.array(_levels(group, 'block0_items')).T
    # A multi-level index ends with the image name.
    index = _levels(group, 'axis1')[-1]
    stored = group['block0_values']
    values = stored[:].astype(float)
    return columns, np.array(index), values if stored.attrs.get('transposed', 1) else values.T


def _levels(group: Any, axis: str) -> list[list[str]]:
    """Return the texts of each level of an axis."""
    if axis in group:
        return [texts(group[axis][:])]
    levels = []
    for level in range(int(group.attrs[f'{axis}_nlevels'])):
        names = texts(group[f'{axis}_level{level}'][:])
        labels = group[f'{axis}_label{level}'][:]
        if len(labels) and not 0 <= labels.min() <= labels.max() < len(names):
            raise ValueError('an index of its columns is not known')
        levels.append([names[label] for label in labels])
    return levels


def literal(pickled: bytes) -> Any:
    """Return the value of a pickle of protocol 0, without loading it.

    Raises ValueError for anything but lists and tuples of texts and numbers.
    """
    stack: list[Any] = []
    memory: dict[Any, Any] = {}
    for instruction, argument, _ in pickletools.genops(pickled):
        name = instruction.name
        if name == 'MARK':
            stack.append(_MARK)
        elif name in _VALUES:
            stack.append(argument)
        elif name in _MAKERS:
            mark_index = len(stack) - 1 - stack[::-1].index(_MARK)
            stack[mark_index:] = [_MAKERS[name](stack[mark_index + 1 :])]
        elif name == 'APPEND':
            value = stack.pop()
            stack[-1].append(value)
        elif name == 'PUT':
            memory[argument] = stack[-1]
        elif name == 'GET':
            stack.append(memory[argument])
        elif name == 'STOP':
            return stack.pop()
        else:
            raise ValueError(f'its columns are stored by {name}, which is not read')
    raise ValueError('its columns are cut off')


# Axes of `tracks` in a file that does not name them; the order that SLEAP itself writes.
SLEAP_AXES = ('track', 'xy', 'node', 'frame')


def sleap_arrays(path: str) -> dict[str, Any]:
    """Return the arrays of an analysis file of SLEAP. Raises ValueError for another file."""
    import h5py

    with h5py.File(path, 'r') as file:
        if 'tracks' not in file or 'node_names' not in file:
            raise ValueError(
                'it is not an analysis file of SLEAP, which has tracks and node_names; of a '
                'project, export the analysis HDF5'
            )
        tracks = file['tracks']
        axes = list(json.loads(tracks.attrs['dims']) if 'dims' in tracks.attrs else SLEAP_AXES)
        uv = np.transpose(tracks[:], [axes.index(n) for n in ('frame', 'track', 'node', 'xy')])
        axes.remove('xy')
        score = np.full(uv.shape[:3], np.nan)
        if 'point_scores' in file:
            order = [axes.index(name) for name in ('frame', 'track', 'node')]
            score = np.transpose(file['point_scores'][:], order)
        return {
            'uv': np.asarray(uv, dtype=float),
            'score': np.asarray(score, dtype=float),
            'nodes': np.array(texts(file['node_names']), dtype=str),
            'tracks': np.array(texts(file.get('track_names', [])), dtype=str),
        }


def deeplabcut_arrays(path: str) -> dict[str, Any]:
    """Return the arrays of a DeepLabCut table. Raises ValueError for another file."""
    import h5py

    with h5py.File(path, 'r') as file:
        tables = [group for group in file.values() if 'pandas_type' in group.attrs]
        if len(tables) != 1:
            raise ValueError('it is not a file of DeepLabCut, which has one table of pandas')
        return table_arrays(tables[0])


READERS = {'c3d': c3d_arrays, 'sleap': sleap_arrays, 'deeplabcut': deeplabcut_arrays}


def main() -> None:
    """Write the arrays to standard output, or the error to standard error and exit with 1."""
    watch_parent(os.getppid())
    with suppress(ImportError, ValueError, OSError):  # Windows has no such limit
        import resource

        size = os.path.getsize(sys.argv[2])
        memory = min(BASE_MEMORY + MEMORY_OF_BYTE * size, MAX_MEMORY)
        resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    try:
        arrays = READERS[sys.argv[1]](sys.argv[2])
    except Exception as error:  # the exceptions of ezc3d have no common type
        print(' '.join(str(error).split()), file=sys.stderr)
        sys.exit(1)
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    sys.stdout.buffer.write(buffer.getvalue())


# Time limit of the process [s]: base for the start, plus seconds per byte of the file.
BASE_SECONDS = 10
SECONDS_OF_BYTE = 1e-6


def hdf5_arrays(kind: str, path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of an HDF5 file. Raises DataError, also if h5py is not installed."""
    require_h5py(path)
    return arrays_apart(kind, path, 'HDF5')


def require_h5py(path: Path) -> None:
    """Raise DataError if h5py is not installed."""
    if importlib.util.find_spec('h5py') is None:
        raise DataError(
            f'{path}: HDF5 files need the package h5py: pip install h5py, or '
            'fluoro_calib_ros[hdf5]'
        )


def arrays_apart(kind: str, path: Path, title: str) -> dict[str, np.ndarray]:
    """Return the arrays of a file, read in a separate process. Raises DataError if that fails."""
    seconds = BASE_SECONDS + SECONDS_OF_BYTE * path.stat().st_size
    try:
        process = run_module(__name__, kind, os.fspath(path.resolve()), timeout_s=seconds)
    except TimeoutError:
        raise DataError(f'{path}: this {title} file cannot be read, it is damaged') from None
    if process.returncode:
        cause = (
            process.stderr.decode('utf-8', 'replace').strip() if process.returncode == 1 else ''
        )
        raise DataError(
            f'{path}: this {title} file cannot be read ({cause or "it is damaged"})'
        ) from None
    with np.load(io.BytesIO(process.stdout), allow_pickle=False) as arrays:
        return dict(arrays)


if __name__ == '__main__':
    main()
