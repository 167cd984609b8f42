# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Track implanted markers through the images of one fluoroscope.

Ids come from a first frame. In every further image, shadows are searched near the predictions,
assigned to all markers together, and measured at once. A marker that is not seen coasts, and is
searched where it may be by then. If two markers could have been exchanged, the tracker reports
it: their ids stay doubtful until a second view, or the user, confirms them.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError
from ..findings import Finding, Kind
from ..options import option, validate_options
from .marker_fit import MarkerMeasurement, noise_of_markers
from .marker_intensity import (
    NOWHERE_PX,
    FilteredImage,
    LightWindows,
    MarkerLook,
    MarkerSearch,
    MarkerStart,
    Shadows,
    check_image,
    learn_start,
)
from .marker_motion import GIVEN_SD_PX, MarkerStates, MeasuredMarkers
from .marker_watch import (
    MarkerDoubts,
    MarkerWatch,
    follow_beside,
    shift_together,
)


@dataclass(frozen=True)
class MarkerOptions:
    """Options of the tracker. Raises ValueError for a value outside the range of an option."""

    gate: float = option(
        4.5,
        'largest distance from its prediction at which a marker is searched for',
        minimum=1,
        maximum=20,
        unit='standard deviations',
    )
    margin: float = option(
        14.0,
        'difference of twice the log likelihood below which two ids may have been exchanged',
        minimum=0,
        maximum=1000,
    )
    search_every: int = option(
        30,
        'images over which the search of the whole image for a lost marker is spread, in strips',
        minimum=1,
        maximum=100000,
        unit='images',
    )
    lost_after: int = option(
        10,
        'images without a marker after which it is lost, and searched in the whole image',
        minimum=1,
        maximum=100000,
        unit='images',
    )
    shutter: float = option(
        0.5,
        'share of the time between two images during which the light is on; blurs what moves',
        minimum=0,
        maximum=1,
    )

    def __post_init__(self) -> None:
        validate_options(self)


@dataclass(frozen=True)
class FirstMarkers:
    """Markers of one image: ids (n,) and places (n, 2) [px], to a pixel or two.

    filtered: the filtered image, if the markers were searched in it.
    """

    target_id: NDArray[np.int64]
    uv: NDArray[np.float64]
    filtered: FilteredImage | None = None

    def __post_init__(self) -> None:
        ids = np.asarray(self.target_id, dtype=np.int64).reshape(-1)
        uv = np.asarray(self.uv, dtype=float)
        if not len(ids):
            raise DataError('the first frame has no markers')
        if uv.shape != (len(ids), 2):
            raise DataError(f'{len(ids)} markers, but image points of shape {uv.shape}')
        if not np.isfinite(uv).all():
            unplaced_id = ids[~np.isfinite(uv).all(axis=1)][0]
            raise DataError(f'marker {unplaced_id} of the first frame has no image point')
        unique, count = np.unique(ids, return_counts=True)
        if (count > 1).any():
            raise DataError(f'marker {unique[count > 1][0]} occurs twice in the first frame')
        object.__setattr__(self, 'target_id', ids)
        object.__setattr__(self, 'uv', uv)


@dataclass(frozen=True)
class MarkerFrame:
    """Markers of one image."""

    frame: int
    target_id: NDArray[np.int64]  #: (n,), ids of the measured markers
    uv: NDArray[np.float64]  #: (n, 2), centres [px] in the middle of the exposure
    sigma: NDArray[np.float64]  #: (n,), standard deviation of a coordinate [px]
    #: (n,), True if the shadow of another marker reaches into that of the marker
    overlapped: NDArray[np.bool_]
    doubtful: NDArray[np.bool_]  #: (n,), True if the id may be wrong
    missing: NDArray[np.int64]  #: (k,), markers that were not measured
    #: (k, 2), predicted places of these [px], NaN for markers that were never seen
    predicted: NDArray[np.float64]
    lost: NDArray[np.bool_]  #: (k,), True if they are searched in the whole image
    #: new doubts in this image: two markers that may have been exchanged, or one that may be
    #: another object
    doubts: tuple[Finding, ...] = ()
    finding: Finding | None = None  #: reason why nothing was measured
    seconds: float = 0.0

    @property
    def reason(self) -> str:
        """Reason in words why nothing was measured; '' if something was."""
        return '' if self.finding is None else self.finding.cause


MIN_MEMBERS = 4  # members of a body that determine ids; suggested markers that start tracking


def _inside(uv: NDArray[np.float64], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return (n,) whether points (n, 2) are inside an image of a shape."""
    return np.asarray(((uv > 0) & (uv < np.array(shape[::-1]) - 1)).all(axis=1))


def _filtered(image: np.ndarray, first: FirstMarkers | None) -> FilteredImage:
    """Return the filtered image; reuse the one in which the first markers were searched."""
    if first is None or first.filtered is None or first.filtered.image is not image:
        return FilteredImage(image)
    return first.filtered


@dataclass(frozen=True)
class _Followed:
    """State and steps of the tracker from the first image on."""

    states: MarkerStates  #: predicted, then updated
    doubts: MarkerDoubts
    look: MarkerLook
    size: tuple[int, int]  #: width and height of the images [px]
    #: the steps for an image, in order
    search: MarkerSearch
    measurement: MarkerMeasurement
    watch: MarkerWatch

    @classmethod
    def begun(
        cls, start: MarkerStart, target_id: NDArray[np.int64], options: MarkerOptions
    ) -> _Followed:
        """Return the tracker's state and steps at the first image."""
        doubts = MarkerDoubts(len(target_id))
        return cls(
            start.states,
            doubts,
            start.look,
            start.size,
            search=MarkerSearch(
                start.look,
                gate=options.gate,
                lost_after=options.lost_after,
                search_every=options.search_every,
            ),
            measurement=MarkerMeasurement(
                start.profile, start.noise, gate=options.gate, shutter=options.shutter
            ),
            watch=MarkerWatch(
                target_id,
                doubts,
                gate=options.gate,
                margin=options.margin,
                lost_after=options.lost_after,
                density=start.density,
            ),
        )


class MarkerTracker:
    """Tracks markers through the images of one fluoroscope.

    first: ids and places in the first image; None to start with an image in which enough suggested
    markers are seen. later (k,): ids of markers that are tracked once their places are given or
    suggested.
    """

    def __init__(
        self,
        options: MarkerOptions | None = None,
        *,
        first: FirstMarkers | None,
        later: NDArray[np.int64] | None = None,
    ) -> None:
        self.options = options or MarkerOptions()
        self.first = first
        no_ids = np.zeros(0, dtype=np.int64)
        first_ids = no_ids if first is None else first.target_id
        # Ids of all markers.
        self.target_id = np.append(first_ids, no_ids if later is None else later)
        self._rows = {number: row for row, number in enumerate(self.target_id.tolist())}
        self._followed: _Followed | None = None
        self._frame = 0
        self._gap = 1  # frames between the last two images
        self._images = 0  # number of images since the first
        self._led: NDArray[np.bool_] | None = None
        self._suggested: list[tuple[np.ndarray, ...]] = []
        self._given: list[FirstMarkers] = []  # places given for the next image
        self._anew = np.zeros(len(self.target_id), dtype=bool)
        self._tried = 0  # image from which suggested markers are searched again

    @property
    def begun(self) -> bool:
        """Whether the tracker has started."""
        return self._followed is not None

    def update(self, image: np.ndarray | None, frame: int) -> MarkerFrame:
        """Measure the markers of the next image (h, w) of uint8 or uint16; None if there is none.

        frame is its number, which must increase; markers also move during skipped numbers. If
        nothing can be seen in an image, all markers are missing, and the finding states the
        reason. Raises DataError for a number that does not increase, and for a first image without
        the markers.
        """
        begin = time.perf_counter()
        followed = self._followed
        if followed is not None and frame <= self._frame:
            raise DataError(f'image {frame} does not come after image {self._frame}')
        try:
            if image is None:
                raise DataError('there is no image')
            check_image(image, None if followed is None else followed.size)
            start = self._start(image, frame) if followed is None else None
        except DataError as error:
            if followed is None and self.first is not None:
                raise
            self._advance(frame)
            self._given = []
            nothing = MeasuredMarkers.nothing(len(self.target_id))
            return self._result(nothing, (), error.finding, begin)
        self._advance(frame)
        self._followed = start or followed
        given_rows = self._place_given()
        markers, doubts = self._measure(image, frame, given_rows)
        none_seen = Finding(Kind.NO_MARKERS, 'no marker is seen')
        return self._result(markers, doubts, None if markers.measured.any() else none_seen, begin)

    def doubted_since(self, target_id: int) -> int | None:
        """Return the image since which an id may be wrong, None if it is certain."""
        return self._known().doubts.since(self._row(target_id))

    def doubtful(self) -> NDArray[np.int64]:
        """Return the ids (k,) that may be wrong."""
        if self._followed is None:
            return self.target_id[:0]
        return self.target_id[self._followed.doubts.doubtful]

    def confirm(self, target_id: int) -> None:
        """Revoke the doubt in a marker."""
        self._known().doubts.confirm(self._row(target_id))

    def exchange(self, one: int, other: int) -> None:
        """Exchange two ids that were found to be swapped."""
        self._known().states.exchange(self._row(one), self._row(other))

    def partners(self, target_id: int) -> set[int]:
        """Return ids that a marker may be exchanged with; its own id means another object."""
        rows = self._known().doubts.partners(self._row(target_id))
        return {int(self.target_id[row]) for row in rows}

    def part(self, one: int, other: int) -> None:
        """Revoke the doubt that two markers were exchanged."""
        self._known().doubts.part(self._row(one), self._row(other))

    def forget(self, target_id: int) -> None:
        """Discard the place of a marker that was found to be another object."""
        followed = self._known()
        row = self._row(target_id)
        followed.doubts.confirm(row)
        followed.states.forget(row, self.options.lost_after + 1)

    def doubt(self, target_id: int, frame: int) -> None:
        """Note that an id may be wrong."""
        self._known().doubts.add(self._row(target_id), frame)

    def widen(self, factor: float) -> None:
        """Multiply the standard deviations of the next measurements by a factor."""
        if self._followed is not None:
            self._followed.measurement.factor = factor

    def unsure(self) -> NDArray[np.int64]:
        """Return the ids (k,) of markers that were not measured last, or are doubtful."""
        followed = self._followed
        if followed is None:
            return self.target_id
        return self.target_id[(followed.states.unseen > 0) | followed.doubts.doubtful]

    def seen_anew(self) -> NDArray[np.int64]:
        """Return the ids (k,) of markers measured last whose motion was unknown before."""
        return self.target_id[self._anew]

    def shadows(self, image: np.ndarray) -> Shadows:
        """Return all shadows in an image that look like markers."""
        return self._known().search.everywhere(image)

    def place(self, positions: FirstMarkers) -> None:
        """Set places of markers in the next image, given by a person or by their bodies.

        Ids of markers that are measured there are certain. A marker that is tracked to its place
        anyway keeps its state. If a place is given twice, the first one counts.
        """
        self._given.append(positions)

    def suggest(
        self,
        target_id: NDArray[np.int64],
        uv: NDArray[np.float64],
        velocity: NDArray[np.float64],
        sd_px: NDArray[np.float64],
    ) -> None:
        """Offer predictions for the next image, such as those from another view.

        target_id: (k,). uv, velocity: (k, 2) [px], [px/frame]. sd_px: (k,) standard deviations; a
        prediction is used if it is more precise than the tracker's own.
        """
        rows = np.array([self._row(int(i)) for i in target_id], dtype=int)
        self._suggested.append((rows, np.asarray(uv), np.asarray(velocity), np.asarray(sd_px)))

    def _known(self) -> _Followed:
        if self._followed is None:
            raise DataError('there was no image yet')
        return self._followed

    def _row(self, target_id: int) -> int:
        row = self._rows.get(target_id)
        if row is None:
            raise DataError(f'there is no marker {target_id}')
        return row

    def _start(self, image: np.ndarray, frame: int) -> _Followed:
        """Learn from the first image. Raises DataError if the markers are not in it."""
        places = self._first_places(image.shape, frame)
        filtered = _filtered(image, self.first)
        if self.first is not None:
            self.first = replace(self.first, filtered=None)  # release a large image
        start = learn_start(filtered, self.target_id, places)
        seen = start.states.motion.uv[start.states.unseen == 0]
        windows = LightWindows(image, start.look)
        start = replace(start, noise=noise_of_markers(windows, seen, start.profile, start.noise))
        for row in np.flatnonzero(np.isnan(places[:, 0])).tolist():
            start.states.forget(row, self.options.lost_after + 1)
        return _Followed.begun(start, self.target_id, self.options)

    def _first_places(self, shape: tuple[int, ...], frame: int) -> NDArray[np.float64]:
        """Return places (n, 2) in the first image [px], NaN for unknown places.

        Raises DataError if too few are suggested in an image of this shape.
        """
        places = np.full((len(self.target_id), 2), np.nan)
        if self.first is not None:
            places[: len(self.first.uv)] = self.first.uv
            return places
        for rows, uv, _, sd in self._suggested:
            usable = _inside(uv, shape) & (sd < GIVEN_SD_PX)
            places[rows[usable]] = uv[usable]
        if np.isfinite(places[:, 0]).sum() < MIN_MEMBERS or frame < self._tried:
            raise DataError('no marker is seen', kind=Kind.NO_MARKERS)
        self._tried = frame + self.options.search_every
        return places

    def _advance(self, frame: int) -> None:
        """Predict all tracked markers for an image."""
        if self._followed is not None:
            states = self._followed.states
            self._gap = frame - self._frame
            self._images += 1
            states.advance(self._gap, self._led)
            for suggested in self._suggested:
                states.motion.place(*suggested)
        self._frame = frame
        self._suggested = []

    def _place_given(self) -> NDArray[np.int64]:
        """Set markers to the places given for this image; return the rows of all of them."""
        given = [np.zeros(0, dtype=np.int64)]
        for markers in reversed(self._given):  # the first place counts, so it is set last
            rows = np.array([self._row(int(i)) for i in markers.target_id])
            self._known().states.place(rows, markers.uv, self._gap)
            given.append(rows)
        self._given = []
        return np.unique(np.concatenate(given))

    def _believe(
        self, rows: NDArray[np.int64], doubts: tuple[Finding, ...]
    ) -> tuple[Finding, ...]:
        """Revoke doubts that given markers are other objects; return the remaining doubts.

        A place given to a pixel or two does not distinguish markers whose shadows meet there.
        """
        for row in rows.tolist():
            self._known().doubts.confirm_alone(row)
        ids = set(self.target_id[rows].tolist())
        return tuple(
            doubt
            for doubt in doubts
            if doubt.kind is Kind.SHADOWS_MET or ids.isdisjoint(doubt.place.target_id)
        )

    def _measure(
        self, image: np.ndarray, frame: int, given_rows: NDArray[np.int64]
    ) -> tuple[MeasuredMarkers, tuple[Finding, ...]]:
        """Find and measure the markers of an image; return them with new doubts in their ids.

        given_rows: markers whose places are given for this image.
        """
        followed = self._known()
        states = followed.states
        watch = followed.watch
        windows = LightWindows(image, followed.look)
        shadows = followed.search.shadows(image, windows, states, self._images)
        if self._images:
            follow_beside(states, self._gap)
            shift_together(states, shadows, self.options.gate, self._gap)
        markers = followed.measurement.measure(windows, shadows, states, self._gap)
        given_rows = given_rows[markers.measured[given_rows]]
        for row in given_rows.tolist():
            followed.doubts.confirm(row)
        unknown = ~states.motion.settled | (states.unseen > 1)
        markers, doubts = watch.shadows_met(markers, states, frame, is_first=self._images == 0)
        doubts += watch.recovered(markers, states, frame)
        doubts += watch.other_shadows(markers, states, frame)
        # In the first image, and at given places, ids are certain.
        self._anew = markers.measured & unknown & (states.placed > 0) & (self._images > 0)
        velocity_before = states.motion.velocity.copy()
        states.update(markers, self._gap)
        doubts += watch.moving_alone(markers, states, frame, self._gap)
        sure = ~followed.doubts.doubtful
        self._led = states.motion.lead(states.unseen == 0, velocity_before, sure)
        return markers, self._believe(given_rows, doubts)

    def _result(
        self,
        markers: MeasuredMarkers,
        doubts: tuple[Finding, ...],
        finding: Finding | None,
        begin: float,
    ) -> MarkerFrame:
        """Return the markers of the current image."""
        followed = self._followed
        measured = markers.measured
        missing = ~measured
        doubtful = np.zeros(len(measured), dtype=bool)
        predicted = np.full((len(measured), 2), np.nan)
        lost = ~doubtful
        if followed is not None:
            doubtful = followed.doubts.doubtful
            uv = followed.states.motion.uv
            predicted = np.where(uv > NOWHERE_PX / 2, uv, np.nan)
            lost = followed.search.lost(followed.states)
        return MarkerFrame(
            self._frame,
            self.target_id[measured],
            uv=markers.uv[measured],
            sigma=markers.sigma[measured],
            overlapped=markers.overlapped[measured],
            doubtful=doubtful[measured],
            missing=self.target_id[missing],
            predicted=predicted[missing],
            lost=lost[missing],
            doubts=doubts,
            finding=finding,
            seconds=time.perf_counter() - begin,
        )
