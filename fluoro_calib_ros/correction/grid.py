# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Correction at the rate of a stream, by a lookup grid that is computed once from a model.

Neighbour searches and series of sines take too long for a frame of 30 points, and even more so for
millions of points. The image is therefore divided into cells. In each cell the correction and its
standard deviation are interpolated bilinearly between exact values at the corners. A cell is one
row of a table, with all the data of a point in it: the cost of a lookup is one random memory
access per point, plus the numpy calls for a small frame.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .base import CorrectionModel, CorrectionStatus, Smoothness
from .grid_cells import (
    COEFFICIENTS,
    Cells,
    DividedCells,
    aligned_array,
    build_cells,
    divide_cells,
    write_coefficients,
)

# Fraction of a cell by which the image is extended, so that rounding leaves its edge on it.
EDGE = 1e-11


DIVIDED = 4  # added to the status of a cell that is divided
CHUNK = 8192  # points per lookup, so that their coefficients fit the cache


class CorrectionGrid:
    """Correction, standard deviation and status of the pixels of an image, from a table.

    Use does not change a grid, so any number of threads may share it. A piecewise constant model
    (knn) gets the smallest cells; lookups interpolate between the values at their corners.

    image_size: width and height [px].
    """

    def __init__(self, model: CorrectionModel, image_size: tuple[int, int]) -> None:
        width, height = image_size
        self.image_size = (int(width), int(height))
        cells = build_cells(model, self.image_size)
        self.nodes = cells.nodes  #: (w,) columns and rows [px] of the corners of cells
        #: longer side of a cell
        self.cell_px = float(max(np.diff(axis).max() for axis in cells.nodes))
        self._set_tables(cells)
        self.divided = 0  #: number of cells that are divided further
        errors = cells.errors
        if model.smoothness is not Smoothness.STEPPED:
            divided = divide_cells(model, cells)
            if divided is not None:
                self._set_divided(divided)
                errors[:, divided.row, divided.column] = self._errors_of_divided(model, divided)
        #: largest difference of a coordinate from the exact model in the calibrated area, measured
        #: at the centres of cells and of their edges; a kink between these may add half as much
        self.error_px = float(np.nanmax(errors[0][~cells.outside], initial=0.0))
        #: the same for cells outside the calibrated area
        self.error_outside_px = float(np.nanmax(errors[0][cells.outside], initial=0.0))
        #: largest difference of the standard deviation, everywhere
        self.sd_error_px = float(np.nanmax(errors[1]))

    def _set_tables(self, cells: Cells) -> None:
        """Make the tables of coefficients and status, one row for each cell."""
        rows, columns = cells.outside.shape
        number = np.array([[columns], [rows]])
        self._cells_per_px = (number - 2 * EDGE) / np.array(self.image_size)[:, None]
        self._shift = 0.5 * self._cells_per_px + 1 + EDGE
        self._highest = number + 1.5
        self._columns_of_table = columns + 2
        # A border of cells around the image covers points off the image, with NaN and INVALID.
        table = aligned_array((rows + 2, columns + 2, COEFFICIENTS))
        table[:] = np.nan
        write_coefficients(cells.nodes, cells.values, table[1:-1, 1:-1])
        self._table = table.reshape(-1, COEFFICIENTS)
        status = np.where(cells.outside, CorrectionStatus.OUTSIDE, CorrectionStatus.OK)
        self._status = np.pad(
            status.astype(np.uint8), 1, constant_values=int(CorrectionStatus.INVALID)
        ).ravel()

    def _set_divided(self, divided: DividedCells) -> None:
        """Make lookups in divided cells use the table of their parts."""
        self._first = divided.first
        self._parts = divided.parts
        self._parts_table = divided.table
        self._divided_cells = (divided.row + 1) * self._columns_of_table + divided.column + 1
        self._status[self._divided_cells] += DIVIDED
        self.divided = len(divided.row)

    def _errors_of_divided(
        self, model: CorrectionModel, divided: DividedCells
    ) -> NDArray[np.float64]:
        """Return the errors (2, d) [px] of correction and standard deviation in divided cells."""
        place = np.random.default_rng(0).random((2, 20, self.divided))  # 20 places per cell
        u, v = (
            axis[k] + part * (axis[k + 1] - axis[k])
            for axis, k, part in zip(self.nodes, (divided.column, divided.row), place)
        )
        looked_up = self.look_up(u.ravel(), v.ravel())[0]
        exact = model.evaluate_in_bulk(np.stack([u.ravel(), v.ravel()], axis=1))
        error = np.abs(looked_up - exact).reshape(3, *u.shape).max(axis=1)
        return np.stack([error[:2].max(axis=0), error[2]])

    def look_up(
        self, u: NDArray[np.float64], v: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
        """Return correction, standard deviation and status at pixels.

        u, v: (n,) columns and rows [px]. Returns values: (3, n) du, dv and standard deviation
        [px], NaN where the status is INVALID; status: (n,) `CorrectionStatus`, INVALID off the
        image and for coordinates that are not a number.
        """
        n = len(u)
        if n <= CHUNK:
            return self._look_up(u, v)
        values = np.empty((3, n))
        status = np.empty(n, dtype=np.uint8)
        for start in range(0, n, CHUNK):
            part = slice(start, start + CHUNK)
            values[:, part], status[part] = self._look_up(u[part], v[part])
        return values, status

    def _look_up(
        self, u: NDArray[np.float64], v: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
        """Look up at most CHUNK points; see `look_up`. Few numpy calls, most of them in place."""
        place = np.array((u, v), dtype=float)  # in units of cells, in the table
        place *= self._cells_per_px
        place += self._shift
        np.fmax(place, 0.5, place)  # also replaces NaN
        np.fmin(place, self._highest, place)
        column, row = place.astype(np.intp)  # rounds down, as it is positive
        row *= self._columns_of_table
        row += column
        # The rows are in range; modes other than 'clip' make an additional copy.
        status = self._status.take(row, mode='clip')
        coefficients = np.empty((COEFFICIENTS, len(u)))
        coefficients[...] = self._table.take(row, 0, mode='clip').T
        values = _interpolated(coefficients, u, v)
        if self.divided:
            self._look_up_parts(u, v, place, row, (values, status))
        return values, status

    def _look_up_parts(
        self,
        u: NDArray[np.float64],
        v: NDArray[np.float64],
        place: NDArray[np.float64],
        row: NDArray[np.int64],
        result: tuple[NDArray[np.float64], NDArray[np.uint8]],
    ) -> None:
        """Replace the results of points in divided cells, whose status is DIVIDED or more."""
        values, status = result
        divided = np.flatnonzero(status >= DIVIDED)
        if not len(divided):
            return
        cell = np.searchsorted(self._divided_cells, row[divided])
        parts = self._parts[cell]
        place = place[:, divided]
        column, line = np.minimum(((place - np.floor(place)) * parts).astype(np.intp), parts - 1)
        coefficients = self._parts_table[self._first[cell] + line * parts + column].T
        values[:, divided] = _interpolated(coefficients, u[divided], v[divided])
        status[divided] -= DIVIDED


def _interpolated(
    coefficients: NDArray[np.float64], u: NDArray[np.float64], v: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return values (3, n) from coefficients (12, n) of 1, u, v, u v; overwrites these."""
    of_v = coefficients[6:]
    of_v *= v
    of_v += coefficients[:6]
    values = of_v[3:]
    values *= u
    values += of_v[:3]
    return values
