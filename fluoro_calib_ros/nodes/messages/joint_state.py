# Copyright 2026 fluoro_calib_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

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
