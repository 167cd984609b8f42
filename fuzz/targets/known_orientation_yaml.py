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

"""Known orientations as YAML."""

from __future__ import annotations

import numpy as np

from fluoro_calib_ros.files.known_orientation import (
    read_known_orientations,
    write_known_orientations,
)
from fluoro_calib_ros.photogrammetry.known_orientation import KnownOrientation

from ..harness import Target
from ..seeds import written

KNOWN = KnownOrientation(
    np.array([511.5, 511.5, 4000.0]),
    np.eye(3),
    np.array([0.0, 0.0, -1000.0]),
    (1.0, 1.0, 10.0),
    (0.5, 0.001),
)

TARGET = Target(
    'known_orientation_yaml',
    'known_orientation.yaml',
    read_known_orientations,
    lambda: written(lambda path: write_known_orientations(path, {'a': KNOWN, 'b': KNOWN})),
)
