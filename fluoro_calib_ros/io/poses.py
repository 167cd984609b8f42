# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Results in space as CSV: poses and motion of bodies, and reconstructed points.

Poses and motion have a row for each body and exposure, in mm, s and rad. A pose takes points of
the body to the frame of the reconstructed points; errors of a rotation are about the axes of that
frame. The motion is that of the centre of the markers of a body.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from ..bodies.body import STATUS_NAMES as POSE_STATUS
from ..bodies.body import Body, BodyPoses
from ..bodies.tracking import TrackedExposure
from ..exposures.names import Names
from ..photogrammetry.rotations import quaternion_from_matrix
from ..reconstruction.intersection import STATUS_NAMES
from ..reconstruction.reconstruct import ReconstructedFrame
from .access import PathLike
from .csv_table import Table

COLUMNS = (
    *('body', 'exposure', 'time_s', 'x_mm', 'y_mm', 'z_mm', 'qx', 'qy', 'qz', 'qw'),
    *('sd_x_mm', 'sd_y_mm', 'sd_z_mm', 'sd_rx_rad', 'sd_ry_rad', 'sd_rz_rad', 'markers', 'status'),
)
_VALUES = (
    *('vx_mm_s', 'vy_mm_s', 'vz_mm_s', 'wx_rad_s', 'wy_rad_s', 'wz_rad_s'),
    *('ax_mm_s2', 'ay_mm_s2', 'az_mm_s2', 'alpha_x_rad_s2', 'alpha_y_rad_s2', 'alpha_z_rad_s2'),
)
MOTION_COLUMNS = ('body', 'exposure', 'time_s', *_VALUES, *(f'sd_{name}' for name in _VALUES))


def pose_table(poses: Sequence[BodyPoses], start_ns: int) -> Table:
    """Return poses.csv, with times since start_ns."""
    return Table(COLUMNS, (row for one in poses for row in _rows(one, start_ns)))


def _rows(one: BodyPoses, start_ns: int) -> Iterator[list[object]]:
    known = one.known
    quaternion = np.full((len(known), 4), np.nan)
    quaternion[known] = quaternion_from_matrix(one.rotation[known])
    time_s = (one.stamp_ns - start_ns)[:, None] / 1e9
    numbers = np.hstack([time_s, one.position_mm, np.roll(quaternion, -1, axis=1), one.sd])
    rows = zip(one.number.tolist(), numbers.tolist(), one.markers.tolist(), one.status)
    for number, values, markers, status in rows:
        yield [one.body, number, *values, markers, POSE_STATUS[status]]


def motion_table(
    bodies: Sequence[Body], exposures: Sequence[TrackedExposure], start_ns: int
) -> Table:
    """Return motion.csv: velocities and accelerations with their standard deviations."""
    rows = (
        _motion(body, row, one, start_ns) for row, body in enumerate(bodies) for one in exposures
    )
    return Table(MOTION_COLUMNS, rows)


def _motion(body: Body, row: int, one: TrackedExposure, start_ns: int) -> list[object]:
    sd = np.sqrt(np.diagonal(one.covariance[row])[6:])
    values = np.concatenate([one.velocity[row], one.acceleration[row], sd])
    time_s = (one.stamp_ns - start_ns) / 1e9
    return [body.name, one.number, time_s, *values.tolist()]


# Reconstructed points as CSV: one row for a point of a frame, lengths in mm, residuals in px.

POINT_COLUMNS = (
    *('frame', 'stamp_ns', 'target_id', 'x', 'y', 'z'),
    *('sd_x', 'sd_y', 'sd_z', 'residual', 'rays', 'status'),
)
NAME_COLUMN = 'name'  # the last one, of targets that have names


def write_reconstruction(
    path: PathLike, frames: Iterable[ReconstructedFrame], names: Names | None = None
) -> None:
    """Write reconstructed frames to a CSV file, with a column name where targets have names.

    What is unknown, such as the coordinates of a point that only one fluoroscope sees, is an empty
    cell. Raises DataError where the file cannot be written.
    """
    point_table(frames, names).write(path)


def point_table(frames: Iterable[ReconstructedFrame], names: Names | None = None) -> Table:
    """Return reconstructed frames as a table, with a column name where targets have names."""
    labels = (names or Names()).target_names()
    rows = (
        [*row, labels.get(row[2], '')] if labels else row
        for frame in frames
        for row in _point_rows(frame)
    )
    return Table((*POINT_COLUMNS, NAME_COLUMN) if labels else POINT_COLUMNS, rows)


def _point_rows(frame: ReconstructedFrame) -> Iterable[list[Any]]:
    points = frame.points
    numbers = np.column_stack([points.xyz_mm, points.sd_mm, points.residual])
    for target, values, rays, status in zip(
        frame.target_id.tolist(), numbers.tolist(), points.rays.tolist(), points.status.tolist()
    ):
        yield [frame.number, frame.stamp_ns, target, *values, rays, STATUS_NAMES[status]]
