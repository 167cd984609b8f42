# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A function with a memory, in a process of its own."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import Any

import cv2
from threadpoolctl import threadpool_limits

from .parent_watch import start_child

NICE = 5  # lower priority than the live nodes, higher than a calibration
END_S = 1.0  # in which a process that has closed its connection ends


class ServiceProcess:
    """Calls a function in another process, call after call, on one core.

    One thread calls it, any may close it. After a failure the next call starts a new process.

    Parameters
    ----------
    make : callable
        Makes the function in the process; it has to be picklable.
    what : str
        What the process does, for errors.
    """

    def __init__(self, make: Callable[[], Callable[..., Any]], what: str) -> None:
        self._make = make
        self._what = what
        self._lock = threading.Lock()
        self._closed = False
        self._process: SpawnProcess | None = None
        self._connection: Connection | None = None

    def start(self) -> None:
        """Start the process, so that it is ready for the first call."""
        with self._lock:
            if self._process is not None or self._closed:
                return
            context = multiprocessing.get_context('spawn')  # a fork would copy locks of threads
            self._connection, other = context.Pipe()
            self._process = start_child(context, _work, other, self._make)
            other.close()

    def __call__(self, *arguments: Any) -> Any:
        """Return the result of a call. Raises RuntimeError where function or process fails."""
        self.send(*arguments)
        return self.receive()

    def send(self, *arguments: Any) -> None:
        """Begin a call; its result is received before the next one. Raises RuntimeError."""
        self.start()
        try:
            self._open_connection().send(arguments)
        except OSError:
            raise self._ended() from None

    def receive(self) -> Any:
        """Return the result of the call that was begun. Raises RuntimeError."""
        try:
            result = self._open_connection().recv()
        except (EOFError, OSError):
            raise self._ended() from None
        if isinstance(result, BaseException):
            raise RuntimeError(f'{self._what} failed: {result}') from result
        return result

    def close(self) -> None:
        """End the process, also during a call, which then raises RuntimeError."""
        self._closed = True
        self._end(0)

    def _open_connection(self) -> Connection:
        connection = self._connection
        if connection is None:
            raise RuntimeError(f'{self._what} was ended')
        return connection

    def _ended(self) -> RuntimeError:
        """Clear up after a process that has ended by itself, and return the error."""
        status = self._end(END_S)
        return RuntimeError(f'the process of {self._what} ended with status {status}')

    def _end(self, patience_s: float) -> int | None:
        """End the process, by force where it does not end itself; returns its exit status."""
        with self._lock:
            process = self._process
            self._process = None
            self._connection = None
        if process is None:
            return None
        process.join(patience_s)
        process.terminate()
        process.join()
        return process.exitcode


def _work(connection: Connection, make: Callable[[], Callable[..., Any]]) -> None:
    """Answer calls until the caller has closed the connection or has died."""
    os.nice(NICE)
    cv2.setNumThreads(1)
    with suppress(EOFError, OSError), threadpool_limits(1):
        function = make()
        while True:
            arguments = connection.recv()
            try:
                result = function(*arguments)
            except Exception as error:  # this call is lost, the next one is not
                result = RuntimeError(repr(error))
            connection.send(result)
