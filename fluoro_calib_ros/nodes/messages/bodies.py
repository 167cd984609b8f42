# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Poses of bodies and motion of joints in one exposure, in metres.

Covariances of poses refer to the fixed axes of the header's frame, as REP 103 requires and
robot_localization expects; those of BodyPoses already do.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from fluoro_calib_msgs.msg import BodyPoses, JointAngles
from geometry_msgs.msg import Point, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from sensor_msgs.msg import JointState
from std_msgs.msg import ColorRGBA, Header
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import Marker, MarkerArray

from ...bodies import body as of_bodies
from ...bodies.body import AXIS_MM, Body, PoseStatus
from ...bodies.joints import JointMotion, JointStatus
from ...photogrammetry.rig_orientation import RigOrientation
from .observations import float64_field, stamp_from_nanoseconds, uint8_field, uint32_field
from .points import GREEN, LIFETIME_NS, YELLOW
from .rig_orientation import pose_of, set_poses, transform_of

try:
    from mocap4r2_msgs import msg as mocap
except ImportError:
    mocap = None
try:
    from vision_msgs import msg as vision
except ImportError:
    vision = None

# Types without a status contain measured poses only: predicted ones would not be recognisable.
MEASURED = (PoseStatus.OK, PoseStatus.WEAK)
_TO_METRES = np.repeat([1e-3, 1.0], 3)  # position, then rotation
_SCALE = _TO_METRES[:, None] * _TO_METRES
_OF_JOINT = _SCALE[::-1, ::-1]  # angles, then translations
AXES = [ColorRGBA(r=r, g=g, b=b, a=1.0) for r, g, b in np.eye(3).tolist()]  # colours of RViz
MARKER_MM = 2.0  # diameter of a bead in the display


class BodiesContent(NamedTuple):
    """Poses of B bodies and motion of joints in one exposure."""

    #: of the exposure
    stamp_ns: int
    frame_number: int
    orientation_id: str
    orientation: RigOrientation  #: orientation with which the poses were found
    bodies: Sequence[Body]
    poses: Sequence[of_bodies.BodyPoses]  #: of this exposure
    #: (B, 6), (B, 6, 6): see `bodies.tracking.twists_of`
    twist: NDArray[np.float64]
    twist_covariance: NDArray[np.float64]
    joints: Sequence[JointMotion]  #: of this exposure
    used: Sequence[NDArray[np.int64]]  #: ids of the markers used for each pose

    def header(self) -> Header:
        """Return the header, with the frame of the orientation."""
        return Header(
            stamp=stamp_from_nanoseconds(self.stamp_ns), frame_id=self.orientation.frame_id
        )

    @property
    def measured(self) -> list[int]:
        """Rows of the bodies whose poses were measured in this exposure."""
        return [row for row, pose in enumerate(self.poses) if pose.status[0] in MEASURED]


def message_from_bodies(content: BodiesContent) -> BodyPoses:
    """Return the message of the poses of all bodies."""
    poses = content.poses
    message = BodyPoses(header=content.header(), frame_number=content.frame_number)
    message.body = [pose.body for pose in poses]
    set_poses(
        message,
        np.array([pose.position_mm[0] for pose in poses]),
        np.array([pose.rotation[0] for pose in poses]),
    )
    message.covariance = float64_field(np.array([pose.covariance[0] for pose in poses]) * _SCALE)
    message.status = uint8_field([pose.status[0] for pose in poses])
    message.markers = uint32_field([pose.markers[0] for pose in poses])
    message.orientation_id = content.orientation_id
    message.calibration_id = list(content.orientation.calibration_ids)
    return message


def pose_with_covariance(message: BodyPoses, row: int) -> PoseWithCovarianceStamped:
    """Return the pose of a body from a message, with its covariance."""
    out = PoseWithCovarianceStamped(header=message.header)
    out.pose.pose = pose_of(message, row)
    out.pose.covariance = np.array(message.covariance[36 * row : 36 * row + 36])
    return out


def odometry(content: BodiesContent, message: BodyPoses, row: int) -> Odometry:
    """Return pose and velocities of a body; the velocities are along the body's own axes."""
    out = Odometry(header=message.header, child_frame_id=message.body[row])
    out.pose = pose_with_covariance(message, row).pose
    twist = (content.twist[row] * _TO_METRES).tolist()
    linear, angular = out.twist.twist.linear, out.twist.twist.angular
    linear.x, linear.y, linear.z, angular.x, angular.y, angular.z = twist
    out.twist.covariance = (content.twist_covariance[row] * _SCALE).ravel()
    return out


def transforms_of_bodies(content: BodiesContent, message: BodyPoses, parent: str) -> TFMessage:
    """Return the frames of the measured bodies, as children of the rig frame."""
    stamp = message.header.stamp
    return TFMessage(
        transforms=[
            transform_of(stamp, parent, message.body[row], pose_of(message, row))
            for row in content.measured
        ]
    )


def _point(xyz_mm: NDArray[np.float64]) -> Point:
    x, y, z = (xyz_mm / 1000).tolist()
    return Point(x=x, y=y, z=z)


def body_markers(content: BodiesContent, message: BodyPoses) -> MarkerArray:
    """Return markers and axes of the measured bodies, for RViz.

    The axes of each body start at the centre of its markers.
    """
    out = MarkerArray()
    for row in content.measured:
        body = content.bodies[row]
        common = {'header': message.header, 'ns': body.name, 'pose': pose_of(message, row)}
        axes = Marker(id=0, type=Marker.LINE_LIST, **common)
        for axis, colour in zip(AXIS_MM * np.eye(3), AXES):
            axes.points += [_point(body.centre), _point(body.centre + axis)]
            axes.colors += [colour, colour]
        axes.scale.x = MARKER_MM / 2000
        beads = Marker(id=1, type=Marker.SPHERE_LIST, **common)
        beads.points = [_point(xyz) for xyz in body.xyz_mm]
        beads.scale.x = beads.scale.y = beads.scale.z = MARKER_MM / 1000
        beads.color = GREEN if message.status[row] == PoseStatus.OK else YELLOW
        for marker in (axes, beads):
            marker.lifetime.nanosec = LIFETIME_NS
            out.markers.append(marker)
    return out


def detections(content: BodiesContent, message: BodyPoses) -> vision.Detection3DArray:
    """Return the measured bodies as detections; each box encloses the markers of a body."""
    out = vision.Detection3DArray(header=message.header)
    for row in content.measured:
        body = content.bodies[row]
        detection = vision.Detection3D(header=message.header, id=body.name)
        result = vision.ObjectHypothesisWithPose()
        result.hypothesis.class_id = body.name
        result.hypothesis.score = 1.0
        result.pose = pose_with_covariance(message, row).pose
        detection.results = [result]
        low, high = body.xyz_mm.min(axis=0), body.xyz_mm.max(axis=0)
        detection.bbox.center = pose_of(message, row)
        poses = content.poses[row]
        centre = poses.rotation[0] @ ((low + high) / 2) + poses.position_mm[0]
        detection.bbox.center.position = _point(centre)
        detection.bbox.size.x, detection.bbox.size.y, detection.bbox.size.z = (
            (high - low) / 1000
        ).tolist()
        out.detections.append(detection)
    return out


def rigid_bodies(content: BodiesContent, message: BodyPoses) -> mocap.RigidBodies:
    """Return the measured bodies, with their markers in the rig frame."""
    out = mocap.RigidBodies(header=message.header, frame_number=message.frame_number)
    for row in content.measured:
        body, poses = content.bodies[row], content.poses[row]
        positions = body.xyz_mm @ poses.rotation[0].T + poses.position_mm[0]
        markers = [
            mocap.Marker(id_type=mocap.Marker.USE_INDEX, marker_index=k, translation=_point(xyz))
            for k, xyz in zip(body.target_id.tolist(), positions)
        ]
        pose = pose_of(message, row)
        out.rigidbodies.append(
            mocap.RigidBody(rigid_body_name=body.name, markers=markers, pose=pose)
        )
    return out


# Further message types, published while they have subscribers: of each body that an exposure shows
# (row of the message), and of all of them together.
BODY_FORMS = {
    'pose': (
        PoseWithCovarianceStamped,
        lambda _, message, row: pose_with_covariance(message, row),
    ),
    'odometry': (Odometry, odometry),
}
FORMS = {'body_markers': (MarkerArray, body_markers)}
if vision is not None:
    FORMS['body_detections'] = (vision.Detection3DArray, detections)
if mocap is not None:
    FORMS['rigid_bodies'] = (mocap.RigidBodies, rigid_bodies)


def message_from_joints(content: BodiesContent) -> JointAngles:
    """Return the message of the motion of all joints."""
    joints = content.joints
    message = JointAngles(header=content.header(), frame_number=content.frame_number)
    message.joint = [motion.joint.name for motion in joints]
    message.convention = [motion.joint.convention for motion in joints]
    message.angle_name = [name for motion in joints for name in motion.angle_names]
    message.translation_name = [name for motion in joints for name in motion.translation_names]
    message.angle = float64_field([motion.angles[0] for motion in joints])
    message.translation = float64_field(
        np.array([motion.translations[0] for motion in joints]) / 1000
    )
    message.covariance = float64_field(
        np.array([motion.covariance[0] for motion in joints]) * _OF_JOINT
    )
    message.status = uint8_field([motion.status[0] for motion in joints])
    message.orientation_id = content.orientation_id
    message.calibration_id = list(content.orientation.calibration_ids)
    return message


def joint_state(content: BodiesContent, _: BodyPoses | None = None) -> JointState:
    """Return the angles of measured joints, named <joint>_<angle>."""
    out = JointState(header=content.header())
    for motion in content.joints:
        if motion.status[0] in (JointStatus.OK, JointStatus.WEAK):
            out.name.extend(f'{motion.joint.name}_{name}' for name in motion.angle_names)
            out.position.extend(motion.angles[0].tolist())
    return out
