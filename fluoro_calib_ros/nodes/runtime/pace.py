# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Playing at a speed that may change."""

from __future__ import annotations

import threading
import time

LONGEST_WAIT_S = 0.2  # after which a change of the speed, or a pause, is noticed
PAUSED_WAIT_S = 0.02  # after which the end of a pause, or a step, is noticed


class Pace:
    """Moments at which positions of a recording are due.

    rate: speed relative to the recording. paused: whether to begin with a pause.
    """

    def __init__(self, rate: float, paused: bool = False) -> None:
        self._rate = rate
        self._steps = threading.Semaphore(0)
        self._paused = threading.Event()
        if paused:
            self._paused.set()
        self.start()

    def start(self) -> None:
        """Be at position 0 now."""
        # Replaced as a whole: another thread may change it.
        self._anchor = (time.monotonic(), 0.0, 0.0 if self.paused else self._rate)

    @property
    def paused(self) -> bool:
        """Whether there is a pause."""
        return self._paused.is_set()

    @property
    def position_s(self) -> float:
        """The present position [s]."""
        then, position, rate = self._anchor
        return position + (time.monotonic() - then) * rate

    def pause(self) -> None:
        """Stay where it is."""
        self._anchor = (time.monotonic(), self.position_s, 0.0)
        self._paused.set()

    def resume(self) -> None:
        """Go on from there."""
        self._anchor = (time.monotonic(), self.position_s, self._rate)
        self._paused.clear()

    def step(self) -> None:
        """Let one wait end during a pause."""
        self._steps.release()

    def change(self, rate: float) -> None:
        """Go on from the present position at another speed."""
        self._rate = rate
        self._anchor = (time.monotonic(), self.position_s, 0.0 if self.paused else rate)

    def wait(self, position_s: float, stop: threading.Event) -> bool:
        """Wait until a position [s] is due; returns whether `stop` has ended the wait."""
        while True:
            if self.paused:
                if self._steps.acquire(blocking=False):
                    self._anchor = (time.monotonic(), position_s, 0.0)
                    return stop.is_set()
                if stop.wait(PAUSED_WAIT_S):
                    return True
                continue
            then, position, rate = self._anchor
            if rate == 0:  # resumed between the two lines above
                continue
            left = then + (position_s - position) / rate - time.monotonic()
            if left <= 0:
                return stop.is_set()
            if stop.wait(min(left, LONGEST_WAIT_S)):
                return True
