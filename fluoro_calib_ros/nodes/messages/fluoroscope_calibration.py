# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Lossless conversion of FluoroscopeCalibration, and the CameraInfo of a corrected stream."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from fluoro_calib_msgs.msg import FluoroscopeCalibration
from numpy.typing import ArrayLike
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo

from ...correction import fluoroscope_calibration as calibration_result
from ...correction.calibration_record import FIELDS, Field
from ...errors import DataError
from ...exposures.stamps import nanoseconds_from_stamp
from ...io.arrays import to_values
from ...io.bags.metadata import FLUOROSCOPE_CALIBRATION, present_cdr
from ...io.calibration import validated_arrays
from ..runtime.streams import DECODING_ERRORS
from .observations import (
    float64_field,
    stamp_from_nanoseconds,
    uint32_field,
)


def _axis(field: Field) -> int:
    """Return the axis along which a value is split into several fields of the message."""
    return field.shape.index(len(field.message))


def _parts(field: Field, value: Any) -> Iterable[Any]:
    """Yield a value in the form that rclpy accepts, or its parts for several fields."""
    value = np.asarray(value)
    for part in np.moveaxis(value, _axis(field), 0) if len(field.message) > 1 else (value,):
        if not part.ndim:
            yield part.item()
        else:
            yield uint32_field(part) if field.dtype == 'int' else float64_field(part)


def _value(where: str, message: Any, field: Field) -> Any:
    """Return the value of a field from a message.

    Raises DataError, starting with the text `where`, for sequences of impossible length.
    """
    names = field.message or (field.name,)
    parts = [getattr(message, name) for name in names]
    if not field.shape:
        return parts[0]
    if len(names) == 1:
        return _shaped(where, field, np.array(parts[0]))
    if len({np.size(part) for part in parts}) > 1:
        raise DataError(f'{where}: {" and ".join(names)} differ in length')
    return np.stack([np.array(part) for part in parts], axis=_axis(field))


def _shaped(where: str, field: Field, flat: np.ndarray) -> np.ndarray:
    """Return a flat sequence in the shape of its field."""
    if len(field.shape) == 1:
        return flat
    if not len(flat) and field.before is not None:
        return np.asarray(field.before)
    lengths = [field.lengths[n] if isinstance(n, str) else (n,) for n in field.shape]
    shapes = {math.prod(shape): shape for shape in itertools.product(*lengths)}
    if len(flat) not in shapes:
        expected = ' or '.join(map(str, shapes))
        raise DataError(f'{where}: {field.name} has {len(flat)} values, {expected} are expected')
    return flat.reshape(shapes[len(flat)])


# The header contains the excluded fields.
MESSAGE_FIELDS = [field for field in FIELDS if field.name not in ('stamp_ns', 'frame_id')]


def decode_fluoroscope_calibration(data: bytes) -> FluoroscopeCalibration:
    """Read a message, possibly of an earlier definition, from its bytes.

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
    message.seconds = calibration.seconds
    values = calibration.to_values()
    for field in MESSAGE_FIELDS:
        names = field.message or (field.name,)
        for name, part in zip(names, _parts(field, values[field.name]), strict=True):
            setattr(message, name, part)
    return message


def calibration_from_message(
    message: FluoroscopeCalibration,
) -> calibration_result.FluoroscopeCalibration:
    """Return the calibration of a message, identical to the one that was sent.

    Raises DataError if the message contains no valid calibration, or if its id does not match.
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
    """Return the calibration of a message without comparing its id. Raises DataError."""
    where = f'calibration of fluoroscope {message.fluoroscope}'
    values = {field.name: _value(where, message, field) for field in MESSAGE_FIELDS}
    values['stamp_ns'] = nanoseconds_from_stamp(message.header.stamp)
    values['frame_id'] = message.header.frame_id
    values = to_values(validated_arrays(where, values))
    try:
        return calibration_result.FluoroscopeCalibration.from_values(values, message.seconds)
    except ValueError as error:
        raise DataError(f'{where}: {error}') from None


def message_of_corrected_stream(
    calibration: calibration_result.FluoroscopeCalibration, stamp: Time
) -> CameraInfo:
    """Return the CameraInfo without distortion; K follows from the interior orientation."""
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


def image_size_of(
    message: CameraInfo, topic: str, frame_id: str = '', interior: ArrayLike | None = None
) -> tuple[int, int]:
    """Return width and height [px] from the CameraInfo of a corrected stream.

    Raises DataError if the message has no size, or if it does not match an optical frame and an
    interior orientation xp, yp, c [px]; '' and None skip these comparisons.
    """
    if not message.width or not message.height:
        raise DataError(
            f'topic {topic}: the image size is {message.width} x {message.height} px, '
            'so this is not the camera_info of a correction node'
        )
    received = message.header.frame_id
    if frame_id and received and received != frame_id:
        raise DataError(
            f'topic {topic}: the camera_info is of frame {received}, not of {frame_id}: it is of '
            'another camera'
        )
    k = message.k[[2, 5, 0]]  # row by row: c, 0, xp, 0, c, yp, 0, 0, 1
    if interior is not None and not np.allclose(k, interior, rtol=0, atol=1e-6):  # rounding
        raise DataError(
            f'topic {topic}: the camera_info of {message.width} x {message.height} px has the '
            f'principal distance {k[2]:g} px, the orientation {np.asarray(interior)[2]:g} px: it '
            'is of another camera or calibration'
        )
    return message.width, message.height
