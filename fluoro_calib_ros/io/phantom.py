# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Phantom files: CSV `target_id,x,y,z,sd[,diameter][,part]`, in millimetres.

Beads may have names instead of ids. Files of moving points have a further column `exposure`.
"""

from __future__ import annotations

import numpy as np

from ..errors import DataError, ErrorsAt
from ..exposures.frame import MovingPoints
from ..exposures.names import Names, without_trivial
from ..exposures.phantom import Phantom
from ..limits import read_limits
from .access import PathLike
from .csv_table import Block, NamedColumn, Table, read_all, read_blocks

COLUMNS = ('target_id', 'x', 'y', 'z', 'sd')
DIAMETER = 'diameter'  # diameter of the beads, optional
PART = 'part'  # number of the part of the phantom, optional
EXPOSURE = 'exposure'


def read_phantom(path: PathLike) -> Phantom:
    """Read a Phantom from a CSV file with the columns target_id and x, y, z, sd [mm].

    The columns may be in any order. Raises DataError that names row and cause.
    """
    return _read(path, NamedColumn('target_id', None))


def read_named_phantom(path: PathLike, known: Names) -> tuple[Phantom, Names]:
    """Read a Phantom whose targets may have names; return the names, too. Raises DataError."""
    column = NamedColumn('target_id', known.targets)
    phantom = _read(path, column)
    return phantom, Names(without_trivial(column.ids()))


def _read(path: PathLike, column: NamedColumn) -> Phantom:
    rows = read_all(path, COLUMNS)
    numbers = _numbers(rows)
    ids = column.numbers(column.read(rows))
    max_targets = read_limits().max_targets
    if len(ids) > max_targets:
        raise DataError(f'{path}: phantoms of more than {max_targets} targets are not read')
    diameters = rows.positive(DIAMETER) if DIAMETER in rows else None
    part = rows.ids(PART) if PART in rows else None
    rows.require_different(ids, lambda row: f'target {ids[row]}')
    with ErrorsAt(path):
        return Phantom(ids, numbers[:, :3], numbers[:, 3], diameters, part)


def _numbers(rows: Block) -> np.ndarray:
    """Return x, y, z and sd (n, 4) of the rows of a file. Raises DataError."""
    return np.column_stack([*(rows.floats(name) for name in 'xyz'), rows.positive('sd')])


def has_exposures(path: PathLike) -> bool:
    """Return whether a file contains coordinates by exposure; False for other formats."""
    try:
        return any(EXPOSURE in block for block in read_blocks(path, COLUMNS))
    except DataError:
        return False


def read_moving_points(path: PathLike) -> MovingPoints:
    """Read MovingPoints from a CSV file with the columns exposure, target_id and x, y, z, sd [mm].

    Raises DataError that names row and cause.
    """
    rows = read_all(path, (EXPOSURE, *COLUMNS))
    numbers = _numbers(rows)
    exposure = rows.ids(EXPOSURE)
    target_id = rows.ids('target_id')
    points = MovingPoints(exposure, target_id, numbers[:, :3], numbers[:, 3])
    rows.require_different(
        points.ids(exposure, target_id),
        lambda row: f'target {target_id[row]} of exposure {exposure[row]}',
    )
    return points


def write_phantom(path: PathLike, phantom: Phantom, names: Names | None = None) -> None:
    """Write a Phantom to a CSV file; reading the file restores the same values.

    Names are written instead of ids if all targets have one. Raises DataError if the file cannot
    be written.
    """
    labels = (names or Names()).target_names()
    if not all(target in labels for target in phantom.target_id.tolist()):
        labels = {}
    optional = {DIAMETER: phantom.diameter_mm, PART: phantom.part}
    given = {name: values for name, values in optional.items() if values is not None}
    columns = [*phantom.xyz_mm.T, phantom.sd_mm, *given.values()]
    targets = phantom.target_id.tolist()
    rows = (
        [labels.get(target, target), *row]
        for target, *row in zip(targets, *(column.tolist() for column in columns))
    )
    Table((*COLUMNS, *given), rows).write(path)
