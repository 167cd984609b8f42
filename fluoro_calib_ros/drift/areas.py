# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The areas of an image in which the drift watch looks for a drift."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


class ImageAreas:
    """Overlapping areas of an image: n x n cells, windows of half its size, halves, and the whole.

    Parameters
    ----------
    n : int
        Number of cells across the image, even.

    Attributes
    ----------
    member : ndarray
        (areas, cells), 1 where a cell belongs to an area, else 0.
    box : ndarray
        (areas, 4), edges u0, v0, u1, v1 as fractions of the image.
    """

    def __init__(self, n: int) -> None:
        half = n // 2
        step = max(1, n // 4)
        starts = range(0, half + 1, step) if n % 4 == 0 else (0, half)
        boxes = [(i, j, i + 1, j + 1) for j in range(n) for i in range(n)] if n > 2 else []
        boxes += [(i, j, i + half, j + half) for j in starts for i in starts]
        boxes += [(0, 0, half, n), (half, 0, n, n), (0, 0, n, half), (0, half, n, n), (0, 0, n, n)]
        self.n = n
        self.box = np.array(boxes) / n
        row, column = np.divmod(np.arange(n * n), n)
        left, top, right, bottom = np.array(boxes).T[:, :, None]
        inside = (column >= left) & (column < right) & (row >= top) & (row < bottom)
        self.member = inside.astype(float)

    def __len__(self) -> int:
        return len(self.member)

    def cell(self, uv: np.ndarray, size: Sequence[float] | np.ndarray) -> np.ndarray:
        """Cells (n,) of pixels uv (n, 2) of an image of size (width, height) [px].

        Pixels off the image belong to the nearest cell.
        """
        column = np.clip((uv[:, 0] + 0.5) * (self.n / size[0]), 0, self.n - 1).astype(int)
        row = np.clip((uv[:, 1] + 0.5) * (self.n / size[1]), 0, self.n - 1).astype(int)
        return column + self.n * row

    def describe(self, area: int, size: Sequence[float]) -> tuple[tuple[float, ...], str]:
        """Corners (u0, v0, u1, v1) [px] of an area of an image of that size, and its name."""
        u0, v0, u1, v1 = self.box[area]
        corners = tuple(float(x) for x in self.box[area] * np.tile(size, 2) - 0.5)
        across = _side(u0 + u1, 'left', 'right')
        down = _side(v0 + v1, 'upper', 'lower')
        width = u1 - u0
        height = v1 - v0
        if width == 1 and height == 1:
            return corners, 'whole image'
        if width == 1 or height == 1:
            return corners, f'{across if height == 1 else down} half'
        if width < 0.5:
            middle = self.box[area].reshape(2, 2).mean(axis=0) * size - 0.5
            return corners, f'{down} {across} quarter, about ({middle[0]:.0f}, {middle[1]:.0f}) px'
        if 'middle' in (across, down):
            return corners, 'middle' if across == down else f'{down} {across}'
        return corners, f'{down} {across} quarter'


def _side(edges: float, low: str, high: str) -> str:
    """Name of the side of the image on which an interval lies whose edges have this sum."""
    if edges == 1:
        return 'middle'
    return low if edges < 1 else high
