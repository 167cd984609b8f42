# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Outputs of a calibration node: results, status, coverage, and its diagnostics."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from fluoro_calib_msgs.msg import CalibrationStatus, FluoroscopeCalibration, RigOrientation
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from ..correction import fluoroscope_calibration as calibration_result
from ..errors import DataError
from ..images.overlay import coverage_picture
from ..io.calibration import Verdict
from ..io.versions import calibrated_orientation
from ..photogrammetry import rig_orientation
from .messages.fluoroscope_calibration import message_from_calibration
from .messages.image import message_from_image
from .messages.rig_orientation import message_from_orientation
from .messages.status import Collected
from .runtime import conditions
from .runtime.conditions import StreamState, fails, missing_publisher, warns
from .runtime.diagnostics import OK, Health
from .runtime.lifecycle import StreamNode
from .runtime.topics import latched_qos


class CalibrationOutput:
    """Publishers of a calibration node, the results in use, and the faults of refused ones."""

    def __init__(self, node: StreamNode, names: Sequence[str], directory: Path) -> None:
        self.orientation: rig_orientation.RigOrientation | None = None  #: orientation in use
        self.refused: dict[str, str] = {}  #: why the last calibration of a fluoroscope was refused
        #: why calibrations were not loaded at the start, or could not be saved; '' without a fault
        self.load_fault = ''
        self.save_fault = ''
        self._node = node
        self._names = names
        self._directory = directory
        self._in_use: dict[str, calibration_result.FluoroscopeCalibration] = {}
        self._since: dict[str, float] = {}
        self._verdict: dict[str, Verdict] = {}
        # Create the status publishers first: receivers of calibrations count them to recognise
        # that two nodes serve the same fluoroscope.
        self._status = self._publishers(CalibrationStatus, 'calibration_status', 10)
        self._calibration = self._publishers(FluoroscopeCalibration, 'calibration', latched_qos())
        self._coverage = self._publishers(Image, 'coverage', latched_qos())
        self._orientation, self._as_calibrated = (
            self._publisher(RigOrientation, topic, latched_qos())
            for topic in ('rig_orientation', 'rig_orientation_as_calibrated')
        )

    def _publishers(self, kind: type, topic: str, qos: QoSProfile | int) -> dict[str, Publisher]:
        return {name: self._publisher(kind, f'{name}/{topic}', qos) for name in self._names}

    def _publisher(self, kind: type, topic: str, qos: QoSProfile | int) -> Publisher:
        """Return a publisher that also publishes while the node is inactive."""
        publisher = self._node.create_publisher(kind, topic, qos)
        return self._node.own(publisher, self._node.destroy_publisher, publisher)

    @property
    def calibrations(self) -> dict[str, calibration_result.FluoroscopeCalibration]:
        """The calibrations in use, by fluoroscope."""
        return {name: self._in_use[name] for name in self._names if name in self._in_use}

    def all_calibrations(self) -> dict[str, calibration_result.FluoroscopeCalibration]:
        """Return the calibrations in use. Raises DataError if a fluoroscope has none."""
        calibrations = self.calibrations
        missing = [name for name in self._names if name not in calibrations]
        if missing:
            raise DataError(f'fluoroscope {missing[0]} is not calibrated yet')
        return calibrations

    def publish(
        self,
        calibrations: Mapping[str, calibration_result.FluoroscopeCalibration],
        orientation: rig_orientation.RigOrientation | None,
        verdict: Verdict | None = None,
    ) -> None:
        """Use and publish calibrations, and the orientation that belongs to them, if any.

        verdict: validation verdict on some of the calibrations.
        """
        # Publish the orientation first, so that it is there when the first points arrive that are
        # corrected with the new calibrations.
        if orientation is not None:
            self.publish_orientation(orientation)
        for name, calibration in calibrations.items():
            self._in_use[name] = calibration
            self._since[name] = time.monotonic()
            self._verdict.pop(name, None)
            if verdict and verdict.calibration_id.get(name) == calibration.calibration_id:
                self._verdict[name] = verdict
            self.refused.pop(name, None)
            self.load_fault = ''
            self._calibration[name].publish(message_from_calibration(calibration))

    def publish_orientation(self, orientation: rig_orientation.RigOrientation) -> None:
        """Use and publish an orientation, preceded by the calibrated one if it was healed."""
        self.orientation = orientation
        calibrated = calibrated_orientation(self._directory, orientation)
        if calibrated is not None:
            self._as_calibrated.publish(message_from_orientation(calibrated))
        self._orientation.publish(message_from_orientation(orientation))

    def verdict(self, name: str) -> Verdict:
        """Return the verdict on a calibration in use."""
        return self._verdict.get(name, Verdict())

    def age_s(self, name: str) -> float:
        """Return how long a calibration has been in use [s], NaN if there is none."""
        return time.monotonic() - self._since.get(name, float('nan'))

    def publish_status(self, collected: Collected) -> None:
        """Publish the status of a fluoroscope, and a coverage picture if it has subscribers."""
        status, readiness = collected.status, collected.readiness
        name = status.fluoroscope
        stamp = self._node.get_clock().now().to_msg()
        status.header = Header(stamp=stamp, frame_id=f'{name}_optical')
        self._status[name].publish(status)
        if collected.covered is None or not self._coverage[name].get_subscription_count():
            return
        lines = (
            f'{name}: {status.exposures} exposures, {100 * status.coverage:.0f} % covered',
            readiness.advice,
        )
        size = collected.image_size or (1, 1)
        picture = coverage_picture(collected.covered, size, lines, readiness.areas)
        self._coverage[name].publish(message_from_image(status.header, picture))


@dataclass(frozen=True)
class FluoroscopeState(StreamState):
    """State from which the health of a fluoroscope is diagnosed."""

    collected: Collected
    output: CalibrationOutput
    disagreement: str  #: message if stamps show that pairs may be wrong, else ''
    angle: Health | None  #: warning if the angle of the C-arm is unknown


def _refused_calibration(state: FluoroscopeState) -> str:
    """Return why the last self-calibration gave no calibration, '' if it gave one."""
    reason = state.output.refused.get(state.stream.name, '')
    in_use = state.collected.status.calibration_id or 'no calibration'
    return reason and f'the last calibration was refused: {reason}; {in_use} is in use'


def _failed_verdict(state: FluoroscopeState) -> str:
    """Return a message if the calibration in use has failed its verdict."""
    verdict = state.output.verdict(state.stream.name)
    if verdict.verdict != 'fail':
        return ''
    return ': '.join(['the calibration in use has failed its verdict', *verdict.findings[:1]])


def working(state: FluoroscopeState) -> Health:
    """Report what the node is doing if nothing is wrong."""
    status = state.collected.status
    if status.state == status.CALIBRATING:
        return Health(OK, f'self-calibration running, round {status.iteration}')
    return Health(OK, 'calibrated' if status.calibration_id else 'collecting exposures')


CONDITIONS = (
    conditions.lost_messages,
    conditions.incompatible_publisher,
    conditions.several_nodes,
    fails(
        lambda state: (
            state.output.load_fault and f'no calibration loaded: {state.output.load_fault}'
        )
    ),
    fails(lambda state: state.output.save_fault),
    fails(_refused_calibration),
    conditions.inactive_node,
    # Nobody publishes frames, or has ever done so.
    warns(lambda state: '' if state.stream.received else missing_publisher(state)),
    conditions.overrun_input,
    warns(lambda state: state.disagreement),
    conditions.unpaired_frames,
    conditions.refused_messages,
    lambda state: state.angle,
    warns(_failed_verdict),
    working,
)
