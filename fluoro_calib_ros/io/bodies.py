# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Bodies as CSV `body,marker,x,y,z,sd`, in millimetres; marker is the id of a target.

A marker whose place is unknown has empty x, y, z and sd, one without a standard deviation an
empty sd.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from ..bodies.body import Body, check_bodies
from ..errors import DataError
from ..limits import read_limits
from .access import PathLike
from .csv_table import Block, Table, read_blocks

COLUMNS = ('body', 'marker', 'x', 'y', 'z', 'sd')


def read_bodies(path: PathLike) -> tuple[Body, ...]:
    """Read bodies from a CSV file, in their order there. Raises DataError that names the row."""
    rows: dict[str, list[tuple[int, list[float]]]] = {}
    first_rows: dict[int, tuple[int, str]] = {}
    most = read_limits().max_targets
    for block in read_blocks(path, COLUMNS):
        unknown = [name for name in block.header if name not in COLUMNS]
        if unknown:
            raise DataError(
                f'{path}: the column {unknown[0]!r} is unknown, there are {",".join(COLUMNS)}'
            )
        names = block.strings('body')
        markers = block.ids('marker').tolist()
        for index, values in enumerate(_numbers(block).tolist()):
            name, marker = names[index], markers[index]
            if not name:
                block.fail(index, 'the body has no name')
            if marker in first_rows:
                _fail_repeated(block, index, name, *first_rows[marker])
            first_rows[marker] = int(block.lines[index]), name
            rows.setdefault(name, []).append((marker, values))
        if len(first_rows) > most:
            raise DataError(f'{path}: bodies of more than {most} markers are not read')
    bodies = []
    for name, of_body in rows.items():
        values = np.array([numbers for _, numbers in of_body])
        target_id = np.array([marker for marker, _ in of_body])
        bodies.append(Body(name, target_id, values[:, :3], values[:, 3]))
    check_bodies(bodies)
    return tuple(bodies)


def _numbers(block: Block) -> NDArray[np.float64]:
    """Return x, y, z, sd (n, 4), NaN and an infinite sd where unknown. Raises DataError."""
    columns = []
    for name in COLUMNS[2:]:
        values = block.floats_or_nan(name)
        empty = np.array([not cell for cell in block.strings(name)])
        block.require(name, empty | np.isfinite(values), 'not a finite number')
        columns.append(values)
    x, y, z, sd = columns
    known = np.isfinite(x)
    for name, values in (('y', y), ('z', z)):
        block.require(name, np.isfinite(values) == known, 'but x, y and z are known together')
    block.require('sd', ~(sd < 0), 'below 0')
    return np.column_stack([x, y, z, np.where(np.isfinite(sd), sd, np.inf)])


def _fail_repeated(block: Block, index: int, name: str, row: int, owner: str) -> NoReturn:
    marker = block.strings('marker')[index]
    if name == owner:
        block.fail(index, f'marker {marker} of {name} is already given in row {row}')
    block.fail(
        index,
        f'marker {marker} is one of {owner} in row {row} and one of {name} here; a marker belongs '
        'to one body',
    )


def write_bodies(path: PathLike, bodies: Sequence[Body]) -> None:
    """Write bodies to a CSV file, from which the same values are read again. Raises DataError."""
    shape_table(bodies).write(path)


def shape_table(bodies: Sequence[Body]) -> Table:
    """Return the markers of bodies as a table."""
    return Table(COLUMNS, (row for body in bodies for row in _rows(body)))


def _rows(body: Body) -> Iterator[list[object]]:
    sd = np.where(np.isfinite(body.sd_mm), body.sd_mm, np.nan)
    numbers = np.column_stack([body.xyz_mm, sd])
    numbers[~body.known] = np.nan
    for marker, values in zip(body.target_id.tolist(), numbers.tolist()):
        yield [body.name, marker, *values]
