# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Clipped pixels, and what they tell about the light.

A clipped pixel only tells that the light is beyond a bound. Its likelihood is the probability of
that (Tobin, "Estimation of relationships for limited dependent variables", Econometrica 26, 1958).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import erfcx

MIN_CLIPPED = 10  # largest number of outermost grey values that is no evidence of clipping
# JPEG from a quality of 15 changes flat areas by up to half of its quantisation step of 6.7.
CHANGED = 3
OFTEN = 10.0  # a grey value that clipped pixels have, over the number of all others nearby
# Information of a clipped pixel, over that of others, below which it is not used: 2.4 standard
# deviations of the noise beyond the bound.
MIN_INFORMATION = 0.05


@dataclass(frozen=True)
class Clipping:
    """Grey values at which an image is clipped: less, or more, light does not change them."""

    low: float = -np.inf
    high: float = np.inf

    @classmethod
    def of(cls, grey: NDArray[np.floating]) -> Clipping:
        """Return that of an image (h, w)."""
        lowest = float(grey.min())
        highest = float(grey.max())
        return cls(_clipped_from(grey, lowest, 1.0), _clipped_from(grey, highest, -1.0))

    def __bool__(self) -> bool:
        return bool(np.isfinite([self.low, self.high]).any())

    def leaves(self, grey: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return whether grey values (...) are not clipped."""
        return (grey > self.low) & (grey < self.high)

    def observed(
        self,
        grey: NDArray[np.floating],
        light: NDArray[np.floating],
        variance: NDArray[np.floating],
    ) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Return residuals and information (...) of grey values (...).

        light, variance: (...) expected values, and variances of the noise. The information is
        relative to that of pixels that are not clipped. A Gauss-Newton step with both is a step of
        Newton's method for the likelihood.
        """
        residual = grey - light
        information = np.ones_like(residual)
        for bound, beyond in ((self.low, -1.0), (self.high, 1.0)):
            clipped = np.nonzero(beyond * grey >= beyond * bound)
            if len(clipped[0]):
                sd = np.sqrt(variance[clipped])
                # Half a grey value less is rounded to the bound.
                expected = (beyond * (light[clipped] - bound) + 0.5) / sd
                distance, known = _censored(expected)
                residual[clipped] = beyond * sd * distance
                information[clipped] = np.where(known < MIN_INFORMATION, 0.0, known)
        return residual, information


UNCLIPPED = Clipping()


def _clipped_from(grey: NDArray[np.floating], outermost: float, inwards: float) -> float:
    """Return the innermost value of clipped pixels, an infinity if none are clipped.

    With noise alone, the outermost value is rarer than its neighbour. Compression with losses
    changes clipped pixels by a few values; one of these is then far more frequent than all others
    nearby.
    """
    nearby = 2 * CHANGED + 1
    ends = sorted((outermost - 0.5 * inwards, outermost + (nearby - 0.5) * inwards))
    count = cv2.calcHist([grey.astype(np.float32, copy=False)], [0], None, [nearby], ends)[:, 0]
    count = count[:: int(inwards)]
    most = int(np.argmax(count[: CHANGED + 1]))
    if count[most] > max(OFTEN * (count.sum() - count[most]), MIN_CLIPPED):
        return outermost + inwards * most
    return outermost if count[0] > max(count[1], MIN_CLIPPED) else -inwards * np.inf


def _censored(expected: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return residuals and information (k,) of values of which only a bound is known.

    expected: (k,) expected values beyond the bound. The unit of all is the standard deviation.
    """
    expected = expected.astype(float)
    # normal density over the probability of being beyond the bound
    ratio = np.sqrt(2 / np.pi) / erfcx(-expected / np.sqrt(2))
    slope = np.maximum(ratio + expected, np.finfo(float).tiny)
    return 1 / slope, ratio * slope
