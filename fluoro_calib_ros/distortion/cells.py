"""Exact prediction at frame rate: candidates for the nearest neighbours, cell by cell.

The image is divided into square cells. With r the distance from a cell's middle to its k-th nearest training
point and e half the cell's diagonal, the k nearest of any pixel of the cell lie within r + 2e of the middle,
and every training point within r - 2e is one of them (triangle inequality). So each cell keeps its few
candidates in order, and a query selects among the uncertain ones only: the same sum as from a search of all
training points, several times as fast for a frame of many targets.
"""

import numpy as np

from .smoothers import plane_weights

CELL_PX = (8, 16, 32, 64)   # sizes that are tried
MEMORY = 64_000_000   # bytes the candidates of all cells may take


class CellPredictor:
    """Predictions of a smoother of the k nearest, for pixels of an image of image_size (width, height).

    kind 'knn' or 'local_linear'; tree: KD-tree of the training pixels; values (N, 2) there [px].
    """

    def __init__(self, kind, k, tree, values, image_size):
        self._kind, self._k = kind, k
        for self._cell in CELL_PX:
            self._shape = tuple(-(-int(size) // self._cell) for size in image_size)
            if 32 * k * self._shape[0] * self._shape[1] <= MEMORY or self._cell == CELL_PX[-1]:
                break
        middle = np.stack(np.meshgrid(*(np.arange(s) for s in self._shape), indexing='ij'), axis=-1).reshape(-1, 2)
        middle = (middle + 0.5) * self._cell - 0.5
        reach = self._cell / np.sqrt(2) * (1 + 1e-9)
        kth = tree.query(middle, k=[k])[0][:, 0]
        within = tree.query_ball_point(middle, kth + 2 * reach, return_length=True)
        sure = tree.query_ball_point(middle, np.maximum(kth - 2 * reach, 0), return_length=True)
        self._sure = min(int(sure.min()), k - 1)
        _, index = tree.query(middle, k=np.arange(1, int(within.max()) + 1))
        # u, v, du, dv of the candidates of each cell, in ascending distance from its middle.
        self._table = np.concatenate([tree.data[index], values[index]], axis=2).transpose(0, 2, 1).copy()

    def __call__(self, uv):
        """Predictions (n, 2) and squared norms (n,) of their weights at pixels uv (n, 2) of the image."""
        column, row = np.clip(((uv + 0.5) / self._cell).astype(np.intp), 0, np.array(self._shape) - 1).T
        near = self._table[column * self._shape[1] + row]
        dx, dy = near[:, 0] - uv[:, :1], near[:, 1] - uv[:, 1:]
        square = dx * dx + dy * dy
        rank = self._k - 1 - self._sure
        kth = np.partition(square[:, self._sure:], rank, axis=1)[:, rank]
        weights = self._weights(dx, dy, square, kth)
        return np.stack([np.einsum('nk,nk->n', weights, near[:, 2]), np.einsum('nk,nk->n', weights, near[:, 3])],
                        axis=1), np.einsum('nk,nk->n', weights, weights)

    def _weights(self, dx, dy, square, kth):
        if self._kind == 'knn':
            chosen = (square <= kth[:, None]).astype(float)
            return chosen / chosen.sum(axis=1, keepdims=True)   # equally distant ones share the last place
        ratio = square / np.maximum(kth, 1e-12)[:, None]
        kernel = np.sqrt(ratio)
        kernel *= ratio
        np.subtract(1, kernel, out=kernel)
        np.maximum(kernel, 0, out=kernel)
        kernel *= kernel * kernel
        alike = np.einsum('nk->n', kernel) <= 1e-9   # all neighbours at one distance: they count alike
        if alike.any():
            kernel[alike] = square[alike] <= kth[alike, None]
        return plane_weights(dx, dy, kernel, kth)
