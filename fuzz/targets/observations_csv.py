# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Observations as CSV, with ids and with names."""

from __future__ import annotations

from pathlib import Path

from fluoro_calib_ros.exposures.names import Names
from fluoro_calib_ros.io.observations import (
    read_named_observations,
    read_observations_csv,
    write_observations_csv,
)

from ..harness import Target, both
from ..seeds import frames, written

SIZE = (1024, 1024)


def _read(path: Path) -> None:
    both(
        lambda: read_observations_csv(path, SIZE),
        lambda: read_named_observations(path, lambda _: SIZE, Names()),
    )


TARGET = Target(
    'observations_csv',
    'observations.csv',
    _read,
    lambda: [
        *written(lambda path: write_observations_csv(path, frames())),
        b'fluoroscope;exposure;target_id;u;v;sigma\ncam 1;x.tif;p1;1,5;2,5;0,3\n',
    ],
)
