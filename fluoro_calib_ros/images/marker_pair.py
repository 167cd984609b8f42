# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Follow markers in two views together: each view checks and predicts the other.

The image points of both views are corrected and intersected (`reconstruction`). Two rays that do
not meet, and a marker that is not where its rigid body says, reveal a wrong id. The predicted pose
of a body tells where its markers are to be expected, also those that a view does not see.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..bodies.body import Body
from ..correction.fluoroscope_calibration import Calibrations
from ..errors import DataError
from ..photogrammetry.rig_orientation import RigOrientation
from .marker_decisions import BodyDecisions, DecidedView, Decision, RayDecisions, ViewCounts
from .marker_ids import MAX_SHADOWS, CalibratedRig, find_bodies, identifiable
from .marker_intensity import FIRST_SD_PX, check_image
from .marker_rays import MarkerBodies, PairExposure, PairRays
from .markers import FirstMarkers, MarkerFrame, MarkerOptions, MarkerTracker


@dataclass(frozen=True)
class PairFrame:
    """Markers of one exposure of two fluoroscopes."""

    views: Mapping[str, MarkerFrame]  #: by fluoroscope
    #: they hold for the images since the doubt began; the views of this exposure obey them
    decisions: tuple[Decision, ...] = ()


class MarkerPair:
    """Follows markers through the images of two calibrated fluoroscopes.

    orientation: that they belong to. first: ids and places in the first images, of two
    fluoroscopes. bodies: shapes that are not given are learned from the images. later: ids of
    markers whose places are given later. Raises DataError for other than two fluoroscopes, and for
    those without calibration.
    """

    def __init__(
        self,
        calibrations: Calibrations,
        orientation: RigOrientation,
        options: MarkerOptions | None = None,
        *,
        first: Mapping[str, FirstMarkers],
        bodies: Sequence[Body] = (),
        later: Sequence[int] = (),
    ) -> None:
        names = [name for name in orientation.fluoroscopes if name in first]
        if len(names) != 2 or len(first) != 2:
            raise DataError(
                f'markers of {", ".join(first) or "no fluoroscope"} were given, but two '
                f'fluoroscopes of {", ".join(orientation.fluoroscopes)} are followed together'
            )
        self.names = tuple(names)
        self.calibrations = {name: calibrations[name] for name in names}
        entering = np.asarray(later, dtype=np.int64)
        self.target_id = np.unique(
            np.concatenate(
                [
                    *(first[name].target_id for name in names),
                    *(body.target_id[body.known] for body in bodies),
                    entering,
                ]
            )
        )
        rigid = [body.target_id for body in bodies]
        others = np.intersect1d(self.target_id, np.concatenate([*rigid, entering]))
        self.trackers = {
            name: MarkerTracker(
                options, first=first[name], later=np.setdiff1d(others, first[name].target_id)
            )
            for name in names
        }
        n = len(self.target_id)
        self._views = [
            DecidedView(view, name, tracker, self.target_id, ViewCounts(n))
            for view, (name, tracker) in enumerate(self.trackers.items())
        ]
        self._orientation = orientation.subset(names)
        self._rays = PairRays(self.calibrations, self._orientation, names, self.target_id)
        self._bodies = MarkerBodies(self._orientation, self.target_id, bodies)
        self._by_body = [BodyDecisions(view) for view in self._views]
        self._by_rays = [RayDecisions(view, self._rays) for view in self._views]
        self._frame = 0
        self._searched = 0  # last exposure in which lost bodies were searched
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

        images by fluoroscope; one may be missing, after the first exposure. frame is the number of
        the exposure, above that of the one before. angles [rad] are those of the C-arms, for
        corrections that change with them; None where they are unknown. Raises DataError as
        MarkerTracker.update, and for an image of another size than the calibration's.
        """
        if self._frame == 0:
            self._check_sizes(images)
        self._angles_before, self._angles = self._angles, dict(angles or {})
        if self._frame:
            self._suggest(frame)
            self._search(images, frame)
        found = {
            name: tracker.update(images.get(name), frame)
            for name, tracker in self.trackers.items()
        }
        exposure = self._rays.intersect(found, self._angles)
        self._bodies.update(exposure, frame)
        decisions = self._decide(exposure, frame)
        decided = [number for decision in decisions for number in decision.target_id]
        self._bodies.learn(exposure, exposure.sure & ~np.isin(self.target_id, decided))
        self._frame = frame
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

    def _suggest(self, frame: int) -> None:
        """Offer each view predictions of the markers that it is not sure of."""
        before = self._bodies.present
        now = self._bodies.predicted(frame)
        known = now.known & before.known
        for view in self._views:
            rows = np.searchsorted(self.target_id, view.tracker.unsure())
            rows = rows[known[rows]]
            if not len(rows):
                continue
            uv = self._rays.project(view.view, now.xyz_mm[rows], self._angles)
            uv_before = self._rays.project(view.view, before.xyz_mm[rows], self._angles_before)
            velocity = (uv - uv_before) / (frame - self._frame)
            sd = self._rays.spread(view.view, now.xyz_mm[rows], now.covariance[rows])
            view.tracker.suggest(self.target_id[rows], uv, velocity, sd)

    def _search(self, images: Mapping[str, np.ndarray | None], frame: int) -> None:
        """Look in the whole images for bodies whose pose is lost, by their shapes."""
        every = next(iter(self.trackers.values())).options.search_every
        lost = identifiable(self._bodies.lost())
        if not lost or (self._searched and frame - self._searched < every):
            return
        shadows = []
        for view in self._views:
            image = images.get(view.name)
            try:
                if image is None:
                    return
                check_image(image, self.calibrations[view.name].image_size)
            except DataError:  # which the tracker tells
                return
            shadows.append(view.tracker.shadows(image).strongest(MAX_SHADOWS).uv)
        self._searched = frame
        rig = CalibratedRig(self._orientation, self.calibrations, self._angles)
        found, _ = find_bodies(shadows, rig, lost)
        for view in self._views if found else ():
            first = found[view.name]
            unseen = np.isin(first.target_id, view.tracker.unseen())
            for number in first.target_id[unseen].tolist():
                view.tracker.forget(number)
            uv = first.uv[unseen]
            sd = np.full(len(uv), FIRST_SD_PX)
            view.tracker.suggest(first.target_id[unseen], uv, np.zeros_like(uv), sd)

    def _decide(self, exposure: PairExposure, frame: int) -> tuple[Decision, ...]:
        """Confirm, exchange or drop ids, by bodies where these say a place."""
        out: list[Decision] = []
        expected = self._bodies.present
        for view, by_body in enumerate(self._by_body):
            place = self._rays.project(view, expected.xyz_mm, self._angles)
            sd = self._rays.spread(view, expected.xyz_mm, expected.covariance)
            out += by_body.decide(exposure, place, sd, frame)
        for by_rays in self._by_rays:
            out += by_rays.decide(exposure, expected.known, frame)
        return tuple(out)
