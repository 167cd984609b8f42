# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A column of ids in a CSV file, in which a lab may have written names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..exposures.names import number_names
from .csv_table import Block


class NamedColumn:
    """The ids of a column, read block by block.

    Parameters
    ----------
    column : str
    known : mapping of str to int, or None
        Names with known ids; None where the column may only have whole numbers. A column has names
        if none of its first cells is a number.
    """

    def __init__(self, column: str, known: Mapping[str, int] | None) -> None:
        self._column = column
        self._known = known
        self._codes: dict[str, int] | None = None
        self._is_first = True

    def read(self, block: Block) -> np.ndarray:
        """Return ids (n,), or codes of names in the order of occurrence. Raises DataError."""
        if self._is_first:
            self._is_first = False
            if self._known is not None and _are_names(block.strings(self._column)):
                self._codes = {}
        if self._codes is None:
            return block.ids(self._column)
        cells = block.strings(self._column)
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

    def numbers(self, values: np.ndarray) -> np.ndarray:
        """Return the ids of what `read` returned, after all blocks were read."""
        ids = self.ids()
        return np.array(list(ids.values()), dtype=np.int64)[values] if ids else values


def _are_names(cells: Sequence[str]) -> bool:
    """Return whether no cell is a number."""
    for cell in cells:
        try:
            float(cell or 'nan')
        except ValueError:
            continue
        return False
    return True
