"""Residuals tested for what is common to exposures: a trend that remained, and a distortion that
moved.

Residuals of one exposure are correlated by its orientation, those of different exposures nearly
not. So what is averaged here are products of residuals of DIFFERENT exposures that lie close
together on the image, joins in the sense of Moran ("Notes on continuous stochastic phenomena",
Biometrika 37, 1950). Every pair of exposures gives a mean product; without a trend these have the
expectation 0, are uncorrelated whatever goes on within an exposure, and their own scatter tells
how far their mean may lie from 0 (Student's t-test, weighted with the number of joins).
"""

from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.spatial import cKDTree

from ..photogrammetry.collinearity import project
from ..photogrammetry.noise import INLIER_Q
from ..photogrammetry.rotations import matrix_from_quaternion

NEIGHBOURS = 8  # image points looked at about each, of which those of other exposures count
CELLS = 8  # across the image
MIN_IN_CELL = 10  # image points
ALARM = 2e-3  # chance of a false alarm of each test


@dataclass(frozen=True)
class Residuals:
    """Residuals of one fluoroscope: uv (n, 2) observed, r (n, 2) observed - correction - projected
    [px], exposure (n,) rows 0 ... m - 1 in order, target_id (n,); numbers (m,) of the exposures.
    """

    uv: np.ndarray
    r: np.ndarray
    exposure: np.ndarray
    target_id: np.ndarray
    numbers: np.ndarray

    def capped(self, sd):
        """Squared lengths (n,) [px^2] of the residuals, those beyond the core of noise of sd [px]
        at its border.
        """
        squared = np.sum(self.r**2, axis=1)
        return np.minimum(np.where(np.isfinite(squared), squared, np.inf), INLIER_Q * sd**2)

    def inliers(self, sd):
        """The residuals in the core of noise of sd [px]."""
        keep = np.sum(self.r**2, axis=1) <= INLIER_Q * sd**2
        return Residuals(
            self.uv[keep], self.r[keep], self.exposure[keep], self.target_id[keep], self.numbers
        )


@dataclass(frozen=True)
class Trend:
    """A trend in residuals: size and limit [px] of the whole, and of the cell where it is most
    significant with its middle, place (2,) [px]; without a trend a limit is exceeded with the
    chance ALARM.
    """

    size: float
    limit: float
    cell_size: float
    cell_limit: float
    place: np.ndarray


def residuals_of(job, name, frames):
    """Residuals of the frames of fluoroscope `name` in the CalibrationResult of an adjustment with a
    calibration held.
    """
    figures = job.fluoroscopes[name]
    calibration = job.calibrations[name]
    targets = job.targets
    by_number = {frame.number: frame.sorted() for frame in frames}
    parts = []
    for e in figures.exposures:
        frame = by_number[e.exposure]
        points = targets.xyz_mm[np.searchsorted(targets.target_id, frame.target_id)]
        turn = np.broadcast_to(matrix_from_quaternion(e.quaternion_wxyz), (len(points), 3, 3))
        ideal = project(
            turn, np.broadcast_to(e.position_mm, points.shape), points, figures.interior
        )
        parts.append(
            (frame.uv, frame.uv - calibration.model.predict(frame.uv) - ideal, frame.target_id)
        )
    uv, r, ids = (np.concatenate(column) for column in zip(*parts))
    return Residuals(
        uv,
        r,
        np.repeat(np.arange(len(parts)), [len(p[0]) for p in parts]),
        ids,
        np.array([e.exposure for e in figures.exposures]),
    )


def joins(residuals):
    """Mean products (p,) [px^2] of neighbouring residuals of two exposures, numbers (p,) of the
    joins, and the rows (p,) of the exposures, the earlier and the later.
    """
    m = len(residuals.numbers)
    count = min(NEIGHBOURS + 1, len(residuals.uv))
    _, near = cKDTree(residuals.uv).query(residuals.uv, k=count)
    i = np.repeat(np.arange(len(near)), count - 1)
    j = near[:, 1:].ravel()
    e, f = np.sort([residuals.exposure[i], residuals.exposure[j]], axis=0)
    product = np.sum(residuals.r[i] * residuals.r[j], axis=1)
    number, total = (np.bincount(e * m + f, w, m * m) for w in (None, product))
    e, f = np.divmod(np.arange(m * m), m)
    keep = (e < f) & (number > 0)
    return total[keep] / number[keep], number[keep].astype(float), e[keep], f[keep]


def common_trend(residuals, image_size):
    """Trend that all exposures have in common: Trend."""
    mean, number, _, _ = joins(residuals)
    part = np.ones(len(residuals.numbers), dtype=bool)
    return _trend(
        *_mean_and_limit(mean, number, np.ones(len(mean), dtype=bool)),
        *_worst_cell(residuals, image_size, part),
    )


def moved(residuals, image_size):
    """Trend by which the later half of the exposures differs from the earlier: Trend, with the
    sizes of the difference.

    Then residuals agree within a half, and have opposite signs across.
    """
    mean, number, e, f = joins(residuals)
    later = np.arange(len(residuals.numbers)) >= len(residuals.numbers) // 2
    size2, limit2 = _mean_and_limit(mean, number, later[e] == later[f])
    # Halves that are t apart leave residuals of t/2 on both sides of their mean.
    return _trend(4 * size2, 4 * limit2, *_worst_cell(residuals, image_size, later))


def _trend(size2, limit2, *cell):
    # A product of two residuals with the trend t in common has the expectation |t|^2, twice that
    # of a coordinate.
    size, limit = np.sqrt(np.maximum([size2, limit2], 0.0) / 2)
    return Trend(float(size), float(limit), *cell)


def _mean_and_limit(mean, number, same):
    """Mean [px^2] of the products of pairs that are the same, and half its excess over the others
    where there are others; with its limit. Arrays (p,) of pairs of exposures.
    """
    groups = [g for g in (same, ~same) if g.any()]
    freedom = len(mean) - len(groups)
    if freedom < 1 or not same.any():
        return 0.0, np.inf
    centre = [np.average(mean[g], weights=number[g]) for g in groups]
    scatter = sum(np.sum(number[g] * (mean[g] - c) ** 2) for g, c in zip(groups, centre)) / freedom
    sd = np.sqrt(scatter * sum(1 / number[g].sum() for g in groups)) / len(groups)
    value = centre[0] if len(groups) == 1 else (centre[0] - centre[1]) / 2
    return value, stats.t.ppf(1 - ALARM, freedom) * sd


def _cell_sums(residuals, image_size):
    """Sums (c, m, 2) of the residuals of every exposure in cells of the image, counts (c, m),
    middles (c, 2) [px].
    """
    size = np.asarray(image_size) / CELLS
    cell = np.clip(((residuals.uv + 0.5) / size).astype(int), 0, CELLS - 1)
    index = cell[:, 1] * CELLS + cell[:, 0]
    m = len(residuals.numbers)
    sums = np.zeros((CELLS**2, m, 2))
    counts = np.zeros((CELLS**2, m))
    np.add.at(sums, (index, residuals.exposure), residuals.r)
    np.add.at(counts, (index, residuals.exposure), 1)
    v, u = np.divmod(np.arange(CELLS**2), CELLS)
    return sums, counts, (np.stack([u, v], axis=1) + 0.5) * size - 0.5


def _worst_cell(residuals, image_size, part):
    """Length [px] of the mean residual in the cell where it is most significant, its limit and the
    cell's middle.

    part (m,): exposures that count, against the others where there are others.
    """
    sums, counts, middle = _cell_sums(residuals, image_size)
    groups = [g for g in (part, ~part) if g.any()]
    n = np.stack([counts[:, g].sum(axis=1) for g in groups])
    keep = (n >= MIN_IN_CELL).all(axis=0)
    if not keep.any():
        return 0.0, np.inf, np.asarray(image_size) / 2
    sums = sums[keep]
    counts = counts[keep]
    n = n[:, keep]
    middle = middle[keep]
    means = [sums[:, g].sum(axis=1) / k[:, None] for g, k in zip(groups, n)]
    # Variance of a residual as the means of the exposures scatter: a cell's own, or that of all
    # where it is larger.
    scatter = np.zeros(len(sums))
    freedom = np.zeros(len(sums))
    for g, mean in zip(groups, means):
        c = np.maximum(counts[:, g], 1)
        scatter += np.sum(
            (sums[:, g] - counts[:, g, None] * mean[:, None]) ** 2 / c[..., None], axis=(1, 2)
        )
        freedom += 2 * np.maximum((counts[:, g] > 0).sum(axis=1) - 1, 0)
    pooled = scatter.sum() / max(freedom.sum(), 1)
    variance = np.maximum(scatter / np.maximum(freedom, 1), pooled) * np.sum(1 / n, axis=0)
    length = np.linalg.norm(means[0] if len(means) == 1 else means[0] - means[1], axis=1)
    worst = int(np.argmax(length / np.sqrt(variance)))
    # Bonferroni over the cells.
    limit = np.sqrt(
        2 * variance[worst] * stats.f.ppf(1 - ALARM / len(sums), 2, max(freedom.sum(), 1))
    )
    return float(length[worst]), float(limit), middle[worst]
