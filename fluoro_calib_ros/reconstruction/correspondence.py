# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Matching of the image points of one exposure that have the same target id in several views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class CorrectedView:
    """Corrected image points of one view of an exposure.

    Attributes
    ----------
    target_id : ndarray
        (n,), each once.
    uv : ndarray
        (n, 2), corrected pixels.
    sigma, correction_sd : ndarray
        (n,), standard deviations of the coordinates, and of the correction alone [px].
    outside : ndarray
        (n,), True beyond the calibrated area.
    """

    target_id: np.ndarray
    uv: np.ndarray
    sigma: np.ndarray
    correction_sd: np.ndarray
    outside: np.ndarray


@dataclass(frozen=True)
class MatchedViews:
    """Corrected image points of F views of an exposure, by target.

    Values are NaN, and `outside` False, where a view does not see a target.

    Attributes
    ----------
    target_id : ndarray
        (n,), ascending; or, where all views have the same ids in the same order, in that order.
    uv : ndarray
        (F, n, 2), corrected pixels.
    sigma, correction_sd : ndarray
        (F, n), standard deviations of the coordinates, and of the correction alone [px].
    outside : ndarray
        (F, n), True beyond the calibrated area.
    """

    target_id: np.ndarray
    uv: np.ndarray
    sigma: np.ndarray
    correction_sd: np.ndarray
    outside: np.ndarray


def match_views(views: Sequence[CorrectedView | None]) -> MatchedViews:
    """Match the views of an exposure by target id; None stands for a view that is missing.

    At least one view must be there.
    """
    present = [view for view in views if view is not None]
    first = present[0].target_id
    if len(present) == len(views) and all(_equal(first, view.target_id) for view in present[1:]):
        return MatchedViews(
            first,
            np.array([view.uv for view in present], dtype=float).reshape(len(views), -1, 2),
            np.array([view.sigma for view in present], dtype=float),
            np.array([view.correction_sd for view in present], dtype=float),
            np.array([view.outside for view in present], dtype=bool),
        )
    if all(_equal(first, view.target_id) for view in present[1:]):
        target_id = first
        rows: list[np.ndarray | slice] = [slice(None)] * len(present)
    else:
        target_id = np.unique(np.concatenate([view.target_id for view in present]))
        rows = [np.searchsorted(target_id, view.target_id) for view in present]
    shape = (len(views), len(target_id))
    uv = np.full((*shape, 2), np.nan)
    sigma = np.full(shape, np.nan)
    correction_sd = np.full(shape, np.nan)
    outside = np.zeros(shape, dtype=bool)
    numbers = [number for number, view in enumerate(views) if view is not None]
    for number, view, row in zip(numbers, present, rows):
        uv[number, row] = view.uv
        sigma[number, row] = view.sigma
        correction_sd[number, row] = view.correction_sd
        outside[number, row] = view.outside
    return MatchedViews(target_id, uv, sigma, correction_sd, outside)


def _equal(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two views have the same ids in the same order."""
    return len(one) == len(other) and bool((one == other).all())
