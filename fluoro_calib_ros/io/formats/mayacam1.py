# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""MayaCam 1.0: five rows of three numbers; read only.

The layout is that of `Camera::getMayaCam` of XMALab 2.2.7 and `Camera::loadMayaCam1` of
Autoscoper: position of the source; angles x, y, z [degrees] of the camera's axes in the world,
turned about z, then y, then x; position of the film plane (derived, not read); principal point u0,
v0 and -c [px], counted from 1, v upwards; scale, width, height (0: 1024). The camera looks along
-z, y upwards. The unit is that of the calibration object, and the file does not say it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ...errors import DataError
from .content import Content, FileSettings, Format, Sample, camera_at, from_units, name_of_file
from .text import Row, read_table, require_width

ENDING = '_MayaCam.csv'
_DEFAULT_SIZE = 1024
_ROWS = 5
# x right, y up, z backwards -> x right, y down, z forwards.
_AXES = np.diag([1.0, -1.0, -1.0])


def recognise(sample: Sample) -> bool:
    """Return whether the file has just five rows of three numbers."""
    if len(sample.lines) != _ROWS:
        return False
    try:
        return all(len([float(c) for c in line.split(',')]) == 3 for line in sample.lines)
    except ValueError:
        return False


def read(path: Path, settings: FileSettings) -> Content:
    """Read a camera, which is called like the file. Raises DataError that names the row."""
    rows = read_table(path)
    if len(rows) != _ROWS:
        raise DataError(f'{path}: {len(rows)} rows, but MayaCam 1.0 has {_ROWS}')
    require_width(rows, 3, 'MayaCam 1.0')
    position, angles, _, (u0, v0, z), (_, width, height) = (row.numbers() for row in rows)
    size = (_pixels(rows[4], width), _pixels(rows[4], height))
    if not z:
        rows[3].fail('the principal distance is 0')
    # x, y, z of the camera in the world as columns: extrinsic rotations about x, y and z.
    axes = Rotation.from_euler('xyz', angles, degrees=True).as_matrix()
    matrix = np.array([[abs(z), 0, u0 - 1], [0, abs(z), size[1] - 1 - (v0 - 1)], [0, 0, 1]])
    camera = camera_at(
        name_of_file(path, ENDING),
        matrix,
        size,
        (axes @ _AXES).T,
        from_units(np.array(position), settings.unit_read(path)),
    )
    return Content(cameras=(camera,))


def _pixels(row: Row, value: float) -> int:
    if value < 0 or value != int(value):
        row.fail(f'{value:g} px is not a side of an image')
    return int(value) or _DEFAULT_SIZE


FORMAT = Format(
    'mayacam1',
    'MayaCam 1.0',
    parts=('cameras',),
    recognise=recognise,
    read=read,
    write=None,
    looks_like='five rows of three numbers',
    says_units=False,
)
