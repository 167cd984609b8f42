"""A node that does nothing but hand target observations on: what rclpy and DDS cost without any
work between.

python -m benchmarks.relay plain     subscriptions as everybody makes them, in rclpy's executor
python -m benchmarks.relay streams   taken as the nodes of this package take streams
"""

import sys
import time

from fluoro_calib_msgs.msg import TargetObservations

from fluoro_calib_ros.nodes import support
from fluoro_calib_ros.nodes.qos import OBSERVATIONS
from fluoro_calib_ros.nodes.streams import StreamReader


class Relay(support.ManagedNode):
    """Republish <fluoroscope>/target_observations on <fluoroscope>/relayed_KIND."""

    def __init__(self, kind):
        super().__init__(f'relay_{kind}')
        self._kind = kind
        self._reader = None
        self._latencies = {name: support.Latencies() for name in 'ab'}

    def begin(self):
        """Take and publish."""
        self._reader = StreamReader(self, self.fail, self.fail)
        for name in 'ab':
            publisher = self.create_publisher(
                TargetObservations, f'{name}/relayed_{self._kind}', OBSERVATIONS
            )
            topic = f'{name}/target_observations'

            def relay(message, info, publisher=publisher, latencies=self._latencies[name]):
                publisher.publish(message)
                latencies.add(time.time_ns() - info['received_timestamp'])

            if self._kind == 'plain':
                self.create_subscription(
                    TargetObservations,
                    topic,
                    lambda message, info, relay=relay: relay(message, info),
                    OBSERVATIONS,
                )
            else:
                self._reader.subscribe(TargetObservations, topic, relay, OBSERVATIONS)
        if self._kind == 'streams':
            self._reader.start()
        diagnostics = support.Diagnostics(self)
        self.create_timer(
            1.0,
            lambda: diagnostics.publish(
                [
                    (name, support.OK, '', latencies.values())
                    for name, latencies in self._latencies.items()
                ]
            ),
        )

    def end(self):
        """Take no more."""
        self._reader.stop()

    def open(self):
        """Nothing."""

    def close(self):
        """Nothing."""


if __name__ == '__main__':
    support.run(lambda: Relay(sys.argv[1]), sys.argv[:1] + sys.argv[2:])
