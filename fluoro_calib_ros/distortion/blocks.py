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
MAX_BLOCK_PX = 64.0  # its largest side, for pixels that are far apart
BLOCKS_PER_QUERY = 32
MAX_FOUND = 5_000_000  # candidates of a query, to bound the memory


def blocks_with_candidates(
    tree: cKDTree, uv: np.ndarray, k: int
) -> Iterator[tuple[np.ndarray, list[int]]]:
    """Blocks of pixels uv (n, 2), and the training points among which their k nearest are.

    tree holds the training points. Yields the rows of the pixels and of the training points.
    """
    blocks = _blocks(uv)
    # Where many training points coincide, each block has all of them as candidates.
    per_query = int(np.clip(MAX_FOUND // tree.n, 1, BLOCKS_PER_QUERY))
    for start in range(0, len(blocks), per_query):
        some = blocks[start : start + per_query]
        low = np.array([np.min(uv[block], axis=0) for block in some])
        high = np.array([np.max(uv[block], axis=0) for block in some])
        centre = (low + high) / 2
        diagonal = np.linalg.norm(high - low, axis=1)
        kth = tree.query(centre, k=[k])[0][:, 0]
        found = tree.query_ball_point(centre, (kth + diagonal) * (1 + 1e-9) + 1e-9)
        yield from zip(some, found)


def _blocks(uv: np.ndarray) -> list[np.ndarray]:
    """Rows of pixels uv (n, 2) that are close together, about BLOCK of them each."""
    low = uv.min(axis=0)
    high = uv.max(axis=0)
    side = min(MAX_BLOCK_PX, np.sqrt(BLOCK * np.prod(high - low + 1) / len(uv)))
    column, row = ((uv - low) / side).astype(np.intp).T
    block = row * (column.max() + 1) + column
    order = np.argsort(block, kind='stable')
    border = np.flatnonzero(np.diff(block[order])) + 1
    return [
        part[i : i + 2 * BLOCK]
        for part in np.split(order, border)
        for i in range(0, len(part), 2 * BLOCK)
    ]
