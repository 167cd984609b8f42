# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

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
