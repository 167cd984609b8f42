# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""fluoro-calib simulate."""

from __future__ import annotations

import argparse
import dataclasses

from .arguments import add_options, add_shared, options_of
from .output import ProgressBar, print_result

NAME = 'simulate'
HELP = 'Simulate a rig: write bags, CSV files, phantom and truth.'
EXAMPLE = 'fluoro-calib simulate --out rig --seed 1 --exposures 15'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    from ..jobs.simulation import SimulationOptions

    add_shared(parser, 'out', help='folder to write')
    add_options(parser, SimulationOptions, images={'nargs': '?', 'const': 'clean'})


def run(arguments: argparse.Namespace) -> None:
    """Write the data set. Raises DataError."""
    from ..jobs.simulation import SimulationOptions, simulate

    options = options_of(SimulationOptions, arguments)
    with ProgressBar('radiographs') as bar:
        simulate(arguments.out, options, bar)
    document = {'out': str(arguments.out), **dataclasses.asdict(options)}
    calibrate = (
        *('calibrate', arguments.out / 'calibration'),
        *('--phantom', arguments.out / 'phantom.csv', '--out', 'result'),
    )
    print_result(arguments, document, f'written to {arguments.out}', calibrate)
