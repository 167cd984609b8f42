# Copyright 2026 fluoro_calib_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""fluoro-calib report."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from .arguments import add_result_folder, result_folder
from .output import print_result

NAME = 'report'
HELP = 'Write the report of a calibration as one HTML file to hand on.'
EXAMPLE = 'fluoro-calib report result'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    add_result_folder(parser)


def check(arguments: argparse.Namespace, error: Callable[[str], None]) -> None:
    """Find the result folder; call error with a sentence where none is given."""
    arguments.directory = result_folder(arguments, error)


def run(arguments: argparse.Namespace) -> None:
    """Write DIR/report.html. Raises DataError."""
    from ..jobs.report import write_report

    path = write_report(arguments.directory)
    print_result(arguments, {'out': path}, f'written to {path}')
