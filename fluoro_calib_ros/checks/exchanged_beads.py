# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Detect beads exchanged in the survey: their image points lie at each other's place.

Beads that few exposures show cannot be intersected from their images, and all of their few image
points may be rejected by chance. If several exposures show the image points of either bead at the
projection of the other one, that is not chance: a false match lies anywhere, and ids that are
exchanged in one exposure are right in the others. Both probabilities are combined (Fisher,
"Statistical Methods for Research Workers", 4th edition, 1932, 21.1).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree
from scipy.special import bdtrc, xlogy

from ..estimation.result import Targets
from ..photogrammetry.collinearity import project_with_jacobian
from ..photogrammetry.noise import INLIER_Q
from ..photogrammetry.outliers import FALSE_ALARM
from ..photogrammetry.resection import ROUNDING
from .bead_intersection import Rays

NOWHERE = -1  # image point that agrees with no bead
FAR = 1e9  # [px]; replaces NaN, as for a bead behind the source


def exchanged_beads(rays: Rays, targets: Targets) -> NDArray[np.int64]:
    """Return the target ids (n, 2) of pairs of beads that are exchanged."""
    place = _places(rays, targets)
    rejected = place != rays.target_id
    is_moved = rejected & (place != NOWHERE)
    ids = np.sort(np.stack([rays.target_id, place], axis=1), axis=1)
    nearness = np.full(len(ids), len(targets.target_id))
    nearness[is_moved] = _nearness(ids[is_moved], targets)
    exchanged = []
    pairs, times = np.unique(ids[is_moved], axis=0, return_counts=True)
    for pair in pairs[times > 1]:
        of_pair = np.isin(rays.target_id, pair)
        at_other = is_moved & np.all(ids == pair, axis=1)
        is_mutual = len(np.unique(place[at_other])) == 2
        if not is_mutual or 2 * at_other.sum() <= of_pair.sum():
            continue
        # For all other beads, by the rule of succession: rate of rejected image points, and share
        # of these that lie at the place of a bead as near as this one.
        other_beads = rejected & ~of_pair
        share = rate_of(other_beads.sum(), (~of_pair).sum())
        share_near = rate_of(
            np.sum(other_beads & (nearness <= nearness[at_other].max())), other_beads.sum()
        )
        # Either image points are false independently, or ids are exchanged, which displaces two.
        chances = []
        for unit in (np.arange(len(of_pair)), rays.exposure):
            count = [
                len(np.unique(unit[rows])) for rows in (of_pair, of_pair & rejected, at_other)
            ]
            chance = bdtrc(count[1] - 1, count[0], share) * bdtrc(
                count[2] - 1, count[1], share_near
            )
            chances.append(chance - xlogy(chance, chance))
        if max(chances) * len(targets.target_id) < FALSE_ALARM:
            exchanged.append(pair)
    return np.array(exchanged, dtype=np.int64).reshape(-1, 2)


def rate_of(events: ArrayLike, count: ArrayLike) -> NDArray[np.float64]:
    """Return rates (...) of events out of counts, by Laplace's rule of succession."""
    return (np.asarray(events) + 1.0) / (np.asarray(count) + 2.0)


def _nearness(ids: NDArray[np.int64], targets: Targets) -> NDArray[np.int64]:
    """Return for pairs (n, 2) the number (n,) of beads as near to one bead as the other one."""
    first, second = targets.xyz_mm[np.searchsorted(targets.target_id, ids)].transpose(1, 0, 2)
    distance = np.linalg.norm(first - second, axis=1) * (1 + ROUNDING)
    tree = cKDTree(targets.xyz_mm)
    return np.minimum(
        *(
            tree.query_ball_point(centre, distance, return_length=True)
            for centre in (first, second)
        )
    )


def _places(rays: Rays, targets: Targets) -> NDArray[np.int64]:
    """Return the target ids (n,) of the beads at whose places image points lie.

    An image point gets its own id if it agrees with its bead, and NOWHERE if with none.
    """
    out = rays.target_id.copy()
    for exposure in np.unique(rays.exposure):
        rows = np.flatnonzero(rays.exposure == exposure)
        first = rows[0]
        ideal, _, d_point, _ = project_with_jacobian(
            rays.rotation[first], rays.position_mm[first], targets.xyz_mm, rays.interior[first]
        )
        bead_covariance = np.einsum('nij,njk,nlk->nil', d_point, targets.covariance, d_point)
        tree = cKDTree(np.nan_to_num(ideal, nan=FAR))
        nearest = tree.query(np.nan_to_num(rays.uv[rows], nan=-FAR))[1]
        claimed = np.searchsorted(targets.target_id, rays.target_id[rows])
        beads = np.stack([claimed, nearest])
        r = rays.uv[rows] - ideal[beads]
        covariance = rays.variance[rows, None, None] * np.eye(2) + bead_covariance[beads]
        q = np.einsum('...i,...ij,...j', r, np.linalg.inv(covariance), r)
        alternative = np.where(q[1] <= INLIER_Q, targets.target_id[nearest], NOWHERE)
        out[rows] = np.where(q[0] <= INLIER_Q, rays.target_id[rows], alternative)
    return out
