# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Node that collects exposures of the phantom and self-calibrates the fluoroscopes on request.

A dedicated thread receives the frames. A second thread runs all other callbacks: long ones
(calibrate, capture) are coroutines that await their results, and the calibration itself runs in a
separate process. rclpy's MultiThreadedExecutor is no alternative: it schedules a callback
repeatedly until it has started, which on a busy machine takes so long that frames are lost.

The node is assembled from parameters and rig (calibration_settings), exposures (exposure_input),
publishers (calibration_output), and services that collect (exposure_input), orient the rig and
calibrate (calibration_services), heal (healing_services), and save and load
(calibration_settings). shape_learning learns the shapes of bodies.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache, partial

from fluoro_calib_msgs.msg import DriftStatus
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.lifecycle.node import LifecycleState
from sensor_msgs.msg import CompressedImage

from ..exposures.stamps import nanoseconds_from_stamp
from .angle_input import AngleInput
from .calibration_output import CONDITIONS, CalibrationOutput, FluoroscopeState
from .calibration_services import SelfCalibration
from .calibration_settings import (
    PARAMETERS,
    CalibrationFiles,
    CalibrationSettings,
    read_rig,
)
from .capture_services import CollectServices, NodeParts, OrientationService
from .exposure_input import (
    RADIOGRAPH,
    ExposureInput,
    PhantomStream,
)
from .frame_validation import subscribe_frames
from .healing_services import Healing
from .messages.observations import ObservedFrame
from .messages.status import fill_calibration
from .runtime.conditions import health_of, state_of
from .runtime.diagnostics import RefusalLog, Status
from .runtime.lifecycle import StreamNode, stream_faults
from .runtime.main import run
from .runtime.services import Requests, create_services, wake
from .runtime.topics import observations_qos
from .shape_learning import ShapeLearning

__all__ = ['PARAMETERS', 'CalibrationNode', 'main']


class CalibrationNode(StreamNode):
    """Collects exposures of the fluoroscopes, and runs one self-calibration at a time."""

    subject = 'target observations'
    topics = ('target_observations',)

    def __init__(self) -> None:
        super().__init__('calibration_node', CalibrationSettings)
        self._rig = read_rig(self, lambda: self.settings)
        self._requests = Requests()
        self.reset()

    def reset(self) -> None:
        """Discard exposures and angles, and reset all counters."""
        self._angles = AngleInput(self.settings.angles, self.names, self.limited_logger)
        self._exposures = ExposureInput(
            self.names,
            self._rig.phantom,
            self.settings,
            on_captured=partial(wake, self),
            logger=self.get_logger(),
        )

    def use(self, settings: CalibrationSettings) -> None:
        """Apply new settings from now on."""
        super().use(settings)
        self._exposures.use(settings)

    # -- lifecycle

    def create_outputs(self) -> None:
        """Create topics, services and actions, and publish the saved calibrations."""
        rig = self._rig
        self._output = output = CalibrationOutput(self, rig.names, rig.directory)
        files = CalibrationFiles(rig, output, self.get_logger())
        parts = NodeParts(
            self, rig, self._exposures, output=output, files=files, requests=self._requests
        )
        self._orienting = OrientationService(parts)
        self._calibrating = SelfCalibration(parts)
        self._healing = Healing(parts)
        self._learning = ShapeLearning(parts)
        # Reentrant, so that a service that awaits something does not block the others.
        group = ReentrantCallbackGroup()
        groups = (
            self._calibrating,
            CollectServices(parts),
            files,
            self._orienting,
            self._healing,
        )
        table = [entry for services in groups for entry in services.services]
        for service in create_services(self, table, group):
            self.own(service, self.destroy_service, service)
        for job in (self._calibrating, self._healing):
            action = job.create_action(group)
            self.own(action, action.destroy)
            self.own(job, job.end)
        self.own(self._learning, self._learning.end)
        if self.settings.node.learn_bodies:
            topic, callback = 'reconstruction/drift', self._learning.on_drift
            refusals = RefusalLog(topic, self.limited_logger)
            self.create_input(DriftStatus, topic, callback, observations_qos(), refusals)
        for name in rig.names:
            refusals = self._exposures.streams[name].refusals
            on_radiograph = partial(self._exposures.add_radiograph, name)
            topic = f'{name}/{RADIOGRAPH}'
            self.create_input(CompressedImage, topic, on_radiograph, observations_qos(), refusals)
        files.load_at_start()

    def create_readers(self) -> None:
        """Receive the observations of all fluoroscopes in one thread."""
        faults = stream_faults(self._exposures.streams, self.fail)
        reader = self._angles.create_reader(self, faults)
        subscribe_frames(reader, self, self.topics[0], self._on_frame)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Clean up, unless a request is being answered."""
        if self._requests.waiting:
            self.get_logger().error(
                'cleanup refused: a request is being answered; cancel it or wait for its end'
            )
            return TransitionCallbackReturn.FAILURE
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Cancel a running job and deactivate; requests still waiting end with the process."""
        if not self._requests.waiting:
            return super().on_shutdown(state)
        self._calibrating.stop()
        self._healing.stop()
        self.deactivate()
        return TransitionCallbackReturn.SUCCESS

    # -- observations, in the thread of the streams

    def _on_frame(self, name: str, frame: ObservedFrame, _: Mapping[str, int]) -> None:
        stamp_ns = nanoseconds_from_stamp(frame)
        needed = bool(self.settings.angles.angle_joint)

        @cache  # asked for by each part that needs it, and counted once
        def angle() -> float | None:
            return self._angles.of_frame(name, stamp_ns, needed=needed)

        self._exposures.add(name, frame, angle)
        self._healing.add(name, frame, angle)
        self._learning.add(name, frame, angle)

    # -- diagnostics

    def diagnose(self) -> list[Status]:
        """Return the diagnostic status of every fluoroscope, and publish its CalibrationStatus."""
        statuses = [self._diagnose(stream) for stream in self._exposures.streams.values()]
        return [*statuses, *self._learning.diagnose()]

    def _diagnose(self, stream: PhantomStream) -> Status:
        name = stream.name
        collected = self._exposures.collected(name)
        calibration = self._output.calibrations.get(name)
        fill_calibration(
            collected.status,
            calibration.calibration_id if calibration else '',
            self._output.age_s(name),
            running=name in self._calibrating.running,
            last=self._calibrating.last_round.get(name),
        )
        self._output.publish_status(collected)
        state = state_of(
            FluoroscopeState,
            self,
            stream,
            counts={'unpaired': collected.status.frames_unpaired},
            collected=collected,
            output=self._output,
            disagreement=self._exposures.disagreement(),
            angle=self._angles.health(name, self.incompatible),
        )
        orientation = self._output.orientation
        verdict = self._output.verdict(name)
        values = {
            **collected.values(),
            'calibration directory': self._rig.directory,
            'lost at the input': stream.overrun,
            'last fault': stream.refusals.last_fault,
            'calibration': collected.status.calibration_id,
            'verdict': verdict.verdict,
            'findings of the verdict': '\n'.join(verdict.findings),
            'orientation': orientation.orientation_id if orientation else '',
            'source of the orientation': orientation.source if orientation else '',
            **self._angles.values(name),
        }
        return Status(name, *health_of(state, CONDITIONS), values)


main = partial(run, CalibrationNode)

if __name__ == '__main__':
    main()
