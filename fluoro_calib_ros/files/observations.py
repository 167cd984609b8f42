# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Observations as CSV: `fluoroscope,exposure,target_id,u,v[,sigma][,angle_deg]`.

u, v and sigma are in pixels; angle_deg is the angle of the C-arm in degrees, the same in all rows
of an exposure of a fluoroscope, or empty.

Files of a lab may have names instead of ids in the first three columns.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from ..errors import DataError
from ..exposures.columns import first_repeated, is_positive
from ..exposures.frame import MAX_ANGLE, Frame, angle_in_degrees, points_on_image
from ..exposures.names import Names, safe_names, without_trivial
from ..exposures.strays import few
from .access import check_safe_name
from .atomic import atomic_file
from .csv_table import Block, format_float, read_blocks, write_rows
from .named_column import NamedColumn

ANGLE = 'angle_deg'
CORRECTED_BY = 'corrected_by'  # id of the calibration, of image points that are corrected already
COLUMNS = ('fluoroscope', 'exposure', 'target_id', 'u', 'v')

PathLike = str | os.PathLike[str]


@dataclass(frozen=True)
class _Rows:
    """Rows of the file as arrays.

    Attributes
    ----------
    code : (n,) ndarray of int
        Index of the fluoroscope in the order of first occurrence.
    exposure, target_id : (n,) ndarray of int
    uv : (n, 2) ndarray
        [px]
    sigma : (n,) ndarray
        [px], NaN where unknown.
    angle : (n,) ndarray
        Of the C-arm [degrees], NaN where unknown.
    line : (n,) ndarray of int
        Number of the row in the file.
    """

    code: np.ndarray
    exposure: np.ndarray
    target_id: np.ndarray
    uv: np.ndarray
    sigma: np.ndarray
    angle: np.ndarray
    line: np.ndarray

    def __getitem__(self, rows: np.ndarray) -> _Rows:
        return _Rows(*(getattr(self, field.name)[rows] for field in fields(self)))


def read_observations_csv(
    path: PathLike, image_size: tuple[int, int] | None = None
) -> dict[str, list[Frame]]:
    """Read the frames of a CSV file, fluoroscopes by name and exposures by number.

    The rows of a frame may be anywhere in the file. sigma is given for all targets of a frame or
    for none.

    Parameters
    ----------
    path : path-like
    image_size : (int, int), optional
        Width and height of the images of all fluoroscopes [px]; required, as the file does not
        contain it.

    Returns
    -------
    dict of str to list of Frame

    Raises
    ------
    DataError
        For text that is not a number, a point off the image, and a target that occurs twice in a
        frame. The message names the row.
    """
    return _read(path, image_size, _Columns(None))[0]


def read_named_observations(
    path: PathLike, image_size: tuple[int, int] | None, known: Names
) -> tuple[dict[str, list[Frame]], Names, str]:
    """Read the frames of a CSV file in which fluoroscopes, exposures and targets may have names.

    known are names whose ids are given. Returns the frames by id of the fluoroscope, the names of
    the file, and a sentence about the few points that are off the image and left out, or ''.
    Raises DataError as `read_observations_csv` does.
    """
    columns = _Columns(known)
    frames, stray = _read(path, image_size, columns)
    return frames, columns.names(), stray


class _Columns:
    """What was read of the columns with names; without known names they are ids."""

    def __init__(self, known: Names | None) -> None:
        self.codes: dict[str, int] = {}
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
        """Return the names that are not ids themselves."""
        pairs = zip(self.codes, self.fluoroscopes())
        return Names(
            without_trivial(self.target.ids()),
            without_trivial(self.exposure.ids()),
            {name: identity for name, identity in pairs if name != identity},
        )


def _read(
    path: PathLike, image_size: tuple[int, int] | None, columns: _Columns
) -> tuple[dict[str, list[Frame]], str]:
    if image_size is None:
        raise DataError(
            f'{path}: a CSV file does not contain the image size, --image-size WxH is needed'
        )
    blocks = read_blocks(path, COLUMNS)
    rows = _concatenate([_parse(block, columns) for block in blocks])
    rows, stray = _on_image(path, rows, image_size, columns.known is not None)
    rows = replace(
        rows,
        exposure=columns.exposure.numbers(rows.exposure),
        target_id=columns.target.numbers(rows.target_id),
    )
    names = columns.fluoroscopes()
    frames: dict[str, list[Frame]] = {name: [] for name in sorted(names)}
    for of_frame in _by_frame(rows, names):
        name = names[of_frame.code[0]]
        frames[name].append(_frame(path, name, of_frame, image_size))
    return {name: of_one for name, of_one in frames.items() if of_one}, stray


def _on_image(
    path: PathLike, rows: _Rows, image_size: tuple[int, int], leave_out: bool
) -> tuple[_Rows, str]:
    """Return the rows without a few that are off the image, and a sentence about these.

    Raises DataError where they are many, or are not to be left out.
    """
    off = ~points_on_image(rows.uv, image_size)
    if not off.any():
        return rows, ''
    first = int(np.argmax(off))
    u, v = rows.uv[first]
    sentence = (
        f'{path}, row {rows.line[first]}: the point ({u:g}, {v:g}) is off the image of '
        f'{image_size[0]} x {image_size[1]} px'
    )
    if not leave_out or not few(int(off.sum()), len(off)):
        raise DataError(sentence)
    more = f', and {off.sum() - 1} more' if off.sum() > 1 else ''
    return rows[~off], f'not used: {sentence}{more}'


def write_observations_csv(
    path: PathLike,
    frames: Mapping[str, Sequence[Frame]] | Iterable[Frame],
    names: Names | None = None,
    corrected_by: Mapping[str, str] | None = None,
) -> None:
    """Write frames, by fluoroscope or as a sequence, to a CSV file.

    The file has a column sigma if any frame has sigma, and angle_deg if any has an angle. Names
    are written instead of ids in a column whose ids all have one. corrected_by are the ids of the
    calibrations that corrected the image points, a further column. Raises DataError where the file
    cannot be written.
    """
    if isinstance(frames, Mapping):
        frames = [frame for of_fluoroscope in frames.values() for frame in of_fluoroscope]
    frames = list(frames)
    with_sigma = any(frame.sigma is not None for frame in frames)
    with_angle = any(frame.angle is not None for frame in frames)
    labels = _labels(frames, names or Names())
    with atomic_file(path, 'w') as file:
        header = COLUMNS + ('sigma',) * with_sigma + (ANGLE,) * with_angle
        write_rows(file, [header + (CORRECTED_BY,) * bool(corrected_by)])
        for frame in frames:
            check_safe_name(frame.fluoroscope, path)
            last = [corrected_by.get(frame.fluoroscope, '')] if corrected_by else []
            rows = _csv_rows(frame, with_sigma, with_angle, labels)
            write_rows(file, ([*row, *last] for row in rows))


def corrections_of(path: PathLike) -> dict[str, str]:
    """Return by fluoroscope the ids of calibrations that corrected the points of a CSV file.

    {} for points as they were observed. Raises DataError.
    """
    found: dict[str, str] = {}
    for block in read_blocks(path, COLUMNS):
        if CORRECTED_BY not in block:
            return {}
        found |= dict(zip(block.strings('fluoroscope'), block.strings(CORRECTED_BY)))
    return {name: identity for name, identity in found.items() if identity}


@dataclass(frozen=True)
class _Labels:
    """Names to write instead of ids, empty for a column that is written as ids."""

    fluoroscopes: Mapping[str, str]
    exposures: Mapping[int, str]
    targets: Mapping[int, str]


def _labels(frames: Sequence[Frame], names: Names) -> _Labels:
    """Return the names of the columns whose ids all have one."""
    exposures = names.exposure_names()
    targets = names.target_names()
    if not all(frame.number in exposures for frame in frames):
        exposures = {}
    if not all(int(i) in targets for frame in frames for i in frame.target_id):
        targets = {}
    return _Labels(names.fluoroscope_names(), exposures, targets)


def _parse(block: Block, columns: _Columns) -> _Rows:
    """Return a block of the file as arrays; new names are added to columns."""
    names = block.strings('fluoroscope')
    codes = columns.codes
    for name in dict.fromkeys(names):
        if name not in codes:
            if columns.known is None or not name:
                check_safe_name(name, f'{block.path}, row {block.lines[names.index(name)]}')
            codes[name] = len(codes)
    uv = np.column_stack([block.floats('u'), block.floats('v')])
    sigma = np.full(len(uv), np.nan)
    if 'sigma' in block:
        sigma = block.floats_or_nan('sigma')
        is_empty = np.array([cell == '' for cell in block.strings('sigma')])
        block.require('sigma', is_empty | is_positive(sigma), 'not a finite number above 0')
    angle = np.full(len(uv), np.nan)
    if ANGLE in block:
        angle = block.floats_or_nan(ANGLE)
        block.require(
            ANGLE, np.isnan(angle) | (np.abs(angle) <= np.degrees(MAX_ANGLE)), 'not an angle'
        )
    code = np.array([codes[name] for name in names])
    exposure = columns.exposure.read(block)
    return _Rows(code, exposure, columns.target.read(block), uv, sigma, angle, block.lines)


def _concatenate(parts: Sequence[_Rows]) -> _Rows:
    return _Rows(
        *(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(_Rows))
    )


def _by_frame(rows: _Rows, names: Sequence[str]) -> Iterator[_Rows]:
    """Yield the rows of each frame, by name of the fluoroscope and number of the exposure.

    Within a frame the order of the file is kept.
    """
    rank = np.argsort(np.argsort(names))[rows.code]
    order = np.lexsort((rows.exposure, rank))
    ordered = rows[order]
    new_code = np.diff(ordered.code, prepend=-1)
    new_exposure = np.diff(ordered.exposure, prepend=-1)
    starts = np.flatnonzero(new_code | new_exposure)
    for of_frame in np.split(order, starts[1:]):
        yield rows[of_frame]


def _frame(path: PathLike, name: str, rows: _Rows, image_size: tuple[int, int]) -> Frame:
    """Return the frame of its rows. Raises DataError."""
    where = f'of fluoroscope {name}, exposure {rows.exposure[0]}'
    repeated = first_repeated(rows.target_id)
    if repeated is not None:
        first, second = repeated
        raise DataError(
            f'{path}, row {rows.line[second]}: target {rows.target_id[second]} {where} is already '
            f'given in row {rows.line[first]}'
        )
    unknown = np.isnan(rows.sigma)
    if unknown.any() and not unknown.all():
        row = np.argmax(unknown)
        raise DataError(
            f'{path}, row {rows.line[row]}: sigma of target {rows.target_id[row]} {where} is '
            f'empty, but other targets of this exposure have one'
        )
    width, height = image_size
    return Frame(
        name,
        int(rows.exposure[0]),
        rows.target_id,
        rows.uv,
        (int(width), int(height)),
        None if unknown.all() else rows.sigma,
        frame_id=f'{name}_optical',
        angle=_angle(path, where, rows),
    )


def _angle(path: PathLike, where: str, rows: _Rows) -> float | None:
    """Return the angle [rad] of the rows of a frame, None without one. Raises DataError."""
    differs = ~((rows.angle == rows.angle[0]) | np.isnan(rows.angle) & np.isnan(rows.angle[0]))
    if differs.any():
        row = np.argmax(differs)
        raise DataError(
            f'{path}, row {rows.line[row]}: {ANGLE} {where} is {rows.angle[row]:g}, '
            f'but {rows.angle[0]:g} in row {rows.line[0]}'
        )
    return None if np.isnan(rows.angle[0]) else float(np.radians(rows.angle[0]))


def _csv_rows(
    frame: Frame, with_sigma: bool, with_angle: bool, labels: _Labels
) -> Iterator[list[Any]]:
    fluoroscope = labels.fluoroscopes.get(frame.fluoroscope, frame.fluoroscope)
    exposure = labels.exposures.get(int(frame.number), int(frame.number))
    columns: list[Iterable[Any]] = [
        [labels.targets.get(i, i) for i in np.asarray(frame.target_id).tolist()],
        *(map(repr, np.asarray(column, float).tolist()) for column in frame.uv.T),
    ]
    if with_sigma:
        sigma = np.full(len(frame.target_id), np.nan) if frame.sigma is None else frame.sigma
        columns.append(map(format_float, sigma))
    if with_angle:
        angle = np.nan if frame.angle is None else angle_in_degrees(frame.angle)
        columns.append([format_float(angle)] * len(frame.target_id))
    return ([fluoroscope, exposure, *cells] for cells in zip(*columns))
