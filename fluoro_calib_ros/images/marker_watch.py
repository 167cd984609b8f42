# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Watch on the ids of markers: what an image leaves open, and what it makes sure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..findings import Finding, Kind
from .marker_company import MarkerCompany
from .marker_doubts import MarkerDoubts, doubt_in
from .marker_motion import doubtful_pairs
from .marker_states import SHADOW_SD_PX, MarkerStates, MeasuredMarkers

FALSE_SHADOWS = 0.02  # expected in the gate, from which a marker found again is doubtful
MERGED_PX = 5.0  # between predictions, within which two markers are one shadow
MERGED_FRAMES = 6  # for which neither of them is measured; then one is, with a doubt


class MarkerWatch:
    """Notes which ids may be wrong after an image.

    Parameters
    ----------
    target_id : (n,) ndarray
    doubts : MarkerDoubts
        In these markers; new ones are added.
    gate : float
        Distance from its prediction within which a marker is looked for [standard deviations].
    margin : float
        Difference of twice the log likelihood below which two ids may have been exchanged.
    density : float
        Of false shadows [1/px^2].
    """

    def __init__(
        self,
        target_id: np.ndarray,
        doubts: MarkerDoubts,
        *,
        gate: float,
        margin: float,
        density: float,
    ) -> None:
        self._target_id = target_id
        self._doubts = doubts
        self._company = MarkerCompany(len(target_id))
        self._gate = gate
        self._margin = margin
        self._density = density

    def shadows_met(
        self, found: MeasuredMarkers, states: MarkerStates, frame: int
    ) -> tuple[MeasuredMarkers, tuple[Finding, ...]]:
        """Note which markers may have been exchanged in an image.

        A measurement that may be that of a marker beside it, which is not seen, is taken back.
        """
        motion = states.motion
        measured = found.measured.copy()
        out = []
        variance = motion.innovation_variance(found.sigma)
        pairs = doubtful_pairs(motion.uv, variance, measured, found.uv, self._margin)
        # Ids of the first image are given; before a velocity is known, nothing can be said.
        settled = motion.settled
        apart = np.linalg.norm(motion.uv[pairs[:, 0]] - motion.uv[pairs[:, 1]], axis=1)
        for (one, two), distance in zip(pairs.tolist(), apart.tolist()):
            both_settled = settled[one] and settled[two]
            if measured[one] and measured[two]:
                if not both_settled:
                    continue
            else:
                if not (both_settled or distance < MERGED_PX):
                    continue
                if max(states.unseen[one], states.unseen[two]) <= MERGED_FRAMES:
                    measured[one] = measured[two] = False
                    continue
            if two not in self._doubts.partners(one):
                self._doubts.add_pair(one, two, frame)
                ids = (int(self._target_id[one]), int(self._target_id[two]))
                out.append(doubt_in(Kind.SHADOWS_MET, frame, *ids))
        return replace(found, measured=measured), tuple(out)

    def found_again(
        self, found: MeasuredMarkers, states: MarkerStates, frame: int
    ) -> tuple[Finding, ...]:
        """Note which markers, unseen before, may be a false shadow in their gate."""
        out = []
        for row in np.flatnonzero(found.measured & (states.unseen > 1)).tolist():
            area = np.pi * self._gate**2 * states.motion.variance[row]
            if area * self._density > FALSE_SHADOWS and row not in self._doubts.partners(row):
                images = int(states.unseen[row]) - 1
                out.append(self._doubt(Kind.MARKER_FOUND_AGAIN, row, frame, images=images))
        return tuple(out)

    def other_shadows(
        self, found: MeasuredMarkers, states: MarkerStates, frame: int
    ) -> tuple[Finding, ...]:
        """Note which markers could as well be a shadow that no marker has."""
        motion = states.motion
        rows = np.flatnonzero(found.measured & motion.settled)
        if not len(found.free) or not len(rows):
            return ()
        variance = motion.variance[rows] + SHADOW_SD_PX**2
        own = ((motion.uv[rows] - found.uv[rows]) ** 2).sum(axis=1) / variance
        away = motion.uv[rows][:, None] - found.free[None]
        other = (away**2).sum(axis=2) / variance[:, None]
        out = []
        for row in rows[other.min(axis=1) - own < self._margin].tolist():
            if row not in self._doubts.partners(row):
                out.append(self._doubt(Kind.OTHER_SHADOW, row, frame))
        return tuple(out)

    def moving_alone(
        self, found: MeasuredMarkers, states: MarkerStates, frame: int, frames: int
    ) -> tuple[Finding, ...]:
        """Doubt markers that move unlike those they moved with, and confirm some that do not.

        A shadow that is none of a marker, such as a screw, does not move with the bone. Markers
        that may have been exchanged with another are left to the second view. The states are
        those after the image, frames after the image before.
        """
        alone, together = self._company.compare(
            states.motion, found.measured, self._doubts.doubtful, frames
        )
        out = []
        for row in alone:
            out.append(self._doubt(Kind.MARKER_MOVES_ALONE, row, frame))
        for row in together:
            self._doubts.confirm_alone(row)
        return tuple(out)

    def _doubt(self, kind: Kind, row: int, frame: int, **numbers: int) -> Finding:
        """Note that a marker may be something else, and return why."""
        self._doubts.add(row, frame)
        return doubt_in(kind, frame, int(self._target_id[row]), **numbers)
