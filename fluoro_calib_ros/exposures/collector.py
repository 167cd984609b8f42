"""Collecting exposures from streams of frames: pairing, and waiting for the phantom to stand
still.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np

from ..errors import DataError
from .coverage import Coverage
from .pairing import FramePairer

COMMON_TARGETS = 8  # fewer targets in common, and two frames cannot be compared


def displacement(a, b):
    """Median displacement [px] of the targets that two frames of a fluoroscope have in common;
    infinite where they have too few in common.
    """
    _, in_a, in_b = np.intersect1d(
        a.target_id, b.target_id, assume_unique=True, return_indices=True
    )
    if len(in_a) < COMMON_TARGETS:
        return np.inf
    return float(np.median(np.linalg.norm(a.uv[in_a] - b.uv[in_b], axis=1)))


@dataclass(frozen=True)
class StillOptions:
    """When the phantom counts as standing still in a new pose.

    still_time_s: no frame of that time before may show it displaced by more than still_px, and
    those there are have to go back half of it; new_px: median displacement from every collected
    exposure. Frames further apart than still_time_s are single shots, each of which counts; but
    not after a gap in a stream, up to ten times as long.
    """

    still_time_s: float = 0.1
    still_px: float = 1.0
    new_px: float = 10.0


class ExposureCollector:
    """Exposures collected from paired frames.

    exposures: list of {fluoroscope: Frame}; offer() takes a pair where the phantom stands still in
    a new pose, take() takes it as it is. coverage: by fluoroscope, grows with the exposures.
    """

    def __init__(self, fluoroscopes, still=StillOptions()):
        self.fluoroscopes = tuple(fluoroscopes)
        self.still = still
        self.exposures = []
        self.coverage = {}
        self._recent = deque(maxlen=1000)
        self._streaming = False

    def offer(self, pair):
        """Take the pair if the phantom stands still in a new pose; returns '' if taken, else why
        not.
        """
        first = self.fluoroscopes[0]
        now = pair[first].stamp_ns
        still_ns = self.still.still_time_s * 1e9
        window = [p for p in self._recent if 0 <= now - p[first].stamp_ns <= still_ns]
        moved = max(
            (displacement(pair[n], p[n]) for p in window for n in self.fluoroscopes), default=0.0
        )
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
        self.exposures = []
        self.coverage = {}
        self._recent.clear()
        self._streaming = False

    def frames(self, fluoroscopes=None):
        """{fluoroscope: [Frame, ...]} of the exposures. Raises DataError for an unknown
        fluoroscope.
        """
        for name in fluoroscopes or ():
            if name not in self.fluoroscopes:
                raise DataError(
                    f'fluoroscope {name} is unknown, there are {", ".join(self.fluoroscopes)}'
                )
        return {
            name: [pair[name] for pair in self.exposures]
            for name in self.fluoroscopes
            if not fluoroscopes or name in fluoroscopes
        }


def collect_recorded(frames, mode='auto', pair_by='frame_number', still=StillOptions()):
    """Exposures of a recording, as the calibration node would collect them: ({fluoroscope:
    [Frame]}, unpaired).

    frames {fluoroscope: [Frame, ...]}; mode 'all': every paired frame; 'still': as the node does
    by itself; 'auto': 'still' for a stream, 'all' for single shots.
    """
    pairer = FramePairer(frames, pair_by, waiting=10**9)
    collector = ExposureCollector(frames, still)
    if mode == 'auto':
        mode = 'still' if any(_is_stream(f, still) for f in frames.values()) else 'all'
    everything = sorted(
        (f for of_one in frames.values() for f in of_one), key=lambda f: (f.stamp_ns, f.number)
    )
    for frame in everything:
        pair = pairer.add(frame)
        if pair is not None:
            (collector.offer if mode == 'still' else collector.take)(pair)
    pairer.flush()
    return collector.frames(), dict(pairer.unpaired)


def _is_stream(frames, still):
    gaps = np.diff(sorted(f.stamp_ns for f in frames)) if len(frames) > 1 else np.array([0])
    return 0 < np.median(gaps) <= still.still_time_s * 1e9
