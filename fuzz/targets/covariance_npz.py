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
"""The covariance matrix of an adjustment; the fuzzer sees its arrays without the archive."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fluoro_calib_ros.calibration.joint_precision import JointPrecision
from fluoro_calib_ros.files.covariance import read_covariance, write_covariance

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
