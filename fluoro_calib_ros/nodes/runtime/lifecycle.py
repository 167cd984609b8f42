# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Base of the managed nodes, which process streams."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar, TypeVar

from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.lifecycle.node import LifecycleState
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile

from ...errors import DataError
from .diagnostics import (
    TOO_LARGE,
    USER_ERRORS,
    DiagnosticsPublisher,
    LatencyWindow,
    RateLimitedLogger,
    RecentCounts,
    RefusalLog,
    Refused,
    StallDetector,
    StartError,
    Status,
    Trace,
    one_line,
)
from .parameters import ParameterNode, declare_groups, declare_read_limits, groups_of
from .streams import FaultHandlers, StreamReader
from .topics import qos_overrides

T = TypeVar('T')


class StreamNode(ParameterNode, LifecycleNode):
    """Lifecycle node with outputs and stream readers, which publishes diagnostics once a second.

    It configures and activates itself, unless autostart is false. Subclasses override
    create_outputs(), create_readers(), diagnose(), reset() and use(). deactivate() and cleanup()
    must work in every state. A transition that raises is logged, which rclpy would not do, and
    undone; after a failed deactivate() or cleanup(), everything is cleaned up.
    """

    subject: ClassVar[str] = ''  #: messages of the streams, in words
    topics: tuple[str, ...] = ()  #: their topics, relative to each fluoroscope

    def __init__(self, name: str, settings: type[Any]) -> None:
        super().__init__(name)
        declare_read_limits(self)
        #: values of the parameters by group, of which `node` has ManagedParameters
        self.settings = declare_groups(self, settings)
        self.names: tuple[str, ...] = self.settings.node.fluoroscopes
        self._starting = False
        self._fault = ''
        self.limited_logger = RateLimitedLogger(self.get_logger())
        self.readers: list[StreamReader] = []
        self._resources = ExitStack()
        self._readiness = ''  # last logged state
        self.recent = RecentCounts()
        #: messages about publishers that cannot be received, by topic; checked once a second
        self.incompatible: dict[str, str] = {}
        for field_name, each in groups_of(settings).items():
            if each.settable:
                each.follow(self, partial(self._use_group, field_name))

    def _use_group(self, field_name: str, values: Any) -> None:
        """Apply the values of the parameters of a group, which have been set."""
        self.use(replace(self.settings, **{field_name: values}))

    def use(self, settings: Any) -> None:
        """Apply new settings from now on."""
        self.settings = settings

    def create_outputs(self) -> None:
        """Create what exists while the node is configured, by create_output() and own()."""

    def create_readers(self) -> None:
        """Create the stream readers of the active node by create_reader()."""

    def diagnose(self) -> list[Status]:
        """Return the diagnostic statuses of the node."""
        return []

    def reset(self) -> None:
        """Discard everything that was received."""

    def own(self, resource: T, destroy: Callable[..., Any], *arguments: Any) -> T:
        """Call destroy(*arguments) at cleanup, in reverse order; return the resource."""
        self._resources.callback(destroy, *arguments)
        return resource

    def create_output(self, kind: type, topic: str, qos: QoSProfile) -> Publisher:
        """Create the publisher of a stream: silent while the node is inactive, QoS overridable."""
        publisher = self.create_lifecycle_publisher(
            kind, topic, qos, qos_overriding_options=qos_overrides()
        )
        return self.own(publisher, self.destroy_publisher, publisher)

    def create_outputs_of(
        self, kind: type, topic: str, qos: Callable[[], QoSProfile]
    ) -> dict[str, Publisher]:
        """Create the publishers <fluoroscope>/<topic>, by fluoroscope."""
        return {name: self.create_output(kind, f'{name}/{topic}', qos()) for name in self.names}

    def create_input(
        self,
        kind: type,
        topic: str,
        callback: Callable[[Any], None],
        qos: QoSProfile,
        refusals: RefusalLog,
    ) -> None:
        """Subscribe to a slow topic while configured; log an exception in the callback.

        kind: message type. callback: called with every message. refusals: counts the messages for
        which the callback raises.
        """

        def guarded(message: Any) -> None:
            try:
                callback(message)
            except Exception as error:  # a message may contain anything and must not end the node
                refusals.fail(topic, error)

        subscription = self.create_subscription(kind, topic, guarded, qos)
        self.own(subscription, self.destroy_subscription, subscription)

    def create_reader(self, faults: FaultHandlers) -> StreamReader:
        """Create a StreamReader that runs while the node is active."""
        self.readers.append(StreamReader(self, faults))
        return self.readers[-1]

    def has_publisher(self, topic: str) -> bool:
        """Return whether a topic, named as in this node, has a publisher; remaps are applied."""
        return bool(self.count_publishers(self.resolve_topic_name(topic)))

    def check_active(self) -> None:
        """Raise DataError if the node is not active."""
        if not self.readers:
            raise DataError('the node is not active, so no frames come in')

    def configure(self) -> None:
        """Create outputs, slow inputs and the diagnostics."""
        self.create_outputs()
        diagnostics = DiagnosticsPublisher(self)
        self.own(diagnostics, diagnostics.close)

        def report() -> None:
            self._check_publishers()
            diagnostics.publish(self.diagnose())
            self._log_readiness()

        timer = self.create_timer(1.0, report)
        self.own(timer, self.destroy_timer, timer)

    def activate(self) -> None:
        """Start the stream readers."""
        self.create_readers()
        for reader in self.readers:
            reader.start()
        self._readiness = ''

    def _check_publishers(self) -> None:
        """Adapt the subscriptions to their publishers, and log those that are incompatible."""
        self.incompatible = {}
        for reader in self.readers:
            reader.adapt()
            self.incompatible.update(reader.incompatible_publishers())
        for message in self.incompatible.values():
            self.limited_logger.warning(message)

    def _log_readiness(self) -> None:
        """Log that the node is ready and which publishers it waits for, whenever that changes."""
        topics: dict[str, bool] = {}
        for reader in self.readers:
            for topic, published in reader.topics().items():
                # Of raw and compressed images, one suffices.
                topic = topic.removesuffix('/compressed')
                topics[topic] = topics.get(topic, False) or published
        if not topics:
            return
        missing = [topic for topic, published in topics.items() if not published]
        lead, names = ('waiting for a publisher of', missing) if missing else ('receiving', topics)
        state = f'{lead} {", ".join(names)}'
        if state != self._readiness:
            self._readiness = state
            self.get_logger().info(f'ready: {state}')

    def deactivate(self) -> None:
        """Stop the stream readers."""
        for reader in self.readers:
            reader.stop()
        self.readers = []

    def cleanup(self) -> None:
        """Destroy outputs and inputs, and discard what was received."""
        self._resources.close()
        self.recent = RecentCounts()
        self.reset()

    # -- transitions

    def bring_up(self) -> None:
        """Configure and activate the node if autostart is set. Raises StartError."""
        if not self.settings.node.autostart:
            return
        self._starting = True
        for trigger in (self.trigger_configure, self.trigger_activate):
            if trigger() != TransitionCallbackReturn.SUCCESS:
                raise StartError(self._fault)
        self._starting = False

    def stop(self) -> None:
        """Deactivate and clean up before the node is destroyed."""
        self._try(self.deactivate)
        self._try(self.cleanup)

    def destroy_node(self) -> None:
        """Destroy the node and its state machine, which would keep it in the graph."""
        super().destroy_node()
        self._state_machine.destroy_when_not_in_use()

    def destroy_publisher(self, publisher: Publisher) -> bool:
        """Destroy a publisher, possibly a lifecycle publisher."""
        return self.destroy_lifecycle_publisher(publisher)

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Run configure(); undo it if it fails."""
        return self._try(self.configure, self.cleanup)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Run activate(); undo it if it fails."""
        super().on_activate(state)
        result = self._try(self.activate, self.deactivate)
        if result != TransitionCallbackReturn.SUCCESS:
            super().on_deactivate(state)
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Run deactivate()."""
        result = self._try(self.deactivate)
        super().on_deactivate(state)
        return result

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Run cleanup()."""
        return self._try(self.cleanup)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Clean up after a transition that could not be undone; the node is unconfigured then."""
        return self._try(self.cleanup)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Deactivate and clean up."""
        self.stop()
        return TransitionCallbackReturn.SUCCESS

    def _try(
        self, function: Callable[[], None], undo: Callable[[], None] | None = None
    ) -> TransitionCallbackReturn:
        try:
            function()
        except Exception as error:
            is_user_error = isinstance(error, USER_ERRORS)
            self._fault = one_line(error) if is_user_error else Trace(traceback.format_exc())
            if not self._starting:  # otherwise the main loop logs it
                self.get_logger().error(self._fault)
            if undo is None:
                return TransitionCallbackReturn.ERROR
            undo()
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS


# Counts of the stream of one fluoroscope.


@dataclass
class Stream:
    """Counts of the messages of one fluoroscope; nodes add their own counts."""

    name: str  #: fluoroscope
    refusals: RefusalLog  #: shared by streams whose messages are counted together
    received: int = 0  #: number of messages
    overrun: int = 0  #: number of messages lost at the input, because the queue was full
    stall: StallDetector = field(default_factory=StallDetector)
    #: delays from the arrival of a message to the publication of its result
    latencies: LatencyWindow = field(default_factory=LatencyWindow)

    def add_latency(self, received_ns: int) -> None:
        """Add the time since the arrival of a message [ns, system clock]."""
        self.latencies.add(time.time_ns() - received_ns)

    def stalled(self) -> str:
        """Return a message if the stream has stopped, else ''; see StallDetector."""
        return self.stall.message(self.received)


def stream_faults(
    streams: Mapping[str, Stream], reader_error: Callable[[str], None]
) -> FaultHandlers:
    """Return handlers that count faults of messages on <fluoroscope>/<...> in their streams."""

    def stream_of(topic: str) -> Stream:
        return streams[topic.partition('/')[0]]

    def refuse(topic: str, kind: str, reason: str) -> None:
        stream = stream_of(topic)
        stream.received += 1
        stream.refusals.refuse(
            Refused(kind, f'fluoroscope {stream.name}: a message on {topic} {reason}')
        )

    def undecodable(topic: str) -> None:
        refuse(topic, 'undecodable', 'cannot be decoded')

    def lost(topic: str, error: Exception) -> None:
        stream_of(topic).refusals.fail(topic, error)

    def too_large(topic: str, size: int) -> None:
        limit = stream_of(topic).refusals.limit
        refuse(topic, TOO_LARGE, f'has {size} bytes, more than the parameter {limit} allows')

    def overrun(topic: str, count: int) -> None:
        stream_of(topic).overrun += count

    return FaultHandlers(undecodable, lost, reader_error, too_large, overrun)
