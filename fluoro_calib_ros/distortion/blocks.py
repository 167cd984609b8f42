# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Nearest training points of very many pixels, block by block.

All pixels of a block have their k nearest training points among those within r + 2e of its centre,
where r is the distance of the k-th nearest from the centre and e half the diagonal (triangle
inequality). So one search serves some 200 pixels, and every call of numpy takes some ten
microseconds: a stream in the same process is not delayed.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial import cKDTree

BLOCK = 200  # pixels of a block
MIN_BLOCK = 9  # where training points are dense
MAX_BLOCK_PX = 64.0  # its largest side, for pixels that are far apart
BLOCKS_PER_QUERY = 32
MAX_FOUND = 2_000_000  # candidates of a query, to bound the memory
REACH_SAMPLES = 32
# In candidates of a pixel: what a block costs, and each neighbour in the search from its centre.
WORK_OF_BLOCK = 5000
WORK_OF_NEIGHBOUR = 10


def blocks_with_candidates(
    tree: cKDTree, uv: np.ndarray, k: int, most: int
) -> Iterator[tuple[np.ndarray, list[int] | None]]:
    """Blocks of pixels uv (n, 2), and the training points among which their k nearest are.

    tree holds the training points. Yields the rows of the pixels and of the training points; None
    in place of more than most points, as where many coincide.
    """
    per_query = int(np.clip(MAX_FOUND // min(tree.n, most), 1, BLOCKS_PER_QUERY))
    for some, centre, radius in _circles(tree, uv, k, per_query):
        if tree.n <= most:
            yield from zip(some, tree.query_ball_point(centre, radius))
            continue
        few = tree.query_ball_point(centre, radius, return_length=True) <= most
        found = iter(tree.query_ball_point(centre[few], radius[few]) if few.any() else ())
        for block, is_few in zip(some, few):
            yield block, next(found) if is_few else None


def work_of_blocks(tree: cKDTree, uv: np.ndarray, k: int, limit: float) -> int:
    """Sum of the numbers of candidates over pixels uv (n, 2), and the work on blocks as such.

    Counting ends above a limit.
    """
    total = 0
    for some, centre, radius in _circles(tree, uv, k, BLOCKS_PER_QUERY):
        counts = tree.query_ball_point(centre, radius, return_length=True)
        total += sum(len(block) * int(count) for block, count in zip(some, counts))
        total += len(some) * (WORK_OF_BLOCK + WORK_OF_NEIGHBOUR * k)
        if total > limit:
            break
    return total


def _circles(
    tree: cKDTree, uv: np.ndarray, k: int, per_query: int
) -> Iterator[tuple[list[np.ndarray], np.ndarray, np.ndarray]]:
    """Yield per_query blocks at a time, with centres and radii of the circles of candidates."""
    reach = np.median(tree.query(uv[:: len(uv) // REACH_SAMPLES + 1], k=[k])[0])
    blocks = _blocks(uv, reach)
    for start in range(0, len(blocks), per_query):
        some = blocks[start : start + per_query]
        low = np.array([np.min(uv[block], axis=0) for block in some])
        high = np.array([np.max(uv[block], axis=0) for block in some])
        centre = (low + high) / 2
        diagonal = np.linalg.norm(high - low, axis=1)
        kth = tree.query(centre, k=[k])[0][:, 0]
        yield some, centre, (kth + diagonal) * (1 + 1e-9) + 1e-9


def _blocks(uv: np.ndarray, reach: float) -> list[np.ndarray]:
    """Rows of pixels uv (n, 2) that are close together, about BLOCK of them each.

    reach: distance of the k-th nearest training point [px]. Larger blocks would have many more
    candidates than k, and are divided.
    """
    low = uv.min(axis=0)
    high = uv.max(axis=0)
    of_one = np.sqrt(np.prod(high - low + 1) / len(uv))
    side = min(
        np.sqrt(BLOCK) * of_one,
        max(MAX_BLOCK_PX, reach / 2),
        max(reach, np.sqrt(MIN_BLOCK) * of_one),
    )
    column, row = ((uv - low) / side).astype(np.intp).T
    block = row * (column.max() + 1) + column
    order = np.argsort(block, kind='stable')
    border = np.flatnonzero(np.diff(block[order])) + 1
    return [
        part[i : i + 2 * BLOCK]
        for part in np.split(order, border)
        for i in range(0, len(part), 2 * BLOCK)
    ]
