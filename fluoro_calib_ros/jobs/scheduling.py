# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Where the parts of a job run: in processes of this machine, or on a Dask cluster."""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from typing import Any, Protocol, TypeVar

from ..errors import DataError
from ..limits import ReadLimits, read_limits, use_read_limits
from ..processes import ProcessEnded, WorkerProcess, one_core

Task = TypeVar('Task')
Result = TypeVar('Result')

QUEUED = 3  # tasks that wait for each worker
CONNECT_S = 10  # to wait for a scheduler and its first worker
RETRIES = 2  # of a task that fails


class Workers(Protocol):
    """Workers that run a function on many tasks."""

    def map(self, function: Callable[[Task], Result], tasks: Iterable[Task]) -> Iterator[Result]:
        """Yield the results of tasks in their order; only a few of them are in memory."""


def open_workers(
    count: int = 0, scheduler: str | None = None, tasks: int = 0
) -> AbstractContextManager[Workers]:
    """Return workers, as a context that ends them.

    Parameters
    ----------
    count : int
        Processes; 0: as many as there are cores.
    scheduler : str or None
        Address of a Dask scheduler (tcp://host:port), in place of processes.
    tasks : int
        How many there will be, 0 where it is not known. For a single one, no process is started.

    Raises
    ------
    DataError
        Where the scheduler cannot be reached, or the package `distributed` is missing.
    """
    if scheduler is not None:
        return DaskWorkers(scheduler)
    return LocalWorkers(min(count or os.cpu_count() or 1, tasks or 2**31))


class LocalWorkers:
    """Processes of this machine, each called by a thread; for a single one, the caller's own."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._threads = ThreadPoolExecutor(count) if count > 1 else None
        self._of_thread = threading.local()
        self._processes: list[WorkerProcess] = []

    def __enter__(self) -> LocalWorkers:
        return self

    def __exit__(self, *error: object) -> None:
        if self._threads is not None:
            self._threads.shutdown(wait=True, cancel_futures=True)
        for process in self._processes:
            process.close()

    def map(self, function: Callable[[Task], Result], tasks: Iterable[Task]) -> Iterator[Result]:
        """Yield the results of tasks in their order. Raises DataError for a worker that died."""
        threads = self._threads
        if threads is None:
            for task in tasks:
                yield _alone(function, task, read_limits())
            return
        try:
            yield from _in_order(
                lambda task: threads.submit(self._call, function, task),
                tasks,
                QUEUED * self._count,
            )
        except ProcessEnded:
            raise DataError(
                'a worker process was ended from outside, perhaps for want of memory; start again '
                'with fewer processes (--workers)'
            ) from None

    def _call(self, function: Callable[[Task], Result], task: Task) -> Result:
        """Return the result of a task, from the process of this thread."""
        process: WorkerProcess | None = getattr(self._of_thread, 'process', None)
        if process is None:
            process = self._of_thread.process = WorkerProcess(_caller, 'a worker process')
            self._processes.append(process)
        return process(function, task)


def _caller() -> Callable[[Callable[[Task], Result], Task], Result]:
    """Return what a worker process does with a function and a task."""
    return _applied


def _applied(function: Callable[[Task], Result], task: Task) -> Result:
    return function(task)


class DaskWorkers:
    """Workers of a Dask cluster.

    A task whose worker dies runs again on another one. Functions and tasks travel as pickles
    between this process and the cluster, which therefore has to be trusted.
    """

    def __init__(self, address: str) -> None:
        try:
            from distributed import Client
        except ImportError:
            raise DataError(
                '--scheduler needs the package distributed: pip install distributed'
            ) from None
        try:
            self._client: Any = Client(address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise DataError(f'there is no Dask scheduler at {address}: {reason}') from None
        try:
            self._client.wait_for_workers(1, timeout=CONNECT_S)
        except TimeoutError:
            self._client.close()
            raise DataError(f'the Dask scheduler at {address} has no workers') from None

    def __enter__(self) -> DaskWorkers:
        return self

    def __exit__(self, *error: object) -> None:
        self._client.close()

    def map(self, function: Callable[[Task], Result], tasks: Iterable[Task]) -> Iterator[Result]:
        """Yield the results of tasks in their order. Raises DataError for a lost cluster."""
        from distributed import CancelledError, KilledWorker

        limits = read_limits()
        threads = max(sum(self._client.nthreads().values()), 1)
        try:
            yield from _in_order(
                lambda task: self._client.submit(
                    _alone, function, task, limits, pure=False, retries=RETRIES
                ),
                tasks,
                QUEUED * threads,
            )
        except (KilledWorker, CancelledError, OSError) as error:
            raise DataError(f'the Dask cluster has lost a task: {error}') from None


def _alone(function: Callable[[Task], Result], task: Task, limits: ReadLimits) -> Result:
    """Run a task on one core, as its worker has others beside it, with the caller's limits."""
    use_read_limits(limits)
    with one_core():
        return function(task)


def _in_order(
    submit: Callable[[Task], Future[Result]], tasks: Iterable[Task], queued: int
) -> Iterator[Result]:
    """Yield the results of submitted tasks in their order, with so many in flight at most."""
    waiting: deque[Future[Result]] = deque()
    for task in tasks:
        waiting.append(submit(task))
        if len(waiting) >= queued:
            yield waiting.popleft().result()
    while waiting:
        yield waiting.popleft().result()
