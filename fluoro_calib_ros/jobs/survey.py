# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The survey job: coordinates of a phantom from its own exposures.

The given coordinates only need to be good enough to find the position of each exposure: to some
centimetres for a phantom of some decimetres. The self-calibration improves them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..brief import brief_repr
from ..checks.check import Check, Validation, not_made, verdict_of
from ..checks.survey import (
    check_survey,
    check_survey_halves,
    displaced,
    trusted_scale,
    unsurveyed,
)
from ..errors import DataError
from ..estimation.calibrate import calibrate_request
from ..estimation.options import CalibrationOptions, CalibrationRequest
from ..estimation.result import CalibrationResult
from ..estimation.rounds import Round
from ..estimation.survey import MeasuredDistance, SurveyedBeads, surveyed_beads
from ..exposures.collector import MIN_EXPOSURES
from ..exposures.frame import Frames
from ..exposures.phantom import EXACT_SD_MM, MIN_TARGETS, Phantom
from ..findings import Finding, Kind, Severity, too_few
from ..rows import chosen_rows
from .calibration import run_calibration


@dataclass(frozen=True)
class SurveyRequest:
    """Exposures of a phantom that is to be surveyed.

    Attributes
    ----------
    frames : mapping of str to sequence of Frame
        By fluoroscope; all are adjusted together.
    given : Phantom
        Coordinates and standard deviations as far as known, from a drawing or a ruler.
    distances : sequence of MeasuredDistance
        Two or more, for scale and check.
    options : CalibrationOptions
        Of the self-calibration; the datum is that of a free network.
    principal_distance : float or None
        Initial value [px]; None: derived from the observations.
    keep_given : bool
        Whether beads that cannot be surveyed keep their given coordinates; else they are omitted.
    """

    __repr__ = brief_repr

    frames: Frames
    given: Phantom
    distances: Sequence[MeasuredDistance] = ()
    options: CalibrationOptions = field(default_factory=CalibrationOptions)
    principal_distance: float | None = None
    keep_given: bool = False

    def calibration_of(self, frames: Frames, phantom: Phantom) -> CalibrationRequest:
        """Return the request for the free network of some exposures."""
        return CalibrationRequest(
            frames,
            phantom,
            replace(self.options, datum='inner'),
            joint=True,
            principal_distance=self.principal_distance,
        )


@dataclass(frozen=True)
class SurveyOutcome:
    """Surveyed phantom.

    Attributes
    ----------
    phantom : Phantom
    beads : SurveyedBeads
        The beads that were surveyed.
    validation : Validation
        Verdict on the survey.
    findings : tuple of Finding
        What was excluded, and where the given coordinates are wrong.
    result : CalibrationResult
        The underlying self-calibration.
    """

    __repr__ = brief_repr

    phantom: Phantom
    beads: SurveyedBeads
    validation: Validation
    findings: tuple[Finding, ...]
    result: CalibrationResult


def survey(
    request: SurveyRequest,
    progress: Callable[[str, Round], None] | None = None,
) -> SurveyOutcome:
    """Survey a phantom from its own exposures.

    Parameters
    ----------
    request : SurveyRequest
    progress : callable, optional
        Called after every round with the names of the fluoroscopes and the Round; may raise to
        stop.

    Raises
    ------
    DataError
        For exposures that do not determine coordinates, interior orientation and distortion, that
        cannot be of the phantom, or that show too few beads well.
    """
    began = time.perf_counter()
    _require_known(request)
    result = _free_network(request, progress)
    if not result.converged:
        raise DataError(
            'the adjustment did not converge: the exposures hardly determine coordinates, '
            'interior orientation and distortion together',
            kind=Kind.UNDETERMINED,
            advice='turn and move the phantom more between the exposures',
        )
    surveyed = surveyed_beads(result, request.given, request.distances)
    left_out = unsurveyed(surveyed)
    beads = _without(surveyed, left_out)
    checks = check_survey(surveyed)
    if len(beads.target_id) < MIN_TARGETS:
        raise DataError(
            f'only {len(beads.target_id)} beads can be surveyed',
            *(replace(finding, severity=Severity.ERROR) for finding in left_out),
            kind=Kind.FEW_TARGETS,
        )
    checks.append(_halves(request, result))
    displacement = displaced(beads)
    return SurveyOutcome(
        _phantom(request, beads),
        beads,
        Validation(
            verdict_of(checks),
            tuple(checks),
            {},
            time.perf_counter() - began,
            notes=tuple(trusted_scale(beads)),
        ),
        (*result.findings, *left_out, *([] if displacement is None else [displacement])),
        result,
    )


def _require_known(request: SurveyRequest) -> None:
    """Raise DataError for a distance to a bead that the phantom does not have."""
    for distance in request.distances:
        for bead in (distance.first, distance.second):
            if request.given.index([bead])[0] < 0:
                raise DataError(
                    f'{distance.name}: bead {bead} is not on the phantom', kind=Kind.NOT_IN_BOTH
                )


def _free_network(
    request: SurveyRequest,
    progress: Callable[[str, Round], None] | None,
) -> CalibrationResult:
    """Self-calibrate with inner constraints; if needed, improve rough coordinates and retry.

    Raises DataError.
    """

    def adjusted(initial: Phantom, force: bool) -> CalibrationResult:
        return run_calibration(
            request.calibration_of(request.frames, initial),
            force=force,
            progress=progress,
        ).result

    try:
        return adjusted(request.given, force=False)
    except DataError as error:
        # Exposures that do not fit the given coordinates may fit those found from the images.
        if any(finding.kind is not Kind.OTHER_PHANTOM for finding in error.findings):
            raise
        refused = error
    try:
        rough = adjusted(request.given, force=True)
        return adjusted(_with_adjusted(request.given, rough), force=False)
    except DataError:
        raise refused from None


def _with_adjusted(initial: Phantom, result: CalibrationResult) -> Phantom:
    """Return the given coordinates, replaced where an adjustment found others."""
    xyz = initial.xyz_mm.copy()
    xyz[initial.index(result.targets.target_id)] = result.targets.xyz_mm
    return replace(initial, xyz_mm=xyz)


def _halves(
    request: SurveyRequest,
    result: CalibrationResult,
) -> Check:
    """Compare two surveys, each from every second exposure."""
    numbers = sorted(
        {e.exposure for fluoroscope in result.fluoroscopes.values() for e in fluoroscope.exposures}
    )
    fewest = min(len(fluoroscope.exposures) for fluoroscope in result.fluoroscopes.values())
    if fewest < 2 * MIN_EXPOSURES:
        reason = f'{too_few(fewest, "exposure")} for two halves of {MIN_EXPOSURES} or more'
        return not_made(Kind.HALVES, reason)
    # Start from the better coordinates found so far. The scale is not compared, so exclude its
    # uncertainty.
    start = replace(
        _with_adjusted(request.given, result), sd_mm=np.full(len(request.given.sd_mm), EXACT_SD_MM)
    )
    surveys = []
    for half in (set(numbers[::2]), set(numbers[1::2])):
        frames = {
            name: [frame for frame in exposures if frame.number in half]
            for name, exposures in request.frames.items()
        }
        try:
            half_result = calibrate_request(request.calibration_of(frames, start), None)
        except (DataError, np.linalg.LinAlgError) as error:
            return not_made(Kind.HALVES, f'half of the exposures cannot be adjusted ({error})')
        beads = surveyed_beads(half_result, start)
        surveys.append(_without(beads, unsurveyed(beads)))
    return check_survey_halves(*surveys)


def _without(beads: SurveyedBeads, findings: Sequence[Finding]) -> SurveyedBeads:
    """Return the beads without those that findings name."""
    return beads.without({target for finding in findings for target in finding.place.target_id})


def _phantom(request: SurveyRequest, beads: SurveyedBeads) -> Phantom:
    """Return the phantom with the surveyed coordinates."""
    given = request.given
    row = given.index(beads.target_id)
    surveyed_mm = np.round(beads.xyz_mm, 6)
    surveyed_sd = np.maximum(np.round(beads.sd_mm, 6), EXACT_SD_MM)
    if not request.keep_given:
        return replace(chosen_rows(given, row), xyz_mm=surveyed_mm, sd_mm=surveyed_sd)
    # Assume given coordinates as far off as those of surveyed beads were, if not more by their sd.
    deviation_mm = float(np.sqrt(np.mean(beads.off_mm**2) / 3))
    xyz = given.xyz_mm.copy()
    sd = np.maximum(given.sd_mm, deviation_mm)
    xyz[row] = surveyed_mm
    sd[row] = surveyed_sd
    return replace(given, xyz_mm=xyz, sd_mm=sd)
