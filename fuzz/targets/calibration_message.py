# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Messages of calibrations and orientations; their ids are recomputed to match changed content."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

from fluoro_calib_msgs.msg import FluoroscopeCalibration, RigOrientation
from rclpy.serialization import deserialize_message, serialize_message

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.nodes.messages.fluoroscope_calibration import (
    calibration_from_message,
    content_of_calibration,
    message_from_calibration,
)
from fluoro_calib_ros.nodes.messages.rig_orientation import (
    content_of_orientation,
    message_from_orientation,
    orientation_from_message,
)

from ..harness import Broken, Target, both
from ..seeds import calibration, orientation


def _read(path: Path) -> None:
    data = path.read_bytes()
    both(lambda: _read_calibration(data), lambda: _read_orientation(data))


def _read_calibration(data: bytes) -> None:
    message = _decoded(FluoroscopeCalibration, data)
    message.calibration_id = content_of_calibration(message).calibration_id
    found = calibration_from_message(message)
    again = calibration_from_message(message_from_calibration(found))
    if again.calibration_id != found.calibration_id:
        raise Broken('another calibration than was sent')


def _read_orientation(data: bytes) -> None:
    message = _decoded(RigOrientation, data)
    message.orientation_id = content_of_orientation(message).orientation_id
    found = orientation_from_message(message)
    again = orientation_from_message(message_from_orientation(found))
    if again.orientation_id != found.orientation_id:
        raise Broken('another orientation than was sent')


def _decoded(kind: type, data: bytes) -> Any:
    try:
        return deserialize_message(data, kind)
    except Exception as error:  # raised by rclpy; the stream readers count such messages
        raise DataError(f'undecodable ({type(error).__name__})') from None


@functools.cache
def _seeds() -> list[bytes]:
    messages = [message_from_calibration(calibration(m)) for m in ('knn', 'parametric', 'none')]
    messages.append(message_from_orientation(orientation()))
    return [bytes(serialize_message(message)) for message in messages]


TARGET = Target('calibration_message', 'message', _read, _seeds)
