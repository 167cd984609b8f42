# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Messages that a node refuses: counted by kind, logged, and shown in the diagnostics."""

from __future__ import annotations

import traceback
from collections import Counter
from collections.abc import Iterable

from ...errors import DataError
from .diagnostics import ERROR, WARN
from .errors import one_line
from .logging import RateLimitedLogger, Trace

# Names in a message may have any length, and error messages go into log and diagnostics.
MAX_LENGTH = 500
TOO_LARGE = 'too large'


class Refused(DataError):
    """Reason why a message is refused, and its kind, by which refusals are counted."""

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message if len(message) <= MAX_LENGTH else f'{message[:MAX_LENGTH]}...')
        self.kind = kind


class RefusalLog:
    """Counts the refused messages of one input and logs the reasons.

    Attributes
    ----------
    counts : Counter
        Refused messages by kind.
    failures : int
        Messages lost by an unexpected exception, that is, by a bug.
    last_fault : str
        The last reason; empty before the first.
    """

    def __init__(self, item: str, logger: RateLimitedLogger) -> None:
        self._item = item
        self._logger = logger
        self.counts: Counter[str] = Counter()
        self.failures = 0
        self.last_fault = ''
        self._last_failure = ''

    @property
    def total(self) -> int:
        """Number of refused messages."""
        return self.counts.total()

    def refuse(self, error: DataError) -> None:
        """Count a refused message and log the reason."""
        self.counts[getattr(error, 'kind', 'invalid')] += 1
        self.last_fault = str(error)
        self._logger.warning(f'{self._item} refused: {error}')

    def refuse_undecodable(self, topic: str) -> None:
        """Count a message that cannot be decoded, on the topic <fluoroscope>/<...>."""
        fluoroscope = topic.partition('/')[0]
        self.refuse(
            Refused(
                'undecodable',
                f'fluoroscope {fluoroscope}: a message on {topic} cannot be decoded',
            )
        )

    def refuse_too_large(self, topic: str, size: int) -> None:
        """Count a message of so many bytes, more than are read, on <fluoroscope>/<...>."""
        fluoroscope = topic.partition('/')[0]
        self.refuse(
            Refused(
                TOO_LARGE,
                f'fluoroscope {fluoroscope}: a message on {topic} has {size} bytes, more than '
                'the parameter max_points allows',
            )
        )

    def note(self, text: str) -> None:
        """Log a fault that does not lead to a refusal."""
        self.last_fault = text
        self._logger.warning(text)

    def fail(self, topic: str, error: Exception) -> None:
        """Count a message on a topic that was lost by an unexpected exception, and log it."""
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

    def failure_status(self) -> tuple[bytes, str] | None:
        """Return level and message where messages were lost by internal errors, else None."""
        if not self.failures:
            return None
        return (
            ERROR,
            f'{self.failures} {self._item}s lost by internal errors: {self._last_failure}',
        )

    def refusal_status(self) -> tuple[bytes, str] | None:
        """Return level and message where messages were refused, else None."""
        if not self.total:
            return None
        return WARN, f'{self.total} {self._item}s refused: {self.last_fault}'
