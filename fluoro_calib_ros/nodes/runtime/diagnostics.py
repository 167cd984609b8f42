# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Diagnostics of a node on /diagnostics, and logs that cannot be flooded or forged."""

from __future__ import annotations

import math
import os
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.impl import rcutils_logger
from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.node import Node

from ...errors import DataError, printable, shortened

MAX_LINE = 4000  # characters
MAX_TRACE = 20_000  # characters


class StartError(RuntimeError):
    """Reason why a node cannot start, in one sentence."""


# Errors that a user can cause, as opposed to bugs: raised for invalid names, parameters and QoS
# overrides; rclpy's RCLError is a RuntimeError.
USER_ERRORS = (ParameterException, NameValidationException, RuntimeError, DataError)


def one_line(error: BaseException) -> str:
    """Return the message of an exception as one line, or its type if it has no message."""
    return printable(' '.join(str(error).split())[:MAX_LINE]) or type(error).__name__


# rclpy keeps state per logging call site, which shall be the caller of this module.
rcutils_logger._internal_callers.append(os.path.realpath(__file__))


_LEVELS = ('debug', 'info', 'warning', 'error', 'fatal')  # methods of a logger


class PrintableLogger:
    """Logger of a node that keeps names and texts of peers within their line.

    Line ends are escaped, and so is everything that a terminal would interpret.
    """

    def __init__(self, logger: RcutilsLogger) -> None:
        self._logger = logger

    def __getattr__(self, name: str) -> Any:
        method = getattr(self._logger, name)
        if name not in _LEVELS:
            return method
        return lambda text, **options: method(log_line(text), **options)


class Trace(str):
    """Text with a traceback, which keeps its lines."""


def log_line(text: str) -> str:
    """Return a text as a line of the log; further lines of a traceback are marked as such."""
    if isinstance(text, Trace):
        return '\n  | '.join(map(printable, shortened(text, MAX_TRACE).splitlines()))
    return printable(shortened(str(text), MAX_LINE))


Logger: TypeAlias = 'RcutilsLogger | PrintableLogger'


BURST = 20.0  # number of messages that may be logged at once


class RateLimitedLogger:
    """Logs a burst of messages, then one per second with the number of suppressed ones."""

    def __init__(self, logger: Logger) -> None:
        self._logger = logger
        self._allowance = BURST
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
        self._allowance = min(BURST, self._allowance + now - self._last)
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


# Messages that a node refuses: counted by kind, logged, and shown in the diagnostics.

TOO_LARGE = 'too large'
# Parameter that limits the size of a message, by item.
_LIMITS = {'frame': 'max_points', 'image': 'max_image_megapixels'}


class Refused(DataError):
    """Reason why a message is refused; refusals are counted by its kind."""

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message)
        self.kind = kind


class RefusalLog:
    """Counts the refused messages of one input and logs the reasons."""

    def __init__(self, item: str, logger: RateLimitedLogger) -> None:
        self._item = item
        self._logger = logger
        self.counts: Counter[str] = Counter()  #: refused messages by kind
        self.failures = 0  #: messages lost by an unexpected exception, that is, a bug
        self.last_fault = ''  #: last reason; empty before the first
        self._last_failure = ''

    @property
    def limit(self) -> str:
        """Parameter that limits the size of a message."""
        return _LIMITS[self._item]

    @property
    def total(self) -> int:
        """Number of refused messages."""
        return self.counts.total()

    def refuse(self, error: DataError) -> None:
        """Count a refused message and log the reason."""
        self.counts[getattr(error, 'kind', 'invalid')] += 1
        self.last_fault = str(error)
        self._logger.warning(f'{self._item} refused: {error}')

    def note(self, text: str) -> None:
        """Log a fault that does not lead to a refusal."""
        self.last_fault = text
        self._logger.warning(text)

    def fail(self, topic: str, error: Exception) -> None:
        """Count and log a message on a topic that was lost by an unexpected exception."""
        self.failures += 1
        self._last_failure = f'topic {topic}: {type(error).__name__}: {one_line(error)}'
        self.last_fault = self._last_failure
        trace = ''.join(traceback.format_exception(error))
        self._logger.error(
            Trace(f'{self._item} lost by an internal error, topic {topic}\n{trace}')
        )

    def values(self, kinds: Iterable[str]) -> dict[str, object]:
        """Return the counts for the diagnostics."""
        return {
            f'{self._item}s refused': self.total,
            **{f'refused: {kind}': self.counts[kind] for kind in kinds},
            f'{self._item}s lost by internal errors': self.failures,
        }

    def failure(self) -> str:
        """Return a message if messages were lost by internal errors, else ''."""
        count = self.failures
        lost = f'{count} {self._item}s lost by internal errors: {self._last_failure}'
        return lost if count else ''

    def refusal(self, recent: int) -> str:
        """Return a message about the number of recently refused messages, '' if it is 0."""
        refused = f'{recent} {self._item}s refused in the last minute: {self.last_fault}'
        return refused if recent else ''


# Counts over a recent period: a fault that is over must not remain a warning for ever.

RECENT_S = 60.0  # duration of a warning: an operator looks up about that often


class RecentCounts:
    """Growth of counts within the last minute.

    now: returns the time [s], by default of the monotonic clock.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        # Times and counts; the first entry is the newest that is no longer recent.
        self._history: dict[tuple[str, str], deque[tuple[float, int]]] = {}

    def growth(self, subject: str, **counts: int) -> dict[str, int]:
        """Return the growth of the counts of a subject; to be called periodically."""
        now = self._now()
        grown = {}
        for name, count in counts.items():
            history = self._history.setdefault((subject, name), deque([(-math.inf, 0)]))
            history.append((now, count))
            while history[1][0] <= now - RECENT_S:
                history.popleft()
            grown[name] = max(count - history[0][1], 0)
        return grown


# Detection of a stream that has stopped.

MIN_RATE_HZ = 5.0  # minimum rate of a stream; exposures taken one by one are slower
MAX_SILENCE_S = 0.9  # checked every second, so a stop is reported within two


class StallDetector:
    """Detects that a stream has stopped from its count of received frames.

    now: returns the time [s], by default of the monotonic clock.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._count = 0
        self._changed_at = now()
        self._rate_hz = 0.0

    def message(self, count: int) -> str:
        """Return a message if the stream has stopped, else ''; to be called periodically.

        count: number of frames received so far.
        """
        now = self._now()
        elapsed = now - self._changed_at
        if count != self._count:
            self._rate_hz = max(count - self._count, 0) / max(elapsed, 1e-3)
            self._count = count
            self._changed_at = now
            return ''
        if self._rate_hz < MIN_RATE_HZ or elapsed < MAX_SILENCE_S:
            return ''
        return f'no frame for {elapsed:.0f} s; before, there were {self._rate_hz:.0f} a second'


OK = DiagnosticStatus.OK
WARN = DiagnosticStatus.WARN
ERROR = DiagnosticStatus.ERROR


class Health(NamedTuple):
    """Level (OK, WARN or ERROR) and message of a Status."""

    level: bytes
    message: str

    def with_consequence(self, text: str) -> Health:
        """Return a copy with a consequence appended to the message."""
        return self._replace(message=f'{self.message}; {text}')


@dataclass(frozen=True)
class Status:
    """Entry of the diagnostics of a node."""

    name: str  #: fluoroscope or function to which the status refers
    level: bytes  #: OK, WARN or ERROR
    message: str
    values: Mapping[str, object] = field(default_factory=dict)


NO_CLOCK = (
    'use_sim_time is set, but nobody publishes /clock: this node stamps its messages with the '
    'time 0'
)


class DiagnosticsPublisher:
    """Publishes the statuses of a node on /diagnostics, with a warning if its clock is 0."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)

    def publish(self, statuses: Iterable[Status]) -> None:
        """Publish statuses in one message."""
        array = DiagnosticArray()
        now = self._node.get_clock().now()
        array.header.stamp = now.to_msg()
        if not now.nanoseconds:
            statuses = (*statuses, Status('clock', WARN, NO_CLOCK))
        node_name = self._node.get_fully_qualified_name()
        array.status = [
            DiagnosticStatus(
                level=status.level,
                name=f'{node_name}: {status.name}',
                message=status.message,
                hardware_id=status.name,
                values=[KeyValue(key=k, value=str(v)) for k, v in status.values.items()],
            )
            for status in statuses
        ]
        self._publisher.publish(array)

    def close(self) -> None:
        """Destroy the publisher."""
        self._node.destroy_publisher(self._publisher)


class LatencyWindow:
    """Window of the last latencies; one thread writes it and another reads it."""

    def __init__(self) -> None:
        self._latest: deque[int] = deque(maxlen=2000)
        self.add = self._latest.append  #: adds a latency [ns]

    def values(self) -> dict[str, str]:
        """Return median and 99th percentile for the diagnostics, nothing before the first one."""
        latest = list(self._latest)
        if not latest:
            return {}
        p50, p99 = np.percentile(latest, [50, 99]) * 1e-6
        return {'latency p50 [ms]': f'{p50:.3f}', 'latency p99 [ms]': f'{p99:.3f}'}
