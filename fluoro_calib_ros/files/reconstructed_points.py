"""Reconstructed points as CSV: one row a point of a frame, lengths in mm, the residual in pixels."""

import numpy as np

from ..reconstruction.intersection import STATUS_NAMES
from .atomic import atomic_file
from .csv_table import cell_of, write_rows

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


def write_reconstruction(path, frames):
    """Write ReconstructedFrames to a CSV file; what is not known, as the coordinates of a point
    that one fluoroscope alone sees, is an empty cell. Raises DataError where the file cannot be
    written.
    """
    with atomic_file(path, 'w') as file:
        write_rows(file, [COLUMNS])
        for frame in frames:
            points = frame.points
            numbers = np.column_stack([points.xyz_mm, points.sd_mm, points.residual]).tolist()
            write_rows(
                file,
                (
                    [
                        frame.number,
                        frame.stamp_ns,
                        target,
                        *map(cell_of, row),
                        rays,
                        STATUS_NAMES[status],
                    ]
                    for target, row, rays, status in zip(
                        frame.target_id.tolist(),
                        numbers,
                        points.rays.tolist(),
                        points.status.tolist(),
                    )
                ),
            )
