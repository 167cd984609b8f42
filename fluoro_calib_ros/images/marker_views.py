# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Track markers in several views together: each view checks and predicts the others.

The image points of all views are corrected and intersected (`reconstruction`). Rays that do not
meet, or a marker that is away from the place in its rigid body, reveal a wrong id. The predicted
pose of a body gives the expected places of its markers, also of those that a view does not see.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import repeat

import numpy as np
from numpy.typing import NDArray

from ..bodies.body import Body
from ..correction.fluoroscope_calibration import Calibrations
from ..errors import DataError
from ..findings import Kind
from ..photogrammetry.rig_orientation import RigOrientation
from ..reconstruction.observed_noise import NoiseOfRays
from .marker_decisions import BodyDecisions, DecidedView, Decision, RayDecisions, ViewCounts
from .marker_ids import MAX_SHADOWS, find_bodies, identifiable
from .marker_intensity import check_image
from .marker_rays import (
    CalibratedRig,
    MarkerBodies,
    MarkerExposure,
    MarkerPlaces,
    MarkerRays,
)
from .markers import FirstMarkers, MarkerFrame, MarkerOptions, MarkerTracker


@dataclass(frozen=True)
class ViewsFrame:
    """Markers of one exposure of all fluoroscopes."""

    views: Mapping[str, MarkerFrame]  #: by fluoroscope
    #: decisions on the images since the doubt began; the views of this exposure already obey them
    decisions: tuple[Decision, ...] = ()


class MarkerViews:
    """Tracks markers through the images of one fluoroscope, or of several calibrated fluoroscopes.

    orientation: of the fluoroscopes; None for a single one. first: ids and places in the first
    images, by fluoroscope; None if it does not see them yet. bodies: unknown shapes are learned.
    later: ids of markers whose places are given later. Raises DataError for several fluoroscopes
    without an orientation, and for fluoroscopes that it does not contain.
    """

    def __init__(
        self,
        calibrations: Calibrations,
        orientation: RigOrientation | None,
        options: MarkerOptions | None = None,
        *,
        first: Mapping[str, FirstMarkers | None],
        bodies: Sequence[Body] = (),
        later: Sequence[int] = (),
    ) -> None:
        self.names = _names(first, orientation)
        entering = np.asarray(later, dtype=np.int64)
        self.target_id = np.unique(
            np.concatenate(
                [
                    *(markers.target_id for markers in first.values() if markers is not None),
                    *(body.target_id[body.known] for body in bodies),
                    entering,
                ]
            )
        )
        body_ids = [body.target_id for body in bodies]
        possible_ids = np.intersect1d(self.target_id, np.concatenate([*body_ids, entering]))
        self.trackers = {
            name: MarkerTracker(
                options, first=first[name], later=_later(possible_ids, first[name])
            )
            for name in self.names
        }
        self._joined: JoinedViews | None = None
        if orientation is not None and len(self.names) > 1:
            rig = CalibratedRig(
                orientation.subset(self.names),
                {name: calibrations[name] for name in self.names},
                angles={},
            )
            self._joined = JoinedViews(self.trackers, rig, self.target_id, bodies)

    def update(
        self,
        images: Mapping[str, np.ndarray | None],
        frame: int,
        angles: Mapping[str, float | None] | None = None,
    ) -> ViewsFrame:
        """Measure the markers of the next images.

        images by fluoroscope; some may be missing, after the first exposure. frame is the number
        of the exposure, which must increase. angles [rad] are those of the C-arms, for corrections
        that depend on them; None if unknown. Raises DataError as MarkerTracker.update does, and
        for an image whose size differs from that of the calibration.
        """
        joined = self._joined
        if joined is not None:
            joined.expect(images, frame, angles or {})
        trackers = self.trackers
        if all(tracker.begun for tracker in trackers.values()):
            frames = {
                name: tracker.update(images.get(name), frame) for name, tracker in trackers.items()
            }
        else:  # initialisation takes the time of ten images
            with ThreadPoolExecutor(len(trackers)) as threads:
                tracker_images = [images.get(name) for name in trackers]
                results = threads.map(
                    MarkerTracker.update, trackers.values(), tracker_images, repeat(frame)
                )
                frames = dict(zip(trackers, results))
        return ViewsFrame(frames) if joined is None else joined.decided(frames, frame)


def _later(target_id: NDArray[np.int64], first: FirstMarkers | None) -> NDArray[np.int64]:
    """Return the ids (k,) of the markers that are not given."""
    return target_id if first is None else np.setdiff1d(target_id, first.target_id)


def _names(
    first: Mapping[str, FirstMarkers | None], orientation: RigOrientation | None
) -> tuple[str, ...]:
    """Return the tracked fluoroscopes in the order of the orientation. Raises DataError."""
    if len(first) > 1 and orientation is None:
        raise DataError('several fluoroscopes are followed together only with their calibration')
    known = tuple(first) if orientation is None else orientation.fluoroscopes
    names = tuple(name for name in known if name in first)
    if not names or len(names) != len(first):
        raise DataError(
            f'markers of {", ".join(first) or "no fluoroscope"} were given, but fluoroscopes of '
            f'{", ".join(known) or "no orientation"} are followed together'
        )
    return names


class JoinedViews:
    """Joint knowledge of calibrated views: predictions before, decisions after an exposure.

    target_id: (n,) ids of the markers of all views, ascending.
    """

    def __init__(
        self,
        trackers: Mapping[str, MarkerTracker],
        rig: CalibratedRig,
        target_id: NDArray[np.int64],
        bodies: Sequence[Body],
    ) -> None:
        self._views = [
            DecidedView(view, name, tracker, target_id, ViewCounts(len(target_id)))
            for view, (name, tracker) in enumerate(trackers.items())
        ]
        self._target_id = target_id
        # At the angles of the last exposure, and of the previous one.
        self._rig = rig
        self._rig_before = rig
        self._rays = MarkerRays(rig, target_id)
        names = rig.orientation.fluoroscopes
        widths = [rig.calibrations[name].image_size[0] for name in names]
        self._noise = NoiseOfRays(rig.orientation, widths)
        self._bodies = MarkerBodies(rig.orientation, target_id, bodies)
        self._by_body = [BodyDecisions(view) for view in self._views]
        self._by_rays = [RayDecisions(view, self._rays) for view in self._views]
        nowhere = MarkerPlaces.nowhere(len(target_id))
        self._predictions = [_ViewPredictions(nowhere, nowhere) for _ in self._views]
        self._frame = 0
        # Lost bodies are searched from this exposure on, and then after a pause of so many more.
        self._next_search = 0
        self._pause = self._views[0].tracker.options.search_every
        self._again: list[Body] = []  # found in the last exposure: another one gives their speed
        self._measured = np.zeros((len(self._views), len(target_id)), dtype=bool)
        self._missed = np.zeros(len(target_id), dtype=bool)  # of bodies that are elsewhere

    def expect(
        self,
        images: Mapping[str, np.ndarray | None],
        frame: int,
        angles: Mapping[str, float | None],
    ) -> None:
        """Suggest where to look in the next images. Raises DataError for other image sizes."""
        if self._frame == 0:
            self._check_sizes(images)
        self._rig_before, self._rig = self._rig, replace(self._rig, angles=dict(angles))
        if self._frame:
            self._suggest(frame, self._search(images, frame))

    def decided(self, frames: Mapping[str, MarkerFrame], frame: int) -> ViewsFrame:
        """Return the markers of the views after decisions by the other views."""
        exposure = self._rays.intersect(self._without_missed(frames, frame), self._rig.angles)
        self._observe_noise(exposure)
        self._bodies.update(exposure, frame)
        self._missed &= ~self._bodies.present.known  # their bodies have a pose again
        self._doubt_unsupported(exposure, frame)
        decisions = self._decide(exposure, frame)
        decided = [number for decision in decisions for number in decision.target_id]
        self._bodies.learn(exposure, exposure.sure & ~np.isin(self._target_id, decided))
        self._frame = frame
        revised = {
            view.name: view.revised(frames[view.name], decisions, frame) for view in self._views
        }
        return ViewsFrame(revised, decisions)

    def _check_sizes(self, images: Mapping[str, np.ndarray | None]) -> None:
        """Raise DataError if the size of an image differs from that of the calibration."""
        for view in self._views:
            image = images.get(view.name)
            expected = self._rig.calibrations[view.name].image_size
            if image is not None and image.shape[::-1] != tuple(expected):
                width, height = image.shape[::-1]
                raise DataError(
                    f'fluoroscope {view.name}: the image is {width} x {height} px, but the '
                    f'calibration is for {expected[0]} x {expected[1]} px'
                )

    def _without_missed(
        self, frames: Mapping[str, MarkerFrame], frame: int
    ) -> dict[str, MarkerFrame]:
        """Doubt the measured markers of bodies that are not at their expected places."""
        views = [view for view in self._views if _is_of_image(frames[view.name])]
        rows = [view.view for view in views]
        measured_before = self._measured[rows]
        for view in views:
            self._measured[view.view] = np.isin(self._target_id, frames[view.name].target_id)
        missed, by_view = self._bodies.miss(self._measured[rows], measured_before)
        if missed.any():
            self._next_search = 0
            self._pause = 1
        self._missed |= missed
        out = dict(frames)
        for view, missed_here in zip(views, by_view):
            doubted = (self._missed | missed_here) & self._measured[view.view]
            view.doubt(np.flatnonzero(doubted), frame)
            doubtful = np.isin(frames[view.name].target_id, view.tracker.doubtful())
            out[view.name] = replace(frames[view.name], doubtful=doubtful)
        return out

    def _observe_noise(self, exposure: MarkerExposure) -> None:
        """Widen the standard deviations of the next exposures by the noise that rays show."""
        views = exposure.intersected.views
        trusted = exposure.agree & ~exposure.doubtful
        self._noise.add(replace(views, uv=np.where(trusted[..., None], views.uv, np.nan)))
        for view in self._views:
            view.tracker.widen(self._noise.factor)

    def _doubt_unsupported(self, exposure: MarkerExposure, frame: int) -> None:
        """Doubt markers of bodies without a pose that no other view supports.

        These are markers that a view newly sees, all markers of a body that was found in one
        exposure only and has no speed yet, and all of a body whose other markers are supported:
        another object is among them.
        """
        unknown = self._bodies.unplaced()
        supported = np.asarray(exposure.agree.any(axis=0))
        doubted = self._bodies.among(supported) | self._among(self._again)
        for view in self._views:
            alone = self._measured[view.view] & ~exposure.agree[view.view]
            anew = np.isin(self._target_id, view.tracker.seen_anew())
            view.doubt(np.flatnonzero(unknown & alone & (doubted | anew)), frame)

    def _among(self, bodies: Sequence[Body]) -> NDArray[np.bool_]:
        """Return (n,) whether markers belong to some of the bodies."""
        return np.isin(self._target_id, np.concatenate([[], *(b.target_id for b in bodies)]))

    def _suggest(self, frame: int, placed: NDArray[np.bool_]) -> None:
        """Suggest to each view predictions of the markers of which it is not certain.

        placed (n,): markers of bodies that have just been found.
        """
        present_places = self._bodies.present
        predicted_places = self._bodies.predicted(frame)
        for view, predicted in zip(self._views, self._predictions):
            expected = predicted_places.filled(predicted.expected(frame))
            previous = present_places.filled(predicted.places)
            rows = np.searchsorted(self._target_id, view.tracker.unsure())
            rows = rows[(expected.known & previous.known & ~placed)[rows]]
            if not len(rows):
                continue
            uv = self._rig.project(view.view, expected.xyz_mm[rows])
            uv_before = self._rig_before.project(view.view, previous.xyz_mm[rows])
            velocity = (uv - uv_before) / (frame - self._frame)
            sd = self._rig.spread(view.view, expected.xyz_mm[rows], expected.covariance[rows])
            seen = np.isfinite(velocity).all(axis=1)  # before the source in both exposures
            ids = self._target_id[rows[seen]]
            view.tracker.suggest(ids, uv[seen], velocity[seen], sd[seen])

    def _search(self, images: Mapping[str, np.ndarray | None], frame: int) -> NDArray[np.bool_]:
        """Search the whole images for bodies with a lost pose, by their shapes.

        Return (n,) which markers belong to bodies that are found.
        """
        placed = np.zeros(len(self._target_id), dtype=bool)
        wanted = {body.name: body for body in self._again}
        due = frame >= self._next_search
        if due:
            wanted |= {body.name: body for body in identifiable(self._bodies.lost())}
        if not wanted:
            return placed
        shadows = [self._shadows(view, images.get(view.name)) for view in self._views]
        if sum(view_shadows is not None for view_shadows in shadows) < 2:
            return placed
        if due:
            interval = self._views[0].tracker.options.search_every
            self._next_search = frame + self._pause
            self._pause = min(2 * self._pause, interval)
        seen = [
            np.zeros((0, 2)) if view_shadows is None else view_shadows for view_shadows in shadows
        ]
        markers, missing = find_bodies(seen, self._rig, list(wanted.values()))
        for view in self._views:
            if view.name in markers:
                view.tracker.place(markers[view.name])
        found_bodies = [body for body in wanted.values() if body.name not in missing]
        placed = self._among(found_bodies)
        self._missed &= ~placed
        names_before = [body.name for body in self._again]
        self._again = [body for body in found_bodies if body.name not in names_before]
        return placed

    def _shadows(self, view: DecidedView, image: np.ndarray | None) -> NDArray[np.float64] | None:
        """Return places (k, 2) of shadows in a view [px], None if there is no image."""
        if image is None or not view.tracker.begun:
            return None
        try:
            check_image(image, self._rig.calibrations[view.name].image_size)
        except DataError:  # the tracker reports it
            return None
        return view.tracker.shadows(image).strongest(MAX_SHADOWS).uv

    def _decide(self, exposure: MarkerExposure, frame: int) -> tuple[Decision, ...]:
        """Confirm, exchange or drop ids, by bodies if these predict a place.

        Markers of no body are expected where at least two other views intersect.
        """
        out: list[Decision] = []
        missing = ~self._bodies.present.known
        self._predictions = [
            predicted.next(self._rays.by_others(exposure, view, missing), frame)
            for view, predicted in enumerate(self._predictions)
        ]
        expected = [
            self._bodies.present.filled(predicted.places) for predicted in self._predictions
        ]
        for view, (by_body, view_places) in enumerate(zip(self._by_body, expected)):
            place = self._rig.project(view, view_places.xyz_mm)
            sd = self._rig.spread(view, view_places.xyz_mm, view_places.covariance)
            out += by_body.decide(exposure, place, sd, frame)
        for by_rays, view_places in zip(self._by_rays, expected):
            out += by_rays.decide(exposure, view_places.known | self._missed, frame)
        return tuple(out)


@dataclass(frozen=True)
class _ViewPredictions:
    """Places of the markers of a view by the other views, in the last two exposures."""

    places: MarkerPlaces
    before: MarkerPlaces
    frame: int = 0
    frame_before: int = 0

    def next(self, places: MarkerPlaces, frame: int) -> _ViewPredictions:
        """Return the places after another exposure."""
        return _ViewPredictions(places, self.places, frame, self.frame)

    def expected(self, frame: int) -> MarkerPlaces:
        """Return the expected places of the markers in the next exposure."""
        share = (frame - self.frame) / max(self.frame - self.frame_before, 1)
        return self.places.moved_on(self.before, share)


def _is_of_image(markers: MarkerFrame) -> bool:
    """Return whether there was an image in which something could be seen."""
    return markers.finding is None or markers.finding.kind is Kind.NO_MARKERS
