# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Rigid motions of points."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ..photogrammetry.rotations import cross_matrix

MAX_TRIPLES = 84  # of points that are tried: all of nine points


def fitted_pose(
    source: np.ndarray, target: np.ndarray, weight: np.ndarray | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotations (..., 3, 3) and shifts (..., 3) that take points (..., k, 3) to others.

    By least squares; weight (..., k): of the points, by default the same for all. Kabsch, "A
    solution for the best rotation to relate two sets of vectors", Acta Cryst. A32, 1976.
    """
    weight = np.ones(source.shape[:-1]) if weight is None else weight
    share = (weight / weight.sum(axis=-1, keepdims=True))[..., None]
    a = np.sum(share * source, axis=-2, keepdims=True)
    b = np.sum(share * target, axis=-2, keepdims=True)
    u, _, vt = np.linalg.svd(np.swapaxes(source - a, -1, -2) @ (share * (target - b)))
    back = np.swapaxes(vt, -1, -2).copy()
    back[..., 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    rotation = back @ np.swapaxes(u, -1, -2)
    return rotation, (b - a @ np.swapaxes(rotation, -1, -2))[..., 0, :]


def robust_pose(
    source: np.ndarray, target: np.ndarray
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotation (3, 3) and shift (3,) that take most of at least three points (k, 3) to others.

    Of the motions of three points, the one with the least median of the distances, then of all
    points within three of these medians. Rousseeuw, "Least median of squares regression", J. Am.
    Stat. Assoc. 79, 1984.
    """
    count = len(source)
    triples = np.array(list(combinations(range(count), 3)))
    triples = triples[np.linspace(0, len(triples) - 1, MAX_TRIPLES).astype(int)]
    rotation, shift = fitted_pose(source[triples], target[triples])
    away = np.linalg.norm(source @ np.swapaxes(rotation, 1, 2) + shift[:, None] - target, axis=2)
    middle = max(count // 2, 2)
    median = np.partition(away, middle, axis=1)[:, middle]
    best = int(np.argmin(median))
    near = away[best] <= 3 * median[best]
    return fitted_pose(source[near], target[near])


def by_pose(arm: np.ndarray) -> NDArray[np.float64]:
    """Derivatives (..., 3, 6) of places by position and rotation; arm (..., 3): R x."""
    out = np.zeros((*arm.shape, 6))
    out[..., :3] = np.eye(3)
    out[..., 3:] = -cross_matrix(arm)
    return out
