# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Cells of a lookup grid: their size, exact values at their corners, and coefficients.

The cells are as large as LIMIT_PX allows. Where a few of them are not accurate enough, such as at
the kinks of neighbour models, they are divided once more into rows of a second table. The cost of
the exact values is estimated beforehand; if it is too high, the cells are larger.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError
from .base import CorrectionModel, Smoothness
from .series import BULK_CHUNK

# Errors of bilinear interpolation between the corners of the cells of a lookup grid.

LIMIT_PX = 0.01  # largest difference of a looked-up correction from the exact model
# The difference is measured at the centres of cells and of their edges; a kink between centre and
# corner has its largest error elsewhere.
TARGET_PX = 0.6 * LIMIT_PX
# The difference in cells of the smallest size is measured in those with the largest second
# differences: minimum and maximum number of such cells, which bounds the time.
MIN_MEASURED = 500
MAX_MEASURED = 25_000
PLACES = ((0.5, 0.5), (0.5, 0.0), (0.0, 0.5), (0.5, 1.0), (1.0, 0.5))  # positions within a cell


def errors_of_finer_grid(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the errors (2, h, w) [px] of correction and standard deviation in cells.

    values (3, 2h + 1, 2w + 1): du, dv and standard deviation at the corners of the cells, the
    middles of their edges, and their centres.
    """
    corner = values[:, ::2, ::2]
    along_u = (corner[:, :, :-1] + corner[:, :, 1:]) / 2
    along_v = (corner[:, :-1] + corner[:, 1:]) / 2
    edge_u = np.abs(values[:, ::2, 1::2] - along_u)
    edge_v = np.abs(values[:, 1::2, ::2] - along_v)
    error = np.abs(values[:, 1::2, 1::2] - (along_u[:, :-1] + along_u[:, 1:]) / 2)
    for edge_error in (edge_u[:, :-1], edge_u[:, 1:], edge_v[:, :, :-1], edge_v[:, :, 1:]):
        np.maximum(error, edge_error, out=error)
    return np.stack([error[:2].max(axis=0), error[2]])


def errors_where_curved(
    model: CorrectionModel,
    nodes: tuple[NDArray[np.float64], NDArray[np.float64]],
    values: NDArray[np.float64],
    affordable: int,
) -> NDArray[np.float64]:
    """Measure the errors of cells where second differences suggest that they may be too large.

    nodes: (w,) columns and rows [px] of the corners of the cells. values: (3, h, w) du, dv and
    standard deviation there. affordable: number of exact values that can be computed in time.
    Returns (2, h - 1, w - 1) errors of correction and standard deviation [px], NaN in cells that
    are not measured. At least MIN_MEASURED cells are measured if that is affordable.
    """
    columns, rows = nodes
    curvature = _second_differences(values)
    # The error is at most half the second difference at a kink, and an eighth on a smooth bend.
    count = MIN_MEASURED
    if model.smoothness is not Smoothness.STEPPED:
        curved = np.count_nonzero(curvature > 1.5 * TARGET_PX)
        count = int(np.clip(curved, MIN_MEASURED, MAX_MEASURED))
    count = max(1, min(count, affordable // len(PLACES)))
    j, i = np.unravel_index(np.argsort(-curvature, axis=None)[:count], curvature.shape)
    errors = np.full((2, *curvature.shape), np.nan)
    errors[:, j, i] = 0.0
    for x, y in PLACES:
        u = columns[i] + x * (columns[i + 1] - columns[i])
        v = rows[j] + y * (rows[j + 1] - rows[j])
        upper = (1 - x) * values[:, j, i] + x * values[:, j, i + 1]
        lower = (1 - x) * values[:, j + 1, i] + x * values[:, j + 1, i + 1]
        exact = model.evaluate_in_bulk(np.stack([u, v], axis=1))
        error = np.abs((1 - y) * upper + y * lower - exact)
        errors[:, j, i] = np.maximum(errors[:, j, i], [error[:2].max(axis=0), error[2]])
    return errors


def _second_differences(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the largest second difference (h - 1, w - 1) [px] at the corners of each cell."""
    at_node = np.zeros(values.shape[1:])
    at_node[:, 1:-1] = np.abs(np.diff(values[:2], 2, axis=2)).max(axis=0)
    at_node[1:-1] += np.abs(np.diff(values[:2], 2, axis=1)).max(axis=0)
    largest_of_rows = np.maximum(at_node[:-1], at_node[1:])
    return np.maximum(largest_of_rows[:, :-1], largest_of_rows[:, 1:])


CELL_PX = (8, 4, 2)  # sizes of cells to try; those of a saved lookup grid are the largest
MAX_SHARE_DIVIDED = 0.01  # maximum fraction of cells to divide; beyond it all cells get smaller
MAX_DIVIDED = 2500  # maximum number of cells to divide, the worst ones first
MAX_PARTS = 16  # maximum number of parts of a divided cell along a side
MAX_TABLE_BYTES = 128_000_000  # up to 5 megapixels, all sizes of cells are tried
MAX_CELL_PX = 64  # larger ones would not represent the model
# Limit of the work for the values at the corners of cells (`CorrectionModel.bulk_work`): some six
# seconds. Measuring the errors may take a quarter of it, dividing cells half of it.
MAX_WORK = 1.2e8
COEFFICIENTS = 12  # per cell: 1, u, v, u v, each for du, dv and the standard deviation

Nodes = tuple[
    NDArray[np.float64], NDArray[np.float64]
]  # columns (w,) and rows (h,) [px] of the corners of cells


@dataclass(frozen=True)
class Cells:
    """Cells of a lookup grid."""

    nodes: Nodes  #: (w,) columns and rows [px] of their corners
    values: NDArray[np.float64]  #: (3, h, w) du, dv and standard deviation [px] there
    #: (2, h - 1, w - 1) errors [px] of correction and standard deviation in the cells; NaN where
    #: they were not measured
    errors: NDArray[np.float64]
    #: (h - 1, w - 1) True for cells with a corner beyond the calibrated area
    outside: NDArray[np.bool_]
    work: float  #: average work per value


@dataclass(frozen=True)
class DividedCells:
    """Cells that are divided further because they are not accurate enough."""

    #: (d,) indices of the divided cells in the grid
    row: NDArray[np.int64]
    column: NDArray[np.int64]
    parts: NDArray[np.int64]  #: (d,) number of parts along a side
    first: NDArray[np.int64]  #: (d,) row of the first part in the table
    table: NDArray[np.float64]  #: (p, 12) coefficients of all parts


def build_cells(model: CorrectionModel, image_size: tuple[int, int]) -> Cells:
    """Compute the cells of an image (width, height) [px] for a model.

    Raises DataError if the values take too long to compute, even at the corners of large cells.
    """
    sizes, work = _affordable_sizes(model, image_size)
    nodes, values, errors = _nodes_and_values(model, image_size, sizes, work)
    return Cells(nodes, values, errors, _outside(model, nodes), work)


def divide_cells(model: CorrectionModel, cells: Cells) -> DividedCells | None:
    """Divide the cells with the largest errors; return None if all are accurate enough."""
    error = cells.errors[0]
    inaccurate = np.flatnonzero(error > TARGET_PX)
    worst_first = np.argsort(-error.ravel()[inaccurate], kind='stable')
    inaccurate = np.sort(inaccurate[worst_first[:MAX_DIVIDED]])
    if not len(inaccurate):
        return None
    j, i = np.unravel_index(inaccurate, error.shape)
    columns, rows = cells.nodes
    # At a kink the error is proportional to the side of a cell. One more halving allows for errors
    # between the measured points.
    halvings = 1 + np.ceil(np.log2(error[j, i] / TARGET_PX))
    parts = np.minimum(2 ** halvings.astype(np.intp), MAX_PARTS)
    affordable = _affordable_cells(error[j, i], parts, cells.work)
    if not len(affordable):
        return None
    j = j[affordable]
    i = i[affordable]
    parts = parts[affordable]
    part_nodes = [
        (
            np.linspace(columns[x], columns[x + 1], n + 1),
            np.linspace(rows[y], rows[y + 1], n + 1),
        )
        for x, y, n in zip(i, j, parts)
    ]
    exact = model.evaluate_in_bulk(np.concatenate([pixels_of(nodes) for nodes in part_nodes]))
    values = np.split(exact, np.cumsum((parts + 1) ** 2)[:-1], axis=1)
    first = np.concatenate([[0], np.cumsum(parts**2)[:-1]])
    table = aligned_array((int(np.sum(parts**2)), COEFFICIENTS))
    for nodes, n, start, cell_values in zip(part_nodes, parts, first, values):
        write_coefficients(
            nodes,
            cell_values.reshape(3, n + 1, n + 1),
            table[start : start + n * n].reshape(n, n, COEFFICIENTS),
        )
    return DividedCells(j, i, parts, first, table)


def _affordable_cells(
    error: NDArray[np.float64], parts: NDArray[np.int64], work: float
) -> NDArray[np.int64]:
    """Return sorted indices of the cells with the largest errors whose parts are affordable."""
    worst_first = np.argsort(-error, kind='stable')
    values = np.cumsum((parts[worst_first] + 1) ** 2)
    return np.sort(worst_first[: np.searchsorted(values * work, MAX_WORK / 2, side='right')])


def write_coefficients(
    nodes: Nodes, values: NDArray[np.float64], out: NDArray[np.float64]
) -> None:
    """Write the coefficients of bilinear interpolation in cells to out (h - 1, w - 1, 12).

    nodes: columns (w,) and rows (h,) [px] of the corners; values (3, h, w) there. The coefficients
    are those of 1, u, v and u v, each for du, dv and the standard deviation.
    """
    columns, rows = nodes
    x = columns[:-1]
    y = rows[:-1, None]
    width = np.diff(columns)
    height = np.diff(rows)[:, None]
    corner = values[:, :-1, :-1]
    slope_x = (values[:, :-1, 1:] - corner) / width
    slope_y = (values[:, 1:, :-1] - corner) / height
    slope_xy = ((values[:, 1:, 1:] - values[:, 1:, :-1]) / width - slope_x) / height
    for k in range(3):
        a = corner[k]
        b = slope_x[k]
        c = slope_y[k]
        d = slope_xy[k]
        out[:, :, k] = a - b * x - (c - d * x) * y
        out[:, :, 3 + k] = b - d * y
        out[:, :, 6 + k] = c - d * x
        out[:, :, 9 + k] = d


def aligned_array(shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return uninitialised floats aligned to cache lines, so that a row spans few of them."""
    size = int(np.prod(shape))
    memory = np.empty(size + 8)
    start = -memory.ctypes.data % 64 // 8
    return memory[start : start + size].reshape(shape)


def _nodes_and_values(
    model: CorrectionModel, image_size: tuple[int, int], sizes: list[float], work: float
) -> tuple[Nodes, NDArray[np.float64], NDArray[np.float64]]:
    """Choose the cell size; return its nodes, values (3, h, w) there, and errors of the cells."""
    nodes = nodes_of(image_size, sizes[0], 1)
    values = None
    for number in range(len(sizes) - 1):
        finer_nodes = nodes_of(image_size, sizes[0], 2 ** (number + 1))
        finer_values = _exact_values(model, finer_nodes)
        values = finer_values[:, ::2, ::2]
        errors = errors_of_finer_grid(finer_values)
        if np.mean(errors[0] > TARGET_PX) <= MAX_SHARE_DIVIDED:
            return nodes, values, errors
        nodes = finer_nodes
        values = finer_values
    if values is None:
        values = _exact_values(model, nodes)
    max_cells = int(MAX_WORK / 4 / work)
    return nodes, values, errors_where_curved(model, nodes, values, max_cells)


def _affordable_sizes(
    model: CorrectionModel, image_size: tuple[int, int]
) -> tuple[list[float], float]:
    """Return the sizes of cells to try that are affordable, and the mean work per value.

    Raises DataError if there are none.
    """
    sizes = _cell_sizes(model.smoothness, image_size)
    while True:
        pixels = pixels_of(nodes_of(image_size, sizes[0], 2 ** (len(sizes) - 1)))
        work = model.bulk_work(pixels, MAX_WORK)
        if work <= MAX_WORK:
            return sizes, work / len(pixels)
        sizes = sizes[:-1] or [2 * sizes[0]]
        if sizes[0] > MAX_CELL_PX:
            raise DataError(
                f'the correction takes too long: its {len(model.train_uv)} training points lie '
                f'too close together for {model.k} neighbours'
            )


def _cell_sizes(smoothness: Smoothness, image_size: tuple[int, int]) -> list[float]:
    """Return the sizes of cells [px] to try, each half the previous one."""
    area = image_size[0] * image_size[1]
    bytes_of_cell = COEFFICIENTS * 8
    sizes: list[float] = [
        size for size in CELL_PX if area / size**2 * bytes_of_cell <= MAX_TABLE_BYTES
    ]
    if not sizes:
        return [2 ** np.ceil(np.log2(area * bytes_of_cell / MAX_TABLE_BYTES) / 2)]
    if smoothness is Smoothness.STEPPED:
        return sizes[-1:]  # small cells blur the steps less
    if smoothness is Smoothness.KINKED:
        return sizes[-2:]  # larger cells are never accurate enough
    return sizes


def nodes_of(image_size: tuple[int, int], size: float, parts: int) -> Nodes:
    """Return the corners of cells of at most size / parts [px], from edge to edge of an image."""
    u, v = (
        np.linspace(-0.5, length - 0.5, parts * max(1, int(np.ceil(length / size))) + 1)
        for length in image_size
    )
    return u, v


def pixels_of(nodes: Nodes) -> NDArray[np.float64]:
    """Return the pixels (h * w, 2) of nodes, row by row."""
    columns, rows = nodes
    return np.stack([np.tile(columns, len(rows)), np.repeat(rows, len(columns))], axis=1)


def _exact_values(model: CorrectionModel, nodes: Nodes) -> NDArray[np.float64]:
    """Return du, dv and standard deviation (3, h, w) [px] of the model at nodes."""
    columns, rows = nodes
    return model.evaluate_in_bulk(pixels_of(nodes)).reshape(3, len(rows), len(columns))


def _outside(model: CorrectionModel, nodes: Nodes) -> NDArray[np.bool_]:
    """Return True (h - 1, w - 1) for cells with a corner beyond the calibrated area.

    All other cells are inside, except for less than a cell at the border of a hole.
    """
    columns, rows = nodes
    step = max(1, BULK_CHUNK // len(columns))
    parts = [
        model.outside(pixels_of((columns, rows[i : i + step]))) for i in range(0, len(rows), step)
    ]
    node = np.concatenate(parts).reshape(len(rows), len(columns))
    return node[:-1, :-1] | node[:-1, 1:] | node[1:, :-1] | node[1:, 1:]
