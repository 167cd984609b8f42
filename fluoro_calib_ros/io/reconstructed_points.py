# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Reconstructed points as CSV: one row for a point of a frame, lengths in mm, residuals in px."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from ..exposures.names import Names
from ..reconstruction.intersection import STATUS_NAMES
from ..reconstruction.reconstruct import ReconstructedFrame
from .access import PathLike
from .csv_table import format_float, write_table

COLUMNS = (
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
    labels = (names or Names()).target_names()
    rows = (
        [*row, labels.get(row[2], '')] if labels else row
        for frame in frames
        for row in _rows(frame)
    )
    write_table(path, (*COLUMNS, NAME_COLUMN) if labels else COLUMNS, rows)


def _rows(frame: ReconstructedFrame) -> Iterable[list[Any]]:
    points = frame.points
    numbers = np.column_stack([points.xyz_mm, points.sd_mm, points.residual])
    for target, values, rays, status in zip(
        frame.target_id.tolist(), numbers.tolist(), points.rays.tolist(), points.status.tolist()
    ):
        cells = map(format_float, values)
        yield [frame.number, frame.stamp_ns, target, *cells, rays, STATUS_NAMES[status]]
