"""Files of named arrays: zip archives of .npy members as numpy.savez writes them, but checked,
whole and repeatable.

Nothing is unpickled. dtype, shape, finiteness and range of every array and the CRC of every member
are checked when it is read, and the same when it is written; the same arrays give the same bytes.
"""

import io
import struct
import zipfile
import zlib
from dataclasses import dataclass

import numpy as np

from ..errors import DataError
from .access import read_bytes
from .atomic import atomic_file

_DATE = (1980, 1, 1, 0, 0, 0)  # of every member: the same arrays give the same bytes
_DTYPES = {'int': np.dtype('<i8'), 'float': np.dtype('<f8'), 'bool': np.dtype('?')}


@dataclass(frozen=True)
class Field:
    """What an array of the file must be: dtype 'text', 'int', 'float' or 'bool'; shape, a letter
    for any length; least: smallest value, and special: values besides finite ones ('inf' or 'nan')
    that it may have.
    """

    dtype: str
    shape: tuple = ()
    least: float | None = None
    special: str = ''


def array_of(path, name, value, field):
    """Value as the array that is written, checked as it will be when it is read. Raises DataError."""
    array = np.asarray(value)
    if field.dtype == 'text':
        return _checked(path, name, array.astype(str), field)
    if (
        array.dtype.kind in 'iub' and field.dtype in ('int', 'float')
    ) or array.dtype.kind == field.dtype[0]:
        array = array.astype(_DTYPES[field.dtype])
    return _checked(path, name, np.ascontiguousarray(array).reshape(array.shape), field)


def write_arrays(path, version, arrays):
    """Write arrays {name: array} as a file of a layout version. Raises DataError where it cannot
    be written; a file that was there is then left as it was.
    """
    with atomic_file(path) as file, zipfile.ZipFile(file, 'w', zipfile.ZIP_STORED) as archive:
        _write_member(archive, 'format_version', np.array(version, dtype=_DTYPES['int']))
        for name, array in arrays.items():
            _write_member(archive, name, array)


def read_arrays(path, fields, readable, what, known=None):
    """The arrays {name: array} of a file, each as its Field in fields {name: Field} says.

    readable: versions of the layout; what: what the file is to be, such as 'a calibration'; known
    {version: {name: array}}: those that an older version does not have. Raises DataError for a
    file that is none, is damaged, or has a layout this program does not know.
    """
    content = read_bytes(path)
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            arrays = _read_members(path, archive, fields, readable, what, known or {})
    except DataError:
        raise
    except (
        zipfile.BadZipFile,
        zlib.error,
        EOFError,
        OSError,
        RuntimeError,
        ValueError,
        struct.error,
    ):
        # RuntimeError: unknown compression; ValueError: places before the file, names that are no
        # text
        raise DataError(f'{path}: this is not {what} file, or it is damaged') from None
    return {name: _checked(path, name, arrays[name], field) for name, field in fields.items()}


def values_of(arrays):
    """The same with numbers and text in place of arrays without dimensions."""
    return {name: array.item() if array.ndim == 0 else array for name, array in arrays.items()}


def _write_member(archive, name, array):
    info = zipfile.ZipInfo(f'{name}.npy', date_time=_DATE)
    # the same on every system
    info.create_system = 3
    info.external_attr = 0o644 << 16
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, array, version=(1, 0), allow_pickle=False)
    archive.writestr(info, buffer.getvalue())


def _read_members(path, archive, fields, readable, what, known):
    """The arrays of an archive by name, their version checked first; CRC of every member checked."""
    names = archive.namelist()
    if 'format_version.npy' not in names:
        raise DataError(f'{path}: this is not {what} file, it has no array format_version')
    version = _read_member(path, archive, 'format_version')
    if version.shape != () or version.dtype.kind not in 'iu':
        raise DataError(
            f'{path}: this is not {what} file, its format_version is not a whole number'
        )
    if version not in readable:
        versions = (
            f'versions {readable[0]} to {readable[-1]}'
            if len(readable) > 1
            else f'version {readable[0]}'
        )
        raise DataError(
            f'{path}: the file has layout version {int(version)}, this program knows {versions}'
        )
    known = known.get(int(version), {})
    missing = [name for name in fields if f'{name}.npy' not in names and name not in known]
    if missing:
        raise DataError(f'{path}: the {what.partition(" ")[2]} has no array {missing[0]}')
    return {
        name: known[name] if name in known else _read_member(path, archive, name)
        for name in fields
    }


def _read_member(path, archive, name):
    content = archive.read(f'{name}.npy')
    try:
        return np.lib.format.read_array(io.BytesIO(content), allow_pickle=False)
    except (ValueError, EOFError, MemoryError, OverflowError, TypeError, SyntaxError):
        raise DataError(
            f'{path}: the array {name} is not one of plain numbers or text, '
            f'and nothing else is read'
        ) from None


def _checked(path, name, array, field):
    """array, if it is what field says. Raises DataError."""
    wanted = 'text' if field.dtype == 'text' else _DTYPES[field.dtype]
    if array.dtype.kind != 'U' if wanted == 'text' else array.dtype != wanted:
        raise DataError(f'{path}: the array {name} has dtype {array.dtype}, not {wanted}')
    shape = field.shape
    if array.ndim != len(shape) or any(
        want != have and isinstance(want, int) for want, have in zip(shape, array.shape)
    ):
        raise DataError(
            f'{path}: the array {name} has shape {array.shape}, not ({", ".join(map(str, shape))})'
        )
    if field.dtype == 'float':
        good = np.isfinite(array)
        good |= {'inf': array == np.inf, 'nan': np.isnan(array), '': False}[field.special]
        if not good.all():
            raise DataError(
                f'{path}: the array {name} holds {array[~good].flat[0]}, which is not a finite number'
            )
    if field.least is not None and (array < field.least).any():
        raise DataError(
            f'{path}: the array {name} holds {array.min()}, which is below {field.least}'
        )
    return array
