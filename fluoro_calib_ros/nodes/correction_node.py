# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Node that removes the distortion from every observation of the fluoroscopes, live."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from fluoro_calib_msgs.msg import CorrectedObservations
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo

from ..correction.base import CorrectionStatus
from ..correction.fluoroscope_calibration import FluoroscopeCalibration
from ..exposures.angles import AngleOptions
from ..exposures.stamps import nanoseconds_from_stamp
from ..limits import StreamLimits
from .correcting_node import CorrectedStream, CorrectingNode
from .frame_validation import OBSERVED_REFUSALS, FrameValidator, subscribe_frames
from .messages.fluoroscope_calibration import message_of_corrected_stream
from .messages.observations import ObservedFrame, encode_corrected_observations
from .runtime.diagnostics import Refused
from .runtime.lifecycle import stream_faults
from .runtime.main import run
from .runtime.parameters import CalibratedParameters, group, parameters_of_managed
from .runtime.topics import latched_qos, observations_qos

# As int, because comparing an array with an enum member takes longer than all other work here.
INVALID = int(CorrectionStatus.INVALID)


@dataclass(frozen=True)
class CorrectionSettings:
    """Parameter values by group."""

    node: CalibratedParameters = group(CalibratedParameters)
    angles: AngleOptions = group(AngleOptions)
    limits: StreamLimits = group(StreamLimits)


PARAMETERS = parameters_of_managed(CorrectionSettings)


@dataclass
class ObservationStream(CorrectedStream):
    """Stream of image points to correct."""

    invalid_points: int = 0
    stamp: tuple[int, int] | None = None  #: seconds and nanoseconds of the newest frame

    def __post_init__(self) -> None:
        self.validator = FrameValidator(self.name)


class CorrectionNode(CorrectingNode):
    """Publishes corrected observations, none before the first calibration."""

    item = 'frame'
    subject = 'target observations'
    refusal_kinds = OBSERVED_REFUSALS
    beyond = 'the points are OUTSIDE'
    stream_kind = ObservationStream
    topics = ('target_observations',)

    def __init__(self) -> None:
        super().__init__('correction_node', CorrectionSettings)

    def create_outputs(self) -> None:
        """Create the outputs and subscribe to calibrations."""
        self._corrected = self.create_outputs_of(
            CorrectedObservations, 'corrected_observations', observations_qos
        )
        self._info = {}
        for name in self.names:
            info = self.create_publisher(CameraInfo, f'{name}/camera_info', latched_qos())
            self._info[name] = self.own(info, self.destroy_publisher, info)
        self.subscribe_calibrations()

    def create_readers(self) -> None:
        """Receive the observations of all fluoroscopes in one thread."""
        angles = self.angles[self.names[0]]  # the same for all fluoroscopes
        reader = angles.create_reader(self, stream_faults(self.streams, self.fail))
        subscribe_frames(reader, self, self.topics[0], self._on_frame)

    def prepare(self, calibration: FluoroscopeCalibration) -> FluoroscopeCalibration:
        """Prepare the lookup grid of a calibration, and return the calibration."""
        calibration.prepare()
        return calibration

    def on_calibration_ready(self, name: str, prepared: FluoroscopeCalibration) -> None:
        """Publish the CameraInfo of a new calibration, and log that it is in use."""
        self._publish_info(name)
        grid = prepared.grid
        self.get_logger().info(
            f'fluoroscope {name}: calibration {prepared.calibration_id} in use '
            f'(grid cells of {grid.cell_px:g} px, within {grid.error_px:.4f} px of the model)'
        )

    def diagnose(self) -> list[Any]:
        """Return the status of every fluoroscope, and publish its CameraInfo again."""
        for name in self.names:
            self._publish_info(name)
        return super().diagnose()

    def extra_values(
        self, stream: ObservationStream, prepared: FluoroscopeCalibration | None
    ) -> dict[str, object]:
        """Return further values for the diagnostics of a fluoroscope."""
        return {
            'invalid points': stream.invalid_points,
            'readers': self._corrected[stream.name].get_subscription_count(),
            'calibration': prepared.calibration_id if prepared else '',
            'grid error [px]': f'{prepared.grid.error_px:.4f}' if prepared else '',
        }

    def _publish_info(self, name: str) -> None:
        calibration = self.prepared(name)
        if calibration is None:
            return
        stamp = self.streams[name].stamp
        info_stamp = (
            self.get_clock().now().to_msg()
            if stamp is None
            else Time(sec=stamp[0], nanosec=stamp[1])
        )
        self._info[name].publish(message_of_corrected_stream(calibration, info_stamp))

    def _on_frame(self, name: str, frame: ObservedFrame, info: Mapping[str, int]) -> None:
        """Correct a frame and publish it."""
        stream = self.streams[name]
        stream.received += 1
        stream.stamp = frame.sec, frame.nanosec
        calibration = self.prepared(name)
        if calibration is None:
            stream.waiting += 1
            return
        try:
            arrays = stream.validator.validated_arrays(frame, calibration)
        except Refused as error:
            stream.refusals.refuse(error)
            return
        stamp_ns = nanoseconds_from_stamp(frame)
        angle = self.angle_of(name, stamp_ns, calibration.angle_field)
        corrected = calibration.correct_arrays(*arrays, angle=angle)
        self._corrected[name].publish(
            encode_corrected_observations(frame, calibration.calibration_id, corrected)
        )
        stream.count_corrected(info)
        status = corrected[-1]
        if not len(status) or status.max() == INVALID:
            self._note_invalid_points(stream, frame, status)

    @staticmethod
    def _note_invalid_points(
        stream: ObservationStream, frame: ObservedFrame, status: NDArray[np.uint8]
    ) -> None:
        """Count and log points of a published frame that are not on the image."""
        where = f'fluoroscope {stream.name}, frame {frame.frame_number}'
        if not len(status):
            stream.refusals.note(f'{where}: the frame is empty, it has no targets')
            return
        invalid = np.flatnonzero(status == INVALID)
        stream.invalid_points += len(invalid)
        number = np.frombuffer(frame.target_id, np.uint32)[invalid[0]]
        stream.refusals.note(
            f'{where}: target {number} is not a point of the image, it is published as INVALID'
        )


main = partial(run, CorrectionNode)

if __name__ == '__main__':
    main()
