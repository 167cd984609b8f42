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

from bisect import bisect_left
from typing import Any

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


class LookupWorkspace:
    """Arrays, and views of them, for the lookup of up to n points in a table of cells.

    Only one thread may use a workspace at a time. It is kept from frame to frame. All numpy calls
    operate on whole, preallocated arrays of the same shape: the number of calls determines the
    time of a frame of 30 points.

    n: largest number of points. shape: numbers of rows and columns of cells on the image.
    image_size: width and height of the image [px].
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
        ones = np.ones((2, n))
        self._cells_per_px = ones * cells_per_px[:, None]
        self._shift = ones * (0.5 * cells_per_px + 1 + EDGE)[:, None]
        self._lowest = ones * 0.5
        self._highest = ones * (number[:, None] + 1.5)
        self._columns_of_table = np.full(n, columns + 2)
        pixels = np.zeros((9, n))  # u three times, v six times
        self._u = pixels[:3]
        self._v = pixels[3:]
        self.uv = pixels[2:4]  #: (2, n) pixels
        self.place = np.empty((2, n))  #: (2, n) pixels in units of cells
        self._cell = np.empty((2, n), dtype=np.intp)
        self._column = self._cell[0]
        self.row = self._cell[1]  #: (n,) rows of their cells in the table
        self._coefficients = np.empty((n, COEFFICIENTS))
        self._found = np.empty((COEFFICIENTS, n))
        self._constant = self._found[:6]
        self._slopes = self._found[6:]
        self._linear = np.empty((6, n))
        self._of_one = self._linear[:3]
        self._of_u = self._linear[3:]
        self.result = np.empty((3, n))  #: (3, n) du, dv and standard deviation [px]
        self.status = np.empty(n, dtype=np.uint8)  #: (n,) status of their cells

    def locate(self, u: NDArray[np.float64], v: NDArray[np.float64]) -> None:
        """Find the cells of points u, v (m,) with m <= n; sets `uv`, `place` and `row`."""
        place = self.place
        row = self.row
        count = len(u)
        self._u[:, :count] = u
        self._v[:, :count] = v
        np.multiply(self.uv, self._cells_per_px, place)
        np.add(place, self._shift, place)
        np.fmax(place, self._lowest, place)  # also replaces NaN
        np.fmin(place, self._highest, place)
        self._cell[...] = place  # rounds down, as it is positive
        np.multiply(row, self._columns_of_table, row)
        np.add(row, self._column, row)

    def interpolate(self, table: NDArray[np.float64], status: NDArray[np.uint8]) -> None:
        """Evaluate the cells of the located points; sets `result` and `status`.

        table (cells, COEFFICIENTS) and status (cells,) have a row for each cell.
        """
        linear = self._linear
        result = self.result
        # The rows are in range; modes other than 'clip' make an additional copy.
        table.take(self.row, 0, self._coefficients, 'clip')
        status.take(self.row, 0, self.status, 'clip')
        self._found[...] = self._coefficients.T
        np.multiply(self._slopes, self._v, linear)  # constant + slopes * v, of 1 and of u
        np.add(linear, self._constant, linear)
        np.multiply(self._of_u, self._u, result)
        np.add(result, self._of_one, result)


DIVIDED = 4  # added to the status of a cell that is divided
CHUNK = 8192  # points per lookup, so that their workspace fits the cache
# Capacities of workspaces: steps of 32 for frames, then powers of two.
WORKSPACE_SIZES = (*range(0, 512, 32), 512, 1024, 2048, 4096, CHUNK)


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
        self._workspaces: list[list[LookupWorkspace]] = _no_workspaces()
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
        self._shape = (rows, columns)
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
        columns = self._shape[1] + 2
        self._divided_cells = (divided.row + 1) * columns + divided.column + 1
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

    def __getstate__(self) -> dict[str, Any]:
        # Copied views would no longer share memory, so workspaces are not pickled.
        return {**self.__dict__, '_workspaces': _no_workspaces()}

    def look_up(
        self,
        u: NDArray[np.float64],
        v: NDArray[np.float64],
        values: NDArray[np.float64] | None = None,
        status: NDArray[np.uint8] | None = None,
    ) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
        """Return correction, standard deviation and status at pixels.

        u, v: (n,) columns and rows [px]. values, status: (3, n) and (n,) arrays for the results,
        both or neither. Returns values: (3, n) du, dv and standard deviation [px], NaN where the
        status is INVALID; status: (n,) `CorrectionStatus`, INVALID off the image and for
        coordinates that are not a number.
        """
        n = len(u)
        if n <= CHUNK:
            return self._look_up(u, v, values, status)
        if values is None or status is None:
            values = np.empty((3, n))
            status = np.empty(n, dtype=np.uint8)
        for start in range(0, n, CHUNK):
            part = slice(start, start + CHUNK)
            self._look_up(u[part], v[part], values[:, part], status[part])
        return values, status

    def _look_up(
        self,
        u: NDArray[np.float64],
        v: NDArray[np.float64],
        values: NDArray[np.float64] | None,
        status: NDArray[np.uint8] | None,
    ) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
        """Look up at most CHUNK points; see `look_up`."""
        n = len(u)
        number = bisect_left(WORKSPACE_SIZES, n)
        workspaces = self._workspaces[number]
        try:
            workspace = workspaces.pop()  # exclusive to this thread until it is appended
        except IndexError:
            workspace = LookupWorkspace(WORKSPACE_SIZES[number], self._shape, self.image_size)
        workspace.locate(u, v)
        workspace.interpolate(self._table, self._status)
        if self.divided:
            self._look_up_parts(workspace)
        if values is None or status is None:
            values = workspace.result[:, :n].copy()
            status = workspace.status[:n].copy()
        else:
            values[...] = workspace.result[:, :n]
            status[...] = workspace.status[:n]
        workspaces.append(workspace)
        return values, status

    def _look_up_parts(self, workspace: LookupWorkspace) -> None:
        """Replace the results of points in divided cells, whose status is DIVIDED or more."""
        divided = np.flatnonzero(workspace.status >= DIVIDED)
        if not len(divided):
            return
        cell = np.searchsorted(self._divided_cells, workspace.row[divided])
        parts = self._parts[cell]
        place = workspace.place[:, divided]
        column, row = np.minimum(((place - np.floor(place)) * parts).astype(np.intp), parts - 1)
        columns = self._parts_table[self._first[cell] + row * parts + column].T
        u, v = workspace.uv[:, divided]
        half = columns[6:] * v + columns[:6]
        workspace.result[:, divided] = half[3:] * u + half[:3]
        workspace.status[divided] -= DIVIDED


def _no_workspaces() -> list[list[LookupWorkspace]]:
    """Return empty lists of free workspaces, by WORKSPACE_SIZES."""
    return [[] for _ in WORKSPACE_SIZES]
