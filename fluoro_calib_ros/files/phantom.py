"""The phantom's file: `target_id,x,y,z,sd` in millimetres."""

import numpy as np

from ..errors import DataError
from ..exposures.phantom import Phantom
from .atomic import atomic_file
from .csv_table import read_blocks, write_rows

COLUMNS = ('target_id', 'x', 'y', 'z', 'sd')


def read_phantom(path):
    """The Phantom of a CSV file with target_id and x, y, z, sd [mm]; the order of the columns is
    free.

    Raises DataError that names the row and the cause.
    """
    ids = []
    numbers = []
    lines = []
    for block in read_blocks(path, COLUMNS):
        ids.append(block.ids('target_id'))
        numbers.append(np.column_stack([block.floats(name) for name in COLUMNS[1:]]))
        block.check('sd', numbers[-1][:, 3] > 0, 'not above 0')
        lines.append(block.lines)
    ids = np.concatenate(ids)
    numbers = np.concatenate(numbers)
    lines = np.concatenate(lines)
    _check_unique(path, ids, lines)
    try:
        return Phantom(ids, numbers[:, :3], numbers[:, 3])
    except DataError as error:
        raise DataError(f'{path}: {error}') from None


def write_phantom(path, phantom):
    """Write a Phantom to a CSV file; read_phantom gives the same to the last bit. Raises
    DataError.
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


def _check_unique(path, ids, lines):
    order = np.argsort(ids, kind='stable')
    twice = np.flatnonzero(ids[order][1:] == ids[order][:-1])
    if len(twice):
        first = order[twice[0]]
        second = order[twice[0] + 1]
        raise DataError(
            f'{path}, row {lines[second]}: target {ids[second]} is there already, '
            f'in row {lines[first]}'
        )
