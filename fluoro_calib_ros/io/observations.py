# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Observations as CSV: `fluoroscope,exposure,target_id,u,v[,sigma][,angle_deg]`.

u, v and sigma are in pixels. angle_deg is the angle of the C-arm in degrees. It is the same in all
rows of a frame (one fluoroscope, one exposure), or empty.

The first three columns may contain names instead of ids.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import repeat
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..correction.base import CorrectionStatus
from ..correction.fluoroscope_calibration import (
    Calibrations,
    CorrectedPoints,
)
from ..errors import DataError
from ..exposures.frame import (
    DECIMALS,
    Frame,
    Frames,
    angle_in_degrees,
    angles_of,
    few,
    points_on_image,
)
from ..exposures.names import Names, safe_names, without_trivial
from ..exposures.phantom import first_repeated, is_positive
from ..limits import MAX_FRAMES
from ..rows import chosen_rows, joined_rows
from .access import PathLike, check_safe_name
from .csv_table import (
    Block,
    NamedColumn,
    Table,
    from_text,
    read_all,
    read_blocks,
)

ANGLE = 'angle_deg'
CORRECTED_BY = 'corrected_by'  # id of the calibration that corrected the image points
COLUMNS = ('fluoroscope', 'exposure', 'target_id', 'u', 'v')
NOT_SEEN = 'remove the rows of targets that are not seen'  # advice


@dataclass(frozen=True)
class _Rows:
    """Rows of the file as arrays."""

    code: NDArray[np.int64]  #: (n,), index of the fluoroscope in the order of first occurrence
    exposure: NDArray[np.int64]  #: (n,)
    target_id: NDArray[np.int64]  #: (n,)
    uv: NDArray[np.float64]  #: (n, 2) [px]
    sigma: NDArray[np.float64]  #: (n,) [px], NaN where unknown
    angle: NDArray[np.float64]  #: (n,), angle of the C-arm [degrees], NaN where unknown
    line: NDArray[np.int64]  #: (n,), number of the row in the file

    def __getitem__(self, rows: np.ndarray) -> _Rows:
        return chosen_rows(self, rows)


def read_observations_csv(path: PathLike, image_size: tuple[int, int]) -> dict[str, list[Frame]]:
    """Read the frames of a CSV file, by name of the fluoroscope.

    The rows of a frame may be anywhere in the file. sigma is given for all targets of a frame or
    for none. image_size [px] applies to all fluoroscopes; the file does not contain it.

    Raises DataError that names the row for text that is not a number, a point off the image, and a
    target that occurs twice in a frame.
    """
    return _read(path, lambda _: image_size, _Columns(None))[0]


def read_named_observations(
    path: PathLike, image_size: Callable[[str], tuple[int, int]], known: Names
) -> tuple[dict[str, list[Frame]], Names, str, dict[str, str]]:
    """Read the frames of a CSV file in which fluoroscopes, exposures and targets may have names.

    image_size: returns width and height [px] for the id of a fluoroscope, or raises DataError.
    known: names whose ids are already known. Returns the frames by fluoroscope id, the names of
    the file, a sentence about excluded points off the image ('' if there are none), and by
    fluoroscope the id of the calibration that corrected its points (empty for observed points).
    Raises DataError as `read_observations_csv` does, and if more than a few points are off the
    image.
    """
    columns = _Columns(known)
    frames, stray = _read(path, image_size, columns)
    corrected_by = {name: identity for name, identity in columns.corrected_by.items() if identity}
    return frames, columns.names(), stray, corrected_by


class _Columns:
    """State of the columns that may contain names; if known is None, they contain ids only."""

    def __init__(self, known: Names | None) -> None:
        self.codes: dict[str, int] = {}
        self.corrected_by: dict[str, str] = {}
        self.known = known
        self.exposure = NamedColumn('exposure', None if known is None else known.exposures)
        self.target = NamedColumn('target_id', None if known is None else known.targets)

    def fluoroscopes(self) -> list[str]:
        """Return the ids of the fluoroscopes, in the order of their codes."""
        if self.known is None:
            return list(self.codes)
        ids = safe_names(self.codes, self.known.fluoroscopes)
        return [ids[name] for name in self.codes]

    def names(self) -> Names:
        """Return the names that differ from their ids."""
        pairs = zip(self.codes, self.fluoroscopes())
        return Names(
            without_trivial(self.target.ids()),
            without_trivial(self.exposure.ids()),
            {name: identity for name, identity in pairs if name != identity},
        )


def _read(
    path: PathLike, image_size: Callable[[str], tuple[int, int]], columns: _Columns
) -> tuple[dict[str, list[Frame]], str]:
    blocks = read_blocks(path, COLUMNS)
    rows = joined_rows([_parse(block, columns) for block in blocks])
    names = columns.fluoroscopes()
    sizes = np.array([image_size(name) for name in names])
    rows, stray = _on_image(path, rows, sizes[rows.code], columns.known is not None)
    rows = replace(
        rows,
        exposure=columns.exposure.numbers(rows.exposure),
        target_id=columns.target.numbers(rows.target_id),
    )
    frames: dict[str, list[Frame]] = {name: [] for name in sorted(names)}
    for number, frame_rows in enumerate(_by_frame(rows, names)):
        if number == MAX_FRAMES:
            raise DataError(f'{path}: more than {MAX_FRAMES} frames are not read')
        name = names[frame_rows.code[0]]
        frames[name].append(_frame(path, name, frame_rows, sizes[frame_rows.code[0]]))
    return {name: view_frames for name, view_frames in frames.items() if view_frames}, stray


def _on_image(
    path: PathLike, rows: _Rows, image_size: NDArray[np.int64], leave_out: bool
) -> tuple[_Rows, str]:
    """Exclude a few points that are off the image; return the remaining rows and a sentence.

    image_size: (n, 2), width and height of the image of each row [px].

    The sentence names the first excluded point and counts the others. Raises DataError if
    leave_out is false or too many points are off the image.
    """
    is_off = ~points_on_image(rows.uv, image_size)
    if not is_off.any():
        return rows, ''
    row = int(np.argmax(is_off))
    u, v = rows.uv[row]
    sentence = (
        f'{path}, row {rows.line[row]}: the point ({u:g}, {v:g}) is outside the image of '
        f'{image_size[row, 0]} x {image_size[row, 1]} px'
    )
    if not leave_out or not few(int(is_off.sum()), len(is_off)):
        raise DataError(sentence)
    addition = f', and {is_off.sum() - 1} more' if is_off.sum() > 1 else ''
    return rows[~is_off], f'not used: {sentence}{addition}'


def write_observations_csv(
    path: PathLike,
    frames: Frames | Iterable[Frame],
    names: Names | None = None,
    corrected_by: Mapping[str, str] | None = None,
) -> None:
    """Write frames, by fluoroscope or as a sequence, to a CSV file.

    The file has a column sigma if any frame has sigma, and angle_deg if any frame has an angle.
    A fluoroscope is written by name if it has one; exposures and targets if all of them have one.
    corrected_by, ids of the calibrations that corrected the image points by fluoroscope, adds a
    column. Raises DataError if the file cannot be written.
    """
    if isinstance(frames, Mapping):
        frames = [frame for view_frames in frames.values() for frame in view_frames]
    frames = list(frames)
    for frame in frames:
        check_safe_name(frame.fluoroscope, path)
    observation_table(frames, names, corrected_by).write(path)


def observation_table(
    frames: Sequence[Frame],
    names: Names | None = None,
    corrected_by: Mapping[str, str] | None = None,
) -> Table:
    """Return frames as a table; see write_observations_csv."""
    names = names or Names()
    fluoroscopes = names.fluoroscope_names()
    exposures = names.exposure_names()
    targets = names.target_names()
    if not all(frame.number in exposures for frame in frames):
        exposures = {}
    if not all(int(i) in targets for frame in frames for i in frame.target_id):
        targets = {}
    with_sigma = any(frame.sigma is not None for frame in frames)
    with_angle = any(frame.angle is not None for frame in frames)

    def rows() -> Iterator[list[Any]]:
        for frame in frames:
            unknown = np.full(len(frame.target_id), np.nan)
            sigma = unknown if frame.sigma is None else frame.sigma
            more: list[Iterable[Any]] = [sigma.tolist()] * with_sigma
            more += [repeat(_angle_cell(frame))] * with_angle
            if corrected_by:
                more.append(repeat(corrected_by.get(frame.fluoroscope, '')))
            name = fluoroscopes.get(frame.fluoroscope, frame.fluoroscope)
            yield from _rows_of(frame, name, exposures, targets, more)

    header = COLUMNS + ('sigma',) * with_sigma + (ANGLE,) * with_angle
    return Table(header + (CORRECTED_BY,) * bool(corrected_by), rows())


def _rows_of(
    frame: Frame,
    name: str,
    exposures: Mapping[int, str],
    targets: Mapping[int, str],
    more: Iterable[Iterable[Any]] = (),
) -> Iterator[list[Any]]:
    """Yield COLUMNS and more columns of each image point, with the names of ids that have one."""
    number = int(frame.number)
    ids = [targets.get(i, i) for i in np.asarray(frame.target_id).tolist()]
    for cells in zip(ids, *np.asarray(frame.uv, float).T.tolist(), *more):
        yield [name, exposures.get(number, number), *cells]


def _parse(block: Block, columns: _Columns) -> _Rows:
    """Return a block of the file as arrays; add new names to columns."""
    names = block.strings('fluoroscope')
    codes = columns.codes
    for name in dict.fromkeys(names):
        if name not in codes:
            if columns.known is None or not name:
                check_safe_name(name, f'{block.path}, row {block.lines[names.index(name)]}')
            codes[name] = len(codes)
    if CORRECTED_BY in block:
        columns.corrected_by |= zip(names, block.strings(CORRECTED_BY))
    uv = np.column_stack([block.floats(name, NOT_SEEN) for name in 'uv'])
    unknown = np.full(len(uv), np.nan)
    return _Rows(
        np.array([codes[name] for name in names]),
        columns.exposure.read(block),
        target_id=columns.target.read(block),
        uv=uv,
        sigma=_sigma(block, ('',)) if 'sigma' in block else unknown,
        angle=block.angles_deg(ANGLE) if ANGLE in block else unknown,
        line=block.lines,
    )


def _by_frame(rows: _Rows, names: Sequence[str]) -> Iterator[_Rows]:
    """Yield the rows of each frame, sorted by fluoroscope name and exposure number.

    Rows within a frame keep the order of the file.
    """
    rank = np.argsort(np.argsort(names))[rows.code]
    order = np.lexsort((rows.exposure, rank))
    ordered = rows[order]
    new_code = np.diff(ordered.code, prepend=-1)
    new_exposure = np.diff(ordered.exposure, prepend=-1)
    starts = np.flatnonzero(new_code | new_exposure)
    for indices in np.split(order, starts[1:]):
        yield rows[indices]


def _frame(path: PathLike, name: str, rows: _Rows, image_size: NDArray[np.int64]) -> Frame:
    """Return the frame with these rows. Raises DataError."""
    where = f'of fluoroscope {name}, exposure {rows.exposure[0]}'
    repeated = first_repeated(rows.target_id)
    if repeated is not None:
        first, second = repeated
        raise DataError(
            f'{path}, row {rows.line[second]}: target {rows.target_id[second]} {where} is already '
            f'given in row {rows.line[first]}'
        )
    without_sigma = np.isnan(rows.sigma)
    if without_sigma.any() and not without_sigma.all():
        row = np.argmax(without_sigma)
        raise DataError(
            f'{path}, row {rows.line[row]}: sigma of target {rows.target_id[row]} {where} is '
            f'empty, but other targets of this exposure have one'
        )
    width, height = image_size
    return Frame(
        name,
        int(rows.exposure[0]),
        target_id=rows.target_id,
        uv=rows.uv,
        image_size=(int(width), int(height)),
        sigma=None if without_sigma.all() else rows.sigma,
        frame_id=f'{name}_optical',
        angle=_angle(path, where, rows),
    )


def _angle(path: PathLike, where: str, rows: _Rows) -> float | None:
    """Return the angle of the C-arm in a frame [rad], None if not given. Raises DataError."""
    differs = ~((rows.angle == rows.angle[0]) | np.isnan(rows.angle) & np.isnan(rows.angle[0]))
    if differs.any():
        row = np.argmax(differs)
        raise DataError(
            f'{path}, row {rows.line[row]}: {ANGLE} {where} is {rows.angle[row]:g}, '
            f'but {rows.angle[0]:g} in row {rows.line[0]}'
        )
    return None if np.isnan(rows.angle[0]) else float(np.radians(rows.angle[0]))


# Observations extracted from images: `fluoroscope,exposure,target_id,u,v,sigma,overlapped`.
#
# The columns after sigma are flags: files of tracked markers also have `doubtful`. If images have
# the angle of a C-arm, the last column is `angle_deg`.


FLAGS = ('overlapped', 'doubtful')


def write_extracted(
    path: PathLike,
    frames: Sequence[tuple[Frame, Sequence[NDArray[np.bool_]]]],
    target_names: Mapping[int, str],
    flags: tuple[str, ...] = FLAGS,
) -> None:
    """Write frames, each with its flags (n,), to a CSV file.

    The angle is written if any frame has one, and the name of a target instead of its id if it has
    one. Raises DataError if the file cannot be written.
    """
    with_angle = any(frame.angle is not None for frame, _ in frames)

    def rows() -> Iterator[list[Any]]:
        for frame, values in frames:
            check_safe_name(frame.fluoroscope, path)
            assert frame.sigma is not None
            rounded = replace(frame, uv=np.round(frame.uv, DECIMALS))
            more: list[Iterable[Any]] = [np.round(frame.sigma, DECIMALS).tolist()]
            more += [flag.astype(int).tolist() for flag in values]
            more += [repeat(_angle_cell(frame))] * with_angle
            yield from _rows_of(rounded, frame.fluoroscope, {}, target_names, more)

    Table((*COLUMNS, 'sigma', *flags, *(ANGLE,) * with_angle), rows()).write(path)


def _angle_cell(frame: Frame) -> float:
    return np.nan if frame.angle is None else float(angle_in_degrees(frame.angle))


# Image points of a CSV file, to be corrected and written with all other columns unchanged.

STATUS = tuple(status.name for status in CorrectionStatus)
ADDED_COLUMNS = ('u_corrected', 'v_corrected', 'sigma', 'status')


@dataclass(frozen=True)
class PointsFile:
    """Image points of a CSV file."""

    path: PathLike
    header: list[str]
    rows: list[list[str]]  #: all cells as text
    lines: NDArray[np.int64]  #: (n,), number of each row in the file
    uv: NDArray[np.float64]  #: (n, 2) [px], NaN where a cell is empty or nan
    #: (n,) [px], NaN where the cell is empty; None if there is no such column
    sigma: NDArray[np.float64] | None
    fluoroscope: NDArray[np.str_] | None  #: (n,), None if there is no such column
    #: (n,), angle of the C-arm [rad], NaN where the cell is empty; None if there is no such column
    angle: NDArray[np.float64] | None = None

    @property
    def added_columns(self) -> list[str]:
        """Names of the columns that `write_points` adds."""
        return [
            f'{name}_corrected' if name == 'sigma' and name in self.header else name
            for name in ADDED_COLUMNS
        ]


def points_of_frames(path: PathLike, frames: Frames, names: Names) -> PointsFile:
    """Return the image points of frames as rows of a CSV file; path is for messages.

    Targets and exposures are written by name if they have one.
    """
    exposures = names.exposure_names()
    targets = names.target_names()
    all_frames = [frame for view_frames in frames.values() for frame in view_frames]
    if not all_frames:
        raise DataError(f'{path}: the file has no image points')
    rows = [
        list(map(str, row))
        for f in all_frames
        for row in _rows_of(f, f.fluoroscope, exposures, targets)
    ]
    return PointsFile(
        path=path,
        header=list(COLUMNS),
        rows=rows,
        lines=np.arange(2, len(rows) + 2),
        uv=np.concatenate([f.uv for f in all_frames]),
        sigma=None,
        fluoroscope=np.array([row[0] for row in rows]),
        angle=np.concatenate(
            [np.repeat(a, len(f.uv)) for f, a in zip(all_frames, angles_of(all_frames))]
        ),
    )


def read_points(path: PathLike, known: Mapping[str, str] | None = None) -> PointsFile:
    """Read a CSV file with the columns u, v [px], optionally fluoroscope, sigma and angle_deg.

    Other columns are kept as text. angle_deg is the angle of the C-arm in degrees. u and v may be
    empty; such a point will have the status INVALID. known maps names of fluoroscopes to ids.
    Raises DataError that names row and cause.
    """
    table = read_all(path, ('u', 'v'))
    header = table.header
    names = table.strings('fluoroscope') if 'fluoroscope' in header else []
    names = [(known or {}).get(name, name) for name in names]
    points = PointsFile(
        path=path,
        header=header,
        rows=[list(map(from_text, row)) for row in table.rows],
        lines=table.lines,
        uv=np.column_stack([table.floats_or_nan('u'), table.floats_or_nan('v')]),
        sigma=_sigma(table) if 'sigma' in header else None,
        fluoroscope=np.array(names) if 'fluoroscope' in header else None,
        angle=np.radians(table.angles_deg(ANGLE)) if ANGLE in header else None,
    )
    if CORRECTED_BY in header:
        raise DataError(
            f'{path}: the image points are already corrected, according to its column '
            f'{CORRECTED_BY}: give the observed image points'
        )
    for name in points.added_columns:
        if name in header:
            raise DataError(
                f'{path}: the file already has a column {name}, which would be written twice'
            )
    return points


def _sigma(block: Block, unknown: tuple[str, ...] = ('', 'nan')) -> NDArray[np.float64]:
    """Return the column sigma [px], NaN for cells that say that it is unknown."""
    sigma = block.floats_or_nan('sigma')
    is_unknown = np.array([cell.lower() in unknown for cell in block.strings('sigma')])
    block.require('sigma', is_unknown | is_positive(sigma), 'not a finite number above 0')
    return sigma


def correct_points(
    points: PointsFile, calibrations: Calibrations, angle: float | None = None
) -> CorrectedPoints:
    """Correct image points with the calibrations of their fluoroscopes.

    A point without sigma gets that of its calibration; a point without an angle gets angle [rad].
    Raises DataError for a fluoroscope without a calibration, and for a file without the column
    fluoroscope if there are several calibrations.
    """
    names = points.fluoroscope
    if names is None:
        if len(calibrations) != 1:
            raise DataError(
                f'{points.path}: the file has no column fluoroscope, and there are calibrations '
                f'of {", ".join(calibrations)}'
            )
        names = np.array([*calibrations] * len(points.uv))
    without_calibration = np.flatnonzero(~np.isin(names, list(calibrations)))
    if len(without_calibration):
        first_row = without_calibration[0]
        raise DataError(
            f'{points.path}, row {points.lines[first_row]}: there is no calibration of '
            f'fluoroscope {str(names[first_row])!r}, only of {", ".join(calibrations)}'
        )
    corrected = CorrectedPoints(
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
        view_points = calibration.correct(points.uv[rows], sigma, angle=angles)
        corrected.uv[rows] = view_points.uv
        corrected.sigma[rows] = view_points.sigma
        corrected.status[rows] = view_points.status
    return corrected


def write_points(path: PathLike, points: PointsFile, corrected: CorrectedPoints) -> None:
    """Write the rows of a PointsFile with additional columns.

    These are u_corrected, v_corrected [px], sigma [px] (sigma_corrected if the file already has a
    column sigma) and status. The additional numbers of an INVALID point are empty. Raises
    DataError if the file cannot be written.
    """
    numbers = np.column_stack([corrected.uv, corrected.sigma]).tolist()
    rows = (
        [*row, *values, STATUS[status]]
        for row, values, status in zip(points.rows, numbers, corrected.status.tolist())
    )
    Table((*points.header, *points.added_columns), rows).write(path)
