# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Targets whose coordinates are known in every exposure, such as markers of a motion capture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import DataError
from .frame import Frame
from .phantom import Phantom


@dataclass(frozen=True)
class MovingPoints:
    """Coordinates of targets that differ between exposures, in the frame of the lab.

    Raises DataError for a negative exposure or target id.

    Parameters
    ----------
    exposure, target_id : (n,) ndarray of int
    xyz_mm : (n, 3) ndarray
        Coordinates [mm].
    sd_mm : (n,) ndarray
        Standard deviation of each coordinate [mm].
    """

    exposure: NDArray[np.int64]
    target_id: NDArray[np.int64]
    xyz_mm: NDArray[np.float64]
    sd_mm: NDArray[np.float64]

    def __post_init__(self) -> None:
        for name in ('exposure', 'target_id'):
            numbers = np.asarray(getattr(self, name), dtype=np.int64)
            if (numbers < 0).any():
                raise DataError(f'moving points: {name} is {numbers.min()}, it must be 0 or above')
            object.__setattr__(self, name, numbers)

    @property
    def base(self) -> int:
        """The power of ten by which the ids of two exposures are apart."""
        return int(10 ** len(str(int(self.target_id.max(initial=0)))))

    def ids(self, exposure: ArrayLike, target_id: ArrayLike) -> NDArray[np.int64]:
        """Return an id (n,) of its own for each target of each exposure.

        Target 7 of exposure 12 is 1207 where all ids have two digits at most.
        """
        return np.asarray(exposure, dtype=np.int64) * self.base + np.asarray(target_id)

    def as_phantom(
        self, frames: Mapping[str, Sequence[Frame]]
    ) -> tuple[dict[str, list[Frame]], Phantom]:
        """Return frames and phantom in which each target of each exposure has an id of its own.

        Raises DataError for a target whose coordinates in an exposure are missing, and for
        coordinates of which no phantom can be made.
        """
        phantom = Phantom(self.ids(self.exposure, self.target_id), self.xyz_mm, self.sd_mm)
        out: dict[str, list[Frame]] = {}
        for name, exposures in frames.items():
            out[name] = []
            for frame in exposures:
                ids = self.ids(frame.number, frame.target_id)
                known = (phantom.index(ids) >= 0) & (np.asarray(frame.target_id) < self.base)
                if not known.all():
                    raise DataError(
                        f'fluoroscope {name}, exposure {frame.number}: the coordinates of target '
                        f'{np.asarray(frame.target_id)[~known][0]} are not given'
                    )
                out[name].append(replace(frame, target_id=ids))
        return out, phantom
