# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Exposures of the phantom collected from the streams of a calibration node, and its services."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from fluoro_calib_msgs.msg import CalibrationStatus
from fluoro_calib_msgs.srv import Capture, Reset
from rclpy.parameter import Parameter
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
from .calibration_output import CalibrationOutput
from .calibration_settings import (
    CalibrationFiles,
    CalibrationSettings,
    RigSetup,
)
from .messages.observations import ObservedFrame, frame_from_observed
from .messages.status import Collected
from .runtime.diagnostics import Logger, RateLimitedLogger, RefusalLog
from .runtime.lifecycle import Stream, StreamNode
from .runtime.services import (
    Requests,
    ServiceEntry,
    Worker,
    check_timeout,
    telling_service,
    within,
)


@dataclass
class PhantomStream(Stream):
    """Stream of a fluoroscope that is searched for the phantom."""

    image_size: tuple[int, int] | None = None
    other_targets: bytes | None = None  #: ids in the last frame without the phantom
    is_other_object_logged: bool = False


@dataclass(eq=False)
class PairWait:
    """Wait for pairs of frames, which ends if there are enough or if it is given up."""

    count: int
    collected: bool = False  #: whether it is for pairs that become exposures
    pairs: list[Mapping[str, Frame]] = field(default_factory=list)
    exposures: int = 0  #: number of exposures with the last pair
    done: Future = field(default_factory=Future)


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
        self._pairer = CompletePairer(self._names, self._settings.pairing)
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
            exposures = self._collector.exposures
            coverage = self._collector.coverage.get(name)
            status = CalibrationStatus(
                fluoroscope=name,
                frames_received=stream.received,
                frames_rejected=stream.refusals.total + stream.refusals.failures,
                frames_unpaired=self._pairer.unpaired[name],
                exposures=len(exposures),
                observations=sum(len(pair[name].target_id) for pair in exposures),
                coverage=coverage.fraction if coverage else 0.0,
            )
            covered = coverage.covered if coverage else None
            ready = readiness(len(exposures), coverage)
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
        wait.exposures = len(self._collector.exposures)
        if len(wait.pairs) == wait.count:
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
        if captures:
            refusal = self.capture_refusal = collector.add(pair)
            if not refusal:
                self._give(pair, captures[0])
        elif self._settings.node.collect == 'still':
            before = len(collector.exposures)
            refusal = collector.offer(pair)
            first = pair[self._names[0]]
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
        counts = ', '.join(
            f'{name}: {len(pair[name].target_id)} targets, '
            f'{100 * coverage.fraction:.0f} % of the image covered'
            for name, coverage in self._collector.coverage.items()
        )
        exposures = len(self._collector.exposures)
        self._logger.info(f'exposure {exposures} collected ({counts})')
        advice = '; '.join(
            f'{name}: {readiness(exposures, coverage).advice}'
            for name, coverage in self._collector.coverage.items()
        )
        self._logger.info(f'next pose: {advice}')


@dataclass(frozen=True)
class NodeParts:
    """Parts of a calibration node that its services use."""

    node: StreamNode
    rig: RigSetup
    exposures: ExposureInput
    output: CalibrationOutput
    files: CalibrationFiles
    requests: Requests


class RigServices(Worker):
    """Services of a calibration node, listed in `services`."""

    services: tuple[ServiceEntry, ...]

    def __init__(self, parts: NodeParts) -> None:
        super().__init__(parts.node)
        self._node, self._rig, self._exposures = parts.node, parts.rig, parts.exposures
        self._output, self._files, self._requests = parts.output, parts.files, parts.requests
        self._logger = parts.node.get_logger()


class CollectServices(RigServices):
    """The services capture, reset and collect_anew."""

    def __init__(self, parts: NodeParts) -> None:
        super().__init__(parts)
        self.services = (
            ServiceEntry('capture', Capture, self._on_capture),
            telling_service('reset', Reset, 'not reset', self._reset, self._logger),
            telling_service('collect_anew', Reset, 'not reset', self._anew, self._logger),
        )

    async def _on_capture(
        self, request: Capture.Request, response: Capture.Response
    ) -> Capture.Response:
        timeout = request.timeout_sec or self._rig.settings().node.capture_timeout
        try:
            self._check(timeout)
        except ValueError as error:  # including DataError
            response.message = str(error)
            return response
        wait = self._exposures.next_pairs(collected=True)
        with self._requests.one():
            await within(self._node, timeout, wait.done, lambda: self._exposures.give_up(wait))
        names = self._rig.names
        response.success = bool(wait.pairs)
        response.exposures = wait.exposures
        if wait.pairs:
            first = wait.pairs[0][names[0]]
            response.message = f'frame {first.number} captured, {response.exposures} exposures now'
        else:
            response.exposures = self._exposures.collected(names[0]).status.exposures
            streams = self._exposures.streams.values()
            received = ', '.join(f'{stream.name} {stream.received}' for stream in streams)
            response.message = self._exposures.capture_refusal or (
                f'no frame of all fluoroscopes ({", ".join(names)}) came within {timeout:g} s; '
                f'frames received: {received}'
            )
        return response

    def _check(self, timeout_s: float) -> None:
        """Raise ValueError (including DataError) if nothing can be captured."""
        self._rig.required_phantom()
        check_timeout(timeout_s)
        self._node.check_active()
        waiting = self._requests.waiting
        if waiting >= self._rig.settings().limits.max_waiting:
            raise DataError(
                f'{waiting} requests wait for their answers, as many as max_waiting allows'
            )

    def _reset(self, _: Reset.Request) -> str:
        count = self._exposures.reset()
        self._output.refused.clear()
        return f'{count} exposures discarded, the calibration stays in use'

    def _anew(self, request: Reset.Request) -> str:
        self._node.set_parameters([Parameter('collect', value='still')])
        return (
            f'{self._reset(request)}; new exposures are collected whenever the phantom stands '
            'still in a new pose'
        )
