# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Execution of the tasks of a job in processes of this machine or on a Dask cluster."""

from __future__ import annotations

import gc
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from ipaddress import ip_address
from typing import Any, TypeVar
from urllib.parse import urlsplit

from ..errors import DataError
from ..io.access import read_bytes
from ..limits import ReadLimits, read_limits, use_read_limits
from ..processes import ProcessEnded, WorkerProcess, one_core

Task = TypeVar('Task')
Result = TypeVar('Result')

QUEUED = 3  # maximum number of queued tasks per worker
CONNECT_S = 10  # time limit for reaching a scheduler and its first worker


def open_workers(
    count: int = 0, scheduler: Cluster | str | None = None, tasks: int = 0
) -> Workers:
    """Return workers as a context that ends them: local processes or those of a Dask cluster.

    count: number of processes, 0 for one per core. tasks: number of tasks, 0 if unknown; for a
    single task, no process is started. Raises DataError if the scheduler cannot be reached or is
    not trusted, or if the package `distributed` is missing.
    """
    if scheduler is not None:
        return DaskWorkers(Cluster(scheduler) if isinstance(scheduler, str) else scheduler)
    return LocalWorkers(min(count or os.cpu_count() or 1, tasks or 2**31))


class LocalWorkers:
    """Processes of this machine, each called from a thread; a single one is the caller's own."""

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
        """Yield the results of tasks in their order, with only a few in memory.

        Raises DataError if a worker died.
        """
        threads = self._threads
        if threads is None:
            for task in tasks:
                yield _alone(function, task, read_limits())
            return
        try:
            yield from in_order(
                lambda task: threads.submit(self._call, function, task),
                tasks,
                QUEUED * self._count,
            )
        except ProcessEnded:
            raise DataError(
                'a worker process was terminated, perhaps for lack of memory; start again with '
                'fewer processes (--workers)'
            ) from None

    def _call(self, function: Callable[[Task], Result], task: Task) -> Result:
        """Return the result of a task, computed in the process of this thread."""
        process: WorkerProcess | None = getattr(self._of_thread, 'process', None)
        if process is None:
            process = self._of_thread.process = WorkerProcess(_caller, 'a worker process')
            self._processes.append(process)
        return process(function, task)


def _caller() -> Callable[[Callable[[Task], Result], Task], Result]:
    """Return the function that a worker process applies to a function and a task."""
    return _applied


def _applied(function: Callable[[Task], Result], task: Task) -> Result:
    return function(task)


@dataclass(frozen=True)
class Cluster:
    """Address and security of a Dask cluster.

    Functions, tasks and results are exchanged as pickles: scheduler and workers can run code here,
    and whoever reaches them can run code there.
    """

    #: address: tls://host:port, or tcp://host:port on this machine or in a trusted network
    scheduler: str
    #: PEM files: certificate of the authority that signed the certificates of the cluster, and
    #: certificate and key of this process; '' for none
    tls_ca: str = ''
    tls_cert: str = ''
    tls_key: str = ''
    #: whether everyone with access to the network of a tcp:// scheduler is trusted
    trusted_network: bool = False

    def security(self) -> Any:
        """Return the security settings of the client, None for plain TCP. Raises DataError."""
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
                f'{self.scheduler}: anyone who reaches this scheduler can run code here; start '
                'it with TLS (tls://HOST:PORT, --tls-ca, --tls-cert, --tls-key), or trust all of '
                'its network with --trusted-network'
            )
        return None


def _is_of_this_machine(address: str) -> bool:
    """Return whether an address is localhost or a numeric loopback; names may be of others."""
    host = urlsplit(address if '//' in address else f'//{address}').hostname or ''
    try:
        return host == 'localhost' or ip_address(host).is_loopback
    except ValueError:
        return False


def _connected(cluster: Cluster) -> Any | str:
    """Return a client of a scheduler, or the reason why there is none."""
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
    """Workers of a Dask cluster. If a worker dies, its task runs again on another."""

    def __init__(self, cluster: Cluster) -> None:
        address = cluster.scheduler
        client = _connected(cluster)
        if isinstance(client, str):
            # A client that failed to connect is closed when it is collected. This must not happen
            # while another one starts, because both would wait for one lock.
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
        """Yield the results of tasks in their order. Raises DataError if the cluster is lost."""
        from distributed import CancelledError, KilledWorker

        limits = read_limits()
        threads = max(sum(self._client.nthreads().values()), 1)
        try:
            yield from in_order(
                lambda task: self._client.submit(
                    _alone, function, task, limits, pure=False, retries=2
                ),
                tasks,
                QUEUED * threads,
            )
        except (KilledWorker, CancelledError, OSError) as error:
            raise DataError(f'the Dask cluster has lost a task: {error}') from None


Workers = LocalWorkers | DaskWorkers


def _alone(function: Callable[[Task], Result], task: Task, limits: ReadLimits) -> Result:
    """Run a task on one core with the caller's limits, as other tasks run in parallel."""
    use_read_limits(limits)
    with one_core():
        return function(task)


def in_order(
    submit: Callable[[Task], Future[Result]], tasks: Iterable[Task], queued: int
) -> Iterator[Result]:
    """Yield the results of submitted tasks in their order, at most `queued` at a time."""
    waiting: deque[Future[Result]] = deque()
    for task in tasks:
        waiting.append(submit(task))
        if len(waiting) >= queued:
            yield waiting.popleft().result()
    while waiting:
        yield waiting.popleft().result()
