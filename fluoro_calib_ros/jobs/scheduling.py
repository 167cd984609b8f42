# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Where the parts of a job run: in processes of this machine, or on a Dask cluster."""

from __future__ import annotations

import gc
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass
from ipaddress import ip_address
from typing import Any, Protocol, TypeVar
from urllib.parse import urlsplit

from ..errors import DataError
from ..io.access import read_bytes
from ..limits import ReadLimits, read_limits, use_read_limits
from ..processes import ProcessEnded, WorkerProcess, one_core

Task = TypeVar('Task')
Result = TypeVar('Result')

QUEUED = 3  # tasks that wait for each worker
CONNECT_S = 10  # to wait for a scheduler and its first worker


class Workers(Protocol):
    """Workers that run a function on many tasks."""

    def map(self, function: Callable[[Task], Result], tasks: Iterable[Task]) -> Iterator[Result]:
        """Yield the results of tasks in their order; only a few of them are in memory."""


def open_workers(
    count: int = 0, scheduler: Cluster | str | None = None, tasks: int = 0
) -> AbstractContextManager[Workers]:
    """Return workers, as a context that ends them: processes, or those of a Dask cluster.

    count: of the processes, 0 for as many as there are cores. tasks: how many there will be, 0
    where it is not known; for a single one, no process is started. Raises DataError where the
    scheduler cannot be reached or is not trusted, or the package `distributed` is missing.
    """
    if scheduler is not None:
        return DaskWorkers(Cluster(scheduler) if isinstance(scheduler, str) else scheduler)
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


@dataclass(frozen=True)
class Cluster:
    """A Dask cluster: who it is, and why it is trusted.

    Functions, tasks and results travel as pickles: scheduler and workers can run code here, and
    whoever reaches them can run code there.
    """

    #: address: tls://host:port, or tcp://host:port on this machine or in a trusted network
    scheduler: str
    #: files (PEM) of the authority that has signed the certificates of the cluster, and of the
    #: certificate of this process and its key; '' for none
    tls_ca: str = ''
    tls_cert: str = ''
    tls_key: str = ''
    #: whether all who reach the network of a tcp:// scheduler are trusted
    trusted_network: bool = False

    def security(self) -> Any:
        """Return what the client proves and demands, None for plain TCP. Raises DataError."""
        from distributed.security import Security

        files = (self.tls_ca, self.tls_cert, self.tls_key)
        if self.scheduler.startswith('tls://'):
            if not all(files):
                raise DataError(
                    f'{self.scheduler}: a scheduler with TLS needs the certificate of the '
                    'authority, and one of this process with its key: --tls-ca, --tls-cert and '
                    '--tls-key'
                )
            for path in files:
                read_bytes(path)
            return Security(
                tls_ca_file=self.tls_ca,
                tls_client_cert=self.tls_cert,
                tls_client_key=self.tls_key,
                require_encryption=True,
            )
        if any(files):
            raise DataError(f'{self.scheduler}: certificates are for a scheduler tls://HOST:PORT')
        if not self.trusted_network and not _is_of_this_machine(self.scheduler):
            raise DataError(
                f'{self.scheduler}: whoever reaches this scheduler can run code here; start it '
                'with TLS (tls://HOST:PORT, --tls-ca, --tls-cert, --tls-key), or say that you '
                'trust all of its network: --trusted-network'
            )
        return None


def _is_of_this_machine(address: str) -> bool:
    """Return whether an address is a loopback one, in numbers; a name may be that of another."""
    host = urlsplit(address if '//' in address else f'//{address}').hostname or ''
    try:
        return host == 'localhost' or ip_address(host).is_loopback
    except ValueError:
        return False


def _connected(cluster: Cluster) -> Any | str:
    """Return a client of a scheduler, or why there is none."""
    try:
        from distributed import Client
    except ImportError:
        raise DataError(
            '--scheduler needs the package distributed: pip install distributed'
        ) from None
    security = cluster.security()
    try:
        return Client(
            cluster.scheduler, timeout=CONNECT_S, set_as_default=False, security=security
        )
    except (OSError, ValueError) as error:
        return str(error).splitlines()[0] if str(error) else type(error).__name__


class DaskWorkers:
    """Workers of a Dask cluster. A task whose worker dies runs again on another one."""

    def __init__(self, cluster: Cluster) -> None:
        address = cluster.scheduler
        client = _connected(cluster)
        if isinstance(client, str):
            # A client that could not connect is closed when it is collected. That must not happen
            # while another one starts: both would wait for one lock.
            gc.collect()
            raise DataError(f'there is no Dask scheduler at {address}: {client}')
        self._client = client
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
                    _alone, function, task, limits, pure=False, retries=2
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
