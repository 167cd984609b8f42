# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""CalibrationStatus (progress of collecting and calibrating, in plain scalars) and DriftStatus."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from builtin_interfaces.msg import Time
from fluoro_calib_msgs.msg import CalibrationStatus, DriftStatus
from numpy.typing import NDArray

from ...checks.drift_charts import DriftState
from ...correction.fluoroscope_calibration import FluoroscopeCalibration
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
class Progress:
    """Data collected for one fluoroscope, and the progress of its calibration."""

    fluoroscope: str
    #: numbers of frames
    received: int
    rejected: int
    unpaired: int
    #: numbers of collected exposures and of image points in them
    exposures: int
    observations: int
    coverage: float  #: covered part of the image, 0 to 1
    #: whether cells (rows, columns) of the image are covered; None before the first exposure
    covered: NDArray[np.bool_] | None
    image_size: tuple[int, int] | None
    readiness: Readiness
    is_calibrating: bool = False
    last_round: Round | None = None  #: last round of the running or last self-calibration
    calibration: FluoroscopeCalibration | None = None
    calibration_age_s: float = math.nan

    @property
    def calibration_id(self) -> str:
        """Id of the calibration, '' if there is none."""
        return self.calibration.calibration_id if self.calibration else ''

    def values(self) -> dict[str, object]:
        """Return the values for the diagnostics."""
        return {
            'exposures': self.exposures,
            'coverage': f'{self.coverage:.2f}',
            'ready': self.readiness.ready,
            'next pose': self.readiness.advice,
            'frames received': self.received,
            'frames rejected': self.rejected,
            'frames unpaired': self.unpaired,
        }


def message_from_progress(progress: Progress, stamp: Time) -> CalibrationStatus:
    """Return the message of the progress of one fluoroscope."""
    state = CalibrationStatus.COLLECTING
    if progress.is_calibrating:
        state = CalibrationStatus.CALIBRATING
    elif progress.calibration is not None:
        state = CalibrationStatus.CALIBRATED
    message = CalibrationStatus(
        fluoroscope=progress.fluoroscope,
        state=state,
        frames_received=progress.received,
        frames_rejected=progress.rejected,
        frames_unpaired=progress.unpaired,
        exposures=progress.exposures,
        observations=progress.observations,
        coverage=progress.coverage,
        calibration_age=progress.calibration_age_s,
        calibration_id=progress.calibration_id,
    )
    message.header.stamp = stamp
    message.header.frame_id = f'{progress.fluoroscope}_optical'
    last = progress.last_round
    if last is not None:
        message.iteration = last.iteration
        message.k = last.k[progress.fluoroscope]
        message.cost_adjustment = last.F
        message.cost_regression = last.G
        message.rmse_u, message.rmse_v = (float(x) for x in last.rmse[progress.fluoroscope])
    return message
