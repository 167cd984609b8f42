# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Analysis of residuals: lack of fit of a model, and noise that differs over the image.

Lack of fit of a correction model, seen in its residuals. Residuals of neighbouring image points of
different exposures have independent noise (joins in the sense of Moran, Biometrika 37, 1950).
Their mean product is therefore the square of the error that all exposures have in common, less the
variance of the correction, which makes residuals of neighbours opposite. A residual shows only the
part of both that its redundancy number gives (Foerstner and Wrobel, "Photogrammetric Computer
Vision", Springer 2016, 4.6); orientations and object points absorb the remainder. The square is
part of the variance of the correction.

Where the error is large, its image points are rejected like gross errors. False matches differ
from each other, but these image points agree.

Noise profile over the image. Blur, shading and oblique shadows make the noise of most cameras and
detectors larger towards the border; a correction magnifies it where it stretches the image; and
distortions that differ between exposures do so most at the border. The profile is estimated as a
gamma regression of the squares by quasi-likelihood (McCullagh and Nelder, "Generalized Linear
Models", 1989, 10.3).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.spatial import cKDTree
from scipy.special import bdtrc, log_ndtr, ndtri

from ..correction.fluoroscope_calibration import MAX_FACTOR, NoiseProfile, square_distance
from ..correction.series import Series, sd_grid_pixels
from ..exposures.collector import MIN_EXPOSURES
from ..photogrammetry.noise import CERTAIN
from ..photogrammetry.outliers import CONTRADICTION, FALSE_ALARM
from ..rows import chosen_rows

NEIGHBOURS = 5  # nearest neighbours of an image point; those of its own exposure are ignored
POINTS = 60  # image points about a node of the grid
MAX_GROWTH = 4.0  # largest ratio of a mean product, extrapolated to distance zero, to its value
PLACE = 0.1  # image points with more than this part of the largest variance are in a place
MIN_CORRELATION = 0.05  # least correlation at which products show what a series omits
FAR = 30.0  # standard deviations below zero beyond which the posterior is taken as exponential
LARGEST_SD = 40.0  # larger residuals [standard deviations] are no errors of a correction
# Rejected image points are tested together in areas, which are cells that overlap by half. An area
# needs image points of MIN_TARGETS targets that agree in MIN_EXPOSURES exposures.
CELLS = 8  # cells side by side along the image
MIN_TARGETS = 6
# Chance that false matches agree in any of the areas where more image points are rejected than
# chance explains; elsewhere it is FALSE_ALARM.
CLUSTERED_FALSE_ALARM = 0.05
# A border may have few image points: FEW_TARGETS targets in FEW_EXPOSURES exposures are enough for
# a test where the rejected image points are clustered.
FEW_TARGETS = 3
FEW_EXPOSURES = 2
DRAWS = 10_000  # random draws of the directions of few residuals


@dataclass(frozen=True)
class FittedPoints:
    """Inliers of one fluoroscope.

    uv (n, 2) [px]; residuals (n, 2) [px] with the correction; exposure (n,); redundancy (n,):
    redundancy number of a coordinate, 1 where it does not matter.
    """

    uv: NDArray[np.float64]
    residuals: NDArray[np.float64]
    exposure: NDArray[np.int64]
    redundancy: NDArray[np.float64] | float = 1.0


@dataclass(frozen=True)
class RejectedArea:
    """Rejected image points of an area.

    size_px: length of their mean residual; limit_px: length that false matches hardly exceed in
    any of the areas; place (2,): mean position [px]; rows: the image points.
    """

    size_px: float
    limit_px: float
    place: NDArray[np.float64]
    rows: NDArray[np.int64]


@dataclass(frozen=True)
class LeftOut:
    """Signal that a series omits by design, as expected from its covariance function.

    variance: function of pixels (n, 2), returns (n,) [px^2]; correlation: function of distances
    (n,) [px].
    """

    variance: Callable[[NDArray[np.float64]], NDArray[np.float64]]
    correlation: Callable[[NDArray[np.float64]], NDArray[np.float64]]


@dataclass(frozen=True)
class _Products:
    """Products of the residuals of n image points with those of their neighbours.

    uv (n, 2) [px]; value (n,): mean product of a coordinate [px^2]; shown (n,): mean product of
    the redundancy numbers, which is the part of a common error that the products show; exposure
    (n,); distance (n,): mean distance of the neighbours [px]; growth: mean product at distance
    zero over that at the distance of the neighbours, 1 where it does not grow.
    """

    uv: NDArray[np.float64]
    value: NDArray[np.float64]
    shown: NDArray[np.float64]
    exposure: NDArray[np.int64]
    distance: NDArray[np.float64]
    growth: float

    def mean_of_all(self) -> tuple[float, float]:
        """Return the mean product, and its standard error from the scatter between exposures."""
        _, place = np.unique(self.exposure, return_inverse=True)
        number = np.bincount(place)
        if len(number) < MIN_EXPOSURES:
            return 0.0, np.inf
        means = np.bincount(place, self.value) / number
        mean = np.average(means, weights=number)
        variance = np.average((means - mean) ** 2, weights=number) / (len(means) - 1)
        return float(mean), float(np.sqrt(variance))

    def is_significant(self) -> bool:
        """Whether the mean product is significantly above zero."""
        mean, error = self.mean_of_all()
        return mean > CERTAIN * error


def _products(points: FittedPoints) -> _Products:
    """Return the products of the image points that have neighbours of other exposures."""
    count = min(NEIGHBOURS + 1, len(points.uv))
    distance, neighbours = cKDTree(points.uv).query(points.uv, k=np.arange(2, count + 1))
    other_exposure = points.exposure[neighbours] != points.exposure[:, None]
    r = points.residuals
    redundancy = np.broadcast_to(points.redundancy, len(r))
    number = other_exposure.sum(axis=1)
    usable = number > 0

    def mean(of_pairs: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.where(other_exposure, of_pairs, 0.0).sum(axis=1)[usable] / number[usable]

    product = np.einsum('na,nka->nk', r, r[neighbours]) / 2
    return _Products(
        points.uv[usable],
        mean(product),
        shown=mean(redundancy[:, None] * redundancy[neighbours]),
        exposure=points.exposure[usable],
        distance=mean(distance),
        growth=_growth(product, distance, other_exposure),
    )


def _growth(
    product: NDArray[np.float64], distance: NDArray[np.float64], other: NDArray[np.bool_]
) -> float:
    """Extrapolate the mean of products (n, k) at distances (n, k) [px] to distance zero.

    Returns its ratio to the mean. The covariance of a smooth error falls with the square of the
    distance, so that nearer and farther neighbours determine it. other (n, k): pairs to use.
    """
    nearer = other & (distance < np.median(distance))
    farther = other & ~nearer
    if not nearer.any() or not farther.any():
        return 1.0
    square = distance**2
    slope = (product[nearer].mean() - product[farther].mean()) / (
        square[farther].mean() - square[nearer].mean()
    )
    at_zero = product[nearer].mean() + slope * square[nearer].mean()
    mean = product[other].mean()
    return float(np.clip(at_zero / mean, 1.0, MAX_GROWTH)) if mean > 0 else 1.0


def sd_with_lack_of_fit(
    points: FittedPoints, series: Series, left_out: Sequence[LeftOut] = ()
) -> NDArray[np.float64]:
    """Return standard deviations (33, 33) [px] of a series with its lack of fit, on its grid.

    series: its standard deviations are those of its coefficients alone; it omits signals left_out.
    """
    products = _products(points)
    variance = series.sd**2
    pixels = sd_grid_pixels(series.functions.image_size)
    if len(products.uv) < 2 * POINTS:
        expected = sum((signal.variance(pixels) for signal in left_out), np.zeros(len(pixels)))
        return np.sqrt(variance + expected.reshape(variance.shape))
    left_out_variance = np.zeros(len(pixels))
    for signal in left_out:
        left_out_variance += _variance_left_out(products, series, signal, pixels)
    _, neighbours = cKDTree(products.uv).query(pixels, k=POINTS)
    mean = products.value[neighbours].mean(axis=1)
    # Each product occurs twice among the points about a node.
    error = products.value[neighbours].std(axis=1) * np.sqrt(2 / POINTS)
    is_significant = products.is_significant()
    limit = -ndtri(FALSE_ALARM / len(pixels))  # Bonferroni over the nodes
    shows_lack = (mean > limit * error) | is_significant
    if is_significant:
        mean = mean * products.growth
    observed = mean / products.shown[neighbours].mean(axis=1) + variance.ravel()
    lack_of_fit = np.where(shows_lack, np.maximum(observed, left_out_variance), left_out_variance)
    return np.sqrt(variance + lack_of_fit.reshape(variance.shape))


def areas_of_rejected(
    rejected: FittedPoints,
    target: NDArray[np.int64],
    inliers: NDArray[np.float64],
    image_size: tuple[int, int],
) -> list[RejectedArea]:
    """Return the areas with enough rejected image points to test whether their residuals agree.

    target (n,): targets of the rejected image points. inliers (k, 2): the other image points [px].
    False matches are as frequent in an area as in the whole image, and have residuals of any
    direction (Rayleigh's test; Mardia and Jupp, "Directional Statistics", 2000, 6.3, here with the
    lengths). An error of the correction gives the image points of one place the same residual. The
    image points of one target count once, because its survey may be wrong.
    """
    if len(target) < FEW_TARGETS:
        return []
    cell = np.asarray(image_size) / CELLS
    of_rejected, of_inliers = ((uv + 0.5) / cell for uv in (rejected.uv, inliers))
    corners = list(np.ndindex(2 * CELLS - 1, 2 * CELLS - 1))
    rate = len(target) / (len(target) + len(inliers))
    areas: list[_Area] = []
    clusters: list[_Area] = []
    for corner in corners:
        rows = _inside(of_rejected, np.array(corner) / 2)
        number = len(np.unique(target[rows]))
        if number < FEW_TARGETS:
            continue
        total = len(rows) + len(_inside(of_inliers, np.array(corner) / 2))
        by_chance = len(corners) * bdtrc(number - 1, total, rate)
        area = _Area.of(rejected, target, rows, clustered=bool(by_chance < CONTRADICTION))
        if number >= MIN_TARGETS:
            areas.append(area)
        elif area.clustered:
            clusters.append(area)
    # Bonferroni correction. Areas with few targets are a separate test, of clusters only.
    return [area.tested(len(areas)) for area in areas] + [
        area.tested_by_draws(len(clusters)) for area in clusters
    ]


def _inside(place: NDArray[np.float64], corner: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return rows of places (n, 2) in a cell with a corner (2,), both in units of cells."""
    x, y = (place - corner).T  # `all` over an axis of two would be slow
    return np.flatnonzero((x >= 0) & (x < 1) & (y >= 0) & (y < 1))


@dataclass(frozen=True)
class _Area:
    """Rejected image points of an area.

    rows (n,): the image points; place (2,): their mean position [px]; of_target (k, 2): mean
    residual of each target [px]; exposures: number of exposures that agree with the mean of all;
    clustered: more rejected than by chance.
    """

    rows: NDArray[np.int64]
    place: NDArray[np.float64]
    of_target: NDArray[np.float64]
    exposures: int
    clustered: bool

    @staticmethod
    def of(
        rejected: FittedPoints, target: NDArray[np.int64], rows: NDArray[np.int64], clustered: bool
    ) -> _Area:
        """Return the area of rows of rejected image points, of targets (n,)."""
        _, place = np.unique(target[rows], return_inverse=True)
        number = np.bincount(place)
        r = rejected.residuals[rows]
        target_means = np.stack([np.bincount(place, r[:, i]) / number for i in (0, 1)], axis=1)
        projected = np.bincount(rejected.exposure[rows], r @ target_means.mean(axis=0))
        exposures = int(np.count_nonzero(projected > 0))
        middle = rejected.uv[rows].mean(axis=0)
        return _Area(rows, middle, target_means, exposures=exposures, clustered=clustered)

    def tested(self, areas: int) -> RejectedArea:
        """Test the mean residual: many residuals of any direction have a Gaussian mean."""
        chance = float(np.sqrt(np.sum(self.of_target**2))) / len(self.of_target)
        false_alarm = CLUSTERED_FALSE_ALARM if self.clustered else FALSE_ALARM
        limit = chance * float(np.sqrt(np.log(areas / false_alarm)))
        return self._with_limit(limit, MIN_EXPOSURES)

    def tested_by_draws(self, areas: int) -> RejectedArea:
        """Test the mean of few residuals, by random draws of their directions."""
        length = np.linalg.norm(self.of_target, axis=1)
        angle = np.random.default_rng(0).uniform(0, 2 * np.pi, (DRAWS, len(length)))
        means = np.abs(np.mean(length * np.exp(1j * angle), axis=1))
        limit = float(np.quantile(means, 1 - CLUSTERED_FALSE_ALARM / areas))
        return self._with_limit(limit, FEW_EXPOSURES)

    def _with_limit(self, limit: float, exposures: int) -> RejectedArea:
        """Return the area with the length of its mean residual, 0 if fewer exposures agree."""
        agree = self.exposures >= exposures
        size = float(np.linalg.norm(self.of_target.mean(axis=0))) if agree else 0.0
        return RejectedArea(size, limit, self.place, self.rows)


def _variance_left_out(
    products: _Products, series: Series, left_out: LeftOut, pixels: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return variances (n,) [px^2] at pixels (n, 2) of what a series omits.

    The expected variances are scaled to those that the products in its places show.
    """
    expected = left_out.variance(products.uv)
    inside = expected > PLACE * np.max(expected, initial=0.0)
    if not inside.any():
        return left_out.variance(pixels)
    mean = float(np.mean(expected[inside]))
    shown = chosen_rows(products, inside)
    variance = _variance_beyond(shown, series, mean, left_out.correlation)
    return variance / mean * left_out.variance(pixels)


def _variance_beyond(
    products: _Products,
    series: Series,
    expected: float,
    correlation_at: Callable[[NDArray[np.float64]], NDArray[np.float64]],
) -> float:
    """Return the variance [px^2] that a series omits, by covariance function and residuals.

    expected: variance by the covariance function [px^2]; correlation_at: function of distances.
    The covariance function was estimated from the functions that the series has; beyond them it is
    an extrapolation. The expected variance is uncertain and positive, and gets an exponential
    prior; the variance that the residuals show has a Gaussian error. The result is the mean of the
    posterior, a truncated Gaussian, and at most the expected variance: a larger value may also
    come from differences between exposures, and is left to the test of significance.
    """
    mean, error = products.mean_of_all()
    redundancy = float(products.shown.mean())
    correlation = float(np.mean(correlation_at(products.distance)))
    if not 0 < error < np.inf or correlation < MIN_CORRELATION:
        return expected
    error /= redundancy * correlation
    observed = (mean / redundancy + float(np.mean(series.sd_at(products.uv) ** 2))) / correlation
    location = observed / error - error / expected
    if location < -FAR:  # the tail is exponential
        return float(-error / location)
    density = np.exp(-(location**2) / 2 - log_ndtr(location)) / np.sqrt(2 * np.pi)
    return min(float(error * (location + density)), expected)


MIN_POINTS = 100  # image points that a profile needs
# Least gain of deviance, over the dispersion, for a profile. Chance exceeds it in one of 20 images
# (chi squared with one degree of freedom), with factors that hardly differ from one.
MIN_GAIN = 4.0
REACH_QUANTILE = 0.99  # quantile of the distances at which a profile ends


def fitted_profile(
    uv: NDArray[np.float64], squares: NDArray[np.float64], image_size: tuple[int, int]
) -> NoiseProfile | None:
    """Return the noise profile that squares of errors show; None: the same everywhere.

    uv: (n, 2) image points [px]. squares: (n,) squared error of a coordinate [px^2], mean of both
    coordinates. image_size: width and height [px].
    """
    mean = float(np.mean(squares)) if len(squares) else 0.0
    if len(uv) < MIN_POINTS or not mean > 0:
        return None
    square = square_distance(uv[:, 0], uv[:, 1], image_size)
    y = squares / mean
    reach = float(np.sqrt(np.quantile(square, REACH_QUANTILE)))
    limit = 2 * np.log(MAX_FACTOR) / reach**2
    slope, expected = _gamma_regression(square, y, limit)
    # Two coordinates give chi squared with two degrees of freedom: a dispersion of one.
    dispersion = float(np.mean((y / expected - 1) ** 2))
    gain = -2 * float(np.sum(np.log(expected)))  # of deviance; the mean of y / expected is one
    if gain <= MIN_GAIN * dispersion:
        return None
    growth = slope * reach**2
    middle = float(np.mean(np.exp(growth * np.minimum(square / reach**2, 1))) ** -0.5)
    return NoiseProfile(middle, middle * float(np.exp(growth / 2)), reach)


def _gamma_regression(
    x: NDArray[np.float64], y: NDArray[np.float64], limit: float
) -> tuple[float, NDArray[np.float64]]:
    """Fit the logarithm of the expectation of y (n,) over x (n,); return slope and expectations.

    The score is a decreasing function of the slope, as all weights are one with a logarithmic
    link (McCullagh and Nelder, 8.4). limit: largest slope.
    """
    x = x - np.mean(x)

    def score(slope: float) -> float:
        return float(x @ (y * np.exp(-slope * x)))

    is_inside = score(-limit) > 0 > score(limit)
    slope = float(brentq(score, -limit, limit) if is_inside else limit * np.sign(score(0.0)))
    expected = np.exp(slope * x)
    return slope, expected * np.mean(y / expected)
