# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Known orientations as YAML."""

from __future__ import annotations

import numpy as np

from fluoro_calib_ros.io.formats.native import read_known_orientations, write_known_orientations
from fluoro_calib_ros.photogrammetry.rig_orientation import KnownOrientation

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
