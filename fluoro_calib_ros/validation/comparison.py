# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What changed between two calibrations of a fluoroscope: the interior orientation and the field.

The corrections of two calibrations may differ by what shifts, turns and scales the image: their
interior and exterior orientations absorb it (the gauge). What is left is compared with the
standard deviations of both, which are taken as independent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from ..calibration.result import FluoroscopeCalibration, at_common_angle
from ..distortion.gauge import gauge_basis
from ..errors import DataError

CELLS = 64  # along the longer side of the image
LEVEL = 0.99
MIN_COMMON = 20  # cells that both calibrations cover
# Of the area: this much differs at the level by chance, doubled for the cells' correlation.
CHANCE = 2 * (1 - LEVEL)


@dataclass(frozen=True)
class Comparison:
    """Difference of two calibrations of a fluoroscope, the second minus the first.

    Attributes
    ----------
    fluoroscope : str
    image_size : (int, int)
    interior, interior_sd : (3,) ndarray
        Difference of xp, yp, c [px] and its standard deviation.
    interior_test, interior_limit : float
        Weighted square sum of the difference, and its 99 % quantile; NaN where both were held.
    uv : (n, 2) ndarray
        Pixels that both calibrations cover.
    duv : (n, 2) ndarray
        Difference of the corrections there, without gauge [px].
    sd : (n,) ndarray
        Its standard deviation in each coordinate [px].
    """

    fluoroscope: str
    image_size: tuple[int, int]
    interior: np.ndarray
    interior_sd: np.ndarray
    interior_test: float
    interior_limit: float
    uv: np.ndarray
    duv: np.ndarray
    sd: np.ndarray

    @property
    def size(self) -> np.ndarray:
        """Lengths (n,) of the differences [px]."""
        return np.hypot(*self.duv.T)

    @property
    def significant(self) -> np.ndarray:
        """Whether (n,) a difference exceeds its 99 % quantile."""
        return self.size**2 > chdtri(2, 1 - LEVEL) * self.sd**2

    @property
    def rms_px(self) -> float:
        """RMS of the differences, of both coordinates together [px]."""
        return float(np.sqrt(np.mean(self.size**2)))

    @property
    def largest(self) -> tuple[float, tuple[float, float]]:
        """The largest difference [px], and its pixel."""
        index = int(np.argmax(self.size))
        u, v = self.uv[index].tolist()
        return float(self.size[index]), (u, v)

    @property
    def field_changed(self) -> bool:
        """Whether the field differs in more of the image than by chance."""
        return bool(self.significant.mean() > CHANCE)

    @property
    def interior_changed(self) -> bool:
        """Whether the interior orientation differs significantly."""
        return bool(self.interior_test > self.interior_limit)


def compare_calibrations(
    first: FluoroscopeCalibration, second: FluoroscopeCalibration
) -> Comparison:
    """Compare two calibrations of a fluoroscope.

    Raises DataError for different image sizes, and for calibrated areas that hardly overlap.
    """
    name = first.fluoroscope
    if first.image_size != second.image_size:
        sizes = [f'{w} x {h} px' for w, h in (first.image_size, second.image_size)]
        raise DataError(f'fluoroscope {name}: the images are {sizes[0]} and {sizes[1]}')
    uv = _cells(first.image_size)
    fields = at_common_angle(uv, first, second)
    common = ~(fields[0].outside | fields[1].outside)
    if common.sum() < MIN_COMMON:
        raise DataError(
            f'fluoroscope {name}: the calibrated areas have hardly any image in common'
        )
    uv = uv[common]
    duv = fields[1].duv[common] - fields[0].duv[common]
    sd = np.hypot(fields[0].sd[common], fields[1].sd[common])
    difference = second.interior - first.interior
    covariance = first.interior_covariance + second.interior_covariance
    test, limit = _test(difference, covariance)
    return Comparison(
        name,
        first.image_size,
        difference,
        np.sqrt(np.diag(covariance)),
        test,
        limit,
        uv,
        _without_gauge(uv, duv, first.interior),
        sd,
    )


def _cells(image_size: tuple[int, int]) -> np.ndarray:
    """Return centres (n, 2) of cells over the image."""
    step = max(image_size) / CELLS
    axes = [-0.5 + step / 2 + step * np.arange(max(1, round(size / step))) for size in image_size]
    u, v = np.meshgrid(*axes)
    return np.column_stack([u.ravel(), v.ravel()])


def _without_gauge(uv: np.ndarray, duv: np.ndarray, interior: np.ndarray) -> np.ndarray:
    """Return differences (n, 2) without their part in the gauge."""
    basis = gauge_basis(uv, interior)
    part, *_ = np.linalg.lstsq(basis.reshape(-1, basis.shape[2]), duv.ravel(), rcond=None)
    return duv - basis @ part


def _test(difference: np.ndarray, covariance: np.ndarray) -> tuple[float, float]:
    """Return the weighted square sum of a difference (3,) and its limit; NaN without variance."""
    free = np.diag(covariance) > 0
    if not free.any():
        return float('nan'), float('nan')
    part = difference[free]
    test = float(part @ np.linalg.solve(covariance[np.ix_(free, free)], part))
    return test, float(chdtri(int(free.sum()), 1 - LEVEL))
