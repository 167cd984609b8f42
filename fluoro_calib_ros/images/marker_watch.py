# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Monitoring of marker ids: which ids an image leaves doubtful, and which it confirms."""

from __future__ import annotations

from collections.abc import Set as AbstractSet
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..findings import Finding, Kind, Place, Severity
from .marker_intensity import MAX_HALF, Shadows
from .marker_motion import (
    GIVEN_SD_PX,
    LEADERS,
    SHADOW_SD_PX,
    MarkerStates,
    MeasuredMarkers,
    Motion,
    common_shift,
    doubtful_pairs,
)

FALSE_SHADOWS = 0.02  # expected number in the gate from which a marker found again is doubtful
# Distance between predictions within which two markers share one shadow. Neither of them is
# measured until one is lost; then the other is measured, with a doubt.
MERGED_PX = 5.0


class MarkerWatch:
    """Notes which ids may be wrong after each image.

    Parameters
    ----------
    target_id : (n,) ndarray
    doubts : MarkerDoubts
        Doubts in these markers; new doubts are added.
    gate : float
        Largest distance of a marker from its prediction [standard deviations].
    margin : float
        Difference of twice the log-likelihood below which two ids may have been exchanged.
    lost_after : int
        Images without a marker after which it is lost.
    density : float
        Density of false shadows [1/px^2].
    """

    def __init__(
        self,
        target_id: NDArray[np.int64],
        doubts: MarkerDoubts,
        *,
        gate: float,
        margin: float,
        lost_after: int,
        density: float,
    ) -> None:
        self._target_id = target_id
        self._doubts = doubts
        self._company = MarkerCompany(len(target_id))
        self._gate = gate
        self._margin = margin
        self._lost_after = lost_after
        self._density = density

    def shadows_met(
        self,
        markers: MeasuredMarkers,
        states: MarkerStates,
        frame: int,
        is_first: bool = False,
    ) -> tuple[MeasuredMarkers, tuple[Finding, ...]]:
        """Note which markers may have been exchanged in an image.

        A measurement that may belong to an unseen neighbouring marker is revoked. is_first: True
        if places are not predicted, but given, to a pixel or two.
        """
        motion = states.motion
        measured = markers.measured.copy()
        out = []
        variance = motion.innovation_variance(markers.sigma)
        pairs = doubtful_pairs(motion.uv, variance, measured, markers.uv, self._margin)
        # Exchanges are only recognised where a place was given, or a velocity is known.
        settled = motion.settled | is_first | (states.placed == 0)
        distances = np.linalg.norm(motion.uv[pairs[:, 0]] - motion.uv[pairs[:, 1]], axis=1)
        for (i, j), distance in zip(pairs.tolist(), distances.tolist()):
            both_settled = settled[i] and settled[j]
            if measured[i] and measured[j]:
                if not both_settled:
                    continue
            else:
                if not (both_settled or distance < MERGED_PX):
                    continue
                if max(states.unseen[i], states.unseen[j]) <= self._lost_after:
                    measured[i] = measured[j] = False
                    continue
            if j not in self._doubts.partners(i):
                self._doubts.add_pair(i, j, frame)
                ids = (int(self._target_id[i]), int(self._target_id[j]))
                out.append(doubt_in(Kind.SHADOWS_MET, frame, *ids))
        return replace(markers, measured=measured), tuple(out)

    def recovered(
        self, measured: MeasuredMarkers, states: MarkerStates, frame: int
    ) -> tuple[Finding, ...]:
        """Note which newly seen markers may be another shadow in their gate.

        It may be a false one, or that of another marker that was not seen.
        """
        out = []
        again = states.unseen > 1
        for row in np.flatnonzero(measured.measured & again).tolist():
            density = self._density + density_of_others(states.motion, row, again)
            area = np.pi * self._gate**2 * states.motion.variance[row]
            if area * density > FALSE_SHADOWS and row not in self._doubts.partners(row):
                images = int(states.unseen[row]) - 1
                out.append(self._doubt(Kind.MARKER_FOUND_AGAIN, row, frame, images=images))
        return tuple(out)

    def other_shadows(
        self, measured: MeasuredMarkers, states: MarkerStates, frame: int
    ) -> tuple[Finding, ...]:
        """Note which markers could as well be a shadow that is assigned to no marker."""
        motion = states.motion
        rows = np.flatnonzero(measured.measured & motion.settled)
        if not len(measured.free) or not len(rows):
            return ()
        variance = motion.variance[rows] + SHADOW_SD_PX**2
        # Use the places before the fit: it may move to another shadow that fits better.
        own_squared = ((motion.uv[rows] - measured.shadow[rows]) ** 2).sum(axis=1) / variance
        offset = motion.uv[rows][:, None] - measured.free[None]
        free_squared = (offset**2).sum(axis=2) / variance[:, None]
        out = []
        for row in rows[free_squared.min(axis=1) - own_squared < self._margin].tolist():
            if row not in self._doubts.partners(row):
                out.append(self._doubt(Kind.OTHER_SHADOW, row, frame))
        return tuple(out)

    def moving_alone(
        self, measured: MeasuredMarkers, states: MarkerStates, frame: int, frames: int
    ) -> tuple[Finding, ...]:
        """Doubt markers that move unlike their former company, and confirm some that move with it.

        The shadow of another object, such as a screw, does not move with the bone. Markers that
        may have been exchanged with another are left to the second view. The states are those
        after the image, `frames` after the previous image.
        """
        alone, together = self._company.compare(
            states.motion, measured.measured, self._doubts.doubtful, frames
        )
        out = []
        for row in alone:
            out.append(self._doubt(Kind.MARKER_MOVES_ALONE, row, frame))
        for row in together:
            self._doubts.confirm_alone(row)
        return tuple(out)

    def _doubt(self, kind: Kind, row: int, frame: int, **numbers: int) -> Finding:
        """Note that a marker may be another object, and return the finding."""
        self._doubts.add(row, frame)
        return doubt_in(kind, frame, int(self._target_id[row]), **numbers)


def density_of_others(motion: Motion, row: int, others: NDArray[np.bool_]) -> float:
    """Return the mean density of other markers (n,) where a marker may be [1/px^2].

    It is the integral of the product of the normal distributions of two predictions.
    """
    rows = np.flatnonzero(others)
    rows = rows[rows != row]
    variance = motion.variance[rows] + motion.variance[row]
    squared = ((motion.uv[rows] - motion.uv[row]) ** 2).sum(axis=1)
    return float((np.exp(-squared / (2 * variance)) / (2 * np.pi * variance)).sum())


# Reasons why an id may be wrong.
DOUBTS = {
    Kind.SHADOWS_MET: 'their shadows overlapped and separated',
    Kind.MARKER_FOUND_AGAIN: 'found again after {images} images',
    Kind.OTHER_SHADOW: 'another shadow was as close to its prediction',
    Kind.MARKER_MOVES_ALONE: 'it no longer moves with its former neighbours',
}


class MarkerDoubts:
    """Doubts in the ids of `count` markers, by row."""

    def __init__(self, count: int) -> None:
        self._since = np.zeros(count, dtype=int)
        self._partners: list[set[int]] = [set() for _ in range(count)]

    @property
    def doubtful(self) -> NDArray[np.bool_]:
        """Whether (n,) an id may be wrong."""
        return np.array([bool(partners) for partners in self._partners], dtype=bool)

    def since(self, row: int) -> int | None:
        """Return the image since which an id may be wrong, None if it is certain."""
        return int(self._since[row]) if self._partners[row] else None

    def partners(self, row: int) -> AbstractSet[int]:
        """Return rows that a marker may be exchanged with; its own row means another object."""
        return self._partners[row]

    def add(self, row: int, frame: int) -> None:
        """Note that a marker may be another object since an image."""
        self.add_pair(row, row, frame)

    def add_pair(self, one: int, other: int, frame: int) -> None:
        """Note that two markers may have been exchanged since an image."""
        for row, partner in ((one, other), (other, one)):
            if not self._partners[row]:
                self._since[row] = frame
            self._partners[row].add(partner)

    def confirm(self, row: int) -> None:
        """Revoke all doubts in a marker."""
        for partner in self._partners[row] - {row}:
            self._partners[partner].discard(row)
        self._partners[row].clear()

    def confirm_alone(self, row: int) -> None:
        """Revoke the doubt that a marker is another object, if there is no other doubt."""
        if self._partners[row] == {row}:
            self._partners[row].clear()

    def part(self, one: int, other: int) -> None:
        """Revoke the doubt that two markers were exchanged."""
        self._partners[one].discard(other)
        self._partners[other].discard(one)


def doubt_in(kind: Kind, frame: int, *target_id: int, **numbers: int) -> Finding:
    """Return the finding that ids may be wrong from an image on."""
    place = Place((), (frame,), target_id, name='')
    cause = DOUBTS[kind].format(**numbers)
    return Finding(kind, cause, place, severity=Severity.WARNING, numbers=numbers)


STRANGE = 7.0  # squared difference of velocities over the usual one, for a marker that moves alone
STRANGE_FRAMES = 2  # consecutive images of such motion
SHARED_PX = 15.0  # motion of the others since a doubt from which the doubt can be revoked
SHARED = 0.35  # largest difference of its own motion from theirs, as a share of theirs


def follow_beside(states: MarkerStates, frames: int) -> None:
    """Give markers of unknown velocity that of their neighbours, if there are any.

    frames: number of frames since the previous image.
    """
    motion = states.motion
    unsettled = np.flatnonzero(~motion.settled & (states.placed > 0)).tolist()
    estimates = {row: velocity_beside(states, row) for row in unsettled}
    for row, estimate in estimates.items():
        if estimate is not None:
            velocity, spread = estimate
            uv = motion.uv[row] + frames * (velocity - motion.velocity[row])
            motion.redirect(row, uv, velocity, max(spread, GIVEN_SD_PX))


def velocity_beside(states: MarkerStates, row: int) -> tuple[NDArray[np.float64], float] | None:
    """Return the velocity (2,) of a marker's company and its spread; None without a company."""
    motion = states.motion
    candidates = np.flatnonzero(motion.settled & (states.unseen <= 1))
    candidates = candidates[candidates != row]
    if len(candidates) < LEADERS:
        return None
    company = motion.company(row, candidates)
    velocity = np.median(motion.velocity[company], axis=0)
    return velocity, float(np.abs(motion.velocity[company] - velocity).max())


def shift_together(states: MarkerStates, shadows: Shadows, gate: float, frames: int) -> None:
    """Shift markers of unknown velocity, or with too wide a gate to search, with their neighbours.

    A single marker could be any shadow in a wide gate; several that keep their relative places
    are hardly other shadows. frames: number of frames since the previous image.
    """
    motion = states.motion
    is_uncertain = (~motion.settled | (gate * np.sqrt(motion.variance) > MAX_HALF)) & (
        states.placed > 0
    )
    if not is_uncertain.any() or len(shadows.uv) < 2 or len(motion.uv) < 2:
        return
    tree = cKDTree(shadows.uv)
    before = motion.uv.copy()
    for row in np.flatnonzero(is_uncertain).tolist():
        neighbours = np.argsort(np.linalg.norm(before - before[row], axis=1), kind='stable')
        # If two bones overlap, half of the nearest markers belong to the other bone.
        neighbours = neighbours[(neighbours != row) & is_uncertain[neighbours]][: 2 * LEADERS]
        if not len(neighbours):
            continue
        reach = gate * float(np.sqrt(motion.variance[row]))
        shift = common_shift(before, row, neighbours, tree, reach)
        if shift is not None:
            velocity = motion.velocity[row]
            if not motion.settled[row]:
                velocity = shift / frames
            motion.redirect(row, before[row] + shift, velocity, GIVEN_SD_PX)


class MarkerCompany:
    """Compares the motions of `count` markers with those of their company."""

    def __init__(self, count: int) -> None:
        self._strange = np.zeros(count, dtype=int)  # consecutive images of different motion
        self._shared = np.zeros((count, 2))  # motion of the company since a doubt
        self._own = np.zeros((count, 2))  # motion of the marker

    def compare(
        self, motion: Motion, measured: np.ndarray, doubtful: NDArray[np.bool_], frames: int
    ) -> tuple[list[int], list[int]]:
        """Return rows that move alone from now on, and doubtful rows that do not.

        measured (n,): measured now, `frames` after the previous image; doubtful (n,): the id may
        be wrong.
        """
        rows, ratio, company_velocity = motion.strangeness(measured)
        strange = np.where(ratio > STRANGE, self._strange[rows] + 1, 0)
        self._strange[rows] = strange
        self._shared[rows] += company_velocity * frames
        self._own[rows] += motion.velocity[rows] * frames
        path_length = np.linalg.norm(self._shared[rows], axis=1)
        deviation = np.linalg.norm(self._own[rows] - self._shared[rows], axis=1)
        has_moved = path_length > SHARED_PX
        alone = rows[(strange == STRANGE_FRAMES) & ~doubtful[rows]]
        together = rows[has_moved & (deviation < SHARED * path_length) & doubtful[rows]]
        restarted = rows[has_moved | ~doubtful[rows]]
        self._shared[restarted] = 0.0
        self._own[restarted] = 0.0
        return alone.tolist(), together.tolist()
