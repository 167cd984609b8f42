# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Scatter of the relative orientations of exposures about that of the rig.

The pairs of exposures of a rigid rig have one relative orientation. A pair whose frames are not of
one exposure, or between whose frames the phantom moved, has another one, and is left out.

Where a distortion changes with the angle of a C-arm, the part of the change that is a shift, turn
or scale of the image goes into the orientation of each exposure, and their relative orientations
are a function of the angle: of its harmonics, as the correction (`correction.angle_field`). So
they are where an arm bends. What these harmonics do not explain is as unexpected as elsewhere.
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

# A pair of exposures is left out of the mean where its deviation is CERTAIN times its standard
# deviation, and as many times the median of all pairs; at most this share of them is.
MAX_LEFT_OUT = 1 / 3
MIN_PAIRS_ROBUST = 4
PAIRS_OF_COLUMN = 2  # that a function of the angle needs at least
STEPS = 20  # of reweighting
CORE = 3.0  # deviation over the median one at which a pair has half its weight in a trend
MAX_REMAINING = 0.5  # of the variance of the pairs that a trend leaves
MOVED_SHARE = 0.2  # of the variance about a trend that is left when the rig was moved once


@dataclass(frozen=True)
class PairScatter:
    """How the relative orientations of k pairs of exposures scatter about the one of the rig."""

    fluoroscopes: tuple[str, str]
    exposures: NDArray[np.int64]  #: (k,)
    #: (k,) RMS displacement of a coordinate of the image points of the second fluoroscope [px],
    #: less what the angle of a C-arm explains
    off_px: NDArray[np.float64]
    off_sd: NDArray[np.float64]  #: (k,) deviation over its standard deviation, also less that
    used: NDArray[np.bool_]  #: (k,) whether the pair has part in the mean
    #: factor, at least 1, by which the used pairs scatter more than their standard deviations
    growth: float
    unexplained: float  #: the same, less what the angle of a C-arm explains
    angle_px: float  #: RMS displacement that the angle explains [px], 0 where there is none
    columns: NDArray[np.float64]  #: (k, p) functions of the angle, the first of them 1
    corrected: bool  #: whether the correction of one of them changes with the angle
    #: (k, 3, 3) rotations from the sensor of the first fluoroscope to that of the second
    turn: NDArray[np.float64]
    shift_mm: NDArray[np.float64]  #: (k, 3) of the second source in the sensor frame of the first


@dataclass(frozen=True)
class Agreement:
    """Which pairs agree on the relative orientation of a rig."""

    used: NDArray[np.bool_]  #: (k,)
    #: (k,) deviations of all pairs over their standard deviations, less the trend
    off_sd: NDArray[np.float64]
    #: see `PairScatter`
    growth: float
    unexplained: float
    trend: NDArray[np.float64]  #: (k, 6) what the angle explains: translation [mm], rotation [rad]


def functions_of_angles(angles: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Functions (k, p) of angles (k,) [rad] of the fluoroscopes of k pairs, the first of them 1.

    As many orders of the harmonics as there are pairs for; none where angles are not known.
    """
    count = len(angles[0])
    one, other = angles
    different = [one] if np.array_equal(one, other) else [one, other]
    columns = [np.ones((count, 1))]
    for order in (HARMONICS, HARMONICS // 2):
        known = [harmonics(each)[:, :order] for each in different if can_be_fitted(each)]
        if known and PAIRS_OF_COLUMN * (1 + order * len(known)) <= count:
            return np.concatenate([*columns, *known], axis=1)
    return columns[0]


def agreeing(
    parameters: Parameters,
    constraint: RelativeConstraint,
    weights: np.ndarray,
    columns: NDArray[np.float64],
) -> Agreement:
    """Return which pairs agree.

    weights (k, 6, 6) are those of the pairs, columns (k, p) functions of the angle. Where more
    than a few pairs contradict the others, none is left out: there is no majority to rely on.
    """
    pairs = constraint.pairs
    used, off_sd = _plain(parameters, constraint, weights)
    growth = _growth(off_sd, used, 1)
    nothing = np.zeros((len(pairs), 6))
    plain = Agreement(used, off_sd, growth, growth, nothing)
    if columns.shape[1] == 1:
        return plain
    with_trend = _with_trend(parameters, constraint, weights, columns)
    explained = with_trend.unexplained**2 <= MAX_REMAINING * growth**2
    return with_trend if explained else plain


def _plain(
    parameters: Parameters, constraint: RelativeConstraint, weights: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Return which (k,) pairs agree, and the deviations (k,) of all over their sd."""
    pairs = constraint.pairs
    every = np.ones(len(pairs), dtype=bool)
    robust = len(pairs) >= MIN_PAIRS_ROBUST
    pose = mean_pose(parameters, pairs, None if robust else weights)
    used = every
    for _ in range(STEPS if robust else 0):
        deviation = _deviations(parameters, constraint, pose, weights)
        before, used = used, _near(deviation)
        pose = mean_pose(parameters, pairs[used], weights[used])
        if np.array_equal(before, used):
            break
    return used, _deviations(parameters, constraint, pose, weights)


def _near(deviation: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which (k,) pairs agree; all where too many do not."""
    near = deviation <= CERTAIN * max(1.0, float(np.median(deviation)))
    return near if np.sum(~near) <= MAX_LEFT_OUT * len(near) else np.ones(len(near), dtype=bool)


def _growth(off_sd: NDArray[np.float64], used: NDArray[np.bool_], columns: int) -> float:
    """Factor by which used pairs scatter more than stated about so many functions."""
    freedom = max(6 * (int(used.sum()) - columns), 1)
    return float(np.sqrt(max(1.0, 6 * np.sum(off_sd[used] ** 2) / freedom)))


def _with_trend(
    parameters: Parameters,
    constraint: RelativeConstraint,
    weights: NDArray[np.float64],
    columns: NDArray[np.float64],
) -> Agreement:
    """Return which pairs agree on a relative orientation that changes with the angle."""
    pairs = constraint.pairs
    off = discrepancies(constraint, mean_pose(parameters, pairs), parameters)
    share = np.ones(len(pairs))
    for _ in range(STEPS):
        deviation, _ = _about_trend(off, weights * share[:, None, None], weights, columns)
        median = max(float(np.median(deviation)), 1e-12)
        share = 1 / (1 + (deviation / (CORE * median)) ** 2)
    used = _near(deviation)
    if np.sum(~used) > 1 and _moved_once(off, weights, columns):
        used[:] = True  # these are no single exposures
    pose = mean_pose(parameters, pairs[used], weights[used])
    off = discrepancies(constraint, pose, parameters)
    deviation, trend = _about_trend(off, weights * used[:, None, None], weights, columns)
    plain = _deviations(parameters, constraint, pose, weights)
    return Agreement(
        used,
        deviation,
        _growth(plain, used, 1),
        _growth(deviation, used, columns.shape[1]),
        trend,
    )


def _moved_once(
    off: NDArray[np.float64], weights: NDArray[np.float64], columns: NDArray[np.float64]
) -> bool:
    """Whether one step explains nearly all that a trend leaves of discrepancies (k, 6)."""
    left = [
        np.sum(_about_trend(off, weights, weights, np.hstack([columns, step]))[0] ** 2)
        for step in steps_of(len(off))
    ]
    total = np.sum(_about_trend(off, weights, weights, columns)[0] ** 2)
    return bool(left) and min(left) <= MOVED_SHARE * total


def steps_of(count: int) -> list[NDArray[np.float64]]:
    """Functions (count, 1) that are 0 before one of count pairs in order, and 1 from it on.

    At least two pairs are on either side.
    """
    return [(np.arange(count) >= k)[:, None].astype(float) for k in range(2, count - 1)]


def _about_trend(
    off: NDArray[np.float64],
    shared: NDArray[np.float64],
    weights: NDArray[np.float64],
    columns: NDArray[np.float64],
) -> tuple[np.ndarray, NDArray[np.float64]]:
    """Deviations (k,) over their sd about a trend of discrepancies (k, 6), and the trend (k, 6).

    The trend is estimated with the weights shared (k, 6, 6).
    """
    size = off.shape[1] * columns.shape[1]
    normal = np.einsum('ka,kb,kij->aibj', columns, columns, shared).reshape(size, size)
    right = np.einsum('ka,kij,kj->ai', columns, shared, off).ravel()
    coefficients = np.linalg.lstsq(normal, right, rcond=None)[0]
    trend = columns @ coefficients.reshape(columns.shape[1], -1)
    left = off - trend
    return np.sqrt(np.einsum('ki,kij,kj->k', left, weights, left) / 6), trend


def _deviations(
    parameters: Parameters,
    constraint: RelativeConstraint,
    pose: RelativePose,
    weights: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Deviations (k,) of pairs from a relative orientation over their standard deviations."""
    off = discrepancies(constraint, pose, parameters)
    return np.sqrt(np.einsum('ki,kij,kj->k', off, weights, off) / 6)


def displacements(
    network: Network,
    parameters: Parameters,
    pairs: NDArray[np.int64],
    poses: Sequence[RelativePose],
    others: Sequence[RelativePose] | None = None,
) -> NDArray[np.float64]:
    """RMS (k,) [px] of a coordinate by which image points of pairs (k, 2) of exposures are off.

    They are displaced by one relative orientation of each pair against another, by default that
    of the adjusted exposures.
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
        one, other = (
            project(rotation, source, points, interior) for rotation, source in exteriors
        )
        out[k] = np.sqrt(np.mean((one - other) ** 2))
    return np.where(np.isnan(out), np.inf, out)  # NaN: points behind the source


def _exterior(
    parameters: Parameters, a: int, pose: RelativePose
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotation (3, 3) and source (3,) [mm] that a relative orientation to exposure a gives."""
    rotation = parameters.rotation[a]
    return pose.rotation @ rotation, parameters.position_mm[a] + rotation.T @ pose.translation_mm
