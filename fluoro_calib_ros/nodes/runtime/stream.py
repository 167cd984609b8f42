# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a node counts of the stream of one fluoroscope, and the conditions of its diagnostics."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from .diagnostics import Health, LatencyWindow, RefusalLog, StallDetector, fault, warning
from .lifecycle import StreamNode
from .streams import FaultHandlers


def remember(table: OrderedDict[Any, Any], key: object, value: object, most: int) -> None:
    """Keep a value by its key; of more than that many, the oldest is forgotten."""
    table[key] = value
    if len(table) > most:
        table.popitem(last=False)


class Stream:
    """Counts of the messages of one fluoroscope; nodes add what only they count."""

    def __init__(self, name: str, refusals: RefusalLog) -> None:
        self.name = name  #: fluoroscope
        self.received = 0  #: number of messages
        #: number of messages that were lost at the input, because the queue was full
        self.overrun = 0
        self.refusals = refusals  #: streams whose messages are counted together share it
        self.stall = StallDetector()
        #: from the arrival of a message to the publication of what is made of it
        self.latencies = LatencyWindow()

    def add_latency(self, received_ns: int) -> None:
        """Add the time since the arrival of a message [ns, system clock]."""
        self.latencies.add(time.time_ns() - received_ns)

    def stalled(self) -> str:
        """Return a message where the stream has stopped, else ''; see StallDetector."""
        return self.stall.message(self.received)


def stream_faults(
    streams: Mapping[str, Stream], reader_error: Callable[[str], None]
) -> FaultHandlers:
    """Return what counts the faults of messages on <fluoroscope>/<...> in their streams."""

    def stream_of(topic: str) -> Stream:
        return streams[topic.partition('/')[0]]

    def undecodable(topic: str) -> None:
        stream = stream_of(topic)
        stream.received += 1
        stream.refusals.refuse_undecodable(topic)

    def lost(topic: str, error: Exception) -> None:
        stream_of(topic).refusals.fail(topic, error)

    def too_large(topic: str, size: int) -> None:
        stream = stream_of(topic)
        stream.received += 1
        stream.refusals.refuse_too_large(topic, size)

    def overrun(topic: str, count: int) -> None:
        stream_of(topic).overrun += count

    return FaultHandlers(undecodable, lost, reader_error, too_large, overrun)


@dataclass(frozen=True)
class InputState:
    """What the diagnostics of an input are decided by."""

    node: StreamNode
    topics: tuple[str, ...]  #: what the node subscribes to
    refusals: RefusalLog
    incompatible: Mapping[str, str]  #: messages about publishers that are not received, by topic
    recent: Mapping[str, int]  #: what was counted within the last minute; see RecentCounts


@dataclass(frozen=True)
class StreamState(InputState):
    """What the diagnostics of a stream are decided by; one of its topics suffices.

    subject: what is published there, in words.
    """

    stream: Stream
    subject: str


def lost_messages(state: InputState) -> Health | None:
    """Messages were lost by internal errors."""
    return fault(state.refusals.failure())


def incompatible_publisher(state: InputState) -> Health | None:
    """A publisher offers less than is requested."""
    found = [state.incompatible[topic] for topic in state.topics if topic in state.incompatible]
    return warning(found[0] if found else '')


def inactive_node(state: InputState) -> Health | None:
    """The node does not receive anything."""
    return warning('' if state.node.readers else 'the node is not active')


def refused_messages(state: InputState) -> Health | None:
    """Messages were refused."""
    return warning(state.refusals.refusal(state.recent['refused']))


def overrun_input(state: InputState) -> Health | None:
    """Messages were lost before the node took them."""
    count = state.recent['overrun']
    lost = (
        f'{count} messages lost at the input in the last minute: they come faster than they are '
        'taken, and the queue was full'
    )
    return warning(lost if count else '')


def unpaired_frames(state: InputState) -> Health | None:
    """Other fluoroscopes did not see the same exposures."""
    count = state.recent['unpaired']
    text = f'{count} frames without partner of the other fluoroscopes in the last minute'
    return warning(text if count else '')


def missing_publisher(state: StreamState) -> Health | None:
    """Nobody publishes the stream."""
    found = any(map(state.node.has_publisher, state.topics))
    return warning('' if found else f'no publisher of {state.subject}')


def stalled_stream(state: StreamState) -> Health | None:
    """The stream has stopped."""
    return warning(state.stream.stalled())
