"""The file of the phantom: CSV `target_id,x,y,z,sd`, in millimetres."""

from __future__ import annotations

import os

import numpy as np

from ..errors import DataError
from ..exposures.columns import first_repeated
from ..exposures.phantom import Phantom
from .atomic import atomic_file
from .csv_table import read_blocks, write_rows

COLUMNS = ('target_id', 'x', 'y', 'z', 'sd')


def read_phantom(path: str | os.PathLike[str]) -> Phantom:
    """Read a Phantom from a CSV file with the columns target_id and x, y, z, sd [mm].

    The columns may have any order. Raises DataError that names row and cause.
    """
    id_parts = []
    number_parts = []
    line_parts = []
    for block in read_blocks(path, COLUMNS):
        numbers = np.column_stack([block.floats(name) for name in COLUMNS[1:]])
        id_parts.append(block.ids('target_id'))
        block.require('sd', numbers[:, 3] > 0, 'not above 0')
        number_parts.append(numbers)
        line_parts.append(block.lines)
    ids = np.concatenate(id_parts)
    numbers = np.concatenate(number_parts)
    repeated = first_repeated(ids)
    if repeated is not None:
        lines = np.concatenate(line_parts)
        first, second = repeated
        raise DataError(
            f'{path}, row {lines[second]}: target {ids[second]} is already given in row '
            f'{lines[first]}'
        )
    try:
        return Phantom(ids, numbers[:, :3], numbers[:, 3])
    except DataError as error:
        raise DataError(f'{path}: {error}') from None


def write_phantom(path: str | os.PathLike[str], phantom: Phantom) -> None:
    """Write a Phantom to a CSV file, from which the same values are read again.

    Raises DataError where the file cannot be written.
    """
    with atomic_file(path, 'w') as file:
        write_rows(file, [COLUMNS])
        write_rows(
            file,
            (
                [int(target), *map(repr, xyz), repr(sd)]
                for target, xyz, sd in zip(
                    phantom.target_id, phantom.xyz_mm.tolist(), phantom.sd_mm.tolist()
                )
            ),
        )
