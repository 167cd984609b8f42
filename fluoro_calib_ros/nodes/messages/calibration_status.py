# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""CalibrationStatus: progress of collecting and calibrating, in plain scalars."""

from __future__ import annotations

import math
from dataclasses import dataclass

from builtin_interfaces.msg import Time
from fluoro_calib_msgs.msg import CalibrationStatus

from ...calibration.result import FluoroscopeCalibration
from ...calibration.rounds import Round


@dataclass(frozen=True)
class FluoroscopeProgress:
    """What the calibration node knows of one fluoroscope.

    Attributes
    ----------
    fluoroscope : str
    frames_received, frames_rejected, frames_unpaired : int
    exposures, observations : int
        Collected exposures, and the image points in them.
    coverage : float
        Covered part of the image, 0 to 1.
    is_calibrating : bool
    last_round : Round or None
        Last round of the running or last self-calibration.
    calibration : FluoroscopeCalibration or None
    calibration_age_s : float
    """

    fluoroscope: str
    frames_received: int
    frames_rejected: int
    frames_unpaired: int
    exposures: int
    observations: int
    coverage: float = 0.0
    is_calibrating: bool = False
    last_round: Round | None = None
    calibration: FluoroscopeCalibration | None = None
    calibration_age_s: float = math.nan

    @property
    def calibration_id(self) -> str:
        """Id of the calibration, empty without one."""
        return self.calibration.calibration_id if self.calibration else ''


def message_from_progress(progress: FluoroscopeProgress, stamp: Time) -> CalibrationStatus:
    """Return the message of the progress of one fluoroscope."""
    message = CalibrationStatus(
        fluoroscope=progress.fluoroscope,
        state=_state_of(progress),
        frames_received=progress.frames_received,
        frames_rejected=progress.frames_rejected,
        frames_unpaired=progress.frames_unpaired,
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


def _state_of(progress: FluoroscopeProgress) -> int:
    if progress.is_calibrating:
        return CalibrationStatus.CALIBRATING
    if progress.calibration is not None:
        return CalibrationStatus.CALIBRATED
    return CalibrationStatus.COLLECTING
