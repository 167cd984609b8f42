"""Collecting exposures from streams of frames: pairing, and waiting for the phantom to stand still."""

from collections import OrderedDict, deque
from dataclasses import dataclass, replace

import numpy as np

from ..photogrammetry.observations import DataError
from .coverage import Coverage

COMMON_TARGETS = 8   # fewer targets in common, and two frames cannot be compared


def displacement(a, b):
    """Median displacement [px] of the targets that two frames of a fluoroscope have in common; infinite where
    they have too few in common."""
    _, in_a, in_b = np.intersect1d(a.target_id, b.target_id, assume_unique=True, return_indices=True)
    if len(in_a) < COMMON_TARGETS:
        return np.inf
    return float(np.median(np.linalg.norm(a.uv[in_a] - b.uv[in_b], axis=1)))


class FramePairer:
    """Brings together the frames of the fluoroscopes that belong to one exposure.

    By frame number, or by stamp within tolerance_ns where pair_by is 'stamp'. Of each fluoroscope the last
    `waiting` frames wait for their partners; a frame that drops out alone is counted as unpaired. A frame that comes
    after one of its partners has dropped out is late: counted as both, and given up at once.
    """

    def __init__(self, fluoroscopes, pair_by='frame_number', tolerance_ns=2_000_000, waiting=64):
        if pair_by not in ('frame_number', 'stamp'):
            raise ValueError(f"pair_by is 'frame_number' or 'stamp', not {pair_by!r}")
        self.fluoroscopes, self.pair_by = tuple(fluoroscopes), pair_by
        self._tolerance, self._limit, self._pairs = tolerance_ns, waiting, 0
        self._waiting = {name: OrderedDict() for name in self.fluoroscopes}
        self._dropped = dict.fromkeys(self.fluoroscopes)   # key that dropped out last
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
            self.unpaired[frame.fluoroscope] += 1   # the number came again: the older one lost its chance
        waiting[key] = frame
        partners = {name: self._partner(name, key) for name in self.fluoroscopes}
        if all(p is not None for p in partners.values()):
            pair = {name: self._waiting[name].pop(p) for name, p in partners.items()}
            self._pairs += 1
            # Frames that are paired by stamp need not be numbered alike, or at all: the pair gets a number.
            return pair if self.pair_by == 'frame_number' else {
                name: replace(frame, number=self._pairs) for name, frame in pair.items()}
        while len(waiting) > self._limit:
            self._dropped[frame.fluoroscope], _ = waiting.popitem(last=False)
            self.unpaired[frame.fluoroscope] += 1
        return None

    def _is_late(self, fluoroscope, key):
        """Whether a frame of that key has a partner that has dropped out already.

        Keys that lie before all that wait, and not after the one that dropped out last: those of a fluoroscope that
        has been started anew are further back.
        """
        for name in self.fluoroscopes:
            dropped = self._dropped[name]
            if name == fluoroscope or dropped is None or key > dropped:
                continue
            near = key >= dropped - self._limit if self.pair_by == 'frame_number' else (
                key >= dropped - 10 ** 9)
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


@dataclass(frozen=True)
class StillOptions:
    """When the phantom counts as standing still in a new pose.

    still_time_s: no frame of that time before may show it displaced by more than still_px, and those there are have
    to go back half of it; new_px: median displacement from every collected exposure. Frames further apart than
    still_time_s are single shots, each of which counts; but not after a gap in a stream, up to ten times as long.
    """

    still_time_s: float = 0.1
    still_px: float = 1.0
    new_px: float = 10.0


class ExposureCollector:
    """Exposures collected from paired frames.

    exposures: list of {fluoroscope: Frame}; offer() takes a pair where the phantom stands still in a new pose,
    take() takes it as it is. coverage: by fluoroscope, grows with the exposures.
    """

    def __init__(self, fluoroscopes, still=StillOptions()):
        self.fluoroscopes, self.still = tuple(fluoroscopes), still
        self.exposures, self.coverage = [], {}
        self._recent, self._streaming = deque(maxlen=1000), False

    def offer(self, pair):
        """Take the pair if the phantom stands still in a new pose; returns '' if taken, else why not."""
        first = self.fluoroscopes[0]
        now, still_ns = pair[first].stamp_ns, self.still.still_time_s * 1e9
        window = [p for p in self._recent if 0 <= now - p[first].stamp_ns <= still_ns]
        moved = max((displacement(pair[n], p[n]) for p in window for n in self.fluoroscopes), default=0.0)
        span = max((now - p[first].stamp_ns for p in window), default=0)
        self._notice_stream(now, bool(window), still_ns)
        self._recent.append(pair)
        if moved > self.still.still_px:
            return 'the phantom moves'
        if self._streaming and span < still_ns / 2:
            return 'too few frames tell whether the phantom stands still'
        for known in self.exposures:
            if max(displacement(pair[n], known[n]) for n in self.fluoroscopes) < self.still.new_px:
                return 'the phantom stands in a pose that is collected already'
        return self.take(pair)

    def _notice_stream(self, now, follows, still_ns):
        """Note whether frames come as a stream: since one has followed another, until a long gap."""
        before = self._recent[-1][self.fluoroscopes[0]].stamp_ns if self._recent else None
        if follows:
            self._streaming = True
        elif before is None or not 0 <= now - before <= 10 * still_ns:
            self._streaming = False

    def take(self, pair):
        """Take the pair as an exposure; returns '' if taken, else why not."""
        numbers = {pair[n].number for n in self.fluoroscopes}
        for known in self.exposures:
            if any(known[n].number == pair[n].number for n in self.fluoroscopes):
                return f'frame {min(numbers)} is collected already'
        self.exposures.append(pair)
        for name in self.fluoroscopes:
            self.coverage.setdefault(name, Coverage(pair[name].image_size)).add(pair[name].uv)
        return ''

    def reset(self):
        """Forget the exposures."""
        self.exposures, self.coverage = [], {}
        self._recent.clear()
        self._streaming = False

    def frames(self, fluoroscopes=None):
        """{fluoroscope: [Frame, ...]} of the exposures. Raises DataError for an unknown fluoroscope."""
        for name in fluoroscopes or ():
            if name not in self.fluoroscopes:
                raise DataError(f'fluoroscope {name} is unknown, there are {", ".join(self.fluoroscopes)}')
        return {name: [pair[name] for pair in self.exposures]
                for name in self.fluoroscopes if not fluoroscopes or name in fluoroscopes}


def collect_recorded(frames, mode='auto', pair_by='frame_number', still=StillOptions()):
    """Exposures of a recording, as the calibration node would collect them: ({fluoroscope: [Frame]}, unpaired).

    frames {fluoroscope: [Frame, ...]}; mode 'all': every paired frame; 'still': as the node does by itself;
    'auto': 'still' for a stream, 'all' for single shots.
    """
    pairer, collector = FramePairer(frames, pair_by, waiting=10 ** 9), ExposureCollector(frames, still)
    if mode == 'auto':
        mode = 'still' if any(_is_stream(f, still) for f in frames.values()) else 'all'
    everything = sorted((f for of_one in frames.values() for f in of_one), key=lambda f: (f.stamp_ns, f.number))
    for frame in everything:
        pair = pairer.add(frame)
        if pair is not None:
            (collector.offer if mode == 'still' else collector.take)(pair)
    pairer.flush()
    return collector.frames(), dict(pairer.unpaired)


def _is_stream(frames, still):
    gaps = np.diff(sorted(f.stamp_ns for f in frames)) if len(frames) > 1 else np.array([0])
    return 0 < np.median(gaps) <= still.still_time_s * 1e9
