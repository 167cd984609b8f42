# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Follow implanted markers through the images of one fluoroscope.

Ids come from a first frame. In every further image, shadows are searched near the predictions,
assigned to all markers together, and measured at once. A marker that is not seen coasts, and is
found again where it may be by then. Where two markers could have been exchanged, the tracker says
so: their ids stay doubtful until a second view, or the user, confirms them.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from ..errors import DataError
from ..options import option, validate_options
from .marker_fit import MarkerGuess, fit_markers
from .marker_light import (
    LightWindows,
    MarkerLook,
    Shadows,
    check_image,
    learn_look,
    search_image,
    search_windows,
)
from .marker_motion import Motion, assign, common_shift, doubtful_pairs
from .measurement import Beads, Noise, estimate_noise, estimate_profile
from .profile import Profile

FIRST_SD_PX = 1.5  # of a given place of the first frame
SHARE = 0.35  # of the response to a typical marker, from which a shadow may be a marker
SHADOW_SD_PX = 0.35  # of the place of a shadow before it is measured
MAX_SIGMA_PX = 0.3
MAX_MISFIT = 10.0
DEPTH = (0.5, 1.8)  # of a shadow, over that of its marker
DEPTH_SD = 1.0  # of the depth of a marker that is not known yet
KNOWN_DEPTH_SD = 0.15
DEPTH_MEMORY = 0.9
MIN_HALF = 4  # of a search window [px]
MAX_HALF = 48
SAME_PLACE = 0.35  # of the radius, at which two markers are one shadow
FALSE_SHADOWS = 0.02  # expected in the gate, from which a marker found again is doubtful
OTHER_SHADOW = 'another shadow was as near to where it was expected'
UNLIKE = 'it moves unlike the markers that it moved with'
STRANGE = 7.0  # squared difference of velocities, over what it used to be
STRANGE_FRAMES = 2
SHARED_PX = 15.0  # way of the others since a doubt, after which a marker is no other shadow
SHARED = 0.35  # if its own way differs by less than this share
MIN_DENSITY = 2e-6  # of false shadows [1/px^2]
MERGED_PX = 5.0  # between predictions, within which two markers are one shadow
MERGED_FRAMES = 6  # for which neither of them is measured; then one is, with a doubt
WIDE_PX = 8.0  # standard deviation of a prediction from which markers beside help
BESIDE = 8
MIN_BESIDE = 4
LOST_SD_PX = 25.0  # of a prediction, from which only markers that move together are found again
MAX_SHIFT_PX = 60.0
SHIFTED_SD_PX = 1.2


@dataclass(frozen=True)
class MarkerOptions:
    """Options of following. Raises ValueError for a value that an option cannot have."""

    gate: float = option(
        4.5,
        'distance from its prediction within which a marker is looked for',
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
        'images between searches of the whole image, where a marker is lost',
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
    """Markers of one image: ids (n,) and places (n, 2) [px], to a pixel or two."""

    target_id: np.ndarray
    uv: np.ndarray

    def __post_init__(self) -> None:
        ids = np.asarray(self.target_id, dtype=np.int64).reshape(-1)
        uv = np.asarray(self.uv, dtype=float)
        if not len(ids):
            raise DataError('the first frame has no markers')
        if uv.shape != (len(ids), 2):
            raise DataError(f'{len(ids)} markers, but places of shape {uv.shape}')
        if not np.isfinite(uv).all():
            bad = ids[~np.isfinite(uv).all(axis=1)][0]
            raise DataError(f'marker {bad} of the first frame has no place')
        unique, count = np.unique(ids, return_counts=True)
        if (count > 1).any():
            raise DataError(f'marker {unique[count > 1][0]} occurs twice in the first frame')
        object.__setattr__(self, 'target_id', ids)
        object.__setattr__(self, 'uv', uv)


@dataclass(frozen=True)
class Doubt:
    """Ids that may be wrong from a frame on.

    Attributes
    ----------
    frame : int
    target_id : tuple of int
        Two markers that may have been exchanged, or one that may be something else.
    reason : str
    """

    frame: int
    target_id: tuple[int, ...]
    reason: str


@dataclass(frozen=True)
class MarkerFrame:
    """Markers of one image.

    Attributes
    ----------
    frame : int
    target_id : (n,) ndarray of int
        Of the markers that were measured.
    uv : (n, 2) ndarray
        Centres [px], of the middle of the exposure.
    sigma : (n,) ndarray
        Standard deviation of a coordinate [px].
    overlapped : (n,) ndarray of bool
        The shadow of another marker reaches into that of the marker.
    doubtful : (n,) ndarray of bool
        The id may be wrong.
    missing : (k,) ndarray of int
        Markers that were not measured.
    predicted : (k, 2) ndarray
        Where they are believed to be [px].
    lost : (k,) ndarray of bool
        Whether they are searched in the whole image.
    doubts : tuple of Doubt
        Those that began with this image.
    reason : str
        Why nothing was measured, '' where something was.
    seconds : float
    """

    frame: int
    target_id: np.ndarray
    uv: np.ndarray
    sigma: np.ndarray
    overlapped: np.ndarray
    doubtful: np.ndarray
    missing: np.ndarray
    predicted: np.ndarray
    lost: np.ndarray
    doubts: tuple[Doubt, ...] = ()
    reason: str = ''
    seconds: float = 0.0


@dataclass
class _Markers:
    """What is known of n markers."""

    target_id: np.ndarray
    motion: Motion
    depth: np.ndarray
    depth_sd: np.ndarray
    unseen: np.ndarray  # images since a marker was measured
    since: np.ndarray  # image with which a doubt began
    strange: np.ndarray  # images in which it moves unlike those that it moved with
    shared: np.ndarray  # way (n, 2) of these, since a doubt
    own: np.ndarray  # its own way (n, 2)
    partner: list[set[int]] = field(default_factory=list)  # rows it may be exchanged with


class MarkerTracker:
    """Follows markers through the images of one fluoroscope.

    Parameters
    ----------
    options : MarkerOptions, optional
    first : FirstMarkers
        Ids and places in the first image.
    """

    def __init__(self, options: MarkerOptions | None = None, *, first: FirstMarkers) -> None:
        self.options = options or MarkerOptions()
        self.first = first
        self._markers: _Markers | None = None
        self._look: MarkerLook | None = None
        self._profile: Profile | None = None
        self._noise: Noise | None = None
        self._frame = 0
        self._images = 0
        self._density = MIN_DENSITY
        self._size: tuple[int, int] | None = None
        self._gap = 1
        self._led: np.ndarray | None = None
        self._velocity_before = np.zeros((0, 2))
        self._suggested: tuple[np.ndarray, ...] | None = None

    @property
    def target_id(self) -> np.ndarray:
        """Ids (n,) of all markers."""
        return self.first.target_id

    @property
    def profile(self) -> Profile | None:
        """Shadow of a typical marker, None before the first image."""
        return self._profile

    def update(self, image: np.ndarray | None, frame: int) -> MarkerFrame:
        """Measure the markers of the next image.

        Parameters
        ----------
        image : (h, w) ndarray of uint8 or uint16, or None
            None where there is no image of this number.
        frame : int
            Number of the image, above that of the one before; markers move on through numbers
            that are left out.

        Returns
        -------
        MarkerFrame
            With all markers missing, and a reason, for an image in which nothing can be seen.

        Raises
        ------
        DataError
            For a number that does not grow; for a first image without the markers.
        """
        begin = time.perf_counter()
        if self._markers is not None and frame <= self._frame:
            raise DataError(f'image {frame} does not come after image {self._frame}')
        try:
            if image is None:
                raise DataError('there is no image')
            check_image(image, self._size)
        except DataError as error:
            if self._markers is None:
                raise
            self._advance(frame)
            return self._nothing(frame, str(error), begin)
        if self._markers is None:
            self._start(image)
            self._frame = frame
        else:
            self._advance(frame)
        return self._measured(image, frame, begin)

    def doubted_since(self, target_id: int) -> int | None:
        """Return the image since which an id may be wrong, None for one that is sure."""
        markers = self._known()
        row = self._row(target_id)
        return int(markers.since[row]) if markers.partner[row] else None

    def confirm(self, target_id: int) -> None:
        """Take back the doubt in a marker."""
        markers = self._known()
        row = self._row(target_id)
        for other in markers.partner[row] - {row}:
            markers.partner[other].discard(row)
        markers.partner[row].clear()

    def exchange(self, one: int, other: int) -> None:
        """Exchange two ids that were found to be the wrong way round."""
        markers = self._known()
        first = self._row(one)
        second = self._row(other)
        markers.motion.exchange(first, second)
        for values in (markers.depth, markers.depth_sd, markers.unseen):
            values[[first, second]] = values[[second, first]]

    def partners(self, target_id: int) -> set[int]:
        """Return the ids that a marker may be exchanged with; its own for something else."""
        markers = self._known()
        return {int(markers.target_id[i]) for i in markers.partner[self._row(target_id)]}

    def part(self, one: int, other: int) -> None:
        """Take back the doubt that two markers were exchanged."""
        markers = self._known()
        first = self._row(one)
        second = self._row(other)
        markers.partner[first].discard(second)
        markers.partner[second].discard(first)

    def forget(self, target_id: int) -> None:
        """Give up the place of a marker that was found to be something else."""
        markers = self._known()
        row = self._row(target_id)
        self.confirm(target_id)
        markers.motion.scatter(row)
        markers.unseen[row] = self.options.lost_after + 1

    def doubt(self, target_id: int, frame: int) -> None:
        """Note that an id may be wrong."""
        markers = self._known()
        row = self._row(target_id)
        if not markers.partner[row]:
            markers.since[row] = frame
        markers.partner[row].add(row)

    def unsure(self) -> np.ndarray:
        """Ids (k,) of markers that were not measured last, or are doubtful."""
        markers = self._known()
        doubtful = np.array([bool(partner) for partner in markers.partner])
        return markers.target_id[(markers.unseen > 0) | doubtful]

    def suggest(
        self, target_id: np.ndarray, uv: np.ndarray, velocity: np.ndarray, sd_px: np.ndarray
    ) -> None:
        """Offer predictions for the next image, such as those from another view.

        Parameters
        ----------
        target_id : (k,) ndarray
        uv, velocity : (k, 2) ndarray
            [px], [px a frame].
        sd_px : (k,) ndarray
            Where it is smaller than that of the own prediction, this one is used.
        """
        rows = np.array([self._row(int(i)) for i in target_id], dtype=int)
        self._suggested = (rows, np.asarray(uv), np.asarray(velocity), np.asarray(sd_px))

    def _known(self) -> _Markers:
        if self._markers is None:
            raise DataError('there was no image yet')
        return self._markers

    def _row(self, target_id: int) -> int:
        rows = np.flatnonzero(self.first.target_id == target_id)
        if not len(rows):
            raise DataError(f'there is no marker {target_id}')
        return int(rows[0])

    def _start(self, image: np.ndarray) -> None:
        """Learn from the first image. Raises DataError where the markers are not there."""
        uv = self.first.uv
        height, width = image.shape
        inside = ((uv > -0.5) & (uv < np.array([width, height]) - 0.5)).all(axis=1)
        if not inside.all():
            bad = int(self.first.target_id[~inside][0])
            raise DataError(f'marker {bad} of the first frame lies outside of the image')
        look = learn_look(image, uv, len(uv))
        found = search_image(image, look, SHARE)
        variance = np.full(len(uv), FIRST_SD_PX**2)
        row, column = assign(uv, variance, found.uv, 3.0)
        if len(row) < max(1, len(uv) // 2):
            raise DataError(
                f'only {len(row)} of {len(uv)} markers of the first frame are in the image'
            )
        place = uv.copy()
        place[row] = found.uv[column]
        unseen = np.ones(len(uv), dtype=int)
        unseen[row] = 0
        top = float(np.iinfo(image.dtype).max)
        light = image.astype(np.float32)
        light = top - light if look.inverted else light
        noise = estimate_noise(light, look.field)
        seen = place[row]
        profile = estimate_profile(light, look.field, seen, np.ones(len(seen)), look.radius_px)
        n = len(uv)
        motion = Motion.start(place, FIRST_SD_PX)
        self._markers = _Markers(
            self.first.target_id,
            motion,
            np.ones(n),
            np.full(n, DEPTH_SD),
            unseen,
            np.zeros(n, dtype=int),
            np.zeros(n, dtype=int),
            np.zeros((n, 2)),
            np.zeros((n, 2)),
            [set() for _ in range(n)],
        )
        self._look = look
        self._profile = profile
        self._noise = noise
        self._size = (width, height)
        self._density = max((len(found.uv) - len(row)) / max(look.field.sum(), 1), MIN_DENSITY)

    def _advance(self, frame: int) -> None:
        """Predict all markers for an image."""
        markers = self._known()
        self._gap = frame - self._frame
        self._frame = frame
        self._images += 1
        markers.motion.predict(self._gap, self._led)
        markers.unseen += 1
        if self._suggested is not None:
            markers.motion.place(*self._suggested)
            self._suggested = None

    def _measured(self, image: np.ndarray, frame: int, begin: float) -> MarkerFrame:
        """Find and measure the markers of an image."""
        markers = self._known()
        assert self._look is not None and self._profile is not None and self._noise is not None
        motion = markers.motion
        windows = LightWindows(image, self._look)
        found = self._search(image, windows)
        self._regroup(found)
        variance = motion.variance + SHADOW_SD_PX**2
        near = np.flatnonzero(variance < LOST_SD_PX**2)
        row, column = assign(motion.uv[near], variance[near], found.uv, self.options.gate)
        row = near[row]
        start = motion.uv.copy()
        start[row] = found.uv[column]
        assigned = np.zeros(len(start), dtype=bool)
        assigned[row] = True
        self._merged(start, assigned)
        tried = np.flatnonzero(assigned)
        guess = MarkerGuess(
            start[tried],
            markers.depth[tried],
            markers.depth_sd[tried],
            self.options.shutter * motion.velocity[tried],
        )
        beads = fit_markers(windows, guess, self._profile, self._noise)
        measured = np.zeros(len(start), dtype=bool)
        measured[tried[self._acceptable(beads, tried)]] = True
        uv = start.copy()
        uv[tried] = beads.uv
        sigma = np.full(len(start), SHADOW_SD_PX)
        sigma[tried] = beads.sigma
        overlapped = np.zeros(len(start), dtype=bool)
        overlapped[tried] = beads.overlapped
        depth = markers.depth.copy()
        depth[tried] = beads.depth
        free = np.delete(found.uv, column, axis=0)
        doubts = self._doubt(uv, sigma, measured, frame)
        doubts += self._doubt_shadows(uv, measured & assigned, free, frame)
        self._take(np.flatnonzero(measured), uv, sigma, depth, overlapped)
        doubts += self._compare_motion(measured, frame)
        return self._result(frame, (uv, sigma, overlapped, measured), doubts, begin)

    def _search(self, image: np.ndarray, windows: LightWindows) -> Shadows:
        """Find shadows near the predictions, or everywhere if a marker is lost."""
        markers = self._known()
        assert self._look is not None
        lost = markers.unseen > self.options.lost_after
        if lost.any() and self._images % self.options.search_every == 0:
            return search_image(image, self._look, SHARE)
        sd = np.sqrt(markers.motion.variance + SHADOW_SD_PX**2)
        reach = np.ceil(self.options.gate * sd)
        near = ~lost | (reach <= MAX_HALF)
        if not near.any():
            return Shadows(np.zeros((0, 2)), np.zeros(0))
        half = np.clip(reach, MIN_HALF, MAX_HALF).astype(int)
        middle = np.rint(markers.motion.uv).astype(int)
        parts = []
        # Few markers need wide windows; those of the others stay small.
        small = int(np.ceil(np.percentile(half[near], 75)))
        for rows in (near & (half <= small), near & (half > small)):
            if rows.any():
                size = int(half[rows].max())
                parts.append(search_windows(windows, middle[rows], size, self._look, SHARE))
        if len(parts) == 1:
            return parts[0]
        uv = np.concatenate([part.uv for part in parts])
        strength = np.concatenate([part.strength for part in parts])
        return Shadows(uv, strength).distinct() if len(uv) else parts[0]

    def _regroup(self, found: Shadows) -> None:
        """Move markers whose velocity is not known, or that are lost, with those beside them.

        One alone could be any shadow in a wide gate; several that keep their places to each other
        are hardly others.
        """
        markers = self._known()
        motion = markers.motion
        if self._images == 0:
            return
        self._follow_beside()
        wide = ~motion.settled | (motion.variance > WIDE_PX**2)
        if not wide.any() or len(found.uv) < 2 or len(motion.uv) < 2:
            return
        tree = cKDTree(found.uv)
        before = motion.uv.copy()
        for row in np.flatnonzero(wide).tolist():
            beside = np.argsort(np.linalg.norm(before - before[row], axis=1), kind='stable')
            beside = beside[(beside != row) & wide[beside]][:BESIDE]
            if not len(beside):
                continue
            reach = min(self.options.gate * float(np.sqrt(motion.variance[row])), MAX_SHIFT_PX)
            shift = common_shift(before, row, beside, tree, reach)
            if shift is not None:
                velocity = motion.velocity[row]
                if not motion.settled[row]:
                    velocity = shift / self._gap
                motion.redirect(row, before[row] + shift, velocity, SHIFTED_SD_PX)

    def _follow_beside(self) -> None:
        """Give markers of unknown velocity that of those beside them, if there are some."""
        motion = self._known().motion
        known = np.flatnonzero(motion.settled & (self._known().unseen <= 1))
        if len(known) < MIN_BESIDE:
            return
        for row in np.flatnonzero(~motion.settled).tolist():
            away = np.linalg.norm(motion.uv[known] - motion.uv[row], axis=1)
            beside = known[np.argsort(away, kind='stable')[:MIN_BESIDE]]
            velocity = np.median(motion.velocity[beside], axis=0)
            spread = float(np.abs(motion.velocity[beside] - velocity).max())
            uv = motion.uv[row] + self._gap * (velocity - motion.velocity[row])
            motion.redirect(row, uv, velocity, max(spread, SHIFTED_SD_PX))

    def _merged(self, start: np.ndarray, assigned: np.ndarray) -> None:
        """Let markers without a shadow share that of a marker beside them.

        Both start from their predictions, moved together so that their middle is the shadow's.
        """
        assert self._profile is not None
        motion = self._known().motion
        reach = 2 * self._profile.radius_px + self._profile.blur_px
        for row in np.flatnonzero(~assigned):
            if motion.variance[row] > reach**2:
                continue
            away = np.linalg.norm(start - motion.uv[row], axis=1)
            away[~assigned] = np.inf
            other = int(np.argmin(away))
            if away[other] < reach:
                between = 0.5 * (motion.uv[row] + motion.uv[other])
                shift = start[other] - between
                start[row] = motion.uv[row] + shift
                start[other] = motion.uv[other] + shift
                assigned[row] = True

    def _acceptable(self, beads: Beads, rows: np.ndarray) -> np.ndarray:
        """Return (k,) whether fitted shadows are those of the markers in rows (k,)."""
        assert self._profile is not None
        markers = self._known()
        relative = beads.depth / markers.depth[rows]
        away = beads.uv - markers.motion.uv[rows]
        variance = markers.motion.innovation_variance(np.zeros(1))[rows] + beads.sigma**2
        good = beads.measured & (beads.sigma < MAX_SIGMA_PX) & (beads.misfit < MAX_MISFIT)
        good &= (away * away).sum(axis=1) < (self.options.gate + 1) ** 2 * variance
        good &= (relative > DEPTH[0]) & (relative < DEPTH[1])
        if len(rows) > 1:
            apart = cdist(beads.uv, beads.uv)
            np.fill_diagonal(apart, np.inf)
            good &= apart.min(axis=1) > SAME_PLACE * self._profile.radius_px
        return good

    def _doubt(
        self, uv: np.ndarray, sigma: np.ndarray, measured: np.ndarray, frame: int
    ) -> tuple[Doubt, ...]:
        """Note which ids may be wrong after this image.

        A measurement that may be that of a marker beside it, which is not seen, is taken back.
        """
        markers = self._known()
        motion = markers.motion
        out = []
        variance = motion.innovation_variance(sigma)
        pairs = doubtful_pairs(motion.uv, variance, measured, uv, self.options.margin)
        # Ids of the first image are given; before a velocity is known, nothing can be said.
        settled = motion.settled & (self._images > 0)
        apart = np.linalg.norm(motion.uv[pairs[:, 0]] - motion.uv[pairs[:, 1]], axis=1)
        for (one, two), distance in zip(pairs.tolist(), apart.tolist()):
            both_settled = settled[one] and settled[two]
            if measured[one] and measured[two]:
                if not both_settled:
                    continue
            else:
                if not (both_settled or distance < MERGED_PX):
                    continue
                if max(markers.unseen[one], markers.unseen[two]) <= MERGED_FRAMES:
                    measured[one] = measured[two] = False
                    continue
            if two not in markers.partner[one]:
                for row in (one, two):
                    if not markers.partner[row]:
                        markers.since[row] = frame
                markers.partner[one].add(two)
                markers.partner[two].add(one)
                ids = (int(markers.target_id[one]), int(markers.target_id[two]))
                out.append(Doubt(frame, ids, 'their shadows met and parted'))
        again = measured & (markers.unseen > 1)
        for row in np.flatnonzero(again).tolist():
            area = np.pi * self.options.gate**2 * motion.variance[row]
            if area * self._density > FALSE_SHADOWS and row not in markers.partner[row]:
                if not markers.partner[row]:
                    markers.since[row] = frame
                markers.partner[row].add(row)
                own = (int(markers.target_id[row]),)
                text = f'found again after {int(markers.unseen[row]) - 1} images'
                out.append(Doubt(frame, own, text))
        return tuple(out)

    def _doubt_shadows(
        self, uv: np.ndarray, measured: np.ndarray, free: np.ndarray, frame: int
    ) -> tuple[Doubt, ...]:
        """Note which markers could as well be a shadow (k, 2) that is none of a marker."""
        markers = self._known()
        motion = markers.motion
        rows = np.flatnonzero(measured & motion.settled)
        if not len(free) or not len(rows):
            return ()
        variance = motion.variance[rows] + SHADOW_SD_PX**2
        own = ((motion.uv[rows] - uv[rows]) ** 2).sum(axis=1) / variance
        other = ((motion.uv[rows][:, None] - free[None]) ** 2).sum(axis=2) / variance[:, None]
        out = []
        for row in rows[other.min(axis=1) - own < self.options.margin].tolist():
            if row not in markers.partner[row]:
                self.doubt(int(markers.target_id[row]), frame)
                out.append(Doubt(frame, (int(markers.target_id[row]),), OTHER_SHADOW))
        return tuple(out)

    def _take(
        self,
        rows: np.ndarray,
        uv: np.ndarray,
        sigma: np.ndarray,
        depth: np.ndarray,
        overlapped: np.ndarray,
    ) -> None:
        """Update what is known of the markers that were measured."""
        markers = self._known()
        self._velocity_before = markers.motion.velocity.copy()
        markers.motion.update(rows, uv[rows], sigma[rows], self._gap)
        markers.unseen[rows] = 0
        free = rows[~overlapped[rows]]
        first = markers.depth_sd[free] > KNOWN_DEPTH_SD
        memory = np.where(first, 0.0, DEPTH_MEMORY)
        markers.depth[free] = memory * markers.depth[free] + (1 - memory) * depth[free]
        markers.depth_sd[free] = KNOWN_DEPTH_SD

    def _compare_motion(self, measured: np.ndarray, frame: int) -> tuple[Doubt, ...]:
        """Doubt markers that move unlike those they moved with, and confirm some that do not.

        A shadow that is none of a marker, such as a screw, does not move with the bone. Markers
        that may have been exchanged with another are left to the second view.
        """
        markers = self._known()
        rows, ratio, others = markers.motion.strangeness(measured)
        out = []
        doubtful = np.array([bool(partner) for partner in markers.partner], dtype=bool)
        strange = np.where(ratio > STRANGE, markers.strange[rows] + 1, 0)
        markers.strange[rows] = strange
        markers.shared[rows] += others * self._gap
        markers.own[rows] += markers.motion.velocity[rows] * self._gap
        way = np.linalg.norm(markers.shared[rows], axis=1)
        apart = np.linalg.norm(markers.own[rows] - markers.shared[rows], axis=1)
        far = way > SHARED_PX
        for row in rows[(strange == STRANGE_FRAMES) & ~doubtful[rows]].tolist():
            self.doubt(int(markers.target_id[row]), frame)
            out.append(Doubt(frame, (int(markers.target_id[row]),), UNLIKE))
        for row in rows[far & (apart < SHARED * way) & doubtful[rows]].tolist():
            if markers.partner[row] == {row}:
                markers.partner[row].clear()
        anew = rows[far | ~doubtful[rows]]
        markers.shared[anew] = 0.0
        markers.own[anew] = 0.0
        sure = np.array([not partner for partner in markers.partner], dtype=bool)
        self._led = markers.motion.lead(markers.unseen == 0, self._velocity_before, sure)
        return tuple(out)

    def _result(
        self,
        frame: int,
        found: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
        doubts: tuple[Doubt, ...],
        begin: float,
    ) -> MarkerFrame:
        uv, sigma, overlapped, measured = found
        markers = self._known()
        doubtful = np.array([bool(partner) for partner in markers.partner])
        missing = ~measured
        return MarkerFrame(
            frame,
            markers.target_id[measured],
            uv[measured],
            sigma[measured],
            overlapped[measured],
            doubtful[measured],
            markers.target_id[missing],
            markers.motion.uv[missing],
            markers.unseen[missing] > self.options.lost_after,
            doubts,
            '' if measured.any() else 'no marker is seen',
            time.perf_counter() - begin,
        )

    def _nothing(self, frame: int, reason: str, begin: float) -> MarkerFrame:
        """Return the result of an image in which nothing can be seen."""
        n = len(self.target_id)
        none = np.zeros(n)
        nowhere = np.zeros(n, dtype=bool)
        found = (np.zeros((n, 2)), none, nowhere, nowhere)
        return replace(self._result(frame, found, (), begin), reason=reason)
