# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""fluoro-calib phantom."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from .arguments import number_in
from .output import print_note, print_result

NAME = 'phantom'
HELP = 'Write the phantom file of a regular sheet or block from its drawing, with a picture.'
EXAMPLE = 'fluoro-calib phantom --hex 45x45 --pitch 7 --diameter 3 --blocked 10,12 sheet.csv'
MAX_COUNT = 1000  # maximum number of places along an axis
MAX_PLACES = 10**6
PICTURES = ('.svg', '.png')


def counts(length: int) -> Callable[[str], tuple[int, ...]]:
    """Return an argument type: `length` integers separated by x."""

    def convert(text: str) -> tuple[int, ...]:
        parts = text.lower().split('x')
        if len(parts) == length and all(part.isascii() and part.isdigit() for part in parts):
            values = tuple(map(int, parts))
            if math.prod(values) > MAX_PLACES:
                raise argparse.ArgumentTypeError(f'{text} has more than {MAX_PLACES} places')
            if all(1 <= value <= MAX_COUNT for value in values):
                return values
        form = 'x'.join(['N'] * length)
        raise argparse.ArgumentTypeError(f'{text!r} is not {form}, numbers from 1 to {MAX_COUNT}')

    return convert


def place(text: str) -> tuple[int, ...]:
    """Parse ROW,COLUMN or ROW,COLUMN,LAYER."""
    parts = text.split(',')
    if len(parts) in (2, 3) and all(part.isascii() and part.isdigit() for part in parts):
        return tuple(map(int, parts))
    raise argparse.ArgumentTypeError(f'{text!r} is not ROW,COLUMN or ROW,COLUMN,LAYER')


def pitches(text: str) -> tuple[float, float, float]:
    """Parse one pitch, or the pitches along x, y and z [mm]."""
    try:
        values = [number_in(1e-3, 1e4)(part) for part in text.split(',')]
        x, y, z = values * 3 if len(values) == 1 else values
    except ValueError:
        raise argparse.ArgumentTypeError(f'{text!r} is not MM or MM,MM,MM') from None
    return x, y, z


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    kind = parser.add_mutually_exclusive_group(required=True)
    kind.add_argument(
        '--hex',
        type=counts(2),
        metavar='COLUMNSxROWS',
        help='perforated sheet, every second row shifted to the right by half a pitch',
    )
    kind.add_argument(
        '--square', type=counts(2), metavar='COLUMNSxROWS', help='sheet of rows and columns'
    )
    kind.add_argument(
        '--cube',
        type=counts(3),
        metavar='COLUMNSxROWSxLAYERS',
        help='block of layers of rows and columns of beads',
    )
    parser.add_argument(
        '--pitch',
        type=pitches,
        required=True,
        metavar='MM[,MM,MM]',
        help='distance of neighbours [mm]: everywhere, or along x, y and z',
    )
    parser.add_argument(
        '--diameter', type=number_in(1e-3, 1e4), metavar='MM', help='of beads or holes [mm]'
    )
    parser.add_argument(
        '--blocked',
        type=place,
        action='append',
        default=[],
        metavar='ROW,COLUMN[,LAYER]',
        help='position without hole or bead, counted from 1 at the upper left; repeatable',
    )
    parser.add_argument(
        '--sd',
        type=number_in(1e-6, 1e3),
        default=0.1,
        metavar='MM',
        help='tolerance of the manufacture, as standard deviation of a coordinate [mm] '
        '(default: 0.1)',
    )
    parser.add_argument(
        '--picture',
        type=Path,
        metavar='FILE',
        help='picture with ids, .svg or .png, to compare with the part (default: OUT.svg)',
    )
    parser.add_argument(
        'file', type=Path, nargs='?', metavar='OUT.csv', help='phantom file to write'
    )
    parser.add_argument(
        '--out', type=Path, metavar='OUT.csv', help='the same, as other commands name it'
    )
    parser.add_argument(
        '--add-to',
        type=Path,
        metavar='PHANTOM',
        help='phantom of any format that is written with the drawing as a further part, such as a '
        'cube with a sheet; each image shows one of the parts; the ids of the drawing are raised '
        'by a power of ten',
    )


def check(arguments: argparse.Namespace, error: Callable[[str], NoReturn]) -> None:
    """Call error with a sentence unless there are one output file and a picture of its own."""
    if (arguments.file is None) == (arguments.out is None):
        error('one file to write is needed: OUT.csv')
    arguments.out = arguments.out or arguments.file
    arguments.picture = arguments.picture or arguments.out.with_suffix('.svg')
    if arguments.picture.suffix.lower() not in PICTURES:
        error(f'{arguments.picture}: a picture is {" or ".join(PICTURES)}')
    if arguments.picture == arguments.out:
        error(f'{arguments.picture}: picture and phantom file are the same file')


def run(arguments: argparse.Namespace) -> None:
    """Write the phantom file and its picture. Raises DataError."""
    from ..exposures.phantom import Drawing, require_size
    from ..io.access import write_bytes
    from ..io.phantom import write_phantom
    from ..jobs.sources import read_survey
    from ..report.figures import phantom_figure, picture_bytes

    picture = arguments.picture
    columns, rows, layers = (*(arguments.cube or arguments.square or arguments.hex), 1)[:3]
    drawing = Drawing(
        columns=columns,
        rows=rows,
        layers=layers,
        pitch_mm=arguments.pitch,
        hexagonal=arguments.hex is not None,
        blocked=arguments.blocked,
        diameter_mm=arguments.diameter,
        sd_mm=arguments.sd,
    )
    phantom = drawing.phantom()
    require_size(phantom)
    count = len(phantom.target_id)
    raised = 0
    if arguments.add_to is not None:
        survey = read_survey(arguments.add_to)
        whole = survey.phantom.with_part(phantom)
        raised = int(whole.target_id[-count] - phantom.target_id[0])
        phantom = whole
        for note in survey.notes:
            print_note(note)
    picture_content = picture_bytes(phantom_figure(drawing), picture.suffix.lower())
    write_phantom(arguments.out, phantom)
    write_bytes(picture, picture_content)
    document = {
        'out': str(arguments.out),
        'picture': str(picture),
        'targets': count,
        'blocked': drawing.blocked_id.tolist(),
        'ids_raised_by': raised,
    }
    text = (
        f'{count} targets, {len(drawing.blocked_id)} positions are blocked\nwritten to '
        f'{arguments.out}; compare {picture} with the part: ids from the upper left, blocked '
        'positions crossed out'
    )
    if raised:
        text += f'\n{arguments.out} has {raised} more than the picture in the ids of this part'
    print_result(arguments, document, text)
