# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Tests of residuals for a trend that all exposures have in common, and for a change of it.

Residuals of one exposure are correlated by its orientation, while those of different exposures are
nearly uncorrelated. The tests therefore average products of residuals of DIFFERENT exposures that
are close together in the image: joins in the sense of Moran ("Notes on continuous stochastic
phenomena", Biometrika 37, 1950). Every pair of exposures gives a mean product. Without a trend
these products have expectation 0 and are uncorrelated, whatever happens within an exposure, and
their scatter gives the limit of their mean (Student's t-test, weighted by the number of joins).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special
from scipy.spatial import cKDTree

from ..correction.fluoroscope_calibration import FluoroscopeCalibration
from ..estimation.lack_of_fit import (
    CELLS,
    LARGEST_SD,
    FittedPoints,
    RejectedArea,
    areas_of_rejected,
)
from ..estimation.result import CalibrationResult
from ..exposures.collector import MIN_EXPOSURES
from ..exposures.decisions import Doubtful
from ..exposures.frame import Frame, angles_of, cells_of
from ..findings import Finding, Kind, Severity
from ..photogrammetry.collinearity import project
from ..photogrammetry.noise import INLIER_Q
from ..photogrammetry.outliers import FALSE_ALARM
from ..photogrammetry.rotations import matrix_from_quaternion
from .check import Check

MIN_IN_CELL = 10  # minimum number of image points


class _TestPlan(NamedTuple):
    """Parameters of a test for a trend.

    neighbours: number per image point; only those of other exposures count. overlap: number of
    cells along each side that contain a given part of the image. false_alarm, cell_false_alarm:
    probability of a false alarm in the whole image, and in any of the cells.
    """

    neighbours: int
    overlap: int
    false_alarm: float
    cell_false_alarm: float


COMMON = _TestPlan(8, 1, FALSE_ALARM, FALSE_ALARM)
# A change has no cause in the calibration itself, so false accusations have to be rarer.
# Overlapping cells find it wherever it is, and more neighbours average more noise. For earlier and
# later exposures of 22 simulated rigs that did not change, in 8800 random orders, each of the two
# tests fails in 0.03 % (docs/verdict.md).
CHANGE = _TestPlan(16, 2, 1e-4, 1e-3)
# Shares of the shortest joins, each half as long as those of the previous share. A ripple makes
# products of residuals that are further apart than a third of its wavelength cancel.
SHARES = 0.25 ** np.arange(4)


@dataclass(frozen=True)
class Residuals:
    """Residuals of one fluoroscope."""

    uv: NDArray[np.float64]  #: (n, 2) observed pixels
    r: NDArray[np.float64]  #: (n, 2) observed - correction - projected [px]
    exposure: NDArray[np.int64]  #: (n,) index of its exposure, 0 to m - 1 in order
    target_id: NDArray[np.int64]  #: (n,)
    numbers: NDArray[np.int64]  #: (m,) numbers of the exposures
    angles: NDArray[np.float64]  #: (m,) angles of the C-arm [rad]; NaN if unknown

    @property
    def angle(self) -> NDArray[np.float64]:
        """Angle (n,) of the C-arm [rad] of each residual."""
        return self.angles[self.exposure]

    def capped(self, sd: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return squared lengths (n,) [px^2], capped at the border of the noise core.

        sd (n,): standard deviations of the noise [px].
        """
        squared = np.sum(self.r**2, axis=1)
        return np.minimum(np.where(np.isfinite(squared), squared, np.inf), INLIER_Q * sd**2)

    def inliers(self, sd: np.ndarray) -> Residuals:
        """Return the residuals in the core of the noise; sd (n,): standard deviations [px]."""
        return self._part(np.sum(self.r**2, axis=1) <= INLIER_Q * sd**2)

    def rejected(self, sd: NDArray[np.float64]) -> Residuals:
        """Return the residuals beyond that core that may be due to distortion."""
        q = np.sum(self.r**2, axis=1) / sd**2
        return self._part((q > INLIER_Q) & (q < LARGEST_SD**2))

    def _part(self, keep: NDArray[np.bool_]) -> Residuals:
        return Residuals(
            self.uv[keep],
            self.r[keep],
            exposure=self.exposure[keep],
            target_id=self.target_id[keep],
            numbers=self.numbers,
            angles=self.angles,
        )


class CellTrend(NamedTuple):
    """Trend in the cell of the image where it is most significant."""

    #: length of the mean residual, and its limit [px]
    size: float
    limit: float
    place: NDArray[np.float64]  #: (2,) centre of the cell [px]


class RejectedExposure(NamedTuple):
    """Agreement of the rejected image points of one exposure with their neighbours."""

    number: int  #: number of the exposure
    #: number of rejected image points, and of all image points
    points: int
    of: int
    #: sum of the products of neighbours, in standard deviations for random directions; limit that
    #: chance exceeds with probability FALSE_ALARM in any of the exposures
    agreement: float
    limit: float


@dataclass(frozen=True)
class ResidualTrend:
    """Trend in residuals; without a trend, each limit is exceeded with its test's probability."""

    #: size and limit for the whole image [px]
    size: float
    limit: float
    #: size and limit for the cell where the trend is most significant [px]
    cell_size: float
    cell_limit: float
    place: NDArray[np.float64]  #: (2,) centre of that cell [px]


@dataclass(frozen=True)
class Joins:
    """Products of neighbouring residuals of two exposures, by pair of exposures."""

    mean: NDArray[np.float64]  #: (p,) mean product [px^2]
    count: NDArray[np.float64]  #: (p,) number of joins
    #: (p,) row indices of the exposures
    earlier: NDArray[np.int64]
    later: NDArray[np.int64]


def residuals_of(job: CalibrationResult, name: str, frames: Sequence[Frame]) -> Residuals:
    """Return the residuals of the frames of a fluoroscope in an adjustment.

    job: adjustment with the calibrations fixed. name: name of the fluoroscope.
    """
    table = job.residuals
    rows = np.flatnonzero(table.fluoroscope == name)
    numbers = np.array([e.exposure for e in job.fluoroscopes[name].exposures])
    by_number = {frame.number: frame for frame in frames}
    return Residuals(
        table.uv[rows],
        table.residual[rows],
        exposure=np.searchsorted(numbers, table.exposure[rows]),
        target_id=table.target_id[rows],
        numbers=numbers,
        angles=angles_of(by_number[number] for number in numbers.tolist()),
    )


def noise_of(
    residuals: Residuals, calibration: FluoroscopeCalibration, frames: Sequence[Frame]
) -> NDArray[np.float64]:
    """Return the standard deviations (n,) [px] of the noise of residuals of frames."""
    by_number = {frame.number: frame.sorted() for frame in frames}
    return np.concatenate([calibration.noise_sd(by_number[n]) for n in residuals.numbers])


def common_trend(residuals: Residuals, image_size: tuple[int, int]) -> ResidualTrend:
    """Test for a trend that all exposures have in common.

    Ripples are shorter than the distance of neighbours where image points are few. Therefore the
    shortest joins are tested, too; the size is that of the share that exceeds its limit most, or
    of all joins if none does.
    """
    tests = []
    for share in SHARES:
        joins = _joins(residuals, COMMON.neighbours, share)
        every_pair = np.ones(len(joins.mean), dtype=bool)
        # Bonferroni over the shares
        tests.append(_mean_and_limit(joins, every_pair, COMMON.false_alarm / len(SHARES)))
    squared, limit = max(tests, key=lambda test: max(test[0] - test[1], 0.0))
    every_exposure = np.ones(len(residuals.numbers), dtype=bool)
    return _trend(squared, limit, _worst_cell(residuals, image_size, every_exposure, COMMON))


def change_of_trend(residuals: Residuals, image_size: tuple[int, int]) -> ResidualTrend:
    """Test for a trend by which the later half of the exposures differs from the earlier half.

    The sizes are those of the difference. After a change, residuals agree within a half, and have
    opposite signs across the halves.
    """
    joins = _joins(residuals, CHANGE.neighbours)
    later = np.arange(len(residuals.numbers)) >= len(residuals.numbers) // 2
    is_same = later[joins.earlier] == later[joins.later]
    squared, limit = _mean_and_limit(joins, is_same, CHANGE.false_alarm)
    # Halves that differ by t have residuals of t/2 on both sides of their mean.
    return _trend(4 * squared, 4 * limit, _worst_cell(residuals, image_size, later, CHANGE))


def rejected_trend(
    rejected: Residuals, inliers: Residuals, image_size: tuple[int, int]
) -> RejectedArea | None:
    """Test whether rejected image points of different exposures agree near some place.

    Returns the most significant place, or None if rejected points are few everywhere.
    """
    points = FittedPoints(rejected.uv, rejected.r, rejected.exposure)
    areas = areas_of_rejected(points, rejected.target_id, inliers.uv, image_size)
    return max(areas, key=lambda area: area.size_px / area.limit_px, default=None)


def unexplained(rejected: Residuals, reach: float) -> Residuals:
    """Return the rejected image points, except those that agree with other exposures.

    If the nearest rejected points of MIN_EXPOSURES other exposures, up to a distance of reach
    [px], are displaced like those of an exposure, it is not this exposure that differs. Residuals
    of false matches have random directions.
    """
    limit = special.ndtri(1 - FALSE_ALARM)
    is_kept = np.ones(len(rejected.r), dtype=bool)
    for row in range(len(rejected.numbers)):
        rows = np.flatnonzero(rejected.exposure == row)
        other_rows = np.flatnonzero(rejected.exposure != row)
        if not len(rows) or not len(other_rows):
            continue
        distance, nearest = cKDTree(rejected.uv[other_rows]).query(rejected.uv[rows])
        is_close = distance <= reach
        # Points near one point of another exposure count together, as it has one direction.
        sums = np.zeros((len(other_rows), 2))
        np.add.at(sums, nearest[is_close], rejected.r[rows[is_close]])
        r = rejected.r[other_rows]
        products = np.sum(sums * r, axis=1)
        sd = np.sqrt(np.sum(np.sum(sums**2, axis=1) * np.sum(r**2, axis=1)) / 2)
        agreeing = len(np.unique(rejected.exposure[other_rows[products > 0]]))
        if agreeing >= MIN_EXPOSURES and products.sum() > limit * sd:
            is_kept[rows[is_close]] = False
    return rejected._part(is_kept)


def rejected_exposure(rejected: Residuals, inliers: Residuals) -> RejectedExposure | None:
    """Test whether the rejected image points of an exposure agree with their neighbours.

    The residuals of false matches have independent random directions. The residuals of an exposure
    that does not fit are similar in neighbouring image points. Returns the most significant
    exposure, or None if no exposure has two rejected image points.
    """
    limit = float(special.ndtri(1 - FALSE_ALARM / len(rejected.numbers)))
    tested = []
    for row, number in enumerate(rejected.numbers.tolist()):
        rows = rejected.exposure == row
        if rows.sum() < 2:
            continue
        r = rejected.r[rows]
        _, nearest = cKDTree(rejected.uv[rows]).query(rejected.uv[rows], k=[2])
        pairs = np.unique(np.sort([np.arange(len(r)), nearest[:, 0]], axis=0), axis=1)
        i, j = pairs[:, pairs[0] != pairs[1]]
        squares = np.sum(r**2, axis=1)
        sd = np.sqrt(np.sum(squares[i] * squares[j]) / 2)
        agreement = float(np.sum(r[i] * r[j]) / sd) if sd > 0 else 0.0
        total = len(r) + int(np.sum(inliers.exposure == row))
        tested.append(RejectedExposure(number, len(r), total, agreement, limit))
    return max(tested, key=lambda exposure: exposure.agreement, default=None)


def _joins(residuals: Residuals, neighbours: int, share: float = 1.0) -> Joins:
    """Return the products of neighbouring residuals of different exposures.

    share: share of the shortest joins to use.
    """
    m = len(residuals.numbers)
    count = min(neighbours + 1, len(residuals.uv))
    distance, nearest = cKDTree(residuals.uv).query(residuals.uv, k=count)
    lengths = distance[:, 1:].ravel()
    rows = np.argsort(lengths, kind='stable')[: math.ceil(share * lengths.size)]
    i = np.repeat(np.arange(len(nearest)), count - 1)[rows]
    j = nearest[:, 1:].ravel()[rows]
    earlier, later = np.sort([residuals.exposure[i], residuals.exposure[j]], axis=0)
    product = np.sum(residuals.r[i] * residuals.r[j], axis=1)
    pair = earlier * m + later
    number = np.bincount(pair, None, m * m)
    total = np.bincount(pair, product, m * m)
    earlier, later = np.divmod(np.arange(m * m), m)
    is_used = (earlier < later) & (number > 0)
    return Joins(
        total[is_used] / number[is_used],
        number[is_used].astype(float),
        earlier[is_used],
        later[is_used],
    )


def _trend(squared: float, limit: float, cell: CellTrend) -> ResidualTrend:
    """Return a trend from its mean product and the limit of the product [px^2]."""
    # The product of two residuals with a common trend t has expectation |t|^2, twice that of a
    # coordinate.
    size, size_limit = np.sqrt(np.maximum([squared, limit], 0.0) / 2)
    return ResidualTrend(float(size), float(size_limit), *cell)


def _mean_and_limit(
    joins: Joins, same: NDArray[np.bool_], false_alarm: float
) -> tuple[float, float]:
    """Return the mean product of the pairs (p,) that are the same, and its limit [px^2].

    If there are other pairs, return half the excess over their mean.
    """
    groups = [group for group in (same, ~same) if group.any()]
    freedom = len(joins.mean) - len(groups)
    if freedom < 1 or not same.any():
        return 0.0, np.inf
    means = [np.average(joins.mean[g], weights=joins.count[g]) for g in groups]
    squares = [
        np.sum(joins.count[g] * (joins.mean[g] - mean) ** 2) for g, mean in zip(groups, means)
    ]
    scatter = sum(squares) / freedom
    sd = np.sqrt(scatter * sum(1 / joins.count[g].sum() for g in groups)) / len(groups)
    value = means[0] if len(groups) == 1 else (means[0] - means[1]) / 2
    return value, special.stdtrit(freedom, 1 - false_alarm) * sd


def _cell_sums(
    residuals: Residuals, image_size: tuple[int, int], overlap: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the residuals by cell and exposure.

    overlap: number of parts of a cell along each side; every such square of parts is a cell.

    Returns the sums (c, m, 2) [px], counts (c, m) and centres (c, 2) of the cells [px].
    """
    parts = CELLS * overlap
    size = np.asarray(image_size) / parts
    column, row = cells_of(residuals.uv, image_size, parts).T
    m = len(residuals.numbers)
    # Sums and numbers of residuals, by rows of parts, columns and exposures.
    part_sums = np.zeros((parts, parts, m, 3))
    values = np.column_stack([residuals.r, np.ones(len(residuals.r))])
    np.add.at(part_sums, (row, column, residuals.exposure), values)
    places = parts - overlap + 1
    rows = np.sum([part_sums[i : i + places] for i in range(overlap)], axis=0)
    cells = np.sum([rows[:, j : j + places] for j in range(overlap)], axis=0)
    cells = cells.reshape(places**2, m, 3)
    v, u = np.divmod(np.arange(places**2), places)
    centres = (np.stack([u, v], axis=1) + overlap / 2) * size - 0.5
    return cells[..., :2], cells[..., 2], centres


def _worst_cell(
    residuals: Residuals, image_size: tuple[int, int], part: NDArray[np.bool_], plan: _TestPlan
) -> CellTrend:
    """Return the mean residual of the cell where it is most significant.

    part (m,) selects exposures; if there are others, the difference of the two means is tested.
    """
    sums, counts, centres = _cell_sums(residuals, image_size, plan.overlap)
    groups = [group for group in (part, ~part) if group.any()]
    n = np.stack([counts[:, g].sum(axis=1) for g in groups])
    is_full = (n >= MIN_IN_CELL).all(axis=0)
    if not is_full.any():
        return CellTrend(0.0, np.inf, np.asarray(image_size) / 2)
    sums = sums[is_full]
    counts = counts[is_full]
    n = n[:, is_full]
    means = [sums[:, g].sum(axis=1) / k[:, None] for g, k in zip(groups, n)]
    scatter, freedom = _scatter(sums, counts, groups, means)
    if not freedom.any():
        return CellTrend(0.0, np.inf, np.asarray(image_size) / 2)
    # Variance of a residual: that of the cell, or of all cells if it is larger.
    pooled = scatter.sum() / max(freedom.sum(), 1)
    variance = np.maximum(scatter / np.maximum(freedom, 1), pooled) * np.sum(1 / n, axis=0)
    length = np.linalg.norm(means[0] if len(means) == 1 else means[0] - means[1], axis=1)
    worst = int(np.argmax(length / np.sqrt(variance)))
    chance = plan.cell_false_alarm / len(sums)  # Bonferroni over the cells
    limit = np.sqrt(2 * variance[worst] * special.fdtri(2, max(freedom.sum(), 1), 1 - chance))
    return CellTrend(float(length[worst]), float(limit), centres[is_full][worst])


def _scatter(
    sums: NDArray[np.float64],
    counts: np.ndarray,
    groups: Sequence[np.ndarray],
    means: Sequence[NDArray[np.float64]],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the squared deviations (c,) of exposures from the mean of their group, by cell.

    The second array contains the number of degrees of freedom.
    """
    scatter = np.zeros(len(sums))
    freedom = np.zeros(len(sums))
    for group, mean in zip(groups, means):
        count = np.maximum(counts[:, group], 1)
        deviation = sums[:, group] - counts[:, group, None] * mean[:, None]
        scatter += np.sum(deviation**2 / count[..., None], axis=(1, 2))
        freedom += 2 * np.maximum((counts[:, group] > 0).sum(axis=1) - 1, 0)
    return scatter, freedom


# Results of an adjustment for review by a person: bad exposures, and ids that may be wrong.

# Kinds of exclusions that are listed. A repeated pose is merged instead, and targets with few rays
# are not the fault of an image point.
BAD = {
    Kind.COPIED_EXPOSURE,
    Kind.FALSE_MATCHES,
    Kind.FEW_TARGETS,
    Kind.NOT_ORIENTED,
    Kind.POOR_FIT,
    Kind.SHARED_EXPOSURE,
    Kind.STRAY_POINTS,
}


def doubtful_observations(
    result: CalibrationResult, checks: Iterable[Check] = ()
) -> list[Doubtful]:
    """Return exposures that are excluded or fail their check, and image points that fail theirs.

    checks: checks of the verdict on the calibration.
    """
    failed = [c for c in checks if c.kind is Kind.EXPOSURES and c.passed is False]
    excluded = [f for f in result.findings if f.severity is Severity.NOTE and f.kind in BAD]
    out = [doubtful for finding in (*failed, *excluded) for doubtful in _of_finding(finding)]
    return [*out, *_outlying_points(result)]


def _of_finding(finding: Finding) -> Iterator[Doubtful]:
    place = finding.place
    for name in place.fluoroscopes:
        for exposure in place.exposures:
            for target in place.target_id or (None,):
                yield Doubtful(name, exposure, exposure, target, finding.cause)


def _outlying_points(result: CalibrationResult) -> Iterator[Doubtful]:
    """Yield the image points that fail their test, with other targets that they may show."""
    table = result.residuals

    def of_exposure(point: Mapping[str, Any]) -> tuple[str, int]:
        return point['fluoroscope'], point['exposure']

    for (name, exposure), points in groupby(
        sorted(result.outliers[0], key=of_exposure), of_exposure
    ):
        tests = {point['target_id']: point for point in points}
        in_exposure = (table.fluoroscope == name) & (table.exposure == exposure)
        rows = np.flatnonzero(in_exposure & np.isin(table.target_id, list(tests)))
        lengths = np.linalg.norm(table.residual[rows], axis=1)
        failed = [tests[target] for target in table.target_id[rows].tolist()]
        sd = np.sqrt([point['value'] for point in failed])
        limit = np.sqrt([point['critical'] for point in failed])
        candidates = _may_be(result, in_exposure, rows, lengths * limit / sd)
        for k, row in enumerate(rows):
            yield Doubtful(
                name,
                exposure,
                exposure,
                int(table.target_id[row]),
                f'residual {lengths[k]:.2f} px, {sd[k]:.1f} times its standard deviation '
                f'(limit {limit[k]:.1f})',
                others=candidates[k],
                uv=(round(float(table.uv[row, 0]), 4), round(float(table.uv[row, 1]), 4)),
                residual_px=round(float(lengths[k]), 3),
            )


def _may_be(
    result: CalibrationResult,
    here: NDArray[np.bool_],
    rows: NDArray[np.intp],
    limit_px: NDArray[np.float64],
) -> list[tuple[int, ...]]:
    """Return other targets at which image points would pass their test, the nearest first.

    here (N,): image points of their exposure; rows (k,): those that fail. Targets that fit their
    own image points are excluded, and each target is only proposed for the image point nearest to
    it. limit_px (k,): of residuals; at other targets they have about the same standard deviation.
    """
    table = result.residuals
    name = str(table.fluoroscope[rows[0]])
    figures = result.fluoroscopes[name]
    pose = next(e for e in figures.exposures if e.exposure == table.exposure[rows[0]])
    ids = result.targets.target_id
    fits = here.copy()
    fits[rows] = False
    is_free = ~np.isin(ids, table.target_id[fits])
    if not is_free.any():
        return [()] * len(rows)
    points = result.targets.xyz_mm[is_free]
    rotation = matrix_from_quaternion(pose.quaternion_wxyz)
    uv: Any = project(rotation, pose.position_mm, points, figures.interior)
    seen = table.uv[rows] - table.correction[rows]
    distance = np.linalg.norm(seen[:, None] - uv, axis=2)
    nearest = distance.argmin(axis=0) == np.arange(len(rows))[:, None]
    fitting = nearest & (distance < limit_px[:, None])
    is_own = table.target_id[rows][:, None] == ids[is_free]
    return [
        tuple(ids[is_free][order][accepted[order]].tolist())
        for order, accepted in zip(np.argsort(distance, axis=1), fitting & ~is_own)
    ]
