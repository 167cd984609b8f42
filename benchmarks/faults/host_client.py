# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A user of the graph on its own host: python -m benchmarks.faults.host_client.

Read one command per line from standard input, and answer each with a line of JSON:

state                    collected exposures, latched messages and diagnostics so far
calibrate MODEL          response of the service calibrate
step NODE NODE           publish one message from each of these paused players, and wait for them
go NODE NODE             resume these paused players
begin                    discard all stream messages
result                   stream messages since then: numbers, gaps, latency
"""

from __future__ import annotations

import json
import os
import select
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from fluoro_calib_msgs.msg import (
    CalibrationStatus,
    FluoroscopeCalibration,
    ReconstructedPoints,
    RigOrientation,
    TargetObservations,
)
from fluoro_calib_msgs.srv import Calibrate
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from std_srvs.srv import SetBool, Trigger

from fluoro_calib_ros.nodes.messages.observations import decode_target_observations
from fluoro_calib_ros.nodes.runtime.streams import FaultHandlers, StreamReader
from fluoro_calib_ros.nodes.runtime.topics import latched_qos

NAMES = ('a', 'b')
DEPTH = 5000  # deep enough that this queue loses nothing
ANSWER_S = 120.0
REPEAT_S = 2.0  # interval after which an unanswered request is sent again


class HostClient:
    """Listens to the graph, and calls its services."""

    def __init__(self) -> None:
        self._node = rclpy.create_node('host_client')
        self._spinner = SingleThreadedExecutor()
        self._spinner.add_node(self._node)
        self._exposures: dict[str, int] = {}
        self._calibrations: dict[str, str] = {}
        self._orientation = ''
        self._diagnostics: dict[str, str] = {}
        # (frame number, sent [ns], received [ns]) by topic
        self._came: dict[str, list[tuple[int, int, int]]] = {}
        for name in NAMES:
            self._node.create_subscription(
                CalibrationStatus, f'{name}/calibration_status', self._on_status, 10
            )
            self._node.create_subscription(
                FluoroscopeCalibration,
                f'{name}/calibration',
                partial(self._on_calibration, name),
                latched_qos(),
            )
        self._node.create_subscription(
            RigOrientation, 'rig_orientation', self._on_orientation, latched_qos()
        )
        self._node.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 50)
        self._calibrate = self._node.create_client(Calibrate, 'calibrate')
        self._reader = self._listen()

    def _listen(self) -> StreamReader:
        fatal = self._node.get_logger().fatal
        reader = StreamReader(
            self._node, FaultHandlers(fatal, lambda t, e: fatal(f'{t}: {e!r}'), fatal)
        )
        for name in NAMES:
            reader.subscribe(
                TargetObservations,
                f'{name}/target_observations',
                partial(self._on_frame, name),
                QoSProfile(depth=DEPTH),
                decode_target_observations,
            )
        reader.subscribe(
            ReconstructedPoints,
            'reconstruction/points_with_covariance',
            partial(self._on_frame, 'points'),
            QoSProfile(depth=DEPTH),
        )
        reader.start()
        return reader

    def _on_frame(self, stream: str, message: Any, info: dict[str, int]) -> None:
        self._came.setdefault(stream, []).append(
            (message.frame_number, info['source_timestamp'], info['received_timestamp'])
        )

    def _on_status(self, status: CalibrationStatus) -> None:
        self._exposures[status.fluoroscope] = status.exposures

    def _on_calibration(self, name: str, message: FluoroscopeCalibration) -> None:
        self._calibrations[name] = message.calibration_id

    def _on_orientation(self, message: RigOrientation) -> None:
        self._orientation = message.orientation_id

    def _on_diagnostics(self, array: DiagnosticArray) -> None:
        for status in array.status:
            self._diagnostics[status.name] = status.message

    def answer(self, words: list[str]) -> dict[str, Any]:
        """Execute a command."""
        commands: dict[str, Callable[..., dict[str, Any]]] = {
            'state': self._state,
            'calibrate': self._run_calibration,
            'step': self._step,
            'go': self._go,
            'begin': self._begin,
            'result': self._result,
        }
        return commands[words[0]](*words[1:])

    def _state(self) -> dict[str, Any]:
        return {
            'exposures': self._exposures,
            'calibrations': self._calibrations,
            'orientation': self._orientation,
            'diagnostics': self._diagnostics,
            'came': {stream: len(came) for stream, came in self._came.items()},
        }

    def _run_calibration(self, model: str) -> dict[str, Any]:
        self._wait(self._calibrate.service_is_ready)
        future = self._calibrate.call_async(Calibrate.Request(model=model))
        self._wait(future.done)
        return {'success': future.result().success, 'message': future.result().message}

    def _step(self, *players: str) -> dict[str, Any]:
        for name in players:
            self._call(self._node.create_client(Trigger, f'{name}/step'), Trigger.Request())
        # The players have discovered their readers, and are not blocked any more.
        self._wait(lambda: len(self._came) >= len(players))
        return {}

    def _go(self, *players: str) -> dict[str, Any]:
        clients = [self._node.create_client(SetBool, f'{name}/pause') for name in players]
        for client in clients:  # already paused: this only ensures that they respond
            self._call(client, SetBool.Request(data=True))
        futures = [client.call_async(SetBool.Request(data=False)) for client in clients]
        self._wait(lambda: all(future.done() for future in futures))
        return {}

    def _call(self, client: Any, request: Any) -> Any:
        """Return the response of a service; repeat the request until the server knows us."""
        futures: list[Any] = []
        asked = 0.0

        def answered() -> bool:
            nonlocal asked
            if client.service_is_ready() and time.monotonic() > asked + REPEAT_S:
                asked = time.monotonic()
                futures.append(client.call_async(request))
            return any(future.done() for future in futures)

        self._wait(answered)
        return next(future.result() for future in futures if future.done())

    def _begin(self) -> dict[str, Any]:
        self._came = {}
        return {}

    def _result(self) -> dict[str, Any]:
        return {stream: _figures(list(came)) for stream, came in self._came.items()}

    def _wait(self, condition: Callable[[], object]) -> None:
        end = time.monotonic() + ANSWER_S
        while not condition():
            if time.monotonic() > end:
                raise TimeoutError
            self._spinner.spin_once(timeout_sec=0.05)

    def spin(self) -> None:
        """Spin and answer commands until the input ends."""
        text = b''
        while rclpy.ok():
            self._spinner.spin_once(timeout_sec=0.02)
            if not select.select([sys.stdin], [], [], 0)[0]:
                continue
            part = os.read(sys.stdin.fileno(), 4096)
            if not part:
                break
            *lines, text = (text + part).split(b'\n')
            for line in lines:
                print(json.dumps(self.answer(line.decode().split())), flush=True)
        self._reader.stop()


def _figures(came: list[tuple[int, int, int]]) -> dict[str, Any]:
    """Return message counts and latency from publication to reception [ms]."""
    numbers = np.array([number for number, _, _ in came])
    sent_ns = np.array([sent for _, sent, _ in came], np.int64)
    received_ns = np.array([received for _, _, received in came], np.int64)
    latency = (received_ns - sent_ns) * 1e-6
    return {
        'count': len(came),
        'different': len(np.unique(numbers)),
        'first': int(numbers.min()),
        'last': int(numbers.max()),
        'in_order': bool((np.diff(numbers) > 0).all()),
        'p50_ms': float(np.percentile(latency, 50)),
        'p99_ms': float(np.percentile(latency, 99)),
        'max_ms': float(latency.max()),
        'longest_gap_s': float(np.diff(np.sort(received_ns)).max(initial=0)) * 1e-9,
    }


def main() -> None:
    rclpy.init(args=[])
    client = HostClient()
    print('{}', flush=True)
    client.spin()
    rclpy.shutdown()


if __name__ == '__main__':
    main()
