# Copyright 2026 fluoro_calib_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

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
