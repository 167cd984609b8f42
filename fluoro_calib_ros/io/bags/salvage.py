# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Read the intact parts of a damaged or cut-off .mcap file.

The file is read from its beginning, without its index. A chunk is used if its checksum is correct.
After damaged bytes, reading continues at the next chunk. The layout of the records is that of the
MCAP specification (https://mcap.dev/spec).
"""

from __future__ import annotations

import mmap
import os
import re
import struct
import sys
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from io import BytesIO
from typing import NamedTuple

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, MessageIndex, Schema, Statistics

from ...errors import DataError
from ..access import PathLike, opened
from .mcap_file import (
    FOOTER,
    MAGIC,
    RECORD,
    ChannelInfo,
    bag_information,
    decompressed,
    storage_files,
)
from .metadata import (
    PACKAGE,
    TARGET_OBSERVATIONS,
    fluoroscope_of_topic,
    profile,
    typestore,
)
from .writer import BagWriter

_CHUNK = struct.Struct('<QQQI')  # chunk: first and last time, size, checksum
_MESSAGE = struct.Struct('<HIQQ')  # message: channel, sequence, log and publish time
# Possible beginnings of a chunk: a short record with its opcode, or the name of its compression.
_CANDIDATE = re.compile(rb'\x06[\x00-\xff]{4}\x00{4}|\x04\x00{3}zstd|\x03\x00{3}lz4')
_TO_COMPRESSION = RECORD.size + _CHUNK.size  # offset in a chunk record [bytes]


class SalvagedMessage(NamedTuple):
    """An intact message, with its times of reception and publication [ns]."""

    topic: str
    log_time_ns: int
    publish_time_ns: int
    data: bytes


@dataclass(frozen=True)
class Damage:
    """Damaged bytes of a file."""

    path: str
    cause: str
    #: messages between these times may be missing [ns]; None: since the beginning, until the end
    start_ns: int | None
    end_ns: int | None
    #: number of lost messages by topic; empty if unknown
    lost: dict[str, int] = field(default_factory=dict)


class FileSalvage:
    """The intact messages of an .mcap file; damages are complete after messages() has ended."""

    def __init__(self, path: str) -> None:
        self.path = path
        self.topics: dict[str, ChannelInfo] = {}
        self.damages: list[Damage] = []
        self.expected: Counter[str] = Counter()  # if the end of the file is intact
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._last_ns: int | None = None
        self._open_damage: Damage | None = None
        self._has_end = False

    def messages(self) -> Iterator[SalvagedMessage]:
        """Yield the intact messages in the order in which they were written.

        Raises DataError for a file that cannot be read at all.
        """
        with opened(self.path) as file:
            if os.fstat(file.fileno()).st_size == 0:
                self._note('the file is empty')
                self._close_damage(None)
                return
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                self._read_summary(data)
                yield from self._records(data)
        if not self._has_end and self._open_damage is None:
            self._note('the end of the file is missing')
        self._close_damage(None)

    def _records(self, data: mmap.mmap) -> Iterator[SalvagedMessage]:
        """Yield the messages of the data section."""
        size = len(data)
        position = len(MAGIC)
        if data[:position] != MAGIC:
            self._note('the beginning is not an MCAP file')
            position = self._next_chunk(data, 0)
        while position < size and not self._has_end:
            end = self._end_of_record(data, position)
            if end is None or data[position] == Opcode.CHUNK or _looks_like_chunk(data, position):
                chunk = _chunk_at(data, position)
                if chunk is not None:
                    content, position = chunk
                    for opcode, start, stop in _records_of(content):
                        yield from self._record(opcode, content[start:stop])
                    continue
                self._note_lost_chunk(data, position, end)
                position = self._next_chunk(data, position + 1)
                continue
            is_end = data[position] == Opcode.DATA_END
            # A damaged length may span several chunks.
            chunk_at = self._next_chunk(data, position + 1, size if is_end else end)
            if chunk_at < size:
                self._note('these bytes are damaged')
                position = chunk_at
                continue
            self._has_end = is_end
            yield from self._record(data[position], data[position + RECORD.size : end])
            position = end

    def _end_of_record(self, data: mmap.mmap, position: int) -> int | None:
        """Return the position after a record, None if there is no complete record."""
        if position + RECORD.size > len(data):
            return None
        opcode, length = RECORD.unpack_from(data, position)
        end = position + RECORD.size + length
        return end if 0 < opcode <= Opcode.DATA_END and end <= len(data) else None

    def _next_chunk(self, data: mmap.mmap, position: int, limit: int = sys.maxsize) -> int:
        """Return the position of the next intact chunk, the end of the file if there is none.

        The search ends at limit.
        """
        for match in _CANDIDATE.finditer(data, position, limit):
            is_head = data[match.start()] == Opcode.CHUNK
            start = match.start() if is_head else match.start() - _TO_COMPRESSION
            if start >= position and _chunk_at(data, start) is not None:
                return start
        return len(data)

    def _record(self, opcode: int, content: bytes) -> Iterator[SalvagedMessage]:
        """Yield the message if the record is one; store schemas and channels."""
        if opcode == Opcode.MESSAGE and len(content) >= _MESSAGE.size:
            number, _, received, sent = _MESSAGE.unpack_from(content)
            topic = self._topic(number)
            if topic is None:
                self._note('the topic of messages is unknown', {'(unknown)': 1})
                return
            self._close_damage(received)
            self._last_ns = received
            yield SalvagedMessage(topic, received, sent, content[_MESSAGE.size :])
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._define(opcode, content)

    def _define(self, opcode: int, content: bytes) -> None:
        """Store a schema or channel; count an unreadable one as damage."""
        try:
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(ReadDataStream(BytesIO(content)))
                self._schemas[schema.id] = schema
            else:
                channel = Channel.read(ReadDataStream(BytesIO(content)))
                self._channels[channel.id] = channel
        except Exception:  # damaged bytes make the reader raise almost anything
            self._note('the definition of a topic is damaged')

    def _topic(self, number: int) -> str | None:
        """Return the topic of a channel, None if unknown."""
        channel = self._channels.get(number)
        if channel is None:
            return None
        if channel.topic not in self.topics:
            schema = self._schemas.get(channel.schema_id)
            self.topics[channel.topic] = ChannelInfo(channel, schema)
        return channel.topic

    def _read_summary(self, data: mmap.mmap) -> None:
        """Read topics and counts from an intact end; the first chunk may be damaged."""
        size = len(data)
        footer = size - len(MAGIC) - FOOTER.size
        if footer < len(MAGIC) or data[-len(MAGIC) :] != MAGIC:
            return
        opcode, _, start, _, checksum = FOOTER.unpack_from(data, footer)
        if opcode != Opcode.FOOTER or not len(MAGIC) < start <= footer or not checksum:
            return
        if zlib.crc32(data[start : footer + FOOTER.size - 4]) != checksum:
            return
        for opcode, position, stop in _records_of(data, start, footer):
            content = data[position:stop]
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._define(opcode, content)
            elif opcode == Opcode.STATISTICS:
                counts = Statistics.read(ReadDataStream(BytesIO(content))).channel_message_counts
                for number, count in counts.items():
                    topic = self._topic(number)
                    if topic is not None:
                        self.expected[topic] += count

    def _note_lost_chunk(self, data: mmap.mmap, position: int, end: int | None) -> None:
        """Record a damaged chunk, with the message counts in the index that follows it."""
        if end is None:
            is_cut = position + RECORD.size > len(data) or data[position] in range(1, 16)
            self._note(
                'the file is cut off or damaged here' if is_cut else 'these bytes are damaged'
            )
            return
        lost: dict[str, int] = {}
        position = end
        while (index_end := self._end_of_record(data, position)) is not None:
            if data[position] != Opcode.MESSAGE_INDEX:
                break
            try:
                content = BytesIO(data[position + RECORD.size : index_end])
                index = MessageIndex.read(ReadDataStream(content))
            except Exception:  # damaged bytes make the reader raise almost anything
                break
            topic = self._topic(index.channel_id) or '(unknown)'
            lost[topic] = lost.get(topic, 0) + len(index.records)
            position = index_end
        self._note('a chunk is damaged', lost)

    def _note(self, cause: str, lost: dict[str, int] | None = None) -> None:
        """Begin a damage, or extend the current one."""
        if self._open_damage is None:
            self._open_damage = Damage(self.path, cause, self._last_ns, None)
        counts = self._open_damage.lost
        for topic, count in (lost or {}).items():
            counts[topic] = counts.get(topic, 0) + count

    def _close_damage(self, next_ns: int | None) -> None:
        """End the current damage at the time of the next message, None at the end of the file."""
        if self._open_damage is not None:
            self.damages.append(replace(self._open_damage, end_ns=next_ns))
            self._open_damage = None


def _records_of(
    content: bytes | memoryview | mmap.mmap, position: int = 0, end: int | None = None
) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, begin and end of the content of each record between two positions."""
    while position + RECORD.size <= (len(content) if end is None else end):
        opcode, length = RECORD.unpack_from(content, position)
        position += RECORD.size + length
        yield opcode, position - length, position


def _looks_like_chunk(data: mmap.mmap, position: int) -> bool:
    """Return whether a record has the name of a compression at the position of a chunk's."""
    start = position + _TO_COMPRESSION
    return data[start : start + 8].startswith((b'\x04\0\0\0zstd', b'\x03\0\0\0lz4'))


def _chunk_at(data: mmap.mmap, position: int) -> tuple[bytes, int] | None:
    """Return the content of the chunk at a position and its end, None unless it is intact.

    Its length is taken from its own fields: opcode and length of the record may be damaged.
    """
    start = position + RECORD.size
    if start + _CHUNK.size + 4 > len(data):
        return None
    _, _, size, checksum = _CHUNK.unpack_from(data, start)
    position = start + _CHUNK.size
    (length,) = struct.unpack_from('<I', data, position)
    position += 4
    if length > 4 or position + length + 8 > len(data):
        return None
    compression = data[position : position + length]
    position += length
    (length,) = struct.unpack_from('<Q', data, position)
    position += 8
    if position + length > len(data):
        return None
    content = _decompressed(compression, memoryview(data)[position : position + length], size)
    if not content or (checksum and zlib.crc32(content) != checksum):
        return None
    return (content, position + length) if checksum or _is_whole(content) else None


def _decompressed(compression: bytes, data: memoryview, size: int) -> bytes | None:
    """Return the content of a chunk, None if it cannot be decompressed."""
    with suppress(DataError), data:
        return decompressed(compression.decode(errors='replace'), data, size) or None
    return None


def _is_whole(content: bytes) -> bool:
    """Return whether a chunk without checksum consists of complete records."""
    data_opcodes = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
    records = list(_records_of(content))
    if not records or any(opcode not in data_opcodes for opcode, *_ in records):
        return False
    return records[-1][-1] == len(content)


# Recovery of a bag: all intact messages of a damaged or cut-off bag are written as a valid bag.


@dataclass(frozen=True)
class Recovery:
    """Result of the recovery of a bag."""

    counts: dict[str, int]  #: number of recovered messages by topic
    #: original number of messages by topic, as far as the bag states it
    expected: dict[str, int]
    damages: tuple[Damage, ...]
    skipped: dict[str, str]  #: reason for each topic that was skipped

    @property
    def lost(self) -> dict[str, int]:
        """Number of messages that are known to be lost, by topic."""
        return dict(Counter(self.expected) - Counter(self.counts))


class Salvage:
    """The intact messages of a bag, file by file; topics and damages of the parts read so far."""

    def __init__(self, source: PathLike) -> None:
        self.files = [FileSalvage(path) for path in storage_files(source, damaged=True)]
        self._metadata = _expected_of_metadata(source)

    def messages(self) -> Iterator[tuple[FileSalvage, SalvagedMessage]]:
        """Yield file and message in the order in which they were written. Raises DataError."""
        for file in self.files:
            for message in file.messages():
                yield file, message

    @property
    def damages(self) -> tuple[Damage, ...]:
        """All damages that were found."""
        return tuple(damage for file in self.files for damage in file.damages)

    @property
    def expected(self) -> dict[str, int]:
        """Original number of messages by topic, as far as the bag states it."""
        total: Counter[str] = Counter()
        for file in self.files:
            total += file.expected
        return {**total, **self._metadata}


def recover_bag(source: PathLike, out: PathLike) -> Recovery:
    """Write the intact messages of a bag to a new one, which must not exist.

    Raises DataError for a source without any intact message, and if the bag cannot be written.
    """
    salvage = Salvage(source)
    if os.path.realpath(out).startswith(os.path.join(os.path.realpath(source), '')):
        raise DataError(f'{out}: the output is inside the input {source}, choose another output')
    counts: Counter[str] = Counter()
    skipped: dict[str, str] = {}
    with BagWriter(out) as bag:
        for file, message in salvage.messages():
            topic = file.topics[message.topic]
            if message.topic not in counts and message.topic not in skipped:
                reason = _added(bag, topic)
                if reason:
                    skipped[message.topic] = reason
            if message.topic in skipped:
                continue
            bag.write(
                message.topic,
                topic.msg_type,
                message.data,
                message.log_time_ns,
                message.publish_time_ns,
            )
            counts[message.topic] += 1
        if not counts:
            causes = sorted({damage.cause for damage in salvage.damages} | {*skipped.values()})
            raise DataError(
                f'{source}: nothing can be recovered ({"; ".join(causes) or "no messages"})'
            )
    return Recovery(dict(sorted(counts.items())), salvage.expected, salvage.damages, skipped)


def _added(bag: BagWriter, topic: ChannelInfo) -> str:
    """Add a topic to a bag; return the reason if that is not possible, otherwise ''."""
    encoding = topic.channel.message_encoding
    if encoding != 'cdr':
        return f'the messages are encoded as {encoding!r}'
    profiles = topic.offered_qos or [profile()]
    try:
        bag.add_topic(topic.channel.topic, topic.msg_type, profiles, topic.definition)
    except DataError as error:
        return str(error)
    return ''


def _expected_of_metadata(source: PathLike) -> dict[str, int]:
    """Return the message counts by topic in metadata.yaml, {} if unavailable."""
    try:
        return {
            str(entry['topic_metadata']['name']): int(entry['message_count'])
            for entry in bag_information(source)['topics_with_message_count']
        }
    except (DataError, KeyError, TypeError, ValueError):
        return {}


# Report on the content of a bag and its faults, also for damaged bags.

JUMP_NS = 1_000_000  # a decrease of time by more than this is a clock that runs backwards
STREAM_NS = 100_000_000  # maximum usual interval between messages of a stream
GAP = 10  # a gap is longer than this multiple of the usual interval
_NUMBERED = (TARGET_OBSERVATIONS, f'{PACKAGE}/msg/CorrectedObservations')


@dataclass
class TopicReport:
    """Content of a topic."""

    type: str
    #: times of reception, and times of the headers, if any [ns]
    log_ns: list[int] = field(default_factory=list)
    stamp_ns: list[int] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)  #: frame numbers, for observations only
    undecodable: int = 0  #: number of messages whose header cannot be read

    @property
    def interval_ns(self) -> float:
        """Median time between messages [ns], from stamps if available; NaN for a single one."""
        times = self.stamp_ns if len(self.stamp_ns) > 1 else self.log_ns
        return float(np.median(np.diff(times))) if len(times) > 1 else float('nan')

    @property
    def longest_gap_s(self) -> float:
        """Longest time between two messages [s], by stamps or by reception."""
        steps = [np.diff(t).max() for t in (self.stamp_ns, self.log_ns) if len(t) > 1]
        return float(max(steps, default=0)) * 1e-9

    @property
    def has_gap(self) -> bool:
        """Whether a stream was interrupted; only messages with a header are a stream."""
        interval_ns = self.interval_ns
        return (
            len(self.stamp_ns) > 1
            and 0 < interval_ns < STREAM_NS
            and self.longest_gap_s * 1e9 > max(GAP * interval_ns, STREAM_NS)
        )

    @property
    def backward_jumps(self) -> int:
        """Number of times that a clock ran backwards."""
        return sum(
            int((np.diff(times) < -JUMP_NS).sum()) for times in (self.log_ns, self.stamp_ns)
        )

    @property
    def restarts(self) -> int:
        """Number of times that the frame numbers restarted."""
        return int((np.diff(self.numbers) < 0).sum())

    @property
    def repeated_frames(self) -> int:
        """Number of frames that repeat the number of the previous frame."""
        return int((np.diff(self.numbers) == 0).sum())

    @property
    def missing_frames(self) -> int:
        """Number of frame numbers that were skipped."""
        steps = np.diff(self.numbers)
        return int((steps[steps > 1] - 1).sum())

    @property
    def faults(self) -> list[str]:
        """Sentences about everything that is wrong."""
        faults = []
        if self.has_gap:
            faults.append(
                f'a gap of {self.longest_gap_s:.3f} s, the usual interval is '
                f'{self.interval_ns * 1e-6:.1f} ms'
            )
        if self.backward_jumps:
            faults.append(f'the clock runs backwards {_times(self.backward_jumps)}')
        if self.missing_frames:
            noun = 'frame is' if self.missing_frames == 1 else 'frames are'
            faults.append(f'{self.missing_frames} {noun} missing in the frame numbers')
        if self.repeated_frames:
            faults.append(f'{self.repeated_frames} frame numbers are repeated')
        if self.restarts:
            faults.append(f'the frame numbers restart {_times(self.restarts)}')
        if self.undecodable:
            faults.append(f'{self.undecodable} messages are too short for their type')
        return faults


@dataclass(frozen=True)
class BagReport:
    """Content of a bag, and its damages."""

    files: list[str]
    topics: dict[str, TopicReport]
    #: by fluoroscope, number of frames whose number is missing for another fluoroscope
    without_partner: dict[str, int]
    damages: tuple[Damage, ...]
    lost: dict[str, int]  #: number of messages that are known to be lost, by topic

    @property
    def faults(self) -> list[str]:
        """Sentences about everything that is wrong."""
        faults = [f'{d.path}: {d.cause}' for d in self.damages]
        faults += [f'{topic}: {count} messages are lost' for topic, count in self.lost.items()]
        for topic, report in self.topics.items():
            faults += [f'{topic}: {text}' for text in report.faults]
        faults += [
            f'fluoroscope {name}: {count} {"frame" if count == 1 else "frames"} without partner'
            for name, count in self.without_partner.items()
            if count
        ]
        return faults


def inspect_bag(source: PathLike) -> BagReport:
    """Read a bag, also a damaged one, and report on it.

    Raises DataError for a source that is not a bag.
    """
    salvage = Salvage(source)
    topics: dict[str, TopicReport] = {}
    for file, message in salvage.messages():
        report = topics.get(message.topic)
        if report is None:
            report = topics[message.topic] = TopicReport(file.topics[message.topic].msg_type)
        report.log_ns.append(message.log_time_ns)
        _read_header(report, message.data)
    if not topics and salvage.damages:
        raise DataError(f'{source}: nothing can be read ({salvage.damages[0].cause})')
    counts = {topic: len(report.log_ns) for topic, report in topics.items()}
    return BagReport(
        [file.path for file in salvage.files],
        dict(sorted(topics.items())),
        _without_partner(topics),
        salvage.damages,
        dict(Counter(salvage.expected) - Counter(counts)),
    )


def _read_header(report: TopicReport, data: bytes) -> None:
    """Read stamp and frame number of a message if its type has them."""
    fields = typestore().fielddefs.get(report.type)
    if fields is None or not fields[1] or 'std_msgs/msg/Header' not in str(fields[1][0]):
        return
    order = '<' if data[1:2] == b'\x01' else '>'
    try:
        sec, nanosec, length = struct.unpack_from(f'{order}iII', data, 4)
        report.stamp_ns.append(sec * 10**9 + nanosec)
        if report.type in _NUMBERED:
            offset = 12 + length
            (number,) = struct.unpack_from(f'{order}I', data, 4 + offset + -offset % 4)
            report.numbers.append(number)
    except struct.error:
        report.undecodable += 1


def _without_partner(topics: Mapping[str, TopicReport]) -> dict[str, int]:
    """Return the number of frames without partner by fluoroscope; {} for a single fluoroscope."""
    numbers: dict[str, Counter[int]] = {}
    for topic, report in topics.items():
        if report.type == TARGET_OBSERVATIONS and topic.count('/') > 1:
            numbers[fluoroscope_of_topic(topic)] = Counter(report.numbers)
    if len(numbers) < 2:
        return {}
    common = Counter(next(iter(numbers.values())))
    for counter in numbers.values():
        common &= counter
    return {name: (counter - common).total() for name, counter in sorted(numbers.items())}


def _times(count: int) -> str:
    return 'once' if count == 1 else f'{count} times'
