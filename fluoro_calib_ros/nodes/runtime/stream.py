# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a node counts of the stream of one fluoroscope, and the faults of its messages."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

from .diagnostics import LatencyWindow, RefusalLog, StallDetector
from .streams import FaultHandlers


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
