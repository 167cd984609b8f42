# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Logging that cannot flood, and whose lines cannot be forged."""

from __future__ import annotations

import os
import time
from typing import Any, TypeAlias

from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.impl import rcutils_logger
from rclpy.impl.rcutils_logger import RcutilsLogger

from ...errors import DataError, printable, shortened

# Errors that a user can cause, as opposed to bugs.

MAX_LENGTH = 1000  # of an error message in one line


class StartError(RuntimeError):
    """Reason why a node cannot start, in one sentence."""


# Raised for invalid names, parameters and QoS overrides; rclpy's RCLError is a RuntimeError.
USER_ERRORS = (ParameterException, NameValidationException, RuntimeError, DataError)


def one_line(error: BaseException) -> str:
    """Return the message of an exception in one line, or its type where it has none."""
    return printable(' '.join(str(error).split())[:MAX_LENGTH]) or type(error).__name__


MAX_LINE = 4000  # characters
MAX_TRACE = 20_000

# rclpy keeps state for each place that logs: that is the caller of this module.
rcutils_logger._internal_callers.append(os.path.realpath(__file__))


class PrintableLogger:
    """Logger of a node: what names and texts of others contain stays in its line.

    A line end is written as an escape, and so is everything that a terminal would obey.
    """

    def __init__(self, logger: RcutilsLogger) -> None:
        self._logger = logger

    def __getattr__(self, name: str) -> Any:
        return getattr(self._logger, name)

    def debug(self, text: str, **options: Any) -> None:
        """Log for debugging."""
        self._logger.debug(log_line(text), **options)

    def info(self, text: str, **options: Any) -> None:
        """Log what happened."""
        self._logger.info(log_line(text), **options)

    def warning(self, text: str, **options: Any) -> None:
        """Log a warning."""
        self._logger.warning(log_line(text), **options)

    def error(self, text: str, **options: Any) -> None:
        """Log an error."""
        self._logger.error(log_line(text), **options)

    def fatal(self, text: str, **options: Any) -> None:
        """Log why the node ends."""
        self._logger.fatal(log_line(text), **options)


class Trace(str):
    """A text with a traceback, which keeps its lines."""


def log_line(text: str) -> str:
    """Return a text as a line of the log; the further lines of a traceback are marked as such."""
    if isinstance(text, Trace):
        return '\n  | '.join(map(printable, shortened(text, MAX_TRACE).splitlines()))
    return printable(shortened(str(text), MAX_LINE))


Logger: TypeAlias = 'RcutilsLogger | PrintableLogger'


class RateLimitedLogger:
    """Logs a burst of messages, then one a second; the next one says how many were suppressed."""

    def __init__(self, logger: Logger, burst: int = 20) -> None:
        self._logger = logger
        self._burst = burst
        self._allowance = float(burst)
        self._last = time.monotonic()
        self._suppressed = 0

    def warning(self, text: str) -> None:
        """Log a warning, unless there have been too many messages."""
        if self._is_allowed():
            self._logger.warning(text + self._suffix())

    def error(self, text: str) -> None:
        """Log an error, unless there have been too many messages."""
        if self._is_allowed():
            self._logger.error(type(text)(text + self._suffix()))

    def _is_allowed(self) -> bool:
        now = time.monotonic()
        self._allowance = min(self._burst, self._allowance + now - self._last)
        self._last = now
        if self._allowance < 1:
            self._suppressed += 1
            return False
        self._allowance -= 1
        return True

    def _suffix(self) -> str:
        count = self._suppressed
        self._suppressed = 0
        return f' ({count} similar messages were suppressed)' if count else ''
