# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The orientation of a rig; the fuzzer sees its arrays without the archive and its checksums."""

from __future__ import annotations

from fluoro_calib_ros.io.calibration import load_orientation, save_orientation

from ..harness import Target
from ..seeds import archive_of, flattened, in_folder, orientation

TARGET = Target(
    'orientation_npz',
    'rig_orientation.npz',
    load_orientation,
    lambda: [flattened(in_folder(lambda folder: save_orientation(folder, orientation())))],
    archive_of,
)
