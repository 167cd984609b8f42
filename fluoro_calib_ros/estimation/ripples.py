# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Ripples: a part of the signal of a distortion within a few bands of spatial frequency.

A weave, a moire pattern or the seams of fibre plates repeat with a wavelength. To follow such
ripples, a covariance function of Matern's family has to include all longer waves too, and a series
for it needs as many sines. The periodogram of the residuals (Scargle, "Studies in astronomical
time series analysis II", ApJ 263, 1982) shows the few bands of frequencies that the ripples have.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from ..correction.series import MARGIN, Functions
from ..exposures.collector import MIN_EXPOSURES
from ..photogrammetry.outliers import FALSE_ALARM

# Number of sines along the image to search: ripples shorter than 53 px on 1024 px.
SEARCHED_BANDS = 50
# Standard deviations by which the mean power of a band with ripples must exceed that of noise.
# With 4, the sharp seam of two plates was taken for ripples.
SIGNIFICANT = 5.0
BESIDE_PEAK = 0.2  # least power of a band of the ripples, relative to the strongest band
LEAST_EXCESS = 0.1  # least initial power of a band in excess of the noise


@dataclass(frozen=True)
class Ripples:
    """Prior variances of the sines of bands of frequencies.

    width: of a band [1/px]; variances: [px^2] of bands 0, 1, ..., zero if there are no ripples.
    """

    width: float
    variances: tuple[float, ...]

    @property
    def bands(self) -> tuple[int, ...]:
        """Bands in which there are ripples."""
        return tuple(band for band, variance in enumerate(self.variances) if variance > 0)

    def band(self, frequency: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the band (s,) of frequency (s,) [1/px]."""
        return np.rint(frequency / self.width).astype(int)

    def variance(self, frequency: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the variances (s,) of sines of frequency (s,) [1/px]."""
        band = self.band(frequency)
        inside = band < len(self.variances)
        return np.where(inside, np.asarray(self.variances)[np.where(inside, band, 0)], 0.0)

    def with_variances(self, variances: NDArray[np.float64]) -> Ripples:
        """Return ripples in the same bands, with these variances (n,) of all bands."""
        new_variances = np.where(np.asarray(self.variances) > 0, variances, 0.0)
        return replace(self, variances=tuple(float(value) for value in new_variances))

    def alone(self) -> Ripples | None:
        """Return the ripples in the bands about the strongest; None: longer waves are as strong.

        A field without ripples grows weaker from band to band.
        """
        variances = np.asarray(self.variances)
        largest = float(variances.max())
        if variances[self.bands[0]] > BESIDE_PEAK * largest:
            return None
        used = _and_next(variances > BESIDE_PEAK * largest)
        return replace(self, variances=tuple(float(v) for v in np.where(used, variances, 0.0)))


def _and_next(bands: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return bands (n,) and their neighbours, because the image ends and the waves do not."""
    return np.convolve(bands, np.ones(3), 'same') > 0


def ripples_of(functions: Functions, coefficients: NDArray[np.float64]) -> Ripples | None:
    """Return the ripples of a series from its coefficients (2, m), or None if it has none."""
    if not functions.absent:
        return None
    count = functions.modes + 1
    squares = np.mean(coefficients[:, functions.trend :] ** 2, axis=0)
    number = np.maximum(np.bincount(functions.band, minlength=count), 1)
    variances = np.bincount(functions.band, squares, count) / number
    variances[: functions.complete + 1] = 0.0
    return Ripples(functions.frequency_of_mode, tuple(float(value) for value in variances))


def shown_ripples(
    image_size: tuple[int, int],
    uv: NDArray[np.float64],
    residuals: NDArray[np.float64],
    exposure: NDArray[np.int64],
    complete: int,
) -> Ripples | None:
    """Return the ripples that residuals show beyond the sines of a series, or None.

    Parameters
    ----------
    image_size : (int, int)
        Width and height of the image [px].
    uv, residuals : (n, 2) ndarray
        Image points and their residuals [px].
    exposure : (n,) ndarray
        Exposures of the image points.
    complete : int
        Number of bands of which the series has all sines.
    """
    functions = Functions(image_size, -1, SEARCHED_BANDS)
    products, squares = functions.sums_of_sines(uv, residuals)
    noise = float(np.mean(residuals**2))
    power = np.mean(products**2, axis=1) / (squares * noise)
    number = np.maximum(np.bincount(functions.band), 1)
    excess = np.bincount(functions.band, power) / number - 1
    bands = np.arange(len(number))
    # The power of a sine is a mean of two squares and has a standard deviation of one. The image
    # determines only a part of the sines over their rectangle.
    shown = (excess > SIGNIFICANT * MARGIN / np.sqrt(number)) & (bands > complete)
    if shown.any():
        shown[shown] = _are_common(functions, uv, residuals, exposure, bands[shown])
    if not shown.any():
        return None
    used = _and_next(shown)
    used &= (bands > complete) & (bands <= SEARCHED_BANDS)
    variances = np.maximum(excess, LEAST_EXCESS) * noise / float(np.mean(squares))
    return Ripples(
        functions.frequency_of_mode, tuple(float(v) for v in np.where(used, variances, 0.0))
    )


def _are_common(
    functions: Functions,
    uv: NDArray[np.float64],
    residuals: NDArray[np.float64],
    exposure: NDArray[np.int64],
    bands: NDArray[np.int64],
) -> NDArray[np.bool_]:
    """Whether the ripples of residuals (n, 2) in bands (b,) are common to the exposures (n,).

    The products of pairs of exposures are compared with zero by Student's t. Those of different
    pairs are uncorrelated if the ripples of each exposure have random signs. FALSE_ALARM is the
    chance that such ripples agree in any band.
    """
    sums = np.stack(
        [
            functions.sums_of_sines(uv[exposure == e], residuals[exposure == e])[0]
            for e in np.unique(exposure)
        ]
    )
    first, second = np.triu_indices(len(sums), 1)
    if len(sums) < MIN_EXPOSURES:
        return np.zeros(len(bands), dtype=bool)
    limit = -stdtrit(len(first) - 1, FALSE_ALARM / SEARCHED_BANDS)
    out = []
    for band in bands:
        band_sums = sums[:, functions.band == band].reshape(len(sums), -1)
        product = (band_sums @ band_sums.T)[first, second]
        error = np.std(product, ddof=1) / np.sqrt(len(product))
        out.append(np.mean(product) > limit * error)
    return np.array(out)
