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

"""fluoro-calib simulate."""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

from ..options import declared
from .arguments import add_option
from .output import ProgressBar, print_result

NAME = 'simulate'
HELP = 'Simulate a rig: write bags, CSV files, phantom and truth.'
EXAMPLE = 'fluoro-calib simulate --out rig --seed 1 --exposures 15'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    from ..jobs.simulation import SimulationOptions

    parser.add_argument('--out', required=True, type=Path, metavar='DIR', help='folder to write')
    for option in declared(SimulationOptions).values():
        if option.name == 'images':
            add_option(parser, option, nargs='?', const='clean')
        else:
            add_option(parser, option)


def run(arguments: argparse.Namespace) -> None:
    """Write the data set. Raises DataError."""
    from ..jobs.simulation import SimulationOptions, simulate

    values = {name: getattr(arguments, name) for name in declared(SimulationOptions)}
    options = SimulationOptions(**values)
    with ProgressBar('radiographs') as bar:
        simulate(arguments.out, options, bar)
    document = {'out': str(arguments.out), **dataclasses.asdict(options)}
    calibrate = (
        *('calibrate', arguments.out / 'calibration'),
        *('--phantom', arguments.out / 'phantom.csv', '--out', 'result'),
    )
    print_result(arguments, document, f'written to {arguments.out}', calibrate)
