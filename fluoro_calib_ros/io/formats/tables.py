# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Shared by formats: number tables in text files; 3-D points and bodies at a constant rate."""

from __future__ import annotations

import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...errors import DataError, quoted
from ...exposures.frame import Frame, points_on_image
from ...exposures.names import Names, number_names, without_trivial
from ...findings import sentence_of
from ...limits import MAX_ROWS
from ..access import PathLike, atomic_file, check_rows, read_text
from ..csv_table import decimal_comma_advice, from_text, split_rows, without_zeros
from .content import Bodies, Content, FileSettings, Points

MISSING = ('', 'nan', 'none', 'null', 'na', 'n/a')


def with_sigma_of_likelihood(
    frames: Sequence[Frame], likelihood: Sequence[NDArray[np.float64]]
) -> list[Frame]:
    """Return frames whose points have standard deviations of 1 px / likelihood.

    likelihood: (n,) for each frame, as stated by a network. If all are 1, as in files that this
    package writes, the frames are returned unchanged, as nothing is known. Residuals are weighted
    by the likelihood, as by Karashchuk et al., "Anipose: A toolkit for robust markerless 3D pose
    estimation", Cell Reports 36, 2021. The pixel is a convention: these programs do not state the
    size of their errors; an adjustment estimates it.
    """
    if all((values == 1).all() for values in likelihood):
        return list(frames)
    return [replace(frame, sigma=1.0 / values) for frame, values in zip(frames, likelihood)]


def frame_of(
    where: object,
    fluoroscope: str,
    number: int,
    target_id: NDArray[np.int64],
    uv: NDArray[np.float64],
    image_size: tuple[int, int],
) -> Frame:
    """Return a frame of image points of a file.

    Raises DataError, whose message begins with where, for a point off the image.
    """
    on_image = points_on_image(uv, image_size)
    if not on_image.all():
        u, v = uv[np.argmin(on_image)]
        raise DataError(
            f'{where}: the point ({u:g}, {v:g}) is outside the image of {image_size[0]} x '
            f'{image_size[1]} px'
        )
    return Frame(fluoroscope, number, target_id, uv, image_size, frame_id=f'{fluoroscope}_optical')


@dataclass(frozen=True)
class Row:
    """A row of a table: its number in the file, counted from 1, and its stripped cells."""

    path: PathLike
    line: int
    cells: list[str]

    def fail(self, cause: str) -> NoReturn:
        """Raise DataError for the row."""
        raise DataError(f'{self.place}: {cause}')

    @property
    def place(self) -> str:
        """File and row, in words."""
        return f'{self.path}, row {self.line}'

    def numbers(self, first: int = 0) -> list[float]:
        """Return the cells from column `first` on as finite numbers. Raises DataError."""
        values = self.numbers_or_nan(first)
        for column, value in enumerate(values, first):
            if math.isnan(value):
                self.fail(f'column {column + 1} is {self.cells[column]!r}, not a number')
        return values

    def numbers_or_nan(self, first: int = 0) -> list[float]:
        """Return the cells from column `first` on as numbers, NaN for missing ones."""
        values = []
        for column, cell in enumerate(self.cells[first:], first):
            try:
                if '_' in cell:  # Python reads 1_0 as 10
                    raise ValueError
                value = math.nan if cell.lower() in MISSING else float(cell)
            except ValueError:
                value = math.inf
            if math.isinf(value):
                cause = f'column {column + 1} is {quoted(cell)}, not a number'
                self.fail(sentence_of(cause, decimal_comma_advice(cell)))
            values.append(value)
        return values

    def whole(self, column: int, label: str) -> int:
        """Return a cell as a non-negative integer. Raises DataError."""
        cell = without_zeros(self.cells[column])
        if not cell.isascii() or not cell.isdigit():
            self.fail(f'{label} is {quoted(cell)}, not an integer')
        return int(cell)


def read_table(path: PathLike, separator: str | None = None) -> list[Row]:
    """Return the rows of a text file that are not blank.

    separator: ' ' for any whitespace; by default a semicolon if the first row has one (then with
    decimal commas, as spreadsheets write them in many countries), otherwise a tabulator or a
    comma. Raises DataError for a file that cannot be read, is not text or has no rows.
    """
    return table_of(path, read_text(path), separator)


def table_of(path: PathLike, text: str, separator: str | None = None) -> list[Row]:
    """Return the rows of a text as `read_table` does; path is for messages."""
    if '\0' in text:
        raise DataError(f'{path}: this is not text, it contains a byte 0')
    check_rows(text, MAX_ROWS, path)
    if separator == ' ':
        rows = [Row(path, n, line.split()) for n, line in enumerate(text.splitlines(), 1)]
    else:
        lines = io.StringIO(text, newline='')
        split = split_rows(path, lines, separator or separator_of(text), 'a table')
        rows = [Row(path, n, [from_text(cell.strip()) for cell in cells]) for n, cells in split]
    rows = [row for row in rows if any(row.cells)]
    if not rows:
        raise DataError(f'{path}: the file has no rows')
    return rows


def separator_of(text: str) -> str:
    """Return the separator found in the first row that is not blank."""
    first_line = next((line for line in text.splitlines() if line.strip()), '')
    return next((mark for mark in ';\t' if mark in first_line), ',')


def read_frames(path: PathLike) -> tuple[Row, list[Row], int]:
    """Return header and rows of a table with one row a frame, and 1 if its first column is Frame.

    The third value is otherwise 0. Raises DataError as `read_table`, and for missing rows.
    """
    header, *rows = read_table(path)
    if not rows:
        raise DataError(f'{path}: the file has a header, but no rows')
    return header, rows, int(header.cells[0].lower() == 'frame')


def frame_numbers(rows: Sequence[Row], first: int) -> list[int]:
    """Return the frame numbers: the column Frame if first is 1, else 1, 2, 3, ..."""
    return [row.whole(0, 'Frame') if first else number for number, row in enumerate(rows, 1)]


def ascending_frames(rows: Sequence[Row], first: int) -> NDArray[np.int64]:
    """Return the frame numbers as `frame_numbers`. Raises DataError unless they ascend."""
    numbers = frame_numbers(rows, first)
    for previous, row, number in zip(numbers, rows[1:], numbers[1:]):
        if number <= previous:
            row.fail(f'frame {number} comes after frame {previous}')
    return np.array(numbers)


def check_row_count(path: PathLike, last: int, shift: int = 0) -> None:
    """Raise DataError if rows for all frames from 0 or 1 to the last one are too many to write."""
    if last + shift > MAX_ROWS:
        raise DataError(f'{path}: frame {last} would need as many rows, at most {MAX_ROWS}')


def require_width(rows: Iterable[Row], width: int, label: str) -> None:
    """Raise DataError for the first row that does not have `width` cells."""
    for row in rows:
        if len(row.cells) != width:
            row.fail(f'{len(row.cells)} columns, but {label} has {width}')


def number_text(value: float) -> str:
    """Return a number as text that reads back to the same value, 'NaN' for a missing one."""
    return 'NaN' if math.isnan(value) else repr(float(value))


def joined(values: Sequence[float] | np.ndarray, separator: str = ',') -> str:
    """Return numbers as a row of text."""
    return separator.join(number_text(value) for value in np.asarray(values, dtype=float).tolist())


# Characters that names in a table cannot contain, as named in messages.
_MARKS = {
    ',': 'a comma',
    ';': 'a semicolon',
    '\t': 'a tabulator',
    '\r': 'a line end',
    '\n': 'a line end',
}


def check_labels(path: PathLike, labels: Iterable[str], marks: str) -> None:
    """Raise DataError for a name with a line end, or with a mark that separates cells."""
    for label in labels:
        for mark in (*marks, '\r', '\n'):
            if mark in label:
                raise DataError(f'{path}: the name {label!r} contains {_MARKS[mark]}')


def write_frames(
    path: PathLike, columns: Iterable[str], frame: NDArray[np.int64], values: NDArray[np.float64]
) -> None:
    """Write a table with the column Frame and the numbers (m, ...) of each frame (m,)."""
    columns = list(columns)
    check_labels(path, columns, ',;\t')
    with atomic_file(path, 'w') as file:
        file.write(','.join(['Frame', *columns]) + '\n')
        for number, numbers in zip(frame.tolist(), values):
            file.write(f'{number},{joined(numbers.ravel())}\n')


# Target names in formats that require them.


def default_name(target_id: int) -> str:
    """Return the name of a target without one, in the style of XMALab: marker001."""
    return f'marker{target_id:03d}'


def named_targets(ids: Mapping[str, int]) -> dict[str, int]:
    """Return the ids of names that were given by a person."""
    return {name: i for name, i in without_trivial(ids).items() if name != default_name(i)}


def numbered_targets(
    targets: Sequence[str], known: Mapping[str, int]
) -> tuple[NDArray[np.int64], Names]:
    """Return the ids (n,) of targets named in a file, and the names given by a person."""
    ids = number_names(targets, known)
    target_ids = {name: ids[name] for name in targets}
    return np.array([target_ids[name] for name in targets], dtype=np.int64), Names(
        named_targets(target_ids)
    )


def are_numbers(lines: Sequence[str], rows: int, columns: int = 0) -> bool:
    """Return whether the lines are `rows` rows of equally many numbers; columns 0: any count."""
    try:
        widths = {len([float(cell) for cell in line.split(',')]) for line in lines}
    except ValueError:
        return False
    return len(lines) == rows and len(widths) == 1 and columns in (0, *widths)


@dataclass(frozen=True)
class Frames:
    """All frames of a recording: the first, their count, and their rate, NaN if unknown."""

    first: int
    count: int
    rate_hz: float

    @property
    def numbers(self) -> NDArray[np.int64]:
        """Frame numbers, shape (m,)."""
        return np.arange(self.first, self.first + self.count)

    @property
    def times_s(self) -> NDArray[np.float64]:
        """Times after the first frame [s], shape (m,)."""
        return np.arange(self.count) / self.rate_hz

    def expanded(
        self, frame: NDArray[np.int64], values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Expand the values (k, ...) of frames (k,) to all frames (m, ...), NaN where missing."""
        expanded = np.full((self.count, *values.shape[1:]), np.nan)
        expanded[frame - self.first] = values
        return expanded


def frames_of(
    path: Path,
    parts: Sequence[Points | Bodies],
    settings: FileSettings,
    needs_rate: bool = True,
) -> Frames:
    """Return all frames from the first to the last one of points and bodies.

    Raises DataError if a rate is needed and unknown, and for too many frames.
    """
    rates = (settings.rate_hz, *(part.rate_hz for part in parts))
    rate = next((rate for rate in rates if rate), None if needs_rate else math.nan)
    if rate is None:
        raise DataError(f'{path}: the source does not contain the frame rate, --rate HZ is needed')
    first_frame = min(int(part.frame[0]) for part in parts)
    count = max(int(part.frame[-1]) for part in parts) - first_frame + 1
    if count > MAX_ROWS:
        raise DataError(
            f'{path}: frames {first_frame} to {first_frame + count - 1} are too many to write'
        )
    return Frames(first_frame, count, float(rate))


Part = TypeVar('Part', Points, Bodies)


def at_all_frames(part: Part, frames: Frames) -> Part:
    """Expand points or bodies to all frames, NaN where there are none."""
    values: dict[str, Any] = {
        name: frames.expanded(part.frame, value)
        for name, value in vars(part).items()
        if isinstance(value, np.ndarray) and name not in ('frame', 'target_id')
    }
    return replace(part, frame=frames.numbers, rate_hz=frames.rate_hz, **values)


def rate_of(frame: NDArray[np.int64], stamp_ns: np.ndarray) -> float | None:
    """Return the frame rate [Hz] between the first and the last time stamp, None if unknown."""
    first = int(np.argmin(frame))
    last = int(np.argmax(frame))
    seconds = (stamp_ns[last] - stamp_ns[first]) / 1e9
    if not seconds > 0:
        return None
    rate = (frame[last] - frame[first]) / seconds
    rounded = round(rate)
    # A clock is off by some millionths, and stamps are rounded to nanoseconds.
    return float(rounded) if rounded and abs(rate - rounded) < 1e-5 * rounded else float(rate)


def labels(content: Content) -> list[str]:
    """Return the names of the targets; a target without a name is marker001, marker002, ..."""
    assert content.points is not None
    target_names = content.names.target_names()
    return [target_names.get(i, default_name(i)) for i in content.points.target_id.tolist()]
