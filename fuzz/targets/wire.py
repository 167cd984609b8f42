# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The hand-written readers of stream messages, compared with those of rclpy."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from fluoro_calib_msgs.msg import CorrectedObservations, TargetObservations
from rclpy.serialization import deserialize_message, serialize_message

from fluoro_calib_ros.nodes.messages.observations import (
    decode_corrected_observations,
    decode_target_observations,
)

from ..harness import Broken, Target

ARRAYS = ('target_id', 'u', 'v', 'sigma', 'correction_sd', 'status')


def _attempt(function: Any, *arguments: Any) -> Any:
    """Return the result of a function, or None if it refuses the bytes."""
    try:
        return function(*arguments)
    except (ValueError, RuntimeError, MemoryError):  # the exceptions that StreamReader expects
        return None
    except Exception as error:
        if type(error).__name__ == 'RCLError':
            return None
        raise


def _agree(found: Any, expected: Any) -> None:
    """Raise Broken if two readers return different messages."""
    pairs: dict[str, tuple[Any, Any]] = {
        'sec': (found.sec, expected.header.stamp.sec),
        'nanosec': (found.nanosec, expected.header.stamp.nanosec),
        'frame_id': (found.frame_id, expected.header.frame_id),
        'frame_number': (found.frame_number, expected.frame_number),
    }
    if hasattr(found, 'image_size'):
        pairs['image_size'] = (
            found.image_size,
            (expected.image_width, expected.image_height),
        )
    if hasattr(found, 'calibration_id'):
        pairs['calibration_id'] = (found.calibration_id, expected.calibration_id)
    for name in ARRAYS:
        if hasattr(found, name):
            one = getattr(found, name)
            one = one if isinstance(one, bytes) else one.tobytes()
            other = getattr(expected, name)
            pairs[name] = (one, np.asarray(other).tobytes())
    for name, (one, other) in pairs.items():
        if one != other:
            raise Broken(f'{name}: {one!r} here, {other!r} by rclpy')


def _read(path: Path) -> None:
    data = path.read_bytes()
    for kind, decode in (
        (TargetObservations, decode_target_observations),
        (CorrectedObservations, decode_corrected_observations),
    ):
        found = _attempt(decode, data)
        expected = _attempt(deserialize_message, data, kind)
        if (found is None) != (expected is None):
            raise Broken(
                f'{kind.__name__}: accepted {"by rclpy" if found is None else "here"} only'
            )
        if found is not None:
            _agree(found, expected)


def _seeds() -> list[bytes]:
    seeds = []
    for count in (0, 1, 2, 3):
        observed = TargetObservations(frame_number=7, image_width=1024, image_height=768)
        observed.header.frame_id = 'a_optical'
        observed.target_id = list(range(count))
        observed.u = observed.v = [math.pi] * count
        corrected = CorrectedObservations(frame_number=7, calibration_id='abc')
        corrected.target_id = list(range(count))
        corrected.u = corrected.v = corrected.sigma = corrected.correction_sd = [0.5] * count
        corrected.status = [1] * count
        seeds += [bytes(serialize_message(observed)), bytes(serialize_message(corrected))]
    return seeds


TARGET = Target('wire', 'message', _read, _seeds)
