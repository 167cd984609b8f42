"""Node that publishes the messages of a bag as they were recorded, and ends."""

import threading
import time
from importlib import import_module

import rclpy
from rclpy._rclpy_pybind11 import RCLError
from rclpy.duration import Duration
from rclpy.node import Node

from ..bags.reader import iterate_messages, topics_of
from ..photogrammetry.observations import DataError
from . import support
from .qos import OBSERVATIONS, overridable
from .support import StartError, declare


class PlayerNode(Node):
    """Plays a bag once, or over and over; stamps are those of the recording."""

    def __init__(self):
        super().__init__('player_node')
        self._bag = declare(self, 'bag', '', 'bag to play: an .mcap file or a folder of rosbag2')
        self._rate = declare(self, 'rate', 1.0, 'speed against the recording', 0.001, 1e6)
        self._loop = declare(self, 'loop', False, 'play over and over')
        self._readers = declare(self, 'wait_for_readers', 1, 'subscriptions of every topic to wait for', 0, 100)
        self._namespace = declare(self, 'strip_prefix', '', 'beginning of the recorded topics that is left out')
        wanted = list(declare(self, 'topics', [''], 'topics to play; empty: all'))
        if not self._bag:
            raise StartError('parameter bag is not set: it names the bag to play')
        try:
            found = topics_of(self._bag)
        except DataError as error:
            raise StartError(str(error)) from None
        self._outputs = {topic: self._output(topic, info.type) for topic, info in found.items()
                         if wanted in ([''], []) or topic in wanted}
        self._outputs = {topic: output for topic, output in self._outputs.items() if output is not None}
        if not self._outputs:
            raise StartError(f'{self._bag}: there is nothing to play among its topics {", ".join(found) or "(none)"}')
        self.failed = False
        self._stopping = threading.Event()
        self._worker = threading.Thread(target=self._play, daemon=True)
        self._worker.start()

    def _output(self, topic, type_name):
        """Publisher of a recorded topic, relative so that it can be remapped; None for a type that is not here."""
        package, _, name = type_name.partition('/msg/')
        try:
            message_type = getattr(import_module(f'{package}.msg'), name)
        except (ImportError, AttributeError):
            self.get_logger().warning(f'{topic} is not played: the type {type_name} is not installed')
            return None
        relative = topic.removeprefix(self._namespace).lstrip('/')
        return self.create_publisher(message_type, relative, OBSERVATIONS, qos_overriding_options=overridable())

    def _play(self):
        try:
            self._wait_for_readers()
            while not self._stopping.is_set():
                self._play_once()
                if not self._loop:
                    break
            self._wait_until_taken()
        except DataError as error:
            self.get_logger().fatal(str(error))
            self.failed = True
        except RCLError:
            if rclpy.ok():   # else the node has been ended between two messages
                raise
        finally:
            if rclpy.ok():
                rclpy.shutdown()

    def _wait_for_readers(self):
        while not self._stopping.is_set():
            missing = [t for t, p in self._outputs.items() if p.get_subscription_count() < self._readers]
            if not missing:
                return
            self.get_logger().info(f'waiting for {self._readers} readers of {", ".join(missing)}',
                                   throttle_duration_sec=5.0)
            self._stopping.wait(0.05)

    def _play_once(self):
        """Publish every message at its time."""
        start, first, count = time.monotonic(), None, 0
        for message in iterate_messages(self._bag, list(self._outputs)):
            first = message.log_time_ns if first is None else first
            due = start + (message.log_time_ns - first) * 1e-9 / self._rate
            if self._stopping.wait(max(0.0, due - time.monotonic())):
                return
            self._outputs[message.topic].publish(message.data)
            count += 1
        self.get_logger().info(f'{count} messages played in {time.monotonic() - start:.1f} s')

    def _wait_until_taken(self):
        """Wait until all messages have arrived; what is not acknowledged is lost when the node goes."""
        for output in self._outputs.values():
            output.wait_for_all_acked(Duration(seconds=10))

    def stop(self):
        """End playing: the node is to go."""
        self._stopping.set()
        self._worker.join(2.0)


def main(args=None):
    """Entry point."""
    support.run(PlayerNode, args)


if __name__ == '__main__':
    main()
