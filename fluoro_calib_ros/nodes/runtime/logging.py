"""Logging that cannot flood."""

from __future__ import annotations

import time

from rclpy.impl.rcutils_logger import RcutilsLogger


class RateLimitedLogger:
    """Logs a burst of messages, then one a second; the next one says how many were suppressed."""

    def __init__(self, logger: RcutilsLogger, burst: int = 20) -> None:
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
            self._logger.error(text + self._suffix())

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
