# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Image points in a CSV file, which are corrected and written with all their other columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..calibration.result import CorrectedPoints, FluoroscopeCalibration
from ..distortion.status import CorrectionStatus
from ..errors import DataError
from ..exposures.columns import is_positive
from ..exposures.frame import MAX_ANGLE, Frame, angles_of
from ..exposures.names import Names
from .access import PathLike
from .atomic import atomic_file
from .csv_table import Block, format_float, read_blocks, write_rows
from .observations import ANGLE, CORRECTED_BY

STATUS = tuple(status.name for status in CorrectionStatus)
ADDED_COLUMNS = ('u_corrected', 'v_corrected', 'sigma', 'status')


@dataclass(frozen=True)
class PointsFile:
    """Image points of a CSV file.

    Attributes
    ----------
    path : path-like
    header : list of str
    rows : list of list of str
        All cells as text.
    lines : (n,) ndarray of int
        Number of each row in the file.
    uv : (n, 2) ndarray
        [px], NaN where a cell is empty or nan.
    sigma : (n,) ndarray or None
        [px], NaN where a cell is empty; None without such a column.
    fluoroscope : (n,) ndarray of str or None
        None without such a column.
    angle : (n,) ndarray or None
        Of the C-arm [rad], NaN where a cell is empty; None without such a column.
    """

    path: PathLike
    header: list[str]
    rows: list[list[str]]
    lines: np.ndarray
    uv: np.ndarray
    sigma: np.ndarray | None
    fluoroscope: np.ndarray | None
    angle: np.ndarray | None = None

    @property
    def added_columns(self) -> list[str]:
        """Names of the columns that `write_points` adds."""
        return [
            f'{name}_corrected' if name == 'sigma' and name in self.header else name
            for name in ADDED_COLUMNS
        ]


def points_of_frames(
    path: PathLike, frames: Mapping[str, Sequence[Frame]], names: Names
) -> PointsFile:
    """Return the image points of frames as the rows of a CSV file; path is for messages.

    Targets and exposures have their names where they have some.
    """
    exposures = names.exposure_names()
    targets = names.target_names()
    flat = [frame for of_fluoroscope in frames.values() for frame in of_fluoroscope]
    if not flat:
        raise DataError(f'{path}: the file has no image points')
    rows = [
        [
            f.fluoroscope,
            str(exposures.get(f.number, f.number)),
            str(targets.get(i, i)),
            *map(repr, uv),
        ]
        for f in flat
        for i, uv in zip(f.target_id.tolist(), f.uv.tolist())
    ]
    return PointsFile(
        path,
        ['fluoroscope', 'exposure', 'target_id', 'u', 'v'],
        rows,
        np.arange(2, len(rows) + 2),
        np.concatenate([f.uv for f in flat]),
        None,
        np.array([row[0] for row in rows]),
        np.concatenate([np.repeat(a, len(f.uv)) for f, a in zip(flat, angles_of(flat))]),
    )


def read_points(path: PathLike, known: Mapping[str, str] | None = None) -> PointsFile:
    """Read a CSV file with the columns u, v [px], optionally fluoroscope and sigma, and others.

    A column angle_deg has the angle of the C-arm in degrees. u and v may be empty; such a point
    will have the status INVALID. known are the ids of
    fluoroscopes that have names. Raises DataError that names row and cause.
    """
    known = known or {}
    blocks = list(read_blocks(path, ('u', 'v')))
    header = blocks[0].header
    points = PointsFile(
        path,
        header,
        [row for block in blocks for row in block.rows],
        np.concatenate([block.lines for block in blocks]),
        np.concatenate([_uv(block) for block in blocks]),
        np.concatenate([_sigma(block) for block in blocks]) if 'sigma' in header else None,
        np.array([known.get(n, n) for block in blocks for n in block.strings('fluoroscope')])
        if 'fluoroscope' in header
        else None,
        np.concatenate([_angle(block) for block in blocks]) if ANGLE in header else None,
    )
    if CORRECTED_BY in header:
        raise DataError(
            f'{path}: the image points are corrected already, as its column {CORRECTED_BY} says: '
            'give the observed ones'
        )
    for name in points.added_columns:
        if name in header:
            raise DataError(
                f'{path}: the file already has a column {name}, which would be written twice'
            )
    return points


def _uv(block: Block) -> np.ndarray:
    return np.column_stack([block.floats_or_nan('u'), block.floats_or_nan('v')])


def _sigma(block: Block) -> np.ndarray:
    sigma = block.floats_or_nan('sigma')
    block.require('sigma', np.isnan(sigma) | is_positive(sigma), 'not a finite number above 0')
    return sigma


def _angle(block: Block) -> np.ndarray:
    angle = np.radians(block.floats_or_nan(ANGLE))
    block.require(ANGLE, np.isnan(angle) | (np.abs(angle) <= MAX_ANGLE), 'not an angle')
    return angle


def correct_points(
    points: PointsFile,
    calibrations: Mapping[str, FluoroscopeCalibration],
    angle: float | None = None,
) -> CorrectedPoints:
    """Correct image points with the calibrations of their fluoroscopes.

    A point without sigma has that of the calibration, one without an angle that of angle [rad].
    Raises DataError for a fluoroscope without
    calibration, and for a file without the column fluoroscope where there are several
    calibrations.
    """
    names = points.fluoroscope
    if names is None:
        if len(calibrations) != 1:
            raise DataError(
                f'{points.path}: the file has no column fluoroscope, and there are calibrations '
                f'of {", ".join(calibrations)}'
            )
        names = np.array([*calibrations] * len(points.uv))
    unknown = np.flatnonzero(~np.isin(names, list(calibrations)))
    if len(unknown):
        first = unknown[0]
        raise DataError(
            f'{points.path}, row {points.lines[first]}: there is no calibration of fluoroscope '
            f'{str(names[first])!r}, only of {", ".join(calibrations)}'
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
            sigma = np.where(
                np.isnan(sigma[rows]), calibration.image_sd_at(points.uv[rows]), sigma[rows]
            )
        angles = np.full(len(rows), np.nan if points.angle is None else points.angle[rows])
        if angle is not None:
            angles[np.isnan(angles)] = angle
        part = calibration.correct(points.uv[rows], sigma, angle=angles)
        out.uv[rows] = part.uv
        out.sigma[rows] = part.sigma
        out.status[rows] = part.status
    return out


def write_points(path: PathLike, points: PointsFile, corrected: CorrectedPoints) -> None:
    """Write the rows of a PointsFile with further columns.

    These are u_corrected, v_corrected [px], sigma [px] (sigma_corrected where the file has a
    sigma) and status. The cells of a point that is INVALID are empty. Raises DataError where the
    file cannot be written.
    """
    numbers = np.column_stack([corrected.uv, corrected.sigma]).tolist()
    with atomic_file(path, 'w') as file:
        write_rows(file, [points.header + points.added_columns])
        write_rows(
            file,
            (
                [*row, *map(format_float, values), STATUS[status]]
                for row, values, status in zip(points.rows, numbers, corrected.status.tolist())
            ),
        )
