# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Bags of a lab: other storages, restarting numbers, a time window, and pairing by stamp."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zstandard
from rigs import exposures, run
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.io.bags.metadata import (
    TARGET_OBSERVATIONS,
    message_from_frame,
    to_cdr,
    typestore,
)
from fluoro_calib_ros.io.bags.reader import read_frames, topics_of
from fluoro_calib_ros.io.bags.writer import write_bag
from fluoro_calib_ros.jobs.sources import BagSelection, read_source
from fluoro_calib_ros.limits import ReadLimits, use_read_limits

SECOND = 10**9


@pytest.fixture(scope='module')
def frames():
    return {name: each[:4] for name, each in exposures().items()}


@pytest.mark.parametrize(
    ('storage', 'mode'),
    [
        (StoragePlugin.SQLITE3, None),
        (StoragePlugin.SQLITE3, CompressionMode.FILE),
        (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
        (StoragePlugin.MCAP, CompressionMode.FILE),
        (StoragePlugin.MCAP, CompressionMode.MESSAGE),
    ],
)
def test_other_storages_are_read(tmp_path, frames, storage, mode):
    """sqlite3, and bags that are compressed by file or by message."""
    bag = Writer(tmp_path / 'bag', version=9, storage_plugin=storage)
    if mode is not None:
        bag.set_compression(mode, CompressionFormat.ZSTD)
    with bag:
        for name, each in frames.items():
            topic = f'/{name}/target_observations'
            connection = bag.add_connection(topic, TARGET_OBSERVATIONS, typestore=typestore())
            for frame in each:
                data = to_cdr(message_from_frame(frame), TARGET_OBSERVATIONS)
                bag.write(connection, frame.stamp_ns, data)
    found = read_frames(tmp_path / 'bag').frames
    for name, each in frames.items():
        for one, other in zip(found[name], each, strict=True):
            assert np.array_equal(one.uv, other.uv) and one.stamp_ns == other.stamp_ns
    assert topics_of(tmp_path / 'bag')['/a/target_observations'].count == 4
    for path in Path(tmp_path / 'bag').iterdir():
        if path.name != 'metadata.yaml':
            path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(DataError, match='bag'):
        read_frames(tmp_path / 'bag')


def test_a_bag_that_unpacks_to_far_more_than_its_size_is_refused(tmp_path, frames):
    bag = Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.MCAP)
    bag.set_compression(CompressionMode.FILE, CompressionFormat.ZSTD)
    with bag:
        topic = '/a/target_observations'
        connection = bag.add_connection(topic, TARGET_OBSERVATIONS, typestore=typestore())
        for frame in frames['a']:
            data = to_cdr(message_from_frame(frame), TARGET_OBSERVATIONS)
            bag.write(connection, frame.stamp_ns, data)
    (packed,) = (tmp_path / 'bag').glob('*.zstd')
    with open(packed, 'ab') as file:  # a further frame of zeros, as a decompressor joins them
        file.write(zstandard.ZstdCompressor().compress(bytes(40_000_000)))
    use_read_limits(ReadLimits(max_file_mb=1))
    try:
        with pytest.raises(DataError, match='unpacked, it has more'):
            read_frames(tmp_path / 'bag')
    finally:
        use_read_limits(ReadLimits())


def test_numbers_that_begin_again_become_different(tmp_path, frames):
    """The camera software was restarted between two series: pairs stay pairs."""
    again = {
        name: [replace(f, stamp_ns=f.stamp_ns + 3600 * SECOND) for f in each]
        for name, each in frames.items()
    }
    write_bag(tmp_path / 'bag', {name: [*frames[name], *again[name]] for name in frames})
    recording = read_source(tmp_path / 'bag', collect='all')
    assert 'the frame numbers restart (a 1, b 1 times)' in recording.notes[0]
    found = recording.frames
    first = [frame.number for frame in frames['a']]
    step = 10 ** len(str(max(first)))
    for name in frames:
        assert [f.number for f in found[name]] == [*first, *(n + step for n in first)]


def test_time_window(tmp_path, frames):
    write_bag(tmp_path / 'bag', frames)
    origin = frames['a'][0].stamp_ns
    middle = (frames['a'][2].stamp_ns - origin) * 1e-9
    numbers = [f.number for f in frames['a']]
    for selection, expected in (
        (BagSelection(start_s=middle - 0.01), numbers[2:]),
        (BagSelection(end_s=middle + 0.01), numbers[:3]),
        (BagSelection(middle - 0.01, middle + 0.01), numbers[2:3]),
    ):
        found = read_source(tmp_path / 'bag', selection=selection).frames
        assert [f.number for f in found['a']] == expected
    last = (frames['a'][-1].stamp_ns - origin) * 1e-9
    with pytest.raises(DataError, match=f'fluoroscope a in the time window.* {last:.3f} s'):
        read_source(tmp_path / 'bag', selection=BagSelection(start_s=1e6))
    with pytest.raises(DataError, match='need a bag'):
        read_source('points.csv', image_size=(9, 9), selection=BagSelection(start_s=1.0))


def test_pairing_by_stamp(tmp_path, frames, capsys):
    """The cameras number their frames independently and start at different times."""
    shifted = {
        'a': frames['a'],
        'b': [
            replace(f, number=f.number + 70, stamp_ns=f.stamp_ns + 1_500_000)
            for f in frames['b'][1:]
        ],
    }
    write_bag(tmp_path / 'bag', shifted)
    recording = read_source(tmp_path / 'bag', selection=BagSelection(pair_by='stamp'))
    assert recording.unpaired == {'a': 1, 'b': 0}
    assert [len(each) for each in recording.frames.values()] == [3, 3]
    for one, other in zip(*recording.frames.values()):
        assert one.number == other.number and other.stamp_ns - one.stamp_ns == 1_500_000
    narrow = BagSelection(pair_by='stamp', tolerance_s=0.001)
    assert read_source(tmp_path / 'bag', selection=narrow).unpaired == {'a': 4, 'b': 3}
    arguments = (
        'calibrate',
        tmp_path / 'bag',
        '--phantom',
        'p.csv',
        '--out',
        tmp_path / 'o',
        '--fast',
    )
    assert run(*arguments, '--pair-by', 'color') == 2
    assert 'invalid choice' in capsys.readouterr().err
