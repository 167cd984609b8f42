# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A node that only relays target observations: the cost of rclpy and DDS without other work.

python -m benchmarks.relay plain     ordinary subscriptions in rclpy's executor
python -m benchmarks.relay streams   received as the nodes of this package receive streams
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from fluoro_calib_msgs.msg import TargetObservations

from fluoro_calib_ros.nodes.runtime.diagnostics import OK, LatencyWindow, Status
from fluoro_calib_ros.nodes.runtime.lifecycle import StreamNode
from fluoro_calib_ros.nodes.runtime.main import run
from fluoro_calib_ros.nodes.runtime.parameters import ManagedParameters, group
from fluoro_calib_ros.nodes.runtime.streams import FaultHandlers
from fluoro_calib_ros.nodes.runtime.topics import observations_qos


@dataclass(frozen=True)
class RelaySettings:
    """Parameter values by group."""

    node: ManagedParameters = group(ManagedParameters)


class Relay(StreamNode):
    """Republishes <fluoroscope>/target_observations on <fluoroscope>/relayed_KIND."""

    def __init__(self, kind: str) -> None:
        super().__init__(f'relay_{kind}', RelaySettings)
        self._kind = kind
        self._latencies = {name: LatencyWindow() for name in 'ab'}

    def create_readers(self) -> None:
        """Start to relay."""
        reader = self.create_reader(all_fatal(self)) if self._kind == 'streams' else None
        for name in 'ab':
            topic = f'{name}/target_observations'
            relay = self._relay(name)
            if reader is None:
                self.create_subscription(
                    TargetObservations,
                    topic,
                    lambda message, info, relay=relay: relay(message, info),
                    observations_qos(),
                )
            else:
                reader.subscribe(TargetObservations, topic, relay, observations_qos())

    def diagnose(self) -> list[Status]:
        """Return the latencies of every fluoroscope."""
        return [
            Status(name, OK, '', latencies.values()) for name, latencies in self._latencies.items()
        ]

    def _relay(self, name: str) -> Callable[[TargetObservations, dict[str, Any]], None]:
        publisher = self.create_publisher(
            TargetObservations, f'{name}/relayed_{self._kind}', observations_qos()
        )
        latencies = self._latencies[name]

        def relay(message: TargetObservations, info: dict[str, Any]) -> None:
            publisher.publish(message)
            latencies.add(time.time_ns() - info['received_timestamp'])

        return relay


def all_fatal(node: StreamNode) -> FaultHandlers:
    """Return handlers that end a benchmark's node at any fault."""
    return FaultHandlers(
        node.fail, lambda topic, error: node.fail(f'{topic}: {error!r}'), node.fail
    )


if __name__ == '__main__':
    run(lambda: Relay(sys.argv[1]), sys.argv[:1] + sys.argv[2:])
