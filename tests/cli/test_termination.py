# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Signals end a command, whatever it is doing at that moment."""

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from fluoro_calib_ros.cli import output

ROOT = Path(__file__).parents[2]

LOSES_THE_EXCEPTION = """
import os
import signal
import sys
from fluoro_calib_ros.cli import output
output.AGAIN_S = 0.05

class Sender:
    def __del__(self):
        os.kill(os.getpid(), signal.{name})
        for _ in range(1000):  # the handler runs here, and Python drops what it raises
            pass

with output.terminated_by_signals():
    sender = Sender()
    del sender
    print('goes on', flush=True)
    while True:
        pass
"""

CLEANS_UP = """
import os
import signal
import time
from fluoro_calib_ros.cli import output
output.AGAIN_S = 0.01

with output.terminated_by_signals():
    try:
        os.kill(os.getpid(), signal.SIGTERM)
        signal.pause()
    finally:
        end = time.monotonic() + 0.2
        while time.monotonic() < end:
            try:
                int('no number')
            except ValueError:
                pass
        print('cleaned up', flush=True)
"""


def run(program):
    return subprocess.run(
        [sys.executable, '-c', program], cwd=ROOT, capture_output=True, text=True, timeout=60
    )


@pytest.mark.parametrize(('name', 'status'), [('SIGTERM', 143), ('SIGINT', -signal.SIGINT)])
def test_exception_that_python_drops_is_raised_again(name, status):
    done = run(LOSES_THE_EXCEPTION.format(name=name))
    assert done.returncode == status, done.stderr
    assert done.stdout == 'goes on\n'
    assert 'Exception ignored' in done.stderr


def test_what_cleans_up_is_not_interrupted():
    done = run(CLEANS_UP)
    assert done.returncode == 143, done.stderr
    assert done.stdout == 'cleaned up\n'


@pytest.mark.parametrize('number', [signal.SIGTERM, signal.SIGINT])
def test_exception_that_is_lost_is_raised_again_and_again_until_the_command_has_ended(
    number, monkeypatch
):
    monkeypatch.setattr(output, 'AGAIN_S', 0.02)
    nothing = threading.Event()
    lost = []
    with output.terminated_by_signals():
        while len(lost) < 3:
            try:
                if not lost:
                    os.kill(os.getpid(), number)
                nothing.wait(60)
            except (SystemExit, KeyboardInterrupt) as error:
                lost.append(error)
    assert set(map(type, lost)) == {SystemExit if number == signal.SIGTERM else KeyboardInterrupt}
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
