# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""CalibrationStatus (progress of collecting and calibrating, in plain scalars) and DriftStatus."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from fluoro_calib_msgs.msg import CalibrationStatus, DriftStatus
from numpy.typing import NDArray

from ...checks.drift_charts import DriftState
from ...photogrammetry.rig_orientation import RigOrientation
from .observations import stamp_from_nanoseconds

if TYPE_CHECKING:  # not imported by the reconstruction node
    from ...estimation.rounds import Round
    from ...exposures.collector import Readiness

# DriftStatus: the state of the drift watch.

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


@dataclass(frozen=True)
class Collected:
    """Data collected for one fluoroscope."""

    #: counts of frames, and of collected exposures and image points; see `fill_calibration`
    status: CalibrationStatus
    #: whether cells (rows, columns) of the image are covered; None before the first exposure
    covered: NDArray[np.bool_] | None
    image_size: tuple[int, int] | None
    readiness: Readiness

    def values(self) -> dict[str, object]:
        """Return the values for the diagnostics."""
        status = self.status
        return {
            'exposures': status.exposures,
            'coverage': f'{status.coverage:.2f}',
            'ready': self.readiness.ready,
            'next pose': self.readiness.advice,
            'frames received': status.frames_received,
            'frames rejected': status.frames_rejected,
            'frames unpaired': status.frames_unpaired,
        }


def fill_calibration(
    status: CalibrationStatus, calibration_id: str, age_s: float, running: bool, last: Round | None
) -> None:
    """Fill in the progress of the calibration of a fluoroscope.

    calibration_id, age_s: of the calibration in use, '' and NaN if there is none. running: whether
    a self-calibration is running. last: last round of the running or last one, or None.
    """
    status.state = status.CALIBRATED if calibration_id else status.COLLECTING
    if running:
        status.state = status.CALIBRATING
    status.calibration_id = calibration_id
    status.calibration_age = age_s
    if last is not None:
        name = status.fluoroscope
        status.iteration = last.iteration
        status.k = last.k[name]
        status.cost_adjustment = last.F
        status.cost_regression = last.G
        status.rmse_u, status.rmse_v = (float(x) for x in last.rmse[name])
