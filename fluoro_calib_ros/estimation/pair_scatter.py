# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Scatter of the relative orientations of exposures about the relative orientation of the rig.

All pairs of exposures of a rigid rig have the same relative orientation. A pair differs, and is
excluded, if its frames are not of one exposure, or if the phantom moved between them.

Where a distortion changes with the angle of a C-arm, the orientation of each exposure absorbs the
part of the change that is a shift, rotation or scale of the image. The relative orientations are
then a function of the harmonics of the angle, like the correction (`correction.angle_field`), as
also if an arm bends. Scatter that the harmonics do not explain is as unexpected as elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..correction.angle_field import harmonics
from ..correction.calibration_record import HARMONICS
from ..photogrammetry.collinearity import project
from ..photogrammetry.network import Network
from ..photogrammetry.noise import CERTAIN
from ..photogrammetry.unknowns import (
    Parameters,
    RelativeConstraint,
    RelativePose,
    discrepancies,
    mean_pose,
)
from .exposure_terms import can_be_fitted

# A pair of exposures is excluded from the mean if its deviation exceeds CERTAIN times its standard
# deviation, and CERTAIN times the median of all pairs; at most this share of the pairs is.
MAX_LEFT_OUT = 1 / 3
MIN_PAIRS_ROBUST = 4
PAIRS_OF_COLUMN = 2  # pairs of exposures needed for each function of the angle
STEPS = 20  # number of iterations of reweighting
CORE = 3.0  # deviation, relative to the median, at which a pair has half its weight in a trend
MAX_REMAINING = 0.5  # share of the variance of the pairs that may remain about a trend
MOVED_SHARE = 0.2  # share of the variance about a trend that may remain if the rig moved once


@dataclass(frozen=True)
class PairScatter:
    """Scatter of the relative orientations of k pairs of exposures about that of the rig."""

    fluoroscopes: tuple[str, str]
    exposures: NDArray[np.int64]  #: (k,) numbers of the exposures
    #: (k,) RMS displacement of a coordinate of the image points of the second fluoroscope [px],
    #: without the part that the angle of a C-arm explains
    off_px: NDArray[np.float64]
    off_sd: NDArray[np.float64]  #: (k,) deviation over its standard deviation, likewise
    used: NDArray[np.bool_]  #: (k,) whether the pair contributes to the mean
    #: factor, at least 1, by which the scatter of the used pairs exceeds their standard deviations
    growth: float
    unexplained: float  #: the same factor without the part that the angle of a C-arm explains
    angle_px: float  #: RMS displacement that the angle explains [px], or 0
    columns: NDArray[np.float64]  #: (k, p) functions of the angle, the first of them 1
    corrected: bool  #: whether the correction of a fluoroscope changes with the angle
    #: (k, 3, 3) rotations from the sensor of the first fluoroscope to that of the second
    turn: NDArray[np.float64]
    shift_mm: NDArray[np.float64]  #: (k, 3) second source in the sensor frame of the first


@dataclass(frozen=True)
class Agreement:
    """Pairs that agree on the relative orientation of a rig."""

    used: NDArray[np.bool_]  #: (k,) whether the pair agrees
    #: (k,) deviations of all pairs over their standard deviations, less the trend
    off_sd: NDArray[np.float64]
    #: see `PairScatter`
    growth: float
    unexplained: float
    trend: NDArray[np.float64]  #: (k, 6) part explained by the angle: shift [mm], rotation [rad]


def functions_of_angles(angles: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return functions (k, p) of the angles (k,) [rad] of both fluoroscopes of k pairs.

    The first is 1; few pairs allow fewer orders of harmonics, and unknown angles allow none.
    """
    count = len(angles[0])
    angles_a, angles_b = angles
    distinct = [angles_a] if np.array_equal(angles_a, angles_b) else [angles_a, angles_b]
    columns = [np.ones((count, 1))]
    for order in (HARMONICS, HARMONICS // 2):
        known = [harmonics(angle)[:, :order] for angle in distinct if can_be_fitted(angle)]
        if known and PAIRS_OF_COLUMN * (1 + order * len(known)) <= count:
            return np.concatenate([*columns, *known], axis=1)
    return columns[0]


def agreeing(
    parameters: Parameters,
    constraint: RelativeConstraint,
    weights: np.ndarray,
    columns: NDArray[np.float64],
) -> Agreement:
    """Find the pairs that agree.

    weights (k, 6, 6): of the pairs; columns (k, p): functions of the angle. If more than a few
    pairs contradict the others, none is excluded, because there is no majority to rely on.
    """
    pairs = constraint.pairs
    used, off_sd = _plain(parameters, constraint, weights)
    growth = _growth(off_sd, used, 1)
    no_trend = np.zeros((len(pairs), 6))
    without_trend = Agreement(used, off_sd, growth, growth, no_trend)
    if columns.shape[1] == 1:
        return without_trend
    with_trend = _with_trend(parameters, constraint, weights, columns)
    explained = with_trend.unexplained**2 <= MAX_REMAINING * growth**2
    return with_trend if explained else without_trend


def _plain(
    parameters: Parameters, constraint: RelativeConstraint, weights: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Return which pairs (k,) agree, and the deviations (k,) of all pairs over their sd."""
    pairs = constraint.pairs
    all_pairs = np.ones(len(pairs), dtype=bool)
    robust = len(pairs) >= MIN_PAIRS_ROBUST
    pose = mean_pose(parameters, pairs, None if robust else weights)
    used = all_pairs
    for _ in range(STEPS if robust else 0):
        deviation = _deviations(parameters, constraint, pose, weights)
        before, used = used, _near(deviation)
        pose = mean_pose(parameters, pairs[used], weights[used])
        if np.array_equal(before, used):
            break
    return used, _deviations(parameters, constraint, pose, weights)


def _near(deviation: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which pairs (k,) agree; all if too many disagree."""
    agrees = deviation <= CERTAIN * max(1.0, float(np.median(deviation)))
    return (
        agrees
        if np.sum(~agrees) <= MAX_LEFT_OUT * len(agrees)
        else np.ones(len(agrees), dtype=bool)
    )


def _growth(off_sd: NDArray[np.float64], used: NDArray[np.bool_], columns: int) -> float:
    """Return the factor by which used pairs scatter more than stated; columns: of their fit."""
    freedom = max(6 * (int(used.sum()) - columns), 1)
    return float(np.sqrt(max(1.0, 6 * np.sum(off_sd[used] ** 2) / freedom)))


def _with_trend(
    parameters: Parameters,
    constraint: RelativeConstraint,
    weights: NDArray[np.float64],
    columns: NDArray[np.float64],
) -> Agreement:
    """Find the pairs that agree on a relative orientation that changes with the angle."""
    pairs = constraint.pairs
    residuals = discrepancies(constraint, mean_pose(parameters, pairs), parameters)
    share = np.ones(len(pairs))
    for _ in range(STEPS):
        deviation, _ = _about_trend(residuals, weights * share[:, None, None], weights, columns)
        median = max(float(np.median(deviation)), 1e-12)
        share = 1 / (1 + (deviation / (CORE * median)) ** 2)
    used = _near(deviation)
    if np.sum(~used) > 1 and _moved_once(residuals, weights, columns):
        used[:] = True  # the disagreeing pairs are not single exposures
    pose = mean_pose(parameters, pairs[used], weights[used])
    residuals = discrepancies(constraint, pose, parameters)
    deviation, trend = _about_trend(residuals, weights * used[:, None, None], weights, columns)
    without_trend = _deviations(parameters, constraint, pose, weights)
    return Agreement(
        used,
        deviation,
        _growth(without_trend, used, 1),
        _growth(deviation, used, columns.shape[1]),
        trend,
    )


def _moved_once(
    discrepancies: NDArray[np.float64], weights: NDArray[np.float64], columns: NDArray[np.float64]
) -> bool:
    """Whether one step explains nearly all of discrepancies (k, 6) about a trend."""
    remaining = [
        np.sum(_about_trend(discrepancies, weights, weights, np.hstack([columns, step]))[0] ** 2)
        for step in steps_of(len(discrepancies))
    ]
    total = np.sum(_about_trend(discrepancies, weights, weights, columns)[0] ** 2)
    return bool(remaining) and min(remaining) <= MOVED_SHARE * total


def steps_of(count: int) -> list[NDArray[np.float64]]:
    """Return step functions (count, 1) for ordered pairs: 0 before a pair, and 1 from it on.

    At least two pairs are on either side of a step.
    """
    return [(np.arange(count) >= k)[:, None].astype(float) for k in range(2, count - 1)]


def _about_trend(
    discrepancies: NDArray[np.float64],
    shared: NDArray[np.float64],
    weights: NDArray[np.float64],
    columns: NDArray[np.float64],
) -> tuple[np.ndarray, NDArray[np.float64]]:
    """Return deviations (k,) over their sd from a trend of discrepancies (k, 6), and trend (k, 6).

    The trend is estimated with the weights `shared` (k, 6, 6).
    """
    size = discrepancies.shape[1] * columns.shape[1]
    normal = np.einsum('ka,kb,kij->aibj', columns, columns, shared).reshape(size, size)
    right = np.einsum('ka,kij,kj->ai', columns, shared, discrepancies).ravel()
    coefficients = np.linalg.lstsq(normal, right, rcond=None)[0]
    trend = columns @ coefficients.reshape(columns.shape[1], -1)
    residuals = discrepancies - trend
    return np.sqrt(np.einsum('ki,kij,kj->k', residuals, weights, residuals) / 6), trend


def _deviations(
    parameters: Parameters,
    constraint: RelativeConstraint,
    pose: RelativePose,
    weights: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the deviations (k,) of pairs from a relative orientation over their sd."""
    residuals = discrepancies(constraint, pose, parameters)
    return np.sqrt(np.einsum('ki,kij,kj->k', residuals, weights, residuals) / 6)


def displacements(
    network: Network,
    parameters: Parameters,
    pairs: NDArray[np.int64],
    poses: Sequence[RelativePose],
    others: Sequence[RelativePose] | None = None,
) -> NDArray[np.float64]:
    """Return the RMS displacement (k,) [px] of image coordinates for pairs (k, 2) of exposures.

    The displacement is between two relative orientations of each pair. By default the second is
    that of the adjusted exposures.
    """
    out = np.zeros(len(pairs))
    for k, (a, b) in enumerate(pairs):
        points = parameters.points_mm[network.point[network.exposure == b]]
        interior = parameters.interior[network.fluoroscope[b]]
        exteriors = [_exterior(parameters, a, poses[k])]
        exteriors += (
            [(parameters.rotation[b], parameters.position_mm[b])]
            if others is None
            else [_exterior(parameters, a, others[k])]
        )
        uv_a, uv_b = (
            project(rotation, source, points, interior) for rotation, source in exteriors
        )
        out[k] = np.sqrt(np.mean((uv_a - uv_b) ** 2))
    return np.where(np.isnan(out), np.inf, out)  # NaN: points behind the source


def _exterior(
    parameters: Parameters, a: int, pose: RelativePose
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return rotation (3, 3) and source (3,) [mm] by a relative orientation to exposure a."""
    rotation = parameters.rotation[a]
    return pose.rotation @ rotation, parameters.position_mm[a] + rotation.T @ pose.translation_mm
