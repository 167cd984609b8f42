# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""fluoro-calib report."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import NoReturn

from .arguments import add_result_folder, result_folder
from .output import ProgressBar, print_result

NAME = 'report'
HELP = 'Write the report of a calibration as one self-contained HTML file.'
EXAMPLE = 'fluoro-calib report result'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    add_result_folder(parser)
    parser.add_argument(
        '--pdf',
        action='store_true',
        help='also print it as DIR/report.pdf, with the Chromium, Chrome or Edge of this machine',
    )


def check(arguments: argparse.Namespace, error: Callable[[str], NoReturn]) -> None:
    """Find the result folder; call error with a sentence if none is given."""
    arguments.directory = result_folder(arguments, error)
    if arguments.pdf and arguments.directory.suffix == '.pdf':
        error(f'--pdf writes DIR/report.pdf; it takes no name, such as {arguments.directory}')


def run(arguments: argparse.Namespace) -> None:
    """Write DIR/report.html, with --pdf also DIR/report.pdf. Raises DataError."""
    from ..jobs.report import print_page, write_report
    from ..jobs.result_folder import REPORT_PDF

    with ProgressBar('report', 'picture') as bar:
        path = write_report(arguments.directory, bar)
    document = {'out': path}
    if arguments.pdf:
        document['pdf'] = str(arguments.directory / REPORT_PDF)
        print_page(path, document['pdf'])
    print_result(arguments, document, f'written to {" and ".join(document.values())}')
