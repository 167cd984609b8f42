"""Node that publishes the messages of a bag as they were recorded, and ends."""

import threading
import time
import traceback
from importlib import import_module

import rclpy
from rclpy.exceptions import NameValidationException
from rclpy.node import Node
from rclpy.type_support import check_for_type_support

from ..bags.reader import iterate_messages, topics_of
from ..errors import DataError
from . import support
from .qos import LATCHED_RECORDED, OBSERVATIONS, overridable
from .support import StartError, declare, sentence_of


class PlayerNode(Node):
    """Plays a bag once, or over and over; stamps are those of the recording."""

    def __init__(self):
        super().__init__('player_node')
        self._bag = declare(self, 'bag', '', 'bag to play: an .mcap file or a folder of rosbag2')
        self._rate = declare(self, 'rate', 1.0, 'speed against the recording', 0.001, 1e6)
        self._loop = declare(self, 'loop', False, 'play over and over')
        self._readers = declare(
            self, 'wait_for_readers', 1, 'subscriptions of every topic to wait for', 0, 100
        )
        self._namespace = declare(
            self, 'strip_prefix', '', 'beginning of the recorded topics that is left out'
        )
        wanted = list(declare(self, 'topics', [''], 'topics to play; empty: all'))
        if not self._bag:
            raise StartError('parameter bag is not set: it names the bag to play')
        try:
            found = topics_of(self._bag)
        except DataError as error:
            raise StartError(str(error)) from None
        self._outputs = {
            topic: self._output(topic, info.type, is_latched(info))
            for topic, info in found.items()
            if wanted in ([''], []) or topic in wanted
        }
        self._outputs = {
            topic: output for topic, output in self._outputs.items() if output is not None
        }
        if not self._outputs:
            raise StartError(
                f'{self._bag}: there is nothing to play among its topics {", ".join(found) or "(none)"}'
            )
        if not any(found[topic].count for topic in self._outputs):
            raise StartError(f'{self._bag}: there are no messages on {", ".join(self._outputs)}')
        self.failed = False
        self._stopping = threading.Event()
        self._worker = threading.Thread(target=self._play, daemon=True)
        self._worker.start()

    def _output(self, topic, type_name, latched):
        """Publisher of a recorded topic, relative so that it can be remapped; None for a type that
        is not here.
        """
        package, _, name = type_name.partition('/msg/')
        try:
            message_type = getattr(import_module(f'{package or "no"}.msg'), name)
            check_for_type_support(message_type)
        except (ImportError, AttributeError):
            self.get_logger().warning(
                f'{topic} is not played: the type {type_name or "(none)"} is not installed'
            )
            return None
        relative = topic.removeprefix(self._namespace).lstrip('/')
        try:
            return self.create_publisher(
                message_type,
                relative,
                LATCHED_RECORDED if latched else OBSERVATIONS,
                qos_overriding_options=overridable(),
            )
        except NameValidationException as error:
            raise StartError(
                f'{topic} cannot be played as {relative!r}: {sentence_of(error)}'
            ) from None

    def _play(self):
        try:
            support.wait_for_readers(self, self._outputs.values(), self._readers, self._stopping)
            while not self._stopping.is_set():
                self._play_once()
                if not self._loop:
                    break
            if (
                not support.wait_until_taken(self._outputs.values(), self._stopping)
                and not self._stopping.is_set()
            ):
                self.get_logger().warning(
                    'not all messages have arrived: a reader does not answer'
                )
        except DataError as error:
            self.get_logger().fatal(str(error))
            self.failed = True
        except Exception:
            if rclpy.ok():  # else the node has been ended between two messages
                self.get_logger().fatal(traceback.format_exc())
                self.failed = True
        finally:
            if rclpy.ok():
                rclpy.shutdown()

    def _play_once(self):
        """Publish every message at its time."""
        start = time.monotonic()
        first = None
        count = 0
        for message in iterate_messages(self._bag, list(self._outputs)):
            first = message.log_time_ns if first is None else first
            due = start + (message.log_time_ns - first) * 1e-9 / self._rate
            if self._stopping.wait(max(0.0, due - time.monotonic())):
                return
            self._outputs[message.topic].publish(message.data)
            count += 1
        self.get_logger().info(f'{count} messages played in {time.monotonic() - start:.1f} s')

    def stop(self):
        """End playing: the node is to go."""
        self._stopping.set()
        self._worker.join(2.0)


def is_latched(info):
    """Whether what was recorded on a topic is heard by those too who come later."""
    return any(profile.get('durability') == 'transient_local' for profile in info.offered_qos)


def main(args=None):
    """Entry point."""
    support.run(PlayerNode, args)


if __name__ == '__main__':
    main()
