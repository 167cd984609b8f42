# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Record messages as they arrive: a thread writes them from a queue and flushes them to disk.

Also contains the options for playing bags.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from ...errors import DataError
from ...options import option, validate_options
from ..access import PathLike
from .metadata import Definition
from .writer import BagWriter, check_topic_name

SMALL_BYTES = 65536  # larger messages are taken for images
LARGE_SHARE = 0.9  # share of the queue for large messages, so that images do not displace frames


@dataclass(frozen=True)
class RecordingOptions:
    """Options of a recording. Raises ValueError for an invalid value."""

    split_size: float = option(
        0.0, 'size after which a new file is begun; 0: never', minimum=0.0, maximum=1e7, unit='MB'
    )
    split_duration: float = option(
        0.0, 'time after which a new file is begun; 0: never', minimum=0.0, maximum=1e7, unit='s'
    )
    flush_period: float = option(
        1.0,
        'longest time after which chunks are closed and flushed to disk',
        minimum=0.05,
        maximum=60.0,
        unit='s',
    )
    queue_size: float = option(
        256.0,
        'messages that may wait for the disk; more are dropped and counted',
        minimum=1.0,
        maximum=1e5,
        unit='MB',
    )

    def __post_init__(self) -> None:
        validate_options(self)


@dataclass(frozen=True)
class PlayingOptions:
    """Options for playing a bag."""

    rate: float = option(1.0, 'speed relative to the recording', minimum=0.001, maximum=1e6)
    loop: bool = option(False, 'whether the bag is played repeatedly')
    start_offset: float = option(
        0.0,
        'time after the first message at which playing begins; earlier latched messages are '
        'published first',
        minimum=0.0,
        maximum=1e9,
        unit='s',
    )
    start_paused: bool = option(
        False, 'whether to wait for the services ~/pause (data: false) or ~/step'
    )
    clock: float = option(
        0.0,
        'rate at which the time of the recording is published on /clock; 0: not at all',
        minimum=0.0,
        maximum=1000.0,
        unit='Hz',
    )


MAX_LATCHED = 100


class TopicToRecord(NamedTuple):
    """A topic, its type, the offered QoS profiles, and the definition of the type.

    latched: number of its last messages that are repeated at the start of each file, at most
    MAX_LATCHED: those that a node would receive which begins to listen then.
    """

    name: str
    msg_type: str
    qos: list[dict[str, Any]]
    definition: Definition
    latched: int = 0


class _Message(NamedTuple):
    topic: str
    data: bytes
    received_ns: int
    sent_ns: int


class Recording:
    """A bag that is being recorded, from start() to stop().

    put() never waits. If the disk is slower than the messages, they wait in a queue of limited
    size; messages that do not fit are dropped and counted, large ones first. Every flush_period
    the open chunk is closed and flushed to disk, so that a crash or a power failure loses no more
    than that. If the disk is full, messages that were not flushed count as dropped.
    """

    def __init__(self, path: PathLike, options: RecordingOptions | None = None) -> None:
        self.path = path
        self.options = options or RecordingOptions()
        self.counts: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()
        self._unflushed: Counter[str] = Counter()  # written, but possibly not yet on disk
        self.fault = ''  # reason why nothing is written any more
        self.waiting_bytes = 0
        self.most_waiting_bytes = 0
        self._writer = BagWriter(path, live=True)
        self._topics: dict[str, TopicToRecord] = {}
        self._latched: dict[str, deque[_Message]] = {}
        self._queue: deque[_Message | TopicToRecord] = deque()
        self._condition = threading.Condition()
        self._stopping = False
        self._file_start = 0.0
        self._thread = threading.Thread(target=self._run, name='recording', daemon=True)

    @property
    def files(self) -> int:
        """Number of files so far."""
        return self._writer.file_count

    def start(self) -> None:
        """Create the bag and begin to record. Raises DataError if that fails."""
        self._writer.__enter__()
        self._file_start = time.monotonic()
        self._thread.start()

    def add_topic(self, topic: TopicToRecord) -> None:
        """Add a topic before its first message, or change the number of its latched messages.

        Raises DataError for a name that is not that of a ROS topic.
        """
        check_topic_name(topic.name, self._writer.path)
        with self._condition:
            self._queue.append(topic)
            self._condition.notify()

    def put(self, topic: str, data: bytes, received_ns: int, sent_ns: int) -> bool:
        """Queue a message; return False if it had to be dropped."""
        with self._condition:
            share = 1.0 if len(data) <= SMALL_BYTES else LARGE_SHARE
            is_full = self.waiting_bytes + len(data) > share * self.options.queue_size * 1e6
            if self.fault or (is_full and self.waiting_bytes):
                self.dropped[topic] += 1
                return False
            self._queue.append(_Message(topic, data, received_ns, sent_ns))
            self.waiting_bytes += len(data)
            self.most_waiting_bytes = max(self.most_waiting_bytes, self.waiting_bytes)
            self._condition.notify()
        return True

    def stop(self) -> None:
        """Write queued messages, close the file, write metadata.yaml; `fault` reports errors."""
        with self._condition:
            self._stopping = True
            self._condition.notify()
        self._thread.join()
        try:
            self._writer.__exit__(None, None, None)
        except DataError as error:
            self._fail(self.fault or str(error), [])

    def _run(self) -> None:
        flushed = time.monotonic()
        while not self.fault:
            with self._condition:
                if not self._queue and not self._stopping:
                    self._condition.wait(max(flushed + self._period_s - time.monotonic(), 0))
                items = list(self._queue)
                self._queue.clear()
                if not items and self._stopping:
                    return
            try:
                for number, item in enumerate(items):
                    self._write(item)
                    items[number] = None  # type: ignore[call-overload]  # frees its memory
                    flushed = self._flush_if_due(flushed)
                flushed = self._flush_if_due(flushed)
            except Exception as error:  # a bug must not end the recording silently
                fault = f'{self.path}: the recording failed unexpectedly: {error!r}'
                fault = str(error) if isinstance(error, DataError) else fault
                self._fail(fault, [item for item in items if item is not None])

    @property
    def _period_s(self) -> float:
        """Time between two flushes [s]: half a period, which leaves time for the flush itself."""
        return 0.5 * self.options.flush_period

    def _flush_if_due(self, flushed: float) -> float:
        """Flush written data to disk if due; return the time of the last flush."""
        if time.monotonic() - flushed <= self._period_s:
            return flushed
        self._writer.flush(to_disk=True)
        self._unflushed.clear()
        return time.monotonic()

    def _fail(self, fault: str, items: list[_Message | TopicToRecord]) -> None:
        """Stop writing; count all messages that are not on disk as dropped."""
        with self._condition:
            self.fault = fault
            self.counts -= self._unflushed  # messages of the open chunk
            self.dropped += self._unflushed
            self._unflushed.clear()
            for item in (*items, *self._queue):
                if isinstance(item, _Message):
                    self.dropped[item.topic] += 1
            self._queue.clear()
            self.waiting_bytes = 0

    def _write(self, item: _Message | TopicToRecord) -> None:
        if isinstance(item, TopicToRecord):
            if item.name not in self._topics:
                self._writer.add_topic(item.name, item.msg_type, item.qos, item.definition)
            self._topics[item.name] = item
            if item.latched:
                self._latched.setdefault(item.name, deque(maxlen=MAX_LATCHED))
            return
        if self._is_full():
            self._writer.split()
            self._file_start = time.monotonic()
            for topic, messages in self._latched.items():
                for message in list(messages)[-self._topics[topic].latched :]:
                    self._write_message(message._replace(received_ns=item.received_ns))
        self._write_message(item)
        self.counts[item.topic] += 1
        self._unflushed[item.topic] += 1
        if item.topic in self._latched:
            self._latched[item.topic].append(item)
        with self._condition:
            self.waiting_bytes -= len(item.data)

    def _write_message(self, message: _Message) -> None:
        self._writer.write(
            message.topic,
            self._topics[message.topic].msg_type,
            message.data,
            message.received_ns,
            message.sent_ns,
        )

    def _is_full(self) -> bool:
        """Return whether a new file is due."""
        size = self.options.split_size * 1e6
        duration = self.options.split_duration
        return bool(
            (size and self._writer.file_bytes >= size)
            or (duration and time.monotonic() - self._file_start >= duration)
        )


def lost_text(dropped: Mapping[str, int]) -> str:
    """Return the numbers of dropped messages by topic, as text."""
    return ', '.join(f'{topic} {count}' for topic, count in sorted(dropped.items()))
