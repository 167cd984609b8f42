# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Processes that end with the one that has started them, and only with it."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any

from ..limits import ReadLimits, read_limits, use_read_limits

PARENT_POLL_S = 0.5  # interval at which a worker looks whether its caller is alive [s]


@contextmanager
def interrupts_blocked() -> Iterator[None]:
    """Keep interrupts from the keyboard from the processes that are started meanwhile.

    They inherit the mask of the calling thread: an interrupt only reaches the caller, which ends
    them.
    """
    resource_tracker.ensure_running()  # unblocks interrupts when it is started
    masked = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, masked)


def start_child(
    context: SpawnContext, function: Callable[..., None], connection: Connection, *arguments: Any
) -> SpawnProcess:
    """Start a function in a process that ends with this one.

    It watches this process before it reads any other module of the package, which takes seconds
    on a busy machine.
    """
    arguments = (_ParentWatch(), read_limits(), function, connection, *arguments)
    process = context.Process(target=_begin, daemon=True, args=arguments)
    with interrupts_blocked():
        process.start()
    return process


class _ParentWatch:
    """Argument of a process that begins to watch the parent where it arrives.

    Arguments arrive in their order: this one before those that make the process import modules.
    """

    def __reduce__(self) -> tuple[Callable[[int], None], tuple[int]]:
        return watch_parent, (os.getpid(),)


def _begin(
    _: None,
    limits: ReadLimits,
    function: Callable[..., None],
    connection: Connection,
    *rest: Any,
) -> None:
    use_read_limits(limits)
    function(connection, *rest)


def watch_parent(parent: int) -> None:
    """End this process with its parent, from a thread of its own."""
    threading.Thread(target=end_with_parent, args=(parent,), daemon=True).start()


def end_with_parent(parent: int) -> None:
    """End this process once its parent has died, which cannot terminate it any more."""
    while os.getppid() == parent:
        time.sleep(PARENT_POLL_S)
    os._exit(1)
