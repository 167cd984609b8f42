"""The file DIR/rig_orientation.npz, described in docs/orientation_file.md."""

import os

from ..errors import DataError
from ..photogrammetry.rig_orientation import RigOrientation
from .access import check_safe_name, make_folder
from .arrays import Field, array_of, read_arrays, values_of, write_arrays

VERSION = 1  # of the layout
READABLE = (1,)
NAME = 'rig_orientation.npz'

FIELDS = {
    'fluoroscope': Field('text', ('F',)),
    'calibration_id': Field('text', ('F',)),
    'optical_frame_id': Field('text', ('F',)),
    'interior': Field('float', ('F', 3)),
    'rotation': Field('float', ('F', 3, 3)),
    'position_mm': Field('float', ('F', 3)),
    'covariance': Field('float', ('N', 'N')),
    'frame_id': Field('text'),
    'source': Field('text'),
    'stamp_ns': Field('int'),
    'exposures': Field('int', least=0),
    'orientation_id': Field('text'),
}
_ATTRIBUTES = {
    'fluoroscope': 'fluoroscopes',
    'calibration_id': 'calibration_ids',
    'optical_frame_id': 'optical_frame_ids',
}  # array: attribute of the RigOrientation


def orientation_path(directory):
    """Path of the orientation of the rig in a directory."""
    return os.path.join(directory, NAME)


def save_orientation(directory, orientation):
    """Write a RigOrientation to directory, which is made where it is missing; returns the path.

    The same orientation gives the same bytes. Raises DataError where it cannot be written; a file
    that was there is then left as it was.
    """
    path = orientation_path(directory)
    for name in orientation.fluoroscopes:
        check_safe_name(name, path)
    arrays = {
        name: array_of(path, name, getattr(orientation, _ATTRIBUTES.get(name, name)), field)
        for name, field in FIELDS.items()
    }
    make_folder(directory)
    write_arrays(path, VERSION, arrays)
    return path


def load_orientation(path):
    """The RigOrientation in a file, equal to the saved one to the last bit.

    Raises DataError for a file that is no orientation of a rig, is damaged, was changed, or has a
    layout this program does not know.
    """
    values = values_of(read_arrays(path, FIELDS, READABLE, 'a rig orientation'))
    identity = values.pop('orientation_id')
    for name in values['fluoroscope'].tolist():
        check_safe_name(name, path)
    try:
        orientation = RigOrientation(
            **{_ATTRIBUTES.get(name, name): value for name, value in values.items()}
        )
    except DataError as error:
        raise DataError(f'{path}: {error}') from None
    if orientation.orientation_id != identity:
        raise DataError(
            f'{path}: the content does not belong to its orientation_id {identity}, the file was changed'
        )
    return orientation
