# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Markers in motion, followed in the stream of one fluoroscope, or of two that help each other."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from ..bodies.body import Body
from ..correction.fluoroscope_calibration import FluoroscopeCalibration
from ..errors import DataError
from ..findings import Finding, Kind, Place
from ..images.marker_decisions import Decision
from ..images.marker_ids import identifiable, identify_markers
from ..images.marker_pair import MarkerPair, PairFrame
from ..images.markers import FirstMarkers, MarkerFrame, MarkerOptions, MarkerTracker
from ..images.overlay import draw_markers, draw_overlay
from ..photogrammetry.rig_orientation import RigOrientation
from .live_extraction import Observations

MIN_STARTED = 0.5  # of the given markers, in the first image
DECIDED = {
    'exchanged': 'were exchanged, which is undone from now on',
    'dropped': 'is not what was followed, and is searched for',
}


@dataclass(frozen=True)
class MarkerSettings:
    """What a MarkerFollower is made of."""

    #: ids and places in the first images of one fluoroscope, or of two; empty: the shapes of the
    #: bodies tell them
    first: Mapping[str, FirstMarkers]
    options: MarkerOptions = field(default_factory=MarkerOptions)
    #: of two fluoroscopes
    calibrations: Mapping[str, FluoroscopeCalibration] = field(default_factory=dict)
    orientation: RigOrientation | None = None  #: of two fluoroscopes
    bodies: tuple[Body, ...] = ()  #: markers that are rigid together, of two fluoroscopes

    @property
    def names(self) -> tuple[str, ...]:
        """The fluoroscopes."""
        if self.first or self.orientation is None:
            return tuple(self.first)
        return self.orientation.fluoroscopes

    def __call__(self) -> MarkerFollower:
        """Return a new MarkerFollower. Raises DataError as MarkerPair."""
        return MarkerFollower(self)


class MarkerFollower:
    """Follows markers in one view, or in two that help each other.

    update() follows them from the first call on; extract() waits for images in which they are
    where they are said to be.
    """

    def __init__(self, settings: MarkerSettings) -> None:
        self._settings = settings
        self._begun = False
        self._renew()
        if not settings.first and not identifiable(settings.bodies):
            raise DataError(
                'there are neither given markers nor a body of four markers of known places'
            )

    def _renew(self) -> None:
        """Begin again. Raises DataError."""
        self._pair: MarkerPair | None = None
        self._trackers: dict[str, MarkerTracker] = {}
        if self._settings.first:
            self._follow(self._settings.first)

    def _follow(self, first: Mapping[str, FirstMarkers]) -> None:
        """Follow markers from their first places on. Raises DataError."""
        settings = self._settings
        if len(first) == 1:
            self._trackers = {
                name: MarkerTracker(settings.options, first=markers)
                for name, markers in first.items()
            }
            return
        if settings.orientation is None:
            raise DataError('two fluoroscopes are followed together only with their calibration')
        self._pair = MarkerPair(
            settings.calibrations,
            settings.orientation,
            settings.options,
            first=first,
            bodies=settings.bodies,
        )
        self._trackers = self._pair.trackers

    def update(
        self,
        images: Mapping[str, np.ndarray | None],
        number: int,
        angles: Mapping[str, float | None] | None = None,
    ) -> PairFrame:
        """Return the markers in the images of an exposure; None: an image that cannot be read.

        Parameters are those of Follower. Raises DataError.
        """
        if self._pair is not None:
            return self._pair.update(images, number, angles)
        ((name, tracker),) = self._trackers.items()
        return PairFrame({name: tracker.update(images[name], number)})

    def extract(
        self,
        images: Mapping[str, np.ndarray],
        number: int,
        overlays: Collection[str] = (),
        angles: Mapping[str, float | None] | None = None,
    ) -> dict[str, Observations]:
        """Return the markers that are seen in the images of an exposure; see Follower."""
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
        if not self._begun and len(images) < len(self._settings.names):
            missing = Finding(Kind.OTHER_VIEW_MISSING, 'the other view is missing')
            return {name: Observations(finding=missing) for name in images}
        try:
            if not self._trackers:
                self._identify(images, angles)
            exposure = self.update(images, number, angles)
            if not self._begun:
                self._check_start(exposure)
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
            found = exposure.views[name]
            result = _observed(found, len(self._trackers[name].target_id))
            decided = [d for d in exposure.decisions if d.fluoroscope == name]
            notes = [result.note, *(_decision_text(d) for d in decided if d.kind in DECIDED)]
            picture = draw_markers(image, found) if name in overlays else None
            note = '; '.join(note for note in notes if note)
            out[name] = replace(result, note=note, picture=picture)
        return out

    def _identify(
        self, images: Mapping[str, np.ndarray], angles: Mapping[str, float | None] | None
    ) -> None:
        """Begin with the bodies that are found by their shapes. Raises DataError."""
        settings = self._settings
        assert settings.orientation is not None
        self._follow(
            identify_markers(
                images, settings.calibrations, settings.orientation, settings.bodies, angles
            )
        )

    def _check_start(self, exposure: PairFrame) -> None:
        """Begin, or wait for another exposure. Raises DataError."""
        for name, view in exposure.views.items():
            problem = _wrong_start(view, len(self._trackers[name].first.target_id))
            if problem is not None:
                self._renew()
                place = Place((name,)) if self._pair is not None else Place()
                raise DataError(replace(problem, place=place))
        self._begun = True


def _wrong_start(found: MarkerFrame, expected: int) -> Finding | None:
    """Return why the first image is not that of the given markers, None where it may be."""
    count = len(found.target_id)
    if found.finding is not None or count >= MIN_STARTED * expected:
        return found.finding
    return Finding(
        Kind.FEW_MARKERS,
        f'only {count} of {expected} markers are where they are said to be at first',
        numbers={'found': count, 'expected': expected},
    )


def _decision_text(decision: Decision) -> str:
    """Return what was decided, in words."""
    several = len(decision.target_id) > 1
    markers = ' and '.join(map(str, decision.target_id))
    return (
        f'{"markers" if several else "marker"} {markers}, since exposure {decision.since}: '
        f'{DECIDED[decision.kind]}'
    )


def _observed(found: MarkerFrame, expected: int) -> Observations:
    """Return the observations of an image."""
    finding = found.finding
    if finding is None and not len(found.target_id):
        finding = Finding(Kind.NO_MARKERS, 'no marker is seen')
    return Observations(
        found.target_id,
        found.uv,
        found.sigma,
        found.overlapped,
        finding=finding,
        note='; '.join(_doubt_text(doubt) for doubt in found.doubts),
        expected=expected,
        found=len(found.target_id) / expected,
        explained=1.0,
        followed=finding is None,
        doubtful=int(found.doubtful.sum()),
    )


def _doubt_text(doubt: Finding) -> str:
    """Return what may be wrong, in words."""
    markers = ' and '.join(map(str, doubt.place.target_id))
    what = 'may have been exchanged' if len(doubt.place.target_id) > 1 else 'may be something else'
    return f'markers {markers} {what}: {doubt.cause}'
