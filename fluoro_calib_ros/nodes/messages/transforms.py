"""Transforms of TF."""

from __future__ import annotations

from fluoro_calib_msgs.msg import RigOrientation
from geometry_msgs.msg import TransformStamped
from tf2_msgs.msg import TFMessage


def transforms_of_orientation(message: RigOrientation) -> TFMessage:
    """Return the optical frames in the rig frame, without one that is the rig frame itself."""
    out = TFMessage()
    for i, child in enumerate(message.optical_frame_id):
        if child == message.header.frame_id:
            continue
        stamped = TransformStamped(header=message.header, child_frame_id=child)
        for name in 'xyz':
            setattr(stamped.transform.translation, name, getattr(message, name)[i])
        for name in 'xyzw':
            setattr(stamped.transform.rotation, name, getattr(message, f'q{name}')[i])
        out.transforms.append(stamped)
    return out
