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
    if calibrated is not None:
        return _with_corrections(message, rig_frame, calibrated)
    stamp = message.header.stamp
    frame = message.header.frame_id
    out = TFMessage()
    if frame != rig_frame and frame not in message.optical_frame_id:
        out.transforms.append(transform_of(stamp, rig_frame, frame, Pose()))
    for row, child in enumerate(message.optical_frame_id):
        if child != rig_frame:
            out.transforms.append(transform_of(stamp, rig_frame, child, pose_of(message, row)))
    return out


def pose_of(message: RigOrientation | BodyPoses, row: int) -> Pose:
    """Return a pose from the arrays x, y, z, qx, qy, qz and qw of a message."""
    pose = Pose()
    for name in 'xyz':
        setattr(pose.position, name, getattr(message, name)[row])
    for name in 'xyzw':
        setattr(pose.orientation, name, getattr(message, f'q{name}')[row])
    return pose


def transform_of(stamp: Time, parent: str, child: str, pose: Pose) -> TransformStamped:
    """Return the transform of a frame with a pose in its parent."""
    stamped = TransformStamped(header=Header(stamp=stamp, frame_id=parent), child_frame_id=child)
    stamped.transform.rotation = pose.orientation
    for axis in 'xyz':
        setattr(stamped.transform.translation, axis, getattr(pose.position, axis))
    return stamped


def _with_corrections(
    message: RigOrientation, rig_frame: str, calibrated: rig.RigOrientation
) -> TFMessage:
    """Return the transforms of a healed orientation, with frames at the calibrated poses."""
    out = transforms_of_orientation(message, rig_frame)
    before = transforms_of_orientation(message_from_orientation(calibrated), rig_frame)
    earlier = {tf.child_frame_id: tf for tf in before.transforms}
    moved = rig_change(calibrated, content_of_orientation(message))
    for healed in list(out.transforms):
        child = healed.child_frame_id
        if child not in moved or child not in earlier:
            continue
        old = earlier[child]
        old.child_frame_id = healed.header.frame_id = f'{child}{AS_CALIBRATED}'
        out.transforms.append(old)
        (p0, r0), (p1, r1) = (_pose_of(tf) for tf in (old, healed))
        place, turn = r0.T @ (p1 - p0), quaternion_from_matrix(r0.T @ r1)
        for target, names, values in (
            (healed.transform.translation, 'xyz', place),
            (healed.transform.rotation, 'wxyz', turn),
        ):
            for name, value in zip(names, values.tolist()):
                setattr(target, name, value)
    return out


def rig_change(before: rig.RigOrientation, after: rig.RigOrientation) -> dict[str, str]:
    """Return how far optical frames have moved between orientations, as text by frame name."""
    return {
        after.optical_frame_ids[f]: text
        for f, name in enumerate(after.fluoroscopes)
        if (text := _moved_by(before, after, name))
    }


def _pose_of(stamped: TransformStamped) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    place, turn = stamped.transform.translation, stamped.transform.rotation
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
    attitude = quaternion_from_matrix(orientation.rotation.transpose(0, 2, 1))
    for names, columns in (
        (_INTERIOR, orientation.interior.T),
        (_POSITION, orientation.position_mm.T / 1000),
        (_ATTITUDE, attitude.T),
    ):
        for name, column in zip(names, columns):
            setattr(message, name, float64_field(column))
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
    texts = ((name, _moved_by(before, after, name)) for name in after.fluoroscopes)
    return ', '.join(f'{name} by {text}' for name, text in texts if text)


def _moved_by(before: rig.RigOrientation, after: rig.RigOrientation, name: str) -> str:
    """Return how far a fluoroscope has moved between orientations, '' if it has not."""
    if name not in before.fluoroscopes:
        return ''
    f_before, f_after = before.index(name), after.index(name)
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
