# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The survey job: coordinates of a phantom from its own exposures.

The given coordinates only need to be good enough to find the position of each exposure: to some
centimetres for a phantom of some decimetres. Without any, the shape is found from the image points
first. The self-calibration improves them.
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
    taken_on_trust,
    unsurveyed,
)
from ..errors import DataError
from ..estimation.calibrate import calibrate_request
from ..estimation.options import CalibrationOptions, CalibrationRequest
from ..estimation.result import CalibrationResult
from ..estimation.rounds import Round
from ..estimation.start_shape import start_shape
from ..estimation.survey import MeasuredDistance, SurveyedBeads, surveyed_beads
from ..exposures.collector import MIN_EXPOSURES
from ..exposures.frame import Frames, frames_without_strays, validate_frame
from ..exposures.phantom import EXACT_SD_MM, MIN_TARGETS, Phantom
from ..findings import Finding, Kind, Place, Severity, first_few, too_few
from ..photogrammetry.network import MIN_RAYS
from ..rows import chosen_rows
from .calibration import run_calibration


@dataclass(frozen=True)
class SurveyRequest:
    """Exposures of a phantom that is to be surveyed.

    Attributes
    ----------
    frames : mapping of str to sequence of Frame
        By fluoroscope; all are adjusted together.
    given : Phantom or None
        Coordinates and standard deviations as far as known, from a drawing or a ruler; None if
        nothing is known.
    distances : sequence of MeasuredDistance
        Two or more, for scale and check; one is required where nothing else is known.
    options : CalibrationOptions
        Of the self-calibration; the datum is that of a free network.
    principal_distance : float or None
        Initial value [px]; None: derived from the observations.
    keep_given : bool
        Whether beads that cannot be surveyed keep their given coordinates; else they are omitted.
    """

    __repr__ = brief_repr

    frames: Frames
    given: Phantom | None
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
    is_given = request.given is not None
    found: list[Finding] = []
    if not is_given:
        request, found = _with_shape(request)
    given = request.given
    assert given is not None
    _require_known(request, given)
    result = _free_network(request, given, progress)
    if not result.converged:
        raise DataError(
            'the adjustment did not converge: the exposures hardly determine coordinates, '
            'interior orientation and distortion together',
            kind=Kind.UNDETERMINED,
            advice='turn and move the phantom more between the exposures',
        )
    surveyed = surveyed_beads(result, given, request.distances)
    left_out = unsurveyed(surveyed)
    beads = _without(surveyed, left_out)
    checks = check_survey(surveyed, is_given)
    if len(beads.target_id) < MIN_TARGETS:
        raise DataError(
            f'only {len(beads.target_id)} beads can be surveyed',
            *(replace(finding, severity=Severity.ERROR) for finding in left_out),
            kind=Kind.FEW_TARGETS,
        )
    checks.append(_halves(request, given, result))
    displacement = displaced(beads) if is_given else None
    return SurveyOutcome(
        _phantom(given, beads, request.keep_given and is_given),
        beads,
        Validation(
            verdict_of(checks),
            tuple(checks),
            {},
            time.perf_counter() - began,
            notes=tuple(taken_on_trust(beads, is_given)),
        ),
        (*found, *result.findings, *left_out, *([] if displacement is None else [displacement])),
        result,
    )


def _with_shape(request: SurveyRequest) -> tuple[SurveyRequest, list[Finding]]:
    """Return the request with the shape of the targets, at the scale of the distances.

    Also return findings on image points that are not used. Raises DataError.
    """
    if not request.distances:
        raise DataError(
            'without given coordinates, images do not show the scale of the phantom',
            kind=Kind.DISTANCES,
            advice='measure two distances or more between beads that are far apart, and give them',
        )
    shown = [frame.target_id for view in request.frames.values() for frame in view]
    if not shown:
        raise DataError('there are no exposures', kind=Kind.FEW_EXPOSURES)
    ids = np.unique(np.concatenate(shown))
    unknown = Phantom(ids, np.zeros((len(ids), 3)), np.ones(len(ids)))
    frames, findings = frames_without_strays(request.frames, unknown)
    for view_frames in frames.values():
        for frame in view_frames:
            validate_frame(frame, unknown)
    principal = request.principal_distance
    shape = start_shape(frames, None if principal is None else dict.fromkeys(frames, principal))
    sd = np.full(len(shape.target_id), max(shape.sd, EXACT_SD_MM))
    phantom = Phantom(shape.target_id, shape.xyz, sd)
    _require_known(request, phantom)
    ends = np.array([(one.first, one.second) for one in request.distances])
    lengths = np.linalg.norm(np.subtract(*shape.xyz[phantom.index(ends).T]), axis=1)
    scale = np.median([one.length_mm for one in request.distances] / lengths)
    given = replace(phantom, xyz_mm=scale * shape.xyz, sd_mm=scale * sd)
    left_out = np.setdiff1d(ids, shape.target_id)
    if len(left_out):
        findings.append(
            Finding(
                Kind.FEW_RAYS,
                f'{len(left_out)} targets are seen in fewer than {MIN_RAYS} exposures, too few to '
                f'determine them: {first_few(left_out)}',
                Place(target_id=tuple(left_out.tolist())),
                severity=Severity.NOTE,
            )
        )
    used = {
        name: [chosen_rows(f, np.isin(f.target_id, shape.target_id)) for f in view_frames]
        for name, view_frames in frames.items()
    }
    return replace(request, frames=used, given=given), findings


def _require_known(request: SurveyRequest, given: Phantom) -> None:
    """Raise DataError for a distance to a bead that the phantom does not have."""
    for distance in request.distances:
        for bead in (distance.first, distance.second):
            if given.index([bead])[0] < 0:
                raise DataError(
                    f'{distance.name}: bead {bead} is not on the phantom', kind=Kind.NOT_IN_BOTH
                )


def _free_network(
    request: SurveyRequest,
    given: Phantom,
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
        return adjusted(given, force=False)
    except DataError as error:
        # Exposures that do not fit the given coordinates may fit those found from the images.
        if any(finding.kind is not Kind.OTHER_PHANTOM for finding in error.findings):
            raise
        refused = error
    try:
        rough = adjusted(given, force=True)
        return adjusted(_with_adjusted(given, rough), force=False)
    except DataError:
        raise refused from None


def _with_adjusted(initial: Phantom, result: CalibrationResult) -> Phantom:
    """Return the given coordinates, replaced where an adjustment found others."""
    xyz = initial.xyz_mm.copy()
    xyz[initial.index(result.targets.target_id)] = result.targets.xyz_mm
    return replace(initial, xyz_mm=xyz)


def _halves(
    request: SurveyRequest,
    given: Phantom,
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
    start = replace(_with_adjusted(given, result), sd_mm=np.full(len(given.sd_mm), EXACT_SD_MM))
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


def _phantom(given: Phantom, beads: SurveyedBeads, keep_given: bool) -> Phantom:
    """Return the phantom with the surveyed coordinates; keep_given: with all its beads."""
    row = given.index(beads.target_id)
    surveyed_mm = np.round(beads.xyz_mm, 6)
    surveyed_sd = np.maximum(np.round(beads.sd_mm, 6), EXACT_SD_MM)
    if not keep_given:
        return replace(chosen_rows(given, row), xyz_mm=surveyed_mm, sd_mm=surveyed_sd)
    # Assume given coordinates as far off as those of surveyed beads were, if not more by their sd.
    deviation_mm = float(np.sqrt(np.mean(beads.off_mm**2) / 3))
    xyz = given.xyz_mm.copy()
    sd = np.maximum(given.sd_mm, deviation_mm)
    xyz[row] = surveyed_mm
    sd[row] = surveyed_sd
    return replace(given, xyz_mm=xyz, sd_mm=sd)
