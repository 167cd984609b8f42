# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The phantom: surveyed coordinates of its beads."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import DataError
from ..findings import Kind
from .columns import first_repeated, is_positive

MIN_TARGETS = 4
# Largest side of what a fluoroscope can see: from a grid before the detector of a specimen scanner
# to a frame around a treadmill, with a factor of five in hand. A wrong unit is a factor of ten.
EXTENT_MM = (2.0, 10_000.0)
UNITS_MM = {'m': 1000.0, 'cm': 10.0, 'micrometres': 1e-3}


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
        Of the beads [mm], where it is known.
    """

    target_id: NDArray[np.int64]
    xyz_mm: NDArray[np.float64]
    sd_mm: NDArray[np.float64]
    diameter_mm: NDArray[np.float64] | None = None

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

    def index(self, target_id: ArrayLike) -> NDArray[np.intp]:
        """Return the rows (n,) of target ids (n,), -1 for an id that the phantom does not have."""
        target_id = np.asarray(target_id, dtype=np.int64)
        row = np.minimum(np.searchsorted(self.target_id, target_id), len(self.target_id) - 1)
        return np.where(self.target_id[row] == target_id, row, -1)


def _validate(ids: np.ndarray, xyz: np.ndarray, sd: np.ndarray) -> None:
    """Raise DataError for a survey that cannot be used."""
    if xyz.shape != (len(ids), 3) or sd.shape != (len(ids),):
        raise DataError(
            f'phantom: {len(ids)} target ids, but coordinates of shape {xyz.shape} '
            f'and standard deviations of shape {sd.shape}'
        )
    if len(ids) < MIN_TARGETS:
        raise DataError(
            f'phantom: {len(ids)} targets are too few, at least {MIN_TARGETS} are needed'
        )
    for name, valid in (
        ('coordinate', np.isfinite(xyz).all(axis=1)),
        ('sd', is_positive(sd)),
    ):
        if not valid.all():
            raise DataError(f'phantom: target {ids[~valid][0]} has a wrong {name}')
    repeated = first_repeated(ids)
    if repeated is not None:
        raise DataError(f'phantom: target {ids[repeated[0]]} is given twice')


def require_size(phantom: Phantom) -> None:
    """Raise DataError for a phantom of a size that none has: its unit is another one.

    Targets that are all in one place have no size, and are left to others.
    """
    extent = float(np.ptp(phantom.xyz_mm, axis=0).max())
    low, high = EXTENT_MM
    if extent == 0 or low <= extent <= high:
        return
    likely = [unit for unit, mm in UNITS_MM.items() if low <= extent * mm <= high]
    if not likely:
        why = 'this is no phantom'
    else:
        why = f'the coordinates are in {likely[0]}, not in mm, or in another unit'
    raise DataError(
        f'the phantom would be {extent:.3g} mm large, between {low:g} and {high:g} mm are '
        f'possible: {why}',
        kind=Kind.WRONG_UNIT,
        numbers={'extent_mm': extent},
    )
