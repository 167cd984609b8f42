# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Search of markers: shadows near their predictions, or in the whole image if one is lost."""

from __future__ import annotations

import numpy as np

from .marker_intensity import LightWindows, MarkerLook, Shadows, search_image, search_windows
from .marker_states import MarkerStates

SHARE = 0.35  # of the response to a typical marker, from which a shadow may be a marker
MIN_HALF = 4  # of a search window [px]
MAX_HALF = 48


class MarkerSearch:
    """Finds shadows where markers may be.

    Parameters
    ----------
    look : MarkerLook
    gate : float
        Half the width of a search window [standard deviations of the prediction].
    lost_after : int
        Images without a marker after which it is lost.
    search_every : int
        Images between searches of the whole image, where a marker is lost.
    """

    def __init__(
        self, look: MarkerLook, *, gate: float, lost_after: int, search_every: int
    ) -> None:
        self._look = look
        self._gate = gate
        self._lost_after = lost_after
        self._search_every = search_every

    def lost(self, states: MarkerStates) -> np.ndarray:
        """Return (n,) whether markers are searched in the whole image."""
        return np.asarray(states.unseen > self._lost_after)

    def shadows(
        self, image: np.ndarray, windows: LightWindows, states: MarkerStates, number: int
    ) -> Shadows:
        """Find shadows in an image; number is that of images since the first one."""
        lost = self.lost(states)
        if lost.any() and number % self._search_every == 0:
            return search_image(image, self._look, SHARE)
        reach = np.ceil(self._gate * np.sqrt(states.shadow_variance))
        near = ~lost | (reach <= MAX_HALF)
        if not near.any():
            return Shadows(np.zeros((0, 2)), np.zeros(0))
        half = np.clip(reach, MIN_HALF, MAX_HALF).astype(int)
        middle = np.rint(states.motion.uv).astype(int)
        parts = []
        # Few markers need wide windows; those of the others stay small.
        small = int(np.ceil(np.percentile(half[near], 75)))
        for rows in (near & (half <= small), near & (half > small)):
            if rows.any():
                size = int(half[rows].max())
                parts.append(search_windows(windows, middle[rows], size, self._look, SHARE))
        if len(parts) == 1:
            return parts[0]
        uv = np.concatenate([part.uv for part in parts])
        strength = np.concatenate([part.strength for part in parts])
        return Shadows(uv, strength).distinct() if len(uv) else parts[0]
