# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Processes of the project that are killed, interrupted and monitored."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType

ROOT = Path(__file__).resolve().parents[2]
POLL_S = 0.005
LEFT_S = 2.0  # time after which no process started by the program may still run


class Process:
    """A process in its own session, with its output in a file; a context manager."""

    def __init__(self, command: Sequence[object], log: Path) -> None:
        self._log = log
        with open(log, 'wb') as out:
            self._process = subprocess.Popen(
                [str(word) for word in command],
                cwd=ROOT,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=out,
                start_new_session=True,
                # Use the sources next to this file, even if others are installed.
                env={**os.environ, 'PYTHONPATH': f'{ROOT}:{os.environ.get("PYTHONPATH", "")}'},
            )
        self.pid = self._process.pid

    @property
    def output(self) -> str:
        """Output of the process so far."""
        return self._log.read_text(errors='replace')

    @property
    def running(self) -> bool:
        return self._process.poll() is None

    def send(self, number: int) -> None:
        """Send a signal to the process, but not to its children."""
        self._process.send_signal(number)

    def wait(self, seconds: float = 60.0) -> int:
        """Return the exit status; if negative, the number of the signal that ended the process."""
        return self._process.wait(seconds)

    def kill(self) -> None:
        """Kill the process as a power failure would, but not its children."""
        self._process.kill()
        self._process.wait()

    def left(self, seconds: float = LEFT_S) -> list[int]:
        """Return the processes of the session that still run after at most this time."""
        end = time.monotonic() + seconds
        while True:
            left = members(self.pid)
            if not left or time.monotonic() > end:
                return left
            time.sleep(POLL_S)

    def __enter__(self) -> Process:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for pid in members(self.pid):
            os.kill(pid, signal.SIGKILL)
        self._process.wait()


def members(session: int) -> list[int]:
    """Return the running processes of a session."""
    found = []
    for name in os.listdir('/proc'):
        if name.isdigit():
            try:
                stat = Path('/proc', name, 'stat').read_text()
            except OSError:  # it has ended in the meantime
                continue
            state, _, _, of = stat.rpartition(')')[2].split()[:4]
            if int(of) == session and state not in 'ZX':
                found.append(int(name))
    return found


def command(*arguments: object) -> list[object]:
    """Return the command line that runs the command fluoro-calib."""
    return [sys.executable, '-m', 'fluoro_calib_ros.cli', *arguments]


def node(
    name: str,
    parameters: Mapping[str, object] | None = None,
    remaps: Mapping[str, str] | None = None,
) -> list[object]:
    """Return the command line that runs a node as its console script does."""
    script = Path(sys.prefix, 'bin', name)
    words: list[object] = [sys.executable]
    if script.exists():
        words.append(script)
    else:
        code = f'import sys; from fluoro_calib_ros.entry_points import {name}; sys.exit({name}())'
        words += ['-c', code]
    words.append('--ros-args')
    for key, value in (parameters or {}).items():
        words += ['-p', f'{key}:={value}']
    for key, new in (remaps or {}).items():
        words += ['-r', f'{key}:={new}']
    return words
