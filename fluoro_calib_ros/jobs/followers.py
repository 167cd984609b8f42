# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Tracking of phantoms and of moving markers from image to image, live and offline.

Each image uses the results of earlier images. A recording is treated as a stream that ends: jobs
pass its images to the follower of phantoms, or to the views in that of markers, as the extraction
node does with those of a camera.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from ..bodies.body import Body
from ..correction.fluoroscope_calibration import Calibrations
from ..errors import DataError
from ..exposures.frame import image_size_error
from ..exposures.phantom import Phantom
from ..findings import Finding, Kind, Place
from ..images.extraction import Extraction, Nearby, extract_beads
from ..images.following import Far, moved_on
from ..images.lattice import FlatGrid
from ..images.marker_decisions import Decision, EarlierImages, Retraction
from ..images.marker_ids import identifiable, identify_markers
from ..images.marker_views import MarkerViews, ViewsFrame
from ..images.markers import FirstMarkers, MarkerFrame, MarkerOptions
from ..images.matching import PhantomModel
from ..images.overlay import draw_markers, draw_overlay
from ..images.view import Lens, View, assumed_lens, lacks_certain_pose, shared_lens
from ..photogrammetry.plane_resection import is_flat
from ..photogrammetry.rig_orientation import RigOrientation
from ..processes import OF_STREAM, WorkerProcess


@dataclass(frozen=True)
class Observations:
    """Observations in one image."""

    #: (n,)
    target_id: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    #: (n, 2), centres [px]
    uv: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))
    #: (n,), standard deviation of a coordinate [px]
    sigma: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    overlapped: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))  #: (n,)
    finding: Finding | None = None  #: why there are no observations; None if there are
    #: remark on the observations, such as ids that may have been exchanged
    note: str = ''
    expected: int = 0  #: number of targets that should be visible
    #: fraction of the expected targets that were found, and of found targets that were expected
    found: float = 0.0
    explained: float = 0.0
    view: View | None = None  #: view of the phantom
    followed: bool = False  #: whether tracking started from the previous image
    bent_px: float = 0.0  #: see Extraction
    doubtful: int = 0  #: number of targets whose id may be wrong
    #: ids in earlier images of the fluoroscope that this image has shown to be wrong
    retracted: tuple[Retraction, ...] = ()
    #: (h, w, 3), overlay of uint8 in BGR order, if requested
    picture: NDArray[np.uint8] | None = None
    seconds: float = 0.0

    @property
    def reason(self) -> str:
        """Why there are no observations, without the place; '' if there are."""
        return '' if self.finding is None else self.finding.cause


@dataclass(frozen=True)
class PhantomSettings:
    """Settings from which a PhantomFollower is created."""

    fluoroscope: str
    phantom: Phantom
    principal_distance_px: float | None = None  #: None if unknown
    #: assumed lens for a recording, whose images all arrive; None for a stream, whose images may
    #: be shed, and whose distortion is used if a pose is not found
    lens: Lens | None = None
    regular_grid: bool = False  #: the phantom is a regular flat grid

    @property
    def names(self) -> tuple[str, ...]:
        """Name of the fluoroscope, as a tuple."""
        return (self.fluoroscope,)

    @property
    def parts(self) -> list[PhantomSettings]:
        """Settings for each part of the phantom.

        If one of several is not flat, grids are accepted at any offset: they serve the correction,
        and the others determine the orientation.
        """
        parts = self.phantom.parts()
        if len(parts) == 1:
            return [self]
        in_space = not all(is_flat(part.xyz_mm) for part in parts)
        return [
            replace(
                self,
                phantom=part,
                regular_grid=in_space and FlatGrid.of(part.xyz_mm) is not None,
            )
            for part in parts
        ]

    def __call__(self) -> PhantomFollower | PartsFollower:
        """Return a new follower, of the parts if the phantom has several."""
        parts = self.parts
        return PhantomFollower(self) if len(parts) == 1 else PartsFollower(parts)


class PhantomFollower:
    """Extracts the beads of a phantom, starting from the previous pose if there is one."""

    def __init__(self, settings: PhantomSettings) -> None:
        phantom = settings.phantom
        diameters = None if phantom.diameter_mm is None else phantom.diameter_mm.tobytes()
        beads = phantom.xyz_mm.tobytes(), phantom.sd_mm.tobytes()
        self._settings = settings
        self._model = _model_of(*beads, diameters, regular=settings.regular_grid)
        self._lens = settings.lens
        # Views of solved images whose distortion is used if a pose is not found.
        self._views: deque[View] = deque(maxlen=30)
        self._near: Nearby | None = None
        # Numbers and views of the last two solved exposures.
        self._track: deque[tuple[int, View]] = deque(maxlen=2)

    def extract(
        self,
        images: Mapping[str, np.ndarray],
        number: int,
        overlays: Collection[str] = (),
        angles: Mapping[str, float | None] | None = None,
    ) -> dict[str, Observations]:
        """Return the observations in the images of an exposure; never raises DataError.

        Parameters
        ----------
        images : mapping of str to (h, w) ndarray of uint8 or uint16
            By fluoroscope.
        number : int
            Exposure number; it increases, and gaps show how many exposures were skipped.
        overlays : collection of str
            Fluoroscopes for which overlays are wanted.
        angles : mapping of str to float or None
            Angles of the C-arms [rad], None if unknown.
        """
        name = self._settings.fluoroscope
        return {name: self._observations(images[name], number, name in overlays)}

    def _observations(self, image: np.ndarray, number: int, overlay: bool) -> Observations:
        start = time.perf_counter()
        extraction: Extraction | None = None
        try:
            extraction = self._extraction(image, number)
            result = self._observed(extraction)
            self._near = extraction.nearby
            self._track.append((number, extraction.view))
            self._views.append(extraction.view)
        except DataError as error:
            result = Observations(finding=error.finding)
        picture = draw_overlay(image, extraction, result.reason) if overlay else None
        return replace(result, picture=picture, seconds=time.perf_counter() - start)

    def _extraction(self, image: np.ndarray, number: int) -> Extraction:
        """Extract the beads; in a stream, retry with the distortion of earlier images if needed.

        Raises DataError.
        """
        lens = self._lens_of((image.shape[1], image.shape[0]))
        try:
            return extract_beads(image, self._model, lens, self._nearby(number))
        except DataError as error:
            is_stream = self._settings.lens is None
            shared = shared_lens(lens, list(self._views)) if is_stream else None
            if shared is None or not lacks_certain_pose(error.finding):
                raise
            return extract_beads(image, self._model, shared)

    def _lens_of(self, size: tuple[int, int]) -> Lens:
        """Return the assumed lens. Raises DataError if the image size of a recording changes."""
        lens = self._settings.lens
        error = '' if lens is None else image_size_error(size, lens.image_size, 'the first one is')
        if error:
            raise DataError(error)
        if self._lens is None or self._lens.image_size != size:
            self._lens = assumed_lens(size, self._settings.principal_distance_px)
            self._views.clear()
            self._track.clear()
            self._near = None
        return self._lens

    def _nearby(self, number: int) -> Nearby | None:
        """Return the previous exposure, and the predicted view after skipped exposures."""
        if self._near is None or self._settings.lens is not None:
            return self._near
        last, view = self._track[-1]
        if number <= last + 1:
            return self._near
        first, view_before = self._track[0]
        predicted: View | None = None
        if first < last:
            centre = self._model.xyz.mean(axis=0)
            predicted = moved_on(view_before, view, centre, (number - last) / (last - first))
        return replace(self._near, far=Far(predicted))

    def _observed(self, extraction: Extraction) -> Observations:
        return Observations(
            self._settings.phantom.target_id[extraction.bead],
            extraction.uv,
            extraction.sigma,
            extraction.overlapped,
            expected=extraction.match.expected,
            found=extraction.match.found,
            explained=extraction.match.explained,
            view=extraction.view,
            followed=extraction.followed,
            bent_px=extraction.bent_px,
        )


class PartsFollower:
    """Extracts the beads of a phantom with several parts, of which an image shows one.

    The part of the previous image is tried first.
    """

    def __init__(self, parts: Sequence[PhantomSettings]) -> None:
        self._followers = deque(map(PhantomFollower, parts))

    def extract(
        self,
        images: Mapping[str, np.ndarray],
        number: int,
        overlays: Collection[str] = (),
        angles: Mapping[str, float | None] | None = None,
    ) -> dict[str, Observations]:
        """Return the observations in the images of an exposure; see PhantomFollower."""
        tried = []
        for follower in list(self._followers):
            ((name, observations),) = follower.extract(images, number, overlays).items()
            tried.append(observations)
            if observations.finding is None:
                self._followers.remove(follower)
                self._followers.appendleft(follower)
                break
        # If no part is found, the finding on that of the previous image is likely to help.
        result = tried[-1] if tried[-1].finding is None else tried[0]
        return {name: replace(result, seconds=sum(one.seconds for one in tried))}


@lru_cache(maxsize=4)
def _model_of(xyz: bytes, sd: bytes, diameters: bytes | None, regular: bool) -> PhantomModel:
    """Return a phantom prepared for matching, cached so that a worker reuses it."""
    diameter_mm = None if diameters is None else np.frombuffer(diameters)
    xyz_mm = np.frombuffer(xyz).reshape(-1, 3)
    return PhantomModel.of(xyz_mm, diameter_mm, regular, np.frombuffer(sd))


MIN_STARTED = 0.5  # minimum fraction of the given markers found in the first image
REVISED = 300  # number of last images in which late decisions can retract ids
DECIDED = {
    'exchanged': 'were exchanged, which is corrected from now on',
    'dropped': 'was confused with another object, and is searched for',
}


@dataclass(frozen=True)
class MarkerSettings:
    """Settings from which a MarkerFollower is created."""

    #: ids and positions in the first images by fluoroscope, None for one that does not see them
    #: yet; if empty, the shapes of the bodies identify the markers
    first: Mapping[str, FirstMarkers | None]
    options: MarkerOptions = field(default_factory=MarkerOptions)
    #: of several fluoroscopes
    calibrations: Calibrations = field(default_factory=dict)
    orientation: RigOrientation | None = None  #: of several fluoroscopes
    bodies: tuple[Body, ...] = ()  #: rigid groups of markers, if several fluoroscopes

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the fluoroscopes."""
        if self.first or self.orientation is None:
            return tuple(self.first)
        return self.orientation.fluoroscopes

    def __call__(self) -> MarkerFollower:
        """Return a new MarkerFollower. Raises DataError for inconsistent settings."""
        return MarkerFollower(self)


class MarkerFollower:
    """Follows markers in one view, or in several views jointly.

    It begins with the first images that show the markers at their given positions.
    """

    def __init__(self, settings: MarkerSettings) -> None:
        self._settings = settings
        for calibration in settings.calibrations.values():
            calibration.prepare()
        self._begun = False
        self._earlier = {name: EarlierImages(REVISED) for name in settings.names}
        self._renew()
        if not settings.first and not identifiable(settings.bodies):
            raise DataError(
                'there are neither given markers nor a body of four markers with known coordinates'
            )

    def _renew(self) -> None:
        """Start again. Raises DataError."""
        self._views: MarkerViews | None = None
        if self._settings.first:
            self._follow(self._settings.first)

    def _follow(self, first: Mapping[str, FirstMarkers | None]) -> MarkerViews:
        """Follow markers from their first positions. Raises DataError."""
        settings = self._settings
        self._views = MarkerViews(
            settings.calibrations,
            settings.orientation,
            settings.options,
            first=first,
            bodies=settings.bodies,
        )
        return self._views

    def extract(
        self,
        images: Mapping[str, np.ndarray],
        number: int,
        overlays: Collection[str] = (),
        angles: Mapping[str, float | None] | None = None,
    ) -> dict[str, Observations]:
        """Return the observed markers in the images of an exposure; see PhantomFollower."""
        start = time.perf_counter()
        results = self._results(images, number, overlays, angles)
        seconds = (time.perf_counter() - start) / max(len(results), 1)
        return {name: replace(result, seconds=seconds) for name, result in results.items()}

    def _results(
        self,
        images: Mapping[str, np.ndarray],
        number: int,
        overlays: Collection[str],
        angles: Mapping[str, float | None] | None,
    ) -> dict[str, Observations]:
        absent = [name for name in self._settings.names if name not in images]
        if not self._begun and absent:
            missing = _missing_views(absent)
            return {name: Observations(finding=missing) for name in images}
        try:
            views = self._views or self._identified(images, angles)
            exposure = views.update(images, number, angles)
            if not self._begun:
                self._check_start(exposure, views)
        except DataError as error:
            finding = error.finding
            return {
                name: Observations(
                    finding=finding,
                    picture=draw_overlay(image, None, str(finding)) if name in overlays else None,
                )
                for name, image in images.items()
            }
        out = {}
        for name, image in images.items():
            marker_frame = exposure.views[name]
            result = _observed(marker_frame, len(views.trackers[name].target_id))
            decisions = [d for d in exposure.decisions if d.fluoroscope == name]
            earlier = self._earlier[name]
            retracted = [retraction for d in decisions for retraction in earlier.revise(d)]
            earlier.add(marker_frame)
            notes = [result.note, *(_decision_text(d) for d in decisions if d.kind in DECIDED)]
            picture = draw_markers(image, marker_frame) if name in overlays else None
            note = '; '.join(note for note in notes if note)
            out[name] = replace(result, note=note, picture=picture, retracted=tuple(retracted))
        return out

    def _identified(
        self, images: Mapping[str, np.ndarray], angles: Mapping[str, float | None] | None
    ) -> MarkerViews:
        """Start with the bodies that are identified by their shapes. Raises DataError."""
        settings = self._settings
        assert settings.orientation is not None
        first_markers = identify_markers(
            images, settings.calibrations, settings.orientation, settings.bodies, angles
        )
        return self._follow({name: first_markers.get(name) for name in settings.names})

    def _check_start(self, exposure: ViewsFrame, views: MarkerViews) -> None:
        """Accept the first exposure, or raise DataError to wait for another."""
        for name, view in exposure.views.items():
            first_markers = views.trackers[name].first
            problem = (
                None if first_markers is None else _wrong_start(view, len(first_markers.target_id))
            )
            if problem is not None:
                self._renew()
                place = Place((name,)) if len(exposure.views) > 1 else Place()
                raise DataError(replace(problem, place=place))
        self._begun = True


def _missing_views(names: Sequence[str]) -> Finding:
    """Return the finding that views are missing in the first exposure."""
    views_text = f'views of {", ".join(names)} are' if len(names) > 1 else f'view of {names[0]} is'
    place = Place(tuple(names), name='')
    return Finding(Kind.OTHER_VIEW_MISSING, f'the {views_text} missing', place)


def _wrong_start(markers: MarkerFrame, expected: int) -> Finding | None:
    """Return why the first image does not show the given markers, None if it may do so."""
    count = len(markers.target_id)
    if markers.finding is not None or count >= MIN_STARTED * expected:
        return markers.finding
    return Finding(
        Kind.FEW_MARKERS,
        f'only {count} of {expected} markers are at their given initial positions',
        numbers={'found': count, 'expected': expected},
    )


def _decision_text(decision: Decision) -> str:
    """Return a decision in words."""
    several = len(decision.target_id) > 1
    markers = ' and '.join(map(str, decision.target_id))
    return (
        f'{"markers" if several else "marker"} {markers}, since exposure {decision.since}: '
        f'{DECIDED[decision.kind]}'
    )


def _observed(markers: MarkerFrame, expected: int) -> Observations:
    """Return a MarkerFrame as Observations."""
    finding = markers.finding
    if finding is None and not len(markers.target_id):
        finding = Finding(Kind.NO_MARKERS, 'no marker is seen')
    return Observations(
        markers.target_id,
        markers.uv,
        markers.sigma,
        markers.overlapped,
        finding=finding,
        note='; '.join(_doubt_text(doubt) for doubt in markers.doubts),
        expected=expected,
        found=len(markers.target_id) / expected,
        explained=1.0,
        followed=finding is None,
        doubtful=int(markers.doubtful.sum()),
    )


def _doubt_text(doubt: Finding) -> str:
    """Return a doubt in words."""
    markers = ' and '.join(map(str, doubt.place.target_id))
    suspicion = (
        'may have been exchanged' if len(doubt.place.target_id) > 1 else 'may be another object'
    )
    return f'markers {markers} {suspicion}: {doubt.cause}'


FollowerSettings = PhantomSettings | MarkerSettings  # picklable; calling one returns a follower


def follower_process(make: FollowerSettings) -> WorkerProcess:
    """Return a process with a follower; calling it calls `extract`."""
    return WorkerProcess(partial(_extract_of, make), 'the process of the extraction', OF_STREAM)


def _extract_of(make: FollowerSettings) -> Callable[..., dict[str, Observations]]:
    return make().extract
