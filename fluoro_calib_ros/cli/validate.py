# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""fluoro-calib validate."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from ..errors import DataError
from ..exposures.frame import Frames
from .arguments import (
    add_angle_options,
    add_collect,
    add_file_options,
    add_result_folder,
    add_shared,
    angle_options,
    file_settings,
    result_folder,
    source_of,
)
from .output import print_notes, print_result, print_step, print_unpaired

if TYPE_CHECKING:
    from ..correction.fluoroscope_calibration import Calibrations
    from ..estimation.options import CalibrationRequest

NAME = 'validate'
HELP = 'Validate a calibration: pass, fail or cannot tell, and what to do.'
EXAMPLE = 'fluoro-calib validate result'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    add_result_folder(parser)
    parser.add_argument(
        '--source',
        type=Path,
        help='bag or file of image points from which the calibration was made (default: '
        'DIR/observations.csv)',
    )
    add_shared(
        parser,
        'phantom',
        required=False,
        help='its surveyed coordinates (default: DIR/phantom.csv)',
    )
    add_shared(
        parser,
        'image_size',
        help='image size of a file given as --source [px] (default: that of the calibration)',
    )
    add_shared(parser, 'fluoroscopes', help='names of the fluoroscopes to validate (default: all)')
    add_angle_options(parser)
    add_collect(parser, 'a bag given as --source')
    add_file_options(parser)
    add_shared(parser, 'exit_zero')


def check(arguments: argparse.Namespace, error: Callable[[str], NoReturn]) -> None:
    """Find the result folder; call error with a sentence if none is given."""
    arguments.directory = result_folder(arguments, error)


def run(arguments: argparse.Namespace) -> bool:
    """Validate and write DIR/validation.json; return whether the verdict is pass.

    Raises DataError.
    """
    from ..checks.rig import RigFindings
    from ..checks.verdict import validate
    from ..io.calibration import edited, exchanged, read_result, used_exposures
    from ..io.result_document import write_validation
    from ..jobs.result_folder import saved_orientation
    from ..jobs.sources import read_calibrations, select_calibrations
    from ..report.tables import verdict_text

    rig = read_calibrations(arguments.directory)
    calibrations = select_calibrations(rig, arguments.fluoroscopes or rig, arguments.directory)
    document = read_result(arguments.directory)
    finding = exchanged(arguments.directory, document, calibrations)
    if finding is not None:
        raise DataError(finding)
    request = _request(arguments, rig, calibrations)
    request = request.with_exposures(used_exposures(document, request.frames))
    orientation = saved_orientation(arguments.directory)
    is_captured = orientation is not None and orientation.source == 'capture'
    validation = validate(
        request, calibrations, print_step, rig=RigFindings() if is_captured else None
    )
    note = edited(arguments.directory, document)
    if note is not None:
        validation = replace(validation, notes=(note, *validation.notes))
    verdict_document = write_validation(arguments.directory, validation)
    passed = validation.verdict == 'pass'
    next_step = ('reconstruct', 'MEASURED', '--calibration', arguments.directory)
    if orientation is None:
        next_step = ('correct', 'POINTS', '--calibration', arguments.directory)
    print_result(
        arguments,
        verdict_document,
        verdict_text(validation),
        (*next_step, '--out', 'points.csv') if passed else (),
    )
    return passed


def _request(
    arguments: argparse.Namespace, rig: Calibrations, calibrations: Calibrations
) -> CalibrationRequest:
    """Read the inputs of some calibrations of a rig, from the folder or the given files."""
    from ..estimation.options import CalibrationRequest
    from ..io.calibration import PHANTOM
    from ..io.calibration_request import read_request
    from ..io.phantom import read_phantom
    from ..jobs.calibration import without_unusable
    from ..jobs.sources import BagSelection, calibrated_settings, read_source, read_survey

    frames: Frames | None = None
    phantom = None
    settings = calibrated_settings(file_settings(arguments), arguments.directory, rig)
    if arguments.phantom is not None:
        survey = read_survey(arguments.phantom, settings)
        print_notes(survey.notes)
        phantom = survey.phantom
    saved_phantom = arguments.directory / PHANTOM
    if arguments.source is not None:
        shown = phantom
        if shown is None and saved_phantom.exists():
            shown = read_phantom(saved_phantom)
        selection = BagSelection(angles=angle_options(arguments), phantom=shown)
        source = source_of(arguments, selection)
        recording = read_source(collect=arguments.collect, **{**source, 'settings': settings})
        print_notes(recording.notes)
        print_unpaired(arguments.source, recording.unpaired)
        frames = recording.frames
        if shown is not None:
            # Excluded as in `calibrate`.
            frames = without_unusable(CalibrationRequest(frames, shown))[0].frames
    return read_request(arguments.directory, calibrations, frames, phantom)
