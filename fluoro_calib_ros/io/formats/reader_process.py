# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Read a C3D file with ezc3d in a process of its own: `python -m ...c3d_process PATH`.

ezc3d trusts what a file says about itself: a damaged one can make it crash, or fill the memory.
Standard output is an .npz of the arrays labels, unit, rate, first, xyz (m, n, 3), residual (m, n),
and rotation_labels, rotation_unit, rotation_rate, rotations (m, b, 4, 4).
"""

from __future__ import annotations

import io
import os
import sys
from contextlib import suppress
from typing import Any

import numpy as np

from ...processes import watch_parent

# Bytes of address space: for the program, for each byte of the file, and at most.
BASE_MEMORY = 3 * 2**30
MEMORY_OF_BYTE = 100
MAX_MEMORY = 8 * 2**30


def labels_of(parameters: Any) -> list[str]:
    """Return the names of all points: a parameter holds 255, the others follow in LABELS2, ..."""
    found = list(parameters['LABELS']['value'])
    number = 2
    while f'LABELS{number}' in parameters:
        found += parameters[f'LABELS{number}']['value']
        number += 1
    return [str(label).strip() for label in found]


def arrays_of(path: str) -> dict[str, Any]:
    """Return the arrays of a C3D file."""
    import ezc3d

    file = ezc3d.c3d(path)
    parameters = file['parameters']['POINT']
    header = file['header']['points']
    # A file without rotations has neither the group nor matrices.
    group = file['parameters'].get('ROTATION', {})
    rotations = np.asarray(file['data']['rotations'], dtype=float)

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
        'xyz': np.asarray(file['data']['points'], dtype=float)[:3].transpose(2, 1, 0),
        'residual': np.asarray(file['data']['meta_points']['residuals'], dtype=float)[0].T,
    }


def main() -> None:
    """Write the arrays to standard output, or the cause to standard error and exit with 1."""
    watch_parent(os.getppid())
    with suppress(ImportError, ValueError, OSError):  # Windows has no such limit
        import resource

        size = os.path.getsize(sys.argv[1])
        memory = min(BASE_MEMORY + MEMORY_OF_BYTE * size, MAX_MEMORY)
        resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    try:
        arrays = arrays_of(sys.argv[1])
    except Exception as error:  # the errors of ezc3d have no type
        print(' '.join(str(error).split()), file=sys.stderr)
        sys.exit(1)
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    sys.stdout.buffer.write(buffer.getvalue())


if __name__ == '__main__':
    main()
