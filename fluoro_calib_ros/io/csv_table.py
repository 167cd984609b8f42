# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""CSV tables: columns by name, and errors that name the row.

If the header contains semicolons and no comma, cells are separated by semicolons and numbers have
decimal commas, as spreadsheets write them in many countries.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain, islice
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError, quoted
from ..exposures.frame import MAX_ANGLE
from ..exposures.names import MAX_ID, Names, number_names
from ..exposures.phantom import first_repeated
from ..findings import sentence_of
from ..limits import MAX_ROWS_CSV
from .access import PathLike, atomic_file, check_rows, check_safe_name, read_text

if TYPE_CHECKING:
    import pandas

BLOCK = 10_000  # rows converted at a time, which bounds the memory


@dataclass(frozen=True)
class Block:
    """A block of rows of a table."""

    path: PathLike  #: file name, for messages
    header: list[str]  #: names of the columns
    rows: list[list[str]]
    lines: NDArray[np.int64]  #: (n,), number of each row in the file; the header is row 1

    def __contains__(self, name: str) -> bool:
        return name in self.header

    def strings(self, name: str) -> list[str]:
        """Return the cells of a column without surrounding blanks."""
        cells = list(map(str.strip, map(itemgetter(self.header.index(name)), self.rows)))
        return list(map(from_text, cells)) if "'" in ''.join(cells) else cells

    def floats(self, name: str, if_missing: str = '') -> NDArray[np.float64]:
        """Return a column (n,) of finite numbers. Raises DataError.

        if_missing: advice for an empty cell or NaN.
        """
        values = np.array(self._convert(name, self.strings(name), float, 'a number', if_missing))
        self.require(name, ~np.isnan(values), sentence_of('not a finite number', if_missing))
        self.require(name, np.isfinite(values), 'not a finite number')
        return values

    def positive(self, name: str) -> NDArray[np.float64]:
        """Return a column (n,) of finite numbers above 0. Raises DataError."""
        values = self.floats(name)
        self.require(name, values > 0, 'not above 0')
        return values

    def floats_or_nan(self, name: str) -> NDArray[np.float64]:
        """Return a column (n,) of finite numbers, NaN for an empty cell. Raises DataError."""
        cells = [cell or 'nan' for cell in self.strings(name)]
        values = np.array(self._convert(name, cells, float, 'a number'))
        self.require(name, ~np.isinf(values), 'not a finite number')
        return values

    def angles_deg(self, name: str) -> NDArray[np.float64]:
        """Return a column (n,) of angles [degrees], NaN for an empty cell. Raises DataError."""
        angles = self.floats_or_nan(name)
        self.require(name, ~(np.abs(angles) > np.degrees(MAX_ANGLE)), 'not an angle')
        return angles

    def ids(self, name: str) -> NDArray[np.int64]:
        """Return a column (n,) of whole numbers from 0 to MAX_ID. Raises DataError.

        They may end in .0, as pandas writes them if a row of the column was empty.
        """
        cells = self.strings(name)
        if '.' in ''.join(cells):
            cells = list(map(without_zeros, cells))
        values = self._convert(name, cells, int, 'an integer')
        if len(values) and not 0 <= min(values) <= max(values) <= MAX_ID:
            in_range = np.array([0 <= value <= MAX_ID for value in values])
            self.require(name, in_range, f'not between 0 and {MAX_ID}')
        return np.array(values, dtype=np.int64)

    def require(self, name: str, valid: NDArray[np.bool_], cause: str) -> None:
        """Raise DataError for the first row of a column that is not valid (n,)."""
        if not np.all(valid):
            index = int(np.argmin(valid))
            self.fail(index, f'{name} is {self.strings(name)[index]!r}, {cause}')

    def require_different(self, keys: NDArray[np.int64], subject: Callable[[int], str]) -> None:
        """Raise DataError for the first row with the key (n,) of an earlier one.

        subject: names what a row is about, given its index.
        """
        repeated = first_repeated(keys)
        if repeated is not None:
            first, second = repeated
            self.fail(second, f'{subject(second)} is already given in row {self.lines[first]}')

    def fail(self, index: int, cause: str) -> NoReturn:
        """Raise DataError for the row with this index in the block."""
        raise DataError(f'{self.path}, row {self.lines[index]}: {cause}')

    def _convert(
        self,
        name: str,
        cells: Sequence[str],
        kind: Callable[[str], Any],
        expected: str,
        if_missing: str = '',
    ) -> list[Any]:
        try:
            if '_' in ''.join(cells):  # Python reads 1_0 as 10
                raise ValueError
            return list(map(kind, cells))
        except ValueError:
            index = next(i for i, cell in enumerate(cells) if not is_number(cell, kind))
            cell = cells[index]
            advice = decimal_comma_advice(cell) if cell else if_missing
            self.fail(index, sentence_of(f'{name} is {cell!r}, not {expected}', advice))


def read_blocks(path: PathLike, required: Sequence[str]) -> Iterator[Block]:
    """Yield the rows of a CSV file as blocks of at most BLOCK rows.

    The first row is the header. Columns may be in any order and include others than the required
    ones. Blank lines and lines that begin with # are skipped. Raises DataError for a file that
    cannot be read, is empty, is not UTF-8 or UTF-16 text or has no rows, for missing or repeated
    columns, and for a row with too few or too many cells.
    """
    text = read_text(path)
    check_rows(text, MAX_ROWS_CSV, path)
    rows = _numbered_rows(path, text)
    line, first_row = next(rows, (0, []))
    if not first_row:
        raise DataError(f'{path}: the file has no header, {",".join(required)} is expected')
    header = [name.strip() for name in first_row]
    _check_header(f'{path}, row {line}', header, required)
    is_empty = True
    while block := list(islice(rows, BLOCK)):
        is_empty = False
        lines, cells = zip(*block)
        read_block = Block(path, header, list(cells), np.array(lines))
        if set(map(len, cells)) != {len(header)}:
            index = next(i for i, row in enumerate(cells) if len(row) != len(header))
            width = len(cells[index])
            read_block.fail(index, f'{width} columns, but the header has {len(header)}')
        yield read_block
    if is_empty:
        raise DataError(f'{path}: the file has a header, but no rows')


def read_all(path: PathLike, required: Sequence[str]) -> Block:
    """Return all rows of a CSV file as one block. Raises DataError as `read_blocks` does."""
    blocks = list(read_blocks(path, required))
    rows = [row for block in blocks for row in block.rows]
    return Block(path, blocks[0].header, rows, np.concatenate([block.lines for block in blocks]))


def decimal_point(cell: str) -> str:
    """Replace the decimal comma of a number by a point; return any other cell unchanged."""
    if cell.count(',') != 1 or '.' in cell:
        return cell
    with_point = cell.replace(',', '.')
    return with_point if is_number(with_point) else cell


def decimal_comma_advice(cell: str) -> str:
    """Return what to do about a decimal comma in a cell that is not a number; '' without one.

    Such a cell is not read: 1,234 may also be 1234 with a comma between thousands.
    """
    if decimal_point(cell) == cell:
        return ''
    return (
        'it has a decimal comma; write decimal points, or save the table with semicolons between '
        'the cells'
    )


# A whole number as pandas writes it in a column of floats.
_WHOLE = re.compile(r'([+-]?[0-9]+)\.0+')


def without_zeros(cell: str) -> str:
    """Return a whole number such as 7.0 without its decimals; any other cell unchanged."""
    match = _WHOLE.fullmatch(cell)
    return cell if match is None else match[1]


@dataclass(frozen=True)
class Table:
    """A table of results for a CSV file or pandas: column names and rows of cells.

    An unknown float is NaN, which is an empty cell in a file.
    """

    columns: tuple[str, ...]
    rows: Iterable[Iterable[Any]]

    def write(self, path: PathLike) -> None:
        """Write a CSV file with line feeds. Raises DataError if it cannot be written."""
        with atomic_file(path, 'w') as file:
            writer = csv.writer(file, lineterminator='\n')
            writer.writerows(map(_as_texts, chain([self.columns], self.rows)))

    def to_dataframe(self) -> pandas.DataFrame:
        """Return the table as a DataFrame. Raises DataError if pandas is not installed."""
        try:
            import pandas
        except ImportError:
            raise DataError(
                "pandas is not installed: pip install 'fluoro_calib_ros[pandas]'"
            ) from None
        return pandas.DataFrame(list(self.rows), columns=list(self.columns))


def dataframe_of(tables: Mapping[str, Table], name: str) -> pandas.DataFrame:
    """Return the table <name>.csv as a DataFrame. Raises DataError for an unknown name."""
    if f'{name}.csv' not in tables:
        names = ', '.join(file.removesuffix('.csv') for file in tables)
        raise DataError(f'no table is named {name!r}, but {names}')
    return tables[f'{name}.csv'].to_dataframe()


# A spreadsheet evaluates a cell that begins with one of these characters as a formula, and a row
# that begins with # is a comment. A leading apostrophe marks such a name as text; it is added on
# writing and removed on reading.
_FORMULA = frozenset('=+-@')
_MARKED = _FORMULA | {'#'}


def as_text(cell: str, marks: frozenset[str] = _FORMULA) -> str:
    """Return a cell, with a leading apostrophe if it begins with a mark and is no number."""
    unquoted = cell.lstrip("'")
    return f"'{cell}" if unquoted[:1] in marks and not is_number(unquoted) else cell


def _as_texts(row: Iterable[Any]) -> list[Any]:
    return [
        as_text(c, _MARKED)
        if isinstance(c, str)
        else format_float(c)
        if isinstance(c, float)
        else c
        for c in row
    ]


def from_text(cell: str) -> str:
    """Return a cell without the apostrophe of a name that begins with a mark."""
    return cell[1:] if cell[:1] == "'" and as_text(cell[1:], _MARKED) == cell else cell


def format_float(value: float) -> str:
    """Return a float as text that reads back to the same value, '' for NaN."""
    return '' if np.isnan(value) else repr(float(value))


def _numbered_rows(path: PathLike, text: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the rows of a table that are not blank, with their row numbers. Raises DataError."""
    lines: Iterable[str] = io.StringIO(text, newline='')
    if '#' in text:  # replace comments by blank lines, to keep the row numbers
        lines = ('\n' if line.lstrip().startswith('#') else line for line in lines)
    return split_rows(path, lines, _separator(text), 'CSV')


def split_rows(
    path: PathLike, lines: Iterable[str], separator: str, title: str
) -> Iterator[tuple[int, list[str]]]:
    """Yield number and cells of the rows of a table that are not blank.

    With semicolons, numbers have decimal commas, which become points. Raises DataError for lines
    that are not what the title says.
    """
    reader = csv.reader(lines, delimiter=separator, strict=True)
    has_commas = separator == ';'
    last_line = 0
    try:
        for row in reader:
            if any(map(str.strip, row)):
                yield last_line + 1, [decimal_point(c.strip()) for c in row] if has_commas else row
            last_line = reader.line_num
    except csv.Error as error:
        raise DataError(f'{path}, row {reader.line_num}: this is not {title} ({error})') from None


def _separator(text: str) -> str:
    """Return the separator of a table: a semicolon if its header has one and no comma."""
    lines = (match[0].strip() for match in re.finditer(r'[^\r\n]+', text))
    header = next((line for line in lines if line and not line.startswith('#')), '')
    return ';' if ';' in header and ',' not in header else ','


def has_columns(lines: Iterable[str], required: Iterable[str]) -> bool:
    """Return whether the first lines of a file are those of a table with these columns."""
    text = '\n'.join(lines)
    with suppress(DataError):
        _, header = next(_numbered_rows('', text), (0, []))
        return set(required) <= {name.strip() for name in header}
    return False


def _check_header(where: str, header: Sequence[str], required: Sequence[str]) -> None:
    """Raise DataError for missing and repeated columns; the message begins with where."""
    missing = [name for name in required if name not in header]
    if missing:
        columns = f'has no column {missing[0]}'
        if len(missing) > 1:
            columns = f'lacks the columns {", ".join(missing)}'
        raise DataError(
            f'{where}: the header {columns}; '
            f'{",".join(required)} is expected, the header is {quoted(",".join(header))}'
        )
    for name in header:
        if name and header.count(name) > 1:
            raise DataError(f'{where}: the header has the column {name} twice')


def is_number(cell: str, kind: Callable[[str], Any] = float) -> bool:
    """Return whether a cell is a number of this kind; Python's 1_0 is not."""
    try:
        kind(cell)
    except ValueError:
        return False
    return '_' not in cell


# Columns of ids in CSV files that may contain names instead.


class NamedColumn:
    """A column of ids or names, read block by block.

    known: ids of known names; None if the column may contain integers only. The column contains
    names if no cell of its first block is a number.
    """

    def __init__(self, column: str, known: Mapping[str, int] | None) -> None:
        self._column = column
        self._known = known
        self._codes: dict[str, int] = {}
        self._has_names: bool | None = None if known is not None else False

    def read(self, block: Block) -> NDArray[np.int64]:
        """Return ids (n,), or codes of names in the order of occurrence. Raises DataError."""
        cells = block.strings(self._column)
        if self._has_names is None:  # an empty cell is not a name
            self._has_names = not any(is_number(cell or 'nan') for cell in cells)
        if not self._has_names:
            return block.ids(self._column)
        if '' in cells:
            block.fail(cells.index(''), f'{self._column} is empty')
        for name in dict.fromkeys(cells):
            self._codes.setdefault(name, len(self._codes))
        return np.array([self._codes[name] for name in cells], dtype=np.int64)

    def ids(self) -> dict[str, int]:
        """Return the ids of the names that were read; empty for a column of ids."""
        if not self._codes:
            return {}
        ids = number_names(self._codes, self._known)
        return {name: ids[name] for name in self._codes}

    def numbers(self, values: NDArray[np.int64]) -> NDArray[np.int64]:
        """Convert values returned by `read` to ids, after all blocks have been read."""
        ids = self.ids()
        return np.array(list(ids.values()), dtype=np.int64)[values] if ids else values


# The file DIR/names.csv: names of targets, exposures and fluoroscopes, `kind,id,name`.
#
# It exists only if the input files of a calibration contain names.

NAMES_FILE = 'names.csv'
COLUMNS = ('kind', 'id', 'name')
_KINDS = {'target': 'targets', 'exposure': 'exposures', 'fluoroscope': 'fluoroscopes'}


def write_names(directory: PathLike, names: Names) -> None:
    """Write the names into a folder, no file if there are none. Raises DataError."""
    if not names:
        return
    rows = (
        [kind, identity, name]
        for kind, attribute in _KINDS.items()
        for name, identity in getattr(names, attribute).items()
    )
    Table(COLUMNS, rows).write(Path(directory) / NAMES_FILE)


def read_names(directory: PathLike) -> Names:
    """Read the names in a folder; there are none without the file. Raises DataError."""
    path = Path(directory) / NAMES_FILE
    if not path.exists():
        return Names()
    tables: dict[str, dict[str, Any]] = {kind: {} for kind in _KINDS}
    ids: dict[str, set[Any]] = {kind: set() for kind in _KINDS}
    for block in read_blocks(path, COLUMNS):
        columns = zip(*(block.strings(name) for name in COLUMNS))
        for index, (kind, identity, name) in enumerate(columns):
            if kind not in _KINDS:
                block.fail(index, f'kind is {kind!r}, not {", ".join(_KINDS)}')
            value: Any = identity
            if kind == 'fluoroscope':
                check_safe_name(identity, f'{path}, row {block.lines[index]}')
            else:
                value = -1
                with suppress(ValueError):
                    value = int(without_zeros(identity))
                if not 0 <= value <= MAX_ID:
                    block.fail(index, f'id is {identity!r}, not an integer')
            if name in tables[kind] or value in ids[kind]:
                block.fail(index, f'the {kind} {name!r}, id {identity}, is given twice')
            tables[kind][name] = value
            ids[kind].add(value)
    return Names(**{_KINDS[kind]: table for kind, table in tables.items()})
