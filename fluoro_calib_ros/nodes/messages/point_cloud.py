# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""PointCloud2 of reconstructed points."""

from __future__ import annotations

import numpy as np
from fluoro_calib_msgs.msg import ReconstructedPoints
from sensor_msgs.msg import PointCloud2, PointField

from .fields import uint8_field

POINT_TYPE = np.dtype([('x', '<f4'), ('y', '<f4'), ('z', '<f4'), ('id', '<u4'), ('sigma', '<f4')])
_FIELD_TYPES = {'f': PointField.FLOAT32, 'u': PointField.UINT32}


def point_cloud(message: ReconstructedPoints, good: np.ndarray) -> PointCloud2:
    """Return a cloud of the good points (indices) of a message: x, y, z, id, sigma [m]."""
    points = np.empty(len(good), dtype=POINT_TYPE)
    for name in 'xyz':
        points[name] = np.asarray(getattr(message, name))[good]
    points['id'] = np.asarray(message.target_id)[good]
    variance = sum(
        np.asarray(getattr(message, name))[good] for name in ('cov_xx', 'cov_yy', 'cov_zz')
    )
    points['sigma'] = np.sqrt(variance / 3)
    cloud = PointCloud2(
        header=message.header,
        height=1,
        width=len(good),
        is_dense=True,
        point_step=POINT_TYPE.itemsize,
        row_step=POINT_TYPE.itemsize * len(good),
    )
    cloud.fields = [
        PointField(
            name=name,
            offset=offset,
            datatype=_FIELD_TYPES[kind.kind],
            count=1,
        )
        for name, (kind, offset, *_) in (POINT_TYPE.fields or {}).items()
    ]
    cloud.data = uint8_field(points.view(np.uint8))
    return cloud
