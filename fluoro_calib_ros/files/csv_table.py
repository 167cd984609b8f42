"""CSV tables: columns by name, numbers with the row they stand in."""

import csv
import io
from dataclasses import dataclass
from itertools import islice
from operator import itemgetter

import numpy as np

from ..errors import DataError
from .access import read_text

BLOCK = 10_000  # rows converted at a time, to bound the memory
MAX_ID = 2**32 - 1  # ids and frame numbers are uint32 in the messages


@dataclass(frozen=True)
class Block:
    """Some rows of a table: rows, lists of cells; lines, the number of the row in the file
    (header: 1).
    """

    path: str
    header: list
    rows: list
    lines: np.ndarray

    def __contains__(self, name):
        return name in self.header

    def text(self, name):
        """The cells of a column, without the blanks around them."""
        return list(map(str.strip, map(itemgetter(self.header.index(name)), self.rows)))

    def floats(self, name):
        """A column (n,) of finite numbers. Raises DataError."""
        values = self._numbers(name, self.text(name), float, 'a number')
        self.check(name, np.isfinite(values), 'not a finite number')
        return values

    def floats_or_nan(self, name):
        """A column (n,) of numbers in which an empty cell is NaN. Raises DataError for any other
        text.
        """
        return self._numbers(name, [cell or 'nan' for cell in self.text(name)], float, 'a number')

    def ids(self, name):
        """A column (n,) of whole numbers from 0 to MAX_ID. Raises DataError."""
        values = self._numbers(name, self.text(name), int, 'a whole number')
        if len(values) and not 0 <= min(values) <= max(values) <= MAX_ID:
            good = np.array([0 <= value <= MAX_ID for value in values])
            self.check(name, good, f'not between 0 and {MAX_ID}')
        return np.array(values, dtype=np.int64)

    def check(self, name, good, cause):
        """Raise DataError for the first row in which good (n,) is False."""
        if not np.all(good):
            self.fail(
                int(np.argmin(good)),
                f'{name} is {self.text(name)[int(np.argmin(good))]!r}, {cause}',
            )

    def fail(self, index, cause):
        """Raise DataError for the row with this index in the block."""
        raise DataError(f'{self.path}, row {self.lines[index]}: {cause}')

    def _numbers(self, name, cells, kind, wanted):
        try:
            if '_' in ''.join(cells):  # Python reads 1_0 as 10
                raise ValueError
            values = list(map(kind, cells))
        except ValueError:
            index = next(i for i, cell in enumerate(cells) if not _is_number(cell, kind))
            self.fail(index, f'{name} is {cells[index]!r}, not {wanted}')
        return np.array(values) if kind is float else values


def read_blocks(path, required):
    """The rows of a CSV file, as Blocks of at most BLOCK rows.

    The header is the first row; columns come in any order, and there may be more than those
    required. Blank lines and lines that begin with # are skipped. Raises DataError for a file that
    cannot be read, is empty or no UTF-8 text, has no rows, and for missing or repeated columns or
    cells.
    """
    text = read_text(path)
    lines = io.StringIO(text, newline='')
    if '#' in text:  # a comment becomes a blank line: the numbers of the rows stay
        lines = ('\n' if line.lstrip().startswith('#') else line for line in lines)
    reader = csv.reader(lines, strict=True)
    line, header = _header(path, reader, required)
    header = [name.strip() for name in header]
    _check_header(path, line, header, required)
    empty = True
    while True:
        rows, lines, ended = _next_rows(path, reader)
        if rows:
            empty = False
            _check_widths(path, header, rows, lines)
            yield Block(path, header, rows, lines)
        if ended:
            break
    if empty:
        raise DataError(f'{path}: the file has a header, but no rows')


def write_rows(file, rows):
    """Write rows of cells to an open text file, as CSV with plain line ends."""
    csv.writer(file, lineterminator='\n').writerows(rows)


def cell_of(value):
    """Text of a float from which the same float is read again; empty for NaN."""
    return '' if np.isnan(value) else repr(float(value))


def _next_rows(path, reader, number=BLOCK):
    """The next rows of a reader that are not blank, their numbers in the file, and whether it has
    ended.
    """
    before = reader.line_num
    try:
        rows = list(islice(reader, number))
    except csv.Error as error:
        raise DataError(f'{path}, row {reader.line_num}: this is not CSV ({error})') from None
    ended = len(rows) < number
    lines = before + 1 + np.arange(len(rows))
    if reader.line_num - before > len(rows):  # some cells have line ends in them
        lines[1:] += np.cumsum(
            [sum(cell.count('\n') for cell in row) for row in rows[:-1]], dtype=int
        )
    filled = np.array([len(row) > 1 or bool(row and row[0].strip()) for row in rows], dtype=bool)
    if not filled.all():
        rows = [row for row, keep in zip(rows, filled) if keep]
    return rows, lines[filled], ended


def _header(path, reader, required):
    """Number and cells of the first row that is not blank."""
    ended = False
    while not ended:
        rows, lines, ended = _next_rows(path, reader, 1)
        if rows:
            return lines[0], rows[0]
    raise DataError(f'{path}: the file has no header, {",".join(required)} is expected')


def _check_header(path, line, header, required):
    missing = [name for name in required if name not in header]
    if missing:
        found = ','.join(header)
        raise DataError(
            f'{path}, row {line}: the header has no column {" and no column ".join(missing)}; '
            f'{",".join(required)} is expected, and {found[:200]!r} is there'
        )
    twice = [name for name in header if name and header.count(name) > 1]
    if twice:
        raise DataError(f'{path}, row {line}: the header has the column {twice[0]} twice')


def _check_widths(path, header, rows, lines):
    if set(map(len, rows)) != {len(header)}:
        index = next(i for i, row in enumerate(rows) if len(row) != len(header))
        raise DataError(
            f'{path}, row {lines[index]}: {len(rows[index])} columns, but the header has {len(header)}'
        )


def _is_number(cell, kind):
    try:
        kind(cell)
    except ValueError:
        return False
    return '_' not in cell
