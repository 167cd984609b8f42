# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Folders are replaced as a whole: result folders and data sets, killed at any moment."""

import gc
import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from rigs import calibrated, exposures, rig, run

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation.options import CalibrationOptions, CalibrationRequest
from fluoro_calib_ros.io import folder as folder_module
from fluoro_calib_ros.io.calibration import load_calibrations
from fluoro_calib_ros.io.calibration_request import read_request
from fluoro_calib_ros.io.folder import (
    FolderKind,
    check_output_file,
    replaced_folder,
    temporary_folder,
)
from fluoro_calib_ros.jobs.calibration import CalibrationOutcome
from fluoro_calib_ros.jobs.result_folder import save_calibrations, save_outcome
from fluoro_calib_ros.jobs.simulation import SimulationOptions, simulate

KILLS = 25
ROOT = Path(__file__).parents[2]
KIND = FolderKind('a test folder', parts=('own*',), marks=('own.txt',))


@pytest.fixture(scope='module')
def outcomes():
    """Outcomes of two calibrations with different numbers of exposures."""
    made = []
    for count in (5, 6):
        result = calibrated('a', count, model='none')
        request = CalibrationRequest(
            {'a': exposures()['a'][:count]}, rig().phantom, CalibrationOptions(model='none')
        )
        made.append(CalibrationOutcome(request, result))
    return made


def fork():
    """Fork; the child never collects the garbage of other tests, such as contexts of ROS."""
    gc.freeze()
    child = os.fork()
    if child:
        gc.unfreeze()
    return child


def killed(work, seconds):
    """Run work() repeatedly in a process of its own, and kill the process after some seconds."""
    child = fork()
    if not child:
        try:
            while True:
                work()
        finally:
            os._exit(1)
    signal.sigtimedwait([], seconds)  # the kill comes at an arbitrary moment
    os.kill(child, signal.SIGKILL)
    assert os.waitpid(child, 0)[1] == signal.SIGKILL


def number_of_whole(path, outcomes):
    """Return the number of the outcome that a folder holds; fail for a mixture."""
    calibrations = load_calibrations(path)
    read_request(path, calibrations)  # checks that the sources are those of the calibrations
    document = json.loads((path / 'result.json').read_text())
    counts = [len(o.request.frames['a']) for o in outcomes]
    number = counts.index(len(document['fluoroscopes']['a']['exposures']))
    wanted = outcomes[number].result.calibrations['a'].calibration_id
    assert calibrations['a'].calibration_id == wanted
    return number


def hidden(path):
    return [name for name in os.listdir(path) if name.startswith('.')]


@pytest.mark.long
def test_killed_calibrations_leave_a_whole_folder(tmp_path, outcomes):
    """At every kill, the folder and the previous one are old or new; the next run cleans up."""
    path = tmp_path / 'result'
    save_outcome(path, outcomes[0])
    rng = random.Random(1)
    found = set()
    leftovers = 0

    def work():
        for outcome in outcomes:
            save_outcome(path, outcome)

    start = time.monotonic()
    work()
    longest = 1.5 * (time.monotonic() - start)
    # On a busy machine a kill may come before or after the work: those do not count.
    for kills in range(10 * KILLS):
        if kills >= KILLS and found == {0, 1} and leftovers > KILLS // 4:
            break
        killed(work, rng.uniform(0.0, longest))
        found.add(number_of_whole(path, outcomes))
        leftovers += len(hidden(tmp_path))
        if (tmp_path / 'result.previous').exists():
            number_of_whole(tmp_path / 'result.previous', outcomes)
    assert found == {0, 1} and leftovers > KILLS // 4, 'the kills hit nothing'
    save_outcome(path, outcomes[0])
    assert number_of_whole(path, outcomes) == 0
    assert sorted(os.listdir(tmp_path)) == ['result', 'result.previous']


@pytest.mark.long
def test_killed_simulation_leaves_a_whole_data_set(tmp_path):
    path = tmp_path / 'rig'
    options = [SimulationOptions(seed, 2, 0, 0.02) for seed in (1, 2)]
    digests = []
    for each in options:
        simulate(path, each)
        digests.append(contents(path))
    rng = random.Random(2)
    for _ in range(6):
        killed(lambda: [simulate(path, each) for each in options], rng.uniform(0.0, 0.3))
        assert contents(path) in digests


def contents(path):
    """Return files by name, but not hidden files: the next run deletes those of a killed one."""
    return {
        str(p.relative_to(path)): p.read_bytes()
        for p in path.rglob('*')
        if p.is_file() and not p.name.startswith('.')
    }


def test_terminated_command_leaves_nothing_unfinished(tmp_path):
    """Service managers send SIGTERM."""
    words = ['simulate', '--out', str(tmp_path / 'rig'), '--exposures', '5000']
    process = subprocess.Popen([sys.executable, '-m', 'fluoro_calib_ros.cli', *words], cwd=ROOT)
    pause = threading.Event()
    while not os.listdir(tmp_path):
        assert process.poll() is None
        pause.wait(0.01)
    process.terminate()
    assert process.wait(60) == 143
    assert not os.listdir(tmp_path)


def test_signal_right_after_the_folder_is_made_leaves_nothing(tmp_path, monkeypatch):
    real = os.mkdir

    def interrupted(path, *options):
        real(path, *options)
        raise SystemExit(143)

    monkeypatch.setattr(folder_module.os, 'mkdir', interrupted)
    with pytest.raises(SystemExit):
        write(tmp_path / 'work', 'first')
    assert not os.listdir(tmp_path)


def test_previous_folder_and_files_of_the_user_are_kept(tmp_path, outcomes):
    path = tmp_path / 'result'
    save_outcome(path, outcomes[0])
    (path / 'notes.txt').write_text('tube B was warm')
    (path / 'raw').mkdir()
    (path / 'raw' / 'frame.png').write_bytes(b'1')
    earlier = ('validation.json', 'names.csv', 'known_orientation.yaml')
    for name in earlier:
        (path / name).write_text('of an earlier calibration')
    before = contents(path)
    save_outcome(path, outcomes[1])
    assert contents(tmp_path / 'result.previous') == before
    assert (path / 'notes.txt').read_text() == 'tube B was warm'
    assert (path / 'raw' / 'frame.png').exists()
    assert not any((path / name).exists() for name in earlier)


@pytest.mark.parametrize('stop', ['swap', 'old'])
def test_run_killed_between_two_renames_is_finished_by_the_next(tmp_path, monkeypatch, stop):
    """The file system can or cannot exchange two folders."""
    path = tmp_path / 'work'
    write(path, 'first')
    write(path, 'second')
    if stop == 'old':  # the file system cannot exchange
        monkeypatch.setattr(folder_module, '_exchange', _no_exchange)
    real = os.rename

    def rename(source, target):
        real(source, target)
        if str(source) == str(path):  # the old folder has just been moved away
            os._exit(9)

    child = fork()
    if not child:
        folder_module.os.rename = rename
        folder_module.keep_as_previous = lambda *_: os._exit(9)
        write(path, 'third')
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 9 << 8
    monkeypatch.undo()
    assert len(hidden(tmp_path)) == (1 if stop == 'swap' else 2)
    assert path.exists() == (stop == 'swap')
    write(path, 'fourth')
    expected = {'swap': 'third', 'old': 'second'}[stop]
    assert (tmp_path / 'work.previous' / 'own.txt').read_text() == expected
    assert (path / 'own.txt').read_text() == 'fourth' and not hidden(tmp_path)


def _no_exchange(*_):
    raise OSError(22, 'Invalid argument')


def write(path, text):
    with replaced_folder(path, KIND) as folder:
        (folder / 'own.txt').write_text(text)


def test_folder_that_must_stay_is_written_in_place(tmp_path, monkeypatch):
    path = tmp_path / 'work'
    write(path, 'first')
    (path / 'own.old').write_text('x')
    monkeypatch.chdir(path)
    write('.', 'second')
    assert os.listdir('.') == ['own.txt'] and (path / 'own.txt').read_text() == 'second'
    assert os.listdir(tmp_path) == ['work']


def test_folder_with_folders_of_the_same_kind_stays(tmp_path):
    """The folder of a node without namespace contains those of the namespaces."""
    write(tmp_path / 'root' / 'rig', 'of the namespace')
    inode = os.stat(tmp_path / 'root').st_ino
    write(tmp_path / 'root', 'of no namespace')
    write(tmp_path / 'root', 'again')
    assert os.stat(tmp_path / 'root').st_ino == inode
    assert (tmp_path / 'root' / 'rig' / 'own.txt').read_text() == 'of the namespace'


def test_failed_write_changes_nothing(tmp_path, outcomes):
    path = tmp_path / 'result'
    save_outcome(path, outcomes[0])
    before = contents(path)

    def fail(folder):
        raise DataError(f'{folder}/figures: cannot be written (no space left on device)')

    with pytest.raises(DataError, match='^' + str(path) + '/figures: cannot'):
        save_outcome(path, outcomes[1], write_more=fail)
    assert contents(path) == before and os.listdir(tmp_path) == ['result']


def test_saved_calibrations_do_not_mix_with_another_result(tmp_path, outcomes):
    save_outcome(tmp_path / 'result', outcomes[0])
    before = contents(tmp_path / 'result')
    save_calibrations(tmp_path / 'result', outcomes[0].calibrations, None)
    assert contents(tmp_path / 'result') == before
    save_calibrations(tmp_path / 'result', outcomes[1].calibrations, None)
    assert os.listdir(tmp_path / 'result') == ['a.calibration.npz']
    assert contents(tmp_path / 'result.previous') == before


def test_output_that_would_destroy_something_is_refused(tmp_path, capsys):
    """Each is refused in one sentence before anything is computed."""
    simulate(tmp_path / 'rig', SimulationOptions(1, 1, 0, 0.0))
    source, phantom = tmp_path / 'rig' / 'calibration', tmp_path / 'rig' / 'phantom.csv'
    foreign = tmp_path / 'home'
    foreign.mkdir()
    (foreign / 'thesis.tex').write_text('x')
    os.mkfifo(tmp_path / 'pipe')
    before = contents(tmp_path / 'rig')
    for out, said in (
        (source, 'would be overwritten'),
        (tmp_path / 'rig', 'would be overwritten'),
        (source / 'result', 'is inside the input'),
        (phantom, 'this is a file'),
        ('/dev/null', 'this is a device'),
        (tmp_path / 'pipe', 'this is a pipe'),
        (foreign, 'it holds thesis.tex'),
        ('/proc/result', 'cannot be written'),
    ):
        assert run('calibrate', source, '--phantom', phantom, '--out', out) == 1
        error = capsys.readouterr().err
        assert said in error and error.count('\n') == 1 and str(out) in error
    assert run('simulate', '--out', foreign) == 1
    assert 'not a data set' in capsys.readouterr().err
    assert contents(tmp_path / 'rig') == before and os.listdir(foreign) == ['thesis.tex']


def test_output_file_that_is_an_input_is_refused(tmp_path):
    (tmp_path / 'bag').mkdir()
    (tmp_path / 'bag' / 'bag_0.mcap').write_bytes(b'x')
    (tmp_path / 'points.csv').write_text('x')
    os.link(tmp_path / 'points.csv', tmp_path / 'same.csv')
    os.mkfifo(tmp_path / 'pipe')
    inputs = (tmp_path / 'bag', tmp_path / 'points.csv')
    for name in ('bag/bag_0.mcap', 'same.csv', 'pipe', 'bag'):
        with pytest.raises(DataError, match='choose another output'):
            check_output_file(tmp_path / name, inputs)
    (tmp_path / 'earlier.json').write_text('of an earlier run')
    for name in ('bag/points3d.csv', 'new.csv', 'earlier.json'):
        check_output_file(tmp_path / name, inputs)
    assert np.all([p.exists() for p in inputs])


def test_temporary_folder_of_a_killed_run_is_deleted_and_that_of_a_running_one_is_not(tmp_path):
    left = tmp_path / '.out.0123456789abcdef.tmp'
    left.mkdir()
    (left / 'image.png').write_bytes(b'x')
    with temporary_folder(tmp_path / 'out') as running:
        assert not left.exists()
        (running / 'file').write_bytes(b'x')
        with temporary_folder(tmp_path / 'out') as second:
            assert running.is_dir() and second != running
        assert [path.name for path in tmp_path.iterdir()] == [running.name]
    assert list(tmp_path.iterdir()) == []
