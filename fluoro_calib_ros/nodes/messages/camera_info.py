# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""CameraInfo of corrected streams."""

from __future__ import annotations

from builtin_interfaces.msg import Time
from sensor_msgs.msg import CameraInfo

from ...correction.fluoroscope_calibration import FluoroscopeCalibration
from ...errors import DataError


def message_of_corrected_stream(calibration: FluoroscopeCalibration, stamp: Time) -> CameraInfo:
    """Return the CameraInfo without distortion, K from the interior orientation."""
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


def image_size_of(message: CameraInfo, topic: str) -> tuple[int, int]:
    """Return width and height [px]. Raises DataError where the message has none."""
    if not message.width or not message.height:
        raise DataError(
            f'topic {topic}: the image size is {message.width} x {message.height} px, '
            'so this is not the camera_info of a correction node'
        )
    return message.width, message.height
