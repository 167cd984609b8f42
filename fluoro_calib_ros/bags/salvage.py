# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Read what is left of a damaged or cut-off .mcap file.

The file is read from its beginning, without its index. A chunk counts if its checksum is right.
Behind damaged bytes, reading goes on at the next chunk. The layout of the records is that of the
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
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from typing import NamedTuple

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, MessageIndex, Schema, Statistics

from ..errors import DataError
from ..files.access import check_regular_file, os_error_reason
from ..limits import MAX_CHUNK

MAGIC = b'\x89MCAP0\r\n'
_HEAD = struct.Struct('<BQ')  # of a record: opcode and length
_CHUNK = struct.Struct('<QQQI')  # of a chunk: first and last time, size, checksum
_MESSAGE = struct.Struct('<HIQQ')  # of a message: channel, sequence, log and publish time
_FOOTER = struct.Struct('<BQQQI')
# Where a chunk may begin: a short record with its opcode, or the name of its compression.
_CANDIDATE = re.compile(rb'\x06[\x00-\xff]{4}\x00{4}|\x04\x00{3}zstd|\x03\x00{3}lz4')
_TO_COMPRESSION = _HEAD.size + _CHUNK.size  # bytes


class SalvagedMessage(NamedTuple):
    """A message that is intact, with the times at which it was received and sent [ns]."""

    topic: str
    log_time_ns: int
    publish_time_ns: int
    sequence: int
    data: bytes


@dataclass(frozen=True)
class SalvagedTopic:
    """A topic of a file as it was recorded: definition of its type, and QoS profiles as YAML."""

    name: str
    msg_type: str
    encoding: str  # of the messages
    schema_encoding: str
    text: str
    qos: str
    type_hash: str


@dataclass(frozen=True)
class Damage:
    """Bytes of a file that cannot be used.

    Attributes
    ----------
    path : str
    cause : str
    start_ns, end_ns : int or None
        Messages between these times may be missing [ns]; None: from the beginning, to the end.
    lost : mapping of str to int
        Number of lost messages by topic, empty where it is not known.
    """

    path: str
    cause: str
    start_ns: int | None
    end_ns: int | None
    lost: dict[str, int] = field(default_factory=dict)


class _Chunk(NamedTuple):
    content: bytes | memoryview
    end: int  # position behind it


class FileSalvage:
    """The intact messages of an .mcap file; damages are known after messages() has ended."""

    def __init__(self, path: str) -> None:
        self.path = path
        self.topics: dict[str, SalvagedTopic] = {}
        self.damages: list[Damage] = []
        self.counts: Counter[str] = Counter()
        self.expected: Counter[str] = Counter()  # number of messages, where the end is intact
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._last_ns: int | None = None
        self._open_damage: tuple[str, int | None, dict[str, int]] | None = None
        self._has_end = False

    def messages(self) -> Iterator[SalvagedMessage]:
        """Yield the intact messages in the order in which they were written.

        Raises DataError for a file that cannot be read at all.
        """
        check_regular_file(self.path)
        try:
            with open(self.path, 'rb') as file:
                if os.fstat(file.fileno()).st_size == 0:
                    self._note('the file is empty')
                    self._close_damage(None)
                    return
                with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                    self._read_summary(data)
                    yield from self._records(data)
        except OSError as error:
            raise DataError(f'{self.path}: cannot be read ({os_error_reason(error)})') from None
        if not self._has_end and self._open_damage is None:
            self._note('the end of the file is missing')
        self._close_damage(None)

    def _records(self, data: mmap.mmap) -> Iterator[SalvagedMessage]:
        """Yield the messages of the data section."""
        size = len(data)
        position = len(MAGIC)
        if data[:position] != MAGIC:
            self._note('the beginning is no MCAP file')
            position = self._next_chunk(data, 0)
        while position < size and not self._has_end:
            end = self._end_of_record(data, position)
            if end is None or data[position] == Opcode.CHUNK or _looks_like_chunk(data, position):
                chunk = _chunk_at(data, position)
                if chunk is not None:
                    yield from self._messages_of(chunk.content)
                    position = chunk.end
                    continue
                self._note_lost_chunk(data, position, end)
                position = self._next_chunk(data, position + 1)
                continue
            is_end = data[position] == Opcode.DATA_END
            # A damaged length may reach over chunks.
            chunk_at = self._next_chunk(data, position + 1, size if is_end else end)
            if chunk_at < size:
                self._note('these bytes are damaged')
                position = chunk_at
                continue
            self._has_end = is_end
            yield from self._record(data[position], data[position + _HEAD.size : end])
            position = end

    def _end_of_record(self, data: mmap.mmap, position: int) -> int | None:
        """Return the position behind a record, None where there is no complete record."""
        if position + _HEAD.size > len(data):
            return None
        opcode, length = _HEAD.unpack_from(data, position)
        end = position + _HEAD.size + length
        return end if 0 < opcode <= Opcode.DATA_END and end <= len(data) else None

    def _next_chunk(self, data: mmap.mmap, position: int, limit: int = sys.maxsize) -> int:
        """Return the position of the next intact chunk, or the end of the file.

        It is looked for as far as a limit.
        """
        for match in _CANDIDATE.finditer(data, position, limit):
            is_head = data[match.start()] == Opcode.CHUNK
            start = match.start() if is_head else match.start() - _TO_COMPRESSION
            if start >= position and _chunk_at(data, start) is not None:
                return start
        return len(data)

    def _messages_of(self, content: bytes | memoryview) -> Iterator[SalvagedMessage]:
        """Yield the messages of an intact chunk."""
        position = 0
        while position + _HEAD.size <= len(content):
            opcode, length = _HEAD.unpack_from(content, position)
            position += _HEAD.size
            yield from self._record(opcode, bytes(content[position : position + length]))
            position += length

    def _record(self, opcode: int, content: bytes) -> Iterator[SalvagedMessage]:
        """Yield the message of a record, if it is one; remember schemas and channels."""
        if opcode == Opcode.MESSAGE and len(content) >= _MESSAGE.size:
            number, sequence, received, sent = _MESSAGE.unpack_from(content)
            topic = self._topic(number)
            if topic is None:
                self._note('the topic of messages is unknown', {'(unknown)': 1})
                return
            self._close_damage(received)
            self._last_ns = received
            self.counts[topic] += 1
            yield SalvagedMessage(topic, received, sent, sequence, content[_MESSAGE.size :])
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._define(opcode, content)

    def _define(self, opcode: int, content: bytes) -> None:
        """Remember a schema or channel; one that cannot be read is a damage."""
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
        """Return the topic of a channel, None where it is not known."""
        channel = self._channels.get(number)
        if channel is None:
            return None
        if channel.topic not in self.topics:
            schema = self._schemas.get(channel.schema_id)
            self.topics[channel.topic] = SalvagedTopic(
                channel.topic,
                schema.name if schema else '',
                channel.message_encoding,
                schema.encoding if schema else '',
                schema.data.decode(errors='replace') if schema else '',
                channel.metadata.get('offered_qos_profiles', ''),
                channel.metadata.get('topic_type_hash', ''),
            )
        return channel.topic

    def _read_summary(self, data: mmap.mmap) -> None:
        """Read topics and counts of an intact end: their first chunk may be damaged."""
        size = len(data)
        footer = size - len(MAGIC) - _FOOTER.size
        if footer < len(MAGIC) or data[-len(MAGIC) :] != MAGIC:
            return
        opcode, _, start, _, checksum = _FOOTER.unpack_from(data, footer)
        if opcode != Opcode.FOOTER or not len(MAGIC) < start <= footer or not checksum:
            return
        if zlib.crc32(data[start : footer + _FOOTER.size - 4]) != checksum:
            return
        position = start
        while position < footer:
            opcode, length = _HEAD.unpack_from(data, position)
            position += _HEAD.size
            content = data[position : position + length]
            position += length
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._define(opcode, content)
            elif opcode == Opcode.STATISTICS:
                counts = Statistics.read(ReadDataStream(BytesIO(content))).channel_message_counts
                for number, count in counts.items():
                    topic = self._topic(number)
                    if topic is not None:
                        self.expected[topic] += count

    def _note_lost_chunk(self, data: mmap.mmap, position: int, end: int | None) -> None:
        """Note a damaged chunk, with what its message index says about it."""
        if end is None:
            is_cut = position + _HEAD.size > len(data) or data[position] in range(1, 16)
            self._note(
                'the file is cut off or damaged here' if is_cut else 'these bytes are damaged'
            )
            return
        lost: dict[str, int] = {}
        position = end
        while (behind := self._end_of_record(data, position)) is not None:
            if data[position] != Opcode.MESSAGE_INDEX:
                break
            try:
                content = BytesIO(data[position + _HEAD.size : behind])
                index = MessageIndex.read(ReadDataStream(content))
            except Exception:  # damaged bytes make the reader raise almost anything
                break
            topic = self._topic(index.channel_id) or '(unknown)'
            lost[topic] = lost.get(topic, 0) + len(index.records)
            position = behind
        self._note('a chunk is damaged', lost)

    def _note(self, cause: str, lost: dict[str, int] | None = None) -> None:
        """Begin a damage, or extend the one that has begun."""
        if self._open_damage is None:
            self._open_damage = (cause, self._last_ns, {})
        for topic, count in (lost or {}).items():
            known = self._open_damage[2]
            known[topic] = known.get(topic, 0) + count

    def _close_damage(self, next_ns: int | None) -> None:
        """End a damage at the time of the next message, None at the end of the file."""
        if self._open_damage is not None:
            cause, start_ns, lost = self._open_damage
            self.damages.append(Damage(self.path, cause, start_ns, next_ns, lost))
            self._open_damage = None


def _looks_like_chunk(data: mmap.mmap, position: int) -> bool:
    """Return whether a record names a compression where a chunk does."""
    start = position + _TO_COMPRESSION
    return data[start : start + 8].startswith((b'\x04\0\0\0zstd', b'\x03\0\0\0lz4'))


def _chunk_at(data: mmap.mmap, position: int) -> _Chunk | None:
    """Return the content of the chunk at a position, None unless it is intact.

    Its length is taken from its own fields: opcode and length of the record may be damaged.
    """
    start = position + _HEAD.size
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
    if content is None or not content:
        return None
    if checksum and zlib.crc32(content) != checksum:
        return None
    return _Chunk(content, position + length) if checksum or _is_whole(content) else None


def _decompressed(compression: bytes, data: memoryview, size: int) -> bytes | None:
    """Return the content of a chunk, None where it cannot be decompressed."""
    try:
        if compression == b'zstd':
            held = zstandard.frame_content_size(data)
            if not 0 <= held <= MAX_CHUNK and not 0 < size <= MAX_CHUNK:
                return None
            limit = held if held >= 0 else size
            return zstandard.ZstdDecompressor().decompress(data, max_output_size=limit)
        if compression == b'lz4':
            return lz4.frame.decompress(bytes(data)) if 0 < size <= MAX_CHUNK else None
        return bytes(data) if compression == b'' and len(data) <= MAX_CHUNK else None
    except (zstandard.ZstdError, RuntimeError, ValueError, MemoryError):
        return None
    finally:
        data.release()


def _is_whole(content: bytes) -> bool:
    """Return whether a chunk without checksum consists of whole records."""
    position = 0
    while position + _HEAD.size <= len(content):
        opcode, length = _HEAD.unpack_from(content, position)
        if opcode not in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
            return False
        position += _HEAD.size + length
    return position == len(content)
