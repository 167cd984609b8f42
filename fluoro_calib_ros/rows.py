# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Rows of tables: dataclasses whose arrays have one row for each item; other fields are common."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar('T')


def joined_rows(tables: Sequence[T]) -> T:
    """Return all rows of one or more tables, in order; common fields are those of the first."""
    return _with_arrays(
        tables[0], lambda name: np.concatenate([getattr(table, name) for table in tables])
    )


def chosen_rows(table: T, rows: NDArray[Any] | slice) -> T:
    """Return the table with some of its rows, given by mask, indices or slice."""
    return _with_arrays(table, lambda name: getattr(table, name)[rows])


def _with_arrays(table: Any, array: Callable[[str], NDArray[Any]]) -> Any:
    """Return a copy of a table with the array of each field by its name."""
    names = [entry.name for entry in fields(table)]
    arrays = [name for name in names if isinstance(getattr(table, name), np.ndarray)]
    return replace(table, **{name: array(name) for name in arrays})
