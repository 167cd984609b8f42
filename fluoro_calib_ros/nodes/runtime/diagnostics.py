# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""State of a node on /diagnostics."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

OK = DiagnosticStatus.OK
WARN = DiagnosticStatus.WARN
ERROR = DiagnosticStatus.ERROR


@dataclass(frozen=True)
class Status:
    """One entry of the diagnostics of a node.

    Attributes
    ----------
    name : str
        Fluoroscope or function that the status is about.
    level : bytes
        OK, WARN or ERROR.
    message : str
    values : mapping of str to object
    """

    name: str
    level: bytes
    message: str
    values: Mapping[str, object] = field(default_factory=dict)


class DiagnosticsPublisher:
    """Publishes the statuses of a node on /diagnostics."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)

    def publish(self, statuses: Iterable[Status]) -> None:
        """Publish statuses in one message."""
        array = DiagnosticArray()
        array.header.stamp = self._node.get_clock().now().to_msg()
        node_name = self._node.get_fully_qualified_name()
        array.status = [
            DiagnosticStatus(
                level=status.level,
                name=f'{node_name}: {status.name}',
                message=status.message,
                hardware_id=status.name,
                values=[KeyValue(key=k, value=str(v)) for k, v in status.values.items()],
            )
            for status in statuses
        ]
        self._publisher.publish(array)

    def close(self) -> None:
        """Destroy the publisher."""
        self._node.destroy_publisher(self._publisher)


class LatencyWindow:
    """The last latencies; one thread writes them and another one reads them."""

    def __init__(self, size: int = 2000) -> None:
        self._ring = np.zeros(size, dtype=np.int64)
        self._count = 0

    def add(self, nanoseconds: int) -> None:
        """Add a latency [ns]."""
        self._ring[self._count % len(self._ring)] = nanoseconds
        self._count += 1

    def values(self) -> dict[str, str]:
        """Return median and 99th percentile for the diagnostics; nothing before the first one."""
        if not self._count:
            return {}
        p50, p99 = np.percentile(self._ring[: self._count], [50, 99]) * 1e-6
        return {'latency p50 [ms]': f'{p50:.3f}', 'latency p99 [ms]': f'{p99:.3f}'}
