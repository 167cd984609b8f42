# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Detection of a stream that has stopped."""

from __future__ import annotations

import time
from collections.abc import Callable

MIN_RATE_HZ = 5.0  # of a stream; exposures that are taken one by one are slower
MAX_SILENCE_S = 0.9  # diagnostics ask every second, so a stop is told within two


class StallDetector:
    """Tells from the count of received frames that a stream has stopped.

    now: returns the time [s], by default of the monotonic clock.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._count = 0
        self._changed_at = now()
        self._rate_hz = 0.0

    def message(self, count: int) -> str:
        """Return a message where the stream has stopped, else ''; to be called periodically.

        count: frames received up to now.
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
