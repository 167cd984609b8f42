# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Files of named arrays: .npz archives as numpy.savez writes them, but validated and repeatable.

Nothing is unpickled. Data type, shape, finiteness and range of every array and the CRC of every
member are validated on reading; the arrays are also validated on writing. The same arrays give the
same bytes.
"""

from __future__ import annotations

import io
import struct
import sys
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..correction.calibration_record import Field
from ..errors import DataError
from ..limits import read_limits
from .access import PathLike, atomic_file, check_layout_version, read_bytes

_DTYPES = {'int': np.dtype('<i8'), 'float': np.dtype('<f8'), 'bool': np.dtype('?')}


@dataclass(frozen=True)
class Layout:
    """Layout of a file."""

    content: str  #: content of the file, with an article, such as 'a calibration'
    fields: Sequence[Field]  #: its arrays
    version: int  #: version that is written; all earlier ones can be read


def to_arrays(where: object, layout: Layout, values: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return values as the arrays that a file of this layout contains.

    Raises DataError, whose message begins with where, for a value that could not be read again.
    """
    return {field.name: _to_array(where, values[field.name], field) for field in layout.fields}


def to_values(arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return arrays with zero-dimensional ones converted to Python numbers and text."""
    return {name: array.item() if array.ndim == 0 else array for name, array in arrays.items()}


def write_arrays(path: PathLike, layout: Layout, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays returned by `to_arrays`.

    Raises DataError if the file cannot be written; an earlier file is then unchanged.
    """
    version = np.array(layout.version, dtype=_DTYPES['int'])
    with atomic_file(path) as file, zipfile.ZipFile(file, 'w', zipfile.ZIP_STORED) as archive:
        _write_member(archive, 'format_version', version)
        for name, array in arrays.items():
            _write_member(archive, name, array)


def read_arrays(path: PathLike, layout: Layout) -> dict[str, np.ndarray]:
    """Read the arrays of a file.

    Raises DataError for a file of another kind, a damaged file, an unknown version of the layout,
    and an array that does not meet its requirements.
    """
    content = read_bytes(path)
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            arrays = _read_members(path, archive, layout)
    except DataError:
        raise
    except (
        zipfile.BadZipFile,
        zlib.error,
        EOFError,
        OSError,
        RuntimeError,  # unknown compression
        ValueError,  # offsets before the file, names that are not text
        struct.error,
    ):
        raise DataError(f'{path}: this is not {layout.content} file, or it is damaged') from None
    for field in layout.fields:
        _validate(path, arrays[field.name], field)
    return arrays


def _to_array(where: object, value: Any, spec: Field) -> np.ndarray:
    array = np.asarray(value)
    if spec.dtype == 'text':
        array = array.astype(str)
    else:
        is_whole = array.dtype.kind in 'iub' and spec.dtype in ('int', 'float')
        if is_whole or array.dtype.kind == spec.dtype[0]:
            array = array.astype(_DTYPES[spec.dtype])
        array = np.ascontiguousarray(array).reshape(array.shape)
    _validate(where, array, spec)
    return array


def _write_member(archive: zipfile.ZipFile, name: str, array: np.ndarray) -> None:
    info = zipfile.ZipInfo(f'{name}.npy')  # dated 1980: the same arrays give the same bytes
    info.create_system = 3  # Unix, on every system
    info.external_attr = 0o644 << 16
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, array, version=(1, 0), allow_pickle=False)
    archive.writestr(info, buffer.getvalue())


def _read_members(
    path: PathLike, archive: zipfile.ZipFile, layout: Layout
) -> dict[str, np.ndarray]:
    """Return the arrays of an archive, after checking its version."""
    members = archive.namelist()
    size = sum(info.file_size for info in archive.infolist())
    limits = read_limits()
    if size > limits.max_file_bytes:
        raise DataError(
            f'{path}: its arrays take {size / 1e6:.0f} MB; the limit is {limits.max_file_mb} MB'
        )
    version = _read_version(path, archive, layout)
    for field in layout.fields:
        if field.since <= version and f'{field.name}.npy' not in members:
            noun = layout.content.partition(' ')[2]
            raise DataError(f'{path}: the {noun} has no array {field.name}')
    return {
        field.name: _read_member(path, archive, field.name)
        if field.since <= version
        else field.before
        for field in layout.fields
    }


def _read_version(path: PathLike, archive: zipfile.ZipFile, layout: Layout) -> int:
    """Return the version of the layout. Raises DataError for an unknown version."""
    if 'format_version.npy' not in archive.namelist():
        raise DataError(
            f'{path}: this is not {layout.content} file, it has no array format_version'
        )
    version = _read_member(path, archive, 'format_version')
    if version.shape != () or version.dtype.kind not in 'iu':
        raise DataError(
            f'{path}: this is not {layout.content} file, its format_version is not an integer'
        )
    check_layout_version(path, int(version), layout.version)
    return int(version)


def _read_member(path: PathLike, archive: zipfile.ZipFile, name: str) -> np.ndarray:
    """Return an array of an archive. Raises DataError unless it contains plain numbers or text."""
    info = archive.getinfo(f'{name}.npy')
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise DataError(f'{path}: the array {name} is compressed in a way that numpy does not use')
    content = archive.read(info)
    stream = io.BytesIO(content)
    try:
        array = np.lib.format.read_array(stream, allow_pickle=False)
        if array.dtype.kind not in 'biufU' or not array.itemsize or stream.tell() < len(content):
            raise ValueError
        if array.dtype.kind == 'U':
            codes = np.frombuffer(array.tobytes(), f'{array.dtype.str[0]}u4')
            is_surrogate = (codes >> 11) == 0xD800 >> 11
            if ((codes > sys.maxunicode) | is_surrogate).any():  # not valid characters
                raise ValueError
    except Exception:  # numpy evaluates the header as Python, which raises almost anything
        raise DataError(
            f'{path}: the array {name} does not contain plain numbers or text, only these are read'
        ) from None
    return array.astype(array.dtype.newbyteorder('='))  # a writable copy


def _validate(where: object, array: np.ndarray, spec: Field) -> None:
    """Raise DataError, whose message begins with where, for an array that is not as required."""
    name = spec.name
    if spec.dtype == 'text':
        is_expected = array.dtype.kind == 'U'
    else:
        is_expected = array.dtype == _DTYPES[spec.dtype]
    if not is_expected:
        expected = _DTYPES.get(spec.dtype, spec.dtype)
        raise DataError(f'{where}: the array {name} has dtype {array.dtype}, not {expected}')
    if len(array.shape) != len(spec.shape) or any(
        isinstance(length, int) and length != actual
        for length, actual in zip(spec.shape, array.shape)
    ):
        shape = ', '.join(map(str, spec.shape))
        raise DataError(f'{where}: the array {name} has shape {array.shape}, not ({shape})')
    if spec.longest is not None and max(array.shape, default=0) > spec.longest:
        raise DataError(
            f'{where}: the array {name} has shape {array.shape}, lengths above {spec.longest} are '
            'not read'
        )
    if spec.dtype == 'float':
        valid = np.isfinite(array)
        if spec.allowed == 'inf':
            valid = valid | (array == np.inf)
        elif spec.allowed == 'nan':
            valid = valid | np.isnan(array)
        if not valid.all():
            raise DataError(
                f'{where}: the array {name} holds {array[~valid].flat[0]}, '
                f'which is not a finite number'
            )
    if spec.minimum is not None and (array < spec.minimum).any():
        raise DataError(
            f'{where}: the array {name} holds {array.min()}, which is below {spec.minimum}'
        )
    if spec.maximum is not None and (np.abs(array[np.isfinite(array)]) > spec.maximum).any():
        raise DataError(f'{where}: the array {name} holds a value beyond {spec.maximum:g}')
