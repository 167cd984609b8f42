# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Work in separate processes, which are started, watched, limited and ended in a uniform way.

A `WorkerProcess` calls a function in another process, call after call; `LentArrays` passes large
arrays to it without pickling them; `run_module` runs a module as a program. Both processes end
with the one that started them, however that ends. `Programs` run alongside, and are interrupted
when their context ends.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from multiprocessing.reduction import ForkingPickler
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import numpy as np

from .errors import DataError
from .limits import ReadLimits, read_limits, use_read_limits

Started = TypeVar('Started', bound='Programs')

PARENT_POLL_S = 0.5  # interval at which a process checks whether its caller is alive
CANCEL_POLL_S = 0.05  # interval at which a call can be cancelled
END_S = 1.0  # time limit for a process to end after closing its connection
PROGRAM_END_S = 5  # time limit for a program to end after an interrupt


@dataclass(frozen=True)
class Resources:
    """Resources of the machine that a process may use."""

    nice: int = 0  #: decrease of its priority
    one_core: bool = True  #: whether its libraries use a single thread each


OF_STREAM = Resources(nice=5)  # lower priority than the nodes, which must not wait for images
OF_JOB = Resources(nice=10, one_core=False)  # lower priority than all live processing


class ProcessEnded(RuntimeError):
    """Raised when a process has ended during a call."""


class WorkerProcess:
    """Calls a function in another process, call after call.

    One thread calls it; any thread may close it. After its process has ended, the next call starts
    a new one. Keyboard interrupts do not reach the process.

    make: picklable; returns the function, in the process. description: of the process, for
    error messages: 'the process of ...'.
    """

    def __init__(
        self,
        make: Callable[[], Callable[..., Any]],
        description: str,
        resources: Resources = Resources(),
    ) -> None:
        self._make = make
        self._what = description
        self._resources = resources
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
            self._connection, child_connection = context.Pipe()
            # Arguments are unpickled in order: the watch before those that import modules.
            arguments = (
                _ParentWatch(),
                read_limits(),
                self._resources,
                child_connection,
                self._make,
            )
            self._process = context.Process(target=_serve, daemon=True, args=arguments)
            with interrupts_blocked():
                self._process.start()
            child_connection.close()

    def __call__(
        self,
        *arguments: Any,
        progress: Callable[..., None] | None = None,
        raise_if_cancelled: Callable[[], None] | None = None,
    ) -> Any:
        """Return the result of a call.

        The arguments must be picklable. If progress is given, the function receives a progress
        argument whose calls are forwarded to it. raise_if_cancelled is called repeatedly; if it
        raises, the process is ended. Raises ValueError and OSError, which users can cause, if the
        function does; RuntimeError if it fails otherwise; and ProcessEnded if the process ends.
        """
        self.send(*arguments, progress=progress is not None)
        return self.receive(progress, raise_if_cancelled)

    def send(self, *arguments: Any, progress: bool = False) -> None:
        """Start a call, whose result must be received before the next one. Raises ProcessEnded."""
        self.start()
        pickled = _Pieces()
        ForkingPickler(pickled, pickle.HIGHEST_PROTOCOL).dump((arguments, progress))
        try:
            self._open_connection().send_bytes(b''.join(pickled.pieces))
        except OSError:
            self._raise_ended()

    def receive(
        self,
        progress: Callable[..., None] | None = None,
        raise_if_cancelled: Callable[[], None] | None = None,
    ) -> Any:
        """Return the result of the call that was started; errors are those of a call."""
        connection = self._open_connection()
        try:
            while True:
                if raise_if_cancelled is not None:
                    raise_if_cancelled()
                    if not connection.poll(CANCEL_POLL_S):
                        continue
                message = self._received(connection)
                if not isinstance(message, _Progress):
                    break
                if progress is not None:
                    progress(*message.arguments)
        except BaseException:  # cancelled or interrupted: the process is still working
            self._end(0)
            raise
        if not isinstance(message, _Failure):
            return message
        if message.error is not None:
            raise message.error
        trace = RuntimeError(message.trace)
        raise RuntimeError(f'{self._what} failed: {message.text}') from trace

    def _received(self, connection: Connection) -> Any:
        """Return the next message of the process. Raises ProcessEnded."""
        try:
            return connection.recv()
        except (EOFError, OSError):
            self._raise_ended()

    def close(self) -> None:
        """End the process, even during a call, which then raises RuntimeError."""
        self._closed = True
        self._end(0)

    def _open_connection(self) -> Connection:
        connection = self._connection
        if connection is None:
            raise ProcessEnded(f'{self._what} was ended')
        return connection

    def _raise_ended(self) -> NoReturn:
        """Clean up after a process that has ended by itself, and raise ProcessEnded."""
        status = self._end(END_S)
        raise ProcessEnded(f'{self._what} ended with status {status}') from None

    def _end(self, patience_s: float) -> int | None:
        """End the process, by force if it does not end by itself; return its exit status."""
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


class _Pieces:
    """File for a pickler, which writes pieces of 64 kB, so that other threads run in between.

    Pickling thousands of frames takes 0.15 s, in which an input in another thread loses frames.
    """

    def __init__(self) -> None:
        self.pieces: list[bytes] = []

    def write(self, piece: bytes) -> None:
        self.pieces.append(bytes(piece))


def in_worker_process(
    function: Callable[..., Any] | str,
    *arguments: Any,
    progress: Callable[..., None] | None = None,
    raise_if_cancelled: Callable[[], None] | None = None,
) -> Any:
    """Return the result of one call of a function in a process with the resources of a job.

    The function belongs to a module, or is given as 'module:function' of this package, which only
    the process imports. Errors are those of a call of a WorkerProcess.
    """
    process = WorkerProcess(partial(_given, function), 'the worker process', OF_JOB)
    try:
        return process(*arguments, progress=progress, raise_if_cancelled=raise_if_cancelled)
    finally:
        process.close()


def _given(function: Callable[..., Any] | str) -> Callable[..., Any]:
    if not isinstance(function, str):
        return function
    module, _, name = function.partition(':')
    imported: Callable[..., Any] = getattr(import_module(f'.{module}', __package__), name)
    return imported


class LentArrays:
    """Shared memory for arrays that are arguments of a WorkerProcess.

    Each slot contains one array, which is read-only in the process. A slot may only be filled
    again after the call that used it.
    """

    def __init__(self) -> None:
        self._blocks: dict[str, SharedMemory] = {}

    def lend(self, slot: str, array: np.ndarray) -> Any:
        """Copy an array into a slot; return the argument that a process receives as this array."""
        block = self._blocks.get(slot)
        if block is None or block.size < array.nbytes:
            self._release(slot)
            block = self._blocks[slot] = SharedMemory(create=True, size=max(array.nbytes, 1))
        np.ndarray(array.shape, array.dtype, block.buf)[...] = array
        return _Lent(block.name, array.shape, array.dtype.str)

    def close(self) -> None:
        """Free the memory; the process keeps its mapping until it ends."""
        for slot in tuple(self._blocks):
            self._release(slot)

    def _release(self, slot: str) -> None:
        block = self._blocks.pop(slot, None)
        if block is not None:
            block.close()
            block.unlink()


@dataclass(frozen=True)
class _Lent:
    """Array in shared memory, in the form that is sent."""

    name: str
    shape: tuple[int, ...]
    dtype: str

    def __reduce__(self) -> tuple[Callable[..., np.ndarray], tuple[Any, ...]]:
        return _borrowed, (self.name, self.shape, self.dtype)


_borrowed_blocks: dict[str, SharedMemory] = {}  # blocks in use by this process, by name


def _borrowed(name: str, shape: tuple[int, ...], dtype: str) -> np.ndarray:
    """Return an array lent by the caller of this process."""
    if name not in _borrowed_blocks:
        _borrowed_blocks[name] = SharedMemory(name)
    array: np.ndarray = np.ndarray(shape, dtype, _borrowed_blocks[name].buf)
    array.flags.writeable = False
    return array


@dataclass(frozen=True)
class _Progress:
    """Arguments of a call of progress."""

    arguments: tuple[Any, ...]


@dataclass(frozen=True)
class _Failure:
    """Exception raised by a function, and its traceback."""

    error: ValueError | OSError | None  #: to be raised again; None for a bug
    text: str
    trace: str


def _serve(
    _: None,
    limits: ReadLimits,
    resources: Resources,
    connection: Connection,
    make: Callable[[], Callable[..., Any]],
) -> None:
    """Answer calls until the caller has closed the connection or died."""
    use_read_limits(limits)
    if hasattr(os, 'nice'):  # Windows has no such number
        os.nice(resources.nice)
    with ExitStack() as stack:
        stack.enter_context(suppress(EOFError, BrokenPipeError, ConnectionResetError))
        if resources.one_core:
            stack.enter_context(one_core())
        function = make()
        while True:
            arguments, progress = connection.recv()
            keywords = {'progress': lambda *a: connection.send(_Progress(a))} if progress else {}
            connection.send(_answer(function, arguments, keywords))


def _answer(
    function: Callable[..., Any], arguments: tuple[Any, ...], keywords: dict[str, Any]
) -> Any:
    """Return the result of a function, or a _Failure, so that later calls are still answered."""
    try:
        return function(*arguments, **keywords)
    except BrokenPipeError:
        raise  # the caller has gone
    except Exception as error:
        trace = ''.join(traceback.format_exception(error))
        return _Failure(_portable(error), repr(error), trace)


def _portable(error: Exception) -> ValueError | OSError | None:
    """Return an error that can be sent to the caller, or None for an error that indicates a bug.

    Errors of other packages may have special arguments, so that they cannot be recreated.
    """
    if isinstance(error, DataError):
        return error
    if isinstance(error, OSError):
        if error.errno is None:
            return OSError(str(error))
        return OSError(error.errno, error.strerror, error.filename)
    return ValueError(str(error)) if isinstance(error, ValueError) else None


@contextmanager
def one_core() -> Iterator[None]:
    """Restrict the libraries of this process to one thread each, as others work in parallel."""
    import cv2
    from threadpoolctl import threadpool_limits

    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with threadpool_limits(1):
            yield
    finally:
        cv2.setNumThreads(threads)


@contextmanager
def interrupts_blocked() -> Iterator[None]:
    """Block keyboard interrupts in the processes that are started in this context.

    They inherit the signal mask of the calling thread: an interrupt only reaches the caller, which
    ends them. Windows has no signal masks.
    """
    if not hasattr(signal, 'pthread_sigmask'):
        yield
        return
    resource_tracker.ensure_running()  # starting it unblocks interrupts
    masked = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, masked)


class _ParentWatch:
    """Argument of a process that starts to watch the parent when it is unpickled.

    That happens before the process imports the modules of the later arguments, which takes seconds
    on a busy machine.
    """

    def __reduce__(self) -> tuple[Callable[[int], None], tuple[int]]:
        return watch_parent, (os.getpid(),)


def watch_parent(parent: int) -> None:
    """End this process with its parent, from a dedicated thread."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(PARENT_POLL_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


class Programs:
    """Context manager for modules that run as programs and end together.

    Each has its own session, so that keyboard interrupts reach it only from here, in order.
    """

    def __init__(self) -> None:
        self._processes: list[subprocess.Popen[Any]] = []

    def run(
        self, name: str, *arguments: str, log: Path, out: Path | None = None
    ) -> subprocess.Popen[Any]:
        """Start a module and append its output to a file; return its process.

        out: file of its standard output, by default the log.
        """
        with ExitStack() as stack:
            errors = stack.enter_context(open(log, 'ab'))
            output = errors if out is None else stack.enter_context(open(out, 'wb'))
            process = subprocess.Popen(
                _command(name, arguments), stdout=output, stderr=errors, start_new_session=True
            )
        self._processes.append(process)
        return process

    def failed(self) -> list[subprocess.Popen[Any]]:
        """Return the processes that have ended with a fault."""
        return [p for p in self._processes if p.poll() not in (None, 0)]

    def __enter__(self: Started) -> Started:
        return self

    def __exit__(self, *error: object) -> None:
        running = [p for p in self._processes if p.poll() is None]
        for process in running:
            process.send_signal(signal.SIGINT)
        for process in running:
            try:
                process.wait(timeout=PROGRAM_END_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def run_module(name: str, *arguments: str, timeout_s: float) -> subprocess.CompletedProcess[bytes]:
    """Run a module of the package as a program, without importing the caller's main module.

    The program must call watch_parent(). Raises TimeoutError.
    """
    root = str(Path(__file__).resolve().parents[1])
    environment = {
        **os.environ,
        'OPENBLAS_NUM_THREADS': '1',  # each thread takes address space
        'PYTHONPATH': os.pathsep.join(filter(None, [root, os.environ.get('PYTHONPATH')])),
    }
    try:
        return subprocess.run(
            _command(name, arguments),
            capture_output=True,
            timeout=timeout_s,
            env=environment,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise TimeoutError(f'{name} takes longer than {timeout_s:g} s') from None


def _command(name: str, arguments: Sequence[str]) -> list[str]:
    """Return the command that runs a module."""
    return [sys.executable, '-m', name, *arguments]
