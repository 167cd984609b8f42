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

"""What the nodes that correct streams have in common."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, ClassVar

from ..calibration.result import FluoroscopeCalibration
from ..errors import DataError
from ..files.calibration import load_calibrations
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
    """

    def __init__(self, name: str, item: str, logger: RateLimitedLogger) -> None:
        self.name = name
        self.received = 0
        self.corrected = 0
        self.waiting = 0
        self.refusals = RefusalLog(item, logger)
        self.stall = StallDetector()
        self.latencies = LatencyWindow()

    def count_corrected(self, info: Mapping[str, int]) -> None:
        """Count a message that was corrected and published; info: see StreamReader.subscribe."""
        self.corrected += 1
        self.latencies.add(time.time_ns() - info['received_timestamp'])


class CorrectingNode(StreamNode):
    """Node that corrects a stream of each fluoroscope with its newest calibration.

    Nothing is corrected before the first calibration. Subclasses set the class attributes and
    override prepare(), on_calibration_ready(), make_stream(), extra_values() and extra_verdict().

    Attributes
    ----------
    item : str
        What is corrected: frame or image.
    subject : str
        What is subscribed to, in words.
    refusal_kinds : tuple of str
    topics : tuple of str
        What is subscribed to, below each fluoroscope.
    """

    item: ClassVar[str] = ''
    subject: ClassVar[str] = ''
    refusal_kinds: ClassVar[tuple[str, ...]] = ()
    topics: tuple[str, ...] = ()

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.names: tuple[str, ...] = ()
        self._directory = ''
        self.streams: dict[str, Any] = {}

    def use_parameters(self, parameters: CalibratedParameters) -> None:
        """Take the parameters that all these nodes have; subclasses call it in __init__."""
        self.autostart = parameters.autostart
        self._directory = parameters.calibration_directory
        self.names = parameters.fluoroscopes
        self.reset()

    def make_stream(self, name: str) -> Stream:
        """Return the state of one fluoroscope before the first message."""
        return Stream(name, self.item, self.limited_logger)

    def prepare(self, calibration: FluoroscopeCalibration) -> Any:
        """Prepare a calibration for use, and return it; called in a thread."""
        return calibration

    def on_calibration_ready(self, name: str, prepared: Any) -> None:
        """Log that a calibration is in use; called in a thread."""

    def extra_values(self, stream: Any, prepared: Any) -> dict[str, object]:
        """Return further values for the diagnostics of a fluoroscope."""
        return {}

    def extra_verdict(
        self, stream: Any, prepared: Any, incompatible: Mapping[str, str]
    ) -> tuple[bytes, str] | None:
        """Return level and message of a fault of a subclass in a stream that is corrected."""
        return None

    def reset(self) -> None:
        """Start counting from zero."""
        self.streams = {name: self.make_stream(name) for name in self.names}

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
            or self.extra_verdict(stream, self.prepared(stream.name), incompatible)
            or (OK, 'correcting')
        )
