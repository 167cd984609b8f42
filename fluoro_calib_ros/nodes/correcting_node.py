# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the nodes that correct streams have in common."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, ClassVar

from ..calibration.result import FluoroscopeCalibration
from ..distortion.angle_field import AngleField
from ..errors import DataError, printable
from ..exposures.angles import AngleOptions
from ..files.calibration import load_calibrations
from ..files.result_check import disagreements
from .angle_input import AngleInput, beyond_text
from .calibration_input import CalibrationInput
from .runtime.diagnostics import ERROR, OK, WARN, LatencyWindow, Status
from .runtime.errors import one_line
from .runtime.lifecycle import StreamNode
from .runtime.logging import RateLimitedLogger
from .runtime.parameters import CalibratedParameters, expand_path
from .runtime.refusals import RefusalLog
from .runtime.stall import StallDetector
from .runtime.stream_reader import FaultHandlers


class Stream:
    """Counts of one fluoroscope.

    Attributes
    ----------
    received, corrected : int
        Number of frames or images.
    waiting : int
        Number of those that came before the first calibration.
    refusals : RefusalLog
    stall : StallDetector
    latencies : LatencyWindow
        From the arrival of a message to the publication of its correction.
    beyond : (float, AngleField) or None
        Angle [rad] of a message since the last diagnostics that is far from all calibrated ones.
    """

    def __init__(self, name: str, item: str, logger: RateLimitedLogger) -> None:
        self.name = name
        self.received = 0
        self.corrected = 0
        self.waiting = 0
        self.refusals = RefusalLog(item, logger)
        self.stall = StallDetector()
        self.latencies = LatencyWindow()
        self.beyond: tuple[float, AngleField] | None = None

    def count_corrected(self, info: Mapping[str, int]) -> None:
        """Count a message that was corrected and published; info: see StreamReader.subscribe."""
        self.corrected += 1
        self.latencies.add(time.time_ns() - info['received_timestamp'])


class CorrectingNode(StreamNode):
    """Node that corrects a stream of each fluoroscope with its newest calibration.

    Nothing is corrected before the first calibration. A correction that depends on the angle of a
    C-arm is that at the angle of the stamp, or the mean over the angles where that is unknown.
    Subclasses set the class attributes and override prepare(), on_calibration_ready(),
    make_stream(), make_angles() and extra_values().

    Attributes
    ----------
    item : str
        What is corrected: frame or image.
    subject : str
        What is subscribed to, in words.
    refusal_kinds : tuple of str
    beyond : str
        What becomes of the items at an angle far from all calibrated ones.
    topics : tuple of str
        What is subscribed to, below each fluoroscope.
    angles : dict of str to AngleInput
        Angles of the C-arms, by fluoroscope.
    """

    item: ClassVar[str] = ''
    subject: ClassVar[str] = ''
    refusal_kinds: ClassVar[tuple[str, ...]] = ()
    beyond: ClassVar[str] = ''
    topics: tuple[str, ...] = ()

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.names: tuple[str, ...] = ()
        self._directory = ''
        self.streams: dict[str, Any] = {}
        self.angle_options = AngleOptions()
        self.angles: dict[str, AngleInput] = {}

    def use_parameters(self, parameters: CalibratedParameters, angles: AngleOptions) -> None:
        """Take the parameters that all these nodes have; subclasses call it in __init__."""
        self.angle_options = angles
        self.autostart = parameters.autostart
        self._directory = parameters.calibration_directory
        self.names = parameters.fluoroscopes
        self.reset()

    def make_stream(self, name: str) -> Stream:
        """Return the state of one fluoroscope before the first message."""
        return Stream(name, self.item, self.limited_logger)

    def make_angles(self) -> dict[str, AngleInput]:
        """Return what gives the angles of each fluoroscope; threads must not share one."""
        angles = AngleInput(self.angle_options, self.names, self.limited_logger)
        return dict.fromkeys(self.names, angles)

    def angle_of(self, name: str, stamp_ns: int, field: AngleField | None) -> float | None:
        """Return the angle [rad] of a message at its stamp, None where it is unknown.

        field: what the correction changes with the angle.
        """
        angle = self.angles[name].of_frame(name, stamp_ns, needed=field is not None)
        if field is not None and angle is not None and not field.covers(angle):
            self.streams[name].beyond = angle, field
        return angle

    def prepare(self, calibration: FluoroscopeCalibration) -> Any:
        """Prepare a calibration for use, and return it; called in a thread."""
        return calibration

    def on_calibration_ready(self, name: str, prepared: Any) -> None:
        """Log that a calibration is in use; called in a thread."""

    def extra_values(self, stream: Any, prepared: Any) -> dict[str, object]:
        """Return further values for the diagnostics of a fluoroscope."""
        return {}

    def _angle_verdict(
        self, stream: Any, incompatible: Mapping[str, str]
    ) -> tuple[bytes, str] | None:
        """Return the status where an angle of the C-arm is unknown or was not calibrated."""
        unknown = self.angles[stream.name].status(stream.name, incompatible)
        beyond, stream.beyond = stream.beyond, None
        if unknown:
            level, reason = unknown
            return level, f'{reason}; the mean correction over all angles is used'
        if beyond is None:
            return None
        angle, field = beyond
        return WARN, f'{beyond_text(angle, field.angles)}: {self.beyond}'

    def reset(self) -> None:
        """Start counting from zero."""
        self.streams = {name: self.make_stream(name) for name in self.names}
        self.angles = self.make_angles()

    def prepared(self, name: str) -> Any:
        """Return the prepared calibration in use, None before the first one."""
        return self._calibrations.current(name)

    def subscribe_calibrations(self) -> None:
        """Subscribe to calibrations; the outputs that they need must exist."""
        self._calibrations = CalibrationInput(
            self, self.names, self.prepare, self.on_calibration_ready, self._on_refused_calibration
        )
        self.own(self._calibrations, self._calibrations.close)
        if self._directory:
            self._load_calibrations(self._directory)

    def _load_calibrations(self, text: str) -> None:
        """Begin with the calibrations of a folder."""
        try:
            directory = expand_path(text)
            loaded = load_calibrations(directory)
            missing = [name for name in self.names if name not in loaded]
            if missing:
                raise DataError(f'{directory}: there is no calibration of {", ".join(missing)}')
        except (DataError, OSError) as error:
            self.get_logger().error(f'no calibration loaded: {one_line(error)}')
            for name in self.names:
                self._on_refused_calibration(name, one_line(error))
            return
        for sentence in disagreements(directory, loaded):
            self.get_logger().warning(printable(sentence))
        for name in self.names:
            self._calibrations.begin_with(name, loaded[name])

    @property
    def fault_handlers(self) -> FaultHandlers:
        """What a stream reader calls when something goes wrong."""
        return FaultHandlers(
            lambda topic: self._count_undecodable(self.stream_of(topic), topic),
            lambda topic, error: self.stream_of(topic).refusals.fail(topic, error),
            self.fail,
            lambda topic, size: self._count_too_large(self.stream_of(topic), topic, size),
        )

    def stream_of(self, topic: str) -> Any:
        """Return the Stream of a topic <fluoroscope>/<...>."""
        return self.streams[topic.partition('/')[0]]

    def diagnose(self) -> list[Status]:
        """Return the status of every fluoroscope."""
        self._calibrations.release()
        incompatible = self.incompatible_publishers()
        return [
            Status(name, *self._verdict(stream, incompatible), self._values(stream))
            for name, stream in self.streams.items()
        ]

    def _on_refused_calibration(self, name: str, reason: str) -> None:
        self.streams[name].refusals.last_fault = reason

    @staticmethod
    def _count_undecodable(stream: Stream, topic: str) -> None:
        stream.received += 1
        stream.refusals.refuse_undecodable(topic)

    @staticmethod
    def _count_too_large(stream: Stream, topic: str, size: int) -> None:
        stream.received += 1
        stream.refusals.refuse_too_large(topic, size)

    def _values(self, stream: Stream) -> dict[str, object]:
        return {
            f'{self.item}s received': stream.received,
            f'{self.item}s corrected': stream.corrected,
            f'{self.item}s without calibration': stream.waiting,
            **stream.refusals.values(self.refusal_kinds),
            'last fault': stream.refusals.last_fault,
            **self.extra_values(stream, self.prepared(stream.name)),
            **self.angles[stream.name].values(stream.name),
            **stream.latencies.values(),
        }

    def _verdict(self, stream: Stream, incompatible: Mapping[str, str]) -> tuple[bytes, str]:
        """Return level and message of the diagnostics of a fluoroscope."""
        failure = stream.refusals.failure_status()
        if failure:
            return failure
        conflict = self._calibrations.conflict(stream.name)
        if conflict:
            return ERROR, conflict
        topics = [f'{stream.name}/{topic}' for topic in self.topics]
        for topic in topics:
            if topic in incompatible:
                return WARN, incompatible[topic]
        if self.prepared(stream.name) is None:
            return WARN, f'no calibration yet: {stream.waiting} {self.item}s were not corrected'
        if not self.readers:
            return WARN, 'the node is not active'
        if not any(map(self.has_publisher, topics)):
            return WARN, f'no publisher of {self.subject}'
        stalled = stream.stall.message(stream.received)
        if stalled:
            return WARN, stalled
        return (
            stream.refusals.refusal_status()
            or self._angle_verdict(stream, incompatible)
            or (OK, 'correcting')
        )
