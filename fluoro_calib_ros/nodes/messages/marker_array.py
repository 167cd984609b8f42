# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""MarkerArray of reconstructed points: covariance ellipsoids for RViz."""

from __future__ import annotations

import numpy as np
from fluoro_calib_msgs.msg import ReconstructedPoints
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from ...photogrammetry.rotations import quaternion_from_matrix
from .reconstructed_points import covariance_of

GREEN = ColorRGBA(r=0.2, g=0.9, b=0.3, a=0.8)
YELLOW = ColorRGBA(r=1.0, g=0.8, b=0.1, a=0.8)
LIFETIME_NS = 500_000_000  # after which RViz removes a marker that is no longer seen


def ellipsoid_markers(
    message: ReconstructedPoints, good: np.ndarray, sigmas: float
) -> MarkerArray:
    """Return the ellipsoids of the good points (indices) of a message.

    sigmas: half axes in standard deviations.
    """
    values, axes = np.linalg.eigh(covariance_of(message)[good])
    axes[:, :, 0] *= np.linalg.det(axes)[:, None]  # a rotation, not a reflection
    attitudes = quaternion_from_matrix(axes).tolist()
    scales = (2 * sigmas * np.sqrt(np.maximum(values, 0))).tolist()
    out = MarkerArray()
    for k, attitude, scale in zip(good.tolist(), attitudes, scales):
        marker = Marker(
            header=message.header, ns='targets', id=int(message.target_id[k]), type=Marker.SPHERE
        )
        position = marker.pose.position
        position.x = message.x[k]
        position.y = message.y[k]
        position.z = message.z[k]
        q = marker.pose.orientation
        q.w, q.x, q.y, q.z = attitude
        marker.scale.x, marker.scale.y, marker.scale.z = scale
        marker.color = GREEN if message.status[k] == message.OK else YELLOW
        marker.lifetime.nanosec = LIFETIME_NS
        out.markers.append(marker)
    return out
