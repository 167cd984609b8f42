# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Separate beads whose shadows overlap: find discs of one size in the mask of dark pixels.

The distance from a pixel of the mask to the border of the mask has its maxima at the centres of
the discs. There it equals the radius, whatever else overlaps the disc. A blob detector finds
several overlapping discs as one blob, or one disc off its centre.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

SMOOTH_PX = 1.0  # standard deviation of the blur that reduces the noise of the light
BORDER_PX = 0.7  # standard deviation of the blur that smooths the pixel steps of the distances
# Smaller discs that overlap are not separated: two discs that are a radius apart leave a dip of
# 0.13 radii between their centres, which the blur removes.
MIN_RADIUS_PX = 3.0
SIZES = (0.8, 1.25)  # least and largest radius of a disc, relative to the typical one
APART = 0.5  # distance in radii below which two maxima are the same disc
MIN_STRAIGHT = 3  # pairs of discs in a straight line from which a part of the mask is a bar
SAME = 0.1  # distance in radii within which a blob is a disc; the place of the blob is better


def set_apart(
    relative: NDArray[np.floating], uv: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float | None]:
    """Return places (n, 2) and radius of beads; each of the blobs (m, 2) may be several beads.

    relative: (h, w) light as a fraction of that around the beads. Blobs with no disc near them are
    kept. The radius [px] is None if beads are too small for discs, or if there are none.
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
    # A part without a blob is noise or a border; a part wider than a disc is a plate or bone.
    usable = np.isin(np.arange(count), part[row, column])
    usable[part[distance > SIZES[1] * radius]] = usable[0] = False
    discs = _discs(np.where(usable[part], distance, 0), radius)
    discs = discs[~_in_bars(discs, distance, part, radius)]
    if not len(discs):
        return uv, None
    disc_distance, nearest = cKDTree(discs).query(uv)
    exact = disc_distance < SAME * radius
    has_blob = np.isin(np.arange(len(discs)), nearest[exact])
    return np.concatenate([uv[exact | (disc_distance > radius)], discs[~has_blob]]), radius


def _discs(distance: NDArray[np.float32], radius: float) -> NDArray[np.float64]:
    """Return centres (n, 2) of discs of about a radius, from distances (h, w) to the border."""
    size = 2 * int(APART * radius) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    v, u = np.nonzero((distance >= cv2.dilate(distance, kernel)) & (distance > SIZES[0] * radius))
    place = np.column_stack([u, v]).astype(float)
    place = place[np.argsort(-distance[v, u], kind='stable')]
    duplicates = {second for _, second in cKDTree(place).query_pairs(APART * radius)}
    return place[[number for number in range(len(place)) if number not in duplicates]]


def _in_bars(
    discs: NDArray[np.float64],
    distance: NDArray[np.float32],
    part: NDArray[np.int32],
    radius: float,
) -> NDArray[np.bool_]:
    """Return (n,) whether discs (n, 2) lie in bars, such as screws, that are as wide as a bead.

    Halfway between two beads, the distance (h, w) to the border is less than the radius; in a bar
    it is not. Three beads in a line form one such pair; a bar has at least MIN_STRAIGHT pairs.
    """
    pair = cKDTree(discs).query_pairs(2 * radius, output_type='ndarray').reshape(-1, 2)
    spacing = np.linalg.norm(discs[pair[:, 0]] - discs[pair[:, 1]], axis=1)
    pair, spacing = pair[spacing > radius], spacing[spacing > radius]
    label = part[tuple(discs.astype(int).T[::-1])]
    column, row = np.rint(discs[pair].mean(axis=1)).astype(int).T
    half_width = np.sqrt(np.maximum(radius**2 - spacing**2 / 4, 0))
    straight = distance[row, column] > 0.5 * (radius + half_width)
    size = int(part.max()) + 1
    count = np.bincount(label[pair[straight, 0]], minlength=size)
    total = np.bincount(label[pair[:, 0]], minlength=size)
    return np.asarray((count >= MIN_STRAIGHT) & (2 * count > total))[label]
