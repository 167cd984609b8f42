"""Pairing: bring together the frames that belong to one exposure.

The calibration needs all views of an exposure; for a reconstruction two views of three or more
suffice.

Streams are in order. So a fluoroscope that has delivered a later frame has lost the one before,
and nothing has to wait for it; only for one that is silent is there a wait, and it is bounded.
"""

from collections import OrderedDict, deque
from dataclasses import dataclass, replace

from ..options import option

PAIR_BY = ('frame_number', 'stamp')
MIN_VIEWS = 2  # views of an exposure that can be intersected
# frames of two others for which a silent fluoroscope is waited for: a stall of 32 ms at 1000 Hz
PATIENCE = 32
RESTART_NS = (
    10**9
)  # a stamp so much before the last one is no frame out of order, but a stream begun anew


@dataclass(frozen=True)
class PairingOptions:
    """How frames of several fluoroscopes are paired."""

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
        'frames of two others for which a silent one of three or more fluoroscopes is awaited',
        minimum=1,
        maximum=10000,
    )

    @property
    def tolerance_ns(self) -> int:
        """The tolerance in nanoseconds."""
        return round(1e9 * self.tolerance_s)


class FramePairer:
    """Brings together the frames of the fluoroscopes that belong to one exposure.

    By frame number, or by stamp within tolerance_ns where pair_by is 'stamp'. Of each fluoroscope
    the last `waiting` frames wait for their partners; a frame that drops out alone is counted as
    unpaired. A frame that comes after one of its partners has dropped out is late: counted as
    both, and given up at once.
    """

    def __init__(self, fluoroscopes, pair_by='frame_number', tolerance_ns=2_000_000, waiting=64):
        if pair_by not in ('frame_number', 'stamp'):
            raise ValueError(f"pair_by is 'frame_number' or 'stamp', not {pair_by!r}")
        self.fluoroscopes = tuple(fluoroscopes)
        self.pair_by = pair_by
        self._tolerance = tolerance_ns
        self._limit = waiting
        self._pairs = 0
        self._waiting = {name: OrderedDict() for name in self.fluoroscopes}
        self._dropped = dict.fromkeys(self.fluoroscopes)  # key that dropped out last
        self.unpaired = dict.fromkeys(self.fluoroscopes, 0)
        self.late = dict.fromkeys(self.fluoroscopes, 0)

    def add(self, frame):
        """Take a frame; returns {fluoroscope: Frame} once all of an exposure are there, else None.

        Frames need a fluoroscope, a number and a stamp_ns.
        """
        waiting = self._waiting[frame.fluoroscope]
        key = frame.number if self.pair_by == 'frame_number' else frame.stamp_ns
        if self._is_late(frame.fluoroscope, key):
            self.late[frame.fluoroscope] += 1
            self.unpaired[frame.fluoroscope] += 1
            return None
        if key in waiting:
            self.unpaired[frame.fluoroscope] += (
                1  # the number came again: the older one lost its chance
            )
        waiting[key] = frame
        partners = {name: self._partner(name, key) for name in self.fluoroscopes}
        if all(p is not None for p in partners.values()):
            pair = {name: self._waiting[name].pop(p) for name, p in partners.items()}
            self._pairs += 1
            # Frames that are paired by stamp need not be numbered alike, or at all: the pair gets
            # a number.
            return (
                pair
                if self.pair_by == 'frame_number'
                else {name: replace(frame, number=self._pairs) for name, frame in pair.items()}
            )
        while len(waiting) > self._limit:
            self._dropped[frame.fluoroscope], _ = waiting.popitem(last=False)
            self.unpaired[frame.fluoroscope] += 1
        return None

    def _is_late(self, fluoroscope, key):
        """Whether a frame of that key has a partner that has dropped out already.

        Keys that lie before all that wait, and not after the one that dropped out last: those of a
        fluoroscope that has been started anew are further back.
        """
        for name in self.fluoroscopes:
            dropped = self._dropped[name]
            if name == fluoroscope or dropped is None or key > dropped:
                continue
            near = (
                key >= dropped - self._limit
                if self.pair_by == 'frame_number'
                else (key >= dropped - 10**9)
            )
            if near and self._partner(name, key) is None:
                return True
        return False

    def _partner(self, name, key):
        waiting = self._waiting[name]
        if self.pair_by == 'frame_number':
            return key if key in waiting else None
        nearest = min(waiting, key=lambda stamp: abs(stamp - key), default=None)
        return nearest if nearest is not None and abs(nearest - key) <= self._tolerance else None

    def flush(self):
        """Give up all waiting frames; they count as unpaired."""
        for name, waiting in self._waiting.items():
            self.unpaired[name] += len(waiting)
            waiting.clear()


def exposure_pairer(
    fluoroscopes, pair_by='frame_number', tolerance_ns=2_000_000, waiting=64, patience=PATIENCE
):
    """Pairer of the frames of fluoroscopes (names): add(frame) and flush() give the exposures
    {fluoroscope: frame} that come out by it, unpaired, late {fluoroscope: number of frames},
    incomplete (number of exposures) and silent (names) tell what was missing. Raises ValueError
    for another pair_by.

    Of two fluoroscopes no view can be missing: they are paired as for the calibration, and there
    is no patience.
    """
    if len(fluoroscopes) <= MIN_VIEWS:
        return _CompletePairer(fluoroscopes, pair_by, tolerance_ns, waiting)
    return ExposurePairer(fluoroscopes, pair_by, tolerance_ns, waiting, patience)


def recorded_pairer(fluoroscopes, pair_by='frame_number'):
    """Pairer of a recording, of which everything is there: nothing drops out, and nobody is given
    up.
    """
    return exposure_pairer(fluoroscopes, pair_by, waiting=10**9, patience=10**9)


class _CompletePairer(FramePairer):
    """FramePairer with the interface of an ExposurePairer."""

    incomplete = 0
    silent = frozenset()

    def add(self, frame):
        """Take a frame; returns the exposure that it completes, or none."""
        pair = super().add(frame)
        return () if pair is None else (pair,)

    def flush(self):
        """Give up all waiting frames; returns no exposures."""
        super().flush()
        return ()


class ExposurePairer:
    """Exposures of three or more fluoroscopes, in order of time, each once, with two views or
    more.

    By frame number, or by stamp where pair_by is 'stamp': all that is within tolerance_ns of the
    earliest frame. An exposure comes out once every fluoroscope has a frame in it or has delivered
    a later one. One that has delivered nothing while two others went on by `patience` frames is
    silent: nothing waits for it until it is there again. Of each fluoroscope at most the last
    `waiting` frames wait. A frame alone in its exposure is counted as unpaired, one that comes
    when its exposure is out already, or after a later one of its own stream, as late too. A stream
    whose frames begin anew releases what waits.
    """

    def __init__(
        self,
        fluoroscopes,
        pair_by='frame_number',
        tolerance_ns=2_000_000,
        waiting=64,
        patience=PATIENCE,
    ):
        if pair_by not in ('frame_number', 'stamp'):
            raise ValueError(f"pair_by is 'frame_number' or 'stamp', not {pair_by!r}")
        self.fluoroscopes = tuple(fluoroscopes)
        self.pair_by = pair_by
        self._by_number = pair_by == 'frame_number'
        self._tolerance = 0 if self._by_number else tolerance_ns
        self._limit = waiting
        self._patience = patience
        self._exposures = 0
        self.unpaired = dict.fromkeys(self.fluoroscopes, 0)
        self.late = dict.fromkeys(self.fluoroscopes, 0)
        self.incomplete = 0
        self._begin()

    def _begin(self):
        self._queues = {name: deque() for name in self.fluoroscopes}  # (key, frame), ascending
        self._last = dict.fromkeys(self.fluoroscopes)  # key and stamp that came last
        self._until = dict.fromkeys(
            self.fluoroscopes, float('-inf')
        )  # key up to which exposures went without it
        self._recent = deque(maxlen=self._patience)  # keys of the last exposures
        self.silent = frozenset()

    def add(self, frame):
        """Take a frame; returns the exposures that come out by it, [{fluoroscope: Frame}, ...].

        Frames need a fluoroscope, a number and a stamp_ns.
        """
        name = frame.fluoroscope
        out = []
        key = frame.number if self._by_number else frame.stamp_ns
        last = self._last[name]
        if last is not None and key <= last[0]:
            if not self._is_new_stream(key, frame.stamp_ns, *last):
                self._count_late(name)
                return out
            out = self.flush()
        self._last[name] = key, frame.stamp_ns
        if key <= self._until[name]:
            self._count_late(name)
            # No further behind than can be waited for: so it will be, from now on.
            if name in self.silent and key >= self._recent[0]:
                self.silent -= {name}
            return out
        if name in self.silent:
            self.silent -= {name}
        queue = self._queues[name]
        queue.append((key, frame))
        self._release(out)
        if len(queue) > self._limit:
            queue.popleft()
            self.unpaired[name] += 1
            self._release(out)
        return out

    def _count_late(self, name):
        self.late[name] += 1
        self.unpaired[name] += 1

    def _is_new_stream(self, key, stamp_ns, last, last_ns):
        """Whether a frame that is not after the last one of its stream begins a new one: its
        number falls back while time goes on, or by more than frames can be out of order.
        """
        if not self._by_number:
            return last - key > RESTART_NS
        return key < last and (
            stamp_ns > last_ns or last_ns - stamp_ns > RESTART_NS or last - key > self._limit
        )

    def _release(self, out):
        """Put the exposures into out of which it is certain, or has to do, what belongs to them."""
        queues = self._queues
        while True:
            heads = {name: queue[0][0] for name, queue in queues.items() if queue}
            if len(heads) < MIN_VIEWS:
                return
            until = min(heads.values()) + self._tolerance
            there = [name for name, key in heads.items() if key <= until]
            if len(heads) + len(self.silent) < len(queues) and not self._given_up(heads, there):
                return
            self._take(there, until, out)

    def _given_up(self, heads, there):
        """Whether the fluoroscopes that have nothing waiting have been waited for long enough;
        they are silent then.
        """
        lengths = sorted(len(queue) for queue in self._queues.values())
        full = len(there) >= MIN_VIEWS and any(
            len(self._queues[name]) > self._limit for name in there
        )
        if lengths[-MIN_VIEWS] <= self._patience and not full:
            return False
        self.silent = frozenset(name for name in self.fluoroscopes if name not in heads)
        return True

    def _take(self, there, until, out):
        """Take the first frames of the fluoroscopes that are there out of their queues, and into
        out as an exposure.
        """
        frames = {name: self._queues[name].popleft()[1] for name in there}
        if len(frames) < MIN_VIEWS:
            self.unpaired[there[0]] += 1
            return
        if len(frames) < len(self.fluoroscopes):
            self.incomplete += 1
            for name in self.fluoroscopes:
                if name not in frames:
                    self._until[name] = until
        self._exposures += 1
        self._recent.append(until - self._tolerance)
        # Frames that are paired by stamp need not be numbered alike, or at all: the exposure gets
        # a number.
        out.append(
            frames
            if self._by_number
            else {name: replace(frame, number=self._exposures) for name, frame in frames.items()}
        )

    def flush(self):
        """Wait no longer; returns the exposures that come out, [{fluoroscope: Frame}, ...], and
        begins anew.
        """
        out = []
        while any(self._queues.values()):
            until = min(queue[0][0] for queue in self._queues.values() if queue) + self._tolerance
            self._take(
                [name for name, queue in self._queues.items() if queue and queue[0][0] <= until],
                until,
                out,
            )
        self._begin()
        return out
