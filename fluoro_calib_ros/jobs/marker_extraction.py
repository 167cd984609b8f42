# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The marker job: observations of markers from image sequences of fluoroscopes.

Threads read images ahead, because decoding takes as long as tracking. Calibrated views are tracked
jointly, image by image, because each view predicts and checks the others. Their later decisions on
an earlier doubt are applied to the earlier images.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import groupby, repeat
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..bodies.body import Body
from ..correction.angle_field import note_on_angles
from ..correction.fluoroscope_calibration import Calibrations
from ..errors import DataError, ErrorsAt
from ..exposures.decisions import Doubtful
from ..exposures.frame import Frame, Frames
from ..exposures.phantom import Phantom
from ..findings import Finding
from ..images.codec import encode_overlay
from ..images.marker_decisions import Decision, EarlierImages
from ..images.marker_ids import identifiable, identify_markers
from ..images.marker_views import MarkerViews
from ..images.markers import FirstMarkers, MarkerFrame, MarkerOptions
from ..images.overlay import draw_markers
from ..io.access import write_bytes
from ..photogrammetry.rig_orientation import RigOrientation
from ..processes import one_core
from .extraction import Progress, make_picture_folder
from .image_sources import (
    ImageAngles,
    ImageSources,
    SourceImage,
    open_sources,
    source_of_each,
)
from .scheduling import in_order

MAX_TRIES = 30  # maximum number of exposures tried for identifying markers by their shapes


@dataclass(frozen=True)
class MarkerRequest:
    """Image sequences of one or more fluoroscopes, and their markers."""

    sources: Mapping[str, Sequence[Path]]  #: images by fluoroscope
    #: markers given in one or more exposures, by fluoroscope; tracking starts at the first
    #: exposure for which all fluoroscopes have some; markers given later enter or are re-found
    #: there
    first: Frames
    options: MarkerOptions = field(default_factory=MarkerOptions)
    #: of several fluoroscopes
    calibrations: Calibrations = field(default_factory=dict)
    orientation: RigOrientation | None = None  #: of several fluoroscopes
    #: rigid groups of markers, if several fluoroscopes; their shapes give ids if none are given
    bodies: tuple[Body, ...] = ()
    overlay: Path | None = None  #: folder for overlay pictures
    #: names of markers, for overlay pictures
    target_names: Mapping[int, str] = field(default_factory=dict)
    angles: ImageAngles = field(default_factory=ImageAngles)  #: angles of the C-arms


@dataclass(frozen=True)
class MarkerImageResult:
    """Markers of one image, its source, and the angle of its C-arm [rad]."""

    exposure: int
    place: str
    markers: MarkerFrame
    angle: float | None = None


@dataclass(frozen=True)
class DoubtfulSpan:
    """Range of exposures in which an id may be wrong."""

    fluoroscope: str
    target_id: int
    first: int  #: exposures
    last: int  #: exposures
    images: int
    #: markers with which it may be exchanged; empty if it may be something else
    others: tuple[int, ...]
    reason: str


@dataclass(frozen=True)
class MarkerOutcome:
    """Tracked markers."""

    #: by fluoroscope, ordered by exposure
    results: Mapping[str, tuple[MarkerImageResult, ...]]
    #: decisions of the views on doubtful ids, which are applied in the results
    decisions: tuple[Decision, ...]
    image_size: Mapping[str, tuple[int, int]]
    #: number of unused images before the first with given markers
    before: Mapping[str, int]
    notes: tuple[str, ...] = ()  #: notes for the user about the angles

    def frames(self) -> list[tuple[Frame, NDArray[np.bool_], NDArray[np.bool_]]]:
        """Return observations, with flags (n,) of overlapped markers and of doubtful ids."""
        out = []
        for name, results in self.results.items():
            for result in results:
                markers = result.markers
                if not len(markers.target_id):
                    continue
                frame = Frame(
                    name,
                    result.exposure,
                    markers.target_id,
                    markers.uv,
                    self.image_size[name],
                    sigma=markers.sigma,
                    angle=result.angle,
                )
                out.append((frame, markers.overlapped, markers.doubtful))
        return out

    def spans(self) -> list[DoubtfulSpan]:
        """Return the remaining doubts, by fluoroscope, marker and run of exposures."""
        out = []
        for name, results in self.results.items():
            open_spans: dict[int, DoubtfulSpan] = {}
            causes: dict[int, Finding] = {}
            for result in results:
                markers = result.markers
                for doubt in markers.doubts:
                    for target in doubt.place.target_id:
                        causes[target] = doubt
                for target in markers.target_id[~markers.doubtful].tolist():
                    if target in open_spans:
                        out.append(open_spans.pop(target))
                for target in markers.target_id[markers.doubtful].tolist():
                    span = open_spans.get(target)
                    if span is None:
                        cause = causes.get(target)
                        others = () if cause is None else cause.place.target_id
                        reason = 'the views do not agree' if cause is None else cause.cause
                        others = tuple(i for i in others if i != target)
                        span = DoubtfulSpan(
                            fluoroscope=name,
                            target_id=target,
                            first=result.exposure,
                            last=result.exposure,
                            images=0,
                            others=others,
                            reason=reason,
                        )
                    open_spans[target] = replace(
                        span, last=result.exposure, images=span.images + 1
                    )
            out += open_spans.values()
        return out


def doubtful_ids(outcome: MarkerOutcome) -> list[Doubtful]:
    """Return the remaining doubts, for the table in which a person decides on them."""
    return [
        Doubtful(s.fluoroscope, s.first, s.last, s.target_id, s.reason, others=s.others)
        for s in outcome.spans()
    ]


def sequences(
    sources: Sequence[Path], fluoroscopes: Sequence[str]
) -> tuple[dict[str, list[Path]], tuple[int, int]]:
    """Return the sources of each fluoroscope, and the size of the first image [px].

    Several fluoroscopes have one source each, or share a bag or a folder with one folder each.
    Raises DataError.
    """
    if len(fluoroscopes) == 1:
        out = {fluoroscopes[0]: list(sources)}
    elif len(sources) == len(fluoroscopes):
        out = {name: [source] for name, source in zip(fluoroscopes, sources)}
    else:
        out = {name: [path] for name, path in source_of_each(sources[0], fluoroscopes).items()}
    first = next(open_sources(out[fluoroscopes[0]], fluoroscopes[0]).images(), None)
    if first is None:
        raise DataError(f'{sources[0]}: there are no images')
    if isinstance(first.image, DataError):
        raise first.image
    return out, (first.image.shape[1], first.image.shape[0])


def shaped(bodies: Sequence[Body], phantom: Phantom, path: Path) -> tuple[Body, ...]:
    """Return bodies with the surveyed coordinates of their markers. Raises DataError."""
    out = []
    for body in bodies:
        rows = phantom.index(body.target_id)
        if (rows < 0).any():
            absent = body.target_id[rows < 0].min()
            raise DataError(f'{path}: there is no marker {absent} of cluster {body.name}')
        out.append(replace(body, xyz_mm=phantom.xyz_mm[rows], sd_mm=phantom.sd_mm[rows]))
    return tuple(out)


def run_marker_extraction(
    request: MarkerRequest, progress: Progress | None = None
) -> MarkerOutcome:
    """Track markers through the images of one or more fluoroscopes.

    An image that is damaged or of another size is skipped, and its result says why. progress is
    called after every exposure with the number of finished exposures and their total, and again
    while their pictures are written. Raises DataError for sources that cannot be read, markers
    that are not in the images, and fluoroscopes without calibration.
    """
    names = list(request.sources)
    sources = {name: open_sources(request.sources[name], name, request.angles) for name in names}
    if request.overlay is not None:
        for name in names:
            make_picture_folder(request.overlay, name, request.sources[name])
    recording = _Recording(request)
    total = max(source.count for source in sources.values())
    with one_core():
        for number, images in enumerate(_exposures(sources), 1):
            recording.add(images)
            if progress is not None:
                progress(number, max(total, number))
    outcome = recording.outcome()
    if request.overlay is not None:
        _write_pictures(request, sources, outcome, progress)
    return outcome


class _Recording:
    """Follows markers from the first exposure that shows them; revises the results."""

    def __init__(self, request: MarkerRequest) -> None:
        self._request = request
        self._names = list(request.sources)
        self._given = {
            name: {frame.number: frame for frame in request.first.get(name, ())}
            for name in self._names
        }
        self._tries = 0
        self._reason = ''
        by_shape = bool(identifiable(request.bodies)) and not request.first
        for name in self._names:
            if not self._given[name] and not by_shape:
                raise DataError(f'there are no given markers of fluoroscope {name}')
        self._views: MarkerViews | None = None
        self._results: dict[str, list[MarkerImageResult]] = {name: [] for name in self._names}
        self._earlier = {name: EarlierImages() for name in self._names}
        self._decisions: list[Decision] = []
        self._size: dict[str, tuple[int, int]] = {}
        self._before = dict.fromkeys(self._names, 0)
        self._start = None if by_shape else self._first_exposure()

    def _first_exposure(self) -> int:
        """Return the first exposure with given markers of all fluoroscopes. Raises DataError."""
        common = set.intersection(*(set(frames) for frames in self._given.values()))
        if not common:
            raise DataError(
                f'the markers of {" and ".join(self._names)} are not given for the same exposure'
            )
        return min(common)

    def add(self, images: Mapping[str, SourceImage]) -> None:
        """Track the markers through the images of one exposure, by fluoroscope."""
        exposure = next(iter(images.values())).exposure
        if self._views is None:
            first_markers = self._first_markers(images, exposure)
            if not first_markers:
                for name in images:
                    self._before[name] += 1
                return
            self._views = self._begun(images, first_markers)
        for name in images if self._results[self._names[0]] else ():
            if exposure in self._given[name]:
                self._views.trackers[name].place(self._markers(name, exposure))
        arrays = {
            name: None if isinstance(image.image, DataError) else image.image
            for name, image in images.items()
        }
        views_frame = self._views.update(arrays, exposure, _angles_of(images))
        self._decisions += views_frame.decisions
        for decision in views_frame.decisions:
            self._earlier[decision.fluoroscope].revise(decision)
        for name, image in images.items():
            view = views_frame.views[name]
            if isinstance(image.image, DataError):
                view = replace(view, finding=image.image.finding)
            result = MarkerImageResult(exposure, image.place, view, image.angle)
            self._results[name].append(result)
            self._earlier[name].add(view)

    def _first_markers(
        self, images: Mapping[str, SourceImage], exposure: int
    ) -> Mapping[str, FirstMarkers | None]:
        """Return the markers of an exposure, empty if they are unknown. Raises DataError."""
        if len(images) < len(self._names) or (self._start or exposure) != exposure:
            return {}
        if self._start is None:
            return self._by_shape(images)
        return {name: self._markers(name, exposure) for name in self._names}

    def _markers(self, name: str, exposure: int) -> FirstMarkers:
        """Return the given markers of an exposure. Raises DataError."""
        frame = self._given[name][exposure]
        with ErrorsAt(f'fluoroscope {name}, exposure {exposure}'):
            return FirstMarkers(frame.target_id, frame.uv)

    def _given_later(self) -> tuple[int, ...]:
        """Return ids of markers that are given for exposures after the first."""
        if self._start is None:
            return ()
        frames = [
            f for frames_by_number in self._given.values() for f in frames_by_number.values()
        ]
        ids = [frame.target_id for frame in frames if frame.number > self._start]
        return tuple(np.unique(np.concatenate(ids)).tolist()) if ids else ()

    def _by_shape(self, images: Mapping[str, SourceImage]) -> Mapping[str, FirstMarkers | None]:
        """Identify markers by the shapes of their bodies, in one of the first exposures."""
        request = self._request
        assert request.orientation is not None
        arrays = {name: image.image for name, image in images.items()}
        self._tries += 1
        try:
            readable = {n: a for n, a in arrays.items() if not isinstance(a, DataError)}
            if len(readable) < len(arrays):
                return {}
            first_markers = identify_markers(
                readable,
                request.calibrations,
                request.orientation,
                request.bodies,
                _angles_of(images),
            )
            return {name: first_markers.get(name) for name in self._names}
        except DataError as error:
            self._reason = self._reason or str(error)
            if self._tries >= MAX_TRIES:
                raise DataError(
                    f'the markers are in none of the first {self._tries} exposures: {self._reason}'
                ) from None
            return {}

    def _begun(
        self, images: Mapping[str, SourceImage], first: Mapping[str, FirstMarkers | None]
    ) -> MarkerViews:
        """Return views starting at the first images. Raises DataError for a damaged image."""
        for name in self._names:
            image = images[name].image
            if isinstance(image, DataError):
                raise image
            self._size[name] = (image.shape[1], image.shape[0])
        request = self._request
        return MarkerViews(
            request.calibrations,
            request.orientation,
            request.options,
            first=first,
            bodies=request.bodies,
            later=self._given_later(),
        )

    def outcome(self) -> MarkerOutcome:
        """Return all results. Raises DataError if tracking has not started."""
        if self._views is None and self._start is None:
            raise DataError(f'the markers are in no exposure: {self._reason or "no images"}')
        if self._views is None:
            raise DataError(
                f'the markers are given for exposure {self._start}, but there is no image of it '
                f'of {" and ".join(self._names)}'
            )
        return MarkerOutcome(
            {
                name: tuple(
                    replace(result, markers=markers)
                    for result, markers in zip(results, self._earlier[name], strict=True)
                )
                for name, results in self._results.items()
            },
            tuple(self._decisions),
            self._size,
            self._before,
            tuple(self._notes()),
        )

    def _notes(self) -> Iterator[str]:
        """Yield notes for the user about the angles."""
        request = self._request
        for name, results in self._results.items():
            angles = [result.angle for result in results]
            yield from request.angles.note(name, angles)
            calibration = request.calibrations.get(name)
            field = None if calibration is None else calibration.angle_field
            note = note_on_angles(
                name, field, angles, 'images', 'markers are predicted by the mean over the angles'
            )
            if note:
                yield note


def _angles_of(images: Mapping[str, SourceImage]) -> dict[str, float | None]:
    """Return the angles of the C-arms in the images of an exposure [rad], by fluoroscope."""
    return {name: image.angle for name, image in images.items()}


def _exposures(sources: Mapping[str, ImageSources]) -> Iterator[dict[str, SourceImage]]:
    """Yield the images of each exposure, by fluoroscope, ordered by exposure."""
    readers = [zip(repeat(name), _ahead(source.images())) for name, source in sources.items()]
    merged = heapq.merge(*readers, key=_exposure)
    for _, images in groupby(merged, key=_exposure):
        yield dict(images)


def _exposure(named: tuple[str, SourceImage]) -> int:
    return named[1].exposure


def _ahead(images: Iterator[SourceImage]) -> Iterator[SourceImage]:
    """Yield images that a thread reads ahead."""
    with ThreadPoolExecutor(1) as pool:
        # three at a time, until there is no more image
        ahead = in_order(lambda end: pool.submit(next, images, end), repeat(None), 3)
        yield from iter(partial(next, ahead), None)


def _write_pictures(
    request: MarkerRequest,
    sources: Mapping[str, ImageSources],
    outcome: MarkerOutcome,
    progress: Progress | None,
) -> None:
    """Write a picture of every readable image with the final ids."""
    assert request.overlay is not None
    for name, source in sources.items():
        markers_by_exposure = {result.exposure: result.markers for result in outcome.results[name]}
        for image in source.counted(progress):
            if image.exposure in markers_by_exposure and not isinstance(image.image, DataError):
                picture = draw_markers(
                    image.image, markers_by_exposure[image.exposure], request.target_names
                )
                path = request.overlay / f'{name}_{image.exposure:04d}.png'
                write_bytes(path, encode_overlay(picture))
