# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Signals end a command, whatever it is doing at that moment."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

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

LOSES_IT_AGAIN = """
import os
import signal
from fluoro_calib_ros.cli import output
output.AGAIN_S = 0.05

class Loses:
    def __del__(self):
        while True:  # the handler runs here, and Python drops what it raises
            pass

class Sender(Loses):
    def __del__(self):
        os.kill(os.getpid(), signal.SIGTERM)
        super().__del__()

with output.terminated_by_signals():
    for kind in (Sender, Loses, Loses):
        loses = kind()
        del loses
        print('goes on', flush=True)
    while True:
        pass
"""

ENDS_AT_LEISURE = """
import os
import signal
import time
from fluoro_calib_ros.cli import output
output.AGAIN_S = 0.05

try:
    with output.terminated_by_signals():
        os.kill(os.getpid(), signal.SIGTERM)
        signal.pause()
except SystemExit as error:
    time.sleep(0.3)
    print('ends with', error.code, flush=True)
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


def test_exception_that_python_drops_again_and_again_is_raised_until_it_ends_the_command():
    done = run(LOSES_IT_AGAIN)
    assert done.returncode == 143, done.stderr
    assert done.stdout == 'goes on\n' * 3


def test_no_signal_follows_a_command_that_has_ended():
    done = run(ENDS_AT_LEISURE)
    assert (done.returncode, done.stdout) == (0, 'ends with 143\n'), done.stderr
