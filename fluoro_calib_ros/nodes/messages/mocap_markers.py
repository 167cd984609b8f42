# Copyright 2026 fluoro_calib_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

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
