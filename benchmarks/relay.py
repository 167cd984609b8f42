"""A node that does nothing but hand target observations on: what rclpy and DDS cost without any work between.

    python -m benchmarks.relay plain     subscriptions as everybody makes them, in rclpy's executor
    python -m benchmarks.relay streams   taken as the nodes of this package take streams
"""

import sys

from fluoro_calib_msgs.msg import TargetObservations

from fluoro_calib_ros.nodes import support
from fluoro_calib_ros.nodes.qos import OBSERVATIONS
from fluoro_calib_ros.nodes.streams import StreamReader


class Relay(support.ManagedNode):
    """Publishes every message of <fluoroscope>/target_observations on <fluoroscope>/relayed_KIND."""

    def __init__(self, kind):
        super().__init__(f'relay_{kind}')
        self._kind, self._reader = kind, None

    def begin(self):
        """Take and publish."""
        self._reader = StreamReader(self, self.fail, self.fail)
        for name in 'ab':
            publisher = self.create_publisher(TargetObservations, f'{name}/relayed_{self._kind}', OBSERVATIONS)
            topic = f'{name}/target_observations'
            if self._kind == 'plain':
                self.create_subscription(TargetObservations, topic, publisher.publish, OBSERVATIONS)
            else:
                self._reader.subscribe(TargetObservations, topic, lambda message, _, publisher=publisher:
                                       publisher.publish(message), OBSERVATIONS)
        if self._kind == 'streams':
            self._reader.start()

    def end(self):
        """Take no more."""
        self._reader.stop()

    def open(self):
        """Nothing."""

    def close(self):
        """Nothing."""


if __name__ == '__main__':
    support.run(lambda: Relay(sys.argv[1]), sys.argv[:1] + sys.argv[2:])
