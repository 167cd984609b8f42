# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Numerical results for bags: gaps, restarts and partners of streams, spans of files, queues."""

import struct
from collections import Counter
from types import SimpleNamespace as Fake

import numpy as np
import pytest
from mcap.opcode import Opcode

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.exposures.stamps import ExposureNumbers
from fluoro_calib_ros.images.codec import raw_image
from fluoro_calib_ros.io.bags import recording, salvage
from fluoro_calib_ros.io.bags.mcap_file import MAGIC, RECORD
from fluoro_calib_ros.io.bags.metadata import (
    ADDED,
    NO_MESSAGE_NS,
    TARGET_OBSERVATIONS,
    FileSpan,
    _added,
    message_class,
    parse_profiles,
)
from fluoro_calib_ros.io.bags.reader import (
    COMPRESSED_IMAGE,
    IMAGE,
    _is_restart,
    _renumbered,
    image_topics,
    images_of,
)
from fluoro_calib_ros.io.bags.recording import Recording, lost_text
from fluoro_calib_ros.io.bags.salvage import (
    Damage,
    FileSalvage,
    Recovery,
    Salvage,
    TopicReport,
    _is_whole,
    _looks_like_chunk,
    _read_header,
    _without_partner,
)
from fluoro_calib_ros.io.bags.writer import BagWriter

MS = 1_000_000


def report(log_ms=(), stamp_ms=(), numbers=(), kind=TARGET_OBSERVATIONS):
    return TopicReport(
        kind, [round(MS * t) for t in log_ms], [round(MS * t) for t in stamp_ms], list(numbers)
    )


def test_interval_of_a_stream_is_the_median_by_its_stamps():
    one = report([0, 50, 60], [0, 10, 20, 100])
    assert one.interval_ns == 10 * MS
    assert report([0, 50, 70, 90]).interval_ns == 20 * MS
    assert report([0, 30], [5]).interval_ns == 30 * MS
    assert np.isnan(report([7]).interval_ns) and np.isnan(report().interval_ns)


def test_longest_gap_is_of_either_clock():
    assert report([0, 50, 60], [0, 10]).longest_gap_s == pytest.approx(0.05)
    assert report([0, 50], [0, 10, 90]).longest_gap_s == pytest.approx(0.08)
    assert report([3], [4]).longest_gap_s == 0


@pytest.mark.parametrize(
    ('stamp_ms', 'expected'),
    [
        ([0, 20, 40, 60, 261], True),  # ten intervals are 200 ms
        ([0, 20, 40, 60, 260], False),
        ([0, 1, 2, 3, 104], True),  # but at least a tenth of a second
        ([0, 1, 2, 3, 103], False),
        ([0, 99, 198, 297, 2000], True),
        ([0, 100, 200, 300, 9000], False),  # not a stream
        ([0, 0, 0, 0, 9000], False),
        ([5], False),
    ],
)
def test_gap_is_ten_times_the_interval_of_a_stream(stamp_ms, expected):
    assert report([0, 9], stamp_ms).has_gap is expected


def test_clock_runs_backwards_by_more_than_a_millisecond():
    assert report([0, 10, 9, 8]).backward_jumps == 0
    assert report([0, 10, 8.9, 20]).backward_jumps == 1
    assert report([0, 10, 5], [9, 3, 1, 4]).backward_jumps == 3


def test_frame_numbers_that_are_missing_repeated_or_begin_again():
    one = report(numbers=[1, 2, 2, 5, 1, 2, 4, 4, 4])
    assert (one.missing_frames, one.repeated_frames, one.restarts) == (3, 3, 1)
    assert (report(numbers=[3]).missing_frames, report().restarts) == (0, 0)
    texts = one.faults
    assert [text.split()[0] for text in texts] == ['3', '3', 'the'] and 'once' in texts[2]
    assert report(numbers=[1, 2]).faults == []
    (text,) = report(numbers=[1, 3]).faults
    assert text.startswith('1 frame is')
    gap = report([0, 0, 0, 500], [0, 20, 40, 540])
    assert gap.faults[0].startswith('a gap of 0.500 s, the usual interval is 20.0 ms')
    assert TopicReport('x', undecodable=2).faults[0].startswith('2 messages')


def cdr(order, sec, nanosec, frame_id, number):
    """Return the bytes of a message that begins with a header and a number."""
    text = frame_id.encode() + b'\0'
    head = struct.pack(f'{order}iII', sec, nanosec, len(text)) + text
    head += bytes(-len(head) % 4)
    return (
        (b'\0\1' if order == '<' else b'\0\0') + b'\0\0' + head + struct.pack(f'{order}I', number)
    )


@pytest.mark.parametrize('order', '<>')
@pytest.mark.parametrize('frame_id', ['', 'a', 'abc', 'abcd', 'a_optical'])
def test_stamp_and_number_are_read_from_the_bytes(order, frame_id):
    one = report()
    data = cdr(order, 7, 250, frame_id, 70_000)
    _read_header(one, data)
    assert (one.stamp_ns, one.numbers, one.undecodable) == ([7_000_000_250], [70_000], 0)
    _read_header(one, data[:-1])
    assert one.undecodable == 1 and len(one.numbers) == 1
    joints = report(kind='sensor_msgs/msg/JointState')
    _read_header(joints, data)
    assert (joints.stamp_ns, joints.numbers) == ([7_000_000_250], [])
    for kind in ('std_msgs/msg/String', 'lab_msgs/msg/Own', 'std_msgs/msg/Empty'):
        other = report(kind=kind)
        _read_header(other, data)
        assert other.stamp_ns == [] and other.undecodable == 0


def test_partners_are_counted_among_all_fluoroscopes():
    topics = {
        '/rig/b/target_observations': report(numbers=[1, 2, 3, 3]),
        '/rig/a/target_observations': report(numbers=[2, 3, 4]),
        '/rig/c/target_observations': report(numbers=[2, 3, 3, 9, 9]),
    }
    assert _without_partner(topics) == {'a': 1, 'b': 2, 'c': 3}
    alone = dict([next(iter(topics.items()))])
    assert _without_partner(alone) == {}
    alone['/lone'] = report(numbers=[1])
    alone['/rig/x/other'] = report(numbers=[1], kind='std_msgs/msg/String')
    assert _without_partner(alone) == {}


# ---- salvage


def records(*parts):
    return b''.join(RECORD.pack(opcode, len(content)) + content for opcode, content in parts)


def test_chunk_without_checksum_is_of_whole_records():
    whole = records((Opcode.CHANNEL, b'xy'), (Opcode.MESSAGE, b''))
    assert _is_whole(whole) and not _is_whole(whole[:-1]) and not _is_whole(whole + b'\0')
    assert not _is_whole(records((Opcode.DATA_END, b'')))


def test_compression_is_named_where_a_chunk_has_it():
    head = bytes(salvage._TO_COMPRESSION)
    for name in (b'zstd', b'lz4'):
        text = struct.pack('<I', len(name)) + name + b'....'
        assert _looks_like_chunk(head + text, 0) and _looks_like_chunk(b'???' + head + text, 3)
        assert not _looks_like_chunk(head + text, 1)
    assert not _looks_like_chunk(head + b'\4\0\0\0none', 0)


def test_next_chunk_is_found_by_its_head_or_its_compression(monkeypatch):
    """If the length of the record is damaged, the name of the compression reveals it."""
    length = salvage._TO_COMPRESSION
    compression = struct.pack('<I', 4) + b'zstd'
    head = RECORD.pack(Opcode.CHUNK, 500) + bytes(range(1, length - RECORD.size + 1))
    broken = b'\x06' + b'\xff' * 8 + head[9:]
    found = FileSalvage('bag.mcap')
    for begin in (head, broken):
        data = b'#' * 11 + begin + compression + b'#' * 40
        asked = []

        def chunk_at(data, position, asked=asked):
            asked.append(position)
            return Fake() if position == 11 else None

        monkeypatch.setattr(salvage, '_chunk_at', chunk_at)
        assert found._next_chunk(data, 3) == 11 and asked == [11]
        assert found._next_chunk(data, 12) == len(data)
        assert found._next_chunk(data, 3, 11) == len(data)


def test_damages_have_the_times_around_them_and_sum_what_is_lost():
    found = FileSalvage('bag.mcap')
    found._note('one', {'/a': 2})
    found._note('another', {'/a': 1, '/b': 4})
    found._close_damage(70)
    found._last_ns = 90
    found._note('three')
    found._close_damage(None)
    found._close_damage(100)
    assert found.damages == [
        Damage('bag.mcap', 'one', None, 70, {'/a': 3, '/b': 4}),
        Damage('bag.mcap', 'three', 90, None, {}),
    ]


@pytest.mark.parametrize(
    ('data', 'cut'),
    [
        (bytes(20), False),
        (bytes([1]) + bytes(20), True),
        (bytes([15]) + bytes(20), True),
        (bytes([16]) + bytes(20), False),
        (bytes(RECORD.size), False),
        (bytes(RECORD.size - 1), True),
    ],
)
def test_end_of_a_file_is_told_from_damaged_bytes(data, cut):
    found = FileSalvage('bag.mcap')
    found._note_lost_chunk(data, 0, None)
    found._close_damage(None)
    assert ('cut off' in found.damages[0].cause) is cut


def test_messages_of_a_lost_chunk_are_counted_by_its_index():
    def index(channel, count):
        return struct.pack('<HI', channel, 16 * count) + bytes(16 * count)

    found = FileSalvage('bag.mcap')
    found._channels = {1: Fake(topic='/a')}
    found.topics = {'/a': Fake()}
    parts = [(Opcode.MESSAGE_INDEX, index(*of)) for of in ((1, 3), (2, 2), (1, 1))]
    data = b'###' + records(*parts, (Opcode.MESSAGE, b''), parts[0])
    found._note_lost_chunk(data, 0, 3)
    found._close_damage(None)
    assert found.damages[0].lost == {'/a': 4, '(unknown)': 2}


def test_what_is_lost_is_what_was_expected_and_not_recovered():
    found = Recovery({'/a': 3, '/b': 2}, {'/a': 5, '/b': 2, '/c': 1}, (), {})
    assert found.lost == {'/a': 2, '/c': 1}
    both = Salvage.__new__(Salvage)
    both.files = [Fake(expected=Counter(a=1, b=2)), Fake(expected=Counter(b=3))]
    both._metadata = {'a': 9}
    assert both.expected == {'a': 9, 'b': 5}


def test_summary_counts_messages_only_where_it_is_intact():
    found = FileSalvage('bag.mcap')
    for data in (b'', MAGIC, MAGIC + bytes(50) + MAGIC, MAGIC * 4):
        found._read_summary(data)
    assert not found.expected and not found.damages


# ---- metadata and reading


def test_span_of_a_file_is_of_all_its_messages():
    span = FileSpan('x')
    assert span.starting_time == {'nanoseconds_since_epoch': NO_MESSAGE_NS}
    assert span.duration == {'nanoseconds': 0}
    for time_ns in (50, 20, 90, 60):
        span.add(time_ns)
    assert (span.count, span.start_ns, span.end_ns) == (4, 20, 90)
    assert span.duration == {'nanoseconds': 70}


@pytest.mark.parametrize(
    ('number', 'name'),
    [
        (-1, 'unknown'),
        (0, 'system_default'),
        (1, 'keep_last'),
        (2, 'keep_all'),
        (3, 'unknown'),
        (4, 'unknown'),
        ('keep_all', 'keep_all'),
    ],
)
def test_policies_are_told_by_name(number, name):
    assert parse_profiles([{'history': number, 'depth': 7}, 'x'])[0] == {
        'history': name,
        'depth': 7,
    }


def test_fields_that_were_added_are_those_of_later_changes():
    for kind, changes in ADDED.items():
        every = [name for names in changes for name in names]
        assert _added(kind, 0) == every and _added(kind, len(changes)) == []
        assert _added(kind, 1) == every[len(changes[0]) :]


def frame(number, stamp):
    return Frame('a', number, np.arange(3), np.zeros((3, 2)), (9, 9), stamp_ns=stamp)


def test_numbers_begin_again_while_time_goes_on():
    last = frame(5, 100)
    assert _is_restart(last, frame(4, 101))
    assert not any(_is_restart(last, frame(*of)) for of in ((4, 100), (5, 101), (6, 101)))


@pytest.mark.parametrize(('largest', 'step'), [(9, 10), (10, 100), (99, 100), (100, 1000)])
def test_step_between_restarts_is_a_power_of_ten_above_all_numbers(largest, step):
    given = {'a': [frame(1, 1), frame(2, 2), frame(1, 3)], 'b': [frame(largest, 1)]}
    found, of = _renumbered(given, {'a': [0, 0, 2], 'b': [1]})
    assert of == step
    assert [f.number for f in found['a']] == [1, 2, 1 + 2 * step]
    assert [f.number for f in found['b']] == [largest + step]


def image(encoding='mono16', step=10, width=4, height=2, big=0, data=None):
    return Fake(
        encoding=encoding,
        step=step,
        width=width,
        height=height,
        is_bigendian=big,
        data=np.asarray(np.arange(step * height) if data is None else data, np.uint8),
    )


@pytest.mark.parametrize(('big', 'first'), [(0, 0x0100), (1, 0x0001)])
def test_rows_of_an_image_begin_after_its_step(big, first):
    grey = raw_image(image(big=big))
    assert grey.shape == (2, 4) and grey.dtype == np.uint16 and grey[0, 0] == first
    assert grey[1, 0] - grey[0, 0] == 10 * 0x0101
    assert raw_image(image('8UC1', step=4)).tolist() == [[0, 1, 2, 3], [4, 5, 6, 7]]
    assert raw_image(image(data=np.arange(18))).shape == (2, 4), 'the last row is not padded'


@pytest.mark.parametrize(
    'wrong',
    [
        {'step': 7},
        {'data': np.arange(17)},
        {'data': np.arange(21)},
        {'encoding': 'rgb8'},
        {'width': 6},
        {'width': 0, 'height': 0, 'step': 0},
    ],
)
def test_image_whose_bytes_are_not_of_its_size_is_refused(wrong):
    with pytest.raises(DataError):
        raw_image(image(**wrong))


def test_images_of_a_bag_are_those_of_a_topic_of_each_fluoroscope(tmp_path):
    """The name is the last part but one of the topic or its only part; plain images come first."""
    stamp = message_class('builtin_interfaces/msg/Time')(3, 7)
    header = message_class('std_msgs/msg/Header')(stamp, '')
    grey = np.arange(6, dtype=np.uint8).reshape(2, 3)
    plain = message_class(IMAGE)(header, 2, 3, 'mono8', 0, 3, grey.ravel())
    damaged = message_class(IMAGE)(header, 2, 3, 'mono8', 0, 3, grey.ravel()[:5])
    packed = message_class(COMPRESSED_IMAGE)(header, 'png', np.zeros(9, np.uint8))
    bag = tmp_path / 'bag'
    with BagWriter(bag) as out:
        for topic in ('/a', '/lab/b/image_raw'):
            for message in (plain, damaged, plain):
                out.write(topic, IMAGE, message, 5 * 10**9)
        for name in 'bc':
            out.write(f'/lab/{name}/image_raw/compressed', COMPRESSED_IMAGE, packed, 5 * 10**9)
    assert image_topics(bag) == {
        'a': '/a',
        'b': '/lab/b/image_raw',
        'c': '/lab/c/image_raw/compressed',
    }
    numbers = ExposureNumbers('abc', 2 * MS)
    first, second, third = images_of(bag, 'a', numbers)
    assert first.stamp_ns == second.stamp_ns == 3 * 10**9 + 7
    assert first.image.tolist() == third.image.tolist() == grey.tolist()
    assert isinstance(second.image, DataError)
    assert second.place == f'{bag}, topic /a, message 2' and second.place in str(second.image)
    (refused,) = images_of(bag, 'c', numbers)
    assert isinstance(refused.image, DataError) and refused.stamp_ns == 3 * 10**9 + 7


@pytest.fixture
def camera_bag(tmp_path):
    """A function that writes a bag with an image on each of some topics."""

    def write(*topics):
        grey = np.arange(6, dtype=np.uint8).reshape(2, 3)
        header = message_class('std_msgs/msg/Header')(stamp_of(3), '')
        plain = message_class(IMAGE)(header, 2, 3, 'mono8', 0, 3, grey.ravel())
        packed = message_class(COMPRESSED_IMAGE)(header, 'png', np.zeros(9, np.uint8))
        with BagWriter(tmp_path / 'bag') as out:
            for topic in topics:
                is_packed = topic.endswith(('/compressed', '/radiograph'))
                message = (COMPRESSED_IMAGE, packed) if is_packed else (IMAGE, plain)
                out.write(topic, *message, 10**9)
        return tmp_path / 'bag'

    return write


def stamp_of(seconds):
    return message_class('builtin_interfaces/msg/Time')(seconds, 0)


RAW = '/rig/a/image_raw/compressed'


@pytest.mark.parametrize(
    'others', [('radiograph',), ('image_corrected',), ('coverage', 'image_overlay'), ('zoom',)]
)
def test_images_of_a_bag_are_those_of_the_camera(camera_bag, others):
    """Not those that the nodes publish of them, which a recording of all topics contains."""
    bag = camera_bag(RAW, *(f'/rig/a/{name}' for name in others))
    assert image_topics(bag) == {'a': RAW}


def test_images_that_the_nodes_publish_are_none_of_a_camera(camera_bag):
    assert image_topics(camera_bag('/a/radiograph', '/b/coverage')) == {}


@pytest.mark.parametrize('topics', [('/a/x', '/a/y'), ('/one/a/image_raw', '/two/a/image_raw')])
def test_several_cameras_of_a_fluoroscope_are_refused(camera_bag, topics):
    with pytest.raises(DataError) as caught:
        image_topics(camera_bag(*topics))
    assert all(topic in str(caught.value) for topic in topics)


# ---- recording


@pytest.fixture
def queue(tmp_path, monkeypatch):
    """A recording with a queue of 100 bytes that is not started."""
    monkeypatch.setattr(recording, 'SMALL_BYTES', 10)
    made = Recording(tmp_path / 'bag')
    made.options = Fake(queue_size=100 / 1e6)
    return made


def test_large_messages_are_dropped_before_small_ones(queue):
    share = round(100 * recording.LARGE_SHARE)
    assert 0 < share < 100
    assert queue.put('/large', bytes(share), 1, 1)
    assert not queue.put('/large', bytes(11), 2, 2)
    for _ in range((100 - share) // 10):
        assert queue.put('/small', bytes(10), 3, 3)
    assert not queue.put('/small', bytes(10), 4, 4)
    assert queue.dropped == Counter({'/large': 1, '/small': 1})
    assert queue.waiting_bytes == queue.most_waiting_bytes == share + (100 - share) // 10 * 10


def test_message_larger_than_the_queue_is_taken_where_nothing_waits(queue):
    assert queue.put('/a', bytes(500), 1, 1) and not queue.put('/a', b'x', 1, 1)
    queue._fail('the disk is full', [])
    assert queue.fault and queue.waiting_bytes == 0 and queue.dropped['/a'] == 2
    assert not queue.put('/a', b'x', 1, 1) and queue.dropped['/a'] == 3
    assert lost_text({'/b': 2, '/a': 1}) == '/a 1, /b 2'


def test_what_is_not_on_the_disk_yet_counts_as_dropped(queue):
    queue.counts.update({'/a': 5, '/b': 1})
    queue._unflushed.update({'/a': 2})
    queue._fail('the disk is full', [])
    assert queue.counts == Counter({'/a': 3, '/b': 1}) and queue.dropped == Counter({'/a': 2})


@pytest.mark.parametrize(
    ('size', 'seconds', 'full'),
    [(0, 0, False), (50, 0, True), (51, 0, False), (0, 5, True), (0, 6, False), (51, 5, True)],
)
def test_file_is_full_by_its_size_or_its_age(queue, monkeypatch, size, seconds, full):
    queue.options = Fake(split_size=size / 1e6, split_duration=seconds)
    queue._writer = Fake(file_bytes=50)
    queue._file_start = 10.0
    monkeypatch.setattr(recording, 'time', Fake(monotonic=lambda: 15.0))
    assert queue._is_full() is full
    written = []
    queue._writer.flush = lambda **how: written.append(how)
    queue.options.flush_period = 4.0
    assert queue._flush_if_due(13.0) == 13.0 and not written
    assert queue._flush_if_due(12.9) == 15.0 and written == [{'to_disk': True}]


def test_latched_messages_begin_every_file(queue):
    """They get the time of the message that follows them; other messages are not repeated."""
    written = []
    queue._writer = Fake(
        split=lambda: written.append('split'),
        write=lambda topic, kind, data, *times: written.append((topic, data, *times)),
        add_topic=lambda *_: None,
    )
    full = iter([False, False, False, True])
    queue._is_full = lambda: next(full)
    for name, latched in (('/map', 1), ('/a', 0)):
        queue._write(recording.TopicToRecord(name, 'kind', [], None, latched))
    for topic, data, received in (('/map', b'1', 5), ('/map', b'2', 6), ('/a', b'3', 7)):
        queue._write(recording._Message(topic, data, received, received - 1))
    queue._write(recording._Message('/a', b'4', 9, 8))
    assert written[:3] == [('/map', b'1', 5, 4), ('/map', b'2', 6, 5), ('/a', b'3', 7, 6)]
    assert written[3:] == ['split', ('/map', b'2', 9, 5), ('/a', b'4', 9, 8)]
    assert queue.counts == Counter({'/map': 2, '/a': 2}) and queue.waiting_bytes == -4
