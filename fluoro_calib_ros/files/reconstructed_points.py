"""Reconstructed points as CSV: one row for a point of a frame, lengths in mm, residuals in px."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from ..reconstruction.intersection import STATUS_NAMES
from ..reconstruction.reconstruct import ReconstructedFrame
from .atomic import atomic_file
from .csv_table import format_float, write_rows

COLUMNS = (
    'frame',
    'stamp_ns',
    'target_id',
    'x',
    'y',
    'z',
    'sd_x',
    'sd_y',
    'sd_z',
    'residual',
    'rays',
    'status',
)


def write_reconstruction(
    path: str | os.PathLike[str], frames: Iterable[ReconstructedFrame]
) -> None:
    """Write reconstructed frames to a CSV file.

    What is unknown, such as the coordinates of a point that only one fluoroscope sees, is an empty
    cell. Raises DataError where the file cannot be written.
    """
    with atomic_file(path, 'w') as file:
        write_rows(file, [COLUMNS])
        for frame in frames:
            write_rows(file, _rows(frame))


def _rows(frame: ReconstructedFrame) -> Iterator[list[Any]]:
    points = frame.points
    numbers = np.column_stack([points.xyz_mm, points.sd_mm, points.residual])
    for target, values, rays, status in zip(
        frame.target_id.tolist(), numbers.tolist(), points.rays.tolist(), points.status.tolist()
    ):
        cells = map(format_float, values)
        yield [frame.number, frame.stamp_ns, target, *cells, rays, STATUS_NAMES[status]]
