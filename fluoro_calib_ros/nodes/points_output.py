# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Points, poses of bodies and motion of joints, published in all their forms."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence

import numpy as np
from fluoro_calib_msgs.msg import BodyPoses, JointAngles, ReconstructedPoints
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.publisher import Publisher
from sensor_msgs.msg import JointState, PointCloud2
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

from ..reconstruction.intersection import FAILED, OUTSIDE, REJECTED, SINGLE_VIEW, IntersectedPoints
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
from .messages.points import (
    MOCAP_MARKERS,
    PointsContent,
    ellipsoid_markers,
    encode_reconstructed_points,
    message_from_points,
    mocap_markers,
    point_cloud,
)
from .runtime.lifecycle import StreamNode
from .runtime.streams import observations_qos

COUNTED_STATUSES = {
    'outside': OUTSIDE,
    'rejected': REJECTED,
    'failed': FAILED,
    'in a single view': SINGLE_VIEW,
}
POINT_FORMS = ('points', 'markers', 'mocap_markers')  # beside the points with covariance


class PointsCounter:
    """Counts points by status."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()

    def add(self, points: IntersectedPoints) -> None:
        """Count points."""
        self._counts['points'] += len(points.status)
        if points.status.any():
            for name, status in COUNTED_STATUSES.items():
                self._counts[name] += int(np.count_nonzero(points.status == status))

    def values(self) -> dict[str, object]:
        """Return the counts for the diagnostics."""
        return {
            'points': self._counts['points'],
            **{f'points {name}': self._counts[name] for name in COUNTED_STATUSES},
        }


class PointsOutput:
    """Publishers of reconstructed points."""

    def __init__(self, node: StreamNode) -> None:
        kinds = {
            'points_with_covariance': ReconstructedPoints,
            'points': PointCloud2,
            'markers': MarkerArray,
        }
        if MOCAP_MARKERS is not None:
            kinds['mocap_markers'] = MOCAP_MARKERS
        self._outputs = {
            name: node.create_output(kind, f'reconstruction/{name}', observations_qos())
            for name, kind in kinds.items()
        }
        self._markers_published_ns = 0

    def publish(self, content: PointsContent) -> None:
        """Publish points with their covariance."""
        self._outputs['points_with_covariance'].publish(encode_reconstructed_points(content))

    def publish_forms(self, content: PointsContent, sigmas: float, rate_hz: float) -> None:
        """Publish the other forms that have subscribers: ellipsoids of so many sigmas."""
        wanted = [
            name
            for name in POINT_FORMS
            if name in self._outputs and self._outputs[name].get_subscription_count()
        ]
        if not wanted:
            return
        message = message_from_points(content)
        good = np.flatnonzero(content.points.status <= OUTSIDE)
        if 'points' in wanted:
            self._outputs['points'].publish(point_cloud(message, good))
        if 'mocap_markers' in wanted:
            self._outputs['mocap_markers'].publish(mocap_markers(message, good))
        now = time.monotonic_ns()
        if 'markers' in wanted and now - self._markers_published_ns >= round(1e9 / rate_hz):
            self._markers_published_ns = now
            self._outputs['markers'].publish(ellipsoid_markers(message, good, sigmas))


class BodiesOutput:
    """Publishers of bodies and joints.

    names: bodies. rig_frame: parent of the frames of the bodies.
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
