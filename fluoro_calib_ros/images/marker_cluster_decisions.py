# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Decisions on the ids of a view by the places that rigid clusters say."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from .marker_decisions import DecidedView, Decision
from .marker_rays import PairExposure

DECIDED = 3  # exposures that agree before an id is confirmed
WRONG = 3  # exposures that disagree before an id is wrong
NEAR_PX = 1.0  # from where its cluster says, that a marker is; or so many
NEAR_SIGMAS = 3.5
FAR = 1.5  # times that, from which it is something else
MAX_DISTANCE_PX = 50.0  # beyond it, distances are alike


class ClusterDecisions:
    """Decides on the ids of a view by the places that clusters say."""

    def __init__(self, view: DecidedView) -> None:
        self._view = view
        self._seen_right = np.zeros(len(view.target_id), dtype=int)  # last image in the place

    def decide(self, exposure: PairExposure, place: np.ndarray, frame: int) -> list[Decision]:
        """Confirm, exchange or drop ids by places (n, 2) of markers [px], NaN for unknown."""
        view = self._view
        seen = exposure.observed[view.view]
        doubtful = exposure.doubtful[view.view]
        away = np.linalg.norm(seen - place, axis=1)
        near = np.maximum(NEAR_PX, NEAR_SIGMAS * exposure.sigma[view.view])
        right = away < near
        wrong = away > FAR * near
        self._seen_right[right] = frame
        view.counts.disagree(wrong)
        view.doubt(np.flatnonzero(wrong & ~doubtful), frame)
        suspects = np.flatnonzero(np.isfinite(away) & (doubtful | (view.counts.wrong > 0)))
        crossed = _crossed(seen, place, near, suspects)
        out = [self._exchange(rows, frame) for rows in crossed]
        exchanged = {row for rows in crossed for row in rows}
        for row in suspects.tolist():
            if row in exchanged:
                continue
            beside = np.linalg.norm(place - seen[row], axis=1)
            beside[row] = np.inf
            # Another one that could be here as well leaves the doubt.
            alone = np.nanmin(beside, initial=np.inf) > FAR * near[row]
            out += self._weigh(row, bool(right[row] and alone), frame)
        return out

    def _exchange(self, rows: tuple[int, int], frame: int) -> Decision:
        """Exchange two ids, each of which is where the other one should be."""
        view = self._view
        # They were not exchanged while one of them was where its cluster says.
        together = int(self._seen_right[list(rows)].max()) + 1
        since = max(view.doubted_since(rows, frame), together)
        view.counts.clear(rows)
        return view.exchange(rows, frame, since)

    def _weigh(self, row: int, agrees: bool, frame: int) -> list[Decision]:
        """Confirm or drop an id by the exposures up to the present one, which agrees or not."""
        view = self._view
        began = view.tracker.doubted_since(*view.ids(row))
        agreed = view.counts.agree(row, agrees, frame)
        if began is not None and agreed >= DECIDED:
            return [view.confirm(row, frame)]
        if view.counts.wrong[row] >= WRONG:
            return [view.drop(row, frame, began or frame - WRONG + 1)]
        return []


def _crossed(
    seen: np.ndarray, place: np.ndarray, near: np.ndarray, suspects: np.ndarray
) -> list[tuple[int, int]]:
    """Pairs of suspects that are where clusters say that the other is.

    Markers beside each other exchange places only if both are nearer to the other's.
    """
    if len(suspects) < 2:
        return []
    distance = np.linalg.norm(seen[suspects][:, None] - place[suspects][None], axis=2)
    own = np.diagonal(distance)
    cost = np.minimum(distance, MAX_DISTANCE_PX)
    _, column = linear_sum_assignment(cost)
    out = []
    for one, two in enumerate(column.tolist()):
        if one < two and column[two] == one:
            limit = float(near[suspects[[one, two]]].min())
            both = max(distance[one, two], distance[two, one])
            if both < limit and min(own[one], own[two]) > FAR * limit:
                out.append((int(suspects[one]), int(suspects[two])))
    return out
