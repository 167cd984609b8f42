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

"""Playing at a speed that may change."""

from __future__ import annotations

import threading
import time

LONGEST_WAIT_S = 0.2  # after which a change of the speed is noticed


class Pace:
    """Moments at which positions of a recording are due.

    Parameters
    ----------
    rate : float
        Speed relative to the recording.
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self.start()

    def start(self) -> None:
        """Be at position 0 now."""
        # Replaced as a whole: another thread may change it.
        self._anchor = (time.monotonic(), 0.0, self._rate)

    def change(self, rate: float) -> None:
        """Go on from the present position at another speed."""
        now = time.monotonic()
        then, position, old_rate = self._anchor
        self._rate = rate
        self._anchor = (now, position + (now - then) * old_rate, rate)

    def wait(self, position_s: float, stop: threading.Event) -> bool:
        """Wait until a position [s] is due; returns whether `stop` has ended the wait."""
        while True:
            then, position, rate = self._anchor
            left = then + (position_s - position) / rate - time.monotonic()
            if left <= 0:
                return stop.is_set()
            if stop.wait(min(left, LONGEST_WAIT_S)):
                return True
