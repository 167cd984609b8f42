# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""First image of markers: where they are, how they look, the noise. Search for lost ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import DataError
from .light import Light, Noise, estimate_noise
from .marker_intensity import (
    LightWindows,
    MarkerLook,
    Shadows,
    learn_look,
    search_image,
    search_windows,
)
from .marker_motion import MarkerStates, Motion, assign
from .measurement import estimate_profile
from .shadow_fit import Profile

FIRST_SD_PX = 1.5  # of a given place of the first frame
FIRST_GATE = 3.0  # standard deviations from a given place, within which its shadow is
MIN_DENSITY = 2e-6  # of false shadows [1/px^2]


@dataclass(frozen=True)
class MarkerStart:
    """What the first image says of the markers."""

    states: MarkerStates
    look: MarkerLook
    profile: Profile  #: shadow of a typical marker
    noise: Noise
    size: tuple[int, int]  #: width and height of the images [px]
    density: float  #: of false shadows [1/px^2]


NOWHERE_PX = -2e4  # where markers are whose place is not known yet


def learn_start(
    image: np.ndarray, target_id: np.ndarray, uv: np.ndarray, later: int = 0
) -> MarkerStart:
    """Learn from an image with markers near uv (n, 2) [px].

    later: number of further markers, whose places are not known yet. Raises DataError where the
    markers are not there.
    """
    height, width = image.shape
    inside = ((uv > -0.5) & (uv < np.array([width, height]) - 0.5)).all(axis=1)
    if not inside.all():
        bad = int(target_id[~inside][0])
        raise DataError(f'marker {bad} of the first frame lies outside of the image')
    look = learn_look(image, uv, len(uv))
    found = search_image(image, look, SHARE)
    variance = np.full(len(uv), FIRST_SD_PX**2)
    row, column = assign(uv, variance, found.uv, FIRST_GATE)
    if len(row) < max(1, len(uv) // 2):
        raise DataError(
            f'only {len(row)} of {len(uv)} markers of the first frame are in the image'
        )
    place = uv.copy()
    place[row] = found.uv[column]
    unseen = np.ones(len(uv) + later, dtype=int)
    unseen[row] = 0
    top = float(np.iinfo(image.dtype).max)
    light = image.astype(np.float32)
    light = top - light if look.inverted else light
    seen = place[row]
    place = np.concatenate([place, np.full((later, 2), NOWHERE_PX)])
    return MarkerStart(
        MarkerStates.start(Motion.start(place, FIRST_SD_PX), unseen),
        look,
        profile=estimate_profile(
            Light(light, look.field), seen, np.ones(len(seen)), look.radius_px
        ),
        noise=estimate_noise(light, look.field),
        size=(width, height),
        density=max((len(found.uv) - len(row)) / max(look.field.sum(), 1), MIN_DENSITY),
    )


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

    def everywhere(self, image: np.ndarray) -> Shadows:
        """Find the shadows of a whole image."""
        return search_image(image, self._look, SHARE)

    def lost(self, states: MarkerStates) -> np.ndarray:
        """Return (n,) whether markers are searched in the whole image."""
        return np.asarray(states.unseen > self._lost_after)

    def shadows(
        self, image: np.ndarray, windows: LightWindows, states: MarkerStates, number: int
    ) -> Shadows:
        """Find shadows in an image; number is that of images since the first one."""
        lost = self.lost(states)
        if lost.any() and number % self._search_every == 0:
            return self.everywhere(image)
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
