# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Measurement of markers: shadows are assigned to all of them together, fitted and checked."""

from __future__ import annotations

import numpy as np
from scipy.spatial.distance import cdist

from .light import Noise
from .marker_fit import MarkerGuess, fit_markers
from .marker_intensity import LightWindows, Shadows
from .marker_motion import Motion, assign
from .marker_states import SHADOW_SD_PX, MarkerStates, MeasuredMarkers
from .shadow_fit import Beads
from .shadow_profile import Profile

LOST_SD_PX = 25.0  # of a prediction, from which only markers that move together are found again
MAX_SIGMA_PX = 0.3
MAX_MISFIT = 10.0
DEPTH = (0.5, 1.8)  # of a shadow, over that of its marker
SAME_PLACE = 0.35  # of the radius, at which two markers are one shadow


class MarkerMeasurement:
    """Measures markers in shadows that were found near them.

    Parameters
    ----------
    profile : Profile
        Shadow of a typical marker.
    noise : Noise
    gate : float
        Distance from its prediction within which a marker is looked for [standard deviations].
    shutter : float
        Share of the time between two images during which the light is on.
    """

    def __init__(self, profile: Profile, noise: Noise, *, gate: float, shutter: float) -> None:
        self.profile = profile
        self._noise = noise
        self._gate = gate
        self._shutter = shutter

    def measure(
        self, windows: LightWindows, found: Shadows, states: MarkerStates
    ) -> MeasuredMarkers:
        """Measure the markers of an image in the shadows found in it."""
        start, assigned, free = self._assign(found, states)
        self._share_shadows(start, assigned, states.motion)
        tried = np.flatnonzero(assigned)
        guess = MarkerGuess(
            start[tried],
            states.depth[tried],
            states.depth_sd[tried],
            self._shutter * states.motion.velocity[tried],
        )
        beads = fit_markers(windows, guess, self.profile, self._noise)
        measured = np.zeros(len(start), dtype=bool)
        measured[tried[self._acceptable(beads, tried, states)]] = True
        uv = start.copy()
        uv[tried] = beads.uv
        sigma = np.full(len(start), SHADOW_SD_PX)
        sigma[tried] = beads.sigma
        overlapped = np.zeros(len(start), dtype=bool)
        overlapped[tried] = beads.overlapped
        depth = states.depth.copy()
        depth[tried] = beads.depth
        return MeasuredMarkers(
            measured, uv, sigma=sigma, depth=depth, overlapped=overlapped, free=free
        )

    def _assign(
        self, found: Shadows, states: MarkerStates
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Places (n, 2) of shadows or predictions, which have one (n,), and free ones (k, 2)."""
        motion = states.motion
        variance = states.shadow_variance
        near = np.flatnonzero(variance < LOST_SD_PX**2)
        row, column = assign(motion.uv[near], variance[near], found.uv, self._gate)
        row = near[row]
        start = motion.uv.copy()
        start[row] = found.uv[column]
        assigned = np.zeros(len(start), dtype=bool)
        assigned[row] = True
        return start, assigned, np.delete(found.uv, column, axis=0)

    def _share_shadows(self, start: np.ndarray, assigned: np.ndarray, motion: Motion) -> None:
        """Let markers without a shadow share that of a marker beside them.

        Both start from their predictions, moved together so that their middle is the shadow's.
        start (n, 2) and assigned (n,) are changed.
        """
        reach = 2 * self.profile.radius_px + self.profile.blur_px
        for row in np.flatnonzero(~assigned):
            if motion.variance[row] > reach**2:
                continue
            away = np.linalg.norm(start - motion.uv[row], axis=1)
            away[~assigned] = np.inf
            other = int(np.argmin(away))
            if away[other] < reach:
                between = 0.5 * (motion.uv[row] + motion.uv[other])
                shift = start[other] - between
                start[row] = motion.uv[row] + shift
                start[other] = motion.uv[other] + shift
                assigned[row] = True

    def _acceptable(self, beads: Beads, rows: np.ndarray, states: MarkerStates) -> np.ndarray:
        """Return (k,) whether fitted shadows are those of the markers in rows (k,)."""
        relative = beads.depth / states.depth[rows]
        away = beads.uv - states.motion.uv[rows]
        variance = states.motion.innovation_variance(np.zeros(1))[rows] + beads.sigma**2
        good = beads.measured & (beads.sigma < MAX_SIGMA_PX) & (beads.misfit < MAX_MISFIT)
        good &= (away * away).sum(axis=1) < (self._gate + 1) ** 2 * variance
        good &= (relative > DEPTH[0]) & (relative < DEPTH[1])
        if len(rows) > 1:
            apart = cdist(beads.uv, beads.uv)
            np.fill_diagonal(apart, np.inf)
            good &= apart.min(axis=1) > SAME_PLACE * self.profile.radius_px
        return good
