# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""ReconstructedPoints: points in the rig frame with their covariance, in metres."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from fluoro_calib_msgs.msg import ReconstructedPoints
from geometry_msgs.msg import Point
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from ...exposures.stamps import NS_PER_S
from ...photogrammetry.rig_orientation import RigOrientation
from ...photogrammetry.rotations import quaternion_from_matrix
from ...reconstruction.intersection import IntersectedPoints
from .observations import (
    ENCAPSULATION,
    TIME,
    UINT32,
    columns_bytes,
    string_bytes,
    string_sequence_bytes,
    uint8_field,
)

_TERMS = [0, 1, 2, 4, 5, 8]  # indices into a flattened covariance: xx, xy, xz, yy, yz, zz
_SYMMETRIC = ('xx', 'xy', 'xz', 'xy', 'yy', 'yz', 'xz', 'yz', 'zz')


class PointsContent(NamedTuple):
    """Content of a ReconstructedPoints message."""

    #: of the exposure
    stamp_ns: int
    frame_number: int
    orientation_id: str
    orientation: RigOrientation  #: orientation with which the points were intersected
    target_id: NDArray[np.integer]  #: (n,)
    points: IntersectedPoints  #: n points


def encode_reconstructed_points(content: PointsContent) -> bytes:
    """Return the bytes of a ReconstructedPoints message."""
    orientation = content.orientation
    points = content.points
    sec, nanosec = divmod(content.stamp_ns, NS_PER_S)
    start = b''.join(
        (
            ENCAPSULATION,
            TIME.pack(sec, nanosec),
            string_bytes(orientation.frame_id),
            UINT32.pack(content.frame_number),
        )
    )
    columns = (
        *np.divide(points.xyz_mm.T, 1000, order='C'),
        *(points.covariance.reshape(-1, 9).T[_TERMS] * 1e-6),
        points.residual,
    )
    octets = (points.rays.astype(np.uint8), points.status)
    ids = string_bytes(content.orientation_id) + string_sequence_bytes(orientation.calibration_ids)
    return columns_bytes(
        start, content.target_id.astype(np.uint32).tobytes(), columns, octets, ids
    )


def covariance_of(message: ReconstructedPoints) -> NDArray[np.float64]:
    """Return the covariance matrices (n, 3, 3) of a message [m^2]."""
    columns = [np.asarray(getattr(message, f'cov_{name}')) for name in _SYMMETRIC]
    return np.stack(columns, axis=1).reshape(-1, 3, 3)


class GoodPoints(NamedTuple):
    """Intersected points of a ReconstructedPoints message."""

    frame_number: int
    total: int  #: number of all points of the message, including failed ones
    target_id: NDArray[np.uint32]  #: (n,)
    xyz_mm: NDArray[np.float64]  #: (n, 3)
    covariance: NDArray[np.float64]  #: (n, 3, 3) [mm^2]


def good_points_of(message: ReconstructedPoints) -> GoodPoints:
    """Return the points of a message with the status OK or OUTSIDE."""
    good = np.array(message.status) <= message.OUTSIDE
    xyz = np.stack([message.x, message.y, message.z], axis=1)
    return GoodPoints(
        message.frame_number,
        len(good),
        np.array(message.target_id)[good],
        1e3 * xyz[good],
        1e6 * covariance_of(message)[good],
    )


# MarkerArray of reconstructed points: covariance ellipsoids for RViz.

GREEN = ColorRGBA(r=0.2, g=0.9, b=0.3, a=0.8)
YELLOW = ColorRGBA(r=1.0, g=0.8, b=0.1, a=0.8)
LIFETIME_NS = 500_000_000  # time after which RViz removes a marker that is no longer published


def ellipsoid_markers(
    message: ReconstructedPoints, good: NDArray[np.int64], sigmas: float
) -> MarkerArray:
    """Return covariance ellipsoids of the good points (indices) of a message.

    sigmas: half axes in standard deviations.
    """
    values, axes = np.linalg.eigh(covariance_of(message)[good])
    axes[:, :, 0] *= np.linalg.det(axes)[:, None]  # make it a rotation, not a reflection
    attitudes = quaternion_from_matrix(axes).tolist()
    scales = (2 * sigmas * np.sqrt(np.maximum(values, 0))).tolist()
    out = MarkerArray()
    for k, attitude, scale in zip(good.tolist(), attitudes, scales):
        marker = Marker(
            header=message.header, ns='targets', id=int(message.target_id[k]), type=Marker.SPHERE
        )
        position = marker.pose.position
        position.x = message.x[k]
        position.y = message.y[k]
        position.z = message.z[k]
        q = marker.pose.orientation
        q.w, q.x, q.y, q.z = attitude
        marker.scale.x, marker.scale.y, marker.scale.z = scale
        marker.color = GREEN if message.status[k] == message.OK else YELLOW
        marker.lifetime.nanosec = LIFETIME_NS
        out.markers.append(marker)
    return out


# mocap4r2 Markers of reconstructed points, if mocap4r2_msgs is installed.

try:
    from mocap4r2_msgs import msg as mocap
except ImportError:
    mocap = None


def mocap_markers(message: ReconstructedPoints, good: NDArray[np.int64]) -> mocap.Markers:
    """Return the good points (indices) of a message; each marker index is the target id."""
    out = mocap.Markers(header=message.header, frame_number=message.frame_number)
    for k in good.tolist():
        out.markers.append(
            mocap.Marker(
                id_type=mocap.Marker.USE_INDEX,
                marker_index=int(message.target_id[k]),
                translation=Point(x=message.x[k], y=message.y[k], z=message.z[k]),
            )
        )
    return out


# PointCloud2 of reconstructed points.

POINT_TYPE = np.dtype([('x', '<f4'), ('y', '<f4'), ('z', '<f4'), ('id', '<u4'), ('sigma', '<f4')])
_FIELD_TYPES = {'f': PointField.FLOAT32, 'u': PointField.UINT32}


def point_cloud(message: ReconstructedPoints, good: NDArray[np.int64]) -> PointCloud2:
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


# Further message types of the good points (indices), published while they have subscribers.
POINT_FORMS = {'points': (PointCloud2, point_cloud)}
if mocap is not None:
    POINT_FORMS['mocap_markers'] = (mocap.Markers, mocap_markers)
