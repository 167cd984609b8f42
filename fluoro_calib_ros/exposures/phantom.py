# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Phantoms: surveyed coordinates of beads, and drawings of regular phantoms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..brief import brief_repr
from ..errors import DataError
from ..findings import Kind, too_few
from ..rows import chosen_rows

MIN_TARGETS = 4
# Possible extent of what a fluoroscope sees: from a grid before the detector of a specimen scanner
# to a frame around a treadmill, with a fivefold margin. A wrong unit is a factor of ten.
EXTENT_MM = (2.0, 10_000.0)
UNITS_MM = {'m': 1000.0, 'cm': 10.0, 'micrometres': 1e-3}
MISTAKEN_UNITS = {10.0: 'cm', 25.4: 'inches', 1000.0: 'm'}  # mistaken for mm; keys in mm
# Relative tolerance for recognising another unit of lengths from the ratio to other ones.
SCALE_TOLERANCE = 0.05
EXACT_SD_MM = 1e-6  # coordinates with a smaller sd count as known; files have six decimals


def mistaken_unit(factor: float) -> str:
    """Return the unit of lengths that seem too short by this factor, taken for mm; '' for mm."""
    units = (u for mm, u in MISTAKEN_UNITS.items() if abs(factor / mm - 1) < SCALE_TOLERANCE)
    return next(units, '')


@dataclass(frozen=True)
class Phantom:
    """Surveyed coordinates of the beads of a phantom.

    The arrays are read-only, and sorted by target id. Raises DataError for arrays of different
    lengths, fewer than four targets, values that are not finite, a standard deviation that is not
    positive, and a repeated target.

    Parameters
    ----------
    target_id : (n,) ndarray of int
    xyz_mm : (n, 3) ndarray
        Coordinates [mm].
    sd_mm : (n,) ndarray
        Standard deviation of each coordinate [mm].
    diameter_mm : (n,) ndarray, optional
        Diameters of the beads [mm], if known.
    part : (n,) ndarray of int, optional
        Numbers of the parts that the beads belong to, if the phantom has several. Each part is
        shown in exposures of its own, and its coordinates have a frame of their own.
    """

    __repr__ = brief_repr

    target_id: NDArray[np.int64]
    xyz_mm: NDArray[np.float64]
    sd_mm: NDArray[np.float64]
    diameter_mm: NDArray[np.float64] | None = None
    part: NDArray[np.int64] | None = None

    def __post_init__(self) -> None:
        ids = np.asarray(self.target_id, dtype=np.int64)
        xyz = np.asarray(self.xyz_mm, dtype=float)
        sd = np.asarray(self.sd_mm, dtype=float)
        _validate(ids, xyz, sd)
        order = np.argsort(ids, kind='stable')
        arrays = [('target_id', ids), ('xyz_mm', xyz), ('sd_mm', sd)]
        if self.diameter_mm is not None:
            diameter = np.asarray(self.diameter_mm, dtype=float)
            if diameter.shape != sd.shape or not is_positive(diameter).all():
                raise DataError('phantom: a diameter above 0 is needed for every target, or none')
            arrays.append(('diameter_mm', diameter))
        if self.part is not None:
            part = np.asarray(self.part, dtype=np.int64)
            _validate_parts(part, len(ids))
            arrays.append(('part', part))
        for name, values in arrays:
            ordered = values[order]
            ordered.setflags(write=False)
            object.__setattr__(self, name, ordered)

    def equals(self, other: Phantom) -> bool:
        """Return whether another phantom has the same targets, coordinates and sds."""
        return (
            np.array_equal(self.target_id, other.target_id)
            and np.array_equal(self.xyz_mm, other.xyz_mm)
            and np.array_equal(self.sd_mm, other.sd_mm)
        )

    def parts(self) -> list[Phantom]:
        """Return the parts, ordered by number; a phantom without parts is its only one."""
        if self.part is None:
            return [self]
        return [chosen_rows(self, self.part == number) for number in np.unique(self.part)]

    def with_part(self, other: Phantom) -> Phantom:
        """Return the phantom with another one as a further part.

        The ids of the other one are raised by the smallest power of ten above those of this one.
        Diameters are kept if both have them.
        """
        power = 10 ** len(str(max(int(self.target_id.max()), 0)))
        first = np.ones(len(self.target_id), np.int64) if self.part is None else self.part
        added = np.full(len(other.target_id), first.max() + 1)
        diameters = None
        if self.diameter_mm is not None and other.diameter_mm is not None:
            diameters = np.concatenate([self.diameter_mm, other.diameter_mm])
        return Phantom(
            np.concatenate([self.target_id, power + other.target_id]),
            np.concatenate([self.xyz_mm, other.xyz_mm]),
            np.concatenate([self.sd_mm, other.sd_mm]),
            diameters,
            np.concatenate([first, added]),
        )

    def index(self, target_id: ArrayLike) -> NDArray[np.intp]:
        """Return the rows (n,) of target ids (n,), -1 for an id that is not on the phantom."""
        target_id = np.asarray(target_id, dtype=np.int64)
        row = np.minimum(np.searchsorted(self.target_id, target_id), len(self.target_id) - 1)
        return np.where(self.target_id[row] == target_id, row, -1)


def _validate(ids: NDArray[np.int64], xyz: NDArray[np.float64], sd: NDArray[np.float64]) -> None:
    """Raise DataError for a survey that cannot be used."""
    if xyz.shape != (len(ids), 3) or sd.shape != (len(ids),):
        raise DataError(
            f'phantom: {len(ids)} target ids, but coordinates of shape {xyz.shape} '
            f'and standard deviations of shape {sd.shape}'
        )
    if len(ids) < MIN_TARGETS:
        raise DataError(
            f'phantom: {too_few(len(ids), "target")}, at least {MIN_TARGETS} are needed'
        )
    for name, valid in (
        ('coordinate', np.isfinite(xyz).all(axis=1)),
        ('sd', is_positive(sd)),
    ):
        if not valid.all():
            raise DataError(f'phantom: target {ids[~valid][0]} has an invalid {name}')
    repeated = first_repeated(ids)
    if repeated is not None:
        raise DataError(f'phantom: target {ids[repeated[0]]} is given twice')


def _validate_parts(part: NDArray[np.int64], targets: int) -> None:
    """Raise DataError for numbers of parts that are not one for each target, or small parts."""
    if part.shape != (targets,):
        raise DataError(f'phantom: {targets} target ids, but parts of shape {part.shape}')
    numbers, count = np.unique(part, return_counts=True)
    if count.min() < MIN_TARGETS:
        raise DataError(
            f'phantom: part {numbers[count.argmin()]} has {too_few(int(count.min()), "target")}, '
            f'at least {MIN_TARGETS} are needed'
        )


def require_size(phantom: Phantom) -> None:
    """Raise DataError for a phantom of an impossible size: its unit must be a different one.

    Targets that all coincide have no size; they are not checked here.
    """
    extent = float(np.ptp(phantom.xyz_mm, axis=0).max())
    low, high = EXTENT_MM
    if extent == 0 or low <= extent <= high:
        return
    units = [unit for unit, mm in UNITS_MM.items() if low <= extent * mm <= high]
    if not units:
        cause = 'this is not a phantom'
    else:
        cause = f'the coordinates are in {units[0]}, not in mm, or in another unit'
    raise DataError(
        f'the phantom would be {extent:.3g} mm large, between {low:g} and {high:g} mm are '
        f'possible: {cause}',
        kind=Kind.WRONG_UNIT,
        numbers={'extent_mm': extent},
    )


# Regular phantoms as drawings: sheets of holes or beads, and blocks of layers of beads.
#
# x runs along a row, y from row to row, z from layer to layer, starting at the first hole at (0,
# 0, 0); a sheet is seen with x to the right, y down and z away from the viewer. Ids count all
# places from 1, row by row and layer by layer, including those without a hole, so that a blocked
# hole does not change the ids.

HEX_ROW = np.sqrt(3) / 2  # distance of rows as a fraction of the pitch


@dataclass(frozen=True)
class Drawing:
    """A regular phantom.

    Raises DataError for an impossible drawing.
    """

    columns: int
    rows: int
    layers: int = 1
    #: pitch along x, y and z; hexagonal: that along y follows from that along x
    pitch_mm: tuple[float, float, float] = (10.0, 10.0, 10.0)
    hexagonal: bool = False  #: whether every second row is shifted by half a pitch
    #: places without a hole or bead: row and column, or row, column and layer, from 1
    blocked: Sequence[tuple[int, ...]] = ()
    diameter_mm: float | None = None  #: diameter of holes or beads
    sd_mm: float = 0.1  #: manufacturing tolerance, as standard deviation

    def __post_init__(self) -> None:
        if min(self.columns, self.rows, self.layers) < 1:
            raise DataError('a drawing needs at least one column, row and layer', kind=Kind.DATA)
        if not all(0 < pitch < np.inf for pitch in self.pitch_mm):
            raise DataError('a pitch must be above 0 mm', kind=Kind.IMPLAUSIBLE_NUMBER)
        x, y, z = self.pitch_mm
        nearest = min(x, x if self.hexagonal else y, z if self.layers > 1 else x)
        if self.diameter_mm is not None and not 0 < self.diameter_mm < nearest:
            raise DataError(
                f'a diameter of {self.diameter_mm:g} mm is not between 0 and the pitch, '
                f'{nearest:g} mm',
                kind=Kind.IMPLAUSIBLE_NUMBER,
            )
        self.blocked_id  # noqa: B018 - it raises DataError

    @property
    def blocked_id(self) -> NDArray[np.int64]:
        """Ids (b,) of the blocked places. Raises DataError for one outside the drawing."""
        ids = []
        for place in self.blocked:
            row, column, layer = (*place, 1)[:3] if len(place) in (2, 3) else (0, 0, 0)
            if not (
                1 <= row <= self.rows and 1 <= column <= self.columns and 1 <= layer <= self.layers
            ):
                raise DataError(
                    f'the blocked position {",".join(map(str, place))} is outside the drawing of '
                    f'{self.rows} rows, {self.columns} columns and {self.layers} layers'
                )
            ids.append(((layer - 1) * self.rows + row - 1) * self.columns + column)
        return np.unique(np.array(ids, dtype=np.int64))

    @property
    def places_mm(self) -> NDArray[np.float64]:
        """Coordinates (n, 3) of all places, including blocked ones, in the order of their ids."""
        layer, row, column = (
            index.ravel() for index in np.indices((self.layers, self.rows, self.columns))
        )
        x, y, z = self.pitch_mm
        if self.hexagonal:
            y = x * HEX_ROW
        shift = 0.5 * (row % 2) if self.hexagonal else 0.0
        return np.round(np.column_stack([x * (column + shift), y * row, z * layer]), 6)

    def phantom(self) -> Phantom:
        """Return the phantom without the blocked places. Raises DataError if too few remain."""
        places = self.places_mm
        ids = np.arange(1, len(places) + 1)
        kept = ~np.isin(ids, self.blocked_id)
        count = int(kept.sum())
        diameter = None if self.diameter_mm is None else np.full(count, self.diameter_mm)
        return Phantom(ids[kept], places[kept], np.full(count, self.sd_mm), diameter)


# Checks of columns of numbers, shared by phantoms and frames.


def is_positive(sigma: ArrayLike) -> NDArray[np.bool_]:
    """Return (n,) whether values are finite and above 0, as a standard deviation must be."""
    sigma = np.asarray(sigma)
    return np.isfinite(sigma) & (sigma > 0)


def first_repeated(target_id: ArrayLike) -> tuple[int, int] | None:
    """Return the first two positions of the smallest id that occurs more than once, else None."""
    ids = np.asarray(target_id)
    order = np.argsort(ids, kind='stable')
    ordered = ids[order]
    repeated = np.flatnonzero(ordered[1:] == ordered[:-1])
    if not len(repeated):
        return None
    return int(order[repeated[0]]), int(order[repeated[0] + 1])
