# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Markers that move together: they place each other, and one that moves alone is doubted."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from .marker_intensity import Shadows
from .marker_motion import Motion, common_shift
from .marker_states import MarkerStates

WIDE_PX = 8.0  # standard deviation of a prediction from which markers beside help
BESIDE = 8
MIN_BESIDE = 4
MAX_SHIFT_PX = 60.0
SHIFTED_SD_PX = 1.2
STRANGE = 7.0  # squared difference of velocities, over what it used to be
STRANGE_FRAMES = 2
SHARED_PX = 15.0  # way of the others since a doubt, after which a marker is no other shadow
SHARED = 0.35  # if its own way differs by less than this share


def follow_beside(states: MarkerStates, frames: int) -> None:
    """Give markers of unknown velocity that of those beside them, if there are some.

    frames is the number of them since the image before.
    """
    motion = states.motion
    known = np.flatnonzero(motion.settled & (states.unseen <= 1))
    if len(known) < MIN_BESIDE:
        return
    for row in np.flatnonzero(~motion.settled).tolist():
        away = np.linalg.norm(motion.uv[known] - motion.uv[row], axis=1)
        beside = known[np.argsort(away, kind='stable')[:MIN_BESIDE]]
        velocity = np.median(motion.velocity[beside], axis=0)
        spread = float(np.abs(motion.velocity[beside] - velocity).max())
        uv = motion.uv[row] + frames * (velocity - motion.velocity[row])
        motion.redirect(row, uv, velocity, max(spread, SHIFTED_SD_PX))


def shift_together(motion: Motion, found: Shadows, gate: float, frames: int) -> None:
    """Move markers whose velocity is not known, or that are lost, with those beside them.

    One alone could be any shadow in a wide gate; several that keep their places to each other
    are hardly others. frames is the number of them since the image before.
    """
    wide = ~motion.settled | (motion.variance > WIDE_PX**2)
    if not wide.any() or len(found.uv) < 2 or len(motion.uv) < 2:
        return
    tree = cKDTree(found.uv)
    before = motion.uv.copy()
    for row in np.flatnonzero(wide).tolist():
        beside = np.argsort(np.linalg.norm(before - before[row], axis=1), kind='stable')
        beside = beside[(beside != row) & wide[beside]][:BESIDE]
        if not len(beside):
            continue
        reach = min(gate * float(np.sqrt(motion.variance[row])), MAX_SHIFT_PX)
        shift = common_shift(before, row, beside, tree, reach)
        if shift is not None:
            velocity = motion.velocity[row]
            if not motion.settled[row]:
                velocity = shift / frames
            motion.redirect(row, before[row] + shift, velocity, SHIFTED_SD_PX)


class MarkerCompany:
    """Compares the ways of count markers with those of the markers that they move with."""

    def __init__(self, count: int) -> None:
        self._strange = np.zeros(count, dtype=int)  # images in which one moves unlike them
        self._shared = np.zeros((count, 2))  # way of these since a doubt
        self._own = np.zeros((count, 2))  # its own way

    def compare(
        self, motion: Motion, measured: np.ndarray, doubtful: np.ndarray, frames: int
    ) -> tuple[list[int], list[int]]:
        """Return rows that move alone from now on, and doubtful ones that do not.

        measured (n,) were measured now, frames after the image before; doubtful (n,) are those
        whose id may be wrong.
        """
        rows, ratio, others = motion.strangeness(measured)
        strange = np.where(ratio > STRANGE, self._strange[rows] + 1, 0)
        self._strange[rows] = strange
        self._shared[rows] += others * frames
        self._own[rows] += motion.velocity[rows] * frames
        way = np.linalg.norm(self._shared[rows], axis=1)
        apart = np.linalg.norm(self._own[rows] - self._shared[rows], axis=1)
        far = way > SHARED_PX
        alone = rows[(strange == STRANGE_FRAMES) & ~doubtful[rows]]
        together = rows[far & (apart < SHARED * way) & doubtful[rows]]
        anew = rows[far | ~doubtful[rows]]
        self._shared[anew] = 0.0
        self._own[anew] = 0.0
        return alone.tolist(), together.tolist()
