# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""mocap4r2 Markers of reconstructed points, where mocap4r2_msgs is installed."""

from __future__ import annotations

import numpy as np
from fluoro_calib_msgs.msg import ReconstructedPoints
from geometry_msgs.msg import Point

try:
    from mocap4r2_msgs.msg import Marker as MocapMarker
    from mocap4r2_msgs.msg import Markers as MocapMarkers
except ImportError:
    MocapMarker = MocapMarkers = None


def mocap_markers(message: ReconstructedPoints, good: np.ndarray) -> MocapMarkers:
    """Return the good points (indices) of a message; the index of each is its target id."""
    out = MocapMarkers(header=message.header, frame_number=message.frame_number)
    for k in good.tolist():
        out.markers.append(
            MocapMarker(
                id_type=MocapMarker.USE_INDEX,
                marker_index=int(message.target_id[k]),
                translation=Point(x=message.x[k], y=message.y[k], z=message.z[k]),
            )
        )
    return out
