# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Hostile input: sizes are checked before anything is read or decoded; one sentence each."""

import functools
import io
import os
import tracemalloc
import zipfile
from dataclasses import replace

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Schema,
    Statistics,
)
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
from rigs import calibrated, rig, run

from fluoro_calib_ros import limits
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.io import access
from fluoro_calib_ros.io.bags import reader as reader_module
from fluoro_calib_ros.io.bags.reader import iterate_messages, read_frames
from fluoro_calib_ros.io.bags.salvage import inspect_bag
from fluoro_calib_ros.io.bags.writer import write_bag
from fluoro_calib_ros.io.calibration import load_calibration, save_calibration
from fluoro_calib_ros.io.documents import parse_yaml
from fluoro_calib_ros.io.formats.native import read_known_orientations
from fluoro_calib_ros.simulation.rig import simulate_exposures

MEGABYTES = 40


def refused(function, *arguments):
    """Return the message of the DataError; check that it is one line and took little memory."""
    tracemalloc.start()
    with pytest.raises(DataError) as caught:
        function(*arguments)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < MEGABYTES * 10**6, f'{peak / 1e6:.0f} MB'
    assert '\n' not in str(caught.value)
    return str(caught.value)


def test_giant_file_is_not_read(tmp_path):
    """The file is sparse, so that it costs nothing to make."""
    path = tmp_path / 'observations.csv'
    with path.open('wb') as file:
        file.write(b'fluoroscope,exposure,target_id,u,v\n')
        file.truncate(10**9)
    assert 'the limit is 268 MB' in refused(access.read_text, path)


def test_arrays_that_would_be_giant_are_not_decompressed(tmp_path):
    path = save_calibration(tmp_path, calibrated('a', 5, model='none').calibrations['a'])
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, 'w', zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
        with archive.open('train_uv2.npy', 'w', force_zip64=True) as member:
            for _ in range(300):
                member.write(bytes(2**20))
    assert os.path.getsize(path) < 2**21
    assert 'the limit is' in refused(load_calibration, path)


def test_yaml_aliases_are_refused(tmp_path):
    lines = ['a0: &a0 [x, x]'] + [f'a{n}: &a{n} [*a{n - 1}, *a{n - 1}]' for n in range(1, 30)]
    (tmp_path / 'rig.yaml').write_text('\n'.join(lines))
    assert 'aliases are not allowed' in refused(read_known_orientations, tmp_path / 'rig.yaml')
    (tmp_path / 'rig.yaml').write_text('[' * 100_000)
    assert 'nested too deeply' in refused(read_known_orientations, tmp_path / 'rig.yaml')
    assert parse_yaml('a: [1, 2]', 'x') == {'a': [1, 2]}


def test_chunk_that_would_be_giant_is_not_decompressed(tmp_path, monkeypatch):
    """Its header either states the size or hides it."""
    bomb = zstandard.compress(bytes(600 * 2**20))
    for claimed in (600 * 2**20, 1000):
        buffer = io.BytesIO()
        writer = Writer(buffer, compression=CompressionType.ZSTD)
        monkeypatch.setattr('mcap.writer.zstandard.compress', lambda _: bomb)
        writer.start('ros2', 'x')
        schema = writer.register_schema('std_msgs/msg/String', 'ros2msg', b'string data')
        channel = writer.register_channel('/x', 'cdr', schema)
        writer.add_message(channel, 1, b'\0\1\0\0', 1)
        writer.finish()
        content = bytearray(buffer.getvalue())
        at = content.index(b'\4\0\0\0zstd') - 12
        content[at : at + 8] = claimed.to_bytes(8, 'little')
        (tmp_path / 'bomb.mcap').write_bytes(content)
        message = refused(lambda: list(iterate_messages(tmp_path / 'bomb.mcap')))
        assert 'a chunk of the bag takes 629 MB' in message


def bag_of_a_chunk(path, chunk, indexed):
    """Write a bag whose chunk is behind the end of its data, where only the index names it."""
    buffer = io.BytesIO()
    writer = Writer(buffer, compression=CompressionType.NONE)
    writer.start('ros2', 'x')
    schema = writer.register_schema('std_msgs/msg/String', 'ros2msg', b'string data')
    channel = writer.register_channel('/x', 'cdr', schema)
    writer.add_message(channel, 1, b'\0\1\0\0', 1)
    writer.finish()
    records = list(StreamReader(io.BytesIO(buffer.getvalue()), emit_chunks=True).records)
    builder = RecordBuilder()
    parts = {type(record): record for record in records}
    magic = b'\x89MCAP0\r\n'
    out = magic + _bytes(builder, parts[Header])
    out += _bytes(builder, parts[DataEnd]) if indexed else b''
    at = len(out)
    out += _bytes(builder, chunk)
    out += b'' if indexed else _bytes(builder, DataEnd(0))
    start = len(out)
    if indexed:
        index = replace(
            parts[ChunkIndex], chunk_start_offset=at, chunk_length=start - at, message_start_time=1
        )
        for record in (parts[Schema], parts[Channel], parts[Statistics], index):
            out += _bytes(builder, record)
    footer = Footer(start if indexed else 0, 0, 0)
    path.write_bytes(out + _bytes(builder, footer) + magic)
    return path


def _bytes(builder, record):
    record.write(builder)
    return builder.end()


@functools.cache
def giant(compression):
    """Return 600 MB of zeros, compressed."""
    compress = {'zstd': zstandard.compress, 'lz4': lz4.frame.compress}[compression]
    return compress(bytes(600 * 2**20))


@pytest.mark.parametrize('indexed', [True, False])
@pytest.mark.parametrize(
    ('compression', 'stated', 'sentence'),
    [('zstd', 600 * 2**20, 'a chunk of the bag takes 629 MB'), ('lz4', 1000, 'does not have the')],
)
def test_chunk_that_hides_its_size_is_not_decompressed(
    tmp_path, compression, stated, sentence, indexed
):
    """Neither by the index of a bag nor in a recovery."""
    chunk = Chunk(
        compression, giant(compression), 1, 1, uncompressed_crc=0, uncompressed_size=stated
    )
    path = bag_of_a_chunk(tmp_path / 'bomb.mcap', chunk, indexed)
    assert sentence in refused(lambda: list(iterate_messages(path)))
    if not indexed:
        assert 'nothing can be read' in refused(inspect_bag, path)


def test_giant_message_is_not_decoded(tmp_path, monkeypatch):
    write_bag(tmp_path / 'bag', simulate_exposures(rig(), 1, 1).frames)
    monkeypatch.setattr(reader_module, 'MAX_OBSERVATIONS', 100)
    assert 'the limit is 100' in refused(read_frames, tmp_path / 'bag')


def test_bag_of_very_many_channels_is_not_read(tmp_path):
    buffer = io.BytesIO()
    writer = Writer(buffer)
    writer.start('ros2', 'x')
    schema = writer.register_schema('std_msgs/msg/String', 'ros2msg', b'string data')
    for number in range(limits.MAX_TOPICS + 1):
        writer.register_channel(f'/t{number}', 'cdr', schema)
    writer.finish()
    (tmp_path / 'many.mcap').write_bytes(buffer.getvalue())
    assert 'the bag has 2001 channels' in refused(read_frames, tmp_path / 'many.mcap')


def changed_calibration(folder, compression=zipfile.ZIP_STORED, **members):
    """Write a calibration file with some members replaced; return its path."""
    path = save_calibration(folder, calibrated('a', 5, model='none').calibrations['a'])
    with zipfile.ZipFile(path) as archive:
        content = {name: archive.read(name) for name in archive.namelist()}
    content.update({f'{name}.npy': data for name, data in members.items()})
    with zipfile.ZipFile(path, 'w', compression) as archive:
        for name, data in content.items():
            archive.writestr(name, data)
    return path


def array_file(value):
    buffer = io.BytesIO()
    np.save(buffer, value)
    return buffer.getvalue()


def header(text):
    return b'\x93NUMPY\1\0' + len(text).to_bytes(2, 'little') + text


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize(
    'members, sentence',
    [
        ({'noise_px': header(b'((((\n')}, 'noise_px does not contain plain numbers'),
        ({'noise_px': header(b'(' * 60_000 + b'\n')}, 'noise_px does not contain plain numbers'),
        ({'noise_px': array_file(1e308)}, 'noise_px holds a value beyond 1e+06'),
        ({'train_uv': array_file(np.full((9, 2), 1e308))}, 'train_uv holds a value beyond'),
        ({'image_size': array_file(np.array([2**32, 1]))}, 'image_size holds a value beyond'),
        ({'image_size': array_file(np.array([32000, 32000]))}, 'more than 64 megapixels'),
        ({'interior': array_file(np.array([1.0, 1.0, 0.0]))}, 'the principal distance is 0 px'),
        ({'frame_id': array_file(np.array([2**31 - 1], 'u4').view('<U1')[0:1])}, 'frame_id'),
    ],
)
def test_crafted_array_is_refused(tmp_path, members, sentence):
    """It is refused in one sentence: numpy evaluates a header, and huge numbers overflow later."""
    assert sentence in refused(load_calibration, changed_calibration(tmp_path, **members))


def test_compression_that_numpy_does_not_write_is_refused(tmp_path):
    """A damaged LZMA member raises an exception of its own and may claim a dictionary of 4 GB."""
    path = changed_calibration(tmp_path, zipfile.ZIP_LZMA)
    assert 'compressed in a way that numpy does not use' in refused(load_calibration, path)


def test_training_points_on_one_place_are_refused(tmp_path):
    """A search tree cannot divide them: each of 16,000 nodes of the grid would visit them all."""
    count = limits.MAX_COINCIDENT + 1
    path = changed_calibration(
        tmp_path,
        train_uv=array_file(np.full((count, 2), 500.0)),
        train_duv=array_file(np.zeros((count, 2))),
        train_exposure=array_file(np.zeros(count, np.int64)),
    )
    assert 'training points coincide in the image' in refused(load_calibration, path)


def test_message_of_an_error_is_one_short_line():
    error = DataError('a\n[FATAL] forged\x1b[2J ' + 'x' * 10**6 + ' the cause')
    assert str(error).isprintable() and len(str(error)) < 1000
    assert str(error).startswith('a\\n[FATAL]') and str(error).endswith(' the cause')


@pytest.mark.parametrize('what', ['source', 'phantom', 'calibration', 'known'])
def test_pipe_does_not_hang(tmp_path, capsys, what):
    """A FIFO without a writer would block forever."""
    os.mkfifo(tmp_path / 'pipe.csv')
    (tmp_path / 'result').mkdir()
    for name in ('a.calibration.npz', 'options.json'):
        os.mkfifo(tmp_path / 'result' / name)
    pipe = tmp_path / 'pipe.csv'
    out = tmp_path / 'out'
    arguments = {
        'source': ('calibrate', pipe, '--phantom', 'bags/phantom.csv', '--out', out),
        'phantom': ('calibrate', 'bags/calibration', '--phantom', pipe, '--out', out),
        'calibration': ('validate', tmp_path / 'result'),
        'known': (
            *('calibrate', 'bags/calibration', '--phantom', 'bags/phantom.csv', '--out', out),
            *('--known-orientation', pipe),
        ),
    }[what]
    assert run(*arguments) == 1
    error = capsys.readouterr().err
    assert 'this is a pipe' in error and error.count('\n') == 1
    assert np.all([not out.exists()])
