# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""ReconstructedPoints: points in the rig frame with their covariance, in metres."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from fluoro_calib_msgs.msg import ReconstructedPoints

from ...photogrammetry.rig_orientation import RigOrientation
from ...reconstruction.intersection import IntersectedPoints
from .cdr import (
    ENCAPSULATION,
    TIME,
    UINT32,
    columns_bytes,
    string_bytes,
    string_sequence_bytes,
)
from .fields import NS_PER_S, float64_field, stamp_from_nanoseconds, uint8_field, uint32_field

# Field of each term of the covariance, and its index in the flattened matrix.
_COVARIANCE = {'cov_xx': 0, 'cov_xy': 1, 'cov_xz': 2, 'cov_yy': 4, 'cov_yz': 5, 'cov_zz': 8}
_TERMS = list(_COVARIANCE.values())
_SYMMETRIC = (
    'cov_xx',
    'cov_xy',
    'cov_xz',
    'cov_xy',
    'cov_yy',
    'cov_yz',
    'cov_xz',
    'cov_yz',
    'cov_zz',
)


class PointsContent(NamedTuple):
    """Content of a ReconstructedPoints message.

    Attributes
    ----------
    stamp_ns, frame_number : int
        Those of the exposure.
    orientation_id : str
    orientation : RigOrientation
        Orientation with which the points were intersected.
    target_id : np.ndarray
        (n,)
    points : IntersectedPoints
        n points.
    """

    stamp_ns: int
    frame_number: int
    orientation_id: str
    orientation: RigOrientation
    target_id: np.ndarray
    points: IntersectedPoints


def message_from_points(content: PointsContent) -> ReconstructedPoints:
    """Return the message of reconstructed points."""
    orientation = content.orientation
    points = content.points
    message = ReconstructedPoints()
    message.header.stamp = stamp_from_nanoseconds(content.stamp_ns)
    message.header.frame_id = orientation.frame_id
    message.frame_number = content.frame_number
    message.target_id = uint32_field(content.target_id)
    message.x, message.y, message.z = (float64_field(column) for column in points.xyz_mm.T / 1000)
    terms = points.covariance.reshape(-1, 9).T * 1e-6
    for name, row in _COVARIANCE.items():
        setattr(message, name, float64_field(terms[row]))
    message.residual = float64_field(points.residual)
    message.rays = uint8_field(points.rays)
    message.status = uint8_field(points.status)
    message.orientation_id = content.orientation_id
    message.calibration_id = list(orientation.calibration_ids)
    return message


def encode_reconstructed_points(content: PointsContent) -> bytes:
    """Return the bytes of the message of reconstructed points."""
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


def covariance_of(message: ReconstructedPoints) -> np.ndarray:
    """Return the covariance matrices (n, 3, 3) of a message [m^2]."""
    columns = [np.asarray(getattr(message, name)) for name in _SYMMETRIC]
    return np.stack(columns, axis=1).reshape(-1, 3, 3)


class GoodPoints(NamedTuple):
    """The intersected points of a ReconstructedPoints message.

    Attributes
    ----------
    frame_number : int
    total : int
        Number of all points of the message, the ones that failed among them.
    target_id : np.ndarray
        (n,)
    xyz_mm : np.ndarray
        (n, 3)
    covariance : np.ndarray
        (n, 3, 3) [mm^2]
    """

    frame_number: int
    total: int
    target_id: np.ndarray
    xyz_mm: np.ndarray
    covariance: np.ndarray


def good_points_of(message: ReconstructedPoints) -> GoodPoints:
    """Return the points of a message that are OK or OUTSIDE."""
    good = np.array(message.status) <= message.OUTSIDE
    xyz = np.stack([message.x, message.y, message.z], axis=1)
    return GoodPoints(
        message.frame_number,
        len(good),
        np.array(message.target_id)[good],
        1e3 * xyz[good],
        1e6 * covariance_of(message)[good],
    )
