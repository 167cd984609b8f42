# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Comparison of two independent calibrations of one fluoroscope, and names of image areas.

The comparison is the cross-validation of mrcal (D. Kogan, mrcal documentation, "A tour of mrcal:
cross-validation"): two calibrations that share no exposure predict the same, except for what the
orientation absorbs and for their noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..calibration.result import FluoroscopeCalibration, at_common_angle

GRID = 24  # points across the image at which predictions are compared
MIN_POINTS = 20  # of the grid inside both calibrated areas
MIN_SD_PX = 1e-3  # of a prediction: a model without uncertainty would cause a division by 0


@dataclass(frozen=True)
class FieldDifference:
    """Difference of the predictions of two calibrations.

    Attributes
    ----------
    uv : (n, 2) ndarray
        Observed pixels.
    duv : (n, 2) ndarray
        Difference [px], without what orientations absorb.
    sd : (n,) ndarray
        Its predicted standard deviation [px].
    """

    uv: np.ndarray
    duv: np.ndarray
    sd: np.ndarray

    @property
    def normalised(self) -> float:
        """RMS of the differences divided by their predicted standard deviations; expected: 1."""
        return float(np.sqrt(np.mean(np.sum(self.duv**2, axis=1) / (2 * self.sd**2))))

    @property
    def rms_px(self) -> float:
        """RMS of a coordinate of the differences [px]."""
        return float(np.sqrt(np.mean(self.duv**2)))

    @property
    def worst(self) -> np.ndarray:
        """Pixel (2,) with the largest difference divided by its standard deviation."""
        return self.uv[np.argmax(np.linalg.norm(self.duv, axis=1) / self.sd)]


def image_grid(image_size: tuple[int, int]) -> np.ndarray:
    """Return pixels (GRID^2, 2), evenly spaced over an image (width, height)."""
    u, v = ((np.arange(GRID) + 0.5) / GRID * size - 0.5 for size in image_size)
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)


def orientation_fields(xy: ArrayLike) -> np.ndarray:
    """Return the displacements (2n, 6) of points xy (n, 2) that orientations absorb.

    Coordinates are in units of the principal distance. The columns are a shift of the image in
    both directions, its scale, its rotation, and its tilt about both axes (the linearised
    projective map of a rotated sensor).
    """
    x, y = np.asarray(xy, dtype=float).T
    one = np.ones_like(x)
    zero = np.zeros_like(x)
    u = np.stack([one, zero, x, -y, x * x, x * y], axis=1)
    v = np.stack([zero, one, y, x, x * y, y * y], axis=1)
    return np.stack([u, v], axis=1).reshape(-1, 6)


def difference(
    one: FluoroscopeCalibration, other: FluoroscopeCalibration
) -> FieldDifference | None:
    """Compare what two calibrations predict in the area that both cover.

    An observed pixel u stands for the ray (u - du - (xp, yp)) / c. The rays are compared, as
    pixels at the mean principal distance, after the best combination of `orientation_fields` is
    removed. Returns None for an area that is too small.
    """
    grid = image_grid(one.image_size)
    corrections = at_common_angle(grid, one, other)
    both = ~(corrections[0].outside | corrections[1].outside)
    if both.sum() < MIN_POINTS:
        return None
    uv = grid[both]
    rays = [
        (uv - correction.duv[both] - calibration.interior[:2]) / calibration.interior[2]
        for calibration, correction in zip((one, other), corrections)
    ]
    c_mean = (one.interior[2] + other.interior[2]) / 2
    variance = sum(correction.sd[both] ** 2 for correction in corrections)
    sd = np.maximum(np.sqrt(variance), MIN_SD_PX)
    offset = c_mean * (rays[0] - rays[1])
    basis = orientation_fields((rays[0] + rays[1]) / 2)
    weight = 1 / np.repeat(sd, 2)
    fit, *_ = np.linalg.lstsq(basis * weight[:, None], offset.ravel() * weight, rcond=None)
    return FieldDifference(uv, offset - (basis @ fit).reshape(-1, 2), sd)


def place_name(uv: ArrayLike, image_size: tuple[int, int]) -> str:
    """Return the ninth of the image with a pixel (2,): 'upper left', ..., 'lower right'."""
    thirds = (np.asarray(uv) + 0.5) / np.asarray(image_size) * 3
    column, row = np.clip(thirds, 0, 2.999).astype(int)
    across = ('left', 'middle', 'right')[column]
    down = ('upper', 'middle', 'lower')[row]
    return 'middle' if across == down else f'{down} {across}'


def describe_place(uv: ArrayLike, image_size: tuple[int, int]) -> str:
    """Return a pixel (2,) in words and numbers."""
    u, v = np.asarray(uv)
    return f'the {place_name(uv, image_size)} of the image (about u {u:.0f}, v {v:.0f})'
