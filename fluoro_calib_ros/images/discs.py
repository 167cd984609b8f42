# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Tell beads apart whose shadows overlap: discs of one size in the mask of what is dark.

The distance from a pixel of the mask to its border is largest in the middles of the discs, and
there it is their radius, whatever else overlaps them. A blob detector finds several of them as
one, or one beside its middle.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

SMOOTH_PX = 1.0  # blur of the light, for its noise
BORDER_PX = 0.7  # blur of the distances, for the pixels of the border
# Of smaller discs, those that overlap are one: two that are a radius apart leave a dip of 0.13
# radii between their middles, which the blur takes away.
MIN_RADIUS_PX = 3.0
SIZES = (0.8, 1.25)  # of discs, over that of a typical one
APART = 0.5  # radii between discs, below which they are one
MIN_STRAIGHT = 3  # pairs of discs, that lie in a bar
SAME = 0.1  # radii from a disc, within which a blob has the better place


def set_apart(
    relative: NDArray[np.floating], uv: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float | None]:
    """Return places (n, 2) and radius of beads, from blobs (m, 2) that may be several beads each.

    relative: (h, w) light over that around the beads. Blobs at which there is no disc stay; the
    radius [px] is None where beads are too small for discs.
    """
    column, row = np.rint(uv).astype(int).T
    half = 0.5 * (1 + float(np.median(relative[row, column])))
    smooth = cv2.GaussianBlur(relative.astype(np.float32), (0, 0), SMOOTH_PX)
    mask = (smooth < half).astype(np.uint8)
    distance = cv2.distanceTransform(mask, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    distance = cv2.GaussianBlur(distance, (0, 0), BORDER_PX)
    radius = float(np.median(distance[row, column]))
    if radius < MIN_RADIUS_PX:
        return uv, None
    count, part = cv2.connectedComponents(mask)
    # A part without a blob is noise or a border; one that is wider than a disc is a plate, a bone.
    usable = np.isin(np.arange(count), part[row, column])
    usable[part[distance > SIZES[1] * radius]] = usable[0] = False
    discs = _discs(np.where(usable[part], distance, 0), radius)
    discs = discs[~_in_bars(discs, distance, part, radius)]
    if not len(discs):
        return uv, None
    away, nearest = cKDTree(discs).query(uv)
    exact = away < SAME * radius
    found = np.isin(np.arange(len(discs)), nearest[exact])
    return np.concatenate([uv[exact | (away > radius)], discs[~found]]), radius


def _discs(distance: NDArray[np.float32], radius: float) -> NDArray[np.float64]:
    """Middles (n, 2) of discs of about a radius, by the distances (h, w) to the border."""
    size = 2 * int(APART * radius) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    v, u = np.nonzero((distance >= cv2.dilate(distance, kernel)) & (distance > SIZES[0] * radius))
    place = np.column_stack([u, v]).astype(float)
    place = place[np.argsort(-distance[v, u], kind='stable')]
    again = {two for _, two in cKDTree(place).query_pairs(APART * radius)}
    return place[[number for number in range(len(place)) if number not in again]]


def _in_bars(
    discs: NDArray[np.float64],
    distance: NDArray[np.float32],
    part: NDArray[np.int32],
    radius: float,
) -> NDArray[np.bool_]:
    """Return (n,) whether discs (n, 2) lie in bars, such as screws, that are as wide as a bead.

    Half way between two discs the distance (h, w) to the border is less, in a bar it is not. Three
    beads in a line have one such pair, so a part of the mask with fewer than three is no bar.
    """
    pair = cKDTree(discs).query_pairs(2 * radius, output_type='ndarray').reshape(-1, 2)
    away = np.linalg.norm(discs[pair[:, 0]] - discs[pair[:, 1]], axis=1)
    pair, away = pair[away > radius], away[away > radius]
    label = part[tuple(discs.astype(int).T[::-1])]
    column, row = np.rint(discs[pair].mean(axis=1)).astype(int).T
    between = np.sqrt(np.maximum(radius**2 - away**2 / 4, 0))
    straight = distance[row, column] > 0.5 * (radius + between)
    size = int(part.max()) + 1
    count = np.bincount(label[pair[straight, 0]], minlength=size)
    total = np.bincount(label[pair[:, 0]], minlength=size)
    return np.asarray((count >= MIN_STRAIGHT) & (2 * count > total))[label]
