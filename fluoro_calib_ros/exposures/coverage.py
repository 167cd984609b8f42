# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Coverage of the image by the collected image points."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import binary_dilation

from .columns import cells_of

# Across the image: at 1024 px a cell is 32 px, about the spacing of the points of 15 exposures.
CELLS = 32
# Areas of the image, in rows of three from the top left.
AREAS = (
    'in the upper left corner',
    'at the upper edge',
    'in the upper right corner',
    'at the left edge',
    'in the centre',
    'at the right edge',
    'in the lower left corner',
    'at the lower edge',
    'in the lower right corner',
)
SUFFICIENT_OF_AREA = 0.85  # covered fraction above which an area is not named as missing


class Coverage:
    """Fraction of the image that is close to an image point.

    A point covers its cell in a grid of 32 x 32 and the eight cells around it.
    """

    def __init__(self, image_size: tuple[int, int]) -> None:
        self._size = np.asarray(image_size, dtype=float)
        self._occupied = np.zeros((CELLS, CELLS), dtype=bool)

    def add(self, uv: ArrayLike) -> None:
        """Add image points (n, 2) [px]."""
        column, row = cells_of(uv, self._size, CELLS).T
        self._occupied[row, column] = True

    @property
    def covered(self) -> np.ndarray:
        """Whether cells (rows, columns) are covered."""
        return binary_dilation(self._occupied, np.ones((3, 3), dtype=bool))

    @property
    def fraction(self) -> float:
        """Covered fraction of the image, 0 to 1."""
        return float(np.mean(self.covered))

    @property
    def missing_areas(self) -> tuple[str, ...]:
        """Areas of the image that are not sufficiently covered, the emptiest first, in words."""
        thirds = np.linspace(0, CELLS, 4).astype(int)
        covered = np.add.reduceat(
            np.add.reduceat(self.covered.astype(float), thirds[:-1], 0), thirds[:-1], 1
        )
        size = np.diff(thirds)
        fractions = (covered / np.outer(size, size)).ravel()
        order = np.argsort(fractions, kind='stable')
        return tuple(AREAS[i] for i in order if fractions[i] < SUFFICIENT_OF_AREA)
