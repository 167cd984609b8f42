# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""How long a pose is searched for: until a right one would have been found, almost surely.

A search from a bead of the image leads to the right pose if two of its neighbours in the image are
neighbours in the phantom as well. How often they are is counted in random views of the phantom, in
which as many beads are lost, and as much else is seen, as may be.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

VIEWS = 48
LEAST = 4  # beads that stand apart in a view in which the phantom can be found
FOUND = 0.72  # share of the beads that are found, at least
SEEN = 0.4  # share of what is found that are beads, at least
MERGED = 2.0  # radii between beads that are found as one
# Chance that a search from three right beads leads to the pose. Of 47 images of the renderings
# with a share of 0.95 of such beads, 31 were found from the first one, 8 from the second.
LEADS = 0.5
MISSED = 1e-3  # chance that a right pose is missed


def enough_seeds(
    xyz: NDArray[np.float64], found: int, radius: float, neighbours: tuple[int, int]
) -> int:
    """Return from how many beads a search is long enough; none where no view shows beads apart.

    Parameters
    ----------
    xyz : (n, 3) ndarray
        Beads of the phantom [mm].
    found : int
        Number of what is found in the image.
    radius : float
        Radius of a bead, with its blur, at the scale of the phantom [mm].
    neighbours : tuple of int
        Neighbours of a bead in the phantom and in the image that make triples with it.
    """
    share = float(np.clip(FOUND * len(xyz) / found, SEEN, 1.0))
    chance = LEADS * _chances(xyz, share, MERGED * radius, neighbours)
    missed = np.ones(len(chance))
    seeds = 0
    while seeds < found and np.sum(missed) > MISSED * len(chance):
        missed = missed * (1 - chance)
        seeds += 1
    return seeds


def _chances(
    xyz: np.ndarray, share: float, merged: float, neighbours: tuple[int, int]
) -> NDArray[np.float64]:
    """Chances (v,) that something found is a bead with two neighbours that are its own.

    Of the views in which beads stand apart. merged: distance within which they are found as one
    [mm].
    """
    rng = np.random.default_rng(0)
    in_space, in_image = neighbours
    _, near = cKDTree(xyz).query(xyz, k=min(in_space + 1, len(xyz)))
    out = []
    for turn in Rotation.random(VIEWS, random_state=0).as_matrix():
        uv = xyz @ turn[:2].T
        apart = cKDTree(uv).query(uv, k=[2])[0][:, 0] > merged
        bead = np.flatnonzero(apart & (rng.random(len(xyz)) < FOUND))
        if len(bead) < LEAST:
            continue
        others = round(len(bead) * (1 / share - 1))
        clutter = rng.uniform(uv.min(axis=0), uv.max(axis=0), (others, 2))
        tree = cKDTree(np.concatenate([uv[bead], clutter]))
        number = np.append(bead, np.full(others, -1))
        _, around = tree.query(uv[bead], k=min(in_image + 1, tree.n))
        own = (number[around[:, 1:]][..., None] == near[bead, None, 1:]).any(axis=2)
        out.append(share * float(np.mean(own.sum(axis=1) >= 2)))
    return np.array(out)
