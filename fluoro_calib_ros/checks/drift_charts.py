# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Options, input, state and CUSUM control charts of the drift watch.

In every area and in both directions a CUSUM (Page, Biometrika 41, 1954) sums the log-likelihood
ratio of a drift beyond the dead band against a drift at its edge. The expectation of each factor
of the likelihood ratio is at most 1 for all means within the band. The mean number of blocks to a
false alarm of a chart is therefore at least exp(threshold) (Lorden, Annals of Mathematical
Statistics 42, 1971; for composite hypotheses Shin, Ramdas and Rinaldo, "E-detectors", New England
Journal of Statistics in Data Science 2, 2024). With M charts it is at least this number divided by
M.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from ..exposures.frame import cells_of
from ..findings import Finding, Severity
from ..options import option, validate_options
from ..reconstruction.epipolar import EpipolarResiduals
from ..rows import chosen_rows

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

    finding: Finding  #: result of the watch; its severity is the level
    evidence: float  #: largest log-likelihood ratio of all charts
    #: evidence at which the levels WARN and ERROR begin
    threshold_warn: float
    threshold_error: float
    observations: int  #: number of residuals and distances since the last reset
    learning: bool  #: whether the reference is still being learned at the start of the stream
    #: fluoroscope whose image has drifted; several if they cannot be distinguished
    fluoroscopes: tuple[str, ...] = ()
    #: corners u0, v0, u1, v1 of the area that has drifted [px]
    area: tuple[float, ...] = (NAN,) * 4
    place: str = ''  #: the same area in words
    #: size of the drift along `direction` and its standard deviation [px]; as residuals are
    #: clipped, a size above a pixel is a lower bound
    size: float = NAN
    sd: float = NAN
    #: unit vector (2,) in the image: normal of the epipolar lines, or u or v for a drift found by
    #: bodies
    direction: tuple[float, ...] = (NAN,) * 2
    against: str = ''  #: reference of the drift: 'calibration' or 'start'
    source: str = ''  #: 'epipolar' or 'cluster NAME'
    since_s: float = NAN  #: estimated time since the drift began [s]

    @property
    def level(self) -> Severity:
        """Level of the alarm."""
        return self.finding.severity

    @property
    def fluoroscope(self) -> str:
        """Name of the drifted fluoroscope, 'a or b' if it is one of two, '' for none."""
        return ' or '.join(self.fluoroscopes)

    @property
    def message(self) -> str:
        """Finding as a sentence."""
        return self.finding.sentence


@dataclass(frozen=True)
class DriftOptions:
    """Options of the drift watch.

    The dead band of a chart is the root sum of squares of the tolerance and of band_calibration or
    band_start systematic standard deviations. Raises ValueError for values out of range and for
    inconsistent combinations.
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
        'length of the start of the stream, which is the reference for the rest',
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
        'negligible drift, part of every dead band',
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
class EpipolarObservations(EpipolarResiduals):
    """Epipolar residuals of n markers in one pair of views, a and b.

    Rows with a value that is not finite are ignored. Include residuals that are too large for a
    match: they are clipped, and a large drift produces no other residuals.
    """

    target_id: NDArray[np.integer]  #: (n,)
    #: (n, 2) positions of the markers in the images [px]
    uv_a: NDArray[np.float64]
    uv_b: NDArray[np.float64]
    #: (n,) variances of the residuals due to the noise of the image points [px^2], which is
    #: independent in every frame
    noise: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.target_id)

    @property
    def systematic(self) -> NDArray[np.float64]:
        """Variances (n,) due to the correction and the orientation [px^2].

        These errors are constant at a place and do not average out.
        """
        return np.maximum(self.sd_total**2 - self.noise, 0)

    @property
    def uv(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Pixels in both images."""
        return self.uv_a, self.uv_b

    @property
    def normal(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Normals of the epipolar lines in both images."""
        return self.normal_a, self.normal_b

    @property
    def factor(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Factors in both images."""
        return self.factor_a, self.factor_b

    def usable(self) -> EpipolarObservations:
        """Return the rows that are finite and have positive variances and factors."""
        is_usable = (self.noise > 0) & (self.factor_a > 0) & (self.factor_b > 0)
        for field in fields(self):
            finite = np.isfinite(getattr(self, field.name))
            is_usable &= finite if finite.ndim == 1 else finite.all(axis=1)
        return chosen_rows(self, is_usable)


@dataclass(frozen=True)
class Block:
    """Statistics of the observations of a block, in K series and A areas."""

    #: (K, A) score and information of a drift of each area [1/px, 1/px^2]
    score: NDArray[np.float64]
    information: NDArray[np.float64]
    systematic: NDArray[np.float64]  #: (K, A) systematic standard deviations of the drift [px]
    enough: NDArray[np.bool_]  #: (K, A) whether the area has enough observations to be tested


# Areas of an image in which the drift watch tests for a drift.


class ImageAreas:
    """Overlapping areas of an image: n x n cells, windows of half its size, halves, and the whole.

    n: number of cells across the image; must be even.
    """

    def __init__(self, n: int) -> None:
        half = n // 2
        step = max(1, n // 4)
        starts = range(0, half + 1, step) if n % 4 == 0 else (0, half)
        boxes = [(i, j, i + 1, j + 1) for j in range(n) for i in range(n)] if n > 2 else []
        boxes += [(i, j, i + half, j + half) for j in starts for i in starts]
        boxes += [(0, 0, half, n), (half, 0, n, n), (0, 0, n, half), (0, half, n, n), (0, 0, n, n)]
        self.n = n
        #: (areas, 4), edges u0, v0, u1, v1 as fractions of the image
        self.box = np.array(boxes) / n
        row, column = np.divmod(np.arange(n * n), n)
        left, top, right, bottom = np.array(boxes).T[:, :, None]
        inside = (column >= left) & (column < right) & (row >= top) & (row < bottom)
        #: (areas, cells), 1 if a cell belongs to an area, else 0
        self.member = inside.astype(float)

    def __len__(self) -> int:
        return len(self.member)

    def cell(
        self, uv: NDArray[np.float64], size: Sequence[float] | np.ndarray
    ) -> NDArray[np.int64]:
        """Return cells (n,) of pixels uv (n, 2) in an image of size (width, height) [px].

        Pixels off the image belong to the nearest cell.
        """
        column, row = cells_of(uv, size, self.n).T
        return column + self.n * row

    def describe(self, area: int, size: Sequence[float]) -> tuple[tuple[float, ...], str]:
        """Return corners (u0, v0, u1, v1) [px] of an area in an image of a size, and its name."""
        u0, v0, u1, v1 = self.box[area]
        corners = tuple(float(x) for x in self.box[area] * np.tile(size, 2) - 0.5)
        horizontal = _side(u0 + u1, 'left', 'right')
        vertical = _side(v0 + v1, 'upper', 'lower')
        width = u1 - u0
        height = v1 - v0
        if width == 1 and height == 1:
            return corners, 'whole image'
        if width == 1 or height == 1:
            return corners, f'{horizontal if height == 1 else vertical} half'
        if width < 0.5:
            middle = self.box[area].reshape(2, 2).mean(axis=0) * size - 0.5
            return (
                corners,
                f'{vertical} {horizontal} quarter, about ({middle[0]:.0f}, {middle[1]:.0f}) px',
            )
        if 'middle' in (horizontal, vertical):
            return corners, 'middle' if horizontal == vertical else f'{vertical} {horizontal}'
        return corners, f'{vertical} {horizontal} quarter'


def _side(edges: float, low: str, high: str) -> str:
    """Return the side of the image of an interval, given the sum of its edges."""
    if edges == 1:
        return 'middle'
    return low if edges < 1 else high


MEMORY = 160  # number of blocks over which the variance is estimated
PRIOR_DIFFERENCES = 20  # weight of the pooled variance in that of an area, in pairs of blocks
VARIANCE_MARGIN = 1.25  # a variance estimated from 100 differences has a relative sd of 15 %
MIN_BLOCKS_TO_ALARM = 4
EVIDENCE_CAP = 1.5  # multiple of the threshold of ERROR; evidence falls soon after a drift ends
MIN_INFORMATION = 1e-300  # avoids division by zero


class CusumCharts:
    """CUSUM charts of K series in A areas and both directions, with estimated variances.

    series, areas: K and A. step_px: excess over the dead band to which the charts are most
    sensitive [px]. cap: maximum evidence.
    """

    def __init__(self, series: int, areas: int, step_px: float, cap: float) -> None:
        shape = (series, areas)
        self._step = step_px
        self._cap = cap
        #: (2, K, A), for drifts in positive and in negative direction
        self.evidence = np.zeros((2, *shape))
        #: (2, K, A), start time of the present run of each chart [ns]
        self.begin = np.zeros((2, *shape), dtype=np.int64)
        #: (K, 1), variance of a long sum of blocks over the variance of their differences
        self.stretch = np.ones((series, 1))
        self._run = np.zeros((2, 2, *shape))  # score and information of the runs, by direction
        self._squares = np.zeros(shape)
        self._count = np.zeros(shape)
        self._last = np.full((2, *shape), np.nan)  # mean and variance of the last block
        self._decay = 1 - 1 / MEMORY

    def variance_factor(self) -> NDArray[np.float64]:
        """Return the variance of sums of blocks over the predicted variance (K, A).

        It is the estimate, at least 1, times VARIANCE_MARGIN.
        """
        pooled = (1 + self._squares.sum(axis=1)) / (1 + self._count.sum(axis=1))
        pooled = np.maximum(pooled, 1)[:, None]
        total = (PRIOR_DIFFERENCES * pooled + self._squares) / (PRIOR_DIFFERENCES + self._count)
        return VARIANCE_MARGIN * np.maximum(total, 1) * self.stretch

    def update(
        self,
        score: NDArray[np.float64],
        information: NDArray[np.float64],
        band: NDArray[np.float64],
        testing: NDArray[np.bool_],
        stamp_ns: int,
    ) -> None:
        """Add one block.

        Parameters
        ----------
        score, information : ndarray
            (K, A), score and information of the drifts [1/px, 1/px^2].
        band : ndarray
            (K, A), dead bands [px].
        testing : ndarray
            (K, A), where the block counts as evidence.
        stamp_ns : int
            Time at which the block began [ns].
        """
        seen = information > 0
        factor = self._update_variance(score, information, seen)
        step = self._step
        sign = np.array([1.0, -1.0])[:, None, None]
        with np.errstate(invalid='ignore'):
            gain = step * (sign * score - band * information - step / 2 * information) / factor
        max_gain = self._cap / EVIDENCE_CAP / MIN_BLOCKS_TO_ALARM
        gain = np.where(seen & testing, np.minimum(gain, max_gain), 0.0)
        begins = (self.evidence <= 0) & (gain > 0)
        self.begin[begins] = stamp_ns
        self._run[:, begins] = 0
        self._run += np.where(seen & testing, np.stack([score, information]), 0)[:, None]
        self.evidence = np.clip(self.evidence + gain, 0, self._cap)

    def _update_variance(
        self, score: NDArray[np.float64], information: NDArray[np.float64], seen: NDArray[np.bool_]
    ) -> NDArray[np.float64]:
        """Add the differences from the last block; return the previous factor (K, A)."""
        factor = self.variance_factor()
        with np.errstate(divide='ignore', invalid='ignore'):
            estimate = np.stack([score / information, 1 / information])
            square = (estimate[0] - self._last[0]) ** 2 / (estimate[1] + self._last[1])
        has_both = np.isfinite(square)
        decay = np.where(has_both, self._decay, 1)
        self._squares *= decay
        self._count *= decay
        # The onset of a drift is one large difference. It must not increase the variance with
        # which the drift is tested.
        self._squares[has_both] += np.minimum(square, 9 * factor)[has_both]
        self._count[has_both] += 1
        self._last = np.where(seen, estimate, self._last)
        return factor

    def log_likelihood(self) -> NDArray[np.float64]:
        """Return the log-likelihood (2, K, A) of a drift of any size in the present runs."""
        score, information = self._run
        return score**2 / (2 * np.maximum(information, MIN_INFORMATION) * self.variance_factor())
