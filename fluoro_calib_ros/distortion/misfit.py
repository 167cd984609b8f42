# Copyright 2026 fluoro_calib_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""What a correction model cannot follow, seen in its residuals.

Residuals of neighbouring image points of different exposures have independent noise. Their mean
product is therefore the square of the error that all exposures have in common, less the variance
of the correction, which makes residuals of neighbours opposite (joins in the sense of Moran,
Biometrika 37, 1950). The square is part of the variance of the correction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from .series import SD_GRID, Series, sd_grid_pixels

NEIGHBOURS = 5  # of an image point, those of its own exposure not counted
POINTS = 60  # image points about a node of the grid
# Standard errors above which a mean product is not chance: of all image points, of those about one
# of the nodes.
SIGNIFICANT = 4.0
SIGNIFICANT_LOCAL = 4.5


@dataclass(frozen=True)
class FittedPoints:
    """Inliers of one fluoroscope.

    uv (n, 2) [px], residuals (n, 2) [px] with the correction, exposure (n,).
    """

    uv: np.ndarray
    residuals: np.ndarray
    exposure: np.ndarray


def neighbour_products(points: FittedPoints) -> np.ndarray:
    """Mean products (n,) [px^2] of a coordinate of each residual with those of its neighbours.

    NaN where all neighbours are of the same exposure.
    """
    count = min(NEIGHBOURS + 1, len(points.uv))
    _, near = cKDTree(points.uv).query(points.uv, k=np.arange(2, count + 1))
    other = points.exposure[near] != points.exposure[:, None]
    r = points.residuals
    products = np.einsum('na,nka->nk', r, r[near]) / 2
    number = other.sum(axis=1)
    with np.errstate(invalid='ignore'):
        return np.where(other, products, 0.0).sum(axis=1) / np.where(number, number, np.nan)


def has_common_error(points: FittedPoints) -> bool:
    """Whether residuals show an error that all exposures have in common."""
    products = neighbour_products(points)
    usable = np.isfinite(products)
    return _is_significant(products[usable], points.exposure[usable])


def misfit_over_image(points: FittedPoints, series: Series) -> np.ndarray:
    """Standard deviations (33, 33) [px] of what a series cannot follow, on its grid.

    Zeros where the residuals do not show a common error.
    """
    out = np.zeros((SD_GRID, SD_GRID))
    products = neighbour_products(points)
    usable = np.isfinite(products)
    if usable.sum() < 2 * POINTS:
        return out
    uv = points.uv[usable]
    products = products[usable]
    everywhere = _is_significant(products, points.exposure[usable])
    pixels = sd_grid_pixels(series.functions.image_size)
    _, near = cKDTree(uv).query(pixels, k=POINTS)
    mean = products[near].mean(axis=1)
    # Each product occurs twice among the points about a node.
    error = products[near].std(axis=1) * np.sqrt(2 / POINTS)
    shown = mean > SIGNIFICANT_LOCAL * error
    square = np.maximum(mean.reshape(out.shape) + series.sd**2, 0.0)
    return np.where((shown | everywhere).reshape(out.shape), np.sqrt(square), 0.0)


def _is_significant(products: np.ndarray, exposure: np.ndarray) -> bool:
    """Whether the mean of products (n,) is above zero, by its scatter between exposures (n,)."""
    _, place = np.unique(exposure, return_inverse=True)
    number = np.bincount(place)
    means = np.bincount(place, products) / number
    if len(means) < 3:
        return False
    mean = np.average(means, weights=number)
    variance = np.average((means - mean) ** 2, weights=number) / (len(means) - 1)
    return bool(mean > SIGNIFICANT * np.sqrt(variance))
