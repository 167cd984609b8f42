# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Bags are written as by rosbag2, reproducible and readable by others; all faults are reported."""

import io
import os
import resource
import struct
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from mcap.reader import NonSeekingReader, make_reader
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
from rigs import write_frame
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.io.bags.mcap_file import storage_files
from fluoro_calib_ros.io.bags.metadata import (
    TARGET_OBSERVATIONS,
    frame_from_message,
    from_cdr,
    full_text,
    message_from_frame,
    observations_topic,
    to_cdr,
    type_hash,
    typestore,
)
from fluoro_calib_ros.io.bags.reader import iterate_messages, read_frames, topics_of
from fluoro_calib_ros.io.bags.writer import BagWriter

SIZE = (1024, 960)
START = 1_700_000_000_000_000_000
TOPIC = '/a/target_observations'


def frame(fluoroscope='a', number=0, targets=30, sigma=True, **changes):
    rng = np.random.default_rng(number)
    values = dict(
        fluoroscope=fluoroscope,
        number=number,
        target_id=rng.permutation(503)[:targets],
        uv=rng.uniform(0, 900, (targets, 2)),
        image_size=SIZE,
        sigma=rng.uniform(0.1, 1, targets) if sigma else None,
        stamp_ns=START + number * 100_000_000,
        frame_id=f'{fluoroscope}_optical',
    )
    return Frame(**{**values, **changes})


def some_frames(number=6):
    return [frame(name, i, sigma=i % 2 == 0) for i in range(number) for name in 'ab']


def write_bag(path, frames=None, split_bytes=0, **options):
    """Write a bag; split_bytes: size after which the next file begins, 0 for never."""
    with BagWriter(path, **options) as writer:
        for one in some_frames() if frames is None else frames:
            if split_bytes and writer.file_bytes >= split_bytes:
                writer.split()
            write_frame(writer, one)
            if split_bytes:
                writer.flush()
    return str(path)


def message_of(function, *arguments):
    """Return the sentence of the DataError that a call raises."""
    with pytest.raises(DataError) as caught:
        function(*arguments)
    assert '\n' not in str(caught.value)
    return str(caught.value)


def same(one, two):
    return (
        (one.fluoroscope, one.number, one.image_size, one.stamp_ns, one.frame_id)
        == (two.fluoroscope, two.number, two.image_size, two.stamp_ns, two.frame_id)
        and np.array_equal(one.target_id, two.target_id)
        and np.array_equal(one.uv, two.uv)
        and ((one.sigma is None and two.sigma is None) or np.array_equal(one.sigma, two.sigma))
    )


def assert_holds(source, frames):
    """Check that a bag gives exactly these frames in this order."""
    read = read_frames(source).frames
    for name in {f.fluoroscope for f in frames}:
        wanted = [f for f in frames if f.fluoroscope == name]
        assert len(read[name]) == len(wanted) and all(map(same, read[name], wanted))
    assert sum(map(len, read.values())) == len(frames)


def mcap_file(
    path,
    messages,
    schema=None,
    compression=CompressionType.NONE,
    schema_name=TARGET_OBSERVATIONS,
    encoding='ros2msg',
    metadata=None,
    message_encoding='cdr',
    **options,
):
    """Write an .mcap file of messages [(topic, log time, bytes)] by the library of its authors."""
    with open(path, 'wb') as file:
        writer = Writer(file, compression=compression, enable_crcs=False, **options)
        writer.start('ros2', 'someone else')
        text = full_text(TARGET_OBSERVATIONS) if schema is None else schema
        schema_id = writer.register_schema(schema_name, encoding, text.encode())
        channels = {}
        for topic, time, data in messages:
            if topic not in channels:
                channels[topic] = writer.register_channel(
                    topic, message_encoding, schema_id, metadata or {}
                )
            writer.add_message(channels[topic], time, data, time)
        writer.finish()
    return str(path)


def cdr(one=None, **changes):
    message = message_from_frame(one or frame())
    for name, value in changes.items():
        setattr(message, name, value)
    return to_cdr(message, TARGET_OBSERVATIONS)


# ---------------------------------------------------------------- round trips


@pytest.mark.parametrize(
    'options', [{}, {'live': True}, {'split_bytes': 2000}], ids=['usual', 'live', 'split']
)
def test_frames_round_trip_is_exact(tmp_path, options):
    frames = some_frames(12)
    path = write_bag(tmp_path / 'run', frames, **options)
    assert_holds(path, frames)
    files = [name for name in os.listdir(path) if name.endswith('.mcap')]
    assert (len(files) > 2) == ('split_bytes' in options)
    os.remove(tmp_path / 'run' / 'metadata.yaml')
    assert_holds(path, frames)
    if len(files) == 1:
        assert_holds(str(tmp_path / 'run' / 'run_0.mcap'), frames)


def test_namespaces_topics_and_qos_profiles(tmp_path):
    with BagWriter(tmp_path / 'run') as writer:
        write_frame(writer, frame('a'), topic='/rig/a/target_observations')
        write_frame(writer, frame('b'), topic='/other/b/target_observations')
        hello = typestore().types['std_msgs/msg/String']('hello')
        writer.write('/text', 'std_msgs/msg/String', hello, START, START - 5, qos='latched')
        writer.add_topic('/silent', 'std_msgs/msg/Empty')
    topics = topics_of(tmp_path / 'run')
    assert list(topics) == [
        '/other/b/target_observations',
        '/rig/a/target_observations',
        '/silent',
        '/text',
    ]
    assert [info.count for info in topics.values()] == [1, 1, 0, 1]
    latched = topics['/text'].offered_qos[0]
    assert (latched['durability'], latched['depth']) == ('transient_local', 1)
    assert topics['/silent'].offered_qos[0] == {
        **topics['/silent'].offered_qos[0],
        'history': 'keep_last',
        'reliability': 'reliable',
        'durability': 'volatile',
    }
    contents = read_frames(tmp_path / 'run')
    assert contents.topics == {
        'a': '/rig/a/target_observations',
        'b': '/other/b/target_observations',
    }
    assert observations_topic('a') == TOPIC


def test_messages_are_read_in_time_order(tmp_path):
    frames = some_frames(10)
    for options in ({}, {'split_bytes': 3000}):
        path = write_bag(tmp_path / 'run', frames[::-1], overwrite=True, **options)
        times = [message.log_time_ns for message in iterate_messages(path)]
        assert times == sorted(times) and len(times) == 20
    only = list(iterate_messages(path, topics=[TOPIC]))
    assert len(only) == 10 and {message.topic for message in only} == {TOPIC}
    assert same(frame_from_message(from_cdr(only[3].data, only[3].type), 'a'), frames[6])


@pytest.mark.parametrize(
    'options',
    [
        {},
        {'use_chunking': False},
        {'compression': CompressionType.LZ4},
        {'use_statistics': False},
        {'repeat_channels': False, 'repeat_schemas': False},
        {
            'use_chunking': False,
            'use_statistics': False,
            'repeat_channels': False,
            'repeat_schemas': False,
            'use_summary_offsets': False,
        },
    ],
    ids=['plain', 'unchunked', 'lz4', 'no statistics', 'no repeats', 'no summary'],
)
def test_mcap_variants_are_read(tmp_path, options):
    frames = [frame(number=i) for i in (3, 1, 2)]
    messages = [(TOPIC, one.stamp_ns, cdr(one)) for one in frames]
    path = mcap_file(tmp_path / 'x.mcap', messages, **options)
    assert_holds(path, [frame(number=i) for i in (1, 2, 3)])
    assert topics_of(path)[TOPIC].count == 3


def test_split_files_without_metadata_are_read_in_numerical_order(tmp_path):
    for number in (0, 2, 10, 1):
        mcap_file(tmp_path / f'run_{number}.mcap', [(TOPIC, 5, cdr(frame(number=number)))])
    assert [os.path.basename(path) for path in storage_files(tmp_path)] == [
        'run_0.mcap',
        'run_1.mcap',
        'run_2.mcap',
        'run_10.mcap',
    ]
    assert [one.number for one in read_frames(tmp_path).frames['a']] == [0, 1, 2, 10]


def test_frame_from_a_message_without_sigma():
    header = SimpleNamespace(stamp=SimpleNamespace(sec=3, nanosec=7), frame_id='x')
    message = SimpleNamespace(
        header=header,
        frame_number=5,
        image_width=8,
        image_height=9,
        target_id=[1, 2],
        u=[1.0, 2.0],
        v=[3.0, 4.0],
        sigma=[],
    )
    one = frame_from_message(message, 'a')
    assert (
        one.stamp_ns == 3_000_000_007 and one.uv.tolist() == [[1, 3], [2, 4]] and one.sigma is None
    )


# ---------------------------------------------------------------- the same bytes, as written
# by rosbag2


def test_same_messages_give_the_same_bytes(tmp_path):
    for folder in ('1', '2'):
        write_bag(tmp_path / folder / 'run')
    for name in ('run_0.mcap', 'metadata.yaml'):
        assert (tmp_path / '1/run' / name).read_bytes() == (tmp_path / '2/run' / name).read_bytes()


def test_metadata_is_version_9_of_rosbag2(tmp_path):
    write_bag(tmp_path / 'run', split_bytes=4000)
    information = yaml.safe_load((tmp_path / 'run/metadata.yaml').read_text())[
        'rosbag2_bagfile_information'
    ]
    assert list(information) == [
        'version',
        'storage_identifier',
        'duration',
        'starting_time',
        'message_count',
        'topics_with_message_count',
        'compression_format',
        'compression_mode',
        'relative_file_paths',
        'files',
        'custom_data',
        'ros_distro',
    ]
    assert (information['version'], information['storage_identifier']) == (9, 'mcap')
    assert information['ros_distro'] == 'jazzy' and information['custom_data'] is None
    assert information['compression_format'] == information['compression_mode'] == ''
    assert information['starting_time'] == {'nanoseconds_since_epoch': START}
    assert (
        information['duration'] == {'nanoseconds': 500_000_000}
        and information['message_count'] == 12
    )
    assert information['relative_file_paths'] == [file['path'] for file in information['files']]
    assert information['relative_file_paths'][:2] == ['run_0.mcap', 'run_1.mcap']
    assert sum(file['message_count'] for file in information['files']) == 12
    topic = information['topics_with_message_count'][0]
    assert topic['message_count'] == 6
    assert topic['topic_metadata']['type_description_hash'] == type_hash(TARGET_OBSERVATIONS)
    infinite = {'sec': 9223372036, 'nsec': 854775807}
    assert topic['topic_metadata']['offered_qos_profiles'] == [
        {
            'history': 'keep_last',
            'depth': 10,
            'reliability': 'reliable',
            'durability': 'volatile',
            'deadline': infinite,
            'lifespan': infinite,
            'liveliness': 'automatic',
            'liveliness_lease_duration': infinite,
            'avoid_ros_namespace_conventions': False,
        }
    ]


def test_file_has_the_records_of_rosbag2(tmp_path):
    write_bag(tmp_path / 'run')
    with open(tmp_path / 'run/run_0.mcap', 'rb') as file:
        reader = make_reader(file)
        assert reader.get_header().profile == 'ros2'
        summary = reader.get_summary()
        assert {chunk.compression for chunk in summary.chunk_indexes} == {'zstd'}
        metadata = [
            record.metadata['serialized_metadata']
            for record in reader.iter_metadata()
            if record.name == 'rosbag2'
        ]
    outside = yaml.safe_load((tmp_path / 'run/metadata.yaml').read_text())[
        'rosbag2_bagfile_information'
    ]
    assert yaml.safe_load(metadata[-1]) == outside
    (schema,) = summary.schemas.values()
    assert (schema.name, schema.encoding) == (TARGET_OBSERVATIONS, 'ros2msg')
    parts = schema.data.decode().split('=' * 80 + '\n')
    assert [part.splitlines()[0] for part in parts[1:]] == [
        'MSG: std_msgs/Header',
        'MSG: builtin_interfaces/Time',
    ]
    for channel in summary.channels.values():
        assert channel.message_encoding == 'cdr'
        assert set(channel.metadata) == {'offered_qos_profiles', 'topic_type_hash'}
        assert (
            yaml.safe_load(channel.metadata['offered_qos_profiles'])[0]['reliability']
            == 'reliable'
        )


def test_type_hashes_agree_with_ros():
    # Expected hashes: /opt/ros/jazzy/share/std_msgs/msg/*.json, and rosidl's for our messages.
    assert (
        type_hash('std_msgs/msg/Header')
        == 'RIHS01_f49fb3ae2cf070f793645ff749683ac6b06203e41c891e17701b1cb597ce6a01'
    )
    assert (
        type_hash(TARGET_OBSERVATIONS)
        == 'RIHS01_28e36f830a53c4f32ca4ec7fb79fbcf47a7f54f67fd2cee70de93e9b793e9cff'
    )


# ---------------------------------------------------------------- independent readers


def test_mcap_library_reads_written_bags_with_checksums(tmp_path):
    write_bag(tmp_path / 'run', some_frames(60))
    content = (tmp_path / 'run/run_0.mcap').read_bytes()
    records = list(StreamReader(io.BytesIO(content), validate_crcs=True, emit_chunks=True).records)
    assert any(getattr(record, 'data_section_crc', 0) for record in records)
    assert all(
        record.uncompressed_crc for record in records if hasattr(record, 'uncompressed_crc')
    )
    for reader in (
        make_reader(io.BytesIO(content), validate_crcs=True),
        NonSeekingReader(io.BytesIO(content), True),
    ):
        assert sum(1 for _ in reader.iter_messages()) == 120


def test_rosbags_reads_written_bags(tmp_path):
    frames = some_frames(20)
    path = write_bag(tmp_path / 'run', frames, split_bytes=6000)
    with Reader(path) as reader:
        assert (reader.message_count, reader.ros_distro, reader.start_time) == (40, 'jazzy', START)
        assert reader.duration == 19 * 100_000_000 + 1
    with AnyReader([Path(path)], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        messages = [
            reader.deserialize(data, connection.msgtype)
            for connection, _, data in reader.messages()
        ]
    assert [m.frame_number for m in messages] == [f.number for f in frames]
    assert (
        np.array_equal(messages[7].u, frames[7].uv[:, 0])
        and messages[7].header.frame_id == 'b_optical'
    )


def test_bag_written_by_rosbags_is_read(tmp_path):
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as RosbagsWriter

    frames = [frame(number=i) for i in range(5)]
    with RosbagsWriter(
        tmp_path / 'theirs', version=8, storage_plugin=StoragePlugin.MCAP
    ) as writer:
        connection = writer.add_connection(TOPIC, TARGET_OBSERVATIONS, typestore=typestore())
        for one in frames:
            writer.write(connection, one.stamp_ns, cdr(one))
    assert_holds(tmp_path / 'theirs', frames)


# ---------------------------------------------------------------- crash safety


def test_exception_leaves_no_bag(tmp_path):
    with pytest.raises(RuntimeError), BagWriter(tmp_path / 'run') as writer:
        write_frame(writer, frame())
        raise RuntimeError
    assert os.listdir(tmp_path) == []


def test_exception_leaves_an_existing_bag(tmp_path):
    path = write_bag(tmp_path / 'run')
    with pytest.raises(RuntimeError), BagWriter(path, overwrite=True) as writer:
        write_frame(writer, frame())
        raise RuntimeError
    assert os.listdir(tmp_path) == ['run']
    assert_holds(path, some_frames())


def test_recording_keeps_messages_before_an_exception(tmp_path):
    with pytest.raises(RuntimeError), BagWriter(tmp_path / 'run', live=True) as writer:
        write_frame(writer, frame())
        writer.flush()
        assert (tmp_path / 'run/run_0.mcap').stat().st_size > 1000
        raise RuntimeError
    assert_holds(tmp_path / 'run', [frame()])


def test_only_bags_are_overwritten_and_only_on_request(tmp_path):
    path = write_bag(tmp_path / 'run')
    assert 'is not overwritten' in message_of(write_bag, path)
    write_bag(path, [frame()], overwrite=True)
    assert_holds(path, [frame()])
    assert sorted(os.listdir(tmp_path)) == ['run', 'run.previous']
    assert_holds(tmp_path / 'run.previous', some_frames())
    (tmp_path / 'run.previous/notes.txt').write_text('precious')
    with pytest.raises(DataError, match=r'notes\.txt'):
        write_bag(path, overwrite=True)
    (tmp_path / 'run/thesis.doc').write_text('precious')
    for options in ({'live': True, 'overwrite': True}, {'overwrite': True}):
        with pytest.raises(DataError, match=r'thesis\.doc'):
            write_bag(path, **options)
    (tmp_path / 'file').write_text('')
    with pytest.raises(DataError, match='not a bag folder'):
        write_bag(tmp_path / 'file', overwrite=True)
    assert_holds(path, [frame()])


def test_full_disk_is_reported_and_leaves_nothing(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, 'No space left on device')

    with (
        pytest.raises(DataError, match='no space left on device'),
        BagWriter(tmp_path / 'run') as writer,
    ):
        write_frame(writer, frame())
        monkeypatch.setattr(os, 'fsync', full)
    assert os.listdir(tmp_path) == []
    (tmp_path / 'file').write_text('')
    with pytest.raises(DataError, match='the bag cannot be written'):
        write_bag(tmp_path / 'file' / 'run')


@pytest.mark.parametrize(
    'arguments, sentence',
    [
        (('a/b', TARGET_OBSERVATIONS, b'', 0), "'a/b' cannot be the name of a ROS topic"),
        (('/c-arm/x', TARGET_OBSERVATIONS, b'', 0), "'/c-arm/x' cannot be the name"),
        (('/x', 'some_msgs/msg/Thing', b'', 0), "'some_msgs/msg/Thing' is not known"),
        (('/x', 'std_msgs/msg/Empty', b'', -1), '-1 ns is not a time that a bag can hold'),
        (('/x', 'std_msgs/msg/String', 'hello', 0), 'not a message of type std_msgs/msg/String'),
        ((TOPIC, 'std_msgs/msg/Empty', b'', 0), 'does not belong to this topic of type'),
    ],
)
def test_invalid_messages_are_reported(tmp_path, arguments, sentence):
    with BagWriter(tmp_path / 'run') as writer:
        write_frame(writer, frame())
        assert sentence in message_of(writer.write, *arguments)
    assert_holds(tmp_path / 'run', [frame()])


# ---------------------------------------------------------------- faults of a bag


def test_sources_that_are_not_bags(tmp_path):
    def said(path):
        text = message_of(read_frames, path)
        assert text.startswith(str(path)) and text == message_of(topics_of, path)
        return text

    assert 'there is no such bag' in said(tmp_path / 'missing')
    assert 'this folder is not a bag' in said(tmp_path)
    (tmp_path / 'x.mcap').write_bytes(b'')
    assert 'empty' in said(tmp_path / 'x.mcap')
    (tmp_path / 'x.mcap').write_bytes(b'hello, this is a text and no bag')
    assert 'not an MCAP file' in said(tmp_path / 'x.mcap')
    (tmp_path / 'metadata.yaml').write_text('a: [')
    assert 'metadata.yaml, row 2: this is not YAML' in message_of(read_frames, tmp_path)


@pytest.mark.parametrize(
    'change, sentence',
    [
        (
            {'relative_file_paths': ['run_0.mcap', 'run_1.mcap']},
            'it lists run_1.mcap, but the folder has no such file',
        ),
        ({'storage_identifier': 'leveldb'}, 'stored as leveldb, only mcap and sqlite3 are'),
        ({'storage_identifier': 'sqlite3'}, ': the bag cannot be read ('),
        ({'compression_mode': 'FILE'}, ': the bag cannot be read ('),
        ({'relative_file_paths': []}, 'has no files'),
        ({'relative_file_paths': 5}, 'not the metadata of a bag'),
        ({'storage_identifier': None}, 'stored as None'),
    ],
)
def test_inconsistent_metadata_is_reported(tmp_path, change, sentence):
    write_bag(tmp_path / 'run')
    path = tmp_path / 'run/metadata.yaml'
    metadata = yaml.safe_load(path.read_text())
    metadata['rosbag2_bagfile_information'].update(change)
    path.write_text(yaml.safe_dump(metadata))
    said = message_of(read_frames, str(tmp_path / 'run'))
    assert said.startswith(str(path.parent)) and sentence in said and '\n' not in said


def test_bags_without_observations(tmp_path):
    with BagWriter(tmp_path / 'empty'):
        pass
    assert 'no topic of type fluoro_calib_msgs' in message_of(read_frames, str(tmp_path / 'empty'))
    assert topics_of(tmp_path / 'empty') == {} and list(iterate_messages(tmp_path / 'empty')) == []
    with BagWriter(tmp_path / 'silent') as writer:
        writer.add_topic(TOPIC, TARGET_OBSERVATIONS)
    assert f'no message on {TOPIC}' in message_of(read_frames, str(tmp_path / 'silent'))


def test_truncated_bag_is_reported(tmp_path):
    write_bag(tmp_path / 'run')
    path = tmp_path / 'run/run_0.mcap'
    content = path.read_bytes()
    for length in (
        7,
        8,
        30,
        500,
        len(content) // 2,
        len(content) - 40,
        len(content) - 8,
        len(content) - 1,
    ):
        path.write_bytes(content[:length])
        for read in (read_frames, topics_of, lambda source: list(iterate_messages(source))):
            assert str(path) in message_of(read, str(path))
            assert str(path) in message_of(read, str(tmp_path / 'run'))


def test_recording_of_more_files_than_may_be_open_is_read(tmp_path, monkeypatch):
    """Files whose times overlap are merged."""
    monkeypatch.setattr(os, 'fsync', lambda _: None)
    count = 20
    with BagWriter(tmp_path / 'run', live=True) as bag:
        for number in range(1, count + 1):
            for log_time in (100 * number, 100 * number + 150):
                write_frame(bag, frame(number=number), log_time_ns=log_time)
            bag.split()
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    open_files = len(os.listdir('/proc/self/fd'))
    resource.setrlimit(resource.RLIMIT_NOFILE, (open_files + 10, limits[1]))
    try:
        times = [message.log_time_ns for message in iterate_messages(tmp_path / 'run')]
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)
    assert times == sorted(times) and len(times) == 2 * count


@pytest.mark.long
def test_changed_byte_is_reported_or_irrelevant(tmp_path):
    frames = some_frames(20)
    write_bag(tmp_path / 'run', frames)
    path = tmp_path / 'run/run_0.mcap'
    content = path.read_bytes()
    told = 0
    for place in np.linspace(0, len(content) - 1, 300).astype(int):
        damaged = bytearray(content)
        damaged[place] ^= 0x55
        path.write_bytes(damaged)
        try:
            assert_holds(str(path), frames)
        except DataError as error:
            assert str(path) in str(error) and '\n' not in str(error)
            told += 1
    assert told > 200


@pytest.mark.long
def test_damaged_bag_without_checksums_raises_only_data_errors(tmp_path):
    path = mcap_file(
        tmp_path / 'x.mcap', [(TOPIC, i, cdr(frame(number=i, targets=5))) for i in range(5)]
    )
    content = (tmp_path / 'x.mcap').read_bytes()
    for place in range(0, len(content), 7):
        damaged = bytearray(content)
        damaged[place] ^= 0xFF
        (tmp_path / 'x.mcap').write_bytes(damaged)
        for read in (read_frames, topics_of, lambda source: list(iterate_messages(source))):
            try:
                read(path)
            except DataError as error:
                assert '\n' not in str(error)


def test_damaged_footer_is_reported(tmp_path):
    write_bag(tmp_path / 'run')
    path = tmp_path / 'run/run_0.mcap'
    content = path.read_bytes()
    for summary in (1, len(content) - 30, 2**63, 2**64 - 1):
        footer = struct.pack('<BQQQI', 2, 20, summary, 0, 0)
        path.write_bytes(content[:-37] + footer + content[-8:])
        assert str(path) in message_of(read_frames, str(path))


WRONG = [
    (dict(u=np.zeros(29)), '30 target ids, but 29 values of u'),
    (dict(v=np.zeros(31)), '30 target ids, but 31 values of v'),
    (dict(sigma=np.ones(3)), '30 target ids, but 3 values of sigma'),
    (dict(u=np.full(30, np.nan)), 'is not a number'),
    (dict(u=np.full(30, 5000.0)), 'is outside the image'),
    (dict(sigma=np.zeros(30)), 'is not a positive number'),
    (dict(target_id=np.full(30, 7, dtype=np.uint32)), 'target 7 occurs 30 times'),
    (dict(image_width=0), 'the image size is 0 x 960 px'),
    (
        dict(target_id=np.zeros(0, np.uint32), u=np.zeros(0), v=np.zeros(0), sigma=np.zeros(0)),
        'the frame is empty',
    ),
]


@pytest.mark.parametrize('changes, sentence', WRONG, ids=[sentence for _, sentence in WRONG])
def test_invalid_frame_is_reported_with_bag_topic_and_message(tmp_path, changes, sentence):
    messages = [(TOPIC, 1, cdr(frame(number=4))), (TOPIC, 2, cdr(frame(number=8), **changes))]
    path = mcap_file(tmp_path / 'x.mcap', messages)
    said = message_of(read_frames, path)
    assert (
        said.startswith(f'{path}, topic {TOPIC}, message 2')
        and 'frame 8' in said
        and sentence in said
    )


def test_validation_of_frames_can_be_switched_off(tmp_path):
    path = mcap_file(tmp_path / 'x.mcap', [(TOPIC, 1, cdr(u=np.full(30, np.nan)))])
    assert np.isnan(read_frames(path, validate=False).frames['a'][0].uv[:, 0]).all()


def test_undecodable_message_is_reported(tmp_path):
    for data in (
        b'',
        b'\0\1\0\0',
        b'garbage' * 20,
        cdr()[:100],
        cdr() + b'more bytes',
        b'\0\1\0\0' + b'\xff' * 99,
    ):
        path = mcap_file(tmp_path / 'x.mcap', [(TOPIC, 1, data)])
        said = message_of(read_frames, path)
        assert (
            said.startswith(f'{path}, topic {TOPIC}, message 1')
            and 'not a fluoro_calib_msgs' in said
        )


def test_repeated_frame_is_reported(tmp_path):
    path = write_bag(tmp_path / 'run', [frame(number=1), frame(number=2), frame(number=1)])
    assert 'frame 1 is already given in message 1' in message_of(read_frames, path)


def test_two_topics_of_one_fluoroscope_are_reported(tmp_path):
    with BagWriter(tmp_path / 'run') as writer:
        write_frame(writer, frame(), topic='/x/a/target_observations')
        write_frame(writer, frame(), topic='/y/a/target_observations')
    said = message_of(read_frames, tmp_path / 'run')
    assert '/x/a/target_observations' in said and '/y/a/target_observations' in said


def test_different_message_definition_is_reported(tmp_path):
    text = full_text(TARGET_OBSERVATIONS)
    for schema in (
        text.replace('float64[] u ', 'float32[] u '),
        text.replace('float64[] sigma', 'float64[] weight'),
        text.replace('string frame_id', 'uint32 seq\nstring frame_id'),
        'uint32 x\n',
    ):
        path = mcap_file(tmp_path / 'x.mcap', [(TOPIC, 1, cdr())], schema=schema)
        assert f'{path}, topic {TOPIC}: the bag defines' in message_of(read_frames, path)
    for schema in ('float64[[ u', 'some_msgs/Thing x\n'):
        path = mcap_file(tmp_path / 'x.mcap', [(TOPIC, 1, cdr())], schema=schema)
        assert f'{path}, topic {TOPIC}: ' in message_of(read_frames, path)
    path = mcap_file(
        tmp_path / 'x.mcap',
        [(TOPIC, 1, cdr())],
        schema='',
        metadata={'topic_type_hash': 'RIHS01_0'},
    )
    assert 'differently' in message_of(read_frames, path)
    path = mcap_file(tmp_path / 'x.mcap', [(TOPIC, 1, cdr())], message_encoding='json')
    assert 'only cdr is supported' in message_of(read_frames, path)


def test_comments_and_blanks_of_a_definition_are_ignored(tmp_path):
    text = '\n'.join(line.split('#')[0] for line in full_text(TARGET_OBSERVATIONS).splitlines())
    path = mcap_file(tmp_path / 'x.mcap', [(TOPIC, 1, cdr())], schema=text)
    assert_holds(path, [frame()])
    path = mcap_file(tmp_path / 'x.mcap', [(TOPIC, 1, cdr())], schema='')
    assert_holds(path, [frame()])


def test_numbered_policies_of_old_bags_get_their_names(tmp_path):
    old = '- history: 3\n  depth: 0\n  reliability: 1\n  durability: 2\n  liveliness: 1\n'
    path = mcap_file(
        tmp_path / 'x.mcap', [(TOPIC, 1, cdr())], metadata={'offered_qos_profiles': old}
    )
    assert topics_of(path)[TOPIC].offered_qos == [
        {
            'history': 'unknown',
            'depth': 0,
            'reliability': 'reliable',
            'durability': 'volatile',
            'liveliness': 'automatic',
        }
    ]
    path = mcap_file(
        tmp_path / 'x.mcap', [(TOPIC, 1, cdr())], metadata={'offered_qos_profiles': ': ['}
    )
    assert topics_of(path)[TOPIC].offered_qos == []
