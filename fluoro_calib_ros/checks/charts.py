# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""CUSUM control charts of the drift watch.

In every area and in both directions a CUSUM (Page, Biometrika 41, 1954) sums the log-likelihood
ratio of a drift beyond the dead band against one at its edge. The expectation of every factor of
the likelihood ratio is at most 1 for all means within the band, so the mean number of blocks to a
false alarm of a chart is at least exp(threshold) (Lorden, Annals of Mathematical Statistics 42,
1971; for composite hypotheses Shin, Ramdas and Rinaldo, "E-detectors", New England Journal of
Statistics in Data Science 2, 2024). With M charts it is at least an M-th of that.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..exposures.frame import cells_of

# The areas of an image in which the drift watch looks for a drift.


class ImageAreas:
    """Overlapping areas of an image: n x n cells, windows of half its size, halves, and the whole.

    n: number of cells across the image, even.
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
        #: (areas, cells), 1 where a cell belongs to an area, else 0
        self.member = inside.astype(float)

    def __len__(self) -> int:
        return len(self.member)

    def cell(self, uv: np.ndarray, size: Sequence[float] | np.ndarray) -> np.ndarray:
        """Cells (n,) of pixels uv (n, 2) of an image of size (width, height) [px].

        Pixels off the image belong to the nearest cell.
        """
        column, row = cells_of(uv, size, self.n).T
        return column + self.n * row

    def describe(self, area: int, size: Sequence[float]) -> tuple[tuple[float, ...], str]:
        """Corners (u0, v0, u1, v1) [px] of an area of an image of that size, and its name."""
        u0, v0, u1, v1 = self.box[area]
        corners = tuple(float(x) for x in self.box[area] * np.tile(size, 2) - 0.5)
        across = _side(u0 + u1, 'left', 'right')
        down = _side(v0 + v1, 'upper', 'lower')
        width = u1 - u0
        height = v1 - v0
        if width == 1 and height == 1:
            return corners, 'whole image'
        if width == 1 or height == 1:
            return corners, f'{across if height == 1 else down} half'
        if width < 0.5:
            middle = self.box[area].reshape(2, 2).mean(axis=0) * size - 0.5
            return corners, f'{down} {across} quarter, about ({middle[0]:.0f}, {middle[1]:.0f}) px'
        if 'middle' in (across, down):
            return corners, 'middle' if across == down else f'{down} {across}'
        return corners, f'{down} {across} quarter'


def _side(edges: float, low: str, high: str) -> str:
    """Name of the side of the image on which an interval lies whose edges have this sum."""
    if edges == 1:
        return 'middle'
    return low if edges < 1 else high


MEMORY = 160  # blocks over which the variance is estimated
PRIOR_DIFFERENCES = 20  # weight of the pooled variance in that of one area, in pairs of blocks
VARIANCE_MARGIN = 1.25  # estimated from 100 differences, a variance has a relative sd of 15 %
MIN_BLOCKS_TO_ALARM = 4
EVIDENCE_CAP = 1.5  # times the threshold of ERROR, so that evidence falls once a drift has ended
MIN_INFORMATION = 1e-300  # avoids division by zero


class CusumCharts:
    """CUSUM charts of K series in A areas and both directions, with estimated variances.

    series, areas: K and A. step_px: excess over the dead band to which the charts are most
    sensitive [px]. cap: largest evidence.
    """

    def __init__(self, series: int, areas: int, step_px: float, cap: float) -> None:
        shape = (series, areas)
        self._step = step_px
        self._cap = cap
        #: (2, K, A), for drifts in the positive and in the negative direction
        self.evidence = np.zeros((2, *shape))
        #: (2, K, A), time at which the present run of each chart began [ns]
        self.begin = np.zeros((2, *shape), dtype=np.int64)
        #: (K, 1), variance of a long sum of blocks over that of their differences
        self.stretch = np.ones((series, 1))
        self._run = np.zeros((2, 2, *shape))  # score and information of the runs, by direction
        self._squares = np.zeros(shape)
        self._count = np.zeros(shape)
        self._last = np.full((2, *shape), np.nan)  # mean and variance of the last block
        self._decay = 1 - 1 / MEMORY

    def variance_factor(self) -> NDArray[np.float64]:
        """Variance of sums of blocks over the predicted one (K, A).

        It is the estimate, never below 1, times VARIANCE_MARGIN.
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
        testing: np.ndarray,
        stamp_ns: int,
    ) -> None:
        """Add one block.

        Parameters
        ----------
        score, information : ndarray
            (K, A), of the drifts [1/px, 1/px^2].
        band : ndarray
            (K, A), dead bands [px].
        testing : ndarray
            (K, A), where the block counts as evidence.
        stamp_ns : int
            Time at which the block began.
        """
        seen = information > 0
        factor = self._update_variance(score, information, seen)
        step = self._step
        sign = np.array([1.0, -1.0])[:, None, None]
        with np.errstate(invalid='ignore'):
            gain = step * (sign * score - band * information - step / 2 * information) / factor
        max_gain = self._cap / EVIDENCE_CAP / MIN_BLOCKS_TO_ALARM
        gain = np.where(seen & testing, np.minimum(gain, max_gain), 0.0)
        fresh = (self.evidence <= 0) & (gain > 0)
        self.begin[fresh] = stamp_ns
        self._run[:, fresh] = 0
        self._run += np.where(seen & testing, np.stack([score, information]), 0)[:, None]
        self.evidence = np.clip(self.evidence + gain, 0, self._cap)

    def _update_variance(
        self, score: np.ndarray, information: np.ndarray, seen: np.ndarray
    ) -> np.ndarray:
        """Add the differences from the last block; return the factor (K, A) as it was before."""
        factor = self.variance_factor()
        with np.errstate(divide='ignore', invalid='ignore'):
            now = np.stack([score / information, 1 / information])
            square = (now[0] - self._last[0]) ** 2 / (now[1] + self._last[1])
        both = np.isfinite(square)
        decay = np.where(both, self._decay, 1)
        self._squares *= decay
        self._count *= decay
        # The onset of a drift is one large difference. It must not raise the variance by which
        # the drift is tested.
        self._squares[both] += np.minimum(square, 9 * factor)[both]
        self._count[both] += 1
        self._last = np.where(seen, now, self._last)
        return factor

    def log_likelihood(self) -> NDArray[np.float64]:
        """Log-likelihood (2, K, A) of a drift of any size in the present runs."""
        score, information = self._run
        return score**2 / (2 * np.maximum(information, MIN_INFORMATION) * self.variance_factor())
