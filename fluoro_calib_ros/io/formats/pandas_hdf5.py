# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Read tables that pandas has stored as HDF5, without pandas.

pandas pickles the column names of a table with protocol 0. Loading a pickle may run arbitrary
code. Therefore its instructions are interpreted one by one, and only those are accepted that make
lists and tuples of texts and numbers.
"""

from __future__ import annotations

import pickletools
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

VALUES = 'values_block_0'  # block of columns of the same type, as in a table of coordinates
_VALUES = ('UNICODE', 'STRING', 'INT', 'LONG')
_MAKERS: dict[str, Callable[[list[Any]], Any]] = {'LIST': list, 'TUPLE': tuple}
_MARK = object()


def texts(values: Any) -> list[str]:
    """Return HDF5 values as texts: bytes decoded, numbers converted."""
    return [v.decode() if isinstance(v, bytes) else str(v) for v in values]


def is_pandas(group: Any) -> bool:
    """Return whether a group of an HDF5 file is a pandas object."""
    return 'pandas_type' in group.attrs


def table_arrays(group: Any) -> dict[str, Any]:
    """Return columns (n, levels), index (m,) and values (m, n) of a table in a group.

    Raises ValueError unless it is a table of numbers whose columns have several headers.
    """
    kind = texts([group.attrs['pandas_type']])[0]
    if kind == 'frame_table':
        columns, index, values = _appendable(group)
    elif kind == 'frame':
        columns, index, values = _fixed(group)
    else:
        raise ValueError(f'it is a {kind} of pandas, not a table')
    if columns.ndim != 2 or values.shape != (len(index), len(columns)):
        raise ValueError('its columns need several headers each, and numbers of one kind')
    return {'columns': columns, 'index': index, 'values': values}


def _appendable(group: Any) -> tuple[NDArray[np.str_], NDArray[np.str_], NDArray[np.float64]]:
    table = group['table']
    if set(table.dtype.names) != {'index', VALUES}:
        raise ValueError('its columns are not of one kind')
    rows = table[:]
    (_, columns), *other_axes = literal(bytes(group.attrs['non_index_axes']))
    if other_axes:
        raise ValueError('it has more than two axes')
    return np.array(columns, dtype=str), np.array(texts(rows['index'])), rows[VALUES].astype(float)


def _fixed(group: Any) -> tuple[NDArray[np.str_], NDArray[np.str_], NDArray[np.float64]]:
    if int(group.attrs['nblocks']) != 1:
        raise ValueError('its columns are not of one kind')
    columns = np.array(_levels(group, 'block0_items')).T
    # A multi-level index ends with the image name.
    index = _levels(group, 'axis1')[-1]
    stored = group['block0_values']
    values = stored[:].astype(float)
    return columns, np.array(index), values if stored.attrs.get('transposed', 1) else values.T


def _levels(group: Any, axis: str) -> list[list[str]]:
    """Return the texts of each level of an axis."""
    if axis in group:
        return [texts(group[axis][:])]
    levels = []
    for level in range(int(group.attrs[f'{axis}_nlevels'])):
        names = texts(group[f'{axis}_level{level}'][:])
        labels = group[f'{axis}_label{level}'][:]
        if len(labels) and not 0 <= labels.min() <= labels.max() < len(names):
            raise ValueError('an index of its columns is not known')
        levels.append([names[label] for label in labels])
    return levels


def literal(pickled: bytes) -> Any:
    """Return the value of a pickle of protocol 0, without loading it.

    Raises ValueError for anything but lists and tuples of texts and numbers.
    """
    stack: list[Any] = []
    memory: dict[Any, Any] = {}
    for instruction, argument, _ in pickletools.genops(pickled):
        name = instruction.name
        if name == 'MARK':
            stack.append(_MARK)
        elif name in _VALUES:
            stack.append(argument)
        elif name in _MAKERS:
            mark_index = len(stack) - 1 - stack[::-1].index(_MARK)
            stack[mark_index:] = [_MAKERS[name](stack[mark_index + 1 :])]
        elif name == 'APPEND':
            value = stack.pop()
            stack[-1].append(value)
        elif name == 'PUT':
            memory[argument] = stack[-1]
        elif name == 'GET':
            stack.append(memory[argument])
        elif name == 'STOP':
            return stack.pop()
        else:
            raise ValueError(f'its columns are stored by {name}, which is not read')
    raise ValueError('its columns are cut off')
