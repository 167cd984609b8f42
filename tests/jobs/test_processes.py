# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Work in other processes: results, errors, progress, cancellation and termination."""

from __future__ import annotations

import multiprocessing
import os
import signal

import cv2
import pytest
from process_work import Work

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.limits import ReadLimits, use_read_limits
from fluoro_calib_ros.processes import (
    ProcessEnded,
    Resources,
    WorkerProcess,
    one_core,
    run_module,
)


@pytest.fixture
def process():
    worker = WorkerProcess(Work, 'the process of the work', Resources(nice=3))
    yield worker
    worker.close()
    assert not multiprocessing.active_children()


def test_errors_of_users_arrive_as_they_are_and_others_are_named(process):
    with pytest.raises(DataError, match=r'^a\.csv: row 3 is damaged$'):
        process('data')
    with pytest.raises(OSError, match='no space left') as caught:
        process('disk')
    assert caught.value.errno == 28
    with pytest.raises(RuntimeError, match=r'the process of the work failed: .*by zero') as failed:
        process('bug')
    assert 'ZeroDivisionError' in str(failed.value.__cause__)
    with pytest.raises(RuntimeError, match=r'the process of the work failed: .*1 and 2'):
        process('own')
    assert process('count') == 5  # the same process, which has counted the earlier calls


def test_progress_is_called_here_in_order(process):
    rounds = []
    assert process('rounds', progress=lambda *content: rounds.append(content)) == 1
    assert rounds == [('a', 0), ('a', 1), ('a', 2)]


@pytest.mark.parametrize('when', ['cancel', 'progress'])
def test_an_exception_of_the_caller_ends_the_process(process, when):
    process.start()

    def cancel(*_):
        raise InterruptedError('enough')

    if when == 'cancel':
        with pytest.raises(InterruptedError):
            process('wait', raise_if_cancelled=cancel)
    else:
        with pytest.raises(InterruptedError):
            process('rounds', progress=cancel)
    assert not multiprocessing.active_children()
    assert process('count') == 1  # a new process, which starts to count anew


def test_a_process_that_ends_is_told_and_replaced(process):
    with pytest.raises(ProcessEnded, match='the process of the work ended with status 3'):
        process('exit')
    assert process('count') == 1
    (child,) = multiprocessing.active_children()
    os.kill(child.pid, signal.SIGKILL)
    with pytest.raises(ProcessEnded, match='ended with status -9'):
        process('count')


def test_a_process_has_the_limits_of_its_caller_and_one_core(process):
    use_read_limits(ReadLimits(max_file_mb=7))
    try:
        nice, threads, megabytes = process('state')
    finally:
        use_read_limits(ReadLimits())
    assert nice == min(os.nice(0) + 3, 19) and threads == 1 and megabytes == 7


def test_a_module_that_takes_too_long_is_ended():
    with pytest.raises(TimeoutError, match=r'longer than 0\.2 s'):
        run_module('http.server', '0', timeout_s=0.2)
    done = run_module('fluoro_calib_ros.io.formats.reader_process', 'c3d', '/no.c3d', timeout_s=60)
    assert done.returncode == 1 and done.stderr


def test_libraries_have_their_threads_again_after_work_on_one_core():
    before = cv2.getNumThreads()
    cv2.setNumThreads(2)
    with one_core():
        assert cv2.getNumThreads() == 1
    assert cv2.getNumThreads() == 2
    cv2.setNumThreads(before)
