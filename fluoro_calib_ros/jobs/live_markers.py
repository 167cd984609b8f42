# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Markers in motion, followed in the stream of one fluoroscope, or of two that help each other."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from ..calibration.result import FluoroscopeCalibration
from ..drift.clusters import Cluster
from ..errors import DataError
from ..photogrammetry.rig_orientation import RigOrientation
from ..radiographs.marker_overlay import draw_markers
from ..radiographs.marker_pair import Decision, MarkerPair, PairFrame
from ..radiographs.markers import Doubt, FirstMarkers, MarkerFrame, MarkerOptions, MarkerTracker
from ..radiographs.overlay import draw_overlay
from .live_extraction import LiveObservations
from .service_process import ServiceProcess

MIN_STARTED = 0.5  # of the given markers, in the first image
DECIDED = {
    'exchanged': 'were exchanged, which is undone from now on',
    'dropped': 'is not what was followed, and is searched for',
}


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
        self._settings = settings
        self._tracker = MarkerTracker(settings.options, first=settings.first)
        self._begun = False

    def extract(self, image: np.ndarray, number: int, overlay: bool = False) -> LiveObservations:
        """Return the markers that are seen in an image (h, w) of uint8 or uint16."""
        start = time.perf_counter()
        picture: np.ndarray | None = None
        try:
            found = self._tracker.update(image, number)
            if not self._begun:
                self._check_start(found)
            result = _observed(found, len(self._tracker.target_id))
            picture = draw_markers(image, found) if overlay else None
        except DataError as error:
            result = LiveObservations(reason=str(error))
            picture = draw_overlay(image, None, str(error)) if overlay else None
        return replace(result, picture=picture, seconds=time.perf_counter() - start)

    def _check_start(self, found: MarkerFrame) -> None:
        """Begin, or wait for another image. Raises DataError."""
        problem = _wrong_start(found, len(self._settings.first.target_id))
        if problem:
            self._tracker = MarkerTracker(self._settings.options, first=self._settings.first)
            raise DataError(problem)
        self._begun = True


@dataclass(frozen=True)
class PairSettings:
    """What a PairFollower is made of.

    Attributes
    ----------
    first : mapping of str to FirstMarkers
        Ids and places in the first images of two fluoroscopes.
    calibrations : mapping of str to FluoroscopeCalibration
    orientation : RigOrientation
    clusters : tuple of Cluster
    options : MarkerOptions
    """

    first: Mapping[str, FirstMarkers]
    calibrations: Mapping[str, FluoroscopeCalibration]
    orientation: RigOrientation
    clusters: tuple[Cluster, ...] = ()
    options: MarkerOptions = field(default_factory=MarkerOptions)

    def __call__(self) -> PairFollower:
        """Return a new PairFollower. Raises DataError as MarkerPair."""
        return PairFollower(self)


class PairFollower:
    """Follows markers in both views, from the first exposure on that shows them in both."""

    def __init__(self, settings: PairSettings) -> None:
        self._settings = settings
        self._pair = self._new_pair()
        self._begun = False

    def _new_pair(self) -> MarkerPair:
        settings = self._settings
        return MarkerPair(
            settings.calibrations,
            settings.orientation,
            settings.options,
            first=settings.first,
            clusters=settings.clusters,
        )

    def extract(
        self,
        images: Mapping[str, np.ndarray],
        number: int,
        overlays: Collection[str] = (),
        angles: Mapping[str, float | None] | None = None,
    ) -> dict[str, LiveObservations]:
        """Return the markers that are seen in the images of an exposure, by fluoroscope.

        overlays names the fluoroscopes whose pictures are wanted; angles are those of the C-arms
        [rad], None where they are unknown. Never raises DataError.
        """
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
    ) -> dict[str, LiveObservations]:
        if not self._begun and len(images) < len(self._pair.names):
            return {name: LiveObservations(reason='the other view is missing') for name in images}
        try:
            exposure = self._pair.update(images, number, angles)
            if not self._begun:
                self._check_start(exposure)
        except DataError as error:
            reason = str(error)
            return {
                name: LiveObservations(
                    reason=reason,
                    picture=draw_overlay(image, None, reason) if name in overlays else None,
                )
                for name, image in images.items()
            }
        out = {}
        for name, image in images.items():
            found = exposure.views[name]
            result = _observed(found, len(self._pair.trackers[name].target_id))
            decided = [d for d in exposure.decisions if d.fluoroscope == name]
            notes = [result.note, *(_decision_text(d) for d in decided if d.kind in DECIDED)]
            picture = draw_markers(image, found) if name in overlays else None
            note = '; '.join(note for note in notes if note)
            out[name] = replace(result, note=note, picture=picture)
        return out

    def _check_start(self, exposure: PairFrame) -> None:
        """Begin, or wait for another exposure. Raises DataError."""
        for name, view in exposure.views.items():
            problem = _wrong_start(view, len(self._settings.first[name].target_id))
            if problem:
                self._pair = self._new_pair()
                raise DataError(f'fluoroscope {name}: {problem}')
        self._begun = True


def _wrong_start(found: MarkerFrame, expected: int) -> str:
    """Return why the first image is not the one of the given markers, '' where it may be."""
    if found.reason or len(found.target_id) >= MIN_STARTED * expected:
        return found.reason
    return (
        f'only {len(found.target_id)} of {expected} markers are where they are said to be at first'
    )


def pair_process(settings: PairSettings) -> ServiceProcess:
    """Return a process that follows two views together; it is called as `extract`."""
    return ServiceProcess(partial(_extract_pair_of, settings), 'the extraction')


def _extract_pair_of(settings: PairSettings) -> Callable[..., dict[str, LiveObservations]]:
    return settings().extract


def _decision_text(decision: Decision) -> str:
    """Return what was decided, in words."""
    several = len(decision.target_id) > 1
    markers = ' and '.join(map(str, decision.target_id))
    return (
        f'{"markers" if several else "marker"} {markers}, since exposure {decision.since}: '
        f'{DECIDED[decision.kind]}'
    )


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
