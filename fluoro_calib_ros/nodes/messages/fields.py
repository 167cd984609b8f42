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

"""Fields that many messages have: stamps, and arrays of primitive numbers."""

from __future__ import annotations

from array import array

import numpy as np
from builtin_interfaces.msg import Time
from numpy.typing import ArrayLike

NS_PER_S = 1_000_000_000


def nanoseconds_from_stamp(stamp: Time) -> int:
    """Return a Time message in nanoseconds."""
    return stamp.sec * NS_PER_S + stamp.nanosec


def stamp_from_nanoseconds(nanoseconds: int) -> Time:
    """Return a Time message of a time in nanoseconds."""
    return Time(sec=int(nanoseconds // NS_PER_S), nanosec=int(nanoseconds % NS_PER_S))


def float64_field(values: ArrayLike) -> array:
    """Return a float64[] field; an array of several dimensions is flattened."""
    return array('d', np.ascontiguousarray(values, dtype=np.float64).tobytes())


def uint32_field(values: ArrayLike) -> array:
    """Return a uint32[] field; an array of several dimensions is flattened."""
    return array('I', np.ascontiguousarray(values, dtype=np.uint32).tobytes())


def uint8_field(values: ArrayLike) -> array:
    """Return a uint8[] field; an array of several dimensions is flattened."""
    return array('B', np.ascontiguousarray(values, dtype=np.uint8).tobytes())
