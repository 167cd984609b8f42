# Copyright 2026 fluoro_calib_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Markers in motion, followed in the stream of one fluoroscope."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

import numpy as np

from ..errors import DataError
from ..radiographs.marker_overlay import draw_markers
from ..radiographs.markers import Doubt, FirstMarkers, MarkerFrame, MarkerOptions, MarkerTracker
from ..radiographs.overlay import draw_overlay
from .live_extraction import LiveObservations


@dataclass(frozen=True)
class MarkerSettings:
    """What a MarkerFollower is made of: ids and places in the first image, and options."""

    first: FirstMarkers
    options: MarkerOptions = field(default_factory=MarkerOptions)

    def __call__(self) -> MarkerFollower:
        """Return a new MarkerFollower."""
        return MarkerFollower(self)


class MarkerFollower:
    """Follows markers, from the first image on in which they are where they are said to be."""

    def __init__(self, settings: MarkerSettings) -> None:
        self._tracker = MarkerTracker(settings.options, first=settings.first)

    def extract(self, image: np.ndarray, number: int, overlay: bool = False) -> LiveObservations:
        """Return the markers that are seen in an image (h, w) of uint8 or uint16."""
        start = time.perf_counter()
        picture: np.ndarray | None = None
        try:
            found = self._tracker.update(image, number)
            result = _observed(found, len(self._tracker.target_id))
            picture = draw_markers(image, found) if overlay else None
        except DataError as error:
            result = LiveObservations(reason=str(error))
            picture = draw_overlay(image, None, str(error)) if overlay else None
        return replace(result, picture=picture, seconds=time.perf_counter() - start)


def _observed(found: MarkerFrame, expected: int) -> LiveObservations:
    """Return the observations of an image."""
    reason = found.reason or ('' if len(found.target_id) else 'no marker is seen')
    return LiveObservations(
        found.target_id,
        found.uv,
        found.sigma,
        found.overlapped,
        reason=reason,
        note='; '.join(_doubt_text(doubt) for doubt in found.doubts),
        expected=expected,
        found=len(found.target_id) / expected,
        explained=1.0,
        followed=not reason,
        doubtful=int(found.doubtful.sum()),
    )


def _doubt_text(doubt: Doubt) -> str:
    """Return what may be wrong, in words."""
    markers = ' and '.join(map(str, doubt.target_id))
    what = 'may have been exchanged' if len(doubt.target_id) > 1 else 'may be something else'
    return f'markers {markers} {what}: {doubt.reason}'
