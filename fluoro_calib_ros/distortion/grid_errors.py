# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Errors of bilinear interpolation between the corners of the cells of a lookup grid."""

from __future__ import annotations

import numpy as np

from .base import CorrectionModel, Smoothness

LIMIT_PX = 0.01  # largest difference of a looked-up correction from that of the exact model
# The difference is measured at centres of cells and of their edges; a kink between centre and
# corner has its largest error elsewhere.
TARGET_PX = 0.6 * LIMIT_PX
# Cells of the smallest size in which the difference is measured: those with the largest second
# differences.
MIN_MEASURED = 500
MAX_MEASURED = 25_000
PLACES = ((0.5, 0.5), (0.5, 0.0), (0.0, 0.5), (0.5, 1.0), (1.0, 0.5))  # in a cell, where it is


def errors_of_finer_grid(values: np.ndarray) -> np.ndarray:
    """Errors (2, h, w) [px] of correction and standard deviation in cells.

    values (3, 2h + 1, 2w + 1): du, dv and standard deviation at the corners of the cells, the
    middles of their edges, and their centres.
    """
    corner = values[:, ::2, ::2]
    along_u = (corner[:, :, :-1] + corner[:, :, 1:]) / 2
    along_v = (corner[:, :-1] + corner[:, 1:]) / 2
    of_u = np.abs(values[:, ::2, 1::2] - along_u)
    of_v = np.abs(values[:, 1::2, ::2] - along_v)
    error = np.abs(values[:, 1::2, 1::2] - (along_u[:, :-1] + along_u[:, 1:]) / 2)
    for other in (of_u[:, :-1], of_u[:, 1:], of_v[:, :, :-1], of_v[:, :, 1:]):
        np.maximum(error, other, out=error)
    return np.stack([error[:2].max(axis=0), error[2]])


def errors_where_curved(
    model: CorrectionModel,
    nodes: tuple[np.ndarray, np.ndarray],
    values: np.ndarray,
    affordable: int,
) -> np.ndarray:
    """Errors of cells, measured where second differences suggest that they may be too large.

    Parameters
    ----------
    model : CorrectionModel
    nodes : (w,) ndarray, (h,) ndarray
        Columns and rows [px] of the corners of the cells.
    values : (3, h, w) ndarray
        du, dv and standard deviation there.
    affordable : int
        Number of exact values that do not take too long.

    Returns
    -------
    (2, h - 1, w - 1) ndarray
        Errors of correction and standard deviation [px]; NaN in cells that are not measured. At
        least MIN_MEASURED cells are, if that is affordable.
    """
    columns, rows = nodes
    curvature = _second_differences(values)
    # At a kink the error is at most half the second difference, on a smooth bend an eighth.
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


def _second_differences(values: np.ndarray) -> np.ndarray:
    """Largest second difference (h - 1, w - 1) [px] of the correction at the corners of a cell."""
    at_node = np.zeros(values.shape[1:])
    at_node[:, 1:-1] = np.abs(np.diff(values[:2], 2, axis=2)).max(axis=0)
    at_node[1:-1] += np.abs(np.diff(values[:2], 2, axis=1)).max(axis=0)
    of_cell = np.maximum(at_node[:-1], at_node[1:])
    return np.maximum(of_cell[:, :-1], of_cell[:, 1:])
