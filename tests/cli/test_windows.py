# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Commands without the functions of Python that Windows does not have."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from rigs import exposures

from fluoro_calib_ros.io.bags.writer import write_bag
from fluoro_calib_ros.io.calibration import load_calibrations

BAGS = Path(__file__).resolve().parents[2] / 'bags'

WITHOUT = """
import os
import signal
import sys

for name in ('fcntl', 'resource', 'termios', 'pwd', 'grp'):
    sys.modules[name] = None
for module, names in (
    (signal, 'SIGALRM SIGHUP SIGVTALRM ITIMER_REAL setitimer alarm pause pthread_sigmask'),
    (signal, 'SIG_BLOCK SIG_SETMASK sigwait pthread_kill'),
    (os, 'nice getuid geteuid killpg setsid mkfifo statvfs sched_getaffinity O_DIRECTORY fork'),
):
    for name in names.split():
        delattr(module, name)
if __name__ == '__main__':
"""
COMMANDS = """
    from fluoro_calib_ros.cli import main

    for model in ('none', 'parametric'):  # the second replaces the first
        main([*sys.argv[1:], '--model', model])
"""
WORKER = """
    from fluoro_calib_ros.processes import in_worker_process

    assert in_worker_process('findings:first_few', [1, 2]) == '1, 2'
"""


@pytest.fixture
def run(tmp_path):
    def run(program, *words):
        path = tmp_path / 'program.py'
        path.write_text(WITHOUT + program)
        done = subprocess.run(
            [sys.executable, path, *map(str, words)], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr

    return run


def test_commands_need_no_function_that_windows_lacks(run, tmp_path):
    out = tmp_path / 'result'
    few = [replace(f, target_id=f.target_id[::3], uv=f.uv[::3]) for f in exposures(5)['a']]
    write_bag(tmp_path / 'few', {'a': few})
    words = (tmp_path / 'few', '--phantom', BAGS / 'phantom.csv', '--fluoroscopes', 'a')
    run(COMMANDS, 'calibrate', *words, '--fast', '--out', out)
    assert load_calibrations(out)['a'].model.kind == 'parametric'
    assert load_calibrations(f'{out}.previous')['a'].model.kind == 'none'


def test_worker_processes_need_no_function_that_windows_lacks(run):
    run(WORKER)
