# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Static transforms of the optical frames of a rig."""

from __future__ import annotations

from fluoro_calib_msgs.msg import RigOrientation
from geometry_msgs.msg import TransformStamped
from tf2_msgs.msg import TFMessage


def transforms_of_orientation(message: RigOrientation, rig_frame: str) -> TFMessage:
    """Return the optical frames as children of the rig frame.

    An orientation from the calibration is given in the optical frame of its first fluoroscope;
    the rig frame then coincides with it. So every optical frame has the same parent whatever the
    source of the orientation is, and no transform of an earlier one stays valid.
    """
    out = TFMessage()
    given = message.header.frame_id
    if given != rig_frame and given not in message.optical_frame_id:
        out.transforms.append(_transform(message, rig_frame, given))
    for i, child in enumerate(message.optical_frame_id):
        if child == rig_frame:
            continue
        stamped = _transform(message, rig_frame, child)
        for name in 'xyz':
            setattr(stamped.transform.translation, name, getattr(message, name)[i])
        for name in 'xyzw':
            setattr(stamped.transform.rotation, name, getattr(message, f'q{name}')[i])
        out.transforms.append(stamped)
    return out


def _transform(message: RigOrientation, parent: str, child: str) -> TransformStamped:
    """Return the identity with the stamp of a message."""
    stamped = TransformStamped(child_frame_id=child)
    stamped.header.stamp = message.header.stamp
    stamped.header.frame_id = parent
    return stamped
