# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Calibrate.srv, SelfCalibrate.action (which share request and result) and Heal.action."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from fluoro_calib_msgs.action import Heal, SelfCalibrate

from ...checks.check import Validation
from ...correction.fluoroscope_calibration import Calibrations
from ...estimation.options import CalibrationOptions
from ...estimation.result import CalibrationResult
from ...estimation.rounds import Round
from ...findings import sentences
from ...jobs.healing import CHANGED_MEANWHILE, HealingOutcome
from ...photogrammetry.rig_orientation import RigOrientation

Request = Any  # Calibrate.Request or SelfCalibrate.Goal
Result = Any  # Calibrate.Response or SelfCalibrate.Result

_REQUESTED = ('model', 'interior', 'loss', 'max_iterations')


def options_of_request(
    request: Request, defaults: CalibrationOptions, joint: bool
) -> CalibrationOptions:
    """Return the options of a request, with defaults for those that it leaves open.

    Raises ValueError for invalid options.
    """
    if request.principal_distance < 0 or not np.isfinite(request.principal_distance):
        raise ValueError(
            f'principal_distance must be a length in pixels, not {request.principal_distance}'
        )
    requested = {name: getattr(request, name) or getattr(defaults, name) for name in _REQUESTED}
    if not joint:
        requested['relative_orientation'] = 'none'
    return replace(defaults, **requested)


def feedback_of_round(label: str, last: Round) -> SelfCalibrate.Feedback:
    """Return the feedback of a round for the fluoroscopes named by the label."""
    mean_square = np.mean([np.square(rmse) for rmse in last.rmse.values()], axis=0)
    rmse_u, rmse_v = (float(x) for x in np.sqrt(mean_square))
    return SelfCalibrate.Feedback(
        fluoroscope=label,
        iteration=last.iteration,
        cost_adjustment=last.F,
        cost_regression=last.G,
        k=max(last.k.values()),
        rmse_u=rmse_u,
        rmse_v=rmse_v,
    )


def feedback_text(feedback: SelfCalibrate.Feedback) -> str:
    """Return the feedback of a round or step as a line of text."""
    if feedback.stage:
        return f'verdict: {100 * feedback.step // feedback.steps} %, {feedback.stage}'
    neighbours = f'k {feedback.k:3d}  ' if feedback.k else ''
    return (
        f'fluoroscope {feedback.fluoroscope}  round {feedback.iteration:2d}  '
        f'{neighbours}RMSE {feedback.rmse_u:.3f} {feedback.rmse_v:.3f} px'
    )


def fill_result(result: Result, job: CalibrationResult, calibrations: Calibrations) -> None:
    """Fill in the result of a successful calibration."""
    result.success = True
    result.seconds = job.seconds
    for name, calibration in calibrations.items():
        sd = np.sqrt(np.diagonal(calibration.interior_covariance))
        result.fluoroscope = [*result.fluoroscope, name]
        result.calibration_id = [*result.calibration_id, calibration.calibration_id]
        result.model_kind = [*result.model_kind, calibration.model.kind]
        result.converged = [*result.converged, calibration.converged]
        result.k.append(calibration.model.k)
        for field in ('iterations', 'observations', 'inliers'):
            getattr(result, field).append(getattr(calibration, field))
        for fields, values in (
            ('xp yp c', calibration.interior),
            ('sd_xp sd_yp sd_c', sd),
            ('rmse_before_u rmse_before_v', calibration.rmse_before),
            ('rmse_after_u rmse_after_v', calibration.rmse_after),
        ):
            for field, value in zip(fields.split(), values):
                getattr(result, field).append(float(value))
    note = '' if job.converged else ' (stopped at the maximum number of rounds, not converged)'
    result.message = f'{", ".join(calibrations)} calibrated in {job.seconds:.1f} s{note}'


def fill_verdict(result: Result, validation: Validation) -> None:
    """Fill in the verdict on a successful calibration."""
    result.verdict = validation.verdict
    result.findings = sentences(validation.findings)
    result.message += f'; verdict: {validation.verdict}'


# Heal.action: changes of a rig.


def fill_healing(result: Heal.Result, outcome: HealingOutcome, parent: RigOrientation) -> None:
    """Fill in the result of a diagnosis. parent: the orientation before healing."""
    result.success = True
    result.verdict = outcome.verdict
    result.parent_orientation_id = parent.orientation_id
    result.findings = sentences(outcome.findings)
    result.probability = [float(probability) for probability in outcome.diagnosis.probability]
    result.checks = [check.sentence for check in outcome.checks if not check.passed]
    result.exposures = outcome.exposures
    result.place_sd_mm = float(outcome.after.place_mm)
    result.scale_sd = float(outcome.after.scale)
    healed = outcome.healed
    if healed is not None:
        result.orientation_id = outcome.orientation.orientation_id
        for f, name in enumerate(outcome.orientation.fluoroscopes):
            if healed.changes[f].any() or f in healed.drift:  # changed fluoroscopes only
                result.fluoroscope = [*result.fluoroscope, name]
                result.distortion = [*result.distortion, f in healed.drift]
                result.change = [*result.change, *healed.changes[f].tolist()]
                result.sd = [*result.sd, *healed.sd[f].tolist()]
    statements = list(result.findings)
    if outcome.changed_meanwhile:
        statements.insert(0, CHANGED_MEANWHILE)
    result.message = '; '.join(
        [
            *(statements or ['no change is evident']),
            outcome.common_motion.sentence,
            outcome.unseen_distortion.sentence,
            f'verdict: {outcome.verdict}',
        ]
    )


def healing_text(feedback: Heal.Feedback) -> str:
    """Return the feedback of a healing as a line of text."""
    if feedback.stage == 'collecting':
        return f'healing: {feedback.frames} frames of markers'
    return f'healing: diagnosis, step {feedback.step} of {feedback.steps}'
