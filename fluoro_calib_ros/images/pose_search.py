# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Find candidate poses of a phantom: match three beads of an image with triples of the phantom.

A bead of the image and two of its neighbours are compared with all triples of a bead of the
phantom and two of its neighbours. Neighbours in the image are chosen in several directions: if a
face is seen from its edge, the nearest ones lie on one line, or belong to other faces. Three
points give a scaled-orthographic pose in closed form (Huttenlocher and Ullman, "Recognizing solid
objects by alignment with an image", IJCV 5, 1990), with a mirror solution. Further neighbours vote
for a pose if there is a detection at their predicted places.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from .texture import window_offsets

MIN_SINE = 0.3  # least sine of the angle between the sides of a triple of the phantom
MIN_IMAGE_SINE = 0.2  # least sine of the angle between the sides of three beads in the image
# Largest number of neighbours that vote, limited to half of the beads: perspective shifts distant
# beads from their scaled-orthographic places, on a phantom of 18 balls by more than the tolerance.
VOTERS = 18
# Number of nearest voters that preselect poses for the vote of all: one of the first few must be
# found, and the share FIRST_VOTE of all of them.
FIRST_VOTERS = (3, 6)
MAX_POSES = 6000  # largest number of poses on which all voters vote
FIRST_VOTE = 0.5  # least vote of the nearest voters
MIN_VOTE = 0.55  # least vote of all voters
SURE_VOTE = 0.85  # vote at which the search from a bead ends
PAIRS_AT_ONCE = 4  # pairs of sides that are evaluated together
FLAT = 0.1  # largest distance of voters from a plane, as a share of the shorter side
KEPT = 10  # best poses of three beads that are kept
# Number of nearest beads of an image from which each neighbour is chosen. In views along a tube of
# 503 beads, 18 % of the searches from one bead lead to the pose with the nearest six; 48 % with
# the nearest in six directions out of 24 or 32 nearest beads, and 40 % out of 14.
CHOICE = 4


@dataclass(frozen=True)
class Triples:
    """Triples of a phantom: a bead, and two of its k nearest neighbours."""

    bead: NDArray[np.int64]  #: (t, 3)
    #: (4, t), squares of both sides, their product [mm^2], and the determinant of these [mm^4]
    products: NDArray[np.float64]
    #: (k, 3, t), neighbours of the first bead, nearest first, in coordinates along both sides
    #: and their cross product
    voter: NDArray[np.float32]
    sides: NDArray[np.float64]  #: (t, 2, 3), from the first bead [mm]
    #: (t,), True if all voters lie in one plane, so that both solutions have the same votes
    planar: NDArray[np.bool_]

    def of_beads(self, chosen: NDArray[np.bool_]) -> Triples:
        """Return the triples whose first bead is among the chosen beads (n,)."""
        row = np.flatnonzero(chosen[self.bead[:, 0]])
        return Triples(
            self.bead[row],
            self.products[:, row],
            self.voter[..., row],
            self.sides[row],
            self.planar[row],
        )


@dataclass(frozen=True)
class LocalPose:
    """A scaled-orthographic pose around one bead."""

    bead: int  #: row of the phantom
    uv: NDArray[np.float64]  #: (2,), pixel of the bead
    #: (3, 3), phantom -> a sensor that looks along the ray of the bead
    rotation: NDArray[np.float64]
    scale: float  #: [px/mm]
    vote: float  #: share of the voters that are found


def triples_of(xyz: NDArray[np.float64], neighbours: int) -> Triples:
    """Return the triples of beads (n, 3) [mm] with so many neighbours each."""
    n = len(xyz)
    voters = min(VOTERS, max(FIRST_VOTERS[1], n // 2))
    count = min(max(neighbours, voters) + 1, n)
    _, near = cKDTree(xyz).query(xyz, k=count)
    first, second = np.nonzero(~np.eye(min(neighbours, count - 1), dtype=bool))
    bead = np.stack(
        [
            np.repeat(np.arange(n), len(first)),
            near[:, 1 + first].ravel(),
            near[:, 1 + second].ravel(),
        ],
        axis=1,
    )
    a = xyz[bead[:, 1]] - xyz[bead[:, 0]]
    b = xyz[bead[:, 2]] - xyz[bead[:, 0]]
    aa = np.sum(a * a, axis=1)
    bb = np.sum(b * b, axis=1)
    ab = np.sum(a * b, axis=1)
    products = np.stack([aa, bb, ab, aa * bb - ab**2])
    good = products[3] > MIN_SINE**2 * aa * bb
    products = np.ascontiguousarray(products[:, good])
    bead = bead[good]
    a = a[good]
    b = b[good]
    axes = np.linalg.inv(np.stack([a, b, np.cross(a, b)], axis=2))
    voter_rows = near[bead[:, 0], 1 : 1 + voters]
    offsets = xyz[voter_rows] - xyz[bead[:, 0], None]
    coordinates = axes @ np.swapaxes(offsets, 1, 2)
    height_mm = np.abs(coordinates[:, 2]) * np.linalg.norm(np.cross(a, b), axis=1)[:, None]
    spacing = np.sqrt(np.minimum(products[0], products[1]))
    planar = height_mm.max(axis=1) < FLAT * spacing
    voter = np.ascontiguousarray(coordinates.astype(np.float32).transpose(2, 1, 0))
    return Triples(bead, products, voter, np.stack([a, b], axis=1), planar)


def neighbours_of(
    uv: NDArray[np.float64], row: NDArray[np.int64], count: int
) -> NDArray[np.int64]:
    """Return rows (m, k) of neighbours of rows (m,) of pixels (n, 2), k = min(count, n - 1).

    These are the nearest in `count` directions, by angles from that of the nearest, and then
    the nearest of the remaining neighbours.
    """
    _, near = cKDTree(uv).query(uv[row], k=min(CHOICE * count + 1, len(uv)))
    # If points coincide, the point itself may not come first.
    near = np.take_along_axis(near, np.argsort(near != row[:, None], kind='stable'), axis=1)[:, 1:]
    offset = uv[near] - uv[row, None]
    angle = np.arctan2(offset[..., 1], offset[..., 0])
    sector = np.rint((angle - angle[:, :1]) / (2 * np.pi) * count).astype(int) % count
    earlier = np.tril(np.ones((near.shape[1],) * 2, dtype=bool), -1)
    repeated = ((sector[:, :, None] == sector[:, None]) & earlier).any(axis=2)
    chosen = np.argsort(repeated, axis=1, kind='stable')[:, :count]
    return np.take_along_axis(near, chosen, axis=1)


def nearby_map(
    uv: NDArray[np.float64], image_size: tuple[int, int], reach_px: float
) -> NDArray[np.uint8]:
    """Return a mask (h, w) of uint8: 1 within a distance of a pixel (n, 2), else 0."""
    width, height = image_size
    places = np.rint(uv).astype(int)
    places = places[((places >= 0) & (places < (width, height))).all(axis=1)]
    places = places[:, None] + window_offsets(reach_px)
    places = places[((places >= 0) & (places < (width, height))).all(axis=2)]
    nearby = np.zeros((height, width), dtype=np.uint8)
    nearby[places[:, 1], places[:, 0]] = 1
    return nearby


def local_poses(
    seed: int,
    uv: NDArray[np.float64],
    neighbours: int,
    triples: Triples,
    detected: NDArray[np.uint8],
    scales: tuple[float, float],
) -> list[LocalPose]:
    """Return the poses with the most votes for a bead of the image, best first.

    Parameters
    ----------
    seed : int
        Row of the bead.
    uv : (n, 2) ndarray
        Beads of the image [px].
    neighbours : int
        Number of its neighbours that form triples with it.
    triples : Triples
    detected : (h, w) ndarray of uint8
        1 near a bead of the image, 2 outside the field, else 0.
    scales : tuple of float
        Smallest and largest scale [px/mm].
    """
    centre = uv[seed].astype(np.float32)
    near = neighbours_of(uv, np.array([seed]), neighbours)[0]
    sides = [
        (uv[near[i]] - uv[seed], uv[near[j]] - uv[seed])
        for i in range(len(near))
        for j in range(i)
    ]
    poses: list[LocalPose] = []
    for start in range(0, len(sides), PAIRS_AT_ONCE):
        parts = [
            _solutions(p, q, triples, scales) for p, q in sides[start : start + PAIRS_AT_ONCE]
        ]
        poses += _best(parts, triples, centre, detected)
        if any(pose.vote >= SURE_VOTE for pose in poses):
            break
    return sorted(poses, key=lambda pose: -pose.vote)[:KEPT]


def _best(
    parts: Sequence[tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float64]]],
    triples: Triples,
    centre: NDArray[np.float32],
    detected: NDArray[np.uint8],
) -> list[LocalPose]:
    """Return the poses with the most votes among the solutions of several image triples."""
    triple, axes, scale = (np.concatenate(values) for values in zip(*parts))
    # A border of pixels around the image represents all places outside it.
    field = np.pad(detected, 1, constant_values=2)
    selected, votes = _elected(centre, axes, triple, triples.voter, field)
    if len(selected) > MAX_POSES:
        selected = selected[np.argsort(-votes, kind='stable')[:MAX_POSES]]
    axes = axes[selected]
    triple = triple[selected]
    scale = scale[selected]
    votes = _votes(*_hits(centre, axes, triple, triples.voter, field), len(triples.voter))
    out: list[LocalPose] = []
    seen: set[tuple[int, ...]] = set()
    for row in np.argsort(-votes, kind='stable'):
        if votes[row] < MIN_VOTE or len(out) >= KEPT:
            break
        bead = int(triples.bead[triple[row], 0])
        # Both solutions have the same votes if the neighbours lie in one plane.
        for mirror in (1, -1):
            axes_of_side = axes[row] * np.array([[1], [1], [mirror]])
            rotation = _rotation(triples.sides[triple[row]], axes_of_side, scale[row])
            # Poses of one bead that hardly differ count as one.
            key = (bead, *np.rint(rotation[2] * 4).astype(int).tolist())
            if key not in seen:
                seen.add(key)
                out.append(
                    LocalPose(bead, centre.astype(float), rotation, float(scale[row]), votes[row])
                )
            if not triples.planar[triple[row]]:
                break
    return out


def _solutions(
    p: NDArray[np.float64], q: NDArray[np.float64], triples: Triples, scales: tuple[float, float]
) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float64]]:
    """Return rows of triples, axes (m, 3, 2) in the image, scales (m,), for sides p, q [px]."""
    pp = p @ p
    qq = q @ q
    pq = p @ q
    area = pp * qq - pq * pq
    nothing = np.zeros(0, dtype=int), np.zeros((0, 3, 2), np.float32), np.zeros(0)
    if area <= MIN_IMAGE_SINE**2 * pp * qq:
        return nothing
    A, B, C, a = triples.products
    half = 0.5 * (A * qq + B * pp) - C * pq
    squared = (half + np.sqrt(np.maximum(half * half - a * area, 0))) / a
    row = np.flatnonzero((squared > scales[0] ** 2) & (squared < scales[1] ** 2))
    squared = squared[row]
    scale = np.sqrt(squared)
    first = np.sqrt(np.maximum(squared * A[row] - pp, 0))
    second = np.sqrt(np.maximum(squared * B[row] - qq, 0))
    second = np.where(squared * C[row] < pq, -second, second)
    # Image of the cross product of both sides; its sign distinguishes the two solutions.
    normal = np.stack([p[1] * second - first * q[1], first * q[0] - p[0] * second], axis=1)
    normal = normal / scale[:, None]
    spatial = np.flatnonzero(~triples.planar[row])
    axes = np.empty((len(row) + len(spatial), 3, 2), dtype=np.float32)
    axes[:, 0] = p
    axes[:, 1] = q
    axes[: len(row), 2] = normal
    axes[len(row) :, 2] = -normal[spatial]
    return (
        np.concatenate([row, row[spatial]]),
        axes,
        np.concatenate([scale, scale[spatial]]),
    )


def _elected(
    centre: NDArray[np.float32],
    axes: NDArray[np.float32],
    triple: NDArray[np.int64],
    voter: NDArray[np.float32],
    field: NDArray[np.uint8],
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return rows (k,) of the solutions that the nearest voters preselect, and their votes."""
    first_count, second_count = FIRST_VOTERS
    hits, inside = _hits(centre, axes, triple, voter[:first_count], field)
    row = np.flatnonzero(hits)
    remaining = _hits(centre, axes[row], triple[row], voter[first_count:second_count], field)
    votes = _votes(hits[row] + remaining[0], inside[row] + remaining[1], second_count)
    elected = votes >= FIRST_VOTE
    return row[elected], votes[elected]


def _hits(
    centre: NDArray[np.float32],
    axes: NDArray[np.float32],
    triple: NDArray[np.int64],
    voters: NDArray[np.float32],
    field: NDArray[np.uint8],
) -> tuple[NDArray[np.int8], NDArray[np.int8]]:
    """Return numbers (m,) of voters (k, 3, t) that are found, and that are in the field of view.

    axes: (m, 3, 2) images of the axes of triples (m,); field: the map with its border.
    """
    hits = np.zeros(len(triple), dtype=np.int8)
    inside = np.zeros(len(triple), dtype=np.int8)
    height, width = field.shape
    flat = field.ravel()
    # Loop over voters and coordinates: numpy is slow with many small matrices.
    a, b, c = np.ascontiguousarray(axes.transpose(1, 2, 0))
    for voter in voters:
        x, y, z = (values[triple] for values in voter)
        column, row = (
            np.clip(x * a[k] + y * b[k] + z * c[k] + (centre[k] + 1.5), 0, size - 1)
            for k, size in enumerate((width, height))
        )
        value = flat[row.astype(np.int32) * width + column.astype(np.int32)]
        hits += value == 1
        inside += value < 2
    return hits, inside


def _votes(hits: NDArray[np.int8], inside: NDArray[np.int8], voters: int) -> NDArray[np.float64]:
    """Return the shares (m,) of the voters that are found.

    A pose that moves its voters off the image must not win by the few that stay inside.
    """
    return hits / np.maximum(inside, 0.6 * voters)


def _rotation(
    sides: NDArray[np.float64], axes: NDArray[np.floating], scale: float
) -> NDArray[np.float64]:
    """Return the rotation (3, 3) that takes sides (2, 3) [mm] to their image (3, 2) [px]."""
    a, b = sides
    normal = np.cross(a, b)
    # Rows 1 and 2 of the scaled rotation, from the images of a, b and a x b.
    images = axes.astype(float) / np.array([[scale], [scale], [scale]])
    rows = np.linalg.solve(np.stack([a, b, normal]), images)
    u, _, vt = np.linalg.svd(rows.T, full_matrices=False)
    first, second = u @ vt
    return np.stack([first, second, np.cross(first, second)])


# Length of a pose search: until a right pose would almost certainly have been found.
#
# A search from a bead of the image leads to the right pose if two of its neighbours in the image
# are neighbours in the phantom as well. How often they are is counted in random views of the
# phantom, with as many missing beads and as many other objects as are tolerated.

VIEWS = 48
LEAST = 4  # isolated beads in a view in which the phantom can be found
MIN_FOUND = 0.72  # share of the beads that are found
MIN_EXPLAINED = 0.4  # share of the detections that are beads
MERGED = 2.0  # distance in radii below which beads are detected as one
# Probability that a search from three right beads leads to the pose. Of 47 images of the
# renderings with a share of 0.95 of such beads, 31 were found from the first, 8 from the second.
LEADS = 0.5
MISSED = 1e-3  # accepted probability that a right pose is missed


def enough_seeds(
    xyz: NDArray[np.float64], detected: int, radius: float, neighbours: tuple[int, int]
) -> int:
    """Return the number of beads after which a search may end; 0 if no view shows isolated beads.

    Parameters
    ----------
    xyz : (n, 3) ndarray
        Beads of the phantom [mm].
    detected : int
        Number of detections in the image.
    radius : float
        Radius of a bead, including its blur, at the scale of the phantom [mm].
    neighbours : tuple of int
        Neighbours of a bead in the phantom and in the image that form triples with it.
    """
    share = float(np.clip(MIN_FOUND * len(xyz) / detected, MIN_EXPLAINED, 1.0))
    chance = LEADS * _chances(xyz, share, MERGED * radius, neighbours)
    missed = np.ones(len(chance))
    seeds = 0
    while seeds < detected and np.sum(missed) > MISSED * len(chance):
        missed = missed * (1 - chance)
        seeds += 1
    return seeds


def _chances(
    xyz: NDArray[np.float64], share: float, merged: float, neighbours: tuple[int, int]
) -> NDArray[np.float64]:
    """Return probabilities (v,) that a detection is a bead with two of its own neighbours.

    Only views with enough isolated beads count. merged: distance within which beads are detected
    as one [mm].
    """
    rng = np.random.default_rng(0)
    in_space, in_image = neighbours
    _, near = cKDTree(xyz).query(xyz, k=min(in_space + 1, len(xyz)))
    out = []
    for turn in Rotation.random(VIEWS, random_state=0).as_matrix():
        uv = xyz @ turn[:2].T
        resolved = cKDTree(uv).query(uv, k=[2])[0][:, 0] > merged
        bead = np.flatnonzero(resolved & (rng.random(len(xyz)) < MIN_FOUND))
        if len(bead) < LEAST:
            continue
        clutter_count = round(len(bead) * (1 / share - 1))
        clutter = rng.uniform(uv.min(axis=0), uv.max(axis=0), (clutter_count, 2))
        number = np.append(bead, np.full(clutter_count, -1))
        seen = np.concatenate([uv[bead], clutter])
        nearby = neighbours_of(seen, np.arange(len(bead)), in_image)
        is_neighbour = (number[nearby][..., None] == near[bead, None, 1:]).any(axis=2)
        out.append(share * float(np.mean(is_neighbour.sum(axis=1) >= 2)))
    return np.array(out)
