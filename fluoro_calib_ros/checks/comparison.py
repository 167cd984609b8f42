# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Compare two calibrations of a fluoroscope: correction field and interior orientation.

The corrections of two calibrations may differ by fields that shift, rotate and scale the image:
their interior and exterior orientations absorb such fields (the gauge). The remaining difference
is compared with the standard deviations of both, which are assumed to be independent.

Each interior orientation belongs to a gauge that depends on the distribution of the image points
of its exposures. For example, a rotation of the sensor by 10 mrad together with the corresponding
shift of the principal point, some 40 px, changes the corrections by less than a pixel. Interior
orientations are therefore compared in a common gauge, that of the area common to both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtri

from ..correction.base import Correction
from ..correction.fluoroscope_calibration import FluoroscopeCalibration, at_common_angle
from ..correction.series import sd_grid_pixels
from ..errors import DataError
from ..estimation.estimator import interior_about, orientation_fields
from ..estimation.model_choice import MIN_PIXELS
from ..estimation.signal import MIN_SD_PX
from ..exposures.frame import cells_of
from ..photogrammetry.outliers import SIGNIFICANCE
from ..rows import chosen_rows

# The comparison is the cross-validation of mrcal (D. Kogan, mrcal documentation, "A tour of mrcal:
# cross-validation"): two calibrations that share no exposure make the same predictions, except for
# what the orientation absorbs and for their noise.


@dataclass(frozen=True)
class FieldDifference:
    """Difference of the predictions of two calibrations."""

    uv: NDArray[np.float64]  #: (n, 2) observed pixels
    duv: NDArray[np.float64]  #: (n, 2) difference [px], without the part that orientations absorb
    sd: NDArray[np.float64]  #: (n,) its predicted standard deviation [px]

    @property
    def normalised(self) -> float:
        """RMS of the differences over their predicted standard deviations; expected to be 1."""
        return float(np.sqrt(np.mean(np.sum(self.duv**2, axis=1) / (2 * self.sd**2))))

    @property
    def rms_px(self) -> float:
        """RMS of a coordinate of the differences [px]."""
        return float(np.sqrt(np.mean(self.duv**2)))

    @property
    def worst(self) -> NDArray[np.float64]:
        """Pixel (2,) with the largest ratio of difference and standard deviation."""
        return self.uv[np.argmax(np.linalg.norm(self.duv, axis=1) / self.sd)]


def difference(
    one: FluoroscopeCalibration, other: FluoroscopeCalibration
) -> FieldDifference | None:
    """Compare the predictions of two calibrations in the area that both cover.

    An observed pixel u represents the ray (u - du - (xp, yp)) / c. The rays are compared as pixels
    at the mean principal distance, after removing the best combination of `orientation_fields`.
    Returns None if the area is too small.
    """
    uv, corrections = _common(one, other, sd_grid_pixels(one.image_size))
    return _difference(uv, (one.interior, other.interior), corrections) if len(uv) else None


def _common(
    one: FluoroscopeCalibration, other: FluoroscopeCalibration, uv: NDArray[np.float64]
) -> tuple[NDArray[np.float64], list[Correction]]:
    """Return the pixels (k, 2) of uv (n, 2) that both cover, and both corrections.

    No pixels if they are too few.
    """
    corrections = at_common_angle(uv, one, other)
    inside = ~(corrections[0].outside | corrections[1].outside)
    if inside.sum() < MIN_PIXELS:
        inside[:] = False
    return uv[inside], [chosen_rows(correction, inside) for correction in corrections]


def _difference(
    uv: NDArray[np.float64],
    interiors: Sequence[NDArray[np.float64]],
    corrections: Sequence[Correction],
) -> FieldDifference:
    """Return the first minus the second prediction at pixels uv (n, 2)."""
    rays = [
        (uv - correction.duv - interior[:2]) / interior[2]
        for interior, correction in zip(interiors, corrections)
    ]
    c_mean = (interiors[0][2] + interiors[1][2]) / 2
    variance = sum(correction.sd**2 for correction in corrections)
    sd = np.maximum(np.sqrt(variance), MIN_SD_PX)
    offset = c_mean * (rays[0] - rays[1])
    basis = orientation_fields((rays[0] + rays[1]) / 2).reshape(-1, 6)
    weight = 1 / np.repeat(sd, 2)
    fit, *_ = np.linalg.lstsq(basis * weight[:, None], offset.ravel() * weight, rcond=None)
    return FieldDifference(uv, offset - (basis @ fit).reshape(-1, 2), sd)


def place_name(uv: ArrayLike, image_size: tuple[int, int]) -> str:
    """Return the name of the ninth of the image with a pixel (2,), such as 'upper left'."""
    column, row = cells_of(uv, image_size, 3)
    horizontal = ('left', 'middle', 'right')[column]
    vertical = ('upper', 'middle', 'lower')[row]
    return 'middle' if horizontal == vertical else f'{vertical} {horizontal}'


def describe_place(uv: ArrayLike, image_size: tuple[int, int]) -> str:
    """Describe a pixel (2,) in words and numbers."""
    u, v = np.asarray(uv)
    return f'the {place_name(uv, image_size)} of the image (about u {u:.0f}, v {v:.0f})'


CELLS = 64  # number of cells along the longer side of the image


@dataclass(frozen=True)
class Comparison:
    """Difference of two calibrations of a fluoroscope, second minus first."""

    fluoroscope: str
    image_size: tuple[int, int]
    #: (3,) difference of xp, yp, c [px], in a common gauge, and its standard deviation
    interior: NDArray[np.float64]
    interior_sd: NDArray[np.float64]
    #: weighted sum of squares of the difference and its 99 % quantile; NaN if both were fixed
    interior_test: float
    interior_limit: float
    uv: NDArray[np.float64]  #: (n, 2) pixels that both calibrations cover
    duv: NDArray[np.float64]  #: (n, 2) difference of the corrections, without the gauge [px]
    sd: NDArray[np.float64]  #: (n,) standard deviation of each coordinate of the difference [px]

    @property
    def size(self) -> NDArray[np.float64]:
        """Lengths (n,) of the differences [px]."""
        return np.hypot(*self.duv.T)

    @property
    def significant(self) -> NDArray[np.bool_]:
        """Whether (n,) each difference exceeds its 99 % quantile."""
        return self.size**2 > chdtri(2, SIGNIFICANCE) * self.sd**2

    @property
    def rms_px(self) -> float:
        """RMS of the differences, both coordinates combined [px]."""
        return float(np.sqrt(np.mean(self.size**2)))

    @property
    def largest(self) -> tuple[float, tuple[float, float]]:
        """Largest difference [px], and its pixel."""
        index = int(np.argmax(self.size))
        u, v = self.uv[index].tolist()
        return float(self.size[index]), (u, v)

    @property
    def field_changed(self) -> bool:
        """Whether the field differs in a larger part of the image than by chance.

        By chance, a fraction SIGNIFICANCE of the cells exceeds the quantile; the limit is twice
        that, as cells are correlated.
        """
        return bool(self.significant.mean() > 2 * SIGNIFICANCE)

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
    uv, corrections = _common(first, second, cell_centres(first.image_size, CELLS)[1])
    if not len(uv):
        raise DataError(f'fluoroscope {name}: the calibrated areas hardly overlap')
    compared = _difference(uv, (first.interior, second.interior), corrections)
    covariance = first.interior_covariance + second.interior_covariance
    difference = second.interior - first.interior
    if first.interior_estimated or second.interior_estimated:
        difference = _interior_difference(uv, (first, second), corrections)
    test, limit = _test(difference, covariance)
    return Comparison(
        name,
        first.image_size,
        interior=difference,
        interior_sd=np.sqrt(np.diag(covariance)),
        interior_test=test,
        interior_limit=limit,
        uv=uv,
        duv=compared.duv,  # rays change by the negative correction
        sd=compared.sd,
    )


def _interior_difference(
    uv: NDArray[np.float64],
    calibrations: Sequence[FluoroscopeCalibration],
    fields: Sequence[Correction],
) -> NDArray[np.float64]:
    """Return second - first interior orientation (3,) in the gauge at pixels uv (n, 2).

    The gauge is defined about the middle of the image: a strong distortion moves principal points
    far away, where several solutions exist.
    """
    centre = (np.array(calibrations[0].image_size) - 1) / 2
    first, second = (
        interior_about(centre, uv, field.duv, calibration.interior)
        for calibration, field in zip(calibrations, fields)
    )
    return second - first


def cell_centres(
    image_size: Sequence[int], cells: int
) -> tuple[list[np.ndarray], NDArray[np.float64]]:
    """Return columns and rows of the centres of cells over an image, and the centres (n, 2).

    cells: number of cells along the longer side.
    """
    step = max(image_size) / cells
    axes = [-0.5 + step / 2 + step * np.arange(max(1, round(size / step))) for size in image_size]
    u, v = np.meshgrid(*axes)
    return axes, np.column_stack([u.ravel(), v.ravel()])


def _test(difference: NDArray[np.float64], covariance: NDArray[np.float64]) -> tuple[float, float]:
    """Return the weighted sum of squares of a difference (3,), and its limit; NaN if fixed."""
    free = np.diag(covariance) > 0
    if not free.any():
        return float('nan'), float('nan')
    part = difference[free]
    test = float(part @ np.linalg.solve(covariance[np.ix_(free, free)], part))
    return test, float(chdtri(int(free.sum()), SIGNIFICANCE))
