# Copyright 2026 fluoro_calib_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Where a phantom may stand: three beads of an image against triples of the phantom.

A bead of the image and two of its neighbours are compared with all triples of a bead of the
phantom and two of its neighbours. Three points give a scaled-orthographic pose in closed form
(Huttenlocher and Ullman, "Recognizing solid objects by alignment with an image", IJCV 5, 1990),
with a mirror solution. Further neighbours vote for a pose if there is something at their predicted
places.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import cv2
import numpy as np
from scipy.spatial import cKDTree

MIN_SINE = 0.3  # of the angle between the sides of a triple of the phantom
MIN_IMAGE_SINE = 0.2  # of the angle between the sides of three beads in the image
VOTERS = 18  # neighbours that vote
FIRST_VOTERS = 6  # of them, which select the poses that the others vote on
MAX_POSES = 6000  # poses that all voters vote on
FIRST_VOTE = 0.5
MIN_VOTE = 0.55
SURE_VOTE = 0.85
PAIRS_AT_ONCE = 4
FLAT = 0.1  # of the shorter side, within which voters lie in a plane
KEPT = 10  # best poses of three beads


@dataclass(frozen=True)
class Triples:
    """Triples of a phantom: a bead, and two of its k nearest neighbours.

    Attributes
    ----------
    bead : (t, 3) ndarray of int
    products : (t, 3) ndarray
        Squares of both sides and their product [mm^2].
    voter : (t, 3, VOTERS) ndarray of float32
        Neighbours of the first bead in the axes of both sides and their cross product.
    first_voter : (t, 3, FIRST_VOTERS) ndarray of float32
        The nearest of them.
    sides : (t, 2, 3) ndarray
        From the first bead [mm].
    planar : (t,) ndarray of bool
        All voters lie in one plane, so that both solutions have the same votes.
    """

    bead: np.ndarray
    products: np.ndarray
    voter: np.ndarray
    first_voter: np.ndarray
    sides: np.ndarray
    planar: np.ndarray

    def of_beads(self, chosen: np.ndarray) -> Triples:
        """Return the triples whose first bead is one of those that are chosen (n,)."""
        row = np.flatnonzero(chosen[self.bead[:, 0]])
        return Triples(*(getattr(self, part.name)[row] for part in fields(self)))


@dataclass(frozen=True)
class LocalPose:
    """A scaled-orthographic pose around one bead.

    Attributes
    ----------
    bead : int
        Row of the phantom.
    uv : (2,) ndarray
        Its pixel.
    rotation : (3, 3) ndarray
        Phantom -> a sensor that looks along the ray of the bead.
    scale : float
        [px/mm]
    vote : float
        Share of the voters that are found.
    """

    bead: int
    uv: np.ndarray
    rotation: np.ndarray
    scale: float
    vote: float


def triples_of(xyz: np.ndarray, neighbours: int) -> Triples:
    """Return the triples of beads (n, 3) [mm] with so many neighbours each."""
    n = len(xyz)
    count = min(max(neighbours, VOTERS) + 1, n)
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
    products = np.stack([np.sum(a * a, 1), np.sum(b * b, 1), np.sum(a * b, 1)], axis=1)
    area = products[:, 0] * products[:, 1] - products[:, 2] ** 2
    good = area > MIN_SINE**2 * products[:, 0] * products[:, 1]
    bead = bead[good]
    a = a[good]
    b = b[good]
    axes = np.linalg.inv(np.stack([a, b, np.cross(a, b)], axis=2))
    others = near[bead[:, 0], 1 : 1 + VOTERS]
    offsets = xyz[others] - xyz[bead[:, 0], None]
    coordinates = axes @ np.swapaxes(offsets, 1, 2)
    height_mm = np.abs(coordinates[:, 2]) * np.linalg.norm(np.cross(a, b), axis=1)[:, None]
    spacing = np.sqrt(np.minimum(products[good, 0], products[good, 1]))
    planar = height_mm.max(axis=1) < FLAT * spacing
    voter = coordinates.astype(np.float32)
    first_voter = np.ascontiguousarray(voter[:, :, :FIRST_VOTERS])
    sides = np.stack([a, b], axis=1)
    return Triples(bead, products[good], voter, first_voter, sides, planar)


def nearby_map(uv: np.ndarray, image_size: tuple[int, int], reach_px: float) -> np.ndarray:
    """Mask (h, w) of uint8: 1 within a distance of a pixel (n, 2), else 0."""
    width, height = image_size
    empty = np.full((height, width), 255, dtype=np.uint8)
    places = np.rint(uv).astype(int)
    inside = ((places >= 0) & (places < (width, height))).all(axis=1)
    empty[places[inside, 1], places[inside, 0]] = 0
    distance = cv2.distanceTransform(empty, cv2.DIST_L2, 5)
    return (distance <= reach_px).astype(np.uint8)


def local_poses(
    seed: int,
    uv: np.ndarray,
    near: np.ndarray,
    triples: Triples,
    found: np.ndarray,
    scales: tuple[float, float],
) -> list[LocalPose]:
    """Return the poses with the most votes for a bead of the image, the best first.

    Parameters
    ----------
    seed : int
        Row of the bead.
    uv : (n, 2) ndarray
        Beads of the image [px].
    near : (k,) ndarray of int
        Neighbours of the bead that make triples with it.
    triples : Triples
    found : (h, w) ndarray of uint8
        1 near a bead of the image, 2 outside of the field, else 0.
    scales : tuple of float
        Smallest and largest scale [px/mm].
    """
    centre = uv[seed].astype(np.float32)
    sides = [
        (uv[near[i]] - uv[seed], uv[near[j]] - uv[seed])
        for i in range(len(near))
        for j in range(i)
    ]
    found_poses: list[LocalPose] = []
    for start in range(0, len(sides), PAIRS_AT_ONCE):
        parts = [
            _solutions(p, q, triples, scales) for p, q in sides[start : start + PAIRS_AT_ONCE]
        ]
        found_poses += _best(parts, triples, centre, found)
        if any(pose.vote >= SURE_VOTE for pose in found_poses):
            break
    return sorted(found_poses, key=lambda pose: -pose.vote)[:KEPT]


def _best(
    parts: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]],
    triples: Triples,
    centre: np.ndarray,
    found: np.ndarray,
) -> list[LocalPose]:
    """Return the poses with the most votes of the solutions of several triples of an image."""
    triple, axes, scale = (np.concatenate(values) for values in zip(*parts))
    votes = _votes(centre, axes, triples.first_voter[triple], found)
    kept = np.flatnonzero(votes >= FIRST_VOTE)
    if len(kept) > MAX_POSES:
        kept = kept[np.argsort(-votes[kept], kind='stable')[:MAX_POSES]]
    axes = axes[kept]
    triple = triple[kept]
    scale = scale[kept]
    votes = _votes(centre, axes, triples.voter[triple], found)
    out: list[LocalPose] = []
    seen: set[tuple[int, ...]] = set()
    for row in np.argsort(-votes, kind='stable'):
        if votes[row] < MIN_VOTE or len(out) >= KEPT:
            break
        bead = int(triples.bead[triple[row], 0])
        # Both solutions have the same votes where the neighbours lie in one plane.
        for mirror in (1, -1):
            both = axes[row] * np.array([[1], [1], [mirror]])
            rotation = _rotation(triples.sides[triple[row]], both, scale[row])
            # Poses of one bead that differ little are one.
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
    p: np.ndarray, q: np.ndarray, triples: Triples, scales: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows of triples, image (m, 3, 2) of their axes, scales (m,), for sides p and q (2,) [px]."""
    pp = p @ p
    qq = q @ q
    pq = p @ q
    area = pp * qq - pq * pq
    nothing = np.zeros(0, dtype=int), np.zeros((0, 3, 2), np.float32), np.zeros(0)
    if area <= MIN_IMAGE_SINE**2 * pp * qq:
        return nothing
    A, B, C = triples.products.T
    a = A * B - C * C
    half = 0.5 * (A * qq + B * pp) - C * pq
    squared = (half + np.sqrt(np.maximum(half * half - a * area, 0))) / a
    row = np.flatnonzero((squared > scales[0] ** 2) & (squared < scales[1] ** 2))
    squared = squared[row]
    scale = np.sqrt(squared)
    first = np.sqrt(np.maximum(squared * A[row] - pp, 0))
    second = np.sqrt(np.maximum(squared * B[row] - qq, 0))
    second = np.where(squared * C[row] < pq, -second, second)
    # The image of the cross product of both sides; its sign tells the two solutions apart.
    normal = np.stack([p[1] * second - first * q[1], first * q[0] - p[0] * second], axis=1)
    normal = normal / scale[:, None]
    other = np.flatnonzero(~triples.planar[row])
    axes = np.empty((len(row) + len(other), 3, 2), dtype=np.float32)
    axes[:, 0] = p
    axes[:, 1] = q
    axes[: len(row), 2] = normal
    axes[len(row) :, 2] = -normal[other]
    return (
        np.concatenate([row, row[other]]),
        axes,
        np.concatenate([scale, scale[other]]),
    )


def _votes(
    centre: np.ndarray, axes: np.ndarray, voters: np.ndarray, found: np.ndarray
) -> np.ndarray:
    """Shares (m,) of voters (m, 3, k) that are found, for images of the axes (m, 3, 2)."""
    height, width = found.shape
    images = axes[:, :, :, None]
    # One product after the other: numpy multiplies many small matrices slowly.
    u, v = (
        voters[:, 0] * images[:, 0, k]
        + voters[:, 1] * images[:, 1, k]
        + voters[:, 2] * images[:, 2, k]
        + centre[k]
        for k in (0, 1)
    )
    # A frame of pixels around the image stands for all that is off it.
    column = np.clip(np.rint(u), -1, width).astype(np.int32) % (width + 1)
    row = np.clip(np.rint(v), -1, height).astype(np.int32) % (height + 1)
    value = np.pad(found, ((0, 1), (0, 1)), constant_values=2)[row, column]
    hits = np.count_nonzero(value == 1, axis=1)
    inside = np.count_nonzero(value < 2, axis=1)
    # A pose that puts its voters off the image must not win by the rest of them.
    return hits / np.maximum(inside, 0.6 * voters.shape[2])


def _rotation(sides: np.ndarray, axes: np.ndarray, scale: float) -> np.ndarray:
    """Rotation (3, 3) that takes sides (2, 3) [mm] to their image (3, 2) [px]."""
    a, b = sides
    normal = np.cross(a, b)
    # Rows 1 and 2 of the scaled rotation, by the images of a, b and a x b.
    images = axes.astype(float) / np.array([[scale], [scale], [scale]])
    rows = np.linalg.solve(np.stack([a, b, normal]), images)
    u, _, vt = np.linalg.svd(rows.T, full_matrices=False)
    first, second = u @ vt
    return np.stack([first, second, np.cross(first, second)])
