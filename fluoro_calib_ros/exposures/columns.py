# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Rules for columns of numbers that frames and phantoms share, and cells of image points."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def is_positive(sigma: ArrayLike) -> NDArray[np.bool_]:
    """Return (n,) whether values are finite and above 0, as a standard deviation must be."""
    sigma = np.asarray(sigma)
    return np.isfinite(sigma) & (sigma > 0)


def first_repeated(target_id: ArrayLike) -> tuple[int, int] | None:
    """Return the first two positions of the smallest id that occurs more than once, else None."""
    ids = np.asarray(target_id)
    order = np.argsort(ids, kind='stable')
    ordered = ids[order]
    repeated = np.flatnonzero(ordered[1:] == ordered[:-1])
    if not len(repeated):
        return None
    return int(order[repeated[0]]), int(order[repeated[0] + 1])


def cells_of(uv: ArrayLike, image_size: ArrayLike, count: int) -> NDArray[np.int64]:
    """Return column and row (n, 2) of image points in a grid of count x count cells.

    Points off the image belong to the nearest cell.
    """
    place = (np.asarray(uv, dtype=float) + 0.5) / np.asarray(image_size) * count
    return np.clip(np.floor(place), 0, count - 1).astype(np.int64)
