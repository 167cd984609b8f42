# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Options of the drift watch, what it is given of every exposure, and its state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from ..findings import Finding, Severity
from ..options import option, validate_options

# What the drift watch reports: its level and the drift it has found.

# Levels of an alarm; the values are those of the message DriftStatus.
OK = Severity.NOTE
WARN = Severity.WARNING
ERROR = Severity.ERROR
LEVEL_NAMES = {OK: 'ok', WARN: 'warn', ERROR: 'error'}
NAN = float('nan')


@dataclass(frozen=True)
class DriftState:
    """Present state of the drift watch.

    Without a drift, size, sd, since_s, area and direction are NaN.
    """

    finding: Finding  #: what the watch says; its severity is the level
    evidence: float  #: largest log-likelihood ratio of all charts
    #: evidence at which the levels WARN and ERROR begin
    threshold_warn: float
    threshold_error: float
    observations: int  #: residuals and distances since the last reset
    learning: bool  #: whether the reference is still being learned from the start of the stream
    #: name of the fluoroscope whose image has drifted, 'a or b' where the two cannot be
    #: distinguished, '' without a drift
    fluoroscope: str = ''
    #: corners u0, v0, u1, v1 of the area that has drifted [px]
    area: tuple[float, ...] = (NAN,) * 4
    place: str = ''  #: the same area in words
    #: size of the drift along `direction` and its standard deviation [px]; as residuals are
    #: clipped, a size of more than a pixel is a lower bound
    size: float = NAN
    sd: float = NAN
    #: unit vector (2,) in the image: the normal of the epipolar lines, or u or v where the drift
    #: was found by bodies
    direction: tuple[float, ...] = (NAN,) * 2
    against: str = ''  #: reference of the drift: 'calibration' or 'start'
    source: str = ''  #: 'epipolar' or 'cluster NAME'
    since_s: float = NAN  #: estimated time since the drift began [s]

    @property
    def level(self) -> Severity:
        """Level of the alarm."""
        return self.finding.severity

    @property
    def message(self) -> str:
        """The finding in a sentence."""
        return self.finding.sentence


@dataclass(frozen=True)
class DriftOptions:
    """Options of the drift watch.

    The dead band of a chart is the root of the sum of the squares of the tolerance and of
    band_calibration or band_start systematic standard deviations. Raises ValueError for values out
    of their range, and for combinations that make no sense.
    """

    error_interval_h: float = option(
        1000.0,
        'mean time between false alarms of level ERROR',
        minimum=1e-3,
        maximum=1e9,
        unit='h of stream',
    )
    warn_interval_h: float = option(
        10.0,
        'mean time between false alarms of level WARN',
        minimum=1e-3,
        maximum=1e9,
        unit='h of stream',
    )
    learn_s: float = option(
        10.0,
        'length of the start, the reference of all that follows',
        minimum=1.0,
        maximum=3600.0,
        unit='s',
    )
    block_s: float = option(
        0.25,
        'time over which observations are collected before they are tested',
        minimum=0.01,
        maximum=10.0,
        unit='s',
    )
    cells: int = option(4, 'cells across an image, an even number', minimum=2, maximum=16)
    tolerance_px: float = option(
        0.15,
        'drift that does not matter, part of every dead band',
        minimum=0.0,
        maximum=100.0,
        unit='px',
    )
    step_px: float = option(
        0.1,
        'excess over the dead band to which a chart is most sensitive',
        minimum=1e-3,
        maximum=100.0,
        unit='px',
    )
    band_calibration: float = option(
        4.0,
        'dead band against the calibration',
        minimum=1.0,
        maximum=20.0,
        unit='systematic standard deviations',
    )
    band_start: float = option(
        3.0,
        'dead band against the start',
        minimum=1.0,
        maximum=20.0,
        unit='systematic standard deviations',
    )
    clip: float = option(
        3.0,
        'size at which residuals are clipped',
        minimum=1.0,
        maximum=10.0,
        unit='standard deviations of the noise',
    )
    min_markers: int = option(
        3,
        'different markers that an area needs in a block to be tested',
        minimum=1,
        maximum=1000,
    )

    def __post_init__(self) -> None:
        validate_options(self)
        if int(self.cells) != self.cells or self.cells % 2:
            raise ValueError(f'cells must be an even number, not {self.cells}')
        if self.warn_interval_h > self.error_interval_h:
            raise ValueError(
                'warn_interval_h must not exceed error_interval_h, but they are '
                f'{self.warn_interval_h:g} and {self.error_interval_h:g}'
            )
        if self.learn_s < 4 * self.block_s:
            raise ValueError(
                f'learn_s must be at least 4 blocks of {self.block_s:g} s, not {self.learn_s:g} s'
            )


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
