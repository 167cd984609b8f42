# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""First image of markers: where they are, what they look like, and how noisy the image is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import DataError
from .marker_intensity import MarkerLook, learn_look, search_image
from .marker_motion import Motion, assign
from .marker_search import SHARE
from .marker_states import MarkerStates
from .measurement import estimate_noise, estimate_profile
from .shadow_fit import Noise
from .shadow_profile import Profile

FIRST_SD_PX = 1.5  # of a given place of the first frame
FIRST_GATE = 3.0  # standard deviations from a given place, within which its shadow is
MIN_DENSITY = 2e-6  # of false shadows [1/px^2]


@dataclass(frozen=True)
class MarkerStart:
    """What the first image says of the markers.

    Attributes
    ----------
    states : MarkerStates
    look : MarkerLook
    profile : Profile
        Shadow of a typical marker.
    noise : Noise
    size : tuple of int
        Width and height of the images [px].
    density : float
        Of false shadows [1/px^2].
    """

    states: MarkerStates
    look: MarkerLook
    profile: Profile
    noise: Noise
    size: tuple[int, int]
    density: float


def learn_start(image: np.ndarray, target_id: np.ndarray, uv: np.ndarray) -> MarkerStart:
    """Learn from an image with markers near uv (n, 2) [px].

    Raises DataError where the markers are not there.
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
    unseen = np.ones(len(uv), dtype=int)
    unseen[row] = 0
    top = float(np.iinfo(image.dtype).max)
    light = image.astype(np.float32)
    light = top - light if look.inverted else light
    seen = place[row]
    return MarkerStart(
        MarkerStates.start(Motion.start(place, FIRST_SD_PX), unseen),
        look,
        profile=estimate_profile(light, look.field, seen, np.ones(len(seen)), look.radius_px),
        noise=estimate_noise(light, look.field),
        size=(width, height),
        density=max((len(found.uv) - len(row)) / max(look.field.sum(), 1), MIN_DENSITY),
    )
