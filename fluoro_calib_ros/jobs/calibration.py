# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The calibration job: self-calibrate, orient the rig, validate.

The command line, the calibration node, its worker process and Python users all call
`run_calibration`; `result_folder.save_outcome` writes what it returns.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np

from ..calibration.calibrate import CalibrationResult, calibrate_request
from ..calibration.initial_network import MIN_EXPOSURES
from ..calibration.known_rig import orientation_of_known
from ..calibration.request import CalibrationRequest
from ..calibration.result import FluoroscopeCalibration
from ..calibration.rig_orientation import orientation_and_scatter
from ..calibration.rounds import Round
from ..errors import DataError
from ..exposures.frame import Frame
from ..exposures.strays import frames_without_strays
from ..photogrammetry.rig_orientation import RigOrientation
from ..validation.check import Validation
from ..validation.inputs import (
    copied_exposures,
    find_wrong_input,
    find_wrong_orientation,
    find_wrong_phantom,
    shared_exposures,
    valid_frames,
    validate_magnitudes,
    validate_names,
    why_left_out,
)
from ..validation.mixed_units import mixed_units
from ..validation.plausibility import implausible
from ..validation.rigidity import contradiction, doubtful, interchanged
from ..validation.verdict import validate_or_report

MAX_SHARED = 1 / 3  # of the exposures of a fluoroscope that another one has as well

Progress = Callable[[str, Round], None]
Cancellation = Callable[[], None]


@dataclass(frozen=True)
class Rig:
    """Fluoroscopes that belong to the rig but are not calibrated by this job.

    Attributes
    ----------
    fluoroscopes : sequence of str
        Names of all fluoroscopes of the rig in their order; empty: those of the request.
    frames : mapping of str to sequence of Frame
        Exposures of the other fluoroscopes.
    calibrations : mapping of str to FluoroscopeCalibration
        Present calibrations of the other fluoroscopes.
    """

    fluoroscopes: Sequence[str] = ()
    frames: Mapping[str, Sequence[Frame]] = field(default_factory=dict)
    calibrations: Mapping[str, FluoroscopeCalibration] = field(default_factory=dict)


@dataclass(frozen=True)
class CalibrationOutcome:
    """Everything that a calibration job found.

    Attributes
    ----------
    request : CalibrationRequest
    result : CalibrationResult
    rig : Rig
        The fluoroscopes that were not calibrated.
    orientation : RigOrientation or None
        None where the exposures give none.
    orientation_note : str
        Why there is none, or what is doubtful about it; '' for nothing.
    validation : Validation or None
        None where no validation was requested.
    doubts : tuple of str
        Why the calibration cannot be right; not empty only where it was forced.
    """

    request: CalibrationRequest
    result: CalibrationResult
    rig: Rig = field(default_factory=Rig)
    orientation: RigOrientation | None = None
    orientation_note: str = ''
    validation: Validation | None = None
    doubts: tuple[str, ...] = ()

    @property
    def rig_note(self) -> str:
        """Why the rig has no orientation, or what is doubtful about it, as a sentence."""
        if not self.orientation_note or len(self.calibrations) < 2:
            return ''
        none = 'no ' if self.orientation is None else ''
        return f'{none}orientation of the rig: {self.orientation_note}'

    @property
    def calibrations(self) -> dict[str, FluoroscopeCalibration]:
        """Calibrations of all fluoroscopes of the rig, the new ones among them."""
        return {**self.rig.calibrations, **self.result.calibrations}

    def without_runs(self) -> CalibrationOutcome:
        """Return the outcome without the networks behind it, which only the figures need."""
        return replace(self, result=replace(self.result, runs={}, solved={}))


def run_calibration(
    request: CalibrationRequest,
    *,
    validate: bool = False,
    force: bool = False,
    rig: Rig | None = None,
    progress: Progress | None = None,
    report_step: Callable[[str, int, int], None] | None = None,
    raise_if_cancelled: Cancellation | None = None,
) -> CalibrationOutcome:
    """Self-calibrate the fluoroscopes of a request, and orient the rig.

    Exposures that repeat an earlier one are left out, and so are a few image points off the image
    or of targets that the phantom does not have.

    Parameters
    ----------
    request : CalibrationRequest
    validate : bool
        Whether the calibration is validated with its own exposures.
    force : bool
        Whether to calibrate input that cannot be right, and return a result that is impossible;
        the outcome then holds the doubts.
    rig : Rig, optional
        Further fluoroscopes of the rig.
    progress : callable, optional
        Called with the names of the fluoroscopes and the Round after every round.
    report_step : callable, optional
        Called as the progress of `validation.verdict.validate`.
    raise_if_cancelled : callable, optional
        Called before every step; may raise to stop the job.

    Returns
    -------
    CalibrationOutcome

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
    request, left_out = _without_strays(request)
    request, copies = _without_copies(request)
    left_out += copies
    request, shared = _without_shared(request)
    left_out += shared
    doubts = _wrong_input(request)
    if doubts and not force:
        raise DataError('. '.join(doubts))
    result = _calibrated(request, progress, raise_if_cancelled)
    result = replace(result, left_out=(*left_out, *_with_causes(request, result)))
    doubts += implausible(request, result)
    doubts += _interchanged(result)
    if doubts and not force:
        raise DataError('. '.join(doubts))
    rig = rig or Rig()
    orientation, note = _orientation(request, result, rig)
    validation = None
    if validate:
        validation = validate_or_report(
            request, result.calibrations, report_step, raise_if_cancelled
        )
    outcome = CalibrationOutcome(
        request, result, rig, orientation, note, validation, tuple(doubts)
    )
    if validation is None or not outcome.rig_note:
        return outcome
    return replace(outcome, validation=replace(validation, notes=(outcome.rig_note,)))


def _wrong_input(request: CalibrationRequest) -> list[str]:
    """Return a sentence for everything in phantom and exposures that cannot be right."""
    frames = valid_frames(request.frames)  # the calibration reports the others
    known = request.known_orientations
    absent = [name for name in known if name not in request.frames]
    if absent:
        raise DataError(
            f'fluoroscope {absent[0]}: its orientation is known, but it has no observations; '
            f'there are only those of {", ".join(request.frames)}'
        )
    unknown = {name: exposures for name, exposures in frames.items() if name not in known}
    # Points in motion may rest, and may come from far away.
    found = [
        *([] if known else find_wrong_phantom(frames, request.phantom)),
        *find_wrong_input(unknown, request.phantom).values(),
    ]
    mixed = '' if known else mixed_units(unknown, request.phantom, bool(found))
    return [
        *([mixed] if mixed else found),
        *find_wrong_orientation(frames, request.phantom, known).values(),
    ]


def _calibrated(
    request: CalibrationRequest,
    progress: Progress | None,
    raise_if_cancelled: Cancellation | None,
) -> CalibrationResult:
    """Calibrate; a normal matrix that breaks down is a fault in the data. Raises DataError."""
    try:
        return calibrate_request(request, progress, raise_if_cancelled)
    except np.linalg.LinAlgError as error:
        raise DataError(
            f'the exposures do not determine the calibration: {str(error).lower()}; add exposures '
            'with the phantom turned and moved, and check target ids and sigma'
        ) from None


def _with_causes(request: CalibrationRequest, result: CalibrationResult) -> tuple[str, ...]:
    """Return what was left out, with the causes of exposures that do not fit, where found."""
    causes: dict[str, str] = {}
    for name, figures in result.fluoroscopes.items():
        used = {exposure.exposure for exposure in figures.exposures}
        frames = valid_frames({name: request.frames[name]})[name]
        if name not in request.known_orientations:
            causes |= {
                f'fluoroscope {name}, exposure {frame.number}: ': why_left_out(
                    frame, request.phantom
                )
                for frame in frames
                if frame.number not in used
            }
    out = []
    for sentence in result.left_out:
        found = [cause for start, cause in causes.items() if cause and sentence.startswith(start)]
        out.append('; '.join([sentence, *found]))
    return tuple(out)


def _without_strays(request: CalibrationRequest) -> tuple[CalibrationRequest, list[str]]:
    """Return the request without a few unusable image points, and sentences about these."""
    cleaned, sentences = frames_without_strays(request.frames, request.phantom)
    return (replace(request, frames=cleaned) if sentences else request), sentences


def _without_copies(request: CalibrationRequest) -> tuple[CalibrationRequest, list[str]]:
    """Return the request without repeated exposures, and a sentence for each of these."""
    sentences = []
    frames = {}
    for name, exposures in request.frames.items():
        # Of a fixed fluoroscope the same points may be seen again.
        copies = [] if name in request.known_orientations else copied_exposures(exposures)
        numbers = {copy.number for copy, _ in copies}
        frames[name] = [frame for frame in exposures if frame.number not in numbers]
        if copies and len(frames[name]) < MIN_EXPOSURES:
            raise DataError(
                f'fluoroscope {name}: {len(copies)} of {len(exposures)} exposures repeat the '
                f'image points of another one, {MIN_EXPOSURES} different exposures are needed'
            )
        sentences += [
            f'fluoroscope {name}, exposure {copy.number}: the image points are those of exposure '
            f'{original.number}'
            for copy, original in copies
        ]
    return (replace(request, frames=frames) if sentences else request), sentences


def _without_shared(request: CalibrationRequest) -> tuple[CalibrationRequest, list[str]]:
    """Return the request without exposures that two fluoroscopes have in common.

    Which of both they are of is not known. Returns a sentence for each, too. Raises DataError
    where they are many.
    """
    frames = {name: list(exposures) for name, exposures in request.frames.items()}
    sentences = []
    for one, other in combinations(frames, 2):
        pairs = shared_exposures(request.frames[one], request.frames[other])
        if not pairs:
            continue
        fewest = min(len(request.frames[one]), len(request.frames[other]))
        if len(pairs) > MAX_SHARED * fewest:
            raise DataError(
                f'fluoroscopes {one} and {other}: {len(pairs)} exposures have the same image '
                'points, as if one recording had been given for both'
            )
        for k, name in enumerate((one, other)):
            numbers = {pair[k].number for pair in pairs}
            frames[name] = [frame for frame in frames[name] if frame.number not in numbers]
        sentences += [
            f'fluoroscopes {one} and {other}, exposure {a.number}'
            f'{f" and {b.number}" * (a.number != b.number)}: both have the same image points'
            for a, b in pairs
        ]
    return (replace(request, frames=frames) if sentences else request), sentences


def _interchanged(result: CalibrationResult) -> list[str]:
    """Return a sentence for every two fluoroscopes whose frames are interchanged somewhere."""
    first, *others = result.fluoroscopes
    figures = result.fluoroscopes
    found = [interchanged((first, name), figures[first], figures[name]) for name in others]
    return [sentence for sentence in found if sentence]


def _orientation(
    request: CalibrationRequest, result: CalibrationResult, rig: Rig
) -> tuple[RigOrientation | None, str]:
    """Return the orientation of the rig and what is doubtful about it, or None and the reason."""
    frames = {**rig.frames, **request.frames}
    calibrations = {**rig.calibrations, **result.calibrations}
    names = [name for name in rig.fluoroscopes or calibrations if name in calibrations]
    if len(names) < 2:
        return None, 'a single fluoroscope is calibrated'
    if all(name in request.known_orientations for name in names):
        known = request.known_orientations
        return orientation_of_known(known, result.fluoroscopes, result.calibrations), ''
    calibrated = [name for name in names if name in result.fluoroscopes]
    for name in calibrated[1:]:
        first = calibrated[0]
        sentence = contradiction(
            (first, name), result.fluoroscopes[first], result.fluoroscopes[name]
        )
        if sentence:
            return None, sentence
    try:
        orientation, scatter = orientation_and_scatter(
            {name: frames[name] for name in names},
            request.phantom,
            {name: calibrations[name] for name in names},
            starts=result.starts,
        )
    except DataError as error:
        return None, str(error)
    side = max(max(calibration.image_size) for calibration in calibrations.values())
    found = [doubtful(pairs, side) for pairs in scatter]
    refused = '; '.join(refusal for refusal, _ in found if refusal)
    if refused:
        return None, refused
    return orientation, '; '.join(note for _, note in found if note)
