# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""ROS client of the demonstration: calls the action, and records the published results."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import rclpy
from action_msgs.msg import GoalStatus
from diagnostic_msgs.msg import DiagnosticArray
from fluoro_calib_msgs.action import SelfCalibrate
from fluoro_calib_msgs.msg import (
    CalibrationStatus,
    CorrectedObservations,
    FluoroscopeCalibration,
    JointAngles,
    ReconstructedPoints,
    RigOrientation,
    TargetObservations,
)
from rclpy.action import ActionClient
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.task import Future
from sensor_msgs.msg import CameraInfo

from ..correction import fluoroscope_calibration as calibration_result
from .messages.fluoroscope_calibration import calibration_from_message
from .messages.observations import (
    CorrectedFrame,
    ObservedFrame,
    decode_corrected_observations,
    decode_target_observations,
)
from .messages.points import GoodPoints, good_points_of
from .messages.self_calibration import feedback_text
from .runtime.streams import FaultHandlers, StreamReader
from .runtime.topics import latched_qos, observations_qos


class DemoError(RuntimeError):
    """Reason why the demonstration failed, in one sentence."""


class DemoClient(Node):
    """Client that uses the graph as a user would."""

    def __init__(self, names: Sequence[str], namespace: str = '') -> None:
        super().__init__('demo_client', namespace=namespace)
        self.names = tuple(names)  #: fluoroscopes
        #: number of subscriptions to corrected observations, as reported by the correction node
        self.corrected_readers: dict[str, int] = {}
        #: frames and their source timestamps [ns] by (fluoroscope, frame number)
        self.sent: dict[tuple[str, int], tuple[ObservedFrame, int]] = {}
        self.corrected: dict[tuple[str, int], tuple[CorrectedFrame, int]] = {}
        #: messages and their source timestamps [ns]
        self.points: list[tuple[ReconstructedPoints, int]] = []
        self.joint_angles: list[JointAngles] = []  #: of exposures with bodies
        self._newest: dict[str, Any] = {}  # messages by topic
        self._streams = StreamReader(
            self,
            FaultHandlers(
                lambda topic: self.get_logger().error(
                    f'topic {topic}: a message cannot be decoded'
                ),
                lambda topic, error: self.get_logger().error(f'topic {topic}: {error!r}'),
                lambda text: self.get_logger().error(text),
            ),
        )
        self._subscribe_streams()
        self._subscribe_states()
        self._action = ActionClient(self, SelfCalibrate, 'self_calibrate')
        self._streams.start()

    @property
    def calibrations(self) -> dict[str, calibration_result.FluoroscopeCalibration]:
        """Published calibrations by fluoroscope."""
        messages = self._newest_of('calibration')
        return {name: calibration_from_message(m) for name, m in messages.items()}

    @property
    def exposures(self) -> dict[str, int]:
        """Number of collected exposures by fluoroscope."""
        return {name: m.exposures for name, m in self._newest_of('calibration_status').items()}

    @property
    def is_correcting(self) -> bool:
        """Whether the correction node uses calibrations of all fluoroscopes.

        It publishes the first CameraInfo of a fluoroscope when it does.
        """
        return len(self._newest_of('camera_info')) == len(self.names)

    @property
    def is_reconstructing(self) -> bool:
        """Whether an orientation is published and the reconstruction node receives frames."""
        readers = [self.corrected_readers.get(name, 0) for name in self.names]
        return 'rig_orientation' in self._newest and all(count > 1 for count in readers)

    def good_points(self) -> list[tuple[GoodPoints, int]]:
        """Return the intersected points and their source timestamps [ns]."""
        return [(good_points_of(message), stamp) for message, stamp in self.points]

    def self_calibrate(self, show: Callable[[str], None]) -> str:
        """Call the action and return the message of its result.

        show: called with a line of text after every round. Raises DemoError.
        """
        self.wait(self._action.server_is_ready, 20, 'the action self_calibrate')
        goal = self._result_of(
            self._action.send_goal_async(
                SelfCalibrate.Goal(), feedback_callback=lambda m: show(feedback_text(m.feedback))
            ),
            10,
            'the answer to the goal',
        )
        if not goal.accepted:
            raise DemoError('calibration_node refused the goal of self_calibrate')
        answer = self._result_of(goal.get_result_async(), 120, 'the self-calibration')
        if answer.status != GoalStatus.STATUS_SUCCEEDED:
            raise DemoError(answer.result.message)
        return answer.result.message

    def wait(self, condition: Callable[[], Any], timeout_s: float, description: str) -> None:
        """Spin until a condition is true. Raises DemoError if time runs out."""
        end = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > end:
                raise DemoError(f'waited {timeout_s:g} s for {description}')
            rclpy.spin_once(self, timeout_sec=0.1)

    def destroy_node(self) -> None:
        """Stop the streams and destroy the node."""
        self._streams.stop()
        super().destroy_node()

    def _result_of(self, future: Future, timeout_s: float, description: str) -> Any:
        self.wait(future.done, timeout_s, description)
        return future.result()

    def _newest_of(self, topic: str) -> dict[str, Any]:
        """Return the newest messages on <fluoroscope>/<topic> by fluoroscope."""
        topics = {name: f'{name}/{topic}' for name in self.names}
        return {name: self._newest[t] for name, t in topics.items() if t in self._newest}

    def _subscribe_streams(self) -> None:
        subscribe = partial(self._streams.subscribe, qos=observations_qos())
        subscribe(
            ReconstructedPoints,
            'reconstruction/points_with_covariance',
            lambda message, info: self.points.append((message, info['source_timestamp'])),
        )
        subscribe(
            JointAngles,
            'reconstruction/joint_angles',
            lambda message, info: self._add_joints(message),
        )
        for kind, topic, frames, decode in (
            (TargetObservations, 'target', self.sent, decode_target_observations),
            (CorrectedObservations, 'corrected', self.corrected, decode_corrected_observations),
        ):
            for name in self.names:
                record = partial(self._record, frames, name)
                subscribe(kind, f'{name}/{topic}_observations', record, decode=decode)

    def _subscribe_states(self) -> None:
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)
        self._keep_newest(RigOrientation, 'rig_orientation', latched_qos())
        for name in self.names:
            self._keep_newest(CalibrationStatus, f'{name}/calibration_status', 10)
            self._keep_newest(FluoroscopeCalibration, f'{name}/calibration', latched_qos())
            self._keep_newest(CameraInfo, f'{name}/camera_info', latched_qos())

    def _keep_newest(self, kind: type, topic: str, qos: QoSProfile | int) -> None:
        self.create_subscription(kind, topic, lambda m: self._newest.update({topic: m}), qos)

    def _add_joints(self, message: JointAngles) -> None:
        """Add joint angles, or remove those of an exposure that are reported as failed."""
        if message.status[0] != JointAngles.FAILED:
            self.joint_angles.append(message)
        else:
            stamp = message.header.stamp
            self.joint_angles = [m for m in self.joint_angles if m.header.stamp != stamp]

    def _on_diagnostics(self, array: DiagnosticArray) -> None:
        for status in array.status:
            if status.name.startswith('/correction_node: '):
                for value in status.values:
                    if value.key == 'readers':
                        self.corrected_readers[status.hardware_id] = int(value.value)

    @staticmethod
    def _record(
        frames: dict[Any, Any],
        name: str,
        frame: ObservedFrame | CorrectedFrame,
        info: Mapping[str, int],
    ) -> None:
        frames[name, frame.frame_number] = (frame, info['source_timestamp'])


@contextmanager
def demo_clients(names: Sequence[str], *namespaces: str) -> Iterator[list[DemoClient]]:
    """Run a DemoClient for each namespace, in a ROS context of their own."""
    rclpy.init(args=[])
    try:
        clients = [DemoClient(names, namespace) for namespace in namespaces]
        try:
            yield clients
        finally:
            for client in clients:
                client.destroy_node()
    finally:
        rclpy.try_shutdown()
