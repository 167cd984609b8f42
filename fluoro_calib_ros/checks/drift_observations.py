# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the drift watch is given of every exposure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class EpipolarObservations:
    """Epipolar residuals of n markers in one pair of views, a and b.

    Rows with a value that is not finite are ignored. Residuals that are too large for a match
    belong here too: they are clipped, and a large drift has no others.

    Raises ValueError for arrays whose shapes do not agree.
    """

    target_id: NDArray[np.int64]  #: (n,)
    #: (n, 2) where the markers are in the images [px]
    uv_a: NDArray[np.float64]
    uv_b: NDArray[np.float64]
    residual: NDArray[np.float64]  #: (n,) signed [px]
    #: (n,) standard deviations of the residuals [px]: by the noise of the image points, which is
    #: new in every frame, and by the correction and the orientation, which stay the same at a
    #: place and do not average out
    sd_noise: NDArray[np.float64]
    sd_systematic: NDArray[np.float64]
    #: (n, 2) normals of the epipolar lines, as in EpipolarResiduals
    normal_a: NDArray[np.float64]
    normal_b: NDArray[np.float64]
    #: (n,) change of the residual by a shift of one pixel along the normal
    factor_a: NDArray[np.float64]
    factor_b: NDArray[np.float64]

    def __post_init__(self) -> None:
        n = len(self.target_id)
        for name, expected in (
            ('uv_a', (n, 2)),
            ('uv_b', (n, 2)),
            ('residual', (n,)),
            ('sd_noise', (n,)),
            ('sd_systematic', (n,)),
            ('normal_a', (n, 2)),
            ('normal_b', (n, 2)),
            ('factor_a', (n,)),
            ('factor_b', (n,)),
        ):
            shape = getattr(self, name).shape
            if shape != expected:
                raise ValueError(f'{name} must have the shape {expected}, not {shape}')

    def __len__(self) -> int:
        return len(self.target_id)

    @property
    def uv(self) -> tuple[np.ndarray, np.ndarray]:
        """Pixels of both images."""
        return self.uv_a, self.uv_b

    @property
    def normal(self) -> tuple[np.ndarray, np.ndarray]:
        """Normals of the epipolar lines in both images."""
        return self.normal_a, self.normal_b

    @property
    def factor(self) -> tuple[np.ndarray, np.ndarray]:
        """Factors of both images."""
        return self.factor_a, self.factor_b

    def swapped(self) -> EpipolarObservations:
        """The same residuals with the views in the other order."""
        return EpipolarObservations(
            self.target_id,
            self.uv_b,
            uv_b=self.uv_a,
            residual=self.residual,
            sd_noise=self.sd_noise,
            sd_systematic=self.sd_systematic,
            normal_a=self.normal_b,
            normal_b=self.normal_a,
            factor_a=self.factor_b,
            factor_b=self.factor_a,
        )

    def usable(self) -> EpipolarObservations:
        """The rows that are finite and have positive standard deviations and factors."""
        good = (self.sd_noise > 0) & (self.factor_a > 0) & (self.factor_b > 0)
        for field in fields(self):
            finite = np.isfinite(getattr(self, field.name))
            good &= finite if finite.ndim == 1 else finite.all(axis=1)
        return EpipolarObservations(*(getattr(self, field.name)[good] for field in fields(self)))

    @classmethod
    def concatenate(cls, parts: Sequence[EpipolarObservations]) -> EpipolarObservations:
        """All rows of one or more observations, in their order."""
        return cls(
            *(
                np.concatenate([getattr(part, field.name) for part in parts])
                for field in fields(cls)
            )
        )
