# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The calibration file DIR/<fluoroscope>.calibration.npz; see docs/calibration_file.md."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ..calibration.result import FluoroscopeCalibration
from ..distortion.angle_field import packed_angles, unpacked_angles
from ..distortion.registry import model_from_arrays
from ..distortion.series import MAX_DEGREE, MAX_MODES, packed
from ..errors import DataError
from ..exposures.frame import MAX_ANGLE
from ..limits import (
    MAX_ANGLES,
    MAX_COINCIDENT,
    MAX_IMAGE_SIDE,
    MAX_NEIGHBOURS,
    MAX_PRINCIPAL_DISTANCE_PX,
    MAX_PX,
    read_limits,
)
from ..photogrammetry.noise_profile import packed_profile, unpacked_profile
from .access import PathLike, check_safe_name, make_folder, os_error_reason
from .arrays import ArraySpec, Layout, read_arrays, to_arrays, to_values, write_arrays

SUFFIX = '.calibration.npz'

ARRAYS = {
    'fluoroscope': ArraySpec('text'),
    'calibration_id': ArraySpec('text'),
    'image_size': ArraySpec('int', (2,), minimum=1, maximum=MAX_IMAGE_SIDE),
    'interior': ArraySpec('float', (3,), maximum=MAX_PRINCIPAL_DISTANCE_PX),
    'interior_covariance': ArraySpec('float', (3, 3), maximum=MAX_PRINCIPAL_DISTANCE_PX**2),
    'interior_estimated': ArraySpec('bool'),
    'model_kind': ArraySpec('text'),
    'model_k': ArraySpec('int', minimum=0, maximum=MAX_NEIGHBOURS),
    'train_uv': ArraySpec('float', ('N', 2), maximum=MAX_PX),
    'train_duv': ArraySpec('float', ('N', 2), maximum=MAX_PX),
    'train_exposure': ArraySpec('int', ('N',), minimum=0),
    'noise_px': ArraySpec('float', minimum=0, maximum=MAX_PX),
    'bias_px': ArraySpec('float', minimum=0, maximum=MAX_PX),
    'series_degree': ArraySpec('int', minimum=-1, maximum=MAX_DEGREE),
    'series_modes': ArraySpec('int', minimum=0, maximum=MAX_MODES),
    'series_coefficients': ArraySpec('float', (2, 'M'), maximum=MAX_PX),
    'series_sd': ArraySpec('float', ('S', 'S'), minimum=0, maximum=MAX_PX),
    'image_sd': ArraySpec('float', minimum=0, maximum=MAX_PX),
    'sigma0': ArraySpec('float', minimum=0, maximum=MAX_PX),
    'nu': ArraySpec('float', minimum=0, allowed='inf'),
    'exposures': ArraySpec('int', minimum=0),
    'observations': ArraySpec('int', minimum=0),
    'inliers': ArraySpec('int', minimum=0),
    'rmse_before': ArraySpec('float', (2,), minimum=0, allowed='nan'),
    'rmse_after': ArraySpec('float', (2,), minimum=0, allowed='nan'),
    'cost_adjustment': ArraySpec('float', allowed='nan'),
    'cost_regression': ArraySpec('float', allowed='nan'),
    'iterations': ArraySpec('int', minimum=0),
    'converged': ArraySpec('bool'),
    'stamp_ns': ArraySpec('int'),
    'frame_id': ArraySpec('text'),
    'source_digest': ArraySpec('text'),
    'angles': ArraySpec('float', ('A',), maximum=MAX_ANGLE, longest=MAX_ANGLES),
    'angle_coefficients': ArraySpec('float', ('H', 2, 'T'), maximum=MAX_PX),
    'angle_variances': ArraySpec('float', ('V', 'G', 'G'), maximum=MAX_PX**2),
    'noise_profile': ArraySpec('float', ('P',), minimum=0, maximum=MAX_PX, longest=3),
}
COINCIDENT_PX = 1e-3
_ANGLES = ('angles', 'angle_coefficients', 'angle_variances')
_SERIES = ('series_degree', 'series_modes', 'series_coefficients', 'series_sd')
# Array of the file: entry of CorrectionModel.to_arrays.
_MODEL_ENTRIES = {
    'model_kind': 'kind',
    'model_k': 'k',
    **{name: name for name in ('train_uv', 'train_duv', 'noise_px', 'bias_px', *_SERIES)},
}
_NO_PROFILE = {'noise_profile': packed_profile(None)}
_NO_ANGLES = {**dict(zip(_ANGLES, packed_angles(None))), **_NO_PROFILE}
LAYOUT = Layout(
    'a calibration',
    ARRAYS,
    version=4,
    readable=(1, 2, 3, 4),
    # Version 1 did not have a series, version 2 no angles, version 3 no noise profile.
    defaults={
        1: {**dict(zip(_SERIES, map(np.asarray, packed(None)))), **_NO_ANGLES},
        2: _NO_ANGLES,
        3: _NO_PROFILE,
    },
)


def calibration_path(directory: PathLike, fluoroscope: str) -> str:
    """Return the path of the calibration file of a fluoroscope. Raises DataError for its name."""
    check_safe_name(fluoroscope, directory)
    return os.path.join(directory, fluoroscope + SUFFIX)


def save_calibration(directory: PathLike, calibration: FluoroscopeCalibration) -> str:
    """Write a calibration into a folder, which is created where it is missing.

    Returns the path. The same calibration gives the same bytes; its `seconds` are not saved.
    Raises DataError where the file cannot be written, or could not be read again; an earlier file
    is then unchanged.
    """
    path = calibration_path(directory, calibration.fluoroscope)
    arrays = validated_arrays(path, calibration)
    make_folder(directory)
    write_arrays(path, LAYOUT, arrays)
    return path


def validated_arrays(where: object, calibration: FluoroscopeCalibration) -> dict[str, np.ndarray]:
    """Return the arrays of a calibration as its file contains them.

    where begins the message of the DataError that is raised for a value that a calibration cannot
    have, such as NaN.
    """
    model = calibration.model.to_arrays()
    values = dict(zip(_ANGLES, packed_angles(calibration.angle_field)))
    values['noise_profile'] = packed_profile(calibration.noise_profile)
    values |= {
        name: model[_MODEL_ENTRIES[name]] if name in _MODEL_ENTRIES else getattr(calibration, name)
        for name in ARRAYS
        if name not in values
    }
    if not len(calibration.train_exposure):
        values['train_exposure'] = np.zeros(0, dtype=np.int64)  # an empty list would be float
    arrays = to_arrays(where, LAYOUT, values)
    _check_content(where, arrays)
    return arrays


def check_model_content(
    where: object, content: Mapping[str, Any], image_size: tuple[int, int]
) -> None:
    """Raise DataError for the content of a model that no file could have, before it is made.

    content: as `CorrectionModel.to_arrays` gives it; where begins the message.
    """
    values = {name: content[entry] for name, entry in _MODEL_ENTRIES.items()}
    values['image_size'] = image_size
    layout = replace(LAYOUT, arrays={name: ARRAYS[name] for name in values})
    arrays = to_arrays(where, layout, values)
    arrays['train_exposure'] = arrays['train_uv']  # of equal length, as was checked
    _check_content(where, arrays)


def load_calibration(path: PathLike) -> FluoroscopeCalibration:
    """Read a calibration, which is equal to the saved one to the last bit; its seconds are NaN.

    The file of an earlier version may have the id that it gave; the calibration has that of this
    version. Raises DataError for a file that is not a calibration, is damaged, or has a version of
    the layout that is not known.
    """
    return read_with_id(path)[0]


def read_with_id(path: PathLike) -> tuple[FluoroscopeCalibration, str]:
    """Read a calibration as `load_calibration` does, and the id that its file has."""
    arrays = read_arrays(path, LAYOUT)
    _check_content(path, arrays)
    values = to_values(arrays)
    identity = values.pop('calibration_id')
    width, height = values['image_size'].tolist()
    values['image_size'] = (width, height)
    check_safe_name(values['fluoroscope'], path)
    content = {entry: values.pop(name) for name, entry in _MODEL_ENTRIES.items()}
    try:
        model = model_from_arrays(content, values['image_size'])
        field = unpacked_angles(values['image_size'], *(values.pop(name) for name in _ANGLES))
        profile = unpacked_profile(values.pop('noise_profile'))
    except ValueError as error:
        raise DataError(f'{path}: {error}') from None
    calibration = FluoroscopeCalibration(
        model=model, angle_field=field, noise_profile=profile, **values
    )
    if identity not in (calibration.calibration_id, calibration.earlier_id):
        raise DataError(
            f'{path}: the content does not belong to its calibration_id {identity}, '
            f'the file was changed'
        )
    return calibration, identity


def load_calibrations(directory: PathLike) -> dict[str, FluoroscopeCalibration]:
    """Read all calibrations in a folder, sorted by fluoroscope.

    Raises DataError, also for a folder without calibrations.
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
        expected = calibration.fluoroscope + SUFFIX
        if name != expected:
            raise DataError(
                f'{path}: this is the calibration of fluoroscope {calibration.fluoroscope}, '
                f'its file is called {expected}'
            )
        out[calibration.fluoroscope] = calibration
    return out


def _check_content(where: object, arrays: Mapping[str, Any]) -> None:
    """Raise DataError for training arrays of different lengths, and for impossible sizes."""
    lengths = {name: len(arrays[name]) for name in ('train_uv', 'train_duv', 'train_exposure')}
    if len(set(lengths.values())) > 1:
        listed = ', '.join(f'{name} {length}' for name, length in lengths.items())
        raise DataError(f'{where}: the training arrays differ in length ({listed})')
    limits = read_limits()
    if lengths['train_uv'] > limits.max_training_points:
        raise DataError(
            f'{where}: {lengths["train_uv"]} training points, more than '
            f'{limits.max_training_points} are not read'
        )
    if _largest_heap(arrays['train_uv']) > MAX_COINCIDENT:
        raise DataError(
            f'{where}: more than {MAX_COINCIDENT} training points lie on one place of the image'
        )
    c = arrays['interior'][2] if 'interior' in arrays else 1.0
    if c <= 0:
        raise DataError(f'{where}: the principal distance is {c:g} px')
    width, height = arrays['image_size'].tolist()
    if width * height > limits.max_pixels:
        raise DataError(
            f'{where}: the images have {width} x {height} px, those of more than '
            f'{limits.max_image_megapixels} megapixels are not read'
        )


def _largest_heap(uv: np.ndarray) -> int:
    """Return the largest number of points (n, 2) in one cell: no search tree can divide them."""
    if not len(uv):
        return 0
    column, row = np.floor(uv / COINCIDENT_PX).astype(np.int64).T
    keys = np.sort(column * 2**32 + row)
    ends = np.flatnonzero(np.diff(keys, append=keys[-1] + 1))
    return int(np.diff(ends, prepend=-1).max())
