"""Messages to frames and calibrations, and back. Arrays are copied in one piece, never element by
element.
"""

from array import array

import numpy as np
from builtin_interfaces.msg import Time
from fluoro_calib_msgs.msg import FluoroscopeCalibration, TargetObservations
from sensor_msgs.msg import CameraInfo

from ..calibration import result as calibration_result
from ..distortion.models import CorrectionModel
from ..distortion.series import SD_GRID, packed, unpacked
from ..errors import DataError
from ..files.calibration import checked_arrays


def to_nanoseconds(stamp):
    """Time message as integer nanoseconds."""
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def to_stamp(nanoseconds):
    """Integer nanoseconds as Time message."""
    return Time(sec=int(nanoseconds // 1_000_000_000), nanosec=int(nanoseconds % 1_000_000_000))


def doubles(values):
    """A float64[] field of an array of any shape."""
    return array('d', np.ascontiguousarray(values, dtype=np.float64).tobytes())


def unsigned(values):
    """A uint32[] field of an array of any shape."""
    return array('I', np.ascontiguousarray(values, dtype=np.uint32).tobytes())


def message_from_frame(frame):
    """TargetObservations message of a Frame."""
    message = TargetObservations()
    message.header.stamp = to_stamp(frame.stamp_ns)
    message.header.frame_id = frame.frame_id
    message.frame_number = frame.number
    message.image_width, message.image_height = frame.image_size
    message.target_id = unsigned(frame.target_id)
    message.u = doubles(frame.uv[:, 0])
    message.v = doubles(frame.uv[:, 1])
    message.sigma = doubles([] if frame.sigma is None else frame.sigma)
    return message


def message_from_calibration(calibration):
    """FluoroscopeCalibration message of a calibration."""
    message = FluoroscopeCalibration()
    model = calibration.model
    message.header.stamp = to_stamp(calibration.stamp_ns)
    message.header.frame_id = calibration.frame_id
    message.image_width, message.image_height = calibration.image_size
    message.xp, message.yp, message.c = (float(x) for x in calibration.interior)
    message.interior_covariance = np.asarray(calibration.interior_covariance, dtype=float).ravel()
    message.model_kind = model.kind
    message.k = model.k
    message.model_noise = model.noise_px
    message.model_bias = model.bias_px
    message.train_u = doubles(model.train_uv[:, 0])
    message.train_v = doubles(model.train_uv[:, 1])
    message.train_du = doubles(model.train_duv[:, 0])
    message.train_dv = doubles(model.train_duv[:, 1])
    message.train_exposure = unsigned(calibration.train_exposure)
    message.series_degree, message.series_modes, coefficients, sd = packed(model.series)
    message.series_u = doubles(coefficients[0])
    message.series_v = doubles(coefficients[1])
    message.series_sd = doubles(sd)
    message.rmse_before_u, message.rmse_before_v = (float(x) for x in calibration.rmse_before)
    message.rmse_after_u, message.rmse_after_v = (float(x) for x in calibration.rmse_after)
    for name in SAME_NAME:
        setattr(message, name, getattr(calibration, name))
    message.calibration_id = calibration.calibration_id
    return message


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


def calibration_from_message(message):
    """Calibration of a FluoroscopeCalibration message, the same to the last bit as the one that
    was sent.

    Raises DataError where the message does not hold a calibration, or not the one its id says.
    """
    where = f'calibration of fluoroscope {message.fluoroscope}'
    train = [
        np.array(field)
        for field in (message.train_u, message.train_v, message.train_du, message.train_dv)
    ]
    if len({len(field) for field in train} | {len(message.train_exposure)}) != 1:
        raise DataError(
            f'{where}: its training points have different numbers of coordinates and corrections'
        )
    try:
        model = CorrectionModel(
            message.model_kind,
            message.k,
            np.stack(train[:2], axis=1),
            np.stack(train[2:], axis=1),
            message.model_noise,
            message.model_bias,
            _series_of(message),
        )
    except ValueError as error:
        raise DataError(f'{where}: {error}') from None
    calibration = calibration_result.FluoroscopeCalibration(
        image_size=(message.image_width, message.image_height),
        interior=np.array([message.xp, message.yp, message.c]),
        interior_covariance=np.array(message.interior_covariance).reshape(3, 3),
        model=model,
        train_exposure=np.array(message.train_exposure, dtype=np.int64),
        rmse_before=np.array([message.rmse_before_u, message.rmse_before_v]),
        rmse_after=np.array([message.rmse_after_u, message.rmse_after_v]),
        stamp_ns=to_nanoseconds(message.header.stamp),
        frame_id=message.header.frame_id,
        **{name: getattr(message, name) for name in SAME_NAME},
    )
    if calibration.calibration_id != message.calibration_id:
        raise DataError(f'{where}: its content does not belong to its id {message.calibration_id}')
    checked_arrays(where, calibration)
    return calibration


def _series_of(message):
    """Series of a FluoroscopeCalibration message, None where it has none. Raises ValueError."""
    if len(message.series_u) != len(message.series_v):
        raise ValueError('its series has different numbers of coefficients in u and in v')
    sd = np.array(message.series_sd)
    sd = sd.reshape(SD_GRID, SD_GRID) if len(sd) == SD_GRID**2 else sd[None]
    return unpacked(
        (message.image_width, message.image_height),
        message.series_degree,
        message.series_modes,
        np.array([message.series_u, message.series_v]),
        sd,
    )


def camera_info(calibration, stamp):
    """CameraInfo of the corrected stream: no distortion, K from the interior orientation."""
    xp, yp, c = (float(x) for x in calibration.interior)
    info = CameraInfo(
        width=calibration.image_size[0],
        height=calibration.image_size[1],
        distortion_model='plumb_bob',
        d=[0.0] * 5,
        k=[c, 0.0, xp, 0.0, c, yp, 0.0, 0.0, 1.0],
        r=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p=[c, 0.0, xp, 0.0, 0.0, c, yp, 0.0, 0.0, 0.0, 1.0, 0.0],
    )
    info.header.stamp = stamp
    info.header.frame_id = calibration.frame_id
    return info
