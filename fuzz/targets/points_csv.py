# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Image points to be corrected, as CSV, and their correction."""

from __future__ import annotations

import functools
from pathlib import Path

from fluoro_calib_ros.correction.fluoroscope_calibration import FluoroscopeCalibration
from fluoro_calib_ros.io.observations import correct_points, read_points, write_points

from ..harness import Target
from ..seeds import calibration


@functools.cache
def _calibrations() -> dict[str, FluoroscopeCalibration]:
    return {'a': calibration()}


def _read(path: Path) -> None:
    points = read_points(path)
    corrected = correct_points(points, _calibrations())
    write_points(path.with_suffix('.out.csv'), points, corrected)


TARGET = Target(
    'points_csv',
    'points.csv',
    _read,
    lambda: [
        b'fluoroscope,u,v,sigma,trial\na,500.5,400.25,0.3,x\na,,nan,,y\n',
        b'u;v\n1,5;2,5\n3,5;4,5\n',
    ],
)
