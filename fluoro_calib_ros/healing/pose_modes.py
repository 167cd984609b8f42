# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Poses of exposures with several false matches, where an iteration may accept the wrong ones.

The likelihood of a pose has a mode for each choice of false matches. The iteration ends in the
mode next to its start. A pose that ends in another mode for one hypothesis than for the others
decides between them: a lost image point costs some ten in log likelihood.
"""

from __future__ import annotations

from itertools import combinations
from math import comb

import numpy as np
from numpy.typing import NDArray

from .rig_adjustment import (
    LinearPoints,
    Mixture,
    ObservedBodies,
    Poses,
    Prior,
    RigAdjustment,
    RigSolution,
    moved_poses,
)

MAX_TRIED = 200  # choices of false matches; with many image points, two do not mislead a pose
# Maximum share of poses with several false matches by chance; above it, the rig is different.
BY_CHANCE = 0.1
STEPS = 4  # iterations with the trusted image points, and as many with all


def with_best_modes(
    adjustment: RigAdjustment, observed: ObservedBodies, prior: Prior, initial: RigSolution
) -> RigSolution:
    """Return a solution with the likeliest poses in exposures with several false matches.

    From the pose of the nearest exposure without these, each image point and, for bodies with few,
    each pair of them is excluded once, and the pose with the largest likelihood is taken.
    """
    has_false = observed.seen.sum(axis=(2, 3)) * (1 - initial.inliers_of_pose) > 1.5
    exposures = np.flatnonzero(has_false.any(axis=1))
    if not len(exposures) or has_false.mean() > BY_CHANCE:
        return initial
    excluded = _choices(observed.seen.shape[2:])
    rows = np.tile(exposures, len(excluded))
    repeated = observed.exposures(rows)
    trusted = repeated.seen & np.repeat(~excluded, len(exposures), axis=0)[:, None]
    start = _from_neighbours(initial.poses, has_false).exposures(rows)
    poses = _posed(adjustment, repeated, prior, (initial.values, start), trusted)
    loss = _loss(adjustment, repeated, prior, (initial.values, poses))
    best = np.argmin(loss.reshape(len(excluded), len(exposures), -1), axis=0)
    best = best * len(exposures) + np.arange(len(exposures))[:, None]
    before = _loss(adjustment, observed, prior, (initial.values, initial.poses))[exposures]
    is_better = has_false[exposures] & (np.take_along_axis(loss, best, axis=0) < before)
    rotation, centre = initial.poses.rotation.copy(), initial.poses.centre_mm.copy()
    row, body = np.nonzero(is_better)
    improved = exposures[row], body
    rotation[improved] = poses.rotation[best[row, body], body]
    centre[improved] = poses.centre_mm[best[row, body], body]
    restart = Poses(rotation, centre, initial.poses.known)
    refined = adjustment.refine(observed, prior, (initial.values, restart))
    return max(initial, refined, key=lambda solution: solution.evidence)


def _choices(shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return which (n, M, F) of the image points of a body are excluded; none in the first."""
    points = range(int(np.prod(shape)))
    choices: list[tuple[int, ...]] = [()]
    for count in (1, 2):
        if len(choices) + comb(len(points), count) <= MAX_TRIED:
            choices += combinations(points, count)
    out = np.zeros((len(choices), len(points)), dtype=bool)
    for row, choice in zip(out, choices):
        row[list(choice)] = True
    return out.reshape(-1, *shape)


def _from_neighbours(poses: Poses, lost: NDArray[np.bool_]) -> Poses:
    """Return poses with lost (T, B) ones replaced by those of the nearest exposures not lost."""
    rotation, centre = poses.rotation.copy(), poses.centre_mm.copy()
    for t, b in np.argwhere(lost):
        usable = np.flatnonzero(poses.known[:, b] & ~lost[:, b])
        if len(usable):
            nearest = usable[np.argmin(np.abs(usable - t))]
            rotation[t, b], centre[t, b] = rotation[nearest, b], centre[nearest, b]
    return Poses(rotation, centre, poses.known)


def _posed(
    adjustment: RigAdjustment,
    observed: ObservedBodies,
    prior: Prior,
    start: tuple[NDArray[np.float64], Poses],
    trusted: NDArray[np.bool_],
) -> Poses:
    """Return poses from their trusted image points (T, B, M, F) alone, then from all.

    start: values (K,) of the unknowns, taken as certain, and initial poses.
    """
    values, poses = start
    none_uncertain = np.zeros(adjustment.size, dtype=bool)
    for step in range(2 * STEPS):
        linear = LinearPoints.of(adjustment, observed, values, poses)
        terms = Mixture.of(adjustment, linear, observed, prior)
        weight = terms.weight(1.0)
        if step < STEPS:
            weight = np.where(trusted & linear.good, 1 / terms.variance, 0.0)
        normal = adjustment.normal_of(linear, weight, none_uncertain)
        poses = moved_poses(poses, normal, np.zeros(adjustment.size))
    return poses


def _loss(
    adjustment: RigAdjustment,
    observed: ObservedBodies,
    prior: Prior,
    estimate: tuple[NDArray[np.float64], Poses],
) -> NDArray[np.float64]:
    """Return minus twice the log likelihood (T, B) of poses."""
    terms = Mixture.of(
        adjustment, LinearPoints.of(adjustment, observed, *estimate), observed, prior
    )
    return np.asarray(terms.losses.sum(axis=(2, 3)))
