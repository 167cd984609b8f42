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
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import DataError
from ...processes import run_module, watch_parent
from .pandas_hdf5 import is_pandas, table_arrays, texts

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
        tables = [group for group in file.values() if is_pandas(group)]
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
