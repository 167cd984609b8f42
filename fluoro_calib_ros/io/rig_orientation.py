# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The file DIR/rig_orientation.npz, described in docs/files.md."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import replace

from ..errors import DataError, ErrorsAt
from ..limits import read_limits
from ..photogrammetry.rig_orientation import RigOrientation
from ..records import Field
from .access import PathLike, check_safe_name, make_folder
from .arrays import Layout, read_arrays, to_arrays, to_values, write_arrays
from .calibration import calibration_path, read_with_id

NAME = 'rig_orientation.npz'

FIELDS = (
    Field('fluoroscope', 'text', ('F',)),
    Field('calibration_id', 'text', ('F',)),
    Field('optical_frame_id', 'text', ('F',)),
    Field('interior', 'float', ('F', 3)),
    Field('rotation', 'float', ('F', 3, 3)),
    Field('position_mm', 'float', ('F', 3)),
    Field('covariance', 'float', ('N', 'N')),
    Field('frame_id', 'text'),
    Field('source', 'text'),
    Field('stamp_ns', 'int'),
    Field('exposures', 'int', minimum=0),
    Field('orientation_id', 'text'),
)
# Array of the file: attribute of the RigOrientation, where it has another name.
_ATTRIBUTES = {
    'fluoroscope': 'fluoroscopes',
    'calibration_id': 'calibration_ids',
    'optical_frame_id': 'optical_frame_ids',
}
LAYOUT = Layout('a rig orientation', FIELDS, version=1)


def orientation_path(directory: PathLike) -> str:
    """Return the path of the orientation of the rig in a folder."""
    return os.path.join(directory, NAME)


def save_orientation(directory: PathLike, orientation: RigOrientation) -> str:
    """Write an orientation into a folder, which is created where it is missing.

    Returns the path. The same orientation gives the same bytes. Raises DataError where the file
    cannot be written; an earlier file is then unchanged.
    """
    path = orientation_path(directory)
    for name in orientation.fluoroscopes:
        check_safe_name(name, path)
    values = {f.name: getattr(orientation, _ATTRIBUTES.get(f.name, f.name)) for f in FIELDS}
    arrays = to_arrays(path, LAYOUT, values)
    make_folder(directory)
    write_arrays(path, LAYOUT, arrays)
    return path


def load_orientation(path: PathLike) -> RigOrientation:
    """Read an orientation, which is equal to the saved one to the last bit.

    Where the calibrations beside it are of an earlier version, it refers to them by the ids of
    this version, and so has an id of its own. Raises DataError for a file that is not the
    orientation of a rig, is damaged or was changed, or has a version of the layout that is not
    known.
    """
    values = to_values(read_arrays(path, LAYOUT))
    identity = values.pop('orientation_id')
    most = read_limits().max_fluoroscopes
    if len(values['fluoroscope']) > most:
        raise DataError(
            f'{path}: the orientation has {len(values["fluoroscope"])} fluoroscopes, more than '
            f'{most} are not read'
        )
    for name in values['fluoroscope'].tolist():
        check_safe_name(name, path)
    with ErrorsAt(path):
        orientation = RigOrientation(
            **{_ATTRIBUTES.get(name, name): value for name, value in values.items()}
        )
    if orientation.orientation_id != identity:
        raise DataError(
            f'{path}: the content does not belong to its orientation_id {identity}, '
            f'the file was changed'
        )
    present = _present_ids(path, orientation)
    if present == orientation.calibration_ids:
        return orientation
    return replace(orientation, calibration_ids=present)


def _present_ids(path: PathLike, orientation: RigOrientation) -> tuple[str, ...]:
    """Ids of the calibrations of an orientation, in place of those that earlier versions gave."""
    folder = os.path.dirname(os.path.abspath(path))
    out = []
    for name, identity in zip(orientation.fluoroscopes, orientation.calibration_ids):
        present = identity
        beside = calibration_path(folder, name)
        if os.path.isfile(beside):
            with suppress(DataError):  # told where the calibration is needed
                calibration, stored = read_with_id(beside)
                present = calibration.calibration_id if stored == identity else identity
        out.append(present)
    return tuple(out)
