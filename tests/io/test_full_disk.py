# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A disk that is really full or read-only: earlier files do not change."""

import os
import shutil
import threading
from pathlib import Path

import pytest
from rigs import run
from small_disk import Disk

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.io.bags.metadata import known_definition, profile, to_cdr, typestore
from fluoro_calib_ros.io.bags.reader import iterate_messages
from fluoro_calib_ros.io.bags.recording import Recording, RecordingOptions, TopicToRecord
from fluoro_calib_ros.io.bags.salvage import recover_bag
from fluoro_calib_ros.jobs.simulation import SimulationOptions, simulate

STRING = 'std_msgs/msg/String'
START = 10**18
FREE_KB = (0, 4, 60)
KEPT = 10  # number of messages on the disk before it is full


@pytest.fixture
def disk(tmp_path):
    with Disk(tmp_path / 'disk') as disk:
        yield disk


@pytest.fixture(scope='module')
def rig(tmp_path_factory):
    path = tmp_path_factory.mktemp('rig') / 'rig'
    simulate(path, SimulationOptions(1, 5, 0, 0.0))
    return path


@pytest.fixture(scope='module')
def earlier(rig, tmp_path_factory):
    """The files written by earlier runs of the commands."""
    path = tmp_path_factory.mktemp('earlier')
    for words in commands(rig, path):
        assert run(*words) == 0
    return path


def commands(rig: Path, folder: Path):
    """Return the arguments of commands that write results to a folder."""
    result, data = folder / 'result', folder / 'data'
    calibrate = ('calibrate', rig / 'calibration.csv', '--phantom', rig / 'phantom.csv')
    how = ('--image-size', '1024x1024', '--model', 'none', '--fast')
    return (
        (*calibrate, *how, '--out', result),
        ('simulate', '--exposures', 3, '--seconds', 0.2, '--out', data),
    )


@pytest.mark.parametrize('free_kb', FREE_KB)
@pytest.mark.long
def test_command_on_a_full_disk_keeps_what_was_there(rig, earlier, disk, free_kb, capsys):
    """Old results do not change, nothing is unfinished, and there is one sentence."""
    shutil.copytree(earlier, disk.path, dirs_exist_ok=True)
    disk.leave(free_kb)
    before = disk.contents()
    capsys.readouterr()
    for words in commands(rig, disk.path):
        assert run(*words) == 1
        error = capsys.readouterr().err
        assert 'no space left on device' in error and error.count('\n') == 1
        assert disk.contents() == before


def test_command_on_a_read_only_disk_says_so(rig, disk, capsys):
    disk.make_read_only()
    for words in commands(rig, disk.path):
        assert run(*words) == 1
        error = capsys.readouterr().err
        assert 'cannot be written (read-only file system)' in error and error.count('\n') == 1
    with pytest.raises(DataError, match='read-only file system'):
        Recording(disk.path / 'bag').start()


@pytest.mark.parametrize('free_kb', FREE_KB)
def test_recording_on_a_full_disk_loses_no_more_than_it_says(tmp_path, disk, free_kb):
    """Earlier messages can be recovered; every other message is counted as dropped."""
    disk.leave(free_kb)
    recording = Recording(disk.path / 'bag', RecordingOptions(flush_period=0.05))
    try:
        recording.start()
    except DataError as error:
        assert free_kb < 60 and 'no space left on device' in str(error)
        return
    recording.add_topic(TopicToRecord('/x', STRING, [profile()], known_definition(STRING)))
    count = 0

    def put():
        nonlocal count
        text = os.urandom(500).hex()  # 0.5 kB after compression
        message = to_cdr(typestore().types[STRING](data=text), STRING)
        recording.put('/x', message, START + count, START + count)
        count += 1

    for _ in range(KEPT):
        put()
    pause = threading.Event()
    while not recording.fault and (recording.counts.total() < KEPT or recording._unflushed):
        pause.wait(0.01)
    while not recording.fault:
        put()
        assert count < 10**6
    recording.stop()
    assert 'no space left on device' in recording.fault
    assert recording.counts.total() + recording.dropped.total() == count
    try:
        recover_bag(disk.path / 'bag', tmp_path / 'out')
    except DataError as error:
        assert 'nothing can be recovered' in str(error)
        assert free_kb < 60 and not recording.counts.total()
        return
    found = [m.log_time_ns - START for m in iterate_messages(tmp_path / 'out')]
    assert found == list(range(len(found))) and len(found) >= recording.counts.total()
