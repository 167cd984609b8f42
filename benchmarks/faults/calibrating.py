# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A client of a calibration node that publishes exposures and starts jobs."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any

import rclpy
from fluoro_calib_msgs.msg import CalibrationStatus, TargetObservations
from fluoro_calib_msgs.srv import Calibrate
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile

from fluoro_calib_ros.io.bags.reader import read_frames
from fluoro_calib_ros.nodes.messages.observations import message_from_frame

from .processes import Process

TIMEOUT_S = 60.0


class JobClient:
    """Publishes the exposures of a bag; a context manager that owns the ROS context."""

    def __init__(self, bag: Path, model: str = 'none') -> None:
        self._model = model
        self._pairs = list(zip(*read_frames(bag).frames.values()))
        self._exposures: dict[str, int] = {}

    def __enter__(self) -> JobClient:
        rclpy.init(args=[])
        self._node = rclpy.create_node('job_client')
        self._spinner = SingleThreadedExecutor()
        self._spinner.add_node(self._node)
        names = [frame.fluoroscope for frame in self._pairs[0]]
        self._outputs = {
            name: self._node.create_publisher(
                TargetObservations, f'{name}/target_observations', QoSProfile(depth=1000)
            )
            for name in names
        }
        for name in names:
            self._node.create_subscription(
                CalibrationStatus, f'{name}/calibration_status', self._on_status, 10
            )
        self._calibrate = self._node.create_client(Calibrate, 'calibrate')
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._spinner.shutdown()
        self._node.destroy_node()
        rclpy.shutdown()

    def _on_status(self, status: CalibrationStatus) -> None:
        self._exposures[status.fluoroscope] = status.exposures

    def collect(self, count: int, process: Process) -> None:
        """Publish the first exposures to a newly started node."""
        # The endpoints of a killed node remain until DDS notices.
        self.wait(lambda: 'ready' in process.output, 'the node')
        self._exposures.clear()
        self.wait(lambda: self._exposures, 'the status of the node')
        sent = 0.0

        def collected() -> bool:
            nonlocal sent
            if time.monotonic() > sent + 1.0:  # the first ones may precede discovery
                sent = time.monotonic()
                for pair in self._pairs[:count]:
                    for frame in pair:
                        message = message_from_frame(frame)
                        self._outputs[frame.fluoroscope].publish(message)
            return all(n == count for n in self._exposures.values())

        self.wait(collected, f'{count} exposures')

    def begin(self) -> Any:
        """Request a calibration; return the future of the response."""
        self.wait(self._calibrate.service_is_ready, 'the service')
        return self._calibrate.call_async(Calibrate.Request(model=self._model))

    def wait(self, condition: Callable[[], object], what: str) -> None:
        """Spin until a condition is true. Raise TimeoutError after the deadline."""
        end = time.monotonic() + TIMEOUT_S
        while not condition():
            if time.monotonic() > end:
                raise TimeoutError(f'waited {TIMEOUT_S:g} s for {what}')
            self._spinner.spin_once(timeout_sec=0.05)

    def spin_for(self, seconds: float) -> None:
        """Spin for a time."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self._spinner.spin_once(timeout_sec=min(0.05, max(end - time.monotonic(), 0.0)))
