"""Taking the messages of streams at lab rates.

rclpy's executors build their wait set anew for every message, of everything a node has: with the
services of parameters and lifecycle that is some 0.2 ms, twice what is left of handling a frame.
So the subscriptions of streams are left to a thread that waits for them alone and takes all that
has come; services and timers stay with the executor. What the two threads share is replaced as a
whole, never changed in place.

The events of these subscriptions are not asked for: one of them in a wait set wakes the executor
at every message. What a publisher offers is compared with what is asked for once a second instead
(incompatible()).
"""

import threading
import traceback

from rclpy._rclpy_pybind11 import InvalidHandle, RCLError
from rclpy.callback_groups import CallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.qos import QoSCompatibility, qos_check_compatible
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription

from .qos import overridable

WAIT_NS = 50_000_000  # after which the thread looks whether it is to end
# messages of a topic that are handled before the next one has its turn: views wait for each other
MAX_AT_ONCE = 8


class _LeftToReader(CallbackGroup):
    """Group whose subscriptions no executor takes."""

    def can_execute(self, entity):
        return not isinstance(entity, Subscription)

    def beginning_execution(self, entity):
        return self.can_execute(entity)

    def ending_execution(self, entity):
        pass


class StreamReader:
    """Subscriptions of a node that a thread of their own serves, between start() and stop().

    on_undecodable(topic): called for a message that cannot be decoded, with the topic as it was
    subscribed to. Where a callback fails, failed(text) is called with the traceback, and nothing
    is taken any more.
    """

    def __init__(self, node, on_undecodable, failed):
        self._node = node
        self._group = _LeftToReader()
        self._on_undecodable = on_undecodable
        self._failed = failed
        self._routes = []  # (topic, Subscription, decode, callback)
        self._ending = threading.Event()
        self._thread = None

    def subscribe(self, kind, topic, callback, qos, decode=None):
        """Call callback(message, info) for every message of a topic, with the times
        received_timestamp and source_timestamp [ns, system clock] in info.

        decode(data): makes the message of its bytes, or raises ValueError; the default makes the
        one of ROS.
        """
        subscription = self._node.create_subscription(
            kind,
            topic,
            lambda _: None,
            qos,
            callback_group=self._group,
            qos_overriding_options=overridable(),
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
        )
        self._routes.append(
            (
                topic,
                subscription,
                decode or (lambda data: deserialize_message(data, kind)),
                callback,
            )
        )

    def incompatible(self):
        """A sentence for every topic on which nothing can come from a publisher, as it offers less
        than is asked for.

        Topics are told as they were subscribed to: {topic: sentence}.
        """
        out = {}
        for topic, subscription, *_ in self._routes:
            for publisher in self._node.get_publishers_info_by_topic(subscription.topic_name):
                found, why = qos_check_compatible(publisher.qos_profile, subscription.qos_profile)
                if found == QoSCompatibility.ERROR:
                    why = why.removeprefix('ERROR: ').strip(' ;.').lower()
                    out[topic] = (
                        f'topic {topic}: a publisher offers an incompatible quality of service ({why}), '
                        'nothing comes from it'
                    )
        return out

    def start(self):
        """Begin to take messages; call it from the thread that made the subscriptions."""
        self._ending.clear()
        self._thread = threading.Thread(target=self._run, name='streams', daemon=True)
        self._thread.start()

    def stop(self):
        """End after the message that is being handled, and give the subscriptions up."""
        self._ending.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()
        self._thread = None
        for _, subscription, *_ in self._routes:
            self._node.destroy_subscription(subscription)
        self._routes = []

    def _run(self):
        try:
            self._serve()
        except InvalidHandle:
            pass  # the node is being destroyed
        except Exception:  # the thread must not die in silence
            if not self._ending.is_set():
                self._failed(traceback.format_exc())

    def _serve(self):
        routes = {
            s.handle.pointer: (topic, s.msg_type, s.handle, decode, callback)
            for topic, s, decode, callback in self._routes
        }
        wait_set = rclpy_implementation.WaitSet(
            len(routes), 0, 0, 0, 0, 0, self._node.context.handle
        )
        while not self._ending.is_set() and self._node.context.ok():
            wait_set.clear_entities()
            for _, _, handle, *_ in routes.values():
                wait_set.add_subscription(handle)
            wait_set.wait(WAIT_NS)
            for pointer in wait_set.get_ready_entities('subscription'):
                self._drain(*routes[pointer])

    def _drain(self, topic, kind, handle, decode, callback):
        """Handle what has come on a subscription, but so much of it at most that the others have
        their turn.
        """
        for _ in range(MAX_AT_ONCE):
            if self._ending.is_set():
                return
            # As bytes: of a message that cannot be decoded, taking the message itself tells
            # nothing but 'none there'.
            taken = handle.take_message(kind, True)
            if taken is None:
                return
            data, info = taken
            try:
                message = decode(data)
            except (
                ValueError,
                RCLError,
                RuntimeError,
                MemoryError,
            ):  # those of rclpy as the middleware sees fit
                self._on_undecodable(topic)
                continue
            callback(message, info)
