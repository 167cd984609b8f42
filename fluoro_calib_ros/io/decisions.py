# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Tables of doubtful image points and exposures, in which a person decides (docs/files.md)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from ..exposures.decisions import Doubtful, PointDecision
from ..exposures.names import MAX_ID, Names
from .access import PathLike
from .csv_table import Block, Table, read_blocks, without_zeros

DOUBTFUL = 'doubtful.csv'  # in a result folder
LEAVE_OUT = 'leave out'
COLUMNS = (
    *('fluoroscope', 'exposure', 'last_exposure', 'target_id', 'u_px', 'v_px', 'residual_px'),
    *('may_be', 'reason', 'decision'),
)
REQUIRED = ('fluoroscope', 'exposure', 'target_id', 'decision')


def doubtful_table(doubtful: Iterable[Doubtful], names: Names | None = None) -> Table:
    """Return the table of doubtful points and exposures, with names of targets and exposures."""
    names = names or Names()
    targets = names.target_names()
    exposures = names.exposure_names()
    fluoroscopes = names.fluoroscope_names()

    def rows() -> Iterator[list[Any]]:
        for point in doubtful:
            target: Any = (
                '' if point.target_id is None else targets.get(point.target_id, point.target_id)
            )
            yield [
                fluoroscopes.get(point.fluoroscope, point.fluoroscope),
                exposures.get(point.first, point.first),
                exposures.get(point.last, point.last),
                target,
                *(point.uv or (float('nan'),) * 2),
                point.residual_px,
                ' '.join(str(targets.get(i, i)) for i in point.others),
                point.reason,
                '',
            ]

    return Table(COLUMNS, rows())


def read_decisions(path: PathLike, names: Names) -> list[PointDecision]:
    """Read the decisions in a table; rows without a decision are skipped.

    names: names of fluoroscopes, exposures and targets that the table may contain. Raises
    DataError that names the row, for a decision that is neither 'leave out' nor a target.
    """
    decisions = []
    for block in read_blocks(path, REQUIRED):
        column_names = [name for name in (*REQUIRED, 'last_exposure') if name in block]
        columns = {name: block.strings(name) for name in column_names}
        for index, decision in enumerate(columns['decision']):
            words = ' '.join(decision.replace('_', ' ').lower().split())
            if not words:
                continue
            row = {name: without_zeros(cells[index].strip()) for name, cells in columns.items()}
            new_id = None if words == LEAVE_OUT else _new_id(block, index, row, names)
            first = _number(block, index, row, 'exposure', names.exposures)
            last = first
            if row.get('last_exposure'):
                last = _number(block, index, row, 'last_exposure', names.exposures)
            if last < first:
                block.fail(index, f'last_exposure is {last}, before exposure {first}')
            target = None
            if row['target_id']:
                target = _number(block, index, row, 'target_id', names.targets)
            name = row['fluoroscope']
            decisions.append(
                PointDecision(
                    f'{path}, row {block.lines[index]}',
                    names.fluoroscopes.get(name, name),
                    first,
                    last,
                    target_id=target,
                    new_id=new_id,
                )
            )
    return decisions


def _new_id(block: Block, index: int, row: Mapping[str, str], names: Names) -> int:
    """Return the new id of an image point. Raises DataError."""
    text = row['decision']
    if not row['target_id']:
        block.fail(
            index,
            f'decision is {text!r}, but a whole exposure can only be excluded ({LEAVE_OUT!r}); '
            'to change an id, name the target_id',
        )
    if text not in names.targets and not text.isdecimal():
        block.fail(index, f'decision is {text!r}, neither {LEAVE_OUT!r} nor a target_id')
    return _number(block, index, row, 'decision', names.targets)


def _number(
    block: Block, index: int, row: Mapping[str, str], column: str, known: Mapping[str, int]
) -> int:
    """Return the number in a cell, which may contain a known name. Raises DataError."""
    text = row[column]
    if text in known:
        return known[text]
    if not text.isdecimal() or int(text[:11]) > MAX_ID:
        block.fail(index, f'{column} is {text!r}, not an integer from 0 to {MAX_ID}')
    return int(text)
