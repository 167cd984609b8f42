# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""RigOrientation: interior and exterior orientation of the fluoroscopes of a rig, in metres."""

from __future__ import annotations

import numpy as np
from builtin_interfaces.msg import Time
from fluoro_calib_msgs.msg import BodyPoses, RigOrientation
from geometry_msgs.msg import Pose, TransformStamped
from numpy.typing import NDArray
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from ...errors import DataError
from ...exposures.stamps import nanoseconds_from_stamp
from ...limits import read_limits
from ...photogrammetry import rig_orientation as rig
from ...photogrammetry.rotations import (
    ROTATION_TOLERANCE,
    matrix_from_quaternion,
    quaternion_from_matrix,
    vector_from_matrix,
)
from .observations import float64_field, stamp_from_nanoseconds

# Static transforms of the optical frames of a rig.


AS_CALIBRATED = '_as_calibrated'  # suffix of the frame at the calibrated pose of a healed camera


def transforms_of_orientation(
    message: RigOrientation, rig_frame: str, calibrated: rig.RigOrientation | None = None
) -> TFMessage:
    """Return the optical frames as children of the rig frame.

    An orientation from the calibration is given in the optical frame of its first fluoroscope, and
    the rig frame then coincides with that frame. Every optical frame thus has the same parent
    whatever the source of the orientation, and no earlier transform stays valid.

    calibrated: the orientation before it was healed. For each optical frame that has moved since,
    a frame at its calibrated pose is inserted between it and the rig frame (REP 105: like odom
    between map and robot).
    """
    stamp = message.header.stamp
    frame = message.header.frame_id
    frames = message.optical_frame_id
    out = TFMessage()
    if frame != rig_frame and frame not in frames:
        out.transforms.append(transform_of(stamp, rig_frame, frame, Pose()))
    before, moved = RigOrientation(), set()
    if calibrated is not None:
        before = message_from_orientation(calibrated)
        after = content_of_orientation(message)
        moved = {child for row, child in enumerate(frames) if _moved_by(calibrated, after, row)}
    corrected = []
    for row, child in enumerate(frames):
        if child == rig_frame:
            continue
        parent = rig_frame
        pose = pose_of(message, row)
        if child in moved and child in before.optical_frame_id:
            parent = f'{child}{AS_CALIBRATED}'
            old = pose_of(before, before.optical_frame_id.index(child))
            corrected.append(transform_of(before.header.stamp, rig_frame, parent, old))
            pose = _relative_pose(old, pose)
        out.transforms.append(transform_of(stamp, parent, child, pose))
    out.transforms += corrected
    return out


def pose_of(message: RigOrientation | BodyPoses, row: int) -> Pose:
    """Return a pose from the arrays x, y, z, qx, qy, qz and qw of a message."""
    pose = Pose()
    for name in 'xyz':
        setattr(pose.position, name, getattr(message, name)[row])
    for name in 'xyzw':
        setattr(pose.orientation, name, getattr(message, f'q{name}')[row])
    return pose


def set_poses(
    message: RigOrientation | BodyPoses,
    position_mm: NDArray[np.float64],
    rotation: NDArray[np.float64],
) -> None:
    """Set the arrays x, y, z, qx, qy, qz and qw of a message to poses (n, 3), (n, 3, 3)."""
    columns = (*(position_mm / 1000).T, *quaternion_from_matrix(rotation).T)
    for name, column in zip((*_POSITION, *_ATTITUDE), columns):
        setattr(message, name, float64_field(column))


def transform_of(stamp: Time, parent: str, child: str, pose: Pose) -> TransformStamped:
    """Return the transform of a frame with a pose in its parent."""
    stamped = TransformStamped(header=Header(stamp=stamp, frame_id=parent), child_frame_id=child)
    stamped.transform.rotation = pose.orientation
    for axis in 'xyz':
        setattr(stamped.transform.translation, axis, getattr(pose.position, axis))
    return stamped


def _relative_pose(old: Pose, new: Pose) -> Pose:
    """Return a new pose relative to an old one."""
    (p0, r0), (p1, r1) = map(_place_and_rotation, (old, new))
    out = Pose()
    for target, names, values in (
        (out.position, 'xyz', r0.T @ (p1 - p0)),
        (out.orientation, 'wxyz', quaternion_from_matrix(r0.T @ r1)),
    ):
        for name, value in zip(names, values.tolist()):
            setattr(target, name, value)
    return out


def _place_and_rotation(pose: Pose) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    place, turn = pose.position, pose.orientation
    rotation = matrix_from_quaternion(np.array([[turn.w, turn.x, turn.y, turn.z]]))[0]
    return np.array([place.x, place.y, place.z]), rotation


_INTERIOR = ('xp', 'yp', 'c')
_POSITION = ('x', 'y', 'z')
_ATTITUDE = ('qw', 'qx', 'qy', 'qz')


def message_from_orientation(orientation: rig.RigOrientation) -> RigOrientation:
    """Return the message of an orientation, whose id is the digest of the rounded values."""
    orientation = orientation.rounded()
    message = RigOrientation()
    message.header.stamp = stamp_from_nanoseconds(orientation.stamp_ns)
    message.header.frame_id = orientation.frame_id
    message.orientation_id = orientation.orientation_id
    message.source = orientation.source
    message.fluoroscope = list(orientation.fluoroscopes)
    message.calibration_id = list(orientation.calibration_ids)
    message.optical_frame_id = list(orientation.optical_frame_ids)
    message.exposures = orientation.exposures
    for name, column in zip(_INTERIOR, orientation.interior.T):
        setattr(message, name, float64_field(column))
    set_poses(message, orientation.position_mm, orientation.rotation.transpose(0, 2, 1))
    scale = _metre_scale(len(orientation.fluoroscopes))
    message.covariance = float64_field(orientation.covariance * scale * scale[:, None])
    return message


def orientation_from_message(message: RigOrientation) -> rig.RigOrientation:
    """Return the orientation of a message, equal to the sent one after rounding.

    Raises DataError if the message contains no valid orientation, or if its id does not match.
    """
    orientation = content_of_orientation(message)
    if orientation.orientation_id != message.orientation_id:
        raise DataError(
            f'rig orientation: its content does not match its id {message.orientation_id}'
        )
    return orientation


def content_of_orientation(message: RigOrientation) -> rig.RigOrientation:
    """Return the orientation of a message without comparing its id. Raises DataError."""
    count = len(message.fluoroscope)
    limit = read_limits().max_fluoroscopes
    if count > limit:
        raise DataError(f'rig orientation: {count} fluoroscopes; the limit is {limit}')
    if not count:
        raise DataError('rig orientation: it has no fluoroscopes')
    columns = {
        name: np.array(getattr(message, name)) for name in (*_INTERIOR, *_POSITION, *_ATTITUDE)
    }
    wrong = [name for name, column in columns.items() if len(column) != count]
    if len(message.covariance) != (rig.ORIENTATION_SIZE * count) ** 2:
        wrong.append('covariance')
    if wrong:
        raise DataError(
            f'rig orientation: {count} fluoroscopes, but the array {wrong[0]} has another length'
        )
    for name, column in (*columns.items(), ('covariance', np.array(message.covariance))):
        if not (np.abs(column) <= rig.MAX_VALUE).all():
            raise DataError(
                f'rig orientation: the array {name} holds a number that is not finite or beyond '
                f'{rig.MAX_VALUE:g}'
            )
    scale = _metre_scale(count)
    attitude = np.stack([columns[name] for name in _ATTITUDE], axis=1)
    if not (np.abs(np.linalg.norm(attitude, axis=1) - 1) <= ROTATION_TOLERANCE).all():
        raise DataError('rig orientation: an attitude is not a unit quaternion')
    return rig.RigOrientation(
        fluoroscopes=tuple(message.fluoroscope),
        interior=np.stack([columns[name] for name in _INTERIOR], axis=1),
        rotation=matrix_from_quaternion(attitude).transpose(0, 2, 1),
        position_mm=1000 * np.stack([columns[name] for name in _POSITION], axis=1),
        covariance=np.array(message.covariance).reshape(len(scale), -1) / np.outer(scale, scale),
        frame_id=message.header.frame_id,
        source=message.source,
        calibration_ids=tuple(message.calibration_id),
        stamp_ns=nanoseconds_from_stamp(message.header.stamp),
        exposures=message.exposures,
        optical_frame_ids=tuple(message.optical_frame_id),
    ).rounded()


def description_of(message: RigOrientation) -> str:
    """Return id, source and frame of an orientation, for the log."""
    return (
        f'orientation {message.orientation_id} by {message.source} '
        f'({message.exposures} exposures), in frame {message.header.frame_id}'
    )


def jump_text(before: rig.RigOrientation, after: rig.RigOrientation) -> str:
    """Return how far fluoroscopes have moved between orientations, '' if none has."""
    if before.frame_id != after.frame_id:
        return f'the rig frame is {after.frame_id} instead of {before.frame_id}'
    texts = ((name, _moved_by(before, after, f)) for f, name in enumerate(after.fluoroscopes))
    return ', '.join(f'{name} by {text}' for name, text in texts if text)


def _moved_by(before: rig.RigOrientation, after: rig.RigOrientation, row: int) -> str:
    """Return how far a fluoroscope has moved between orientations, '' if it has not.

    row: of the fluoroscope in the later orientation.
    """
    name = after.fluoroscopes[row]
    if name not in before.fluoroscopes:
        return ''
    f_before, f_after = before.index(name), row
    shift = np.linalg.norm(after.position_mm[f_after] - before.position_mm[f_before])
    turn = np.linalg.norm(
        vector_from_matrix(after.rotation[f_after] @ before.rotation[f_before].T)
    )
    if shift < 1e-6 and turn < 1e-7:  # rounding by the conversion to a message and back
        return ''
    return f'{shift:.2f} mm and {np.degrees(turn):.3f} degrees'


def _metre_scale(count: int) -> NDArray[np.float64]:
    """Return the factors (9 count,) that convert the unknowns of an orientation from mm to m."""
    return np.tile(np.repeat([1e-3, 1.0], [3, 6]), count)
