# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Phantoms as they are drawn: regular sheets of holes or beads, and blocks of layers of beads.

x runs along a row, y from row to row, z from layer to layer, from the first hole at (0, 0, 0); a
sheet is seen with x to the right, y down and z away from the viewer. Ids count all places from 1,
row by row and layer by layer, those without a hole too, so that a blocked hole changes no id.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError
from ..findings import Kind
from .phantom import Phantom

HEX_ROW = np.sqrt(3) / 2  # distance of rows over the pitch


@dataclass(frozen=True)
class Drawing:
    """A regular phantom.

    Raises DataError for what cannot be drawn.
    """

    columns: int
    rows: int
    layers: int = 1
    #: along x, y and z; hexagonal: along x, from which that along y follows
    pitch_mm: tuple[float, float, float] = (10.0, 10.0, 10.0)
    hexagonal: bool = False  #: whether every second row is shifted by half a pitch
    #: places without hole or bead: row and column, or row, column and layer, from 1
    blocked: Sequence[tuple[int, ...]] = ()
    diameter_mm: float | None = None  #: of holes or beads
    sd_mm: float = 0.1  #: tolerance of the manufacture

    def __post_init__(self) -> None:
        if min(self.columns, self.rows, self.layers) < 1:
            raise DataError('a drawing has one column, row and layer at least', kind=Kind.DATA)
        if not all(0 < pitch < np.inf for pitch in self.pitch_mm):
            raise DataError('a pitch is a number of mm above 0', kind=Kind.IMPLAUSIBLE_NUMBER)
        nearest = min(self.pitch_mm[: 1 if self.hexagonal else 3 if self.layers > 1 else 2])
        if self.diameter_mm is not None and not 0 < self.diameter_mm < nearest:
            raise DataError(
                f'a diameter of {self.diameter_mm:g} mm is not between 0 and the pitch, '
                f'{nearest:g} mm',
                kind=Kind.IMPLAUSIBLE_NUMBER,
            )
        self.blocked_id  # noqa: B018 - it raises DataError

    @property
    def blocked_id(self) -> NDArray[np.int64]:
        """Ids (b,) of the blocked places. Raises DataError for one that is not on the drawing."""
        out = []
        for place in self.blocked:
            row, column, layer = (*place, 1)[:3] if len(place) in (2, 3) else (0, 0, 0)
            if not (
                1 <= row <= self.rows and 1 <= column <= self.columns and 1 <= layer <= self.layers
            ):
                raise DataError(
                    f'the blocked place {",".join(map(str, place))} is not on the drawing of '
                    f'{self.rows} rows, {self.columns} columns and {self.layers} layers'
                )
            out.append(((layer - 1) * self.rows + row - 1) * self.columns + column)
        return np.unique(np.array(out, dtype=np.int64))

    @property
    def places_mm(self) -> NDArray[np.float64]:
        """Coordinates (n, 3) of all places in the order of their ids, blocked ones too."""
        layer, row, column = (
            index.ravel() for index in np.indices((self.layers, self.rows, self.columns))
        )
        x, y, z = self.pitch_mm
        if self.hexagonal:
            y = x * HEX_ROW
        shift = 0.5 * (row % 2) if self.hexagonal else 0.0
        return np.round(np.column_stack([x * (column + shift), y * row, z * layer]), 6)

    def phantom(self) -> Phantom:
        """Return the phantom without the blocked places. Raises DataError where few are left."""
        places = self.places_mm
        ids = np.arange(1, len(places) + 1)
        kept = ~np.isin(ids, self.blocked_id)
        count = int(kept.sum())
        diameter = None if self.diameter_mm is None else np.full(count, self.diameter_mm)
        return Phantom(ids[kept], places[kept], np.full(count, self.sd_mm), diameter)
