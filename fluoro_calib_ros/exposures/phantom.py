"""The phantom: surveyed coordinates of its beads."""

from dataclasses import dataclass

import numpy as np

from ..errors import DataError


@dataclass(frozen=True)
class Phantom:
    """Surveyed coordinates of the beads of a phantom.

    target_id (n,) ascending and unique; xyz_mm (n, 3); sd_mm (n,) standard deviation of each
    coordinate. Raises DataError where the arrays do not fit together or hold something that is not
    a number.
    """

    target_id: np.ndarray
    xyz_mm: np.ndarray
    sd_mm: np.ndarray

    def __post_init__(self):
        ids = np.asarray(self.target_id, dtype=np.int64)
        xyz = np.asarray(self.xyz_mm, dtype=float)
        sd = np.asarray(self.sd_mm, dtype=float)
        if xyz.shape != (len(ids), 3) or sd.shape != (len(ids),):
            raise DataError(
                f'phantom: {len(ids)} target ids, but coordinates of shape {xyz.shape} '
                f'and standard deviations of shape {sd.shape}'
            )
        if len(ids) < 4:
            raise DataError(f'phantom: {len(ids)} targets are too few, at least 4 are needed')
        for name, bad in (
            ('coordinate', ~np.isfinite(xyz).all(axis=1)),
            ('sd', ~(np.isfinite(sd) & (sd > 0))),
        ):
            if bad.any():
                raise DataError(f'phantom: target {ids[bad][0]} has a wrong {name}')
        order = np.argsort(ids, kind='stable')
        ids = ids[order]
        xyz = xyz[order]
        sd = sd[order]
        twice = ids[1:][ids[1:] == ids[:-1]]
        if len(twice):
            raise DataError(f'phantom: target {twice[0]} is given twice')
        for name, value in (('target_id', ids), ('xyz_mm', xyz), ('sd_mm', sd)):
            value.setflags(write=False)
            object.__setattr__(self, name, value)

    def index(self, target_id):
        """Rows (n,) of the phantom that hold target_id (n,), -1 where it has none."""
        target_id = np.asarray(target_id, dtype=np.int64)
        row = np.minimum(np.searchsorted(self.target_id, target_id), len(self.target_id) - 1)
        return np.where(self.target_id[row] == target_id, row, -1)
