# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Poses of bodies and motion of joints, published in all their forms."""

from __future__ import annotations

from collections.abc import Sequence

from fluoro_calib_msgs.msg import BodyPoses, JointAngles
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.publisher import Publisher
from sensor_msgs.msg import JointState
from tf2_msgs.msg import TFMessage

from .messages.bodies import (
    FORMS,
    BodiesContent,
    joint_state,
    message_from_bodies,
    message_from_joints,
    odometry,
    pose_with_covariance,
    transforms_of_bodies,
)
from .runtime.lifecycle import StreamNode
from .runtime.streams import observations_qos


class BodiesOutput:
    """Publishers of bodies and joints.

    Parameters
    ----------
    node : StreamNode
    names : sequence of str
        Bodies.
    has_joints : bool
    rig_frame : str
        Parent of the frames of the bodies.
    """

    def __init__(
        self, node: StreamNode, names: Sequence[str], has_joints: bool, rig_frame: str
    ) -> None:
        def output(kind: type, topic: str) -> Publisher:
            return node.create_output(kind, topic, observations_qos())

        self._rig_frame = rig_frame
        self._bodies = output(BodyPoses, 'reconstruction/body_poses')
        self._transforms = output(TFMessage, '/tf')
        places = [f'reconstruction/bodies/{name}' for name in names]
        self._poses = [output(PoseWithCovarianceStamped, f'{place}/pose') for place in places]
        self._odometry = [output(Odometry, f'{place}/odometry') for place in places]
        self._forms = [
            (output(kind, f'reconstruction/{name}'), make) for name, (kind, make) in FORMS.items()
        ]
        self._joints = output(JointAngles, 'reconstruction/joint_angles') if has_joints else None
        self._joint_states = (
            output(JointState, 'reconstruction/joint_states') if has_joints else None
        )

    def publish(self, content: BodiesContent) -> None:
        """Publish an exposure; standard types only while they have subscribers."""
        message = message_from_bodies(content)
        self._bodies.publish(message)
        if self._transforms.get_subscription_count():
            transforms = transforms_of_bodies(content, message, self._rig_frame)
            self._transforms.publish(transforms)
        for row in content.measured:
            if self._poses[row].get_subscription_count():
                self._poses[row].publish(pose_with_covariance(message, row))
            if self._odometry[row].get_subscription_count():
                self._odometry[row].publish(odometry(content, message, row))
        for form, make in self._forms:
            if form.get_subscription_count():
                form.publish(make(content, message))
        if self._joints is None or self._joint_states is None:
            return
        self._joints.publish(message_from_joints(content))
        if self._joint_states.get_subscription_count():
            self._joint_states.publish(joint_state(content))
