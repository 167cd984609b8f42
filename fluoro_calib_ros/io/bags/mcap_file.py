# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Read the files of a bag; all damage is reported as DataError."""

from __future__ import annotations

import heapq
import os
import re
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

import lz4.frame
import zstandard
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.summary import Summary

from ...errors import DataError, ErrorsAt
from ...limits import MAX_CHUNK, MAX_EXPANSION, MAX_TOPICS, MEGABYTE, read_limits
from ..access import PathLike, check_regular_file, os_errors
from ..documents import read_yaml
from .metadata import Definition, parse_profiles, to_yaml

if TYPE_CHECKING:
    from rosbags.rosbag2 import Reader

MAGIC = b'\x89MCAP0\r\n'
SQLITE = b'SQLite format 3\0'  # signature of a bag with the storage sqlite3
FOOTER = struct.Struct('<BQQQI')  # opcode, length, two offsets, checksum
RECORD = struct.Struct('<BQ')  # opcode and length
MAX_RECORD = MAX_CHUNK + 1000  # bytes of a chunk and its head


class BagMessage(NamedTuple):
    """A message of a bag."""

    topic: str
    type: str
    log_time_ns: int  #: time of reception [ns]
    data: bytes  #: CDR


@dataclass(frozen=True)
class ChannelInfo:
    """A channel of a file, its schema (None if unknown) and its number of messages."""

    channel: Channel
    schema: Schema | None
    count: int = 0

    @property
    def msg_type(self) -> str:
        """Type of the messages, '' if unknown."""
        return self.schema.name if self.schema else ''

    @property
    def definition(self) -> Definition:
        """Recorded definition of the type."""
        type_hash = self.channel.metadata.get('topic_type_hash', '')
        if self.schema is None:
            return Definition('', '', type_hash)
        text = self.schema.data.decode(errors='replace')
        return Definition(text, self.schema.encoding, type_hash)

    @property
    def offered_qos(self) -> list[dict[str, Any]]:
        """QoS profiles {policy: value} of the publishers; empty if unknown."""
        return parse_profiles(self.channel.metadata.get('offered_qos_profiles', ''))


def channels_of_file(path: str) -> list[ChannelInfo]:
    """Return all channels of a file. Raises DataError for a damaged file."""
    with _open_checked(path) as file:
        summary = _complete_summary(file)
        if summary is not None and summary.statistics is not None:
            counts = summary.statistics.channel_message_counts
        else:
            summary, counts, _ = _scan(file)
        channels = summary.channels
        if len(channels) > MAX_TOPICS:
            raise DataError(
                f'{path}: the bag has {len(channels)} channels; the limit is {MAX_TOPICS}'
            )
        return [
            ChannelInfo(channel, summary.schemas.get(channel.schema_id), counts.get(number, 0))
            for number, channel in channels.items()
        ]


def start_of_file(path: str) -> int:
    """Return the time of the first message of a file [ns], 0 if unknown. Raises DataError."""
    with _open_checked(path) as file:
        summary = _complete_summary(file)
        statistics = None if summary is None else summary.statistics
        return 0 if statistics is None else statistics.message_start_time


def messages_of_file(path: str, topics: Collection[str] | None) -> Iterator[BagMessage]:
    """Yield the messages of a file in the order of log time.

    topics: names of the topics to read, None for all. Raises DataError for a damaged file.
    """
    with _open_checked(path) as file:
        summary = _complete_summary(file)
        if summary is None or not summary.chunk_indexes:
            yield from _unindexed_messages(file, topics)
        else:
            yield from _indexed_messages(file, summary, topics)


@contextmanager
def _open_checked(path: str) -> Iterator[BinaryIO]:
    """Open a file and check its beginning and end; turn errors of the reader into DataError."""
    try:
        check_regular_file(path)
        with os_errors(path, 'the bag cannot be read'), open(path, 'rb') as file:
            _check_ends(path, file)
            yield file
    except DataError:
        raise
    except (EndOfFile, struct.error):
        raise DataError(f'{path}: the bag is damaged, a record ends too early') from None
    except Exception as error:  # damaged bytes make the reader raise almost anything
        raise DataError(f'{path}: the bag is damaged ({_cause(error)})') from None


def _check_ends(path: str, file: BinaryIO) -> None:
    """Check the magic at both ends and the CRC of the summary, which the MCAP reader ignores."""
    size = file.seek(0, os.SEEK_END)
    file.seek(0)
    if size == 0:
        raise DataError(f'{path}: the file is empty')
    if file.read(len(MAGIC)) != MAGIC:
        raise DataError(f'{path}: this is not an MCAP file')
    file.seek(max(size - len(MAGIC), 0))
    if size < 2 * len(MAGIC) + FOOTER.size or file.read() != MAGIC:
        raise DataError(f'{path}: the bag is cut off, the end of the file is missing')
    file.seek(size - len(MAGIC) - FOOTER.size)
    opcode, _, start, _, crc = FOOTER.unpack(file.read(FOOTER.size))
    if opcode != Opcode.FOOTER or start > size:
        raise DataError(f'{path}: the bag is damaged, it has no footer')
    if start and crc:
        file.seek(start)
        if zlib.crc32(file.read(size - len(MAGIC) - 4 - start)) != crc:
            raise DataError(f'{path}: the bag is damaged, its summary has a wrong checksum')
    file.seek(0)


def _complete_summary(file: BinaryIO) -> Summary | None:
    """Return the summary of a file, None if it does not list all channels and their schemas."""
    summary = SeekingReader(file).get_summary()
    if summary is None:
        return None
    if not summary.channels and (summary.statistics is None or summary.statistics.channel_count):
        return None
    used_ids = {channel.schema_id for channel in summary.channels.values()} - {0}
    return summary if used_ids <= set(summary.schemas) else None


def _indexed_messages(
    file: BinaryIO, summary: Summary, topics: Collection[str] | None
) -> Iterator[BagMessage]:
    """Yield the messages of a file by its chunk index in the order of log time."""
    wanted = {
        number
        for number, channel in summary.channels.items()
        if topics is None or channel.topic in topics
    }
    indexes = [
        index
        for index in sorted(summary.chunk_indexes, key=lambda i: i.chunk_start_offset)
        if not index.message_index_offsets or wanted & set(index.message_index_offsets)
    ]

    def messages(number: int) -> Iterator[BagMessage]:
        file.seek(indexes[number].chunk_start_offset)
        limits: dict[str, Any] = {'emit_chunks': True, 'record_size_limit': MAX_RECORD}
        chunk = next(StreamReader(file, skip_magic=True, **limits).records)
        if not isinstance(chunk, Chunk):
            raise DataError(f'{file.name}: the bag is damaged, its index names no chunk')
        records = [r for r in _broken_up(file.name, chunk) if isinstance(r, Message)]
        if any(record.channel_id not in summary.channels for record in records):
            raise DataError(f'{file.name}: the bag is damaged, the topic of messages is unknown')
        records.sort(key=lambda record: record.log_time)
        return iter([_message(summary, r) for r in records if r.channel_id in wanted])

    yield from merged_by_time([index.message_start_time for index in indexes], messages)


def merged_by_time(
    starts_ns: Iterable[int], messages: Callable[[int], Iterator[BagMessage]]
) -> Iterator[BagMessage]:
    """Yield the messages of sources in the order of log time.

    starts_ns: time of the first message of each source. messages: opens a source, given by its
    number, once its first message is due: a recording may have more chunks than fit into memory,
    and more files than a process may open.
    """
    streams: dict[int, Iterator[BagMessage]] = {}
    # Next message of each source; None: it is not open
    queue: list[tuple[int, int, BagMessage | None]] = [
        (start_ns, number, None) for number, start_ns in enumerate(starts_ns)
    ]
    heapq.heapify(queue)
    while queue:
        _, number, message = queue[0]
        if message is None:
            streams[number] = messages(number)
        else:
            yield message
        following = next(streams[number], None)
        if following is None:
            heapq.heappop(queue)
            del streams[number]
        else:
            heapq.heapreplace(queue, (following.log_time_ns, number, following))


def _unindexed_messages(file: BinaryIO, topics: Collection[str] | None) -> Iterator[BagMessage]:
    """Yield the messages of a file without a chunk index in the order of log time.

    They are read sequentially if they are in this order, otherwise sorted in memory.
    """
    summary, _, ordered = _scan(file)
    messages = (
        _message(summary, record)
        for record in _records(file)
        if isinstance(record, Message)
        if topics is None or summary.channels[record.channel_id].topic in topics
    )
    yield from messages if ordered else sorted(messages, key=lambda m: m.log_time_ns)


def _message(summary: Summary, message: Message) -> BagMessage:
    channel = summary.channels[message.channel_id]
    schema = summary.schemas.get(channel.schema_id)
    return BagMessage(channel.topic, schema.name if schema else '', message.log_time, message.data)


def _scan(file: BinaryIO) -> tuple[Summary, Counter[int], bool]:
    """Read all records of a file.

    Returns its schemas and channels, the number of messages by channel, and whether they are in
    the order of log time.
    """
    summary = Summary()
    counts: Counter[int] = Counter()
    is_ordered = True
    last_ns = 0
    for record in _records(file):
        if isinstance(record, Schema):
            summary.schemas[record.id] = record
        elif isinstance(record, Channel):
            summary.channels[record.id] = record
        elif isinstance(record, Message):
            counts[record.channel_id] += 1
            is_ordered = is_ordered and record.log_time >= last_ns
            last_ns = record.log_time
    return summary, counts, is_ordered


def _records(file: BinaryIO) -> Iterator[McapRecord]:
    """Yield all records of a file, and those of its chunks in place of these."""
    file.seek(0)
    reader = StreamReader(file, emit_chunks=True, validate_crcs=True, record_size_limit=MAX_RECORD)
    for record in reader.records:
        if isinstance(record, Chunk):
            yield from _broken_up(file.name, record)
        else:
            yield record


def _broken_up(path: str, chunk: Chunk) -> list[McapRecord]:
    """Return the records of a chunk. Raises DataError, also if it would need too much memory."""
    with ErrorsAt(path):
        content = decompressed(chunk.compression, chunk.data, chunk.uncompressed_size)
    return breakup_chunk(replace(chunk, compression='', data=content), validate_crc=True)


def decompressed(compression: str, data: bytes | memoryview, size: int) -> bytes:
    """Return the content of a chunk, which states its size.

    Raises DataError if it cannot be decompressed, or would need too much memory.
    """
    if compression not in ('', 'lz4', 'zstd'):
        raise DataError(f'a chunk of the bag has the unknown compression {compression!r}')
    try:
        # A frame of zstd need not state its size
        stated = zstandard.frame_content_size(data) if compression == 'zstd' else -1
        size = size if stated < 0 else stated
        if size <= MAX_CHUNK:
            return _DECOMPRESS[compression](data, size) if size else b''
    except (zstandard.ZstdError, RuntimeError, MemoryError) as error:
        raise DataError(f'a chunk of the bag is damaged ({_cause(error)})') from None
    raise DataError(
        f'a chunk of the bag takes {size / 1e6:.0f} MB; the limit is {MAX_CHUNK / 1e6:.0f} MB'
    )


def _without_lz4(data: bytes | memoryview, size: int) -> bytes:
    """Return the content of an lz4 frame. Raises DataError unless it has the stated size."""
    decompressor = lz4.frame.LZ4FrameDecompressor()
    content: bytes = decompressor.decompress(bytes(data), max_length=size + 1)
    if len(content) != size or not decompressor.eof:
        raise DataError(f'a chunk of the bag does not have the {size} bytes that it states')
    return content


_DECOMPRESS: dict[str, Callable[[bytes | memoryview, int], bytes]] = {
    '': lambda data, _: bytes(data),
    'lz4': _without_lz4,
    'zstd': lambda data, size: zstandard.ZstdDecompressor().decompress(data, max_output_size=size),
}


def _cause(error: Exception) -> str:
    """Return the text of an exception on one line, or its type."""
    return ' '.join(str(error).split()) or type(error).__name__


# Storage files of a bag: a single .mcap file, or the files in the folder of a rosbag2 bag.

METADATA = 'metadata.yaml'
SUFFIXES = ('.mcap', '.db3')
NO_METADATA = 'this is not the metadata of a bag, or it is damaged'


def is_bag(source: PathLike) -> bool:
    """Return whether a source is a bag, judged by its files, its name, or its first bytes.

    A missing path counts as a bag if its name has no suffix. Raises DataError for a pipe.
    """
    path = Path(source)
    if path.is_dir():
        names = os.listdir(path)
        return METADATA in names or any(name.endswith('.mcap') for name in names)
    if path.suffix.lower() in SUFFIXES or not (path.suffix or path.exists()):
        return True
    check_regular_file(path)
    return _beginning(path).startswith((MAGIC, SQLITE))


def _beginning(path: PathLike) -> bytes:
    """Return the first bytes of a file, b'' if it cannot be read."""
    with suppress(OSError), open(path, 'rb') as file:
        return file.read(len(SQLITE))
    return b''


def storage_files(source: PathLike, damaged: bool = False) -> list[str]:
    """Return the paths of the .mcap files of a bag, in order.

    For a folder these are the files listed in metadata.yaml; without metadata.yaml, or if the bag
    is damaged, all .mcap files, in the order of their numbers. Raises DataError for a source that
    is not a bag.
    """
    if not os.path.lexists(source):
        raise DataError(f'{source}: there is no such bag')
    if not os.path.isdir(source):
        return [os.fspath(source)]
    if not damaged and os.path.lexists(os.path.join(source, METADATA)):
        return _listed_files(source)
    return _files_in(source)


def _files_in(source: PathLike) -> list[str]:
    """Return the paths of the .mcap files in a folder, in the order of their numbers."""
    with os_errors(source, 'the folder cannot be read'):
        names = [name for name in os.listdir(source) if name.endswith('.mcap') and name[0] != '.']
    if not names:
        raise DataError(
            f'{source}: this folder is not a bag, it has neither metadata.yaml nor an .mcap file'
        )

    def key(name: str) -> list[tuple[int, str]]:  # bag_9 before bag_10
        parts = re.split(r'([0-9]+)', name)
        return [(int(part), '') if part.isdigit() else (-1, part) for part in parts]

    return [os.path.join(source, name) for name in sorted(names, key=key)]


def bag_information(folder: PathLike) -> dict[str, Any]:
    """Return the information in metadata.yaml of a bag. Raises DataError."""
    path = os.path.join(folder, METADATA)
    document = read_yaml(path)
    information = (
        document.get('rosbag2_bagfile_information') if isinstance(document, dict) else None
    )
    if not isinstance(information, dict):
        raise DataError(f'{path}: {NO_METADATA}')
    return information


def _listed_files(source: PathLike) -> list[str]:
    """Return the paths of the files listed in metadata.yaml. Raises DataError."""
    path = os.path.join(source, METADATA)
    information = bag_information(source)
    try:
        storage = str(information['storage_identifier'])
        names = list(information['relative_file_paths'])
    except (KeyError, TypeError):
        raise DataError(f'{path}: {NO_METADATA}') from None
    if storage != 'mcap':
        raise DataError(
            f'{path}: the bag is stored as {storage}, only mcap and sqlite3 are supported; '
            f'convert it with ros2 bag convert'
        )
    if not names or not all(isinstance(name, str) for name in names):
        raise DataError(f'{path}: the bag has no files')
    paths = [os.path.join(source, os.path.basename(name)) for name in names]
    for file_path in paths:
        if not os.path.exists(file_path):
            raise DataError(
                f'{path}: it lists {os.path.basename(file_path)}, but the folder has no such file'
            )
    return paths


# Bags of other storages, read by the library rosbags: sqlite3 and compressed bags.
#
# rosbag2 compresses a bag file by file (`file`) or message by message (`message`).


def is_foreign(source: PathLike) -> bool:
    """Return whether a bag is stored in another form than uncompressed .mcap files."""
    if os.path.isdir(source):
        with suppress(DataError, KeyError):  # the reader of MCAP bags reports the error
            information = bag_information(source)
            mode = str(information.get('compression_mode') or 'none').lower()
            return str(information['storage_identifier']) == 'sqlite3' or mode != 'none'
        return False
    return os.path.isfile(source) and _beginning(source) == SQLITE


def channels_of_bag(source: PathLike) -> list[ChannelInfo]:
    """Return all channels of a bag. Raises DataError for a bag that cannot be read."""
    channels = []
    with _opened(source) as bag:
        for number, connection in enumerate(bag.connections, 1):
            text = connection.msgdef.data
            if not all(isinstance(v, str) for v in (connection.topic, connection.msgtype, text)):
                raise DataError(f'{source}: the bag is damaged, the name of a topic is not a text')
            metadata = {'topic_type_hash': connection.digest or ''}
            profiles = getattr(connection.ext, 'offered_qos_profiles', '')
            if not isinstance(profiles, str):
                # rosbags has converted some to objects
                is_plain = isinstance(profiles, list) and all(
                    isinstance(p, dict) for p in profiles
                )
                profiles = to_yaml(profiles if is_plain else [])
            metadata['offered_qos_profiles'] = profiles
            encoding = getattr(connection.ext, 'serialization_format', 'cdr')
            channel = Channel(number, connection.topic, encoding, metadata, number)
            schema = Schema(number, text.encode(), 'ros2msg', connection.msgtype)
            channels.append(ChannelInfo(channel, schema, connection.msgcount))
    return channels


def messages_of_bag(source: PathLike, topics: Collection[str] | None) -> Iterator[BagMessage]:
    """Yield the messages of a bag in the order of log time. Raises DataError."""
    with _opened(source) as bag:
        connections = [c for c in bag.connections if topics is None or c.topic in topics]
        if connections:
            for connection, time_ns, data in bag.messages(connections):
                yield BagMessage(connection.topic, connection.msgtype, time_ns, bytes(data))


def _check_unpacked_size(path: str) -> None:
    """Raise DataError for a file that the library would unpack to far more than a bag has."""
    limit = max(read_limits().max_file_bytes, MAX_EXPANSION * os.path.getsize(path))
    unpacked = 0
    with open(path, 'rb') as file, suppress(zstandard.ZstdError):  # the library reports damage
        stream = zstandard.ZstdDecompressor().stream_reader(file, read_across_frames=True)
        while unpacked <= limit and (block := stream.read(MEGABYTE)):
            unpacked += len(block)
    if unpacked > limit:
        raise DataError(
            f'{path}: unpacked, it has more than {limit / 1e6:.0f} MB, {MAX_EXPANSION} times its '
            'size; give a larger max_file_mb if it is a bag'
        )


@contextmanager
def _opened(source: PathLike) -> Iterator[Reader]:
    """Open a bag; turn every error of the library into a DataError."""
    from rosbags.rosbag2 import Reader  # loads SQLite, which a recorder does not need

    check_regular_file(source)
    for name in os.listdir(source) if os.path.isdir(source) else ():
        path = os.path.join(source, name)
        check_regular_file(path)
        if name.endswith('.zstd'):
            _check_unpacked_size(path)
    try:
        with Reader(Path(source)) as bag:
            yield bag
    except DataError:
        raise
    except Exception as error:  # a damaged bag makes the library raise almost anything
        raise DataError(f'{source}: the bag cannot be read ({_cause(error)})') from None
