# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""FluoroscopeCalibration: interior orientation and correction model, to the last bit."""

from __future__ import annotations

from typing import Any

import numpy as np
from fluoro_calib_msgs.msg import FluoroscopeCalibration
from rclpy.serialization import deserialize_message

from ...bags.definitions import FLUOROSCOPE_CALIBRATION, present_cdr
from ...calibration import result as calibration_result
from ...distortion.angle_field import PACKED_SHAPES, AngleField, packed_angles, unpacked_angles
from ...distortion.base import CorrectionModel
from ...distortion.registry import model_from_arrays
from ...distortion.series import SD_GRID
from ...errors import DataError
from ...files.calibration import check_model_content, validated_arrays
from ...photogrammetry.noise_profile import NoiseProfile, packed_profile, unpacked_profile
from ..runtime.stream_reader import DECODING_ERRORS
from .fields import (
    float64_field,
    nanoseconds_from_stamp,
    stamp_from_nanoseconds,
    uint32_field,
)

# Fields with the same name and content in message and calibration.
SAME_NAME = (
    'fluoroscope',
    'interior_estimated',
    'image_sd',
    'sigma0',
    'nu',
    'exposures',
    'observations',
    'inliers',
    'cost_adjustment',
    'cost_regression',
    'iterations',
    'converged',
    'seconds',
    'source_digest',
)
ANGLES = ('angles', 'angle_coefficients', 'angle_variances')


def decode_fluoroscope_calibration(data: bytes) -> FluoroscopeCalibration:
    """Read a message from its bytes, also one of an earlier definition.

    Raises one of DECODING_ERRORS for damaged bytes.
    """
    try:
        return deserialize_message(data, FluoroscopeCalibration)
    except DECODING_ERRORS:
        return deserialize_message(
            present_cdr(bytes(data), FLUOROSCOPE_CALIBRATION), FluoroscopeCalibration
        )


def message_from_calibration(
    calibration: calibration_result.FluoroscopeCalibration,
) -> FluoroscopeCalibration:
    """Return the message of a calibration."""
    message = FluoroscopeCalibration()
    message.header.stamp = stamp_from_nanoseconds(calibration.stamp_ns)
    message.header.frame_id = calibration.frame_id
    message.image_width, message.image_height = calibration.image_size
    message.xp, message.yp, message.c = (float(x) for x in calibration.interior)
    message.interior_covariance = np.asarray(calibration.interior_covariance, dtype=float).ravel()
    message.train_exposure = uint32_field(calibration.train_exposure)
    _set_model(message, calibration.model)
    message.rmse_before_u, message.rmse_before_v = (float(x) for x in calibration.rmse_before)
    message.rmse_after_u, message.rmse_after_v = (float(x) for x in calibration.rmse_after)
    for name in SAME_NAME:
        setattr(message, name, getattr(calibration, name))
    for name, values in zip(ANGLES, packed_angles(calibration.angle_field), strict=True):
        setattr(message, name, float64_field(values.ravel()))
    message.noise_profile = float64_field(packed_profile(calibration.noise_profile))
    message.calibration_id = calibration.calibration_id
    return message


def calibration_from_message(
    message: FluoroscopeCalibration,
) -> calibration_result.FluoroscopeCalibration:
    """Return the calibration of a message, identical to the one that was sent.

    Raises DataError where the message holds no valid calibration, or not the one its id says.
    """
    calibration = content_of_calibration(message)
    if calibration.calibration_id != message.calibration_id:
        raise DataError(
            f'calibration of fluoroscope {message.fluoroscope}: its content does not match its id '
            f'{message.calibration_id}'
        )
    return calibration


def content_of_calibration(
    message: FluoroscopeCalibration,
) -> calibration_result.FluoroscopeCalibration:
    """Return the calibration of a message, whatever its id says. Raises DataError."""
    where = f'calibration of fluoroscope {message.fluoroscope}'
    calibration = calibration_result.FluoroscopeCalibration(
        image_size=(message.image_width, message.image_height),
        interior=np.array([message.xp, message.yp, message.c]),
        interior_covariance=np.array(message.interior_covariance).reshape(3, 3),
        model=_model_of(message, where),
        train_exposure=np.array(message.train_exposure, dtype=np.int64),
        rmse_before=np.array([message.rmse_before_u, message.rmse_before_v]),
        rmse_after=np.array([message.rmse_after_u, message.rmse_after_v]),
        stamp_ns=nanoseconds_from_stamp(message.header.stamp),
        frame_id=message.header.frame_id,
        angle_field=_angle_field_of(message, where),
        noise_profile=_noise_profile_of(message, where),
        **{name: getattr(message, name) for name in SAME_NAME},
    )
    validated_arrays(where, calibration)
    return calibration


def _set_model(message: FluoroscopeCalibration, model: CorrectionModel) -> None:
    """Fill in the correction model."""
    content = model.to_arrays()
    message.model_kind = content['kind']
    message.k = content['k']
    message.model_noise = content['noise_px']
    message.model_bias = content['bias_px']
    message.train_u = float64_field(content['train_uv'][:, 0])
    message.train_v = float64_field(content['train_uv'][:, 1])
    message.train_du = float64_field(content['train_duv'][:, 0])
    message.train_dv = float64_field(content['train_duv'][:, 1])
    message.series_degree = content['series_degree']
    message.series_modes = content['series_modes']
    message.series_u = float64_field(content['series_coefficients'][0])
    message.series_v = float64_field(content['series_coefficients'][1])
    message.series_sd = float64_field(content['series_sd'])


def _model_of(message: FluoroscopeCalibration, where: str) -> CorrectionModel:
    """Return the correction model of a message. Raises DataError, beginning with `where`."""
    train = [
        np.array(field)
        for field in (message.train_u, message.train_v, message.train_du, message.train_dv)
    ]
    if len({len(field) for field in train} | {len(message.train_exposure)}) != 1:
        raise DataError(
            f'{where}: its training points have different numbers of coordinates and corrections'
        )
    try:
        content = {
            'kind': message.model_kind,
            'k': message.k,
            'train_uv': np.stack(train[:2], axis=1),
            'train_duv': np.stack(train[2:], axis=1),
            'noise_px': message.model_noise,
            'bias_px': message.model_bias,
            **_series_content(message),
        }
        size = (message.image_width, message.image_height)
        check_model_content(where, content, size)
        return model_from_arrays(content, size)
    except DataError:
        raise
    except ValueError as error:
        raise DataError(f'{where}: {error}') from None


def _series_content(message: FluoroscopeCalibration) -> dict[str, Any]:
    """Return the series of a message as `CorrectionModel.to_arrays` has it. Raises ValueError."""
    if len(message.series_u) != len(message.series_v):
        raise ValueError('its series has different numbers of coefficients in u and in v')
    sd = np.array(message.series_sd)
    return {
        'series_degree': message.series_degree,
        'series_modes': message.series_modes,
        'series_coefficients': np.array([message.series_u, message.series_v]),
        'series_sd': sd.reshape(SD_GRID, SD_GRID) if len(sd) == SD_GRID**2 else sd[None],
    }


def _angle_field_of(message: FluoroscopeCalibration, where: str) -> AngleField | None:
    """Return the angle field of a message, if any. Raises DataError, beginning with `where`."""
    arrays = [np.array(getattr(message, name), dtype=float) for name in ANGLES]
    if not any(map(len, arrays)):
        return None
    for name, values, shape in zip(ANGLES, arrays, PACKED_SHAPES, strict=True):
        if shape is not None and len(values) != np.prod(shape):
            raise DataError(
                f'{where}: {name} has {len(values)} values, {np.prod(shape)} are expected'
            )
    shaped = [a if shape is None else a.reshape(shape) for a, shape in zip(arrays, PACKED_SHAPES)]
    try:
        return unpacked_angles((message.image_width, message.image_height), *shaped)
    except ValueError as error:
        raise DataError(f'{where}: {error}') from None


def _noise_profile_of(message: FluoroscopeCalibration, where: str) -> NoiseProfile | None:
    """Return the noise profile of a message, if any. Raises DataError, beginning with `where`."""
    try:
        return unpacked_profile(np.array(message.noise_profile, dtype=float))
    except ValueError as error:
        raise DataError(f'{where}: {error}') from None
