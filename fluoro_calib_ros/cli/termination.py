# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""End a command at SIGINT and SIGTERM, also where the exception of a signal is lost."""

from __future__ import annotations

import contextlib
import signal
import sys
from collections.abc import Iterator

AGAIN_S = 1.0  # after which an exception that nothing handles is raised again


@contextlib.contextmanager
def terminated_by_signals() -> Iterator[None]:
    """Raise KeyboardInterrupt at SIGINT, SystemExit at SIGTERM, until the block ends.

    Python drops an exception that a signal handler raises in a destructor or in a callback of the
    garbage collector, and C code may clear it. It is raised again each second, unless it is being
    handled: what cleans up is not interrupted.
    """
    raised: list[BaseException] = []

    def terminate(number: int, _: object) -> None:
        error = KeyboardInterrupt() if number == signal.SIGINT else SystemExit(128 + number)
        raised.append(error)
        signal.setitimer(signal.ITIMER_REAL, AGAIN_S, AGAIN_S)
        raise error

    def repeat(_number: int, _frame: object) -> None:
        if not _is_handled(raised):
            raise raised[-1]

    handlers = {signal.SIGINT: terminate, signal.SIGTERM: terminate, signal.SIGALRM: repeat}
    previous = {number: signal.signal(number, handlers[number]) for number in handlers}
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        for number, handler in previous.items():
            signal.signal(number, handler)


def _is_handled(raised: list[BaseException]) -> bool:
    """Return whether the code that runs handles one of these exceptions, or one raised then."""
    error = sys.exc_info()[1]
    while error is not None:
        if error in raised:
            return True
        error = error.__context__
    return False
