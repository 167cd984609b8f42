# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""JointState: positions of joints, of which one is the angle of a C-arm."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState

from .fields import nanoseconds_from_stamp


class JointStates(NamedTuple):
    """Stamp [ns], names and positions [rad] of joints; positions may be of any length."""

    stamp_ns: int
    names: Sequence[str]
    positions: Sequence[float]


def decode_joint_state(data: bytes) -> JointStates:
    """Read a JointState message from its bytes. Raises one of DECODING_ERRORS."""
    message = deserialize_message(data, JointState)
    return JointStates(
        nanoseconds_from_stamp(message.header.stamp), message.name, message.position
    )
