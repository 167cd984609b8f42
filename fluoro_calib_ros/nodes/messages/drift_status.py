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

"""DriftStatus: the state of the drift watch."""

from __future__ import annotations

from fluoro_calib_msgs.msg import DriftStatus

from ...drift.state import DriftState
from ...photogrammetry.rig_orientation import RigOrientation
from .fields import stamp_from_nanoseconds

ALARM = DriftStatus.ERROR


def message_from_drift_state(
    state: DriftState, stamp_ns: int, orientation: RigOrientation
) -> DriftStatus:
    """Return the message of a drift state at the stamp of an exposure [ns]."""
    message = DriftStatus(
        level=int(state.level),
        fluoroscope=state.fluoroscope,
        source=state.source,
        message=state.message,
        observations=int(state.observations),
    )
    message.header.stamp = stamp_from_nanoseconds(stamp_ns)
    if state.fluoroscope in orientation.fluoroscopes:
        message.header.frame_id = orientation.optical_frame_ids[
            orientation.index(state.fluoroscope)
        ]
    for name in ('size', 'sd', 'evidence', 'threshold_warn', 'threshold_error'):
        setattr(message, name, float(getattr(state, name)))
    message.u0, message.v0, message.u1, message.v1 = (float(x) for x in state.area)
    message.since = float(state.since_s)
    return message
