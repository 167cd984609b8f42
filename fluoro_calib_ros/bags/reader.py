"""Reading bags: an .mcap file, or a folder of rosbag2 with one or more of them."""

import heapq
import os
import re
import struct
import zlib
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import yaml
from mcap.exceptions import EndOfFile
from mcap.reader import SeekingReader
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader

from ..errors import DataError
from ..exposures.frame import Frame, validate_frame
from ..files.access import cause_of, check_safe_name, read_text
from .definitions import TARGET_OBSERVATIONS, fields_of, from_cdr, type_hash, typestore
from .qos import parse_profiles

MAGIC = b'\x89MCAP0\r\n'
FOOTER = 1 + 8 + 8 + 8 + 4  # bytes of the footer record: opcode, length, two offsets, CRC


class TopicInfo(NamedTuple):
    """A topic of a bag: type, number of messages, and offered qualities of service [{policy:
    value}, ...].
    """

    type: str
    count: int
    offered_qos: list


class BagMessage(NamedTuple):
    """A message as it stands in a bag, with the time [ns] at which it was received; data in CDR."""

    topic: str
    type: str
    log_time_ns: int
    data: bytes


@dataclass(frozen=True)
class BagContents:
    """What a bag holds for a calibration: frames {fluoroscope: [Frame, ...]} in time order,
    fluoroscopes by name; topics {fluoroscope: topic} they come from.
    """

    frames: dict
    topics: dict


def read_frames(source, check=True):
    """The BagContents of an .mcap file or a bag folder: every topic of type TargetObservations.

    The fluoroscope is the part of the topic's name before the last. check: every frame passes
    validate_frame, else only the lengths of its arrays are checked. Raises DataError that names
    bag, topic, message and cause: no bag, damaged or cut off, no such topic, another definition of
    the message, a wrong or repeated frame.
    """
    topics = {
        topic: _fluoroscope_of(source, topic)
        for topic, info in sorted(topics_of(source).items())
        if info.type == TARGET_OBSERVATIONS
    }
    if not topics:
        raise DataError(f'{source}: the bag has no topic of type {TARGET_OBSERVATIONS}')
    by_name = {name: topic for topic, name in topics.items()}
    twice = [topic for topic, name in topics.items() if by_name[name] != topic]
    if twice:
        raise DataError(
            f'{source}: the topics {twice[0]} and {by_name[topics[twice[0]]]} are both of '
            f'fluoroscope {topics[twice[0]]}'
        )
    _check_definitions(source, topics)
    frames = {name: [] for name in sorted(by_name)}
    first = {}
    for message in iterate_messages(source, topics):
        of_one = frames[topics[message.topic]]
        where = f'{source}, topic {message.topic}, message {len(of_one) + 1}'
        frame = _frame(where, topics[message.topic], message.data, check)
        key = (frame.fluoroscope, frame.number)
        if check and key in first:
            raise DataError(
                f'{where}: frame {frame.number} is there already, in message {first[key]}'
            )
        first[key] = len(of_one) + 1
        of_one.append(frame)
    empty = [topic for topic, name in topics.items() if not frames[name]]
    if len(empty) == len(topics):
        raise DataError(f'{source}: the bag has no message on {" or ".join(empty)}')
    return BagContents(
        {name: part for name, part in frames.items() if part},
        {name: topic for name, topic in sorted(by_name.items()) if frames[name]},
    )


def frame_from_message(message, fluoroscope, where):
    """Frame of a TargetObservations message, a dataclass of the typestore or of rclpy.

    Raises DataError, beginning with where, for arrays of different lengths.
    """
    ids, u, v, sigma = (
        np.array(getattr(message, name)) for name in ('target_id', 'u', 'v', 'sigma')
    )
    where = f'{where} (frame {message.frame_number})'
    for name, array in (('u', u), ('v', v)):
        if len(array) != len(ids):
            raise DataError(f'{where}: {len(ids)} target ids, but {len(array)} values of {name}')
    if len(sigma) not in (0, len(ids)):
        raise DataError(f'{where}: {len(ids)} target ids, but {len(sigma)} values of sigma')
    stamp = message.header.stamp
    return Frame(
        fluoroscope,
        int(message.frame_number),
        ids.astype(np.int64),
        np.column_stack([u, v]).astype(float),
        (int(message.image_width), int(message.image_height)),
        sigma.astype(float) if len(sigma) else None,
        stamp.sec * 10**9 + stamp.nanosec,
        message.header.frame_id,
    )


def iterate_messages(source, topics=None):
    """BagMessages of an .mcap file or a bag folder in the order of log time, a few chunks in
    memory at a time.

    topics: names, None: all. Raises DataError, also while iterating, for a bag that is damaged or
    cut off.
    """
    topics = None if topics is None else set(topics)
    parts = [_messages_of_file(path, topics) for path in storage_files(source)]
    yield from heapq.merge(*parts, key=lambda message: message.log_time_ns)


def topics_of(source):
    """Topics {name: TopicInfo} of an .mcap file or a bag folder, by name. Raises DataError."""
    out = {}
    for path in storage_files(source):
        for topic, schema, channel, count in _channels_of_file(path):
            name = schema.name if schema else ''
            known = out.get(topic, TopicInfo(name, 0, []))
            if known.type != name:
                raise DataError(
                    f'{path}: topic {topic} is of type {known.type} and of type {name}'
                )
            profiles = known.offered_qos or parse_profiles(
                channel.metadata.get('offered_qos_profiles', '')
            )
            out[topic] = TopicInfo(name, known.count + count, profiles)
    return dict(sorted(out.items()))


def storage_files(source):
    """Paths of the .mcap files of a source: itself, or of a bag folder those its metadata.yaml
    names, and where that is missing all in the order of their numbers. Raises DataError.
    """
    if not os.path.lexists(source):
        raise DataError(f'{source}: there is no such bag')
    if not os.path.isdir(source):
        return [os.fspath(source)]
    if os.path.lexists(os.path.join(source, 'metadata.yaml')):
        return _files_of_metadata(source, os.path.join(source, 'metadata.yaml'))
    try:
        names = [name for name in os.listdir(source) if name.endswith('.mcap') and name[0] != '.']
    except OSError as error:
        raise DataError(f'{source}: the folder cannot be read ({cause_of(error)})') from None
    if not names:
        raise DataError(
            f'{source}: this folder is no bag, it has neither metadata.yaml nor an .mcap file'
        )
    return [os.path.join(source, name) for name in sorted(names, key=_natural)]


def _natural(name):
    """Sort key in which bag_10 comes behind bag_9."""
    return [
        (int(part), '') if part.isdigit() else (-1, part) for part in re.split(r'([0-9]+)', name)
    ]


def _files_of_metadata(source, path):
    try:
        information = yaml.safe_load(read_text(path))['rosbag2_bagfile_information']
        storage = str(information['storage_identifier'])
        names = list(information['relative_file_paths'])
        compressed = information.get('compression_mode')
    except (yaml.YAMLError, KeyError, TypeError, AttributeError):
        raise DataError(f'{path}: this is not the metadata of a bag, or it is damaged') from None
    if storage != 'mcap':
        raise DataError(
            f'{path}: the bag is stored as {storage}, only mcap is read; convert it with ros2 bag convert'
        )
    if compressed and str(compressed).lower() != 'none':
        raise DataError(
            f'{path}: the files of the bag are compressed as a whole; convert it with ros2 bag convert'
        )
    if not names or not all(isinstance(name, str) for name in names):
        raise DataError(f'{path}: the bag has no files')
    paths = [os.path.join(source, os.path.basename(name)) for name in names]
    missing = [path for path in paths if not os.path.exists(path)]
    if missing:
        raise DataError(
            f'{path}: it names {os.path.basename(missing[0])}, but there is no such file in the folder'
        )
    return paths


@contextmanager
def _opened(path):
    """The file path, open and checked from outside; whatever a reader stumbles over in it is a
    DataError.
    """
    try:
        with open(path, 'rb') as file:
            _check_ends(path, file)
            yield file
    except DataError:
        raise
    except OSError as error:
        raise DataError(f'{path}: the bag cannot be read ({cause_of(error)})') from None
    except (EndOfFile, struct.error):
        raise DataError(f'{path}: the bag is damaged, a record ends too early') from None
    except Exception as error:  # the readers meet bytes that may be anything
        raise DataError(f'{path}: the bag is damaged ({_one_line(error)})') from None


def _check_ends(path, file):
    """Check the magic at both ends and the CRC of the summary, which the readers do not."""
    size = file.seek(0, os.SEEK_END)
    file.seek(0)
    if size == 0:
        raise DataError(f'{path}: the file is empty')
    if file.read(len(MAGIC)) != MAGIC:
        raise DataError(f'{path}: this is not an MCAP file')
    file.seek(max(size - len(MAGIC), 0))
    if size < 2 * len(MAGIC) + FOOTER or file.read() != MAGIC:
        raise DataError(f'{path}: the bag is cut off, the end of the file is missing')
    file.seek(size - len(MAGIC) - FOOTER)
    opcode, _, start, _, crc = struct.unpack('<BQQQI', file.read(FOOTER))
    if opcode != 2 or start > size:
        raise DataError(f'{path}: the bag is damaged, it has no footer')
    if start and crc:
        file.seek(start)
        if zlib.crc32(file.read(size - len(MAGIC) - 4 - start)) != crc:
            raise DataError(f'{path}: the bag is damaged, its summary has a wrong checksum')
    file.seek(0)


def _channels_of_file(path):
    """[(topic, Schema or None, Channel, number of messages)] of every channel in a file."""
    with _opened(path) as file:
        summary = _summary(file)
        if summary is not None and summary.statistics is not None:
            counts = summary.statistics.channel_message_counts
            return [
                (
                    channel.topic,
                    summary.schemas.get(channel.schema_id),
                    channel,
                    counts.get(number, 0),
                )
                for number, channel in summary.channels.items()
            ]
        schemas, channels, counts, _ = _scan(file)
        return [
            (channel.topic, schemas.get(channel.schema_id), channel, counts.get(number, 0))
            for number, channel in channels.items()
        ]


def _messages_of_file(path, topics):
    """BagMessages of a file in the order of log time."""
    with _opened(path) as file:
        summary = _summary(file)
        if summary is None or not summary.chunk_indexes:
            yield from _unindexed_messages(file, topics)
            return
        reader = SeekingReader(file, validate_crcs=True)
        for schema, channel, message in reader.iter_messages(topics=topics):
            yield BagMessage(
                channel.topic, schema.name if schema else '', message.log_time, message.data
            )


def _summary(file):
    """Summary of a file, None where it has none that tells all channels and schemas."""
    summary = SeekingReader(file).get_summary()
    if summary is None or (
        not summary.channels and (summary.statistics is None or summary.statistics.channel_count)
    ):
        return None
    needed = {channel.schema_id for channel in summary.channels.values()} - {0}
    return summary if needed <= set(summary.schemas) else None


def _unindexed_messages(file, topics):
    """BagMessages of a file without chunk index, as they stand if that is their order, else sorted
    in memory.
    """
    *_, ordered = _scan(file)
    messages = _linear_messages(file, topics)
    yield from messages if ordered else sorted(messages, key=lambda message: message.log_time_ns)


def _linear_messages(file, topics):
    schemas = {}
    channels = {}
    for record in _records(file):
        if isinstance(record, Schema):
            schemas[record.id] = record.name
        elif isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, Message):
            channel = channels[record.channel_id]
            if topics is None or channel.topic in topics:
                yield BagMessage(
                    channel.topic, schemas.get(channel.schema_id, ''), record.log_time, record.data
                )


def _scan(file):
    """Schemas, channels and numbers of messages of a file by id, and whether its messages are in
    time order.
    """
    schemas = {}
    channels = {}
    counts = {}
    ordered = True
    last = 0
    for record in _records(file):
        if isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, Message):
            counts[record.channel_id] = counts.get(record.channel_id, 0) + 1
            ordered = ordered and record.log_time >= last
            last = record.log_time
    return schemas, channels, counts, ordered


def _records(file):
    file.seek(0)
    return StreamReader(file, validate_crcs=True).records


def _check_definitions(source, topics):
    """Check that a bag defines TargetObservations as this program does. Raises DataError."""
    for path in storage_files(source):
        for topic, schema, channel, _ in _channels_of_file(path):
            if topic not in topics:
                continue
            if channel.message_encoding != 'cdr':
                raise DataError(
                    f'{path}, topic {topic}: the messages are encoded as {channel.message_encoding!r}, '
                    f'only cdr is read'
                )
            try:
                same = _same_definition(schema, channel.metadata.get('topic_type_hash', ''))
            except DataError as error:
                raise DataError(f'{path}, topic {topic}: {error}') from None
            if not same:
                raise DataError(
                    f'{path}, topic {topic}: the bag defines {TARGET_OBSERVATIONS} differently from this '
                    f'program'
                )


def _same_definition(schema, recorded_hash):
    """Whether a definition in a bag has our fields; where it has no text its hash decides, if it
    has one.
    """
    if schema.data.strip():
        fields = fields_of(
            TARGET_OBSERVATIONS, schema.data.decode(errors='replace'), schema.encoding
        )
        ours = typestore().fielddefs
        return all(name in ours and ours[name][1] == of_one for name, of_one in fields.items())
    return recorded_hash in ('', type_hash(TARGET_OBSERVATIONS))


def _fluoroscope_of(source, topic):
    parts = [part for part in topic.split('/') if part]
    if len(parts) < 2:
        raise DataError(
            f'{source}: topic {topic} does not tell the fluoroscope, '
            f'<fluoroscope>/target_observations is expected'
        )
    check_safe_name(parts[-2], f'{source}, topic {topic}')
    return parts[-2]


def _frame(where, fluoroscope, data, check):
    try:
        message = from_cdr(data, TARGET_OBSERVATIONS)
    except DataError as error:
        raise DataError(f'{where}: {error}') from None
    frame = frame_from_message(message, fluoroscope, where)
    try:
        if check:
            validate_frame(frame)
    except DataError as error:
        raise DataError(f'{where}: {error}') from None
    return frame


def _one_line(error):
    text = ' '.join(str(error).split())
    return text[:120] or type(error).__name__
