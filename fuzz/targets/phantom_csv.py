# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The phantom as CSV, including moving points and names."""

from __future__ import annotations

from pathlib import Path

from fluoro_calib_ros.exposures.names import Names
from fluoro_calib_ros.exposures.phantom import Phantom
from fluoro_calib_ros.io.csv_table import NAMES_FILE, read_names
from fluoro_calib_ros.io.phantom import (
    read_moving_points,
    read_named_phantom,
    read_phantom,
    write_phantom,
)

from ..harness import Target, both
from ..seeds import rig, written


def _read(path: Path) -> None:
    def names() -> None:
        (path.parent / NAMES_FILE).write_bytes(path.read_bytes())
        read_names(path.parent)

    both(
        lambda: read_phantom(path),
        lambda: read_named_phantom(path, Names()),
        lambda: read_moving_points(path),
        names,
    )


def _phantom() -> Phantom:
    whole = rig().phantom
    return Phantom(whole.target_id[:6], whole.xyz_mm[:6], whole.sd_mm[:6])


TARGET = Target(
    'phantom_csv',
    'phantom.csv',
    _read,
    lambda: [
        *written(lambda path: write_phantom(path, _phantom())),
        b'exposure,target_id,x_mm,y_mm,z_mm\n1,1,0.5,1.5,2.5\n2,1,3,4,5\n',
        b'kind,id,name\ntarget,1,p1\nexposure,2,trial 3.tif\nfluoroscope,cam_1,cam 1\n',
    ],
)
