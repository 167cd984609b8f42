# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Poses and motion of bodies as CSV: a row for each body and exposure, in mm, s and rad.

A pose takes points of the body to the frame of the reconstructed points; errors of a rotation are
about the axes of that frame. The motion is that of the centre of the markers of a body.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ..bodies.body import STATUS_NAMES, Body, BodyPoses
from ..bodies.tracking import TrackedExposure
from ..photogrammetry.rotations import quaternion_from_matrix
from .access import PathLike
from .csv_table import format_float, write_table

COLUMNS = (
    *('body', 'exposure', 'time_s', 'x_mm', 'y_mm', 'z_mm', 'qx', 'qy', 'qz', 'qw'),
    *('sd_x_mm', 'sd_y_mm', 'sd_z_mm', 'sd_rx_rad', 'sd_ry_rad', 'sd_rz_rad', 'markers', 'status'),
)
_VALUES = (
    *('vx_mm_s', 'vy_mm_s', 'vz_mm_s', 'wx_rad_s', 'wy_rad_s', 'wz_rad_s'),
    *('ax_mm_s2', 'ay_mm_s2', 'az_mm_s2', 'alpha_x_rad_s2', 'alpha_y_rad_s2', 'alpha_z_rad_s2'),
)
MOTION_COLUMNS = ('body', 'exposure', 'time_s', *_VALUES, *(f'sd_{name}' for name in _VALUES))


def write_poses(path: PathLike, poses: Sequence[BodyPoses], start_ns: int) -> None:
    """Write poses.csv, with times since start_ns. What is unknown is an empty cell.

    Raises DataError where the file cannot be written.
    """
    write_table(path, COLUMNS, (row for one in poses for row in _rows(one, start_ns)))


def _rows(one: BodyPoses, start_ns: int) -> Iterator[list[object]]:
    known = one.known
    quaternion = np.full((len(known), 4), np.nan)
    quaternion[known] = quaternion_from_matrix(one.rotation[known])
    time_s = (one.stamp_ns - start_ns)[:, None] / 1e9
    numbers = np.hstack([time_s, one.position_mm, np.roll(quaternion, -1, axis=1), one.sd])
    rows = zip(one.number.tolist(), numbers.tolist(), one.markers.tolist(), one.status)
    for number, values, markers, status in rows:
        yield [one.body, number, *map(format_float, values), markers, STATUS_NAMES[status]]


def write_motion(
    path: PathLike, bodies: Sequence[Body], exposures: Sequence[TrackedExposure], start_ns: int
) -> None:
    """Write motion.csv: velocities and accelerations with their standard deviations.

    Raises DataError where the file cannot be written.
    """
    rows = (
        _motion(body, row, one, start_ns) for row, body in enumerate(bodies) for one in exposures
    )
    write_table(path, MOTION_COLUMNS, rows)


def _motion(body: Body, row: int, one: TrackedExposure, start_ns: int) -> list[object]:
    sd = np.sqrt(np.diagonal(one.covariance[row])[6:])
    values = np.concatenate([one.velocity[row], one.acceleration[row], sd])
    time_s = (one.stamp_ns - start_ns) / 1e9
    return [body.name, one.number, *map(format_float, [time_s, *values.tolist()])]
