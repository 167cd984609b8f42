# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

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
