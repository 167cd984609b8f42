# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""fluoro-calib watch."""

from __future__ import annotations

import argparse
import os
import sys

NAME = 'watch'
HELP = 'Watch and run a live session in the terminal: nodes, exposures, calibration (needs ROS 2).'
EXAMPLE = 'fluoro-calib watch'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument(
        '--namespace', default='', metavar='NS', help='namespace of the rig (default: none)'
    )
    parser.add_argument(
        '--once', action='store_true', help='print the state once and end, for logs and scripts'
    )


def run(arguments: argparse.Namespace) -> None:
    """Replace this process by the dashboard, which has the terminal to itself."""
    words = ['--once'] if arguments.once else []
    if arguments.namespace:
        words += ['--ros-args', '-r', f'__ns:=/{arguments.namespace.strip("/")}']
    code = 'from fluoro_calib_ros.entry_points import watch; watch()'
    os.execv(sys.executable, [sys.executable, '-c', code, *words])
