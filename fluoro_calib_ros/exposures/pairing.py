# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Pairing: combine the frames of several fluoroscopes that belong to one exposure.

A calibration needs all views of an exposure (CompletePairer), except of a sheet that is placed in
front of one fluoroscope. For a reconstruction, two views of three or more suffice (PartialPairer).

Streams arrive in order. Therefore a fluoroscope that has delivered a later frame has lost the
earlier one, which is no longer waited for. Only a silent fluoroscope makes the others wait, for a
limited time.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from bisect import bisect_left, insort
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any, Protocol

from ..findings import Finding
from ..options import option, validate_options
from .stamps import (
    RESTART_NS,
    Order,
    StampAgreement,
    StampedFrame,
    StampTolerance,
    order_of,
)

PAIR_BY = ('frame_number', 'stamp')
MIN_VIEWS = 2  # minimum number of views for an intersection
PATIENCE = 32  # in frames: a stall of 32 ms at 1000 Hz
REPEATS = 32  # number of newest frames of a stream that another publisher may repeat
UNLIMITED = 10**9  # frames

# Frames by fluoroscope: dataclasses with the fields of PairableFrame.
Exposure = dict[str, Any]


class PairableFrame(StampedFrame, Protocol):
    """Interface of a frame for pairing; the class must be a dataclass, too."""

    @property
    def fluoroscope(self) -> str:
        """Name of the fluoroscope."""


@dataclass(frozen=True)
class PairingOptions:
    """Options for pairing the frames of several fluoroscopes."""

    pair_by: str = option('frame_number', 'how frames are paired', choices=PAIR_BY)
    tolerance_s: float = option(
        0.002,
        'largest difference between the stamps of an exposure',
        minimum=0.0,
        maximum=1.0,
        unit='s',
    )
    waiting: int = option(
        64, 'frames of a fluoroscope that may wait for their partners', minimum=1, maximum=10000
    )
    patience: int = option(
        PATIENCE,
        'with three or more fluoroscopes: frames of two others after which a silent one is given '
        'up',
        minimum=1,
        maximum=10000,
    )

    @property
    def tolerance_ns(self) -> int:
        """Tolerance [ns]."""
        return round(1e9 * self.tolerance_s)

    @property
    def by_number(self) -> bool:
        """Whether frames are paired by number. Raises ValueError for an unknown pair_by."""
        if self.pair_by not in PAIR_BY:
            raise ValueError(f"pair_by must be 'frame_number' or 'stamp', not {self.pair_by!r}")
        return self.pair_by == 'frame_number'


@dataclass(frozen=True)
class RecordedPairing:
    """Options for pairing a recording. Raises ValueError for an invalid value."""

    pair_by: str = option(
        'frame_number', 'what the frames of one exposure have in common', choices=PAIR_BY
    )
    pair_tolerance: float = option(
        PairingOptions.tolerance_s,
        'largest difference between the stamps of an exposure, with --pair-by stamp',
        minimum=0.0,
        maximum=1.0,
        unit='s',
    )

    def __post_init__(self) -> None:
        validate_options(self)

    def unlimited(self) -> PairingOptions:
        """Return options without limits: all frames exist, so none has to be given up."""
        return PairingOptions(
            self.pair_by, self.pair_tolerance, waiting=UNLIMITED, patience=UNLIMITED
        )


def exposure_pairer(fluoroscopes: Iterable[str], options: PairingOptions | None = None) -> Pairer:
    """Return a pairer for a reconstruction with these fluoroscopes.

    Two fluoroscopes are paired as for a calibration, as no view may be missing. Raises ValueError
    for an unknown pair_by.
    """
    names = tuple(fluoroscopes)
    if len(names) <= MIN_VIEWS:
        return CompletePairer(names, options, once=True)
    return PartialPairer(names, options)


def recorded_exposures(
    pairer: Pairer, frames: Iterable[Iterable[PairableFrame]]
) -> Iterator[Exposure]:
    """Pair recorded frames of several fluoroscopes in temporal order; yield the exposures."""
    for frame in sorted(chain.from_iterable(frames), key=lambda f: (f.stamp_ns, f.number)):
        yield from pairer.add(frame)
    yield from pairer.flush()


def disagreement_of_recording(frames: Mapping[str, Iterable[PairableFrame]]) -> Finding | None:
    """Return a warning if recorded frames with the same number are far apart in time.

    frames: by fluoroscope. Returns None if they agree; see StampAgreement.
    """
    if len(frames) < MIN_VIEWS:
        return None
    pairer = CompletePairer(frames, RecordedPairing().unlimited())
    pairer.stamps = StampAgreement(pairer.fluoroscopes, recent=None)
    deque(recorded_exposures(pairer, frames.values()), maxlen=0)
    return pairer.stamps.disagreement()


class Pairer(ABC):
    """Combines frames into exposures; options and counters that all pairers have."""

    def __init__(self, fluoroscopes: Iterable[str], options: PairingOptions | None = None) -> None:
        options = options or PairingOptions()
        self.fluoroscopes = tuple(fluoroscopes)
        #: number of frames that belong to no exposure, by fluoroscope, and how many of them
        #: arrived too late for theirs
        self.unpaired = dict.fromkeys(self.fluoroscopes, 0)
        self.late = dict.fromkeys(self.fluoroscopes, 0)
        self.incomplete = 0  #: number of exposures without a frame of every fluoroscope
        self.silent: frozenset[str] = frozenset()  #: fluoroscopes that are no longer waited for
        #: comparison of stamps of frames that are paired by number; tolerance of the others
        self.stamps = StampAgreement(self.fluoroscopes)
        self.tolerance = StampTolerance(options.tolerance_ns)
        # Latest frame of each stream.
        self._latest: dict[str, PairableFrame] = {}
        self._by_number = options.by_number
        self._exposures = 0
        self.use(options)

    def use(self, options: PairingOptions) -> None:
        """Change the limits from now on. Raises ValueError if pair_by differs."""
        if options.by_number != self._by_number:
            raise ValueError('pair_by cannot change while frames are being paired')
        self.tolerance.largest_ns = options.tolerance_ns
        self._max_waiting = options.waiting

    @abstractmethod
    def add(self, frame: PairableFrame) -> Sequence[Exposure]:
        """Add a frame; return the exposures that are now ready."""

    @abstractmethod
    def flush(self) -> Sequence[Exposure]:
        """Stop waiting; return the exposures that were still waiting for a frame."""

    @property
    def _reach(self) -> int:
        """Largest difference between the keys of an exposure."""
        return 0 if self._by_number else self.tolerance.ns

    def _key(self, frame: PairableFrame) -> int:
        """Return what the frames of an exposure have in common: number or stamp."""
        return frame.number if self._by_number else frame.stamp_ns

    def _order(self, frame: PairableFrame) -> Order:
        """Return the place of a frame in its stream, and note its stamp for the tolerance.

        A number that does not increase restarts the stream if time increases, or if the number
        decreases by more than frames can be out of order.
        """
        if not self._by_number:
            self.tolerance.add(frame.fluoroscope, frame.stamp_ns)
        latest = self._latest.get(frame.fluoroscope)
        if latest is None or self._key(frame) > self._key(latest):
            return Order.IN_ORDER
        order = order_of(frame.stamp_ns, latest.stamp_ns)
        if not self._by_number:
            return order
        is_close = latest.number - frame.number <= self._max_waiting
        return Order.LATE if order is Order.LATE and is_close else Order.RESTART

    def _count_late(self, name: str) -> None:
        self.late[name] += 1
        self.unpaired[name] += 1

    def _counted(self, exposure: Exposure) -> Exposure:
        """Count an exposure and return it.

        Frames that are paired by stamp may be numbered differently, or not at all: their number is
        replaced by that of the exposure.
        """
        self._exposures += 1
        if self._by_number:
            self.stamps.add(exposure)
            return exposure
        return {name: replace(frame, number=self._exposures) for name, frame in exposure.items()}


def never_alone(frame: object) -> bool:
    """Return that a frame is no exposure without its partners."""
    return False


class CompletePairer(Pairer):
    """Pairer of exposures with a frame of every fluoroscope.

    Frames are matched by number, or by stamp within the tolerance. The last `waiting` frames of
    each fluoroscope wait for their partners; a frame that is displaced from this queue counts as
    unpaired. A frame that arrives after one of its partners was displaced counts as late and as
    unpaired. Exposures may become ready in another order than that of their frames. A stream that
    restarts discards the waiting frames from before, so that they do not become partners of later
    ones. Raises ValueError for an unknown pair_by.

    once: whether a frame that is received again, as when two nodes publish the same stream, counts
    as late, instead of making another exposure. alone: whether a frame needs no partner; such a
    frame is an exposure of its own.
    """

    def __init__(
        self,
        fluoroscopes: Iterable[str],
        options: PairingOptions | None = None,
        once: bool = False,
        alone: Callable[[Any], bool] = never_alone,
    ) -> None:
        super().__init__(fluoroscopes, options)
        self._is_alone = alone
        self._waiting: dict[str, OrderedDict[int, Any]] = {
            name: OrderedDict() for name in self.fluoroscopes
        }
        # Keys of these frames in ascending order.
        self._keys: dict[str, list[int]] = {name: [] for name in self.fluoroscopes}
        # Key of the last displaced frame.
        self._displaced: dict[str, int | None] = dict.fromkeys(self.fluoroscopes)
        # Keys and stamps of the newest frames.
        self._newest: dict[str, deque[tuple[int, int]]] = {
            name: deque(maxlen=REPEATS if once else 0) for name in self.fluoroscopes
        }

    def add(self, frame: PairableFrame) -> Sequence[Exposure]:
        """Add a frame; return the exposure that it completes, if any."""
        name = frame.fluoroscope
        if self._is_alone(frame):
            return (self._counted({name: frame}),)
        waiting = self._waiting[name]
        key = self._key(frame)
        order = self._order(frame)
        if order is Order.RESTART:
            self._discard_before(frame)
        if order is not Order.LATE:
            self._latest[name] = frame
        newest = self._newest[name]
        is_repeated = order is Order.LATE and (key, frame.stamp_ns) in newest and frame.stamp_ns
        if is_repeated or self._is_late(name, key):
            self._count_late(name)
            return ()
        newest.append((key, frame.stamp_ns))
        if key in waiting:
            self.unpaired[name] += 1  # the previous frame with the same key, which is replaced
        else:
            insort(self._keys[name], key)
        waiting[key] = frame
        exposure = self._complete(key)
        if exposure is not None:
            return (exposure,)
        while len(waiting) > self._max_waiting:
            self._displaced[name] = next(iter(waiting))
            self._take(name, next(iter(waiting)))
            self.unpaired[name] += 1
        return ()

    def _take(self, name: str, key: int) -> Any:
        """Remove and return a waiting frame."""
        keys = self._keys[name]
        del keys[bisect_left(keys, key)]
        return self._waiting[name].pop(key)

    def _complete(self, key: int) -> Exposure | None:
        """Remove and return the exposure with this key if all its frames are waiting."""
        partners: dict[str, int] = {}
        for name in self.fluoroscopes:
            partner = self._partner(name, key)
            if partner is None:
                return None
            partners[name] = partner
        return self._counted({name: self._take(name, k) for name, k in partners.items()})

    def _is_late(self, fluoroscope: str, key: int) -> bool:
        """Return whether a partner of the frame with this key was already displaced.

        This holds for a key without a waiting partner, not after the last displaced one of another
        fluoroscope, within a limit. The keys of a restarted fluoroscope lie beyond the limit.
        """
        for name in self.fluoroscopes:
            displaced = self._displaced[name]
            if name == fluoroscope or displaced is None or key > displaced:
                continue
            reach = self._max_waiting if self._by_number else RESTART_NS
            if key >= displaced - reach and self._partner(name, key) is None:
                return True
        return False

    def _partner(self, name: str, key: int) -> int | None:
        """Return the key of the waiting frame of a fluoroscope that matches a key, or None."""
        keys = self._keys[name]
        index = bisect_left(keys, key)
        close = [k for k in keys[max(index - 1, 0) : index + 1] if abs(k - key) <= self._reach]
        return min(close, key=lambda other: abs(other - key), default=None)

    def _discard_before(self, frame: PairableFrame) -> None:
        """Discard the frames from before a restart; the frame is the first one after it.

        These are all frames of its stream, and those of others whose stamps are far from its own,
        or not known. They count as unpaired.
        """
        for name, waiting in self._waiting.items():
            for key, other in list(waiting.items()):
                is_close = frame.stamp_ns and abs(other.stamp_ns - frame.stamp_ns) <= RESTART_NS
                if name == frame.fluoroscope or not is_close:
                    self._take(name, key)
                    self.unpaired[name] += 1
        self._displaced = dict.fromkeys(self.fluoroscopes)

    def flush(self) -> Sequence[Exposure]:
        """Discard all waiting frames, which count as unpaired; return no exposures."""
        for name, waiting in self._waiting.items():
            self.unpaired[name] += len(waiting)
            waiting.clear()
            self._keys[name].clear()
        return ()


class PartialPairer(Pairer):
    """Pairer of exposures with frames of at least two of three or more fluoroscopes.

    Each exposure is returned once, in the order of time. Frames are matched by number, or by
    stamp: all within the tolerance of the earliest frame. An exposure is ready once every
    fluoroscope has a frame in it or has delivered a later one. A fluoroscope that has delivered
    nothing while two others advanced by `patience` frames is silent: it is not waited for until it
    delivers again. At most `waiting` frames of each fluoroscope wait. A frame alone in its
    exposure counts as unpaired. One that arrives after its exposure, or after a later one of its
    own stream, also counts as late. A stream that restarts releases all waiting frames. Raises
    ValueError for an unknown pair_by.
    """

    def __init__(self, fluoroscopes: Iterable[str], options: PairingOptions | None = None) -> None:
        self._recent: deque[int] = deque()  # keys of the last exposures
        super().__init__(fluoroscopes, options)
        self._start()

    def _start(self) -> None:
        """Reset the streams, but not the counters."""
        # Keys in ascending order, with frames.
        self._queues: dict[str, deque[tuple[int, Any]]] = {
            name: deque() for name in self.fluoroscopes
        }
        self._latest.clear()
        # Largest key of the exposures that were released without the fluoroscope.
        self._passed: dict[str, float] = dict.fromkeys(self.fluoroscopes, float('-inf'))
        self._recent.clear()
        self.silent = frozenset()

    def use(self, options: PairingOptions) -> None:
        """Change the limits from now on. Raises ValueError if pair_by differs."""
        super().use(options)
        self._patience = options.patience
        self._recent = deque(self._recent.copy(), maxlen=self._patience)

    def add(self, frame: PairableFrame) -> list[Exposure]:
        """Add a frame; return the exposures that are now ready."""
        name = frame.fluoroscope
        ready: list[Exposure] = []
        key = self._key(frame)
        order = self._order(frame)
        if order is Order.LATE:
            self._count_late(name)
            return ready
        if order is Order.RESTART:
            ready = self.flush()
        self._latest[name] = frame
        if key <= self._passed[name]:
            self._count_late(name)
            # Its lag is within the patience, so it is waited for from now on.
            if name in self.silent and key >= self._recent[0]:
                self.silent -= {name}
            return ready
        self.silent -= {name}
        queue = self._queues[name]
        queue.append((key, frame))
        ready += self._release()
        while len(queue) > self._max_waiting:
            queue.popleft()
            self.unpaired[name] += 1
            ready += self._release()
        return ready

    def _release(self) -> list[Exposure]:
        """Remove and return the exposures that no longer have to wait."""
        ready: list[Exposure] = []
        queues = self._queues
        while True:
            heads = {name: queue[0][0] for name, queue in queues.items() if queue}
            if len(heads) < MIN_VIEWS:
                return ready
            end = min(heads.values()) + self._reach
            names = [name for name, key in heads.items() if key <= end]
            missing_count = len(queues) - len(heads) - len(self.silent)
            if missing_count > 0 and not self._gives_up(heads, names):
                return ready
            ready += self._pop_exposure(names, end)

    def _gives_up(self, heads: dict[str, int], names: list[str]) -> bool:
        """Return whether the fluoroscopes without a waiting frame were waited for long enough.

        If so, they become silent. heads: key of the first waiting frame by fluoroscope; names:
        fluoroscopes of the next exposure.
        """
        lengths = sorted(len(queue) for queue in self._queues.values())
        is_full = any(len(self._queues[name]) > self._max_waiting for name in names)
        must_release = is_full and len(names) >= MIN_VIEWS
        if lengths[-MIN_VIEWS] <= self._patience and not must_release:
            return False
        self.silent = frozenset(name for name in self.fluoroscopes if name not in heads)
        return True

    def _pop_exposure(self, names: list[str], end: int) -> list[Exposure]:
        """Remove the first frames of these fluoroscopes; return their exposure, or none.

        end: largest key that belongs to the exposure.
        """
        exposure = {name: self._queues[name].popleft()[1] for name in names}
        if len(exposure) < MIN_VIEWS:
            self.unpaired[names[0]] += 1
            return []
        if len(exposure) < len(self.fluoroscopes):
            self.incomplete += 1
            for name in self.fluoroscopes:
                if name not in exposure:
                    self._passed[name] = end
        self._recent.append(end - self._reach)
        return [self._counted(exposure)]

    def flush(self) -> list[Exposure]:
        """Stop waiting and start anew; return the exposures that were waiting."""
        ready: list[Exposure] = []
        while any(self._queues.values()):
            first_key = min(queue[0][0] for queue in self._queues.values() if queue)
            end = first_key + self._reach
            names = [name for name, queue in self._queues.items() if queue and queue[0][0] <= end]
            ready += self._pop_exposure(names, end)
        self._start()
        return ready
