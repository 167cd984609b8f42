# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Frame numbers of images, which have a stamp but no number."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

RECENT = 512  # exposures whose images may still come


class ExposureNumbers:
    """Gives images of several fluoroscopes the same number where they are of one exposure.

    Images belong together by stamp, within the tolerance [ns]. Exposures are counted from 1 in the
    order of their first image, so an image that is lost, of any fluoroscope, shifts no number.
    Images without a stamp (0) are counted by fluoroscope.
    """

    def __init__(self, fluoroscopes: Iterable[str], tolerance_ns: int) -> None:
        self._tolerance = tolerance_ns
        # Stamp, number, and the fluoroscopes that have delivered their image.
        self._recent: deque[tuple[int, int, set[str]]] = deque(maxlen=RECENT)
        self._last = 0
        self._without_stamp = dict.fromkeys(fluoroscopes, 0)

    def number(self, fluoroscope: str, stamp_ns: int) -> int:
        """Return the number of an image that has arrived."""
        if not stamp_ns:
            self._without_stamp[fluoroscope] += 1
            return self._without_stamp[fluoroscope]
        nearest: tuple[int, int, set[str]] | None = None
        for exposure in self._recent:
            apart = abs(exposure[0] - stamp_ns)
            if apart > self._tolerance or fluoroscope in exposure[2]:
                continue
            if nearest is None or apart <= abs(nearest[0] - stamp_ns):
                nearest = exposure  # the newest one, where a recording is repeated
        if nearest is None:
            self._last += 1
            nearest = (stamp_ns, self._last, set())
            self._recent.append(nearest)
        nearest[2].add(fluoroscope)
        return nearest[1]
