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

"""Observations as CSV, with ids and with names."""

from __future__ import annotations

from pathlib import Path

from fluoro_calib_ros.exposures.names import Names
from fluoro_calib_ros.files.observations import (
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
        lambda: read_named_observations(path, SIZE, Names()),
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
