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
SAME = 0.1  # radii from a disc, within which a blob has the better place


def set_apart(
    relative: np.ndarray, uv: NDArray[np.float64]
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
    discs = _discs(mask, distance, radius) if radius >= MIN_RADIUS_PX else np.zeros((0, 2))
    if not len(discs):
        return uv, None
    away, nearest = cKDTree(discs).query(uv)
    exact = away < SAME * radius
    found = np.isin(np.arange(len(discs)), nearest[exact])
    return np.concatenate([uv[exact | (away > radius)], discs[~found]]), radius


def _discs(mask: np.ndarray, distance: np.ndarray, radius: float) -> NDArray[np.float64]:
    """Middles (n, 2) of the discs of about a radius in a mask (h, w) with distances inside it."""
    count, part = cv2.connectedComponents(mask)
    largest = np.zeros(count, dtype=np.float32)
    np.maximum.at(largest, part[mask > 0], distance[mask > 0])
    # A part that is wider than a disc is something else: a plate, a bone.
    wide = largest > SIZES[1] * radius
    size = 2 * int(APART * radius) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    peaks = (distance >= cv2.dilate(distance, kernel)) & (distance > SIZES[0] * radius)
    v, u = np.nonzero(peaks & ~wide[part])
    place = np.column_stack([u, v]).astype(float)
    order = np.argsort(-distance[v, u], kind='stable')
    place = place[order]
    again = {two for _, two in sorted(cKDTree(place).query_pairs(APART * radius))}
    return place[[number for number in range(len(place)) if number not in again]]
