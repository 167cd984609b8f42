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

"""Files <adjustment>.covariance.npz: covariance matrix of all unknowns (docs/result_folder.md)."""

from __future__ import annotations

import numpy as np

from ..calibration.joint_precision import JointPrecision
from .access import PathLike
from .arrays import ArraySpec, Layout, read_arrays, to_arrays, write_arrays

SUFFIX = '.covariance.npz'
_LAYOUT = Layout(
    'a covariance',
    {
        'names': ArraySpec('text', ('u',)),
        'values': ArraySpec('float', ('u',), allowed='nan'),
        'covariance': ArraySpec('float', ('u', 'u')),
    },
    version=1,
    readable=(1,),
)


def write_covariance(path: PathLike, joint: JointPrecision) -> None:
    """Write the covariance matrix of an adjustment. Raises DataError."""
    values = {
        'names': np.array(joint.names),
        'values': joint.values,
        'covariance': joint.covariance,
    }
    write_arrays(path, _LAYOUT, to_arrays(path, _LAYOUT, values))


def read_covariance(path: PathLike) -> JointPrecision:
    """Read the covariance matrix of an adjustment. Raises DataError."""
    arrays = read_arrays(path, _LAYOUT)
    names = tuple(str(name) for name in arrays['names'])
    return JointPrecision(names, arrays['values'], arrays['covariance'])
