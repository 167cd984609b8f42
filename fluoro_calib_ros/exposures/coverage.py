"""How much of the image the collected image points cover."""

import numpy as np
from scipy.ndimage import binary_dilation

CELLS = (
    32  # across the image: at 1024 px a cell is 32 px, about the spacing of 15 exposures' points
)


class Coverage:
    """Part of the image area within reach of an image point: its cell of a 32 x 32 grid and the
    eight around it.
    """

    def __init__(self, image_size):
        self._size = np.asarray(image_size, dtype=float)
        self._hit = np.zeros((CELLS, CELLS), dtype=bool)

    def add(self, uv):
        """Count image points (n, 2) [px]."""
        cell = np.floor((np.asarray(uv) + 0.5) / self._size * CELLS).astype(int)
        cell = np.clip(cell, 0, CELLS - 1)
        self._hit[cell[:, 1], cell[:, 0]] = True

    @property
    def fraction(self):
        """Covered part of the image area, 0 to 1."""
        return float(np.mean(binary_dilation(self._hit, np.ones((3, 3), dtype=bool))))
