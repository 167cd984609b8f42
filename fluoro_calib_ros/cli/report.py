"""fluoro-calib report."""

from __future__ import annotations

import argparse
from pathlib import Path

from .output import print_result

NAME = 'report'
HELP = 'Write the report of a calibration as one HTML file to hand on.'
EXAMPLE = 'fluoro-calib report result'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('directory', type=Path, metavar='DIR', help='result folder of calibrate')


def run(arguments: argparse.Namespace) -> None:
    """Write DIR/report.html. Raises DataError."""
    from ..jobs.report import write_report

    path = write_report(arguments.directory)
    print_result(arguments, {'out': path}, f'written to {path}')
