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

"""Follow markers in two views together: each view checks and predicts the other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..calibration.result import FluoroscopeCalibration
from ..drift.clusters import Cluster
from ..photogrammetry.rig_orientation import RigOrientation
from .markers import FirstMarkers, MarkerFrame, MarkerOptions, MarkerTracker


@dataclass(frozen=True)
class PairFrame:
    """Markers of one exposure of two fluoroscopes.

    Attributes
    ----------
    views : mapping of str to MarkerFrame
        By fluoroscope.
    exchanged : tuple of (str, int, int)
        Fluoroscope and two ids that were exchanged with this exposure.
    confirmed : tuple of (str, int)
        Ids whose doubt was taken back.
    dropped : tuple of (str, int)
        Markers that were found to be something else.
    """

    views: Mapping[str, MarkerFrame]
    exchanged: tuple[tuple[str, int, int], ...] = ()
    confirmed: tuple[tuple[str, int], ...] = ()
    dropped: tuple[tuple[str, int], ...] = ()


class MarkerPair:
    """Follows markers through the images of two calibrated fluoroscopes.

    Parameters
    ----------
    calibrations : mapping of str to FluoroscopeCalibration
        Of two fluoroscopes.
    orientation : RigOrientation
        That they belong to.
    options : MarkerOptions, optional
    first : mapping of str to FirstMarkers
        Ids and places in the first images.
    clusters : sequence of Cluster
        Markers that are rigid together.
    """

    def __init__(
        self,
        calibrations: Mapping[str, FluoroscopeCalibration],
        orientation: RigOrientation,
        options: MarkerOptions | None = None,
        *,
        first: Mapping[str, FirstMarkers],
        clusters: Sequence[Cluster] = (),
    ) -> None:
        self.orientation = orientation.subset(list(first))
        self.calibrations = calibrations
        self.clusters = tuple(clusters)
        self.trackers = {name: MarkerTracker(options, first=first[name]) for name in first}

    def update(self, images: Mapping[str, np.ndarray], frame: int) -> PairFrame:
        """Measure the markers of the next images, by fluoroscope. Raises DataError."""
        return PairFrame(
            {name: tracker.update(images[name], frame) for name, tracker in self.trackers.items()}
        )
