# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Exposures of the phantom collected from the streams of a calibration node, and its services."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from fluoro_calib_msgs.msg import CalibrationStatus
from rclpy.task import Future
from sensor_msgs.msg import CompressedImage

from ..errors import DataError
from ..estimation.initial_network import MIN_TARGETS_OF_EXPOSURE
from ..exposures.collector import ExposureCollector, RadiographCollector, readiness
from ..exposures.frame import Frame, Frames, validate_frame
from ..exposures.pairing import CompletePairer
from ..exposures.phantom import Phantom
from ..exposures.stamps import nanoseconds_from_stamp
from ..images.codec import JPEG_START
from ..limits import MEGABYTE
from ..photogrammetry.plane_resection import frames_without_partner
from .calibration_settings import (
    CalibrationSettings,
)
from .messages.observations import ObservedFrame, frame_from_observed
from .messages.status import Collected
from .runtime.diagnostics import Logger, RateLimitedLogger, RefusalLog
from .runtime.lifecycle import Stream


@dataclass
class PhantomStream(Stream):
    """Stream of a fluoroscope that is searched for the phantom."""

    image_size: tuple[int, int] | None = None
    other_targets: bytes | None = None  #: ids in the last frame without the phantom
    is_other_object_logged: bool = False


@dataclass(eq=False)
class PairWait:
    """Wait for frames of all fluoroscopes, which ends if there are enough or if it is given up.

    Pairs contain a frame of every fluoroscope; those of collected exposures may be of one, if it
    needs no partner.
    """

    count: int
    collected: bool = False  #: whether it is for pairs that become exposures
    pairs: list[Mapping[str, Frame]] = field(default_factory=list)
    exposures: int = 0  #: number with the last pair, of the fluoroscope that has the fewest
    passed: int = 0  #: frames of fluoroscopes that had enough, while others had none
    done: Future = field(default_factory=Future)

    def has_enough(self, name: str) -> bool:
        """Return whether there are enough frames of a fluoroscope."""
        return sum(name in pair for pair in self.pairs) >= self.count


def captured_frames(wait: PairWait, names: Sequence[str]) -> str:
    """Return the numbers of the captured frames, of single ones with their fluoroscope."""
    first = next(iter(wait.pairs[0].values()))
    if len(wait.pairs[0]) == len(names):
        return f'frame {first.number}'
    frames = [frame for pair in wait.pairs for frame in pair.values()]
    return ', '.join(f'frame {frame.number} of {frame.fluoroscope}' for frame in frames)


RADIOGRAPH = 'radiograph'


class ExposureInput:
    """Validates frames, pairs them, and collects the required pairs.

    The thread of the streams adds frames, and the executor's thread reads the collected data; a
    lock protects them. Frames without any target of the phantom, such as those of markers, are
    dropped first. This is cheap: a stream shows the same targets frame after frame, so comparing
    their ids suffices.

    Parameters
    ----------
    names : sequence of str
        Fluoroscopes.
    phantom : Phantom or None
        If None, frames are only counted.
    settings : CalibrationSettings
    on_captured : callable
        Called in the thread of the streams after a Future of frames has received its result.
    logger : Logger
        Logger of the node.
    """

    def __init__(
        self,
        names: Sequence[str],
        phantom: Phantom | None,
        settings: CalibrationSettings,
        on_captured: Callable[[], None],
        logger: Logger,
    ) -> None:
        self._names = tuple(names)
        self._phantom = phantom
        self._settings = settings
        self._on_captured = on_captured
        self._logger = logger
        self._limited_logger = RateLimitedLogger(logger)
        self.streams = {
            name: PhantomStream(name, RefusalLog('frame', self._limited_logger))
            for name in self._names
        }
        self._waits: list[PairWait] = []  # for the next pairs
        self.capture_refusal = ''  # why the last pair was not captured
        self._lock = threading.Lock()
        self._start()

    def _start(self) -> None:
        alone = frames_without_partner(self._phantom)
        self._pairer = CompletePairer(self._names, self._settings.pairing, alone=alone)
        self._collector = ExposureCollector(self._names, self._settings.still)
        self._radiographs = RadiographCollector(self._names)

    # -- the executor's thread

    def use(self, settings: CalibrationSettings) -> None:
        """Apply new settings from now on; collected exposures are kept."""
        with self._lock:
            self._settings = settings
            self._pairer.use(settings.pairing)
            self._collector.still = settings.still

    def reset(self) -> int:
        """Discard all exposures and return their number. The counts of frames are kept."""
        with self._lock:
            count = len(self._collector.exposures)
            unpaired = self._pairer.unpaired
            self._start()
            self._pairer.unpaired = unpaired
            for stream in self.streams.values():
                stream.image_size = None
            return count

    def frames(self, fluoroscopes: Iterable[str] | None = None) -> dict[str, list[Frame]]:
        """Return the collected frames of fluoroscopes, by default of all. Raises DataError."""
        with self._lock:
            return self._collector.frames(fluoroscopes)

    def radiographs(self, frames: Frames) -> dict[str, dict[int, bytes]]:
        """Return small radiographs of collected frames, by fluoroscope and exposure."""
        with self._lock:
            return self._radiographs.of(frames)

    def collected(self, name: str) -> Collected:
        """Return a summary of the data collected for a fluoroscope."""
        stream = self.streams[name]
        with self._lock:
            frames = self._collector.frames([name])[name]
            coverage = self._collector.coverage.get(name)
            status = CalibrationStatus(
                fluoroscope=name,
                frames_received=stream.received,
                frames_rejected=stream.refusals.total + stream.refusals.failures,
                frames_unpaired=self._pairer.unpaired[name],
                exposures=len(frames),
                observations=sum(len(frame.target_id) for frame in frames),
                coverage=coverage.fraction if coverage else 0.0,
            )
            covered = coverage.covered if coverage else None
            ready = readiness(len(frames), coverage)
            return Collected(status, covered, stream.image_size, ready)

    def disagreement(self) -> str:
        """Return a message if stamps show that pairs may be wrong, else ''.

        Frames with the same number are far apart in time, or stamps fit two exposures.
        """
        with self._lock:
            finding = self._pairer.tolerance.finding() or self._pairer.stamps.disagreement()
            return finding.sentence if finding else ''

    def next_pairs(self, count: int = 1, collected: bool = False) -> PairWait:
        """Wait for the next pairs; collected: only for those that it adds to the exposures."""
        wait = PairWait(count, collected)
        with self._lock:
            self._waits.append(wait)
            if collected:
                self.capture_refusal = ''
        return wait

    def give_up(self, wait: PairWait) -> None:
        """Stop waiting for pairs, unless they have come."""
        with self._lock:
            if wait in self._waits:
                self._waits.remove(wait)
                wait.done.set_result(None)

    def _give(self, pair: Mapping[str, Frame], wait: PairWait) -> None:
        """Give a pair to a wait, which ends with its last one."""
        wait.pairs.append(pair)
        wait.exposures = min(map(len, self._collector.frames().values()))
        if all(map(wait.has_enough, self._names)):
            self._end(wait)

    def _end(self, wait: PairWait) -> None:
        self._waits.remove(wait)
        wait.done.set_result(None)
        self._on_captured()

    # -- the thread of the streams

    def add(
        self, name: str, observed: ObservedFrame, angle: Callable[[], float | None] = lambda: None
    ) -> None:
        """Process a frame: ignore it, refuse it, or validate, pair and possibly collect it.

        angle: returns the angle of the C-arm [rad] or None; called if a frame shows the phantom.
        """
        stream = self.streams[name]
        stream.received += 1
        if self._phantom is None or observed.target_id == stream.other_targets:
            return
        try:
            with self._lock:
                frame = self._validated(stream, observed, self._phantom, angle)
                if frame is not None:
                    for pair in self._pairer.add(frame):
                        self._collect(pair)
        except DataError as error:
            stream.refusals.refuse(error)

    def add_radiograph(self, name: str, message: CompressedImage) -> None:
        """Add a small radiograph; refuse data that is too large or no JPEG."""
        jpeg = bytes(message.data)
        if len(jpeg) > MEGABYTE or not jpeg.startswith(JPEG_START):
            error = DataError(f'{name}/{RADIOGRAPH}: this is not a small JPEG')
            self.streams[name].refusals.refuse(error)
            return
        with self._lock:
            self._radiographs.add(name, nanoseconds_from_stamp(message.header.stamp), jpeg)

    def _validated(
        self,
        stream: PhantomStream,
        observed: ObservedFrame,
        phantom: Phantom,
        angle: Callable[[], float | None],
    ) -> Frame | None:
        """Return a valid frame, None if it does not show the phantom. Raises DataError."""
        ids = np.frombuffer(observed.target_id, np.uint32)
        if len(ids) and (phantom.index(ids) < 0).all():
            stream.other_targets = observed.target_id
            if not stream.is_other_object_logged:
                stream.is_other_object_logged = True
                self._logger.info(
                    f'fluoroscope {stream.name}: frames without any target of the phantom, such '
                    f'as frame {observed.frame_number}, are ignored'
                )
            return None
        frame = frame_from_observed(observed, stream.name, angle()).sorted()
        validate_frame(frame, phantom, stream.image_size)
        if len(frame.target_id) < MIN_TARGETS_OF_EXPOSURE:
            raise DataError(
                f'fluoroscope {stream.name}, frame {frame.number}: {len(frame.target_id)} targets '
                f'are too few, {MIN_TARGETS_OF_EXPOSURE} are needed'
            )
        stream.image_size = stream.image_size or frame.image_size
        return frame

    def _collect(self, pair: Mapping[str, Frame]) -> None:
        """Collect a pair for the oldest capture, or because the phantom stands still."""
        captures = [wait for wait in self._waits if wait.collected]
        if len(pair) == len(self._names):
            for wait in [wait for wait in self._waits if not wait.collected]:
                self._give(pair, wait)
        collector = self._collector
        if len(collector.exposures) >= self._settings.limits.max_exposures:
            # Each new exposure is compared with all others.
            self.capture_refusal = (
                f'{len(collector.exposures)} exposures are collected, as many as max_exposures '
                'allows: reset first'
            )
            self._limited_logger.warning(self.capture_refusal)
            return
        if captures and all(map(captures[0].has_enough, pair)):
            captures[0].passed += 1
            if captures[0].passed >= self._settings.pairing.waiting:
                self._end(captures[0])  # the others show no phantom
            return
        if captures:
            refusal = self.capture_refusal = collector.add(pair)
            if not refusal:
                self._give(pair, captures[0])
        elif self._settings.node.collect == 'still':
            before = len(collector.exposures)
            refusal = collector.offer(pair)
            first = next(iter(pair.values()))
            if not first.stamp_ns:
                self.streams[first.fluoroscope].refusals.note(
                    f'fluoroscope {first.fluoroscope}: {refusal}; use the service capture'
                )
            if len(collector.exposures) < before:
                reason = 'it is the first frame of a stream in which the phantom moves'
                self._logger.info(f'exposure {before} discarded: {reason}')
        else:
            return
        if not refusal:
            self._radiographs.want(collector.exposures)
            self._log_collected(pair)

    def _log_collected(self, pair: Mapping[str, Frame]) -> None:
        coverage = self._collector.coverage
        counts = ', '.join(
            f'{name}: {len(frame.target_id)} targets, '
            f'{100 * coverage[name].fraction:.0f} % of the image covered'
            for name, frame in pair.items()
        )
        self._logger.info(f'exposure {len(self._collector.exposures)} collected ({counts})')
        advice = '; '.join(
            f'{name}: {readiness(len(frames), coverage.get(name)).advice}'
            for name, frames in self._collector.frames().items()
        )
        self._logger.info(f'next pose: {advice}')
