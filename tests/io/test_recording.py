# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Recording without ROS: splits, latched topics, flushes, and a slow and a full disk."""

import os
import threading

import pytest
from rosbags.rosbag2 import Reader

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.io.bags import writer as writer_module
from fluoro_calib_ros.io.bags.metadata import known_definition, profile, to_cdr, typestore
from fluoro_calib_ros.io.bags.reader import iterate_messages
from fluoro_calib_ros.io.bags.recording import Recording, RecordingOptions, TopicToRecord

STRING = 'std_msgs/msg/String'
START = 10**18


def text(value):
    return to_cdr(typestore().types[STRING](data=value), STRING)


def topic(name, latched=0):
    durability = 'transient_local' if latched else 'volatile'
    return TopicToRecord(
        name, STRING, [profile(durability=durability)], known_definition(STRING), latched
    )


def started(path, **options):
    recording = Recording(path, RecordingOptions(**options))
    recording.start()
    recording.add_topic(topic('/note', 2))
    recording.add_topic(topic('/stream'))
    return recording


def test_latched_messages_are_in_every_file(tmp_path, monkeypatch):
    """Each file of a split recording can be played alone."""
    monkeypatch.setattr(writer_module, 'CHUNK_SIZE', 4000)
    recording = started(tmp_path / 'bag', split_size=0.02)
    for value in ('old', 'first', 'second'):
        assert recording.put('/note', text(value), START, START - 5)
    noise = os.urandom(3000).hex()
    for number in range(60):
        assert recording.put('/stream', text(noise), START + number, START + number)
    recording.stop()
    assert not recording.fault and recording.counts == {'/note': 3, '/stream': 60}
    files = sorted((tmp_path / 'bag').glob('*.mcap'))
    assert len(files) >= 3
    for number, path in enumerate(files):
        notes = [m.data for m in iterate_messages(path, ['/note'])]
        expected = ['old', 'first', 'second'] if number == 0 else ['first', 'second']
        assert notes == [text(value) for value in expected]
    streamed = [m.log_time_ns for m in iterate_messages(tmp_path / 'bag', ['/stream'])]
    assert streamed == list(range(START, START + 60))
    with Reader(tmp_path / 'bag') as bag:
        assert bag.message_count == 63 + 2 * (len(files) - 1)


def test_outdated_latched_messages_are_not_repeated(tmp_path):
    """But those of each publisher, as soon as there are several."""
    recording = Recording(tmp_path / 'bag', RecordingOptions(split_size=1e-6))
    recording.start()
    recording.add_topic(topic('/note', 1))
    for value in ('old', 'new'):
        recording.put('/note', text(value), START, START)
    recording.add_topic(topic('/note', 2))
    recording.put('/note', text('of another'), START, START)
    recording.stop()
    files = sorted((tmp_path / 'bag').glob('*.mcap'))
    notes = [[m.data for m in iterate_messages(path)] for path in files]
    assert notes == [
        [],
        [text('old')],
        [text('old'), text('new')],
        [text('old'), text('new'), text('of another')],
    ]


def test_topic_with_a_name_that_is_not_of_ros_does_not_end_a_recording(tmp_path):
    recording = started(tmp_path / 'bag')
    with pytest.raises(DataError, match="'/9lives' cannot be the name"):
        recording.add_topic(topic('/9lives'))
    assert recording.put('/stream', text('x'), START, START)
    recording.stop()
    assert not recording.fault and recording.counts == {'/stream': 1}


def wait_until(condition):
    pause = threading.Event()
    for _ in range(1000):
        if condition():
            return
        pause.wait(0.01)
    raise AssertionError('waited 10 s')


def wait_until_written(recording, count):
    wait_until(lambda: recording.counts.total() >= count)


def test_open_chunk_is_on_disk_within_the_flush_period(tmp_path, monkeypatch):
    """It is flushed without a further message, and with fsync."""
    synced = threading.Event()
    real = os.fsync

    def fsync(descriptor):
        real(descriptor)
        synced.set()

    recording = started(tmp_path / 'bag', flush_period=0.1)
    recording.put('/stream', text('x'), START, START)
    wait_until_written(recording, 1)
    synced.clear()
    monkeypatch.setattr(writer_module.os, 'fsync', fsync)
    assert synced.wait(10)
    assert b'zstd' in (tmp_path / 'bag' / 'bag_0.mcap').read_bytes()
    recording.stop()


def stopped_disk(monkeypatch):
    """Block all writing until the returned event is set."""
    go = threading.Event()
    real = writer_module.BagWriter.write

    def slow(self, *arguments):
        go.wait()
        real(self, *arguments)

    monkeypatch.setattr(writer_module.BagWriter, 'write', slow)
    return go


def test_slow_disk_drops_and_counts(tmp_path, monkeypatch):
    """The messages in the bag and the dropped ones are together all messages."""
    go = stopped_disk(monkeypatch)
    recording = started(tmp_path / 'bag', queue_size=1.0)
    data = text('x' * 99_000)
    taken = [recording.put('/stream', data, START + n, START + n) for n in range(30)]
    go.set()
    recording.stop()
    assert 8 <= sum(taken) <= 10 and recording.most_waiting_bytes <= 10**6
    assert recording.dropped == {'/stream': 30 - sum(taken)}
    assert recording.counts == {'/stream': sum(taken)}
    assert len(list(iterate_messages(tmp_path / 'bag'))) == sum(taken)


def test_images_do_not_displace_frames(tmp_path, monkeypatch):
    """If the disk is too slow for images, small messages still find space in the queue."""
    go = stopped_disk(monkeypatch)
    recording = started(tmp_path / 'bag', queue_size=1.0)
    recording.add_topic(topic('/image'))
    image = text('x' * 99_000)
    assert not all(recording.put('/image', image, START + n, START + n) for n in range(20))
    frames = [recording.put('/stream', text('x'), START + n, START + n) for n in range(200)]
    go.set()
    recording.stop()
    assert all(frames) and set(recording.dropped) == {'/image'}


def test_full_disk_ends_the_recording_and_says_so(tmp_path, monkeypatch):
    """What was written before stays a readable or recoverable bag."""
    from fluoro_calib_ros.io.bags.salvage import recover_bag

    monkeypatch.setattr(writer_module, 'CHUNK_SIZE', 10)
    recording = started(tmp_path / 'bag', flush_period=0.05)
    recording.put('/stream', text('kept'), START, START)
    wait_until_written(recording, 1)
    wait_until(lambda: not recording._unflushed)

    def full(*_):
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr(writer_module.Writer, 'add_message', full)
    recording.put('/stream', text('lost'), START, START)
    wait_until(lambda: recording.fault)
    assert not recording.put('/stream', text('lost, too'), START, START)
    recording.stop()
    assert 'no space left on device' in recording.fault
    assert recording.dropped == {'/stream': 2} and recording.counts == {'/stream': 1}
    monkeypatch.undo()
    assert recover_bag(tmp_path / 'bag', tmp_path / 'out').counts == {'/stream': 1}


def test_folder_that_exists_is_refused(tmp_path):
    (tmp_path / 'bag').mkdir()
    with pytest.raises(DataError, match='already exists'):
        Recording(tmp_path / 'bag').start()
