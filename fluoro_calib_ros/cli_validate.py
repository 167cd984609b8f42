"""The command fluoro-calib validate: a verdict on a calibration, from the observations it was made
of.
"""

import sys
from pathlib import Path

from .errors import DataError

TEXT = 'Validate a calibration: pass, fail or cannot tell, and what to do.'
EXAMPLE = 'fluoro-calib validate result'


def add_validate(sub, image_size):
    """Arguments of the command; image_size: type of an argument WxH."""
    sub.add_argument(
        'directory', type=Path, metavar='DIR', help='folder that calibrate has written'
    )
    sub.add_argument(
        '--source',
        type=Path,
        help='bag or CSV file of which the calibration was made (default: DIR/observations.csv)',
    )
    sub.add_argument(
        '--phantom', type=Path, help='its surveyed coordinates (default: DIR/phantom.csv)'
    )
    sub.add_argument(
        '--image-size', type=image_size, metavar='WxH', help='of a CSV file given as --source [px]'
    )
    sub.add_argument(
        '--fluoroscopes', metavar='A,B', help='names of those to validate (default: all)'
    )
    sub.add_argument(
        '--collect',
        choices=('auto', 'all', 'still'),
        default='auto',
        help='exposures of a bag given as --source, as for calibrate (default: auto)',
    )


def validate(options, frames_of, report):
    """Validate, write DIR/validation.json and report.

    frames_of(options): frames of options.source; report(options, document, text): prints the
    result. Raises DataError, also for the verdict 'fail', after everything is written.
    """
    from .files.calibration_sources import read_sources, validation_document, write_validation
    from .files.phantom import read_phantom
    from .report.verdict import verdict_text
    from .validation.verdict import validate as run

    calibrations = _wanted(options)
    sources = read_sources(
        options.directory,
        calibrations,
        None if options.source is None else frames_of(options),
        None if options.phantom is None else read_phantom(options.phantom),
    )
    validation = run(
        sources.frames,
        sources.phantom,
        calibrations,
        sources.options,
        sources.joint,
        sources.principal_distance,
        _print_step,
    )
    write_validation(options.directory, validation)
    report(options, validation_document(validation), verdict_text(validation))
    if validation.verdict == 'fail':
        failed = [check for check in validation.checks if check.passed is False]
        more = f', and {len(failed) - 1} more checks failed' if len(failed) > 1 else ''
        raise DataError(f'{options.directory}: the verdict is fail: {failed[0].sentence}{more}')


def _wanted(options):
    """Calibrations of the fluoroscopes that are asked for. Raises DataError."""
    from .files.calibration import load_calibrations

    calibrations = load_calibrations(options.directory)
    names = options.fluoroscopes.split(',') if options.fluoroscopes else list(calibrations)
    for name in names:
        if name not in calibrations:
            raise DataError(
                f'{options.directory}: there is no calibration of fluoroscope {name!r}, only of '
                f'{", ".join(calibrations)}'
            )
    return {name: calibrations[name] for name in names}


def _print_step(sentence, done, total):
    """Progress on a terminal."""
    if sys.stderr.isatty():
        print(f'{100 * done // total:3d} %  {sentence}', file=sys.stderr)
