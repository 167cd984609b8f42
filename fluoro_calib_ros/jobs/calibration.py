# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The calibration job: self-calibrate, orient the rig, validate.

The command line, the calibration node, its worker process and Python users all call
`run_calibration`; `result_folder.save_outcome` writes its outcome.
"""

from __future__ import annotations

import html
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from ..checks.check import Validation
from ..checks.held_out import corrected_already, misfits, poor_fits
from ..checks.inputs import (
    copied_exposures,
    doubtful_image_sizes,
    exclusion_reason,
    find_wrong_input,
    find_wrong_orientation,
    find_wrong_phantom,
    implausible,
    require_phantom,
    shared_exposures,
    valid_frames,
    validate_magnitudes,
    validate_names,
)
from ..checks.mixed_units import mixed_units
from ..checks.rig import RigFindings, interchanged, rig_findings
from ..checks.verdict import validate_or_report
from ..correction.fluoroscope_calibration import (
    Calibrations,
    FluoroscopeCalibration,
    uncorrected,
)
from ..errors import DataError
from ..estimation.calibrate import adjust_with_calibrations, calibrate_request
from ..estimation.fixed_calibration import with_comparable_sigma
from ..estimation.options import CalibrationRequest
from ..estimation.result import CalibrationResult
from ..estimation.rounds import Round
from ..exposures.collector import MIN_EXPOSURES, without_repeats
from ..exposures.frame import Frame, Frames, frames_without_strays
from ..exposures.phantom import Phantom
from ..findings import Finding, Kind, Place, Severity
from ..io.csv_table import dataframe_of
from ..io.result_document import result_tables
from ..photogrammetry.rig_orientation import RigOrientation
from ..processes import in_worker_process
from .sources import select_calibrations

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

# The adjustment job: adjust exposures with fixed calibrations, as an out-of-sample test.


def adjust(
    frames: Frames, phantom: Phantom, calibrations: Calibrations, loss: str = 'student_t'
) -> CalibrationResult:
    """Adjust exposures of the phantom with interior orientations and corrections fixed.

    A few image points that are off the image, or do not belong to the phantom, are excluded, and
    exposures that repeat the image points of an earlier one.

    Parameters
    ----------
    frames : mapping of str to sequence of Frame
        Exposures by fluoroscope.
    phantom : Phantom
    calibrations : mapping of str to FluoroscopeCalibration
        At least those of the fluoroscopes in frames.
    loss : {'student_t', 'huber', 'gaussian'}

    Returns
    -------
    CalibrationResult
        Its findings of severity ERROR state where the exposures do not fit the calibrations.

    Raises
    ------
    DataError
        For a missing calibration, implausible numbers, and for frames that do not suffice, cannot
        be of the phantom, or are already corrected.
    """
    validate_names(frames)
    validate_magnitudes(frames, phantom)
    used = select_calibrations(calibrations, frames)
    cleaned, strays = frames_without_strays(frames, phantom)
    cleaned, copies = _without_copies(cleaned, (), minimum=1)
    cleaned, shared = _without_shared(cleaned)
    require_phantom(cleaned, phantom)
    cleaned = with_comparable_sigma(cleaned, used)
    result = adjust_with_calibrations(cleaned, phantom, used, loss)
    if misfits(result, used, cleaned):
        uncorrected_result = adjust_with_calibrations(cleaned, phantom, uncorrected(used), loss)
        finding = corrected_already(result, uncorrected_result, used, cleaned)
        if finding is not None:
            raise DataError(finding)
    findings = (*strays, *copies, *shared, *result.findings, *poor_fits(result, used, cleaned))
    return replace(result, findings=findings)


MAX_SHARED = 1 / 3  # maximum share of the exposures of a fluoroscope that another also has

Progress = Callable[[str, Round], None]


@dataclass(frozen=True)
class Rig:
    """Fluoroscopes that belong to the rig but are not calibrated by this job."""

    #: names of all fluoroscopes of the rig, in order; empty: those of the request
    fluoroscopes: Sequence[str] = ()
    #: exposures of the other fluoroscopes
    frames: Frames = field(default_factory=dict)
    #: current calibrations of the other fluoroscopes
    calibrations: Calibrations = field(default_factory=dict)


@dataclass(frozen=True)
class CalibrationOutcome:
    """Complete outcome of a calibration job.

    Attributes
    ----------
    request : CalibrationRequest
    result : CalibrationResult
    rig : Rig
        The fluoroscopes that were not calibrated.
    orientation : RigOrientation or None
        None if the exposures do not give one; the findings of the result say why.
    validation : Validation or None
        None if no validation was requested.
    """

    request: CalibrationRequest
    result: CalibrationResult
    rig: Rig = field(default_factory=Rig)
    orientation: RigOrientation | None = None
    validation: Validation | None = None

    def __repr__(self) -> str:
        names = ', '.join(self.result.calibrations)
        verdict = self.validation.verdict if self.validation else 'not validated'
        return f'<CalibrationOutcome of {names}: {verdict}>'

    def _repr_html_(self) -> str:
        return f'<pre>{html.escape(self.summary())}</pre>'

    def summary(self) -> str:
        """Return the table that the command prints, and the verdict."""
        from ..report.tables import summary_table, verdict_line

        verdict = [verdict_line(self.validation)] if self.validation else []
        return '\n'.join([summary_table(self.result).rstrip(), *verdict])

    def plot(self, name: str) -> Figure:
        """Return a matplotlib figure of the distortion of a fluoroscope, with its uncertainty.

        Raises DataError for a fluoroscope that is not calibrated, or has no correction.
        """
        from ..report.figures import distortion_figure

        (calibration,) = select_calibrations(self.result.calibrations, [name]).values()
        if not calibration.model.corrects:
            raise DataError(
                f'fluoroscope {name}: the model {calibration.model.kind} corrects nothing'
            )
        return distortion_figure(
            calibration.model, name, calibration.image_size, calibration.interior_estimated
        )

    @property
    def calibrations(self) -> dict[str, FluoroscopeCalibration]:
        """Calibrations of all fluoroscopes of the rig, including the new ones."""
        return {**self.rig.calibrations, **self.result.calibrations}

    def to_dataframe(self, name: str = 'residuals') -> pandas.DataFrame:
        """Return residuals, exposures, targets or interior as a pandas DataFrame.

        The columns are those of the CSV file in the result folder. Raises DataError for another
        name, and if pandas is not installed.
        """
        return dataframe_of(result_tables(self.result), name)


def run_calibration(
    request: CalibrationRequest,
    *,
    validate: bool = False,
    force: bool = False,
    rig: Rig | None = None,
    progress: Progress | None = None,
    report_step: Callable[[str, int, int], None] | None = None,
) -> CalibrationOutcome:
    """Self-calibrate the fluoroscopes of a request, and orient the rig.

    Exposures that repeat an earlier one are excluded, and exposures of a phantom that stands still
    are joined. A few image points that are off the image, or of targets that the phantom does not
    have, are excluded.

    Parameters
    ----------
    request : CalibrationRequest
    validate : bool
        Whether to validate the calibration with its own exposures.
    force : bool
        Whether to calibrate from input that cannot be right, and to return an impossible result;
        the findings of the result then say so.
    rig : Rig, optional
        Further fluoroscopes of the rig.
    progress : callable, optional
        Called after every round with the names of the fluoroscopes and the Round; may raise to
        stop.
    report_step : callable, optional
        Called like the progress of `checks.verdict.validate`.

    Raises
    ------
    DataError
        For observations that do not suffice, that cannot be of the phantom, or that lead to an
        impossible result.
    ValueError
        For options that contradict each other.
    """
    validate_names((*request.frames, *(rig.frames if rig else ())))
    validate_magnitudes(request.frames, request.phantom)
    request, excluded = without_unusable(request)
    faults = _wrong_input(request)
    if faults and not force:
        raise DataError(*faults)
    result = _calibrated(request, progress)
    excluded += _with_causes(request, result)
    if not request.known_orientations:
        excluded += doubtful_image_sizes(valid_frames(request.frames))
    faults += [*implausible(request, result), *_interchanged(result)]
    if faults and not force:
        raise DataError(*faults)
    rig = rig or Rig()
    rig_outcome = _findings_of_rig(request, result, rig)
    result = replace(result, findings=(*excluded, *rig_outcome.doubts, *faults))
    validation = None
    if validate:
        used_request = request.with_exposures(result.used_exposures)
        validation = validate_or_report(
            used_request, result.calibrations, report_step, rig_outcome
        )
    return CalibrationOutcome(request, result, rig, rig_outcome.orientation, validation)


def _wrong_input(request: CalibrationRequest) -> list[Finding]:
    """Return findings on everything in phantom and exposures that cannot be right."""
    frames = valid_frames(request.frames)  # the calibration reports invalid frames
    known = request.known_orientations
    absent = [name for name in known if name not in request.frames]
    if absent:
        raise DataError(
            f'fluoroscope {absent[0]}: its orientation is known, but it has no observations; '
            f'there are only those of {", ".join(request.frames)}'
        )
    unknown = {name: exposures for name, exposures in frames.items() if name not in known}
    # With known orientations the points are in motion: they may rest, or come from far away.
    findings = [
        *([] if known else find_wrong_phantom(frames, request.phantom)),
        *find_wrong_input(unknown, request.phantom),
    ]
    mixed = None if known else mixed_units(unknown, request.phantom, bool(findings))
    return [
        *([mixed] if mixed else findings),
        *find_wrong_orientation(frames, request.phantom, known),
    ]


def _calibrated(
    request: CalibrationRequest,
    progress: Progress | None,
) -> CalibrationResult:
    """Calibrate; raise DataError if the normal matrix breaks down because of the data."""
    try:
        return calibrate_request(request, progress)
    except np.linalg.LinAlgError as error:
        raise DataError(
            f'the exposures do not determine the calibration: {str(error).lower()}; add exposures '
            'with the phantom turned and moved, and check target ids and sigma',
            kind=Kind.UNDETERMINED,
        ) from None


def _with_causes(request: CalibrationRequest, result: CalibrationResult) -> list[Finding]:
    """Return findings on excluded data, with the causes of misfitting exposures if known."""
    causes: dict[Place, Finding | None] = {}
    for name, figures in result.fluoroscopes.items():
        used = {exposure.exposure for exposure in figures.exposures}
        frames = valid_frames({name: request.frames[name]})[name]
        if name not in request.known_orientations:
            for frame in frames:
                if frame.number not in used:
                    causes[frame.place] = exclusion_reason(frame, request.phantom)
    return [finding.explained_by(causes.get(finding.place)) for finding in result.findings]


def without_unusable(request: CalibrationRequest) -> tuple[CalibrationRequest, list[Finding]]:
    """Return the request without stray points and repeated exposures, and findings on them.

    Raises DataError if there are many copies.
    """
    frames, strays = frames_without_strays(request.frames, request.phantom)
    frames, copies = _without_copies(frames, request.known_orientations)
    frames, shared = _without_shared(frames)
    joined, repeats = without_repeats(frames, request.known_orientations)
    if any(len(exposures) < MIN_EXPOSURES for exposures in joined.values()):
        joined, repeats = frames, []  # too few poses, which is reported elsewhere
    return replace(request, frames=joined), [*strays, *copies, *shared, *repeats]


def _without_copies(
    frames: Frames, known: Container[str], minimum: int = MIN_EXPOSURES
) -> tuple[dict[str, list[Frame]], list[Finding]]:
    """Return the frames without repeated exposures, and a finding for each of these.

    A fluoroscope with known orientation is fixed, so it may see the same points again. Raises
    DataError if fewer than a minimum of exposures are left.
    """
    out = {}
    findings = []
    for name, exposures in frames.items():
        copies = [] if name in known else copied_exposures(exposures)
        numbers = {copy.number for copy, _ in copies}
        out[name] = [frame for frame in exposures if frame.number not in numbers]
        if copies and len(out[name]) < minimum:
            raise DataError(
                f'{len(copies)} of {len(exposures)} exposures repeat the image points of '
                f'another one, {minimum} different exposures are needed',
                kind=Kind.COPIED_EXPOSURE,
                place=Place((name,), tuple(sorted(numbers)), name=f'fluoroscope {name}'),
            )
        findings += [
            Finding(
                Kind.COPIED_EXPOSURE,
                f'the image points are those of exposure {original.number}',
                copy.place,
                severity=Severity.NOTE,
                numbers={'original': original.number},
            )
            for copy, original in copies
        ]
    return out, findings


def _without_shared(frames: Frames) -> tuple[dict[str, list[Frame]], list[Finding]]:
    """Return the frames without exposures that two fluoroscopes share, and a finding for each.

    It is unknown to which of the two they belong. Raises DataError if they are many.
    """
    out = {name: list(exposures) for name, exposures in frames.items()}
    findings = []
    for names in combinations(frames, 2):
        first_frames, second_frames = (frames[name] for name in names)
        pairs = shared_exposures(first_frames, second_frames)
        if len(pairs) > MAX_SHARED * min(len(first_frames), len(second_frames)):
            raise DataError(
                f'{len(pairs)} exposures have the same image points, as if one recording had '
                'been given for both',
                kind=Kind.SHARED_EXPOSURE,
                place=Place(names),
                numbers={'exposures': len(pairs)},
            )
        for k, name in enumerate(names):
            numbers = {pair[k].number for pair in pairs}
            out[name] = [frame for frame in out[name] if frame.number not in numbers]
        findings += [
            Finding(
                Kind.SHARED_EXPOSURE,
                'both have the same image points',
                Place(names, tuple(dict.fromkeys((a.number, b.number)))),
                severity=Severity.NOTE,
            )
            for a, b in pairs
        ]
    return out, findings


def _interchanged(result: CalibrationResult) -> list[Finding]:
    """Return a finding for each fluoroscope with frames interchanged with those of the first."""
    first, *others = result.fluoroscopes
    figures = result.fluoroscopes
    findings = [interchanged((first, name), figures[first], figures[name]) for name in others]
    return [finding for finding in findings if finding is not None]


def _findings_of_rig(
    request: CalibrationRequest, result: CalibrationResult, rig: Rig
) -> RigFindings:
    """Return findings of the exposures on the orientation of the rig."""
    frames = {**rig.frames, **request.frames}
    calibrations = {**rig.calibrations, **result.calibrations}
    names = [name for name in rig.fluoroscopes or calibrations if name in calibrations]
    return rig_findings(
        request,
        result,
        {name: frames[name] for name in names if name in frames},
        {name: calibrations[name] for name in names},
    )


# Running a calibration job in another process, so that it does not block its caller.


def run_in_worker_process(
    request: CalibrationRequest,
    *,
    validate: bool = False,
    rig: Rig | None = None,
    progress: Progress | None = None,
    report_step: Callable[[str, int, int], None] | None = None,
    raise_if_cancelled: Callable[[], None] | None = None,
) -> CalibrationOutcome:
    """Run `run_calibration` in another process.

    Parameters and errors are those of `run_calibration`. The outcome has no networks.
    raise_if_cancelled is called repeatedly and may raise to terminate the process. Raises
    RuntimeError for any other failure of the process.
    """

    def report(*arguments: Any) -> None:
        call = progress if isinstance(arguments[-1], Round) else report_step
        if call is not None:
            call(*arguments)

    return in_worker_process(
        _outcome,
        request,
        validate,
        rig,
        progress=report,
        raise_if_cancelled=raise_if_cancelled,
    )


def _outcome(
    request: CalibrationRequest,
    validate: bool,
    rig: Rig | None,
    progress: Callable[..., None] | None = None,
) -> CalibrationOutcome:
    """Run the job in the worker process; progress receives both rounds and steps."""
    outcome = run_calibration(
        request, validate=validate, rig=rig, progress=progress, report_step=progress
    )
    # Do not transfer the networks: only figures need them.
    return replace(outcome, result=replace(outcome.result, runs={}, solved={}))
