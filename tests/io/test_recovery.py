# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Damaged and truncated bags: intact content is recovered, and losses are reported."""

import json
import random
import shutil
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType
from rigs import run, write_frame
from rosbags.rosbag2 import Reader

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.io.bags import writer as writer_module
from fluoro_calib_ros.io.bags.mcap_file import RECORD, channels_of_bag, is_foreign
from fluoro_calib_ros.io.bags.metadata import (
    TARGET_OBSERVATIONS,
    known_definition,
    message_from_frame,
)
from fluoro_calib_ros.io.bags.reader import iterate_messages, read_frames
from fluoro_calib_ros.io.bags.salvage import FileSalvage, _decompressed, recover_bag
from fluoro_calib_ros.io.bags.writer import BagWriter, write_bag
from fluoro_calib_ros.limits import MAX_CHUNK
from fluoro_calib_ros.simulation.rig import StreamStart, simulate_tracking, virtual_rig

START = 10**18


@pytest.fixture(scope='module')
def frames():
    return simulate_tracking(virtual_rig(1), 0.2, 120.0, 1, 0.2, StreamStart(START)).frames


@pytest.fixture(scope='module', params=[CompressionType.ZSTD, CompressionType.NONE])
def bag(request, tmp_path_factory, frames):
    """A bag of about ten chunks."""
    path = tmp_path_factory.mktemp('bags') / 'bag'
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writer_module, 'CHUNK_SIZE', 4000)
        patch.setattr(writer_module, 'CompressionType', SimpleNamespace(ZSTD=request.param))
        with BagWriter(path) as out:
            for pair in zip(*frames.values()):
                for number, frame in enumerate(pair):  # give every message a time of its own
                    write_frame(out, frame, log_time_ns=frame.stamp_ns + number)
    return path


def chunks_of(path):
    """Return [(first byte, end, [message, ...])] of every chunk, from the index of the file."""
    out = []
    with path.open('rb') as file:
        messages = list(make_reader(file).iter_messages())
        file.seek(0)
        for chunk in make_reader(file).get_summary().chunk_indexes:
            start = chunk.chunk_start_offset
            inside = [
                (channel.topic, message.log_time, message.data)
                for _, channel, message in messages
                if chunk.message_start_time <= message.log_time <= chunk.message_end_time
            ]
            out.append((start, start + chunk.chunk_length, inside))
    return out


def places(rng, length, count):
    """Return one place in each of `count` equal parts of a file, drawn at random."""
    return [rng.randrange(i * length // count, (i + 1) * length // count) for i in range(count)]


def held(path):
    return Counter((m.topic, m.log_time_ns, m.data) for m in iterate_messages(path))


def test_chunk_that_claims_more_than_a_chunk_has_is_not_decompressed():
    """The size is taken from the frame, whatever the chunk says, or else from the chunk."""
    content = b'observations' * 100
    known = zstandard.ZstdCompressor().compress(content)
    unknown = zstandard.ZstdCompressor(write_content_size=False).compress(content)
    assert _decompressed(b'zstd', memoryview(known), 1) == content
    assert _decompressed(b'zstd', memoryview(unknown), len(content)) == content
    for size in (0, MAX_CHUNK + 1):
        assert _decompressed(b'zstd', memoryview(unknown), size) is None
    # RFC 8878, 3.1.1.1: magic number, a descriptor with eight bytes of size, a terabyte.
    claimed = known[:4] + bytes([0b11100000]) + (2**40).to_bytes(8, 'little') + known[6:]
    assert zstandard.frame_content_size(claimed) == 2**40
    assert _decompressed(b'zstd', memoryview(claimed), len(content)) is None


@pytest.mark.parametrize(
    ('opcode', 'length', 'end'),
    [
        (Opcode.MESSAGE, 11, 20),
        (Opcode.MESSAGE, 12, None),  # one byte too long
        (Opcode.DATA_END, 0, 9),
        (Opcode.DATA_END + 1, 0, None),
        (0, 0, None),
        (0, 2**40, None),
        (Opcode.MESSAGE, 2**40, None),
    ],
)
def test_record_ends_within_the_file_and_has_a_known_opcode(opcode, length, end):
    data = RECORD.pack(opcode, length) + bytes(11)
    salvage = FileSalvage('bag.mcap')
    assert salvage._end_of_record(data, 0) == end
    assert salvage._end_of_record(data, len(data) - RECORD.size + 1) is None


def test_bag_cut_off_anywhere_gives_the_complete_chunks(tmp_path, bag):
    content = (bag / 'bag_0.mcap').read_bytes()
    chunks = chunks_of(bag / 'bag_0.mcap')
    assert len(chunks) >= 8
    rng = random.Random(1)
    cut = tmp_path / 'cut.mcap'
    total = sum(len(inside) for *_, inside in chunks)
    for number, length in enumerate(places(rng, len(content), 20)):
        cut.write_bytes(content[:length])
        whole = [m for _, end, inside in chunks if end <= length for m in inside]
        if not whole:
            with pytest.raises(DataError, match='nothing can be recovered'):
                recover_bag(cut, tmp_path / str(number))
            assert not (tmp_path / str(number)).exists()
            continue
        recovery = recover_bag(cut, tmp_path / str(number))
        assert held(tmp_path / str(number)) == Counter(whole)
        if len(whole) < total:
            assert recovery.damages and recovery.damages[-1].end_ns is None


def test_flipped_bit_costs_one_chunk_at_most(tmp_path, bag):
    """The bit may be in a chunk, its length, an index, the summary or the ends of the file."""
    content = (bag / 'bag_0.mcap').read_bytes()
    chunks = chunks_of(bag / 'bag_0.mcap')
    complete = held(bag)
    rng = random.Random(2)
    flipped = tmp_path / 'flipped.mcap'
    # Some bits are in the heads of chunks, which are few bytes with a large effect.
    heads = [start + rng.randrange(50) for start, *_ in chunks]
    for number, place in enumerate([*places(rng, len(content), 15), *heads]):
        damaged = bytearray(content)
        damaged[place] ^= 1 << rng.randrange(8)
        flipped.write_bytes(damaged)
        recovery = recover_bag(flipped, tmp_path / str(number))
        found = held(tmp_path / str(number))
        assert found <= complete, place
        intact = [m for a, end, inside in chunks if not a <= place < end for m in inside]
        assert found >= Counter(intact), place
        if found != complete:
            assert recovery.damages, place
            gone = (complete - found).elements()
            for topic, time_ns, _ in gone:
                assert any(
                    (d.start_ns or 0) <= time_ns <= (d.end_ns or 2**63) for d in recovery.damages
                )
                assert recovery.lost[topic] >= 1
            if any(d.lost for d in recovery.damages):
                assert sum(recovery.lost.values()) == (complete - found).total()


def test_recovered_bag_is_a_bag_for_others(tmp_path, bag, frames):
    """Topics, definitions and QoS agree; it has metadata.yaml, an index and statistics."""
    folder = tmp_path / 'cut'
    shutil.copytree(bag, folder)
    content = (folder / 'bag_0.mcap').read_bytes()
    (folder / 'bag_0.mcap').write_bytes(content[: len(content) // 2])
    with pytest.raises(DataError, match='cut off'):
        read_frames(folder)
    recovery = recover_bag(folder, tmp_path / 'out')
    with Reader(tmp_path / 'out') as one, Reader(bag) as other:
        for a, b in zip(one.connections, other.connections, strict=True):
            assert (a.topic, a.msgtype, a.digest, a.ext) == (b.topic, b.msgtype, b.digest, b.ext)
        count = one.message_count
    assert count == sum(recovery.counts.values()) > 0
    # metadata.yaml of the truncated bag has the original numbers.
    assert sum(recovery.lost.values()) == sum(len(f) for f in frames.values()) - count
    with (tmp_path / 'out' / 'out_0.mcap').open('rb') as file:
        kinds = {
            type(record).__name__ for record in StreamReader(file, validate_crcs=True).records
        }
    assert {'Statistics', 'ChunkIndex', 'MessageIndex', 'SummaryOffset'} <= kinds
    assert read_frames(tmp_path / 'out').frames['a'][0].number == frames['a'][0].number


def test_split_bag_with_a_lost_file(tmp_path, frames):
    path = tmp_path / 'bag'
    with BagWriter(path) as bag:
        for frame in frames['a']:
            if bag.file_bytes >= 2000:
                bag.split()
            write_frame(bag, frame)
            bag.flush()
    files = sorted(path.glob('*.mcap'))
    assert len(files) > 3
    files[1].unlink()
    files[2].write_bytes(b'')
    recovery = recover_bag(path, tmp_path / 'out')
    assert [d.cause for d in recovery.damages] == ['the file is empty']
    assert sum(held(tmp_path / 'out').values()) == sum(recovery.counts.values())
    assert sum(recovery.lost.values()) == len(frames['a']) - sum(recovery.counts.values()) > 0


def test_types_that_are_not_known_are_recovered_with_their_definition(tmp_path, frames):
    """For a lab's own messages, definition and hash come from the bag."""
    from fluoro_calib_ros.io.bags.metadata import Definition

    with BagWriter(tmp_path / 'bag') as bag:
        bag.add_topic('/own', 'lab_msgs/msg/Trigger', 'latched', Definition('uint32 n', 'ros2msg'))
        bag.write('/own', 'lab_msgs/msg/Trigger', b'\0\1\0\0\7\0\0\0', START)
        write_frame(bag, frames['a'][0])
    content = (tmp_path / 'bag' / 'bag_0.mcap').read_bytes()
    (tmp_path / 'cut.mcap').write_bytes(content[:-20])
    recover_bag(tmp_path / 'cut.mcap', tmp_path / 'out')
    with (tmp_path / 'out' / 'out_0.mcap').open('rb') as file:
        summary = make_reader(file).get_summary()
    (schema,) = [s for s in summary.schemas.values() if s.name == 'lab_msgs/msg/Trigger']
    assert schema.data == b'uint32 n'
    assert held(tmp_path / 'out') == held(tmp_path / 'bag')


def test_command_says_what_is_gone(tmp_path, bag, capsys):
    content = (bag / 'bag_0.mcap').read_bytes()
    (tmp_path / 'cut.mcap').write_bytes(content[: len(content) // 2])
    assert run('bag', 'recover', tmp_path / 'cut.mcap', '--out', tmp_path / 'out') == 0
    output = capsys.readouterr().out
    assert 'messages recovered' in output and 'after 2001-09-09T01:46:40' in output
    for empty in (b'', b'no bag at all' * 100, content[:60]):
        (tmp_path / 'nothing.mcap').write_bytes(empty)
        assert run('bag', 'recover', tmp_path / 'nothing.mcap', '--out', tmp_path / 'n') == 1
        error = capsys.readouterr().err
        assert 'nothing can be recovered' in error and error.count('\n') == 1
    assert not Path(tmp_path / 'n').exists()


def test_information_about_a_bag(tmp_path, frames, capsys):
    """A dropped frame, a frame without partner, a pause, a clock that jumps back, a truncation."""
    recorded = [f for pair in zip(frames['a'], frames['b']) for f in pair]
    del recorded[10]
    path = tmp_path / 'bag'
    with BagWriter(path) as bag:
        for number, frame in enumerate(recorded):
            time_ns = frame.stamp_ns + (2 * 10**9 if number > 20 else 0)
            bag.write(
                f'/{frame.fluoroscope}/target_observations',
                TARGET_OBSERVATIONS,
                message_from_frame(frame),
                time_ns - (10**9 if number == 30 else 0),
            )
    assert run('bag', 'info', path, '--json') == 0
    document = json.loads(capsys.readouterr().out)
    a, b = (
        document['topics']['/a/target_observations'],
        document['topics']['/b/target_observations'],
    )
    assert (a['messages'], b['messages']) == (len(frames['a']) - 1, len(frames['b']))
    assert a['missing_frames'] == 1 and b['missing_frames'] == 0
    assert a['longest_gap_s'] == pytest.approx(2.0, abs=0.05)
    assert a['backward_jumps'] + b['backward_jumps'] == 1
    assert document['without_partner'] == {'a': 0, 'b': 1}
    faults = ' '.join(document['faults'])
    for word in ('1 frame', 'without partner', 'gap', 'backwards'):
        assert word in faults, word
    write_bag(tmp_path / 'good', frames)
    assert run('bag', 'info', tmp_path / 'good') == 0
    assert 'no faults found' in capsys.readouterr().out


def test_channels_of_a_bag_have_type_hash_format_and_count(bag, frames):
    found = {one.channel.topic: one for one in channels_of_bag(bag)}
    assert set(found) == {f'/{name}/target_observations' for name in frames}
    known = known_definition(TARGET_OBSERVATIONS)
    for name, of_one in frames.items():
        one = found[f'/{name}/target_observations']
        assert one.count == len(of_one)
        assert one.channel.metadata['topic_type_hash'] == known.type_hash
        assert one.channel.message_encoding == 'cdr' and one.schema.name == TARGET_OBSERVATIONS
    assert not is_foreign(bag) and not is_foreign(bag / 'bag_0.mcap')
    assert not is_foreign(bag / 'none')
