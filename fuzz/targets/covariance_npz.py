# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The covariance matrix of an adjustment; the fuzzer sees its arrays without the archive."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fluoro_calib_ros.estimation.fixed_calibration import JointPrecision
from fluoro_calib_ros.io.result_document import read_covariance, write_covariance

from ..harness import Broken, Target
from ..seeds import archive_of, flattened, written


def _read(path: Path) -> None:
    joint = read_covariance(path)
    count = len(joint.names)
    if joint.values.shape != (count,) or joint.covariance.shape != (count, count):
        raise Broken(f'{count} names, {joint.values.shape} values, {joint.covariance.shape}')


def _seeds() -> list[bytes]:
    joint = JointPrecision(('a.c', 'a.xp'), np.array([4000.0, 500.0]), np.eye(2))
    return [flattened(content) for content in written(lambda path: write_covariance(path, joint))]


TARGET = Target('covariance_npz', 'joint.covariance.npz', _read, _seeds, archive_of)
