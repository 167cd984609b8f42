# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""How far normalised errors scatter beyond what is stated, for limits that tell gross errors.

A limit in standard deviations rejects true observations where these are stated too small. The
scale of the errors is observed robustly: the median of those within the limit, over the median of
the stated distribution; the limit follows it until it is steady, from the stated one upwards, so
that gross errors beyond it do not count (trimmed scale by iteration: Rousseeuw and Leroy, "Robust
Regression and Outlier Detection", 1987, 5.1). Only what exceeds chance widens a limit: where the
errors are as stated, the factor is 1.
"""

from __future__ import annotations

from collections import deque

import numpy as np

# Standard deviations of the observed scale that are taken for chance.
SURE = 3.0
# Relative standard deviation of the median of n absolute normal errors, times the root of n:
# 1 / (2 f(m) m) with the density f at the median m. For lengths of errors of two coordinates it is
# 0.72, but tails can be heavy.
MEDIAN_SD = 1.166
MAX_WIDENING = 2.0  # beyond it, something else than the stated standard deviations is wrong
MIN_ERRORS = 12
ITERATIONS = 20
WINDOW = 2000  # latest errors of a recording that count
RENEWED = 0.1  # part of them after which the factor is calculated anew


def widening(size: np.ndarray, limit: float, common: float = 0.0) -> float:
    """Factor of 1 or more by which errors scatter beyond what is stated and beyond chance.

    Parameters
    ----------
    size : (n,) ndarray
        Absolute errors over the median that is expected of them.
    limit : float
        Size beyond which an error is gross.
    common : float
        Part of the stated variance that all errors have in common: it may be far off in all of
        them, and still as stated.
    """
    size = size[np.isfinite(size)]
    scale = 1.0
    count = 0
    for _ in range(ITERATIONS):
        inside = size[size <= limit * scale]
        if len(inside) < MIN_ERRORS:
            return 1.0
        if len(inside) == count:
            break
        count = len(inside)
        scale = max(1.0, float(np.median(inside)))
    chance = (1 - common) * (1 + SURE * MEDIAN_SD / np.sqrt(count)) ** 2 + common * SURE**2
    return float(np.clip(scale / np.sqrt(chance), 1.0, MAX_WIDENING))


def widening_by_group(size: np.ndarray, limit: float, group: np.ndarray) -> np.ndarray:
    """Factors (n,) of errors (n,), each that of its group (n,), such as an exposure."""
    out = np.ones(len(size))
    order = np.argsort(group, kind='stable')
    starts = np.flatnonzero(np.diff(group[order], prepend=-1))
    for rows in np.split(order, starts[1:]):
        out[rows] = widening(size[rows], limit)
    return out


class ObservedScatter:
    """Factor by which the latest errors of a recording scatter beyond what is stated.

    Attributes
    ----------
    factor : float
    """

    def __init__(self) -> None:
        self.factor = 1.0
        self._latest: deque[tuple[np.ndarray, np.ndarray]] = deque()
        self._count = 0
        self._new = 0

    def add(self, size: np.ndarray, common: np.ndarray, limit: float) -> None:
        """Take in errors and their common parts (n,) as `widening` takes them."""
        self._latest.append((size, common))
        self._count += len(size)
        self._new += len(size)
        while self._count - len(self._latest[0][0]) >= WINDOW:
            self._count -= len(self._latest.popleft()[0])
        if self._new >= RENEWED * self._count:
            self._new = 0
            sizes = np.concatenate([a for a, _ in self._latest])
            share = np.concatenate([b for _, b in self._latest])
            known = np.isfinite(share)
            mean = float(np.mean(share[known])) if known.any() else 0.0
            self.factor = widening(sizes, limit, mean)
