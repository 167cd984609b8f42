"""The command fluoro-calib correct, for image points and for images: by the ending of the source."""

import os
import shutil
import sys
from pathlib import Path

from .errors import DataError

TEXT = (
    'Correct image points (a CSV file), or images: a file, a TIFF stack, a folder or a video '
    '(correct recording.avi --calibration result --fluoroscope a --out corrected.avi).'
)
EXAMPLE = 'fluoro-calib correct points.csv --calibration result --out corrected.csv'
POINTS = ('.csv', '.txt', '')  # endings of files with image points


def add_correct(sub):
    """Arguments of the command."""
    sub.add_argument(
        'source',
        type=Path,
        metavar='SOURCE',
        help='CSV file with columns u, v [px], perhaps fluoroscope, sigma; or a grey image (png, tif, '
        'jpg, bmp, pgm), a folder of images, or a video (avi, mkv, mp4)',
    )
    sub.add_argument(
        '--calibration',
        required=True,
        type=Path,
        metavar='DIR',
        help='folder that calibrate has written',
    )
    sub.add_argument(
        '--out',
        required=True,
        type=Path,
        metavar='OUT',
        help='file to write, for a folder the folder; its ending is the format',
    )
    sub.add_argument(
        '--fluoroscope', metavar='NAME', help='whose calibration to take, where there are several'
    )
    sub.add_argument(
        '--interpolation',
        choices=('linear', 'cubic'),
        default='linear',
        help='between the pixels of an image (default: linear)',
    )


def correct(options, calibrations_in, report):
    """Correct points or images; calibrations_in(directory) loads calibrations, report(options,
    document, text) prints the result. Raises DataError.
    """
    from .files.image_files import IMAGES, VIDEOS, ending_of, is_images

    calibrations = _wanted(options, calibrations_in(options.calibration))
    if is_images(options.source):
        _correct_images(options, calibrations, report)
    elif ending_of(options.source) in POINTS or not options.source.exists():
        _correct_points(options, calibrations, report)  # says what is not there
    else:
        known = ', '.join(ending[1:] for ending in ('.csv', *IMAGES, *VIDEOS))
        raise DataError(
            f'{options.source}: what a file with the ending {ending_of(options.source)} has is not known, '
            f'only {known} and folders of images'
        )


def _wanted(options, calibrations):
    """The calibrations, or that of the one fluoroscope that is asked for."""
    name = options.fluoroscope
    if name is None:
        return calibrations
    if name not in calibrations:
        raise DataError(
            f'{options.calibration}: there is no calibration of fluoroscope {name!r}, only of '
            f'{", ".join(calibrations)}'
        )
    return {name: calibrations[name]}


def _correct_points(options, calibrations, report):
    from .files.image_points import correct_points, read_points, write_points

    points = read_points(options.source)
    corrected = correct_points(points, calibrations)
    write_points(options.out, points, corrected)
    counts = {
        name: int((corrected.status == status).sum())
        for status, name in enumerate(('OK', 'OUTSIDE', 'INVALID'))
    }
    report(
        options,
        {'out': str(options.out), 'points': len(corrected.uv), 'status': counts},
        f'{len(corrected.uv)} points written to {options.out}: '
        + ', '.join(f'{count} {name}' for name, count in counts.items()),
    )


def _correct_images(options, calibrations, report):
    from .files.image_files import correct_images
    from .images.corrector import ImageCorrector

    if not os.path.exists(options.source):
        raise DataError(f'{options.source}: there is no such file')
    if len(calibrations) > 1:
        raise DataError(
            f'{options.source}: images do not tell their fluoroscope, and there are calibrations of '
            f'{", ".join(calibrations)}: say which with --fluoroscope'
        )
    (calibration,) = calibrations.values()
    corrector = ImageCorrector(calibration, options.interpolation)
    with _Progress(options.source.name) as progress:
        done = correct_images(options.source, options.out, corrector, progress)
    if done.passed_over:
        print(
            f'{options.source}: files that are no images were passed over: {", ".join(done.passed_over[:5])}'
            + (f' and {len(done.passed_over) - 5} more' if len(done.passed_over) > 5 else ''),
            file=sys.stderr,
        )
    size = 'x'.join(map(str, calibration.image_size))
    empty = int((~corrector.mask).sum())
    report(
        options,
        {
            'out': str(options.out),
            'kind': done.kind,
            'images': done.images,
            'fluoroscope': calibration.fluoroscope,
            'calibration_id': calibration.calibration_id,
            'image_size': list(calibration.image_size),
            'interpolation': options.interpolation,
            'empty_pixels': empty,
            'passed_over': list(done.passed_over),
        },
        f'{done.images} {"image" if done.images == 1 else "images"} of {size} px corrected with '
        f'{calibration.calibration_id}, written to {options.out}; {empty} pixels of each are empty, nothing was '
        'seen there',
    )


class _Progress:
    """A progress bar on a terminal, nothing elsewhere; a context manager, called with (done,
    total).
    """

    def __init__(self, name):
        self._name = name
        self._bar = None

    def __call__(self, done, total):
        if self._bar is None:
            from tqdm import tqdm

            # A terminal that does not tell its width would show nothing.
            self._bar = tqdm(
                desc=self._name,
                total=total or None,
                unit=' images',
                disable=None,
                leave=False,
                ncols=shutil.get_terminal_size().columns,
            )
        self._bar.update(done - self._bar.n)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self._bar is not None:
            self._bar.close()
