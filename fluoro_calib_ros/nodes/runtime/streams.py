# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Reception of the messages of streams at laboratory frame rates.

rclpy's executors rebuild their wait set for every message, from all entities of a node. With the
services of parameters and lifecycle this costs some 0.2 ms, twice the time for handling a frame.
Therefore a dedicated thread waits for the subscriptions of streams only and receives all pending
messages; services and timers stay with the executor. Data used by both threads is replaced as a
whole, never changed in place.

Events of these subscriptions are not requested, because an event in a wait set wakes the executor
at every message. Instead, incompatible_publishers() compares offered and requested quality of
service once a second.
"""

from __future__ import annotations

import threading
import traceback
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from rclpy._rclpy_pybind11 import InvalidHandle, RCLError
from rclpy.callback_groups import CallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    QoSCompatibility,
    QoSProfile,
    qos_check_compatible,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from ...limits import read_limits
from .diagnostics import Trace
from .topics import (
    OBSERVATION_DEPTH,
    adaptation_message,
    differs,
    qos_overrides,
    reliable_if_offered,
)

WAIT_NS = 50_000_000  # interval at which the thread checks whether it has to end
# Messages of a topic that are handled before the next topic's turn: views wait for each other.
MAX_BATCH = 8
# Exceptions for a damaged message, raised by our decoders and those of the middleware.
DECODING_ERRORS = (ValueError, RCLError, RuntimeError, MemoryError)


Adaptation = Callable[[QoSProfile, Sequence[TopicEndpointInfo]], QoSProfile]

REMEMBERED = 1000  # exposures that are kept for messages about them that arrive later


def remember(
    table: OrderedDict[Any, Any], key: object, value: object, most: int = REMEMBERED
) -> None:
    """Store a value by its key as the newest; beyond `most` entries, drop the oldest."""
    table[key] = value
    table.move_to_end(key)
    if len(table) > most:
        table.popitem(last=False)


class TooLarge(ValueError):
    """Raised by a decoder for a message whose content exceeds a limit."""


class _ReaderGroup(CallbackGroup):
    """Callback group whose subscriptions are ignored by executors."""

    def can_execute(self, entity: Any) -> bool:
        return not isinstance(entity, Subscription)

    def beginning_execution(self, entity: Any) -> bool:
        return self.can_execute(entity)

    def ending_execution(self, entity: Any) -> None:
        pass


class _Route(NamedTuple):
    """A subscription, and what is done with its messages."""

    topic: str
    subscription: Subscription
    decode: Callable[..., Any]
    callback: Callable[..., Any]
    max_bytes: int
    faults: FaultHandlers
    is_first: bool  #: whether its pending messages are handled before each one of the others
    is_overridden: bool  #: whether the user has chosen another reliability

    @property
    def handle(self) -> Any:
        return self.subscription.handle

    @property
    def is_latched(self) -> bool:
        return self.subscription.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL


@dataclass(frozen=True)
class FaultHandlers:
    """Functions that a StreamReader calls when something goes wrong."""

    #: called with the topic of a message that cannot be decoded
    undecodable: Callable[[str], None]
    #: called with topic and exception if a callback raises: that message is lost
    callback_error: Callable[[str, Exception], None]
    #: called with a traceback if the thread itself fails and ends
    reader_error: Callable[[str], None]
    #: called with the topic of a message that is too large, and its size [bytes]; if None,
    #: undecodable is called
    too_large: Callable[[str, int], None] | None = None
    #: called with a topic and the number of its messages lost before they were taken, according to
    #: their sequence numbers; only for topics with one publisher that are not latched
    overrun: Callable[[str, int], None] | None = None


class StreamReader:
    """Subscriptions of a node, served by a dedicated thread between start() and stop().

    adaptation: profile of a subscription, of its present profile and its publishers.
    """

    def __init__(
        self, node: Node, faults: FaultHandlers, adaptation: Adaptation = reliable_if_offered
    ) -> None:
        self._node = node
        self._faults = faults
        self._adaptation = adaptation
        self._group = _ReaderGroup()
        self._routes: list[_Route] = []
        # number of the last message by topic, and of its publishers when it was last irregular
        self._sequence: dict[str, tuple[int, int]] = {}
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None

    def subscribe(
        self,
        kind: type,
        topic: str,
        callback: Callable[[Any, dict[str, Any]], None],
        qos: QoSProfile,
        decode: Callable[[bytes], Any] | None = None,
        max_bytes: int | None = None,
        first: FaultHandlers | None = None,
    ) -> None:
        """Subscribe to a topic, also while messages are being received.

        Parameters
        ----------
        kind : type
            Message type.
        topic : str
        callback : callable
            Called with every message and a dictionary of its times, received_timestamp and
            source_timestamp [ns, system clock].
        qos : QoSProfile
        decode : callable, optional
            Converts bytes to a message. Raises ValueError or TooLarge for a message that is then
            dropped and counted as such. By default, the deserialisation of ROS.
        max_bytes : int, optional
            Larger messages are dropped before they are decoded; by default the limit for images.
        first : FaultHandlers, optional
            Handlers of a topic whose pending messages are handled before each one of the others.
        """
        requested = qos.reliability
        subscription = self._subscription(kind, topic, qos, qos_overrides())
        self._routes.append(
            _Route(
                topic,
                subscription,
                decode or (lambda data: deserialize_message(data, kind)),
                callback,
                max_bytes=max_bytes or read_limits().max_image_bytes,
                faults=first or self._faults,
                is_first=first is not None,
                is_overridden=subscription.qos_profile.reliability != requested,
            )
        )

    def _subscription(
        self,
        kind: type,
        topic: str,
        qos: QoSProfile,
        overrides: QoSOverridingOptions | None = None,
    ) -> Subscription:
        """Return a subscription that no executor serves."""
        return self._node.create_subscription(
            kind,
            topic,
            lambda _: None,
            qos,
            callback_group=self._group,
            qos_overriding_options=overrides,
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
        )

    def topics(self) -> dict[str, bool]:
        """Return whether each subscribed topic (relative name) has a publisher."""
        return {
            route.topic: bool(self._node.count_publishers(route.subscription.topic_name))
            for route in self._routes
        }

    def adapt(self) -> None:
        """Renew subscriptions whose publishers offer something else than before, and log that.

        To be called from the thread that created the subscriptions.
        """
        renewed = {}
        for number, route in enumerate(self._routes):
            qos = self._adaptation(route.subscription.qos_profile, self._publishers(route))
            if differs(qos, route.subscription.qos_profile) and not route.is_overridden:
                renewed[number] = qos
        if not renewed:
            return
        self._halt()
        for number, qos in renewed.items():
            route = self._routes[number]
            self._take_pending(route)
            self._node.destroy_subscription(route.subscription)
            self._sequence.pop(route.topic, None)
            new = self._subscription(route.subscription.msg_type, route.topic, qos)
            self._routes[number] = route._replace(subscription=new)
            self._node.get_logger().warning(adaptation_message(route.topic, qos))
        self.start()

    def incompatible_publishers(self) -> dict[str, str]:
        """Return a message for every topic with a publisher that offers less than is requested.

        Keys are the topics as passed to subscribe(), without namespace and remapping.
        """
        messages = {}
        for route in self._routes:
            for publisher in self._publishers(route):
                result, reason = qos_check_compatible(
                    publisher.qos_profile, route.subscription.qos_profile
                )
                if result == QoSCompatibility.ERROR:
                    reason = reason.removeprefix('ERROR: ').strip(' ;.').lower()
                    messages[route.topic] = (
                        f'topic {route.topic}: a publisher offers an incompatible quality of '
                        f'service ({reason}), its messages are not received'
                    )
        return messages

    def _publishers(self, route: _Route) -> Sequence[TopicEndpointInfo]:
        return self._node.get_publishers_info_by_topic(route.subscription.topic_name)

    def start(self) -> None:
        """Start receiving; to be called from the thread that created the subscriptions."""
        self._stopping.clear()
        self._thread = threading.Thread(target=self._run, name='streams', daemon=True)
        self._thread.start()

    def stop(self, take_pending: bool = False) -> None:
        """Stop after the message that is being handled, and destroy the subscriptions.

        take_pending: whether messages that have already arrived are handled, too.
        """
        self._halt()
        for route in self._routes:
            if take_pending:
                self._take_pending(route)
        for route in self._routes:
            self._node.destroy_subscription(route.subscription)
        self._routes = []

    def _take_pending(self, route: _Route) -> None:
        """Handle the messages of a route that have already arrived; the thread is stopped."""
        self._stopping.clear()
        self._drain(route, [], route.subscription.qos_profile.depth)

    def _halt(self) -> None:
        """Stop the thread."""
        self._stopping.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()
        self._thread = None

    def _run(self) -> None:
        try:
            self._serve()
        except InvalidHandle:
            pass  # the node is being destroyed
        except Exception:  # the thread must not die silently
            if not self._stopping.is_set():
                self._faults.reader_error(Trace(traceback.format_exc()))

    def _serve(self) -> None:
        served = -1
        routes: dict[int, _Route] = {}
        wait_set: Any = None
        while not self._stopping.is_set() and self._node.context.ok():
            if len(self._routes) != served:  # a topic was added meanwhile
                routes = {route.handle.pointer: route for route in list(self._routes)}
                served = len(routes)
                wait_set = rclpy_implementation.WaitSet(
                    served, 0, 0, 0, 0, 0, self._node.context.handle
                )
            if not routes:
                self._stopping.wait(WAIT_NS * 1e-9)
                continue
            wait_set.clear_entities()
            for route in routes.values():
                wait_set.add_subscription(route.handle)
            wait_set.wait(WAIT_NS)
            first = [route for route in routes.values() if route.is_first]
            for pointer in wait_set.get_ready_entities('subscription'):
                self._drain(routes[pointer], first, MAX_BATCH)

    def _drain(self, route: _Route, first: list[_Route], most: int) -> None:
        """Handle at most `most` pending messages of a subscription.

        first: routes whose pending messages are handled before each of these.
        """
        for _ in range(most):
            if self._stopping.is_set():
                return
            # Take bytes: with messages, a damaged one could not be distinguished from none.
            received = route.handle.take_message(route.subscription.msg_type, True)
            if received is None:
                return
            for other in first:
                if other is not route:
                    self._drain(other, [], OBSERVATION_DEPTH)  # the whole queue
            self._count_overrun(route, received[1]['publication_sequence_number'])
            self._handle(route, *received)

    def _count_overrun(self, route: _Route, number: int | None) -> None:
        """Count the missing messages before the one with the given sequence number."""
        faults = route.faults
        if faults.overrun is None or number is None or route.is_latched:
            return
        last, before = self._sequence.get(route.topic, (number, 0))
        lost = number - last - 1
        publishers = before
        if lost:  # several publishers number their messages separately; so does a restarted one
            publishers = self._node.count_publishers(route.subscription.topic_name)
        self._sequence[route.topic] = number, publishers
        if lost > 0 and before == publishers == 1:
            faults.overrun(route.topic, lost)

    def _handle(self, route: _Route, data: bytes, info: dict[str, Any]) -> None:
        faults = route.faults
        try:
            if len(data) > route.max_bytes:
                raise TooLarge
            message = route.decode(data)
        except DECODING_ERRORS as error:
            if isinstance(error, TooLarge) and faults.too_large is not None:
                faults.too_large(route.topic, len(data))
            else:
                faults.undecodable(route.topic)
            return
        try:
            route.callback(message, info)
        except Exception as error:  # only this message is lost
            if not self._stopping.is_set() and self._node.context.ok():
                faults.callback_error(route.topic, error)
