# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Decisions on the ids of a view by epipolar distances alone, where no cluster says a place."""

from __future__ import annotations

import numpy as np

from .marker_decisions import DecidedView, Decision
from .marker_rays import AGREE, PairExposure, PairRays

DISAGREE = 6.0  # standardised epipolar distance from which two rays do not belong together
DECIDED_ALONE = 8  # exposures that agree before an id is confirmed
MAX_COST = 50.0  # of a squared distance; and of evidence, from which it decides


class RayDecisions:
    """Decides on the ids of a view by the epipolar distances of both ways round."""

    def __init__(self, view: DecidedView, rays: PairRays) -> None:
        self._view = view
        self._rays = rays
        # By two rows: what speaks against their exchange, and since when it is not believed.
        self._evidence: dict[tuple[int, int], float] = {}
        self._kept: dict[tuple[int, int], int] = {}

    def decide(self, exposure: PairExposure, known: np.ndarray, frame: int) -> list[Decision]:
        """Confirm or exchange ids; known (n,) are those that clusters decide on."""
        view = self._view
        out: list[Decision] = []
        both = np.isfinite(exposure.standardised) & ~known
        for row in np.flatnonzero(both & exposure.doubtful[view.view]).tolist():
            (number,) = view.ids(row)
            if view.tracker.doubted_since(number) is None:
                continue
            partners = view.tracker.partners(number)
            others = [int(np.searchsorted(view.target_id, other)) for other in partners]
            others = [other for other in others if other != row and both[other]]
            for other in others:
                if other > row:
                    out += self._both_ways(exposure, (row, other), frame)
            if not others and not partners - {number}:
                agrees = bool(exposure.standardised[row] < AGREE)
                if view.counts.agree(row, agrees, frame) >= DECIDED_ALONE:
                    out.append(view.confirm(row, frame))
        rows = np.flatnonzero(both)
        bad = exposure.standardised[rows] > DISAGREE
        view.counts.disagree(bad, rows)
        view.doubt(rows[bad], frame)
        return out

    def _both_ways(
        self, exposure: PairExposure, rows: tuple[int, int], frame: int
    ) -> list[Decision]:
        """Weigh the epipolar distances of two markers of a view against those exchanged."""
        view = self._view
        other = self._rays.exchanged(exposure, view.view, rows)
        keep = np.minimum(exposure.standardised[list(rows)] ** 2, MAX_COST).sum()
        change = np.minimum(np.nan_to_num(other, nan=np.inf) ** 2, MAX_COST).sum()
        if change < keep or rows not in self._evidence:
            self._kept[rows] = frame
        self._evidence[rows] = self._evidence.get(rows, 0.0) + float(change - keep)
        if abs(self._evidence[rows]) < MAX_COST:
            return []
        exchanged = self._evidence.pop(rows) < 0
        kept = self._kept.pop(rows)
        out = []
        if exchanged:
            out.append(view.exchange(rows, frame, view.doubted_since(rows, frame)))
            kept = frame
        ids = view.ids(*rows)
        view.tracker.part(*ids)
        for number in ids:
            if view.tracker.doubted_since(number) is None:
                out.append(Decision('confirmed', view.name, frame, kept, (number,)))
        return out
