# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Decisions on doubtful ids of a view, and the changes that they make to its images."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .marker_rays import AGREE, MarkerExposure, MarkerRays
from .markers import MarkerFrame, MarkerTracker


@dataclass(frozen=True)
class Decision:
    """Decision on a doubtful id by other views, or by its body."""

    kind: str  #: {'confirmed', 'exchanged', 'dropped'}
    fluoroscope: str
    #: the image of the decision, and the first image to which it applies
    frame: int
    since: int
    target_id: tuple[int, ...]  #: one id, or the two ids that were exchanged


class ViewCounts:
    """Counts of consecutive exposures that agree or disagree with the ids of `count` markers."""

    def __init__(self, count: int) -> None:
        self._agreed = np.zeros(count, dtype=int)
        self._agreed_since = np.zeros(count, dtype=int)
        self._wrong = np.zeros(count, dtype=int)

    def agree(self, row: int, agrees: bool, frame: int, began: int | None = None) -> int:
        """Count an exposure that agrees with an id or not; return the number of those that agree.

        began: image since which the id is in doubt; earlier exposures are not counted.
        """
        if began is not None and self._agreed_since[row] < began:
            self._agreed[row] = 0
        if agrees and self._agreed[row] == 0:
            self._agreed_since[row] = frame
        self._agreed[row] = self._agreed[row] + 1 if agrees else 0
        return int(self._agreed[row])

    def confirm(self, row: int) -> int:
        """Return the first exposure that agreed, and restart the count."""
        self._agreed[row] = 0
        return int(self._agreed_since[row])

    def disagree(
        self, wrong: NDArray[np.bool_], rows: NDArray[np.int64] | slice = np.s_[:]
    ) -> None:
        """Count an exposure in which some rows are wrong; restart the count of the others."""
        self._wrong[rows] = np.where(wrong, self._wrong[rows] + 1, 0)

    @property
    def wrong(self) -> NDArray[np.int64]:
        """Numbers (n,) of exposures that disagree."""
        return self._wrong

    def clear(self, rows: Sequence[int]) -> None:
        """Restart the counts of some markers."""
        self._wrong[list(rows)] = 0
        self._agreed[list(rows)] = 0


@dataclass(frozen=True)
class DecidedView:
    """One of several views, for whose ids decisions are made."""

    view: int  #: row of the view in an exposure
    name: str  #: name of the fluoroscope
    tracker: MarkerTracker
    target_id: NDArray[np.int64]  #: (n,), ids of the markers of all views, ascending
    counts: ViewCounts  #: counts by row of target_id

    def ids(self, *rows: int) -> tuple[int, ...]:
        """Return the ids of rows."""
        return tuple(int(self.target_id[row]) for row in rows)

    def doubt(self, rows: NDArray[np.int64], frame: int) -> None:
        """Note that the ids of rows may be wrong."""
        for number in self.ids(*rows):
            self.tracker.doubt(number, frame)

    def doubted_since(self, rows: Sequence[int], frame: int) -> int:
        """Return the image since which one of the rows may be wrong, or the current image."""
        return min(self.tracker.doubted_since(number) or frame for number in self.ids(*rows))

    def confirm(self, row: int, frame: int) -> Decision:
        """Revoke the doubt in an id that exposures agreed with."""
        ids = self.ids(row)
        self.tracker.confirm(*ids)
        return Decision('confirmed', self.name, frame, self.counts.confirm(row), ids)

    def exchange(self, rows: Sequence[int], frame: int, since: int) -> Decision:
        """Exchange two ids that have been swapped since an image."""
        first_id, second_id = self.ids(*rows)
        self.tracker.exchange(first_id, second_id)
        return Decision('exchanged', self.name, frame, since, (first_id, second_id))

    def drop(self, row: int, frame: int, since: int) -> Decision:
        """Drop a marker that has been another object since an image."""
        ids = self.ids(row)
        self.tracker.forget(*ids)
        self.counts.clear([row])
        return Decision('dropped', self.name, frame, since, ids)

    def revised(
        self, markers: MarkerFrame, decisions: Sequence[Decision], frame: int
    ) -> MarkerFrame:
        """Return the markers of the view after all decisions, with the remaining doubts."""
        for decision in decisions:
            if decision.fluoroscope == self.name and decision.since <= frame:
                markers = revise(markers, decision)
        return replace(markers, doubtful=np.isin(markers.target_id, self.tracker.doubtful()))


def revise(markers: MarkerFrame, decision: Decision) -> MarkerFrame:
    """Return the markers of an image after a decision that applies to it."""
    ids = markers.target_id.copy()
    doubtful = markers.doubtful.copy()
    if decision.kind == 'exchanged':
        first_id, second_id = decision.target_id
        # The exposure in which they were exchanged is unknown, so they stay doubtful.
        doubtful |= np.isin(markers.target_id, decision.target_id)
        ids = np.where(
            markers.target_id == first_id,
            second_id,
            np.where(markers.target_id == second_id, first_id, markers.target_id),
        )
        return replace(markers, target_id=ids, doubtful=doubtful)
    row = markers.target_id == decision.target_id[0]
    if decision.kind == 'confirmed':
        doubtful[row] = False
        return replace(markers, doubtful=doubtful)
    keep = ~row
    missing = markers.missing
    predicted = markers.predicted
    lost = markers.lost
    if row.any():
        missing = np.append(missing, decision.target_id[0])
        predicted = np.concatenate([predicted, markers.uv[row]])
        lost = np.append(lost, True)
    return replace(
        markers,
        target_id=ids[keep],
        uv=markers.uv[keep],
        sigma=markers.sigma[keep],
        overlapped=markers.overlapped[keep],
        doubtful=doubtful[keep],
        missing=missing,
        predicted=predicted,
        lost=lost,
    )


@dataclass(frozen=True)
class Retraction:
    """Ids of an image that were reported and turned out to be wrong."""

    frame: int
    target_id: tuple[int, ...]


class EarlierImages:
    """Markers of the images of a view, which later decisions modify.

    most: number of images that are kept; None for all.
    """

    def __init__(self, most: int | None = None) -> None:
        self._found: deque[MarkerFrame] = deque(maxlen=most)

    def __iter__(self) -> Iterator[MarkerFrame]:
        return iter(self._found)

    def add(self, markers: MarkerFrame) -> None:
        """Keep the markers of an image."""
        self._found.append(markers)

    def revise(self, decision: Decision) -> list[Retraction]:
        """Apply a decision to the images that it covers; return the ids that it changes."""
        out = []
        for row in range(len(self._found) - 1, -1, -1):
            markers = self._found[row]
            if markers.frame < decision.since:
                break
            changed_ids = np.intersect1d(markers.target_id, decision.target_id)
            if decision.kind != 'confirmed' and len(changed_ids):
                out.append(Retraction(markers.frame, tuple(changed_ids.tolist())))
            self._found[row] = revise(markers, decision)
        return out[::-1]


DECIDED = 3  # exposures that agree before an id is confirmed, or disagree before it is dropped
NEAR_PX = 1.0  # distance from the place that its body predicts, up to which a marker agrees
NEAR_SIGMAS = 3.5  # the same in standard deviations; the larger one counts
FAR = 1.5  # factor on that distance, beyond which the marker is another object
DOUBT_SIGMAS = 4.5  # beyond them it may be one: chance exceeds them in one of 25,000 places


class BodyDecisions:
    """Decides on the ids of a view by the places that bodies predict."""

    def __init__(self, view: DecidedView) -> None:
        self._view = view
        self._seen_right = np.zeros(len(view.target_id), dtype=int)  # last image that agreed

    def decide(
        self,
        exposure: MarkerExposure,
        place: NDArray[np.float64],
        sd: NDArray[np.float64],
        frame: int,
    ) -> list[Decision]:
        """Confirm, exchange or drop ids by places (n, 2) of markers [px], NaN for unknown.

        sd (n,): standard deviations of these places [px].
        """
        view = self._view
        seen = exposure.observed[view.view]
        doubtful = exposure.doubtful[view.view]
        distance = np.linalg.norm(seen - place, axis=1)
        scatter = np.hypot(exposure.sigma[view.view], sd)
        tolerance = np.maximum(NEAR_PX, NEAR_SIGMAS * scatter)
        agreeing = distance < tolerance
        disagreeing = distance > FAR * tolerance
        # A body that only another view shows has uncertain places along the rays of that view.
        contradicted = (sd > NEAR_PX) & (exposure.standardised[view.view] > DISAGREE)
        agreeing &= ~contradicted
        disagreeing |= contradicted
        self._seen_right[agreeing] = frame
        view.counts.disagree(disagreeing)
        strange = disagreeing | (distance > np.maximum(NEAR_PX, DOUBT_SIGMAS * scatter))
        view.doubt(np.flatnonzero(strange & ~doubtful), frame)
        suspects = np.flatnonzero(np.isfinite(distance) & (doubtful | (view.counts.wrong > 0)))
        crossed = _crossed(seen, place, tolerance, suspects)
        out = [self._exchange(rows, frame) for rows in crossed]
        exchanged = {row for rows in crossed for row in rows}
        for row in suspects.tolist():
            if row in exchanged:
                continue
            separation = np.linalg.norm(place - seen[row], axis=1)
            separation[row] = np.inf
            # If another marker could be here as well, the doubt stays.
            is_isolated = np.nanmin(separation, initial=np.inf) > FAR * tolerance[row]
            out += self._weigh(row, bool(agreeing[row] and is_isolated), frame)
        return out

    def _exchange(self, rows: tuple[int, int], frame: int) -> Decision:
        """Exchange two ids, each of which is at the other's predicted place."""
        view = self._view
        # They cannot have been exchanged while one of them agreed with its body.
        earliest = int(self._seen_right[list(rows)].max()) + 1
        since = max(view.doubted_since(rows, frame), earliest)
        view.counts.clear(rows)
        return view.exchange(rows, frame, since)

    def _weigh(self, row: int, agrees: bool, frame: int) -> list[Decision]:
        """Confirm or drop an id by the exposures up to the current one, which agrees or not."""
        view = self._view
        began = view.tracker.doubted_since(*view.ids(row))
        agreed = view.counts.agree(row, agrees, frame, began)
        if began is not None and agreed >= DECIDED:
            return [view.confirm(row, frame)]
        if view.counts.wrong[row] >= DECIDED:
            return [view.drop(row, frame, began or frame - DECIDED + 1)]
        return []


def _crossed(
    seen: NDArray[np.float64],
    place: NDArray[np.float64],
    near: NDArray[np.float64],
    suspects: NDArray[np.int64],
) -> list[tuple[int, int]]:
    """Return pairs of suspects that are at each other's predicted places.

    Neighbouring markers are exchanged only if both are clearly nearer to the other's place.
    """
    if len(suspects) < 2:
        return []
    distance = np.linalg.norm(seen[suspects][:, None] - place[suspects][None], axis=2)
    own_distance = np.diagonal(distance)
    nearest = distance.argmin(axis=1).tolist()
    out = []
    for i, j in enumerate(nearest):
        if i < j and nearest[j] == i:
            limit = float(near[suspects[[i, j]]].min())
            crossed_distance = max(distance[i, j], distance[j, i])
            if crossed_distance < limit and min(own_distance[i], own_distance[j]) > FAR * limit:
                out.append((int(suspects[i]), int(suspects[j])))
    return out


DISAGREE = 6.0  # standardised epipolar distance from which two rays belong to different markers
DECIDED_ALONE = 8  # exposures that agree before an id is confirmed
MAX_COST = 50.0  # limit of a squared distance, and evidence from which a decision is made


class RayDecisions:
    """Decides on the ids of a view by epipolar distances, as they are and after an exchange."""

    def __init__(self, view: DecidedView, rays: MarkerRays) -> None:
        self._view = view
        self._rays = rays
        # By pairs of rows: evidence against an exchange, and since when it is unlikely.
        self._evidence: dict[tuple[int, int], float] = {}
        self._kept: dict[tuple[int, int], int] = {}

    def decide(
        self, exposure: MarkerExposure, known: NDArray[np.bool_], frame: int
    ) -> list[Decision]:
        """Confirm or exchange ids; known (n,): markers that bodies decide on."""
        view = self._view
        out: list[Decision] = []
        misfit = exposure.standardised[view.view]
        decidable = np.isfinite(misfit) & ~known
        for row in np.flatnonzero(decidable & exposure.doubtful[view.view]).tolist():
            (number,) = view.ids(row)
            began = view.tracker.doubted_since(number)
            if began is None:
                continue
            partners = view.tracker.partners(number)
            partner_rows = [int(np.searchsorted(view.target_id, partner)) for partner in partners]
            partner_rows = [
                partner_row
                for partner_row in partner_rows
                if partner_row != row and decidable[partner_row]
            ]
            for partner_row in partner_rows:
                if partner_row > row:
                    out += self._both_ways(exposure, (row, partner_row), frame)
            if not partner_rows and not partners - {number}:
                agrees = bool(misfit[row] < AGREE)
                if view.counts.agree(row, agrees, frame, began) >= DECIDED_ALONE:
                    out.append(view.confirm(row, frame))
        rows = np.flatnonzero(decidable)
        disagreeing = misfit[rows] > DISAGREE
        view.counts.disagree(disagreeing, rows)
        view.doubt(rows[disagreeing], frame)
        return out

    def _both_ways(
        self, exposure: MarkerExposure, rows: tuple[int, int], frame: int
    ) -> list[Decision]:
        """Compare the epipolar distances of two markers of a view with those after an exchange."""
        view = self._view
        exchanged_misfit = self._rays.exchanged(exposure, view.view, rows)
        misfit = exposure.standardised[view.view, list(rows)]
        if not (misfit < AGREE).all() and not (exchanged_misfit < AGREE).all():
            # One of them is another object; this exposure is no evidence for the other exposures.
            if rows in self._evidence:
                self._kept[rows] = frame + 1
            return []
        kept_cost = np.minimum(misfit**2, MAX_COST).sum()
        exchanged_cost = np.minimum(
            np.nan_to_num(exchanged_misfit, nan=np.inf) ** 2, MAX_COST
        ).sum()
        if exchanged_cost < kept_cost or rows not in self._evidence:
            self._kept[rows] = frame
        self._evidence[rows] = self._evidence.get(rows, 0.0) + float(exchanged_cost - kept_cost)
        if abs(self._evidence[rows]) < MAX_COST:
            return []
        exchanged = self._evidence.pop(rows) < 0
        since = self._kept.pop(rows)
        out = []
        if exchanged:
            out.append(view.exchange(rows, frame, view.doubted_since(rows, frame)))
            since = frame
        ids = view.ids(*rows)
        view.tracker.part(*ids)
        for number in ids:
            if view.tracker.doubted_since(number) is None:
                out.append(Decision('confirmed', view.name, frame, since, (number,)))
        return out
