# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Common parts of the nodes that correct streams."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from ..correction.angle_field import AngleField
from ..correction.fluoroscope_calibration import FluoroscopeCalibration
from ..errors import DataError, printable
from ..io.calibration import SUFFIX, disagreements, load_calibrations
from .angle_input import AngleInput, beyond_text
from .calibration_input import CalibrationInput
from .runtime import conditions
from .runtime.conditions import StreamState, health_of, healthy, state_of, warns
from .runtime.diagnostics import WARN, Health, RefusalLog, Status, one_line
from .runtime.lifecycle import Stream, StreamNode
from .runtime.parameters import expand_path

FILES = f'*{SUFFIX}'


@dataclass
class CorrectedStream(Stream):
    """Stream of a fluoroscope whose messages are corrected."""

    corrected: int = 0  #: number of corrected frames or images
    waiting: int = 0  #: number that came before the first calibration
    refused_calibration: str = ''  #: why the last one was refused; '' if none was
    #: angle [rad] since the last diagnostics that is far from all calibrated angles
    beyond: tuple[float, AngleField] | None = None

    def count_corrected(self, info: Mapping[str, int]) -> None:
        """Count a message that was corrected and published; info: see StreamReader.subscribe."""
        self.corrected += 1
        self.add_latency(info['received_timestamp'])


@dataclass(frozen=True)
class CorrectingState(StreamState):
    """State from which the health of a corrected fluoroscope is diagnosed."""

    node: CorrectingNode
    stream: CorrectedStream


def _uncalibrated(state: CorrectingState) -> str:
    """Return a message if there is no calibration yet, and why the last one was refused."""
    stream = state.stream
    if state.node.prepared(stream.name) is not None:
        return ''
    text = f'no calibration yet: {stream.waiting} {state.node.item}s were not corrected'
    return '; '.join(filter(None, (text, stream.refused_calibration)))


def doubtful_angle(state: CorrectingState) -> Health | None:
    """Warn if the angle of the C-arm is unknown or far from all calibrated angles."""
    stream = state.stream
    health = state.node.angles[stream.name].health(stream.name, state.node.incompatible)
    angle_beyond, stream.beyond = stream.beyond, None
    if health:
        return health.with_consequence('the mean correction over all angles is used')
    if angle_beyond is None:
        return None
    angle, field = angle_beyond
    return Health(WARN, f'{beyond_text(angle, field.angles)}: {state.node.beyond}')


CONDITIONS = (
    conditions.lost_messages,
    conditions.several_nodes,
    conditions.incompatible_publisher,
    warns(_uncalibrated),
    conditions.inactive_node,
    conditions.no_publisher,
    conditions.stalled_stream,
    conditions.overrun_input,
    conditions.refused_messages,
    doubtful_angle,
    healthy('correcting'),
)


class CorrectingNode(StreamNode):
    """Node that corrects a stream of each fluoroscope with its newest calibration.

    Nothing is corrected before the first calibration. A correction that depends on the angle of a
    C-arm is evaluated at the angle at the stamp, or averaged over the angles if that is unknown.
    Subclasses set the class attributes and override prepare(), on_calibration_ready(),
    make_angles() and extra_values().
    """

    item: ClassVar[str] = ''  #: corrected item: frame or image
    refusal_kinds: ClassVar[tuple[str, ...]] = ()
    #: what becomes of the items at an angle far from all calibrated ones
    beyond: ClassVar[str] = ''
    stream_kind: ClassVar[type[CorrectedStream]] = CorrectedStream

    def __init__(self, name: str, settings: type[Any]) -> None:
        super().__init__(name, settings)
        self.reset()

    def make_angles(self) -> dict[str, AngleInput]:
        """Return the AngleInput of each fluoroscope; threads must not share one."""
        angles = AngleInput(self.settings.angles, self.names, self.limited_logger)
        return dict.fromkeys(self.names, angles)

    def angle_of(self, name: str, stamp_ns: int, field: AngleField | None) -> float | None:
        """Return the angle [rad] of a message at its stamp, None if it is unknown.

        field: how the correction changes with the angle, None if it does not.
        """
        angle = self.angles[name].of_frame(name, stamp_ns, needed=field is not None)
        if field is not None and angle is not None and not field.covers(angle):
            self.streams[name].beyond = angle, field
        return angle

    def prepare(self, calibration: FluoroscopeCalibration) -> Any:
        """Prepare a calibration for use, and return it; called in a thread."""
        return calibration

    def on_calibration_ready(self, name: str, prepared: Any) -> None:
        """Do nothing; subclasses log that a calibration is in use. Called in a thread."""

    def extra_values(self, stream: Any, prepared: Any) -> dict[str, object]:
        """Return further values for the diagnostics of a fluoroscope."""
        return {}

    def reset(self) -> None:
        """Reset all counters."""
        self.streams: dict[str, Any] = {
            name: self.stream_kind(name, RefusalLog(self.item, self.limited_logger))
            for name in self.names
        }
        self.angles = self.make_angles()

    def prepared(self, name: str) -> Any:
        """Return the prepared calibration in use, None before the first one."""
        return self._calibrations.current(name)

    def subscribe_calibrations(self) -> None:
        """Subscribe to calibrations; the outputs that they need must already exist."""
        self._calibrations = CalibrationInput(
            self, self.names, self.prepare, self.on_calibration_ready, self._on_refused_calibration
        )
        self.own(self._calibrations, self._calibrations.close)
        if self.settings.node.calibration_directory:
            self._load_calibrations(self.settings.node.calibration_directory)

    def _load_calibrations(self, text: str) -> None:
        """Start with the calibrations of a folder, which may be empty or missing at first."""
        try:
            directory = expand_path(text)
            if not directory.exists() or (directory.is_dir() and not any(directory.glob(FILES))):
                self.get_logger().info(f'{directory} has no calibrations yet: waiting for them')
                return
            loaded = load_calibrations(directory)
            missing = [name for name in self.names if name not in loaded]
            if missing:
                raise DataError(f'{directory}: there is no calibration of {", ".join(missing)}')
        except (DataError, OSError) as error:
            self.get_logger().error(f'no calibration loaded: {one_line(error)}')
            for name in self.names:
                self._on_refused_calibration(name, one_line(error))
            return
        for disagreement in disagreements(directory, loaded):
            self.get_logger().warning(printable(str(disagreement)))
        for name in self.names:
            self._calibrations.begin_with(name, loaded[name])

    def diagnose(self) -> list[Status]:
        """Return the status of every fluoroscope."""
        self._calibrations.release()
        return [self._diagnose(stream) for stream in self.streams.values()]

    def _on_refused_calibration(self, name: str, reason: str) -> None:
        stream = self.streams[name]
        stream.refusals.last_fault = stream.refused_calibration = reason

    def _diagnose(self, stream: CorrectedStream) -> Status:
        name = stream.name
        state = state_of(CorrectingState, self, stream)
        values = {
            f'{self.item}s received': stream.received,
            'lost at the input': stream.overrun,
            f'{self.item}s corrected': stream.corrected,
            f'{self.item}s without calibration': stream.waiting,
            **stream.refusals.values(self.refusal_kinds),
            'last fault': stream.refusals.last_fault,
            **self.extra_values(stream, self.prepared(name)),
            **self.angles[name].values(name),
            **stream.latencies.values(),
        }
        return Status(name, *health_of(state, CONDITIONS), values)
