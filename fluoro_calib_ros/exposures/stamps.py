# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Time stamps and numbers of frames: check their agreement, and number images that have none.

Frames with the same number belong to one exposure only if the cameras count in step. Cameras that
were started at different times, or one that has dropped a frame, do not. The stamps reveal this:
frames with the same number are then a frame interval or more apart.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from enum import Enum
from itertools import chain
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..findings import Finding, Kind, Place, Severity

NS_PER_S = 1_000_000_000
# A stamp earlier than the latest one by more than this starts a new stream; else it is late.
RESTART_NS = 1_000_000_000
# Number of consecutive late stamps that start a new stream, such as that of a bag shorter than
# RESTART_NS that is played in a loop. Exposures out of order are fewer.
MAX_LATE = 100
RECENT = 200  # number of exposures that are compared
MIN_EXPOSURES = 5
RECENT_STEPS = 31  # number of steps between stamps that give the frame interval
# Difference of stamps, as a fraction of the frame interval, from which another frame is nearer.
MAX_PART = 0.5


def nanoseconds_from_stamp(stamp: Any) -> int:
    """Return the time [ns] of an object with fields sec and nanosec, such as a Time message."""
    return int(stamp.sec * NS_PER_S + stamp.nanosec)


class Order(Enum):
    """Place of a stamp in its stream: after the latest stamp, or not, or after a restart."""

    IN_ORDER = 'in order'
    LATE = 'late'
    RESTART = 'restart'


def order_of(stamp_ns: int, latest_ns: int) -> Order:
    """Return the place of a stamp after the latest one of its stream [ns]."""
    if stamp_ns > latest_ns:
        return Order.IN_ORDER
    return Order.RESTART if latest_ns - stamp_ns > RESTART_NS else Order.LATE


class StampOrder:
    """Places of the stamps of one stream, of which many consecutive late ones are a restart."""

    def __init__(self) -> None:
        self._latest_ns: int | None = None
        self._late = 0  # consecutive late stamps

    def add(self, stamp_ns: int) -> Order:
        """Add a stamp; return its place."""
        latest_ns = self._latest_ns
        order = Order.IN_ORDER if latest_ns is None else order_of(stamp_ns, latest_ns)
        self._late = self._late + 1 if order is Order.LATE else 0
        if self._late > MAX_LATE:
            order = Order.RESTART
        if order is not Order.LATE:
            self._latest_ns = stamp_ns
            self._late = 0
        return order


class StampedFrame(Protocol):
    """Interface of a frame with number and stamp."""

    @property
    def number(self) -> int:
        """Frame number."""

    @property
    def stamp_ns(self) -> int:
        """Time of the exposure [ns], 0 if unknown."""


class StampAgreement:
    """Comparison of the stamps of the frames of recent exposures.

    fluoroscopes: names; recent: number of exposures, None for all. Frames without a stamp (0) are
    ignored.
    """

    def __init__(self, fluoroscopes: tuple[str, ...], recent: int | None = RECENT) -> None:
        self._fluoroscopes = fluoroscopes
        self._recent: deque[tuple[int, dict[str, int]]] = deque(maxlen=recent)

    def add(self, exposure: Mapping[str, StampedFrame]) -> None:
        """Add an exposure whose frames have the same number."""
        frames = list(exposure.values())
        stamps = {name: frame.stamp_ns for name, frame in exposure.items() if frame.stamp_ns}
        if len(stamps) > 1:
            self._recent.append((frames[0].number, stamps))

    def disagreement(self) -> Finding | None:
        """Return a warning if the frames of an exposure are far apart in time, else None.

        A constant offset between the clocks has the same effect; the advice says so. Another
        warning is that frames are not numbered.
        """
        first, *others = self._fluoroscopes
        return next(filter(None, (self._compare(first, other) for other in others)), None)

    def _compare(self, one: str, other: str) -> Finding | None:
        rows = [
            (number, stamps[one], stamps[other])
            for number, stamps in list(self._recent)
            if one in stamps and other in stamps
        ]
        if len(rows) < MIN_EXPOSURES:
            return None
        number, first, second = np.array(rows, dtype=np.int64).T
        if not np.ptp(number) and np.ptp(first):
            return Finding(
                Kind.FRAMES_UNNUMBERED,
                f'frames of {one} are not numbered: {len(rows)} in a row have the number '
                f'{number[0]}, but different stamps',
                Place((one,), name=''),
                'pair frames by stamp',
                Severity.WARNING,
                numbers={'number': float(number[0]), 'frames': len(rows)},
            )
        interval = _frame_interval(number, first)
        offset = (second - first).astype(float)
        typical = float(np.median(np.abs(offset)))
        if not interval or typical <= MAX_PART * interval:
            return None
        count = typical / interval
        return Finding(
            Kind.STAMPS_APART,
            f'frames of {one} and {other} with the same number are {typical * 1e-6:.1f} ms apart '
            f'({count:.1f} frame intervals): they belong to different exposures, or the clocks '
            'of the cameras differ',
            Place((one, other), name=''),
            'start the cameras together, or pair frames by stamp',
            Severity.WARNING,
            numbers={'apart_ms': typical * 1e-6, 'frames': count},
        )


def _frame_interval(number: NDArray[np.int64], stamp_ns: NDArray[np.int64]) -> float:
    """Return the time between frames of consecutive numbers [ns], 0 if unknown."""
    numbers = np.diff(number)
    times = np.diff(stamp_ns)
    forward = (numbers > 0) & (times > 0)
    if not forward.any():
        return 0.0
    return float(np.median(times[forward] / numbers[forward]))


class StampTolerance:
    """Largest difference between the stamps of an exposure that is paired by stamp.

    From half of the frame interval on, another frame may be nearer: after a lost frame, all later
    ones would be paired with their neighbours. The tolerance is therefore kept below it. The
    interval is the median of the last steps of a stream, the smallest of all streams.
    """

    def __init__(self, largest_ns: int) -> None:
        self.largest_ns = largest_ns  #: tolerance that was asked for [ns]
        self.interval_ns = 0  #: frame interval [ns], 0 if unknown
        self._latest: dict[str, int] = {}
        self._steps: dict[str, deque[int]] = {}
        self._intervals: dict[str, int] = {}

    @property
    def ns(self) -> int:
        """Tolerance [ns]."""
        half_ns = (self.interval_ns - 1) // 2
        return min(self.largest_ns, half_ns) if self.interval_ns else self.largest_ns

    @property
    def step_ns(self) -> int:
        """Median of the last steps of all streams [ns], 0 before the first one."""
        steps = sorted(chain.from_iterable(self._steps.values()))
        return steps[len(steps) // 2] if steps else 0

    def add(self, fluoroscope: str, stamp_ns: int) -> None:
        """Add the stamp of a frame, 0 if unknown."""
        latest_ns = self._latest.get(fluoroscope, 0)
        order = order_of(stamp_ns, latest_ns)
        if not stamp_ns or order is Order.LATE:
            return
        self._latest[fluoroscope] = stamp_ns
        if latest_ns and order is Order.IN_ORDER:
            steps = self._steps.setdefault(fluoroscope, deque(maxlen=RECENT_STEPS))
            steps.append(stamp_ns - latest_ns)
            if len(steps) >= MIN_EXPOSURES:
                self._intervals[fluoroscope] = sorted(steps)[len(steps) // 2]
                self.interval_ns = min(self._intervals.values())

    def finding(self) -> Finding | None:
        """Return a finding if the tolerance that was asked for is too large, else None."""
        if self.ns == self.largest_ns:
            return None
        tolerance_ms, interval_ms = self.largest_ns * 1e-6, self.interval_ns * 1e-6
        return Finding(
            Kind.WIDE_TOLERANCE,
            f'stamps that differ by pair_tolerance, {tolerance_ms:.3g} ms, may belong to '
            f'different exposures, as frames are {interval_ms:.3g} ms apart; frames are paired if '
            'their stamps differ by less than half of that',
            advice='set pair_tolerance to less than half of the frame interval',
            severity=Severity.WARNING,
            numbers={'tolerance_ms': tolerance_ms, 'interval_ms': interval_ms},
        )


RECENT_IMAGES = 512  # number of exposures to which further images may be added
MAX_MISSING = 10  # largest number of images in a row whose numbers are reserved


class ExposureNumbers:
    """Assigns the same number to images of several fluoroscopes that belong to one exposure.

    Images are matched by stamp, within the tolerance [ns], which `StampTolerance` limits.
    Exposures are counted from 1 in the order of time, so a lost image of any fluoroscope does not
    shift the numbers. Where images of a film are missing, their numbers are reserved: other
    fluoroscopes, whose images arrive later, may have them. Images without a stamp (0) are counted
    for each fluoroscope separately.
    """

    def __init__(self, fluoroscopes: Iterable[str], tolerance_ns: int) -> None:
        self._tolerance = StampTolerance(tolerance_ns)
        # Stamp, number, and fluoroscopes whose image has arrived.
        self._recent: deque[tuple[int, int, set[str]]] = deque(maxlen=RECENT_IMAGES)
        self._last = 0
        self._newest_ns = 0  # stamp of the exposure with the last number
        # Expected stamps and numbers of exposures without an image so far.
        self._reserved: deque[tuple[int, int]] = deque(maxlen=RECENT_IMAGES)
        self._without_stamp = dict.fromkeys(fluoroscopes, 0)

    def number(self, fluoroscope: str, stamp_ns: int) -> int:
        """Return the number of an image that has arrived."""
        if not stamp_ns:
            self._without_stamp[fluoroscope] += 1
            return self._without_stamp[fluoroscope]
        self._tolerance.add(fluoroscope, stamp_ns)
        tolerance_ns = self._tolerance.ns
        fitting = (
            exposure
            for exposure in reversed(self._recent)  # the newest of equally near ones, for repeats
            if abs(exposure[0] - stamp_ns) <= tolerance_ns and fluoroscope not in exposure[2]
        )
        nearest = min(fitting, key=lambda exposure: abs(exposure[0] - stamp_ns), default=None)
        if nearest is None:
            nearest = (stamp_ns, self._new_number(stamp_ns), set())
            self._recent.append(nearest)
        nearest[2].add(fluoroscope)
        return nearest[1]

    def _new_number(self, stamp_ns: int) -> int:
        """Return the number of a new exposure, reserving those of the ones before that miss."""
        interval = self._tolerance.step_ns or NS_PER_S
        for reserved in self._reserved:
            if 2 * abs(reserved[0] - stamp_ns) < interval:
                self._reserved.remove(reserved)
                return reserved[1]
        gap = stamp_ns - self._newest_ns
        missing = round(gap / interval) - 1
        if interval >= NS_PER_S or not 0 < missing <= MAX_MISSING:
            missing = 0  # not a film, or its images paused
        for k in range(1, missing + 1):
            self._reserved.append((self._newest_ns + k * gap // (missing + 1), self._last + k))
        self._last += missing + 1
        self._newest_ns = stamp_ns
        return self._last
