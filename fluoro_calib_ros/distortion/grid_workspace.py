# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The arrays in which the points of a frame are looked up, kept from frame to frame."""

from __future__ import annotations

import numpy as np

from .grid_cells import COEFFICIENTS

# Part of a cell by which the image ends later, so that rounding leaves its edge on it.
EDGE = 1e-11


class LookupWorkspace:
    """Arrays, and views of them, for the lookup of up to n points in a table of cells.

    One thread uses it at a time. All calls of numpy are between whole arrays of one shape that
    exist already: the number of calls is what a frame of 30 points costs.

    Parameters
    ----------
    n : int
        Largest number of points.
    shape : (int, int)
        Numbers of rows and columns of cells on the image.
    image_size : (int, int)
        Width and height of the image [px].

    Attributes
    ----------
    uv : (2, n) ndarray
        Pixels.
    place : (2, n) ndarray
        Pixels in units of cells.
    row : (n,) ndarray of int
        Rows of their cells in the table.
    result : (3, n) ndarray
        du, dv and standard deviation [px].
    status : (n,) ndarray of uint8
        Status of their cells.
    """

    __slots__ = (
        '_cell',
        '_cells_per_px',
        '_coefficients',
        '_column',
        '_columns_of_table',
        '_constant',
        '_found',
        '_highest',
        '_linear',
        '_lowest',
        '_of_one',
        '_of_u',
        '_shift',
        '_slopes',
        '_u',
        '_v',
        'place',
        'result',
        'row',
        'status',
        'uv',
    )

    def __init__(self, n: int, shape: tuple[int, int], image_size: tuple[int, int]) -> None:
        rows, columns = shape
        number = np.array([columns, rows])
        cells_per_px = (number - 2 * EDGE) / np.array(image_size)
        whole = np.ones((2, n))
        self._cells_per_px = whole * cells_per_px[:, None]
        self._shift = whole * (0.5 * cells_per_px + 1 + EDGE)[:, None]
        self._lowest = whole * 0.5
        self._highest = whole * (number[:, None] + 1.5)
        self._columns_of_table = np.full(n, columns + 2)
        pixels = np.zeros((9, n))  # u three times, v six times
        self._u = pixels[:3]
        self._v = pixels[3:]
        self.uv = pixels[2:4]
        self.place = np.empty((2, n))
        self._cell = np.empty((2, n), dtype=np.intp)
        self._column = self._cell[0]
        self.row = self._cell[1]
        self._coefficients = np.empty((n, COEFFICIENTS))
        self._found = np.empty((COEFFICIENTS, n))
        self._constant = self._found[:6]
        self._slopes = self._found[6:]
        self._linear = np.empty((6, n))
        self._of_one = self._linear[:3]
        self._of_u = self._linear[3:]
        self.result = np.empty((3, n))
        self.status = np.empty(n, dtype=np.uint8)

    def locate(self, u: np.ndarray, v: np.ndarray) -> None:
        """Find the cells of points u, v (m,) with m <= n: sets `uv`, `place` and `row`."""
        place = self.place
        row = self.row
        count = len(u)
        self._u[:, :count] = u
        self._v[:, :count] = v
        np.multiply(self.uv, self._cells_per_px, place)
        np.add(place, self._shift, place)
        np.fmax(place, self._lowest, place)  # replaces NaN, too
        np.fmin(place, self._highest, place)
        self._cell[...] = place  # rounds down: it is positive
        np.multiply(row, self._columns_of_table, row)
        np.add(row, self._column, row)

    def interpolate(self, table: np.ndarray, status: np.ndarray) -> None:
        """Evaluate the cells of the located points: sets `result` and `status`.

        table (cells, COEFFICIENTS) and status (cells,) have a row for each cell.
        """
        linear = self._linear
        result = self.result
        # The rows are in range; other modes than 'clip' copy once more.
        table.take(self.row, 0, self._coefficients, 'clip')
        status.take(self.row, 0, self.status, 'clip')
        self._found[...] = self._coefficients.T
        np.multiply(self._slopes, self._v, linear)  # constant + slopes v, of 1 and of u
        np.add(linear, self._constant, linear)
        np.multiply(self._of_u, self._u, result)
        np.add(result, self._of_one, result)
