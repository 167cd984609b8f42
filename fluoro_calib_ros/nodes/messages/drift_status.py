# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

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
