"""fluoro-calib validate."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..errors import DataError
from .arguments import add_collect, add_fluoroscopes, add_phantom, image_size
from .output import print_result, print_step, print_unpaired

NAME = 'validate'
HELP = 'Validate a calibration: pass, fail or cannot tell, and what to do.'
EXAMPLE = 'fluoro-calib validate result'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('directory', type=Path, metavar='DIR', help='result folder of calibrate')
    parser.add_argument(
        '--source',
        type=Path,
        help='bag or CSV file from which the calibration was made (default: DIR/observations.csv)',
    )
    add_phantom(parser, required=False, help='its surveyed coordinates (default: DIR/phantom.csv)')
    parser.add_argument(
        '--image-size',
        type=image_size,
        metavar='WxH',
        help='image size of a CSV file given as --source [px]',
    )
    add_fluoroscopes(parser, 'validate')
    add_collect(parser, 'a bag given as --source')


def run(arguments: argparse.Namespace) -> None:
    """Validate and write DIR/validation.json.

    Raises DataError, also for the verdict 'fail', after everything is written.
    """
    from ..files.calibration_request import read_request
    from ..files.phantom import read_phantom
    from ..files.validation import validation_document, write_validation
    from ..jobs.sources import read_calibrations, read_source
    from ..report.verdict import verdict_text
    from ..validation.verdict import validate

    calibrations = read_calibrations(arguments.directory, arguments.fluoroscopes)
    frames = phantom = None
    if arguments.source is not None:
        recording = read_source(
            arguments.source,
            image_size=arguments.image_size,
            fluoroscopes=arguments.fluoroscopes,
            collect=arguments.collect,
        )
        print_unpaired(arguments.source, recording.unpaired)
        frames = recording.frames
    if arguments.phantom is not None:
        phantom = read_phantom(arguments.phantom)
    request = read_request(arguments.directory, calibrations, frames, phantom)
    validation = validate(request, calibrations, print_step)
    write_validation(arguments.directory, validation)
    print_result(arguments, validation_document(validation), verdict_text(validation))
    if validation.verdict == 'fail':
        failed = [check for check in validation.checks if check.passed is False]
        more = f', and {len(failed) - 1} more checks failed' if len(failed) > 1 else ''
        raise DataError(f'{arguments.directory}: the verdict is fail: {failed[0].sentence}{more}')
