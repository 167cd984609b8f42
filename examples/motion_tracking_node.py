# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Track a rigid cluster of markers: its pose relative to the first frame that shows all of it.

    python examples/motion_tracking_node.py --ros-args -p targets:="[1001, 1002, 1003]"

It needs ROS and running nodes. Points are weighted by their covariance, and only those that were
intersected within the calibrated area are used.
"""

import numpy as np
import rclpy
from fluoro_calib_msgs.msg import ReconstructedPoints
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from scipy.spatial.transform import Rotation

POINTS = 'reconstruction/points_with_covariance'


class MotionTracking(Node):
    """Publishes the pose of a cluster: centre [m], and rotation since the first frame."""

    def __init__(self) -> None:
        super().__init__('motion_tracking')
        self._targets = self.declare_parameter('targets', [1001, 1002, 1003]).value
        self._first: dict[int, np.ndarray] = {}
        self._output = self.create_publisher(PoseStamped, 'pose', 100)
        self.create_subscription(ReconstructedPoints, POINTS, self._on_points, 100)

    def _on_points(self, message: ReconstructedPoints) -> None:
        good = np.flatnonzero(np.equal(message.status, message.OK))
        rows = {message.target_id[k]: k for k in good if message.target_id[k] in self._targets}
        xyz = np.transpose([message.x, message.y, message.z])
        if not self._first and len(rows) == len(self._targets):
            self._first = {target: xyz[k] for target, k in rows.items()}
        common = [target for target in rows if target in self._first]
        if len(common) < 3:
            return
        k = [rows[target] for target in common]
        weights = 3 / np.sum([message.cov_xx, message.cov_yy, message.cov_zz], axis=0)[k]
        first = np.array([self._first[target] for target in common])
        centre = np.average(xyz[k], axis=0, weights=weights)
        before = np.average(first, axis=0, weights=weights)
        turn, _ = Rotation.align_vectors(xyz[k] - centre, first - before, weights)
        pose = PoseStamped(header=message.header)  # its stamp is that of the X-ray exposure
        position, orientation = pose.pose.position, pose.pose.orientation
        position.x, position.y, position.z = centre
        orientation.x, orientation.y, orientation.z, orientation.w = turn.as_quat()
        self._output.publish(pose)


if __name__ == '__main__':
    rclpy.init()
    rclpy.spin(MotionTracking())
