# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Diagnose what has changed in a rig since its calibration, from the bodies that it sees.

Bodies whose shapes were learned while the rig was healthy provide scale and rigidity. Each cause
widens the prior of some unknowns by the usual size of such a change. Causes are added one by one,
the one with the largest evidence first, as long as it increases (MacKay 2003, ch. 28).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from itertools import combinations
from math import comb

import numpy as np
from numpy.typing import NDArray

from .pose_modes import with_best_modes
from .rig_adjustment import (
    ObservedBodies,
    Poses,
    Prior,
    RigAdjustment,
    RigSolution,
)
from .sizes import ChangeStatistics, Sizes, parts_of_drift, parts_of_interior, parts_of_knock

MAX_CAUSES = 3
# The search for causes ends if the probability of no further change exceeds 1 - SURE.
SURE = 0.95
# Probability of a cause below which it is not accepted, as another one also explains the data. The
# evidence of two causes depends on the units of four sizes, each known to a factor of eight.
SURE_OF_CAUSE = 1 - 8.0**-4
# Share of inliers below which a pose does not fit: most of its image points are false.
FITS = 0.5
# Number of markers solved in full, those that their derivatives make most likely.
TRIED = 3


class Cause(str, Enum):
    """Possible causes of a change; the values are written to files."""

    ORIENTATION = 'orientation'  # a fluoroscope was moved
    INTERIOR = 'interior'  # source and detector have moved relative to each other
    DISTORTION = 'distortion'  # the distortion of the image has changed
    MIGRATED = 'migrated'  # a marker is at a different place in its body
    EXCHANGED = 'exchanged'  # two markers of a body have exchanged ids
    LOOSE = 'loose'  # a marker moves relative to its body
    SOFT = 'soft'  # the markers of a body move relative to each other


# Causes of the rig; the others are of bodies, and leave the calibration of the rig unchanged.
OF_RIG = (Cause.ORIENTATION, Cause.INTERIOR, Cause.DISTORTION)


@dataclass(frozen=True)
class Change:
    """Cause and place: indices of a fluoroscope, or of a body and its markers."""

    cause: Cause
    fluoroscope: int = -1
    body: int = -1
    markers: tuple[int, ...] = ()


@dataclass(frozen=True)
class Diagnosis:
    """Result of a diagnosis."""

    changes: tuple[Change, ...]  #: ordered by evidence; empty if nothing has changed
    probability: tuple[float, ...]  #: probability of each change against its rivals
    rivals: tuple[Change | None, ...]  #: the most likely rival of each change, or None
    observed: ObservedBodies  #: observations with exchanged ids corrected
    prior: Prior
    solution: RigSolution
    noise: float  #: factor by which image points scatter more than claimed, at least 1
    no_further_probability: (
        float  #: probability of no other change; 0 if more causes were not tried
    )

    @property
    def complete(self) -> bool:
        """Whether no other cause has to be searched for."""
        return self.no_further_probability > 1 - SURE

    @property
    def sure(self) -> bool:
        """Whether the causes explain the data, and no other cause does nearly as well."""
        return self.complete and all(value > SURE_OF_CAUSE for value in self.probability)


@dataclass(frozen=True)
class _Tried:
    changes: tuple[Change, ...]
    observed: ObservedBodies
    prior: Prior
    solution: RigSolution
    # Log evidence of each change over all sizes minus that of the size in its prior, summed.
    by_size: float

    @property
    def evidence(self) -> float:
        """Log evidence, integrated over the sizes of changes."""
        return self.solution.evidence + self.by_size


class Diagnostician:
    """Determines what has changed.

    shape_scale: standard deviation of the scale of the shapes.
    """

    def __init__(self, adjustment: RigAdjustment, shape_scale: float) -> None:
        self.adjustment = adjustment
        bodies = adjustment.bodies
        self._shape_scale = shape_scale
        views = len(adjustment.orientation.fluoroscopes)
        # With two views, only the orientation of one relative to the other is observable.
        self._moved = [views - 1] if views == 2 else list(range(views))
        self._markers = [
            (row, marker) for row, body in enumerate(bodies) for marker in range(len(body.sd_mm))
        ]
        pairs = sum(comb(len(body.sd_mm), 2) for body in bodies)
        self._causes = len(self._of_rig()) + 2 * len(self._markers) + len(bodies) + pairs

    def diagnose(
        self, observed: ObservedBodies, poses: Poses, until: Sequence[Cause] = ()
    ) -> Diagnosis:
        """Diagnose what has changed, from initial poses of the bodies.

        until: causes after which the search for further causes ends.
        """
        adjustment = self.adjustment
        zero = np.zeros(adjustment.size)
        healthy = adjustment.healthy_prior(observed, self._shape_scale)
        solution = self._solve(observed, healthy, (zero, poses))
        best = _Tried((), observed, healthy, solution, 0.0)
        probability: list[float] = []
        rivals: list[Change | None] = []
        p_no_further = 1.0
        while len(best.changes) < MAX_CAUSES:
            hypotheses = self._tried(best, poses)
            chances = _probabilities([best, *hypotheses], self._causes)
            p_no_further = float(chances[0])
            if p_no_further > 1 - SURE:
                break
            winner, rival = (np.argsort(chances[1:])[::-1].tolist() + [-1])[:2]
            rivals.append(hypotheses[rival].changes[-1] if rival >= 0 else None)
            best = hypotheses[winner]
            probability.append(float(chances[1:][winner]))
            p_no_further = 0.0
            if best.changes[-1].cause in until:
                break
        return Diagnosis(
            best.changes,
            tuple(probability),
            tuple(rivals),
            best.observed,
            best.prior,
            solution=best.solution,
            noise=_noise(best.solution),
            no_further_probability=p_no_further,
        )

    # -- hypotheses

    def _tried(self, best: _Tried, first: Poses) -> list[_Tried]:
        """Solve for the additional causes that the derivatives make likely."""
        changes = [*self._changes_of_unknowns(best), *self._scattering(best)]
        changes += self._exchanges(best)
        start = np.zeros(self.adjustment.size), first
        if best.changes:  # otherwise values and poses may be wrong due to the wrong rig
            solution = best.solution
            start = solution.values, solution.poses.or_else(first, solution.inliers_of_pose > FITS)
        leader = best
        out: list[_Tried] = []
        for change in changes:
            if self._is_hopeless(change, best, leader):
                continue
            out.append(self._with(best, change, start))
            leader = max(leader, out[-1], key=lambda hypothesis: hypothesis.evidence)
        return out

    def _is_hopeless(self, change: Change, best: _Tried, leader: _Tried) -> bool:
        """Return whether a change of a body cannot compete with a leader even if all points fit.

        The evidence of other bodies does not change. All hopeless causes together do not reduce
        the certainty of the leader.
        """
        if change.cause in OF_RIG:
            return False
        losses = best.solution.losses[change.body]
        bound = best.evidence + 0.5 * float(losses[list(change.markers) or slice(None)].sum())
        deficit = (leader.evidence - bound) / _noise(leader.solution) ** 2
        return bool(deficit > np.log(self._causes / (1 - SURE_OF_CAUSE)))

    def knocks(self) -> list[Change]:
        """Return the observable changes of the orientation."""
        return [Change(Cause.ORIENTATION, f) for f in self._moved]

    def _of_rig(self) -> list[Change]:
        """Return all changes of the rig."""
        views = range(len(self.adjustment.functions))
        return self.knocks() + [Change(cause, f) for cause in OF_RIG[1:] for f in views]

    def _changes_of_unknowns(self, best: _Tried) -> list[Change]:
        """Return the changes of rig and shapes that may have evidence.

        If any of them is expected to have some, return all changes of the rig, which may be beyond
        the validity of the derivatives, and the most likely ones of markers. Do the same if the
        solution takes most image points of a pose for false matches: these have no weight in the
        derivatives.
        """
        statistics = self.adjustment.change_statistics(best.observed, best.prior, best.solution)
        is_lost = (best.solution.inliers_of_pose < FITS).any()  # due to a change, hardly by chance
        places = self._of_rig()
        places += [Change(Cause.MIGRATED, body=b, markers=(m,)) for b, m in self._markers]
        gains = [
            (self._sizes(statistics, place).evidence, place)
            for place in places
            if place not in best.changes and not _is_implied(place, best.changes)
        ]
        gains.sort(key=lambda entry: -entry[0])
        if not gains or (gains[0][0] <= 0 and not is_lost):
            return []
        rig_changes = [change for _, change in gains if change.cause in OF_RIG]
        marker_gains = [entry for entry in gains if entry[1].cause is Cause.MIGRATED][:TRIED]
        return rig_changes + [change for gain, change in marker_gains if gain > 0]

    def _scattering(self, best: _Tried) -> list[Change]:
        """Return the marker and the body that scatter most, if this is worth an unknown.

        With its own variance s^2 instead of 1, the log likelihood of n squares increases by
        n (s^2 - 1 - log s^2) / 2.
        """
        squares = best.solution.squares
        freedom = best.solution.freedom
        places = [Change(Cause.LOOSE, body=b, markers=(m,)) for b, m in self._markers]
        places += [Change(Cause.SOFT, body=row) for row in range(len(squares))]
        out: dict[Cause, tuple[float, Change]] = {}
        for change in places:
            rows = change.body, change.markers[0] if change.markers else slice(None)
            n = float(freedom[rows].sum())
            s2 = max(1.0, float(squares[rows].sum()) / max(n, 1.0))
            gain = 0.5 * n * (s2 - 1 - np.log(s2)) - 0.5 * np.log(max(n, 1.0))
            is_explained = change in best.changes or _is_implied(change, best.changes)
            if not is_explained and gain > max(0.0, out.get(change.cause, (0.0,))[0]):
                out[change.cause] = gain, change
        return [change for _, change in out.values()]

    def _exchanges(self, best: _Tried) -> list[Change]:
        """Return exchanges of markers that do not fit, in bodies where most others do."""
        inliers = best.solution.inliers
        misfitting = [
            (b, m)
            for b, m in self._markers
            if inliers[b, m] < 0.5 < np.nanmax(inliers[b], initial=0.0)
        ]
        misfitting.sort(key=lambda marker: best.solution.inliers[marker])
        pairs = [
            Change(Cause.EXCHANGED, body=b, markers=(min(m, n), max(m, n)))
            for (b, m), (c, n) in combinations(misfitting[: TRIED + 1], 2)
            if b == c
        ]
        return [change for change in pairs if change not in best.changes]

    def _with(
        self, best: _Tried, change: Change, start: tuple[NDArray[np.float64], Poses]
    ) -> _Tried:
        """Solve for a cause in addition to others, from values of the unknowns and poses."""
        observed = best.observed
        if change.cause is Cause.EXCHANGED:
            observed = observed.exchanged(change.body, *change.markers)
        prior = best.prior
        if change.cause in (Cause.LOOSE, Cause.SOFT):
            prior = replace(prior, inflation=self._inflation(best, change))
        # Start with the usual size; the solution then determines the size.
        solution = self._solve(observed, prior.widened(self.sd_of(change)), start)
        hypothesis = _Tried((*best.changes, change), observed, prior, solution, best.by_size)
        rows = self.rows_of(change)
        if not len(rows):
            return hypothesis
        sd = np.zeros(self.adjustment.size)
        sd[rows] = self._sizes(
            self.adjustment.change_statistics(observed, prior, solution), change
        ).rms
        widened = prior.widened(sd)
        start = solution.values, solution.poses
        solution = self.adjustment.refine(observed, widened, start)
        statistics = self.adjustment.change_statistics(observed, prior, solution)
        by_size = self._sizes(statistics, change).evidence - float(
            statistics.only(rows).evidence(sd[rows])
        )
        return replace(
            hypothesis, prior=widened, solution=solution, by_size=best.by_size + by_size
        )

    def _solve(
        self, observed: ObservedBodies, prior: Prior, start: tuple[NDArray[np.float64], Poses]
    ) -> RigSolution:
        solution = self.adjustment.solve(observed, prior, start)
        return with_best_modes(self.adjustment, observed, prior, solution)

    def rows_of(self, change: Change) -> NDArray[np.int64]:
        """Return the unknowns (k,) that a change affects."""
        return np.flatnonzero(self.sd_of(change))

    def _sizes(self, statistics: ChangeStatistics, change: Change) -> Sizes:
        rows = self.rows_of(change)
        return statistics.only(rows).sizes(self.parts_of(change)[:, rows])

    def sd_of(self, change: Change) -> NDArray[np.float64]:
        """Return standard deviations (K,) of the unknowns for a change of the usual size."""
        return np.asarray(np.linalg.norm(self.parts_of(change), axis=0))

    def parts_of(self, change: Change) -> NDArray[np.float64]:
        """Return standard deviations (p, K) of unknowns for parts of a change of usual size."""
        adjustment = self.adjustment
        number = np.arange(adjustment.size)
        rig_columns = number[adjustment.rig]
        parts: list[tuple[NDArray[np.int64], NDArray[np.float64] | float]] = []
        if change.cause is Cause.ORIENTATION:
            knock = parts_of_knock(adjustment.orientation, change.fluoroscope)
            parts = [(rig_columns, part) for part in knock]
        elif change.cause is Cause.INTERIOR:
            shift = parts_of_interior(adjustment.orientation, change.fluoroscope)
            parts = [(rig_columns, part) for part in shift]
        elif change.cause is Cause.DISTORTION:
            drift = number[adjustment.drift].reshape(len(adjustment.functions), -1)
            one_px = adjustment.sd_of_drift(change.fluoroscope)
            parts = [
                (drift[change.fluoroscope], np.where(part, one_px, 0.0))
                for part in parts_of_drift(adjustment.functions[change.fluoroscope])
            ]
        elif change.cause is Cause.MIGRATED:
            shape = number[adjustment.shape].reshape(adjustment.xyz.shape)
            parts = [(shape[change.body, change.markers[0]], 1.0)]  # [mm], the unit of its size
        out = np.zeros((len(parts), adjustment.size))
        for row, (columns, sd) in zip(out, parts):
            row[columns] = sd
        return out

    def _inflation(self, best: _Tried, change: Change) -> NDArray[np.float64]:
        """Return the factors by which points of a loose marker or a soft body scatter more."""
        solution = best.solution
        rows = np.zeros(solution.squares.shape, dtype=bool)
        rows[change.body, change.markers[0] if change.markers else slice(None)] = True
        factor = np.sqrt(
            solution.squares[rows].sum() / max(float(solution.freedom[rows].sum()), 1.0)
        )
        out = best.prior.inflation.copy()
        out[rows] = max(1.0, float(factor))
        return out


def _is_implied(change: Change, changes: Sequence[Change]) -> bool:
    """Return whether a change of a marker is part of another one: soft body or loose marker."""
    return change.body >= 0 and any(
        earlier.body == change.body
        and (
            earlier.cause is Cause.SOFT
            or (earlier.cause is Cause.LOOSE and earlier.markers == change.markers)
        )
        for earlier in changes
    )


def _noise(solution: RigSolution) -> float:
    """Return the factor by which image points scatter more than claimed, median over bodies."""
    by_body = solution.squares.sum(axis=1) / np.maximum(solution.freedom.sum(axis=1), 1)
    return float(np.sqrt(max(1.0, np.median(by_body[by_body > 0])))) if by_body.any() else 1.0


def _probabilities(tried: Sequence[_Tried], causes: int) -> NDArray[np.float64]:
    """Return probabilities of hypotheses, the first of which has one cause less.

    If image points scatter more than claimed, the evidence is scaled down. A loose marker or a
    soft body has one more unknown, its scatter, known to 1/sqrt(2 n) from n squares.
    """
    evidence = np.array([hypothesis.evidence for hypothesis in tried])
    noise = _noise(tried[int(np.argmax(evidence))].solution)
    log = evidence / noise**2
    for row, hypothesis in enumerate(tried[1:], 1):
        if hypothesis.changes[-1].cause in (Cause.LOOSE, Cause.SOFT):
            change = hypothesis.changes[-1]
            freedom = hypothesis.solution.freedom[change.body]
            count = freedom[change.markers[0]] if change.markers else freedom.sum()
            log[row] -= 0.5 * np.log(max(float(count), 1.0))
    log = log - log.max()
    # No further change and some further change are equally likely, and so are all causes,
    # including those that were not tried.
    prior = np.array([0.5, *([0.5 / causes] * (len(tried) - 1))])
    chance = prior * np.exp(log)
    return chance / chance.sum()
