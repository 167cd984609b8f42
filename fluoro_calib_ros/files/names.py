# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The file DIR/names.csv: names of targets, exposures and fluoroscopes, `kind,id,name`.

It is there only where the files that a calibration was made from have names.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

from ..errors import DataError
from ..exposures.names import MAX_ID, Names
from .access import PathLike, check_safe_name, os_error_reason
from .atomic import atomic_file
from .csv_table import read_blocks, write_rows

NAME = 'names.csv'
COLUMNS = ('kind', 'id', 'name')
_KINDS = {'target': 'targets', 'exposure': 'exposures', 'fluoroscope': 'fluoroscopes'}


def write_names(directory: PathLike, names: Names) -> None:
    """Write the names into a folder; delete the file there where no names are given.

    Raises DataError where that is not possible.
    """
    path = Path(directory) / NAME
    if not names:
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise DataError(f'{path}: cannot be deleted ({os_error_reason(error)})') from None
        return
    with atomic_file(path, 'w') as file:
        write_rows(file, [COLUMNS])
        for kind, attribute in _KINDS.items():
            table = getattr(names, attribute)
            write_rows(file, ([kind, identity, name] for name, identity in table.items()))


def read_names(directory: PathLike) -> Names:
    """Read the names in a folder, none where there is no such file. Raises DataError."""
    path = Path(directory) / NAME
    if not path.exists():
        return Names()
    found: dict[str, dict[str, Any]] = {attribute: {} for attribute in _KINDS.values()}
    for block in read_blocks(path, COLUMNS):
        columns = zip(*(block.strings(name) for name in COLUMNS))
        for index, (kind, identity, name) in enumerate(columns):
            if kind not in _KINDS:
                block.fail(index, f'kind is {kind!r}, not {", ".join(_KINDS)}')
            table = found[_KINDS[kind]]
            value: Any = identity
            if kind == 'fluoroscope':
                check_safe_name(identity, f'{path}, row {block.lines[index]}')
            else:
                value = -1
                with suppress(ValueError):
                    value = int(identity)
                if not 0 <= value <= MAX_ID:
                    block.fail(index, f'id is {identity!r}, not a whole number')
            if name in table or value in table.values():
                block.fail(index, f'the {kind} {name!r}, id {identity}, is given twice')
            table[name] = value
    return Names(**found)
