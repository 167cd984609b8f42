# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The verdict on a calibration from the exposures it was made from: pass, fail or cannot tell.

A given interior orientation may be why a calibration fails. If it is given with a small standard
deviation, it fixes the adjustment where the exposures contradict it: the lack of fit looks like a
trend of the residuals, or like a distortion that differs between exposures. If checks fail, the
fluoroscope is calibrated again without the given values. If the residuals are then clearly
smaller, and the interior orientation is clearly different, the given values are the cause, which a
separate check reports.

The interior orientation of an image with distortion depends on the definition of distortion. A
given one which the exposures move away from, with good residuals, is therefore no fault.

Every check is a number with a limit. docs/verdict.md describes how the limits were found, how
often good calibrations exceed them and how large a fault must be to be detected. `validate`
recalibrates two halves and four folds of the exposures, in about twice the time of the
calibration.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ..correction.fluoroscope_calibration import Calibrations, FluoroscopeCalibration, ids_of
from ..errors import DataError
from ..estimation.calibrate import adjust_with_calibrations
from ..estimation.initial_network import nominal_interior
from ..estimation.options import CalibrationRequest
from ..estimation.result import CalibrationResult
from ..exposures.frame import Frame, Frames
from ..findings import Finding, Kind, Place, Severity
from ..photogrammetry.noise import CERTAIN
from .beads import BEADS
from .calibration_evidence import Evidence
from .check import Check, Validation, rms, verdict_of
from .field_checks import HALVES, PRECISION, TRENDS, VARIATION
from .held_out import HELD_OUT
from .rig import RigFindings, check_rig, rig_findings
from .shape import SHAPE, trusted_shape

REPAIR_FIRST = 'check this again when the given interior orientation fits the exposures'
# Minimum ratio of the RMSE with and without the given values to accept them as the cause. Without
# a correction model, distortion is the more likely cause.
MIN_GAIN = 1.05
MIN_GAIN_UNCORRECTED = 2.0
LABELS = ('xp', 'yp', 'c')


def with_given_interior(evidence: Evidence, checks: Sequence[Check]) -> list[Check]:
    """Return the checks, plus one for every given interior orientation that is contradicted.

    The estimated noise can absorb the misfit, so that no other check fails. Checks that do fail
    then get the advice to repair the interior orientation first.
    """
    contradictions: list[Check] = []
    for names in _given_groups(evidence.request):
        contradictions += _contradictions(evidence, names)
    if not contradictions:
        return list(checks)
    contradicted = {'', *(check.place.fluoroscope for check in contradictions)}
    remaining = [
        replace(check, advice=REPAIR_FIRST)
        if check.passed is False and check.place.fluoroscope in contradicted
        else check
        for check in checks
    ]
    return [*contradictions, *remaining]


def _given_groups(request: CalibrationRequest) -> list[tuple[str, ...]]:
    """Return the fluoroscopes of each adjustment to which an interior orientation is given."""
    if request.options.interior_sd is None or request.principal_distance is None:
        return []
    known = request.known_orientations
    groups = (tuple(name for name in names if name not in known) for names in request.groups)
    return [names for names in groups if names]


def _contradictions(evidence: Evidence, names: Sequence[str]) -> list[Check]:
    """Return a failed check for every fluoroscope whose exposures contradict the given values."""
    evidence.report_step(f'{"+".join(names)}: interior orientation without the given values')
    try:
        free = evidence.calibrate_free(names)
    except DataError:
        return []
    distance = evidence.request.principal_distance
    assert distance is not None
    checks = [_given_interior_check(evidence, name, free[name], distance) for name in names]
    return [check for check in checks if check is not None]


def _given_interior_check(
    evidence: Evidence, name: str, free: FluoroscopeCalibration, distance: float
) -> Check | None:
    calibration = evidence.calibrations[name]
    rmse, rmse_free = rms(calibration.rmse_after), rms(free.rmse_after)
    gain = rmse / rmse_free
    given_interior = nominal_interior(calibration.image_size, distance)
    given_sd = np.asarray(evidence.request.options.interior_sd)
    sd = np.sqrt(np.diag(free.interior_covariance))
    deviation = np.abs(free.interior - given_interior) / np.hypot(given_sd, sd)
    min_gain = MIN_GAIN if calibration.model.corrects else MIN_GAIN_UNCORRECTED
    if not gain > min_gain or not deviation.max() > CERTAIN:
        return None
    deviating = [i for i in np.argsort(-deviation) if deviation[i] > CERTAIN]
    stated = ', '.join(
        f'{LABELS[i]} = {given_interior[i]:.1f} (sd {given_sd[i]:g})' for i in deviating
    )
    shown = ', '.join(f'{LABELS[i]} = {free.interior[i]:.1f} (sd {sd[i]:.1f})' for i in deviating)
    return Check(
        Kind.GIVEN_INTERIOR,
        f'the given interior orientation, {stated} px, contradicts the exposures, which show '
        f'{shown} px: the residuals are {rmse:.2f} px with the given values and {rmse_free:.2f} '
        'px without',
        Place((name,)),
        'give the correct value, a larger --interior-sd, or none',
        numbers={
            **{f'{label}_px': float(x) for label, x in zip(LABELS, free.interior)},
            **{f'sd_{label}_px': float(x) for label, x in zip(LABELS, sd)},
        },
        value=deviation.max(),
        limit=CERTAIN,
        unit='sd',
    )


Progress = Callable[[str, int, int], None]

# A new check is a module with a Subject and an entry here; docs/verdict.md describes it.
SUBJECTS = (BEADS, SHAPE, HALVES, TRENDS, VARIATION, HELD_OUT, PRECISION)


def validate(
    request: CalibrationRequest,
    calibrations: Calibrations,
    progress: Progress | None = None,
    rig: RigFindings | None = None,
) -> Validation:
    """Validate calibrations with the exposures they were made from.

    Parameters
    ----------
    request : CalibrationRequest
        Data and options of the calibrations.
    calibrations : mapping of str to FluoroscopeCalibration
        Calibrations by fluoroscope.
    progress : callable, optional
        Called with the name of a step, the number of steps done and their total before each step.
    rig : RigFindings, optional
        Orientation of the rig and doubts about it; by default they are determined.

    Raises
    ------
    DataError
        For frames that cannot be adjusted with the calibrations.
    """
    began = time.perf_counter()
    result = adjust_with_calibrations(
        request.frames,
        request.phantom,
        calibrations=calibrations,
        loss=request.options.loss,
        known=request.known_orientations,
    )
    request = replace(request, frames=_used_frames(request.frames, result))
    runs = [(subject, tuple(request.frames)) for subject in SUBJECTS if subject.of_rig]
    runs += [(s, names) for names in request.groups for s in SUBJECTS if not s.of_rig]
    total = 1 + sum(subject.steps for subject, _ in runs) + len(_given_groups(request))
    number = itertools.count()

    def report(step: str) -> None:
        if progress is not None:
            progress(step, next(number), total)

    evidence = Evidence(request, calibrations, result, report)
    report('residuals and beads')
    checks = [check for subject, names in runs for check in subject.run(evidence, names)]
    checks = with_given_interior(evidence, checks)
    # One fluoroscope after the other, then the rig.
    order = [*(name for names in request.groups for name in names), '']
    checks = [check for name in order for check in checks if check.place.fluoroscope == name]
    rig = rig or rig_findings(request, result, request.frames, calibrations)
    checks += check_rig(rig)
    return Validation(
        verdict_of(checks),
        tuple(checks),
        ids_of(calibrations),
        seconds=time.perf_counter() - began,
        achieved_sd_px={name: _achieved_sd(evidence, name, checks) for name in request.frames},
        notes=(*rig.notes, *trusted_shape(checks), *trusted_angles(calibrations)),
    )


# NSE of a correction at an angle that errors drawn from its covariance exceed in MANY_PERCENT of a
# hundred calibrations (docs/how_good.md, a C-arm that turns).
MANY_NSE = 2.0
MANY_PERCENT = 7


def trusted_angles(calibrations: Calibrations) -> list[Finding]:
    """Return a finding for each correction that changes with the angle of a C-arm."""
    return [
        Finding(
            Kind.TAKEN_ON_TRUST,
            'most of the error of the correction at an angle of the C-arm comes from one '
            'quantity, the change of the principal distance over the range of angles: in '
            f'{MANY_PERCENT} of 100 calibrations, errors are more than {np.sqrt(MANY_NSE):.1f} '
            'times the standard deviations',
            Place((name,)),
            severity=Severity.NOTE,
            numbers={'nse': MANY_NSE, 'share': MANY_PERCENT / 100},
        )
        for name, calibration in calibrations.items()
        if calibration.angle_field is not None
    ]


def _achieved_sd(evidence: Evidence, name: str, checks: Sequence[Check]) -> float:
    """Return the standard deviation of a coordinate of a fluoroscope's correction [px].

    It is the claimed one, times the ratio of difference and prediction of its halves if this is
    above 1, combined with the trend and the variation in the residuals.
    """
    values = {
        check.kind: check.value
        for check in checks
        if check.place.fluoroscope == name and np.isfinite(check.value)
    }
    trend = evidence.trends[name]
    correction_sd = trend.claimed_sd * max(1.0, values.get(Kind.HALVES, 1.0))
    parts = (correction_sd, values.get(Kind.WHITENESS, 0.0), values.get(Kind.VARIATION, 0.0))
    return float(np.linalg.norm(parts))


def validate_or_report(
    request: CalibrationRequest,
    calibrations: Calibrations,
    progress: Progress | None = None,
    rig: RigFindings | None = None,
) -> Validation:
    """Validate; on DataError the verdict is 'cannot tell' with its message."""
    try:
        return validate(request, calibrations, progress, rig)
    except DataError as error:
        check = Check(Kind.VALIDATION, f'the validation could not be performed: {error}')
        return Validation('cannot tell', (check,), ids_of(calibrations), 0.0)


def _used_frames(frames: Frames, result: CalibrationResult) -> dict[str, list[Frame]]:
    """Return the frames that an adjustment used, in the order of their numbers."""
    out = {}
    for name, exposures in frames.items():
        numbers = {e.exposure for e in result.fluoroscopes[name].exposures}
        out[name] = sorted((f for f in exposures if f.number in numbers), key=lambda f: f.number)
    return out
