# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""fluoro-calib correct."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import DataError
from ..findings import first_few
from .arguments import (
    add_file_options,
    add_scheduler,
    add_shared,
    angle_of,
    cluster_of,
    file_settings,
    input_paths,
    options_of,
)
from .output import ProgressBar, print_note, print_notes, print_result

if TYPE_CHECKING:
    from ..correction.fluoroscope_calibration import Calibrations, FluoroscopeCalibration
    from ..io.image_writing import CorrectedImages

NAME = 'correct'
HELP = 'Correct image points (CSV file) or images (image, TIFF stack, folder or video).'
EXAMPLE = 'fluoro-calib correct points.csv --calibration result --out corrected.csv'
POINTS_SUFFIXES = ('.csv', '.txt', '.xma', '.pho', '')  # suffixes of files with image points


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument(
        'source',
        type=Path,
        metavar='SOURCE',
        help='CSV file with columns u, v [px] and optionally fluoroscope, sigma; image points of '
        'another program (docs/formats.md); or a grey image '
        '(png, tif, jpg, bmp, pgm), a folder of images, or a video (avi, mkv, mp4), or a '
        'recording (cine, dcm) such as trial.cine',
    )
    add_shared(parser, 'calibration')
    add_shared(
        parser,
        'out',
        help='file to write, whose suffix determines the format; a folder for a folder of images',
        metavar='OUT',
    )
    parser.add_argument(
        '--fluoroscopes',
        '--fluoroscope',
        dest='fluoroscope',
        metavar='NAME',
        help='fluoroscope of the source, if several are calibrated',
    )
    parser.add_argument(
        '--interpolation',
        choices=('linear', 'cubic'),
        default='linear',
        help='interpolation between the pixels of an image (default: linear)',
    )
    angle = parser.add_mutually_exclusive_group()
    add_shared(
        angle,
        'angle_deg',
        help='angle of the C-arm of images, and of points without angle_deg, for a calibration '
        'that depends on it (default: unknown, the mean correction of its exposures)',
    )
    angle.add_argument(
        '--angles',
        type=Path,
        metavar='FILE',
        help='CSV file with columns image, angle_deg: angles of the C-arm in the images of a '
        'stack or video, the first of which is 1; an image without one gets the mean correction',
    )
    folders = parser.add_argument_group('folders of images and videos')
    folders.add_argument(
        '--recursive', action='store_true', help='also correct the folders in SOURCE'
    )
    folders.add_argument(
        '--keep-going',
        action='store_true',
        help='skip files that cannot be corrected, and list them; by default, one of them ends '
        'the command and nothing is written',
    )
    add_shared(folders, 'workers')
    add_scheduler(parser, 'correct the files; they see the folders under the same names')
    add_file_options(parser)


def run(arguments: argparse.Namespace) -> None:
    """Correct image points or images. Raises DataError."""
    from ..io.calibration import disagreements
    from ..io.folder import check_output_file
    from ..io.image_reading import READ_SUFFIXES, is_image_source, listed, suffix_of
    from ..jobs.sources import read_calibrations

    if arguments.source.is_file() or not arguments.out.is_dir():  # images can fill a folder
        check_output_file(arguments.out, input_paths(arguments))
    names = None if arguments.fluoroscope is None else [arguments.fluoroscope]
    calibrations = read_calibrations(arguments.calibration, names)
    print_notes(disagreements(arguments.calibration, calibrations))
    if is_image_source(arguments.source):
        _correct_images(arguments, calibrations)
    elif suffix_of(arguments.source) in POINTS_SUFFIXES or not arguments.source.exists():
        _correct_points(arguments, calibrations)  # reports a missing file, too
    else:
        suffixes = listed(('.csv', *READ_SUFFIXES))
        raise DataError(
            f'{arguments.source}: files with the suffix {suffix_of(arguments.source)} cannot be '
            f'read, only {suffixes} and folders of images'
        )


def _correct_points(arguments: argparse.Namespace, calibrations: Calibrations) -> None:
    from ..correction.base import CorrectionStatus
    from ..io.observations import correct_points, write_points
    from ..jobs.sources import calibrated_settings, read_point_table

    if arguments.angles is not None:
        raise DataError(
            f'{arguments.source}: --angles is for images; image points have their angles in a '
            'column angle_deg'
        )
    names = () if arguments.fluoroscope is None else (arguments.fluoroscope,)
    settings = file_settings(arguments, fluoroscopes=names)
    settings = calibrated_settings(settings, arguments.calibration, calibrations)
    points, notes = read_point_table(arguments.source, settings)
    print_notes(notes)
    corrected = correct_points(points, calibrations, angle_of(arguments))
    write_points(arguments.out, points, corrected)
    counts = {s.name: int((corrected.status == s).sum()) for s in CorrectionStatus}
    total = len(corrected.uv)
    by_status = ', '.join(f'{count} {name}' for name, count in counts.items())
    print_result(
        arguments,
        {'out': str(arguments.out), 'points': total, 'status': counts},
        f'{total} points written to {arguments.out}: {by_status}',
    )


def _correct_images(arguments: argparse.Namespace, calibrations: Calibrations) -> None:
    """Correct images and videos. Raises DataError."""
    from ..io.image_reading import read_image_angles
    from ..jobs.image_correction import ImageCorrectionRequest, run_image_correction

    source = arguments.source
    if not source.exists():
        raise DataError(f'{source}: there is no such file')
    if len(calibrations) > 1:
        raise DataError(
            f'{source}: images do not name their fluoroscope, and there are calibrations of '
            f'{", ".join(calibrations)}: choose one with --fluoroscope'
        )
    (calibration,) = calibrations.values()
    angles = None
    if arguments.angles is not None and calibration.angle_field is None:
        name = calibration.calibration_id
        print_note(f'{arguments.angles}: not used, {name} does not depend on an angle')
    elif arguments.angles is not None:
        angles = read_image_angles(arguments.angles)
    if angles is None:
        if calibration.angle_field is not None and arguments.angle_deg is None:
            print_note(
                f'{source}: corrected with the mean over the angles, neither --angle-deg nor '
                '--angles is given'
            )
        calibration = calibration.at_angle(angle_of(arguments))
    request = options_of(
        ImageCorrectionRequest,
        arguments,
        calibration=calibration,
        scheduler=cluster_of(arguments),
        angles=angles,
    )
    with ProgressBar(source.name) as progress:
        corrected = run_image_correction(request, progress)
    if angles is not None:
        without_angle = sum(number not in angles for number in range(1, corrected.images + 1))
        if without_angle:
            print_note(
                f'{source}: {without_angle} of {corrected.images} images have no angle in '
                f'{arguments.angles}, they are corrected with the mean over the angles'
            )
    _print_images(arguments, calibration, corrected)


def _print_images(
    arguments: argparse.Namespace, calibration: FluoroscopeCalibration, done: CorrectedImages
) -> None:
    """Print the summary of a correction of images."""
    from ..images.corrector import ImageCorrector

    if done.passed_over:
        print_note(
            f'{arguments.source}: files that are not images were skipped: '
            f'{first_few(done.passed_over)}'
        )
    if done.failed:
        print_note(f'not corrected: {first_few(done.failed, "; ")}')
    corrector = ImageCorrector(calibration, arguments.interpolation)
    size = 'x'.join(map(str, calibration.image_size))
    empty = int((~corrector.mask).sum())
    document = {
        'out': str(arguments.out),
        'kind': done.kind,
        'images': done.images,
        'files': done.files,
        'fluoroscope': calibration.fluoroscope,
        'calibration_id': calibration.calibration_id,
        'image_size': list(calibration.image_size),
        'interpolation': arguments.interpolation,
        'empty_pixels': empty,
        'passed_over': list(done.passed_over),
        'failed': list(done.failed),
    }
    noun = 'image' if done.images == 1 else 'images'
    print_result(
        arguments,
        document,
        f'{done.images} {noun} of {size} px corrected with {calibration.calibration_id}, written '
        f'to {arguments.out}; {empty} pixels of each are empty, the original does not show them',
    )
