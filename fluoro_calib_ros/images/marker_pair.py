# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Follow markers in two views together: each view checks and predicts the other.

The image points of both views are corrected and intersected (`reconstruction`). Two rays that do
not meet, and a marker that is not where its rigid cluster says, reveal a wrong id. A marker that
one view does not see is predicted from its cluster, whose pose is fitted to the others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..checks.cluster_watch import Cluster
from ..correction.fluoroscope_calibration import FluoroscopeCalibration
from ..errors import DataError
from ..photogrammetry.rig_orientation import RigOrientation
from .marker_bodies import MarkerBodies
from .marker_decisions import ClusterDecisions, DecidedView, Decision, RayDecisions, ViewCounts
from .marker_ids import ClusterShape
from .marker_rays import PairExposure, PairRays
from .markers import FirstMarkers, MarkerFrame, MarkerOptions, MarkerTracker

PREDICTED_SD_PX = 1.0


@dataclass(frozen=True)
class PairFrame:
    """Markers of one exposure of two fluoroscopes.

    Attributes
    ----------
    views : mapping of str to MarkerFrame
        By fluoroscope.
    decisions : tuple of Decision
        They hold for the images since the doubt began; the views of this exposure obey them.
    """

    views: Mapping[str, MarkerFrame]
    decisions: tuple[Decision, ...] = ()


class MarkerPair:
    """Follows markers through the images of two calibrated fluoroscopes.

    Parameters
    ----------
    calibrations : mapping of str to FluoroscopeCalibration
    orientation : RigOrientation
        That they belong to.
    options : MarkerOptions, optional
    first : mapping of str to FirstMarkers
        Ids and places in the first images, of two fluoroscopes.
    clusters : sequence of Cluster
        Markers that are rigid together. Their shapes are learned from the images.
    shapes : sequence of ClusterShape
        Clusters whose shapes are known.

    Raises
    ------
    DataError
        For other than two fluoroscopes, and for those without calibration.
    """

    def __init__(
        self,
        calibrations: Mapping[str, FluoroscopeCalibration],
        orientation: RigOrientation,
        options: MarkerOptions | None = None,
        *,
        first: Mapping[str, FirstMarkers],
        clusters: Sequence[Cluster] = (),
        shapes: Sequence[ClusterShape] = (),
    ) -> None:
        names = [name for name in orientation.fluoroscopes if name in first]
        if len(names) != 2 or len(first) != 2:
            raise DataError(
                f'markers of {", ".join(first) or "no fluoroscope"} were given, but two '
                f'fluoroscopes of {", ".join(orientation.fluoroscopes)} are followed together'
            )
        self.names = tuple(names)
        self.calibrations = {name: calibrations[name] for name in names}
        self.trackers = {name: MarkerTracker(options, first=first[name]) for name in names}
        self.target_id = np.unique(np.concatenate([first[name].target_id for name in names]))
        n = len(self.target_id)
        self._views = [
            DecidedView(view, name, tracker, self.target_id, ViewCounts(n))
            for view, (name, tracker) in enumerate(self.trackers.items())
        ]
        self._rays = PairRays(self.calibrations, orientation, names, self.target_id)
        self._bodies = MarkerBodies(self.target_id, clusters, shapes)
        self._paths = MarkerPaths(n)
        self._by_cluster = [ClusterDecisions(view) for view in self._views]
        self._by_rays = [RayDecisions(view, self._rays) for view in self._views]
        self._frame = 0
        # Of the C-arms [rad], in the last exposure and in the one before.
        self._angles: Mapping[str, float | None] = {}
        self._angles_before: Mapping[str, float | None] = {}

    def update(
        self,
        images: Mapping[str, np.ndarray | None],
        frame: int,
        angles: Mapping[str, float | None] | None = None,
    ) -> PairFrame:
        """Measure the markers of the next images.

        Parameters
        ----------
        images : mapping of str to ndarray or None
            By fluoroscope; one may be missing, after the first exposure.
        frame : int
            Number of the exposure, above that of the one before.
        angles : mapping of str to float or None, optional
            Of the C-arms [rad], by fluoroscope, for corrections that change with them; None where
            they are unknown.

        Returns
        -------
        PairFrame

        Raises
        ------
        DataError
            As MarkerTracker.update, and for an image of another size than the calibration's.
        """
        if self._frame == 0:
            self._check_sizes(images)
        self._angles_before, self._angles = self._angles, dict(angles or {})
        if self._frame:
            self._suggest(frame - self._frame)
        found = {
            name: tracker.update(images.get(name), frame)
            for name, tracker in self.trackers.items()
        }
        exposure = self._rays.intersect(found, self._angles)
        expected_mm = self._bodies.expected(exposure.xyz_mm, exposure.sure, exposure.agree)
        decisions = self._decide(exposure, expected_mm, frame)
        self._remember(exposure, expected_mm, decisions, frame)
        revised = {
            view.name: view.revised(found[view.name], decisions, frame) for view in self._views
        }
        return PairFrame(revised, decisions)

    def _check_sizes(self, images: Mapping[str, np.ndarray | None]) -> None:
        """Raise DataError for an image of another size than the calibration's."""
        for name in self.names:
            image = images.get(name)
            expected = self.calibrations[name].image_size
            if image is not None and image.shape[::-1] != tuple(expected):
                width, height = image.shape[::-1]
                raise DataError(
                    f'fluoroscope {name}: the image is {width} x {height} px, but the '
                    f'calibration is for {expected[0]} x {expected[1]} px'
                )

    def _suggest(self, frames: int) -> None:
        """Offer each view predictions of the markers that it is not sure of."""
        now, good = self._paths.predicted(frames)
        for view in self._views:
            rows = np.searchsorted(self.target_id, view.tracker.unsure())
            rows = rows[good[rows]]
            if not len(rows):
                continue
            before_mm = self._paths.xyz_mm[rows]
            uv = self._rays.project(view.view, now[rows], self._angles)
            before = self._rays.project(view.view, before_mm, self._angles_before)
            velocity = (uv - before) / frames
            sd = PREDICTED_SD_PX * (frames + self._paths.age[rows])
            view.tracker.suggest(self.target_id[rows], uv, velocity, sd)

    def _decide(
        self, exposure: PairExposure, expected_mm: np.ndarray, frame: int
    ) -> tuple[Decision, ...]:
        """Confirm, exchange or drop ids, by clusters (n, 3) where these say a place."""
        out: list[Decision] = []
        for view, by_cluster in enumerate(self._by_cluster):
            place = self._rays.project(view, expected_mm, self._angles)
            out += by_cluster.decide(exposure, place, frame)
        known = np.isfinite(expected_mm).all(axis=1)
        for by_rays in self._by_rays:
            out += by_rays.decide(exposure, known, frame)
        return tuple(out)

    def _remember(
        self,
        exposure: PairExposure,
        expected_mm: np.ndarray,
        decisions: Sequence[Decision],
        frame: int,
    ) -> None:
        """Update the shapes of the clusters, and places in space."""
        decided = [number for decision in decisions for number in decision.target_id]
        sure = exposure.sure & ~np.isin(self.target_id, decided)
        self._bodies.learn(exposure.xyz_mm, sure)
        place_mm = np.where(sure[:, None], exposure.xyz_mm, expected_mm)
        self._paths.update(place_mm, max(frame - self._frame, 1) if self._frame else 1)
        self._frame = frame


FORGET_VELOCITY = 0.5
MAX_AGE = 8  # exposures after the last place in space, for which it predicts
MIN_MOVES = 2  # between exposures, that give a velocity


class MarkerPaths:
    """Places and velocities of count markers in space.

    Attributes
    ----------
    xyz_mm : (n, 3) ndarray
        Last places, or where markers moved on to since; NaN where none was known.
    age : (n,) ndarray of int
        Frames since a place was known.
    """

    def __init__(self, count: int) -> None:
        self.xyz_mm = np.full((count, 3), np.nan)
        self.age = np.zeros(count, dtype=int)
        self._velocity = np.zeros((count, 3))
        self._moves = np.zeros(count, dtype=int)

    def predicted(self, frames: int) -> tuple[np.ndarray, np.ndarray]:
        """Places (n, 3) after a number of frames [mm], and which (n,) are to be relied on."""
        now = self.xyz_mm + frames * self._velocity
        good = np.isfinite(now).all(axis=1) & (self._moves >= MIN_MOVES) & (self.age <= MAX_AGE)
        return now, good

    def update(self, xyz_mm: np.ndarray, frames: int) -> None:
        """Take in places (n, 3) after a number of frames [mm], NaN for unknown."""
        now = xyz_mm.copy()
        velocity = (now - self.xyz_mm) / frames
        fresh = np.isfinite(velocity).all(axis=1)
        share = np.where(self._moves > 0, FORGET_VELOCITY, 1.0)[:, None]
        self._velocity[fresh] += (share * (velocity - self._velocity))[fresh]
        self._moves[fresh] += 1
        # A marker without a place in this exposure moves on.
        unknown = ~np.isfinite(now).all(axis=1)
        self.age = np.where(unknown, self.age + frames, 0)
        now[unknown] = (self.xyz_mm + frames * self._velocity)[unknown]
        self.xyz_mm = now
