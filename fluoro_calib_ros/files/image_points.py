"""Image points in a CSV file that are corrected and written back with all their other columns."""

from dataclasses import dataclass

import numpy as np

from ..calibration.result import CorrectedPoints
from ..distortion.status import CorrectionStatus
from ..errors import DataError
from .atomic import atomic_file
from .csv_table import format_float, read_blocks, write_rows

STATUS = tuple(status.name for status in CorrectionStatus)
ADDED = ('u_corrected', 'v_corrected', 'sigma', 'status')


@dataclass(frozen=True)
class PointsFile:
    """Image points of a CSV file: header and rows as text; lines (n,) numbers of the rows in the
    file; uv (n, 2) [px], NaN where a cell is empty or nan; sigma (n,) [px], NaN where empty, or
    None: no such column; fluoroscope (n,) names, or None: no such column.
    """

    path: str
    header: list
    rows: list
    lines: np.ndarray
    uv: np.ndarray
    sigma: np.ndarray | None
    fluoroscope: np.ndarray | None

    def added(self):
        """Names of the columns that write_points adds."""
        return [
            f'{name}_corrected' if name == 'sigma' and name in self.header else name
            for name in ADDED
        ]


def read_points(path):
    """The PointsFile of a CSV file with u, v [px], perhaps fluoroscope and sigma, and any other
    columns.

    Raises DataError that names the row and the cause; an empty u or v is none, it is a point
    without status OK.
    """
    header = None
    rows = []
    lines = []
    uv = []
    sigma = []
    names = []
    for block in read_blocks(path, ('u', 'v')):
        header = block.header
        rows += block.rows
        lines.append(block.lines)
        uv.append(np.column_stack([block.floats_or_nan('u'), block.floats_or_nan('v')]))
        if 'sigma' in block:
            sigma.append(block.floats_or_nan('sigma'))
            good = np.isnan(sigma[-1]) | (np.isfinite(sigma[-1]) & (sigma[-1] > 0))
            block.require('sigma', good, 'not a finite number above 0')
        if 'fluoroscope' in block:
            names += block.strings('fluoroscope')
    points = PointsFile(
        path,
        header,
        rows,
        np.concatenate(lines),
        np.concatenate(uv),
        np.concatenate(sigma) if sigma else None,
        np.array(names) if names else None,
    )
    taken = [name for name in points.added() if name in header]
    if taken:
        raise DataError(
            f'{path}: the file has a column {taken[0]} already, it would be there twice'
        )
    return points


def correct_points(points, calibrations):
    """CorrectedPoints of a PointsFile, with calibrations {fluoroscope: FluoroscopeCalibration}.

    A point without its own sigma has that of the calibration. Raises DataError where a point's
    fluoroscope has no calibration, or where the file does not tell the fluoroscope and there are
    several.
    """
    names = points.fluoroscope
    if names is None:
        if len(calibrations) != 1:
            raise DataError(
                f'{points.path}: the file has no column fluoroscope, and there are calibrations of '
                f'{", ".join(calibrations)}'
            )
        names = np.array([*calibrations] * len(points.uv))
    unknown = np.flatnonzero(~np.isin(names, list(calibrations)))
    if len(unknown):
        raise DataError(
            f'{points.path}, row {points.lines[unknown[0]]}: there is no calibration of fluoroscope '
            f'{str(names[unknown[0]])!r}, only of {", ".join(calibrations)}'
        )
    out = CorrectedPoints(
        np.full(points.uv.shape, np.nan),
        np.full(len(names), np.nan),
        np.full(len(names), CorrectionStatus.INVALID, dtype=np.uint8),
    )
    for name in np.unique(names):
        rows = np.flatnonzero(names == name)
        calibration = calibrations[str(name)]
        sigma = points.sigma
        if sigma is not None:
            sigma = np.where(np.isnan(sigma[rows]), calibration.image_sd, sigma[rows])
        part = calibration.correct(points.uv[rows], sigma)
        out.uv[rows] = part.uv
        out.sigma[rows] = part.sigma
        out.status[rows] = part.status
    return out


def write_points(path, points, corrected):
    """Write a PointsFile with its CorrectedPoints: the rows as they were, and u_corrected,
    v_corrected [px], sigma [px] (sigma_corrected where there is a sigma already) and status behind
    them. What is INVALID has empty cells. Raises DataError where the file cannot be written.
    """
    with atomic_file(path, 'w') as file:
        write_rows(file, [points.header + points.added()])
        write_rows(
            file,
            (
                [*row, format_float(u), format_float(v), format_float(sigma), STATUS[status]]
                for row, (u, v), sigma, status in zip(
                    points.rows,
                    corrected.uv.tolist(),
                    corrected.sigma.tolist(),
                    corrected.status.tolist(),
                )
            ),
        )
