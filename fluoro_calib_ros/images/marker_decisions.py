# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Decisions on doubtful ids of a view, and what they change in its images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .markers import MarkerFrame, MarkerTracker


@dataclass(frozen=True)
class Decision:
    """What the other view, or its cluster, says of a doubtful id.

    Attributes
    ----------
    kind : {'confirmed', 'exchanged', 'dropped'}
    fluoroscope : str
    frame, since : int
        The image of the decision, and the first one that it holds for.
    target_id : tuple of int
        One id, or the two that were exchanged.
    """

    kind: str
    fluoroscope: str
    frame: int
    since: int
    target_id: tuple[int, ...]


class ViewCounts:
    """Exposures, one after the other, that agree or disagree with the ids of count markers."""

    def __init__(self, count: int) -> None:
        self._agreed = np.zeros(count, dtype=int)
        self._agreed_since = np.zeros(count, dtype=int)
        self._wrong = np.zeros(count, dtype=int)

    def agree(self, row: int, agrees: bool, frame: int) -> int:
        """Count an exposure that agrees with an id or does not, and return how many agree."""
        if agrees and self._agreed[row] == 0:
            self._agreed_since[row] = frame
        self._agreed[row] = self._agreed[row] + 1 if agrees else 0
        return int(self._agreed[row])

    def confirm(self, row: int) -> int:
        """Return the first exposure that agreed, and count anew."""
        self._agreed[row] = 0
        return int(self._agreed_since[row])

    def disagree(self, wrong: np.ndarray, rows: np.ndarray | slice = np.s_[:]) -> None:
        """Count an exposure in which some of the rows are wrong, and the others are not."""
        self._wrong[rows] = np.where(wrong, self._wrong[rows] + 1, 0)

    @property
    def wrong(self) -> np.ndarray:
        """Exposures (n,) that disagree."""
        return self._wrong

    def clear_wrong(self, row: int) -> None:
        """Count anew the exposures that disagree."""
        self._wrong[row] = 0

    def clear(self, rows: Sequence[int]) -> None:
        """Count anew for some markers."""
        self._wrong[list(rows)] = 0
        self._agreed[list(rows)] = 0


@dataclass(frozen=True)
class DecidedView:
    """One of two views, whose ids are decided on.

    Attributes
    ----------
    view : int
        0 or 1, its row in an exposure.
    name : str
        Of the fluoroscope.
    tracker : MarkerTracker
    target_id : (n,) ndarray
        Of the markers of both views, ascending.
    counts : ViewCounts
        By row of these.
    """

    view: int
    name: str
    tracker: MarkerTracker
    target_id: NDArray[np.int64]
    counts: ViewCounts

    def ids(self, *rows: int) -> tuple[int, ...]:
        """Return the ids of rows."""
        return tuple(int(self.target_id[row]) for row in rows)

    def doubt(self, rows: np.ndarray, frame: int) -> None:
        """Note that the ids of rows may be wrong."""
        for number in self.ids(*rows):
            self.tracker.doubt(number, frame)

    def doubted_since(self, rows: Sequence[int], frame: int) -> int:
        """Return the image since which one of the rows may be wrong, or the present one."""
        return min(self.tracker.doubted_since(number) or frame for number in self.ids(*rows))

    def confirm(self, row: int, frame: int) -> Decision:
        """Take back the doubt in an id that exposures agreed with."""
        ids = self.ids(row)
        self.tracker.confirm(*ids)
        return Decision('confirmed', self.name, frame, self.counts.confirm(row), ids)

    def exchange(self, rows: Sequence[int], frame: int, since: int) -> Decision:
        """Exchange two ids that were the wrong way round since an image."""
        one, other = self.ids(*rows)
        self.tracker.exchange(one, other)
        return Decision('exchanged', self.name, frame, since, (one, other))

    def drop(self, row: int, frame: int, since: int) -> Decision:
        """Give up a marker that was something else since an image."""
        ids = self.ids(row)
        self.tracker.forget(*ids)
        self.counts.clear_wrong(row)
        return Decision('dropped', self.name, frame, since, ids)

    def revised(
        self, found: MarkerFrame, decisions: Sequence[Decision], frame: int
    ) -> MarkerFrame:
        """Return the markers of the view after decisions on both, with the doubts left."""
        for decision in decisions:
            if decision.fluoroscope == self.name and decision.since <= frame:
                found = revise(found, decision)
        doubtful = np.array(
            [self.tracker.doubted_since(int(i)) is not None for i in found.target_id], dtype=bool
        )
        return replace(found, doubtful=doubtful)


def revise(found: MarkerFrame, decision: Decision) -> MarkerFrame:
    """Return the markers of an image after a decision that holds for it."""
    ids = found.target_id.copy()
    doubtful = found.doubtful.copy()
    if decision.kind == 'exchanged':
        one, two = decision.target_id
        # The exposure in which they were exchanged is not known, so they stay doubtful.
        doubtful |= np.isin(found.target_id, decision.target_id)
        ids = np.where(
            found.target_id == one, two, np.where(found.target_id == two, one, found.target_id)
        )
        return replace(found, target_id=ids, doubtful=doubtful)
    row = found.target_id == decision.target_id[0]
    if decision.kind == 'confirmed':
        doubtful[row] = False
        return replace(found, doubtful=doubtful)
    keep = ~row
    missing = found.missing
    predicted = found.predicted
    lost = found.lost
    if row.any():
        missing = np.append(missing, decision.target_id[0])
        predicted = np.concatenate([predicted, found.uv[row]])
        lost = np.append(lost, True)
    return replace(
        found,
        target_id=ids[keep],
        uv=found.uv[keep],
        sigma=found.sigma[keep],
        overlapped=found.overlapped[keep],
        doubtful=doubtful[keep],
        missing=missing,
        predicted=predicted,
        lost=lost,
    )
