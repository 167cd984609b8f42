"""The calibration file DIR/<fluoroscope>.calibration.npz, described in docs/calibration_file.md."""

import os

import numpy as np

from ..calibration.result import FluoroscopeCalibration
from ..distortion.registry import model_from_arrays
from ..distortion.series import packed
from ..errors import DataError
from .access import check_safe_name, make_folder, os_error_reason
from .arrays import Field, array_of, read_arrays, values_of, write_arrays

VERSION = 2  # of the layout
READABLE = (1, 2)  # version 1 knew no series
SUFFIX = '.calibration.npz'

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
_SERIES = ('series_degree', 'series_modes', 'series_coefficients', 'series_sd')
# Array of the file: entry of CorrectionModel.to_arrays.
_OF_MODEL = {
    'model_kind': 'kind',
    'model_k': 'k',
    **{name: name for name in ('train_uv', 'train_duv', 'noise_px', 'bias_px', *_SERIES)},
}


def calibration_path(directory, fluoroscope):
    """Path of the calibration file of a fluoroscope in a directory. Raises DataError for an unsafe
    name.
    """
    check_safe_name(fluoroscope, directory)
    return os.path.join(directory, fluoroscope + SUFFIX)


def save_calibration(directory, calibration):
    """Write a FluoroscopeCalibration to directory, which is made where it is missing; returns the
    path.

    The same calibration gives the same bytes; its `seconds` are not kept. Raises DataError where
    it cannot be written or holds something that could not be read again; a file that was there is
    then left as it was.
    """
    path = calibration_path(directory, calibration.fluoroscope)
    arrays = checked_arrays(path, calibration)
    make_folder(directory)
    write_arrays(path, VERSION, arrays)
    return path


def checked_arrays(where, calibration):
    """The arrays {name: array} of a FluoroscopeCalibration. Raises DataError, beginning with
    where, for one that holds what a calibration cannot hold, such as NaN.
    """
    model = calibration.model.to_arrays()
    arrays = {
        name: array_of(where, name, _value_of(calibration, model, name), field)
        for name, field in FIELDS.items()
    }
    _check_lengths(where, arrays)
    return arrays


def load_calibration(path):
    """The FluoroscopeCalibration in a file, equal to the saved one to the last bit; its seconds
    are NaN.

    Raises DataError for a file that is no calibration, is damaged, or has a layout this program
    does not know.
    """
    without_series = dict(zip(_SERIES, map(np.asarray, packed(None))))
    checked = read_arrays(path, FIELDS, READABLE, 'a calibration', {1: without_series})
    _check_lengths(path, checked)
    return _calibration(path, checked)


def load_calibrations(directory):
    """All calibrations {fluoroscope: FluoroscopeCalibration} in a directory, by name. Raises
    DataError, also where there is none.
    """
    try:
        names = sorted(
            name for name in os.listdir(directory) if name.endswith(SUFFIX) and name[0] != '.'
        )
    except FileNotFoundError:
        raise DataError(f'{directory}: there is no such folder') from None
    except NotADirectoryError:
        raise DataError(f'{directory}: this is a file, not a folder with calibrations') from None
    except OSError as error:
        raise DataError(f'{directory}: cannot be read ({os_error_reason(error)})') from None
    if not names:
        raise DataError(f'{directory}: there is no calibration in this folder (no file *{SUFFIX})')
    out = {}
    for name in names:
        path = os.path.join(directory, name)
        calibration = load_calibration(path)
        if calibration.fluoroscope + SUFFIX != name:
            raise DataError(
                f'{path}: this is the calibration of fluoroscope {calibration.fluoroscope}, '
                f'its file is called {calibration.fluoroscope + SUFFIX}'
            )
        out[calibration.fluoroscope] = calibration
    return out


def _value_of(calibration, model, name):
    if name in _OF_MODEL:
        return model[_OF_MODEL[name]]
    if name == 'train_exposure' and not len(calibration.train_exposure):
        return np.zeros(0, dtype=np.int64)  # an empty list would be one of floats
    return getattr(calibration, name)


def _check_lengths(path, arrays):
    lengths = {name: len(arrays[name]) for name in ('train_uv', 'train_duv', 'train_exposure')}
    if len(set(lengths.values())) > 1:
        said = ', '.join(f'{name} {length}' for name, length in lengths.items())
        raise DataError(f'{path}: the training arrays differ in length ({said})')


def _calibration(path, arrays):
    values = values_of(arrays)
    identity = values.pop('calibration_id')
    values['image_size'] = tuple(values['image_size'].tolist())
    check_safe_name(values['fluoroscope'], path)
    content = {entry: values.pop(name) for name, entry in _OF_MODEL.items()}
    try:
        model = model_from_arrays(content, values['image_size'])
        calibration = FluoroscopeCalibration(model=model, **values)
    except ValueError as error:
        raise DataError(f'{path}: {error}') from None
    if calibration.calibration_id != identity:
        raise DataError(
            f'{path}: the content does not belong to its calibration_id {identity}, '
            f'the file was changed'
        )
    return calibration
