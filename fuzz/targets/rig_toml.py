# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""rig.toml, and calibrations of Anipose, which are also TOML."""

from __future__ import annotations

from pathlib import Path

from fluoro_calib_ros.io.formats import registry
from fluoro_calib_ros.io.formats.content import FileSettings
from fluoro_calib_ros.io.rig_file import read_rig_file

from ..harness import Target, both

SETTINGS = FileSettings(image_size=(1024, 1024), units='mm')


def _read(path: Path) -> None:
    both(lambda: read_rig_file(path), lambda: registry.read(path, SETTINGS, 'anipose'))


TARGET = Target(
    'rig_toml',
    'rig.toml',
    _read,
    lambda: [
        b'fluoroscopes = ["a", "b"]\nimage_size = [1024, 1024]\nphantom = "p.csv"\n'
        b'calibration = "result"\n',
        b'[cam_0]\nname = "a"\nsize = [1024, 768]\n'
        b'matrix = [[900.0, 0.0, 500.0], [0.0, 900.0, 400.0], [0.0, 0.0, 1.0]]\n'
        b'distortions = [0.0, 0.0, 0.0, 0.0, 0.0]\nrotation = [0.1, 0.2, 0.3]\n'
        b'translation = [1.0, 2.0, 900.0]\n[metadata]\nadjusted = false\n',
    ],
)
