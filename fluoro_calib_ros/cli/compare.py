# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""fluoro-calib compare."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..findings import sentences
from .output import print_notes, print_result

NAME = 'compare'
HELP = 'Compare two calibrations: what changed, where in the image, and whether significantly.'
EXAMPLE = 'fluoro-calib compare result.previous result --figure changes.png'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('first', type=Path, metavar='DIR', help='result folder of calibrate')
    parser.add_argument(
        'second', type=Path, metavar='DIR', help='result folder to compare with it'
    )
    parser.add_argument(
        '--figure', type=Path, metavar='FILE.png', help='draw the difference of the corrections'
    )


def run(arguments: argparse.Namespace) -> None:
    """Compare two calibrations, and draw the figure if asked for. Raises DataError."""
    from ..io.access import write_bytes
    from ..io.folder import check_output_file
    from ..jobs.report import compare_folders
    from ..report.figures import comparison_document, comparison_png, comparison_text

    if arguments.figure is not None:
        check_output_file(arguments.figure, (arguments.first, arguments.second))
    compared = compare_folders(arguments.first, arguments.second)
    if arguments.figure is not None:
        write_bytes(arguments.figure, comparison_png(compared.comparisons))
    print_notes(compared.findings)
    scales = compared.mm_per_px
    document = {
        'fluoroscopes': {
            name: comparison_document(comparison, scales.get(name))
            for name, comparison in compared.comparisons.items()
        },
        'notes': sentences(compared.findings),
    }
    texts = [comparison_text(c, scales.get(name)) for name, c in compared.comparisons.items()]
    print_result(arguments, document, '\n'.join(texts))
