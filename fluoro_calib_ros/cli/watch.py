# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""fluoro-calib watch."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping
from pathlib import Path

from .arguments import add_address

NAME = 'watch'
HELP = 'Watch and run a live session in a terminal or a browser (needs ROS 2).'
EXAMPLE = 'fluoro-calib watch'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument(
        '--namespace', default='', metavar='NS', help='namespace of the rig (default: none)'
    )
    parser.add_argument(
        '--once', action='store_true', help='print the state once and end, for logs and scripts'
    )
    parser.add_argument(
        '--web',
        action='store_true',
        help='serve a page for a browser near the X-ray machine: state, radiographs, points '
        'in space',
    )
    parser.add_argument(
        '--dicom',
        type=Path,
        metavar='FOLDER',
        help='folder in which the X-ray machine writes DICOM files, with a folder for each '
        'fluoroscope: the page shows their dose (default: that of rig.toml)',
    )
    add_address(parser, 'the page', 8080)


def run(arguments: argparse.Namespace) -> None:
    """Replace this process by the dashboard, which then owns the terminal."""
    words = ['--once'] if arguments.once else []
    if arguments.web:
        about = (arguments.rig_file and arguments.rig_file.about) or {}
        words += ['--web', '--host', arguments.host, '--port', str(arguments.port)]
        words += ['--mas', str(tube_load(about))]
        words += ['--dicom', str(arguments.dicom)] if arguments.dicom else []
    if arguments.namespace:
        words += ['--ros-args', '-r', f'__ns:=/{arguments.namespace.strip("/")}']
    code = 'from fluoro_calib_ros.entry_points import watch; watch()'
    os.execv(sys.executable, [sys.executable, '-c', code, *words])


def tube_load(about: Mapping[str, str]) -> float:
    """Return the tube load of a frame from a rig.toml: mAs, or mA and ms; 0 if unknown."""
    try:
        if 'mAs' in about:
            return float(about['mAs'])
        return float(about['mA']) * float(about['ms']) / 1000
    except (KeyError, ValueError):
        return 0.0
