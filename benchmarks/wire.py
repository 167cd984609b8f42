# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Decoding and encoding of stream messages by our CDR code, rosbags' typestore and rclpy.

    python -m benchmarks.wire

Warm: in a loop. Cold: after a pause of 4 ms and writing 8 MB of other memory, as between two
frames of a stream at 250 Hz with other work in between. Times are medians of the repetitions.
"""

from __future__ import annotations

import argparse
import time
from array import array
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from fluoro_calib_msgs.msg import CorrectedObservations, TargetObservations
from rclpy.serialization import deserialize_message, serialize_message

from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.io.bags.metadata import message_class, typestore
from fluoro_calib_ros.nodes.messages.observations import (
    decode_corrected_observations,
    decode_target_observations,
    encode_corrected_observations,
    float64_field,
    message_from_frame,
)
from tools.sections import show_section

from .timing import table

POINTS = (30, 2028)
WARM = 2000
COLD = 150
PAUSE_S = 0.004
OBSERVED = 'fluoro_calib_msgs/msg/TargetObservations'
CORRECTED = 'fluoro_calib_msgs/msg/CorrectedObservations'
CALIBRATION_ID = 'a-2802e916511fc237'


def median_us(function: Callable[[], object], cold: bool) -> float:
    """Return the median time of a call [us]."""
    times = []
    other_work = np.zeros(1_000_000)
    for _ in range(COLD if cold else WARM):
        if cold:
            time.sleep(PAUSE_S)
            other_work += 1.0
        start = time.perf_counter_ns()
        function()
        times.append(time.perf_counter_ns() - start)
    return float(np.median(times)) / 1e3


def cases(count: int) -> dict[tuple[str, str], Callable[[], object]]:
    """Return the measured functions for a number of points, by task and library."""
    rng = np.random.default_rng(1)
    frame = Frame(
        'a',
        1,
        np.arange(count),
        rng.random((count, 2)) * 1000,
        (1024, 1024),
        rng.random(count),
        10**18,
        'a_optical',
    )
    data = bytes(serialize_message(message_from_frame(frame)))
    columns = [rng.random(count) for _ in range(4)]
    status = np.zeros(count, np.uint8)
    source = decode_target_observations(data)
    corrected = encode_corrected_observations(source, CALIBRATION_ID, (*columns, status))
    store = typestore()
    kind = message_class(CORRECTED)
    rosbags_source: Any = store.deserialize_cdr(data, OBSERVED)
    rclpy_source = deserialize_message(data, TargetObservations)

    def encode_rosbags() -> object:
        message = kind(
            rosbags_source.header,
            rosbags_source.frame_number,
            CALIBRATION_ID,
            rosbags_source.target_id,
            *columns,
            status,
        )
        return bytes(store.serialize_cdr(message, CORRECTED))

    def encode_rclpy() -> object:
        message = CorrectedObservations(
            header=rclpy_source.header,
            frame_number=rclpy_source.frame_number,
            calibration_id=CALIBRATION_ID,
            target_id=rclpy_source.target_id,
        )
        message.u, message.v, message.sigma, message.correction_sd = map(float64_field, columns)
        message.status = array('B', status.tobytes())
        return serialize_message(message)

    decode, encode = 'decode CorrectedObservations', 'encode CorrectedObservations'
    first = 'decode TargetObservations'
    return {
        (first, 'ours'): lambda: decode_target_observations(data),
        (first, 'rosbags'): lambda: store.deserialize_cdr(data, OBSERVED),
        (first, 'rclpy'): lambda: deserialize_message(data, TargetObservations),
        (decode, 'ours'): lambda: decode_corrected_observations(corrected),
        (decode, 'rosbags'): lambda: store.deserialize_cdr(corrected, CORRECTED),
        (decode, 'rclpy'): lambda: deserialize_message(corrected, CorrectedObservations),
        (encode, 'ours'): lambda: encode_corrected_observations(
            source, CALIBRATION_ID, (*columns, status)
        ),
        (encode, 'rosbags'): encode_rosbags,
        (encode, 'rclpy'): encode_rclpy,
    }


def run() -> str:
    """Return the table of the results [us]."""
    rows = []
    for count in POINTS:
        found = {
            key: (median_us(function, False), median_us(function, True))
            for key, function in cases(count).items()
        }
        for task in dict.fromkeys(task for task, _ in found):
            times = [found[task, library] for library in ('ours', 'rosbags', 'rclpy')]
            warm = [f'{t[0]:.1f}' for t in times]
            cold = [f'{t[1]:.0f}' for t in times]
            rows.append([f'{task}, {count} points', *warm, *cold])
    libraries = ('own code', 'rosbags', 'rclpy')
    head = ['', *(f'{k}, {lib} [us]' for k in ('warm', 'cold') for lib in libraries)]
    return table(head, rows)


if __name__ == '__main__':
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--out', type=Path, help='page with the table, docs/how_good/speed.md')
    show_section(run(), parser.parse_args().out, 'messages')
