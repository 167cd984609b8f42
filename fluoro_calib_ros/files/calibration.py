"""The calibration file DIR/<fluoroscope>.calibration.npz, described in docs/calibration_file.md."""

import io
import os
import zipfile
import zlib
from dataclasses import dataclass

import numpy as np

from ..calibration.result import FluoroscopeCalibration
from ..distortion.models import CorrectionModel
from ..distortion.series import packed, unpacked
from ..photogrammetry.observations import DataError
from .access import cause_of, check_safe_name, make_folder, read_bytes
from .atomic import atomic_file

VERSION = 2   # of the layout
READABLE = (1, 2)   # version 1 knew no series
SUFFIX = '.calibration.npz'
_DATE = (1980, 1, 1, 0, 0, 0)   # of every member: the same calibration gives the same bytes


@dataclass(frozen=True)
class Field:
    """What an array of the file must be: dtype 'text', 'int', 'float' or 'bool'; shape, a letter for any length;
    least: smallest value, and special: values besides finite ones ('inf' or 'nan') that it may have."""

    dtype: str
    shape: tuple = ()
    least: float | None = None
    special: str = ''


FIELDS = {
    'fluoroscope': Field('text'),
    'calibration_id': Field('text'),
    'image_size': Field('int', (2,), least=1),
    'interior': Field('float', (3,)),
    'interior_covariance': Field('float', (3, 3)),
    'interior_estimated': Field('bool'),
    'model_kind': Field('text'),
    'model_k': Field('int', least=0),
    'train_uv': Field('float', ('N', 2)),
    'train_duv': Field('float', ('N', 2)),
    'train_exposure': Field('int', ('N',), least=0),
    'noise_px': Field('float', least=0),
    'bias_px': Field('float', least=0),
    'series_degree': Field('int', least=-1),
    'series_modes': Field('int', least=0),
    'series_coefficients': Field('float', (2, 'M')),
    'series_sd': Field('float', ('S', 'S'), least=0),
    'image_sd': Field('float', least=0),
    'sigma0': Field('float', least=0),
    'nu': Field('float', least=0, special='inf'),
    'exposures': Field('int', least=0),
    'observations': Field('int', least=0),
    'inliers': Field('int', least=0),
    'rmse_before': Field('float', (2,), least=0, special='nan'),
    'rmse_after': Field('float', (2,), least=0, special='nan'),
    'cost_adjustment': Field('float', special='nan'),
    'cost_regression': Field('float', special='nan'),
    'iterations': Field('int', least=0),
    'converged': Field('bool'),
    'stamp_ns': Field('int'),
    'frame_id': Field('text'),
    'source_digest': Field('text'),
}
_DTYPES = {'int': np.dtype('<i8'), 'float': np.dtype('<f8'), 'bool': np.dtype('?')}
_SERIES = ('series_degree', 'series_modes', 'series_coefficients', 'series_sd')
_OF_MODEL = {'model_kind': 'kind', 'model_k': 'k', 'train_uv': 'train_uv', 'train_duv': 'train_duv',
             'noise_px': 'noise_px', 'bias_px': 'bias_px'}   # array: attribute of the CorrectionModel


def calibration_path(directory, fluoroscope):
    """Path of the calibration file of a fluoroscope in a directory. Raises DataError for an unsafe name."""
    check_safe_name(fluoroscope, directory)
    return os.path.join(directory, fluoroscope + SUFFIX)


def save_calibration(directory, calibration):
    """Write a FluoroscopeCalibration to directory, which is made where it is missing; returns the path.

    The same calibration gives the same bytes; its `seconds` are not kept. Raises DataError where it cannot be
    written or holds something that could not be read again; a file that was there is then left as it was.
    """
    path = calibration_path(directory, calibration.fluoroscope)
    arrays = {name: _array(path, name, _value_of(calibration, name)) for name in FIELDS}
    _check_lengths(path, arrays)
    make_folder(directory)
    with atomic_file(path) as file, zipfile.ZipFile(file, 'w', zipfile.ZIP_STORED) as archive:
        _write_member(archive, 'format_version', np.array(VERSION, dtype=_DTYPES['int']))
        for name, array in arrays.items():
            _write_member(archive, name, array)
    return path


def load_calibration(path):
    """The FluoroscopeCalibration in a file, equal to the saved one to the last bit; its seconds are NaN.

    Raises DataError for a file that is no calibration, is damaged, or has a layout this program does not know.
    """
    content = read_bytes(path)
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            arrays = _read_arrays(path, archive)
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError):   # last: unknown compression
        raise DataError(f'{path}: this is not a calibration file, or it is damaged') from None
    checked = {name: _checked(path, name, arrays[name], field) for name, field in FIELDS.items()}
    _check_lengths(path, checked)
    return _calibration(path, checked)


def load_calibrations(directory):
    """All calibrations {fluoroscope: FluoroscopeCalibration} in a directory, by name. Raises DataError, also
    where there is none."""
    try:
        names = sorted(name for name in os.listdir(directory) if name.endswith(SUFFIX) and name[0] != '.')
    except FileNotFoundError:
        raise DataError(f'{directory}: there is no such folder') from None
    except NotADirectoryError:
        raise DataError(f'{directory}: this is a file, not a folder with calibrations') from None
    except OSError as error:
        raise DataError(f'{directory}: cannot be read ({cause_of(error)})') from None
    if not names:
        raise DataError(f'{directory}: there is no calibration in this folder (no file *{SUFFIX})')
    out = {}
    for name in names:
        path = os.path.join(directory, name)
        calibration = load_calibration(path)
        if calibration.fluoroscope + SUFFIX != name:
            raise DataError(f'{path}: this is the calibration of fluoroscope {calibration.fluoroscope}, '
                            f'its file is called {calibration.fluoroscope + SUFFIX}')
        out[calibration.fluoroscope] = calibration
    return out


def _value_of(calibration, name):
    if name in _SERIES:
        return packed(calibration.model.series)[_SERIES.index(name)]
    if name in _OF_MODEL:
        return getattr(calibration.model, _OF_MODEL[name])
    return getattr(calibration, name)


def _array(path, name, value):
    """value as the array that is written, checked as it will be when it is read."""
    field = FIELDS[name]
    if field.dtype == 'text':
        return _checked(path, name, np.array(str(value)), field)
    array = np.asarray(value)
    if name == 'train_exposure' and array.size == 0:
        array = array.astype(np.int64)
    if array.dtype.kind in 'iub' and field.dtype in ('int', 'float') or array.dtype.kind == field.dtype[0]:
        array = array.astype(_DTYPES[field.dtype])
    return _checked(path, name, np.ascontiguousarray(array).reshape(array.shape), field)


def _write_member(archive, name, array):
    info = zipfile.ZipInfo(f'{name}.npy', date_time=_DATE)
    info.create_system, info.external_attr = 3, 0o644 << 16   # the same on every system
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, array, version=(1, 0), allow_pickle=False)
    archive.writestr(info, buffer.getvalue())


def _read_arrays(path, archive):
    """The arrays of an archive by name, their version checked first; CRC of every member checked."""
    names = archive.namelist()
    if 'format_version.npy' not in names:
        raise DataError(f'{path}: this is not a calibration file, it has no array format_version')
    version = _read_member(path, archive, 'format_version')
    if version.shape != () or version.dtype.kind not in 'iu':
        raise DataError(f'{path}: this is not a calibration file, its format_version is not a whole number')
    if version not in READABLE:
        raise DataError(f'{path}: the file has layout version {int(version)}, '
                        f'this program knows versions {READABLE[0]} to {READABLE[-1]}')
    known = dict(zip(_SERIES, map(np.asarray, packed(None)))) if version == 1 else {}
    missing = [name for name in FIELDS if f'{name}.npy' not in names and name not in known]
    if missing:
        raise DataError(f'{path}: the calibration has no array {missing[0]}')
    return {name: known[name] if name in known else _read_member(path, archive, name) for name in FIELDS}


def _read_member(path, archive, name):
    content = archive.read(f'{name}.npy')
    try:
        return np.lib.format.read_array(io.BytesIO(content), allow_pickle=False)
    except (ValueError, EOFError, MemoryError, OverflowError, TypeError, SyntaxError):
        raise DataError(f'{path}: the array {name} is not one of plain numbers or text, '
                        f'and nothing else is read') from None


def _checked(path, name, array, field):
    """array, if it is what field says. Raises DataError."""
    wanted = 'text' if field.dtype == 'text' else _DTYPES[field.dtype]
    if array.dtype.kind != 'U' if wanted == 'text' else array.dtype != wanted:
        raise DataError(f'{path}: the array {name} has dtype {array.dtype}, not {wanted}')
    shape = field.shape
    if array.ndim != len(shape) or any(
            want != have and isinstance(want, int) for want, have in zip(shape, array.shape)):
        raise DataError(f'{path}: the array {name} has shape {array.shape}, '
                        f'not ({", ".join(map(str, shape))})')
    if field.dtype == 'float':
        good = np.isfinite(array)
        good |= {'inf': array == np.inf, 'nan': np.isnan(array), '': False}[field.special]
        if not good.all():
            raise DataError(f'{path}: the array {name} holds {array[~good].flat[0]}, which is not a finite number')
    if field.least is not None and (array < field.least).any():
        raise DataError(f'{path}: the array {name} holds {array.min()}, which is below {field.least}')
    return array


def _check_lengths(path, arrays):
    lengths = {name: len(arrays[name]) for name in ('train_uv', 'train_duv', 'train_exposure')}
    if len(set(lengths.values())) > 1:
        said = ', '.join(f'{name} {length}' for name, length in lengths.items())
        raise DataError(f'{path}: the training arrays differ in length ({said})')


def _calibration(path, arrays):
    values = {name: array.item() if array.ndim == 0 else array for name, array in arrays.items()}
    identity, values['image_size'] = values.pop('calibration_id'), tuple(values['image_size'].tolist())
    check_safe_name(values['fluoroscope'], path)
    model = {_OF_MODEL[name]: values.pop(name) for name in _OF_MODEL}
    series = [values.pop(name) for name in _SERIES]
    try:
        model['series'] = unpacked(values['image_size'], *series)
        calibration = FluoroscopeCalibration(model=CorrectionModel(**model), **values)
    except ValueError as error:
        raise DataError(f'{path}: {error}') from None
    if calibration.calibration_id != identity:
        raise DataError(f'{path}: the content does not belong to its calibration_id {identity}, '
                        f'the file was changed')
    return calibration
