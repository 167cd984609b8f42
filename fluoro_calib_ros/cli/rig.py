# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Defaults of the command line from a rig.toml."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from ..io.rig_file import NAME, RigFile, read_rig_file

# Arguments with a default from rig.toml, by command; `out` has the key calibration.
_ANGLE = ('angle_joint', 'angle_max_age')
_IMAGES = ('fluoroscopes', 'image_size', *_ANGLE)
_SOURCE = (*_IMAGES, 'units', 'phantom_sd')
USED = {
    'extract': ('phantom', 'units', 'phantom_sd', *_ANGLE),
    'calibrate': (*_SOURCE, 'phantom', 'out'),
    'adjust': (*_SOURCE, 'phantom', 'calibration'),
    'correct': ('calibration',),
    'survey': _SOURCE,  # its --phantom is a rough one, and its --out is not the folder of the rig
    'validate': ('calibration', *_ANGLE),
    'report': ('calibration',),
    'orient': (*_SOURCE, 'phantom', 'calibration'),
    'reconstruct': (*_SOURCE, 'calibration'),
    'bodies': (*_SOURCE, 'calibration'),
    'heal': (*_SOURCE, 'calibration'),
    'convert': _IMAGES,  # --units also applies to its output
    'watch': (),  # only the table [about]
}


class JointOfRig(str):
    """Value of angle_joint that the user has not typed: not every source has these joints."""


def find_rig(words: Sequence[str], command: str) -> RigFile | None:
    """Return the file of --rig, else the rig.toml of the working directory, else None.

    Raises DataError for an invalid file.
    """
    if command not in USED:
        return None
    parser = argparse.ArgumentParser(add_help=False, exit_on_error=False)
    parser.add_argument('--rig', type=Path)
    try:
        path = parser.parse_known_args(list(words))[0].rig
    except argparse.ArgumentError:  # the parser of the command reports the error
        return None
    if path is None and Path(NAME).is_file():
        path = Path(NAME)
    return None if path is None else read_rig_file(path)


def add_rig(parser: argparse.ArgumentParser, command: str, rig: RigFile | None) -> None:
    """Add --rig to the parser of a command, and use the values of the rig as defaults."""
    if command not in USED:
        return
    parser.add_argument(
        '--rig',
        type=Path,
        metavar='FILE',
        help='names, image size, phantom and folder of the rig, so that flags are unnecessary '
        f'(default: {NAME}, if there is one); flags take precedence',
    )
    if rig is None:
        return
    for action in parser._actions:
        if action.dest not in USED[command]:
            continue
        key = 'calibration' if action.dest == 'out' else action.dest
        value = getattr(rig, key)
        if value is not None and key == 'angle_joint':
            value = JointOfRig(value)
        if value is not None:
            action.default = value
            action.required = False
