# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Motions of a phantom that move many of its beads close to others.

A pose that differs from the right one by such a motion fits an image nearly as well: a rotation of
a cube or a ring, a shift of a lattice, a screw motion of a helix. Each motion superimposes a bead
and two of its neighbours on a congruent triple of beads.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..bodies.body import fitted_pose
from ..photogrammetry.rotations import rotation_angle
from .growth import SURVEY_SIGMAS, Coordinates, spacing_of
from .lattice import REACH
from .pose_search import Triples
from .view import View

# Beads whose triples are superimposed. A motion is missed if all of them, or their neighbours, are
# moved to where no bead is.
STARTS = 12
MIN_SHARE = 0.4  # least share of the beads that a symmetry moves close to a bead
# Motions that are tried, those first that move the middle of the phantom least: they overlap most.
TRIED = 300
SAMPLE = 200  # beads by which the best motions are selected
KEPT = 120  # symmetries that are kept: 24 rotations of a cube, also after a step of a lattice


@dataclass(frozen=True)
class Symmetry:
    """Motion of a phantom that moves many of its beads close to others."""

    rotation: NDArray[np.float64]  #: (3, 3)
    shift: NDArray[np.float64]  #: (3,) [mm]
    row: NDArray[np.int64]  #: (n,), row of the bead to which each bead is moved, -1 for none

    @property
    def turn_rad(self) -> float:
        """Angle of the rotation."""
        return float(rotation_angle(self.rotation))

    @property
    def share(self) -> float:
        """Share of the beads that are moved close to a bead."""
        return float(np.mean(self.row >= 0))

    def turned(self, view: View) -> View:
        """Return the view that sees the moved phantom as this view sees the phantom."""
        return replace(
            view,
            rotation=view.rotation @ self.rotation.T,
            position=self.rotation @ view.position + self.shift,
        )


def symmetries_of(phantom: Coordinates, triples: Triples) -> tuple[Symmetry, ...]:
    """Return the symmetries of a phantom, those with the largest share first."""
    xyz = phantom.xyz
    tree = cKDTree(xyz)
    displaced_mm = SURVEY_SIGMAS * np.sqrt(2) * float(np.median(phantom.sd_mm))
    spacing_mm = spacing_of(xyz)
    reach = min(float(np.hypot(REACH * spacing_mm, displaced_mm)), spacing_mm / 2)
    rotation, shift = _distinct(*_motions(xyz, triples, reach), xyz=xyz, reach=reach)
    sample = np.random.default_rng(0).permutation(xyz)[:SAMPLE]
    for limit in (2 * reach, reach):
        away, row = tree.query(sample @ np.swapaxes(rotation, 1, 2) + shift[:, None])
        near = away < limit
        share = near.mean(axis=1)
        good = np.argsort(-share, kind='stable')[: np.count_nonzero(share >= MIN_SHARE)]
        after = xyz[row[good]]
        rotation, shift = fitted_pose(np.broadcast_to(sample, after.shape), after, near[good])
    found: dict[bytes, Symmetry] = {}
    for number in range(min(len(rotation), 2 * KEPT)):
        moved = xyz @ rotation[number].T + shift[number]
        away, row = tree.query(moved, distance_upper_bound=reach)
        symmetry = Symmetry(rotation[number], shift[number], np.where(np.isfinite(away), row, -1))
        is_identity = np.array_equal(symmetry.row, np.arange(len(xyz)))
        if symmetry.share >= MIN_SHARE and not is_identity:
            found.setdefault(symmetry.row.tobytes(), symmetry)
    order = sorted(found.values(), key=lambda one: (-one.share, one.turn_rad))
    return tuple(order[:KEPT])


def _motions(
    xyz: NDArray[np.float64], triples: Triples, reach: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return rotations (m, 3, 3) and shifts (m, 3) that superimpose congruent triples of beads."""
    a, b = triples.sides[:, 0], triples.sides[:, 1]
    first = triples.bead[:, 0]
    lengths = np.stack([np.linalg.norm(side, axis=1) for side in (a, b, b - a)], axis=1)
    axes = _axes(a, b)
    starts = np.random.default_rng(0).permutation(len(xyz))[:STARTS]
    rotations, shifts = [np.zeros((0, 3, 3))], [np.zeros((0, 3))]
    for start in starts[np.isin(starts, first)]:
        triple = np.flatnonzero(first == start)[0]
        congruent = np.flatnonzero((np.abs(lengths - lengths[triple]) < reach).all(axis=1))
        rotation = axes[congruent] @ axes[triple].T
        rotations.append(rotation)
        shifts.append(xyz[first[congruent]] - rotation @ xyz[start])
    return np.concatenate(rotations), np.concatenate(shifts)


def _axes(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return axes in columns (n, 3, 3): along sides a (n, 3), towards b, and normal to both."""
    along = a / np.linalg.norm(a, axis=1)[:, None]
    normal = np.cross(a, b)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    return np.stack([along, np.cross(normal, along), normal], axis=2)


def _distinct(
    rotation: NDArray[np.float64], shift: NDArray[np.float64], xyz: np.ndarray, reach: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return motions that differ by more than the reach, those of the middle first."""
    middle = xyz.mean(axis=0)
    corners = middle + np.vstack([np.zeros(3), np.diag(np.ptp(xyz, axis=0) / 2)])
    moved = corners @ np.swapaxes(rotation, 1, 2) + shift[:, None]
    distance = np.linalg.norm(moved[:, 0] - middle, axis=1)
    order = np.argsort(np.rint(distance / reach), kind='stable')[: STARTS * TRIED]
    key = np.rint(moved / (2 * reach)).astype(int).reshape(len(moved), -1)[order]
    _, index = np.unique(key, axis=0, return_index=True)
    kept = order[np.sort(index)[:TRIED]]
    return rotation[kept], shift[kept]
