# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""fluoro-calib convert."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from ..errors import DataError
from .arguments import (
    UNITS,
    add_angle_options,
    add_file_options,
    add_shared,
    angle_of,
    angle_options,
    file_settings,
    input_paths,
    number_in,
    options_of,
)
from .output import print_notes, print_result

NAME = 'convert'
HELP = 'Convert between this program and others: XMALab, Autoscoper, Anipose, OpenCV, C3D, TRC ...'
EXAMPLE = 'fluoro-calib convert result --to mayacam2 --out mayacam'
MAX_RATE = 1e6  # [Hz], above the rate of any camera


def _with_meaning(kind: str) -> str:
    """Return the kind of a format with its title, for the help."""
    from ..io.formats.registry import FORMATS

    title = FORMATS[kind].title.removesuffix(' of fluoro_calib_ros')
    return kind if title.lower() == kind else f'{kind} ({title})'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    from ..io.formats.registry import kinds

    written = kinds(lambda format_: format_.write)
    parser.add_argument(
        'source',
        type=Path,
        metavar='SOURCE',
        help='result folder, bag, file of any format (docs/formats.md), or folder with a file of '
        'one format for each camera',
    )
    parser.add_argument(
        '--to',
        required=True,
        choices=written,
        metavar='KIND',
        help=f'format to write: {"; ".join(map(_with_meaning, written))}',
    )
    add_shared(
        parser,
        'out',
        help='file to write; for mayacam2, opencv, camera_info, lut, deeplabcut and sleap a '
        'folder with one file a fluoroscope, for bundle a folder',
        metavar='PATH',
    )
    parser.add_argument(
        '--from',
        dest='source_kind',
        choices=kinds(lambda format_: format_.read),
        metavar='KIND',
        help='format of SOURCE (default: as it is recognised)',
    )
    _add_selection(parser)
    parser.add_argument(
        '--rate',
        type=number_in(1e-6, MAX_RATE),
        metavar='HZ',
        help='frames per second, where SOURCE does not contain it',
    )
    add_file_options(parser)
    parser.add_argument(
        '--out-units',
        choices=UNITS,
        help='unit of what is written (default: mm in files that state their unit, else --units)',
    )


def _add_selection(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that select the content and the calibration."""
    add_shared(parser, 'image_size', help='where SOURCE does not contain it [px]')
    add_shared(parser, 'fluoroscopes', help='names of the fluoroscopes to convert (default: all)')
    parser.add_argument(
        '--exposure',
        type=number_in(0, 2**32 - 1, int),
        metavar='N',
        help='position and attitude of the fluoroscopes of a result folder as in this exposure, '
        'in the frame of the phantom (default: the orientation of the rig)',
    )
    parser.add_argument(
        '--calibration',
        type=Path,
        metavar='DIR',
        help='result folder whose image size and names hold for SOURCE',
    )
    parser.add_argument(
        '--corrected',
        action='store_true',
        help='correct image points by the calibration before they are written',
    )
    add_shared(
        parser,
        'angle_deg',
        help='angle of the C-arm of the corrections that are written, and of corrected points '
        'without angle_deg, for a calibration that depends on it (default: unknown, the mean '
        'correction of its exposures)',
    )
    add_angle_options(parser)


def check(arguments: argparse.Namespace, error: Callable[[str], NoReturn]) -> None:
    """Call error with a sentence for arguments that exclude each other."""
    if arguments.corrected and arguments.calibration is None:
        error('--corrected needs --calibration')


def run(arguments: argparse.Namespace) -> None:
    """Convert a file or folder. Raises DataError."""
    from ..io.folder import check_output_file
    from ..jobs.conversion import ConversionRequest, convert

    inputs = input_paths(arguments)
    if arguments.out.resolve() in [path.resolve() for path in inputs]:
        raise DataError(f'{arguments.out}: the input would be overwritten, choose another output')
    if not arguments.out.is_dir():  # bags and formats with several files create or fill a folder
        check_output_file(arguments.out, inputs)
    written = convert(
        options_of(
            ConversionRequest,
            arguments,
            kind=arguments.to,
            fluoroscopes=tuple(arguments.fluoroscopes or ()),
            settings=file_settings(arguments, rate_hz=arguments.rate),
            angle=angle_of(arguments),
            angles=angle_options(arguments),
        )
    )
    print_notes(written.notes)
    document = {
        'kind': arguments.to,
        'out': str(arguments.out),
        'files': list(written.paths),
        'notes': list(written.notes),
    }
    print_result(arguments, document, '\n'.join(f'written to {path}' for path in written.paths))
