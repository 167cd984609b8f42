# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""C3D files; the process that runs ezc3d is forked here, which is a hundred times faster."""

from __future__ import annotations

import io
import os
import resource
import signal
import subprocess
import sys
from pathlib import Path
from typing import NoReturn
from unittest import mock

import ezc3d
import numpy as np

from fluoro_calib_ros.io.formats import points as of_points
from fluoro_calib_ros.io.formats import reader_process
from fluoro_calib_ros.io.formats.content import Content, FileSettings, points_without_precision

from ..harness import Target
from ..seeds import written

SETTINGS = FileSettings()
SECONDS = 10  # time limit of a child
assert ezc3d  # import it before the forks


def run_forked(
    name: str, kind: str, path: str, timeout_s: float
) -> subprocess.CompletedProcess[bytes]:
    """Replace `run_module`: run the program of the reader in a forked process."""
    pipes = [os.pipe(), os.pipe()]
    child = os.fork()
    if not child:
        for (_, end), target in zip(pipes, (1, 2)):
            os.dup2(end, target)
        _work(kind, path)
    contents = []
    for ours, theirs in pipes:
        os.close(theirs)
        with open(ours, 'rb') as stream:
            contents.append(stream.read())
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if status == -signal.SIGALRM:
        raise TimeoutError(f'{name}: {timeout_s:g} s')
    return subprocess.CompletedProcess([name, path], status, *contents)


def _work(kind: str, path: str) -> NoReturn:
    """Run as the process of the reader."""
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    for number in (signal.SIGSEGV, signal.SIGABRT, signal.SIGFPE, signal.SIGBUS):
        signal.signal(number, signal.SIG_DFL)  # the fuzzer's own handlers would report a finding
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.alarm(SECONDS)
    sys.argv = ['reader_process', kind, path]
    sys.stdout = io.TextIOWrapper(io.FileIO(1, 'w', closefd=False))
    sys.stderr = io.TextIOWrapper(io.FileIO(2, 'w', closefd=False))
    status = 1
    try:
        reader_process.main()
        sys.stdout.flush()
        status = 0
    finally:
        sys.stderr.flush()
        os._exit(status)


def _read(path: Path) -> None:
    with mock.patch.object(reader_process, 'run_module', run_forked):
        of_points.read_c3d(path, SETTINGS)


def _write(path: Path, frames: int) -> None:
    xyz = np.arange(6.0 * frames).reshape(frames, 2, 3)
    xyz[-1, 0] = np.nan
    points = points_without_precision(np.arange(1, frames + 1), np.array([1, 2]), xyz, 100.0)
    of_points.write_c3d(path, Content(points=points), SETTINGS)


TARGET = Target(
    'c3d',
    'trial.c3d',
    _read,
    lambda: written(lambda path: _write(path, 1), lambda path: _write(path, 3)),
)
