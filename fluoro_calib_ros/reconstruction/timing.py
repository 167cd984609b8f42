# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Delays between the fluoroscopes of a recording, estimated from rays that miss each other.

If fluoroscope b takes its images d frame intervals after a, the epipolar residual of a moving
point is d times its change from one frame of b to the next. Residuals due to any change of the
rig are linear in that of the essential matrix, and are eliminated (Frisch and Waugh, Econometrica
1, 1933), so that only a motion that no rig explains counts as a delay. A delay of more than an
interval is a lag by whole frames and the rest. If a frame is lost, later ones are paired with
those of the neighbouring exposure: the lag changes by one. The most likely course of the lag
follows from dynamic programming (Viterbi, IEEE Trans. Inf. Theory 13, 1967).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..exposures.stamps import NS_PER_S, StampedFrame
from ..findings import Finding, Kind, Place, Severity, first_few
from ..photogrammetry.rig_orientation import RigOrientation
from ..rows import chosen_rows, joined_rows
from .epipolar import Counts, EpipolarGeometry, counts_of, recent_misses
from .intersection import IntersectedPoints
from .reconstruct import CorrectedView, RigRecording, match_views

RECENT = 100  # number of recent exposures of a stream
MAX_EXPOSURES = 200  # number of exposures tested: they determine a delay to 0.01 frame intervals
MAX_POINTS = 10_000  # number of their image points in a: 50 each
MIN_SIGMAS = 5.0  # minimum delay over its standard deviation: one in a million by chance
MAX_LAG = 12  # maximum delay by whole frames, and 1/LAG_SHARE of the exposures
LAG_SHARE = 8
MAX_FRAMES = 1.0  # maximum rest of a delay: neighbouring frames show no motion beyond them
SURE_PART = 0.02  # difference from a whole frame interval below which a delay may be whole
WHOLE = 0.1  # maximum difference of an uncertain delay from a frame interval that it may be
TIE = 1e-6  # makes frames that are missing less likely than equally likely ones
MIN_NOISE_PX = 1e-3  # minimum noise of image points
# Minimum share of the squared misses, beyond their noise and what a changed rig explains, that a
# delay explains: it is their main cause. Without a delay, unknown distortions of 0.3 to 3 px were
# explained to 0.13 at most; half an interval beside one of 0.3 px was to 0.79 at least.
MIN_EXPLAINED = 0.5
STEPS = 10  # reweighted Gauss-Newton steps
ROBUST = 2.4  # residual with half the weight, in standard deviations
LOSS = 0.143  # mean log-likelihood lost by normal residuals under Cauchy noise of that scale
# Minimum log-likelihood gained by a lost frame: five standard deviations, and 1200 tries.
MIN_GAIN = 20.0
# Maximum share by which the loss that remains exceeds that of the noise. It is 0.05 at most if
# frames are lost, and 0.7 at least if a distortion of 1 px is wrong, too.
MAX_EXCESS = 0.25
KEPT = 0.796  # weighted variance of normal residuals over their variance, by these weights


AnyFrame = TypeVar('AnyFrame', bound=StampedFrame)


def timing_fault(
    exposures: Sequence[Mapping[str, AnyFrame]],
    corrected: Callable[[AnyFrame], CorrectedView],
    orientation: RigOrientation,
) -> Finding | None:
    """Return a warning if the frames of exposures were not taken at the same time, or None.

    A fluoroscope is delayed relative to the first, or has lost a frame. The warning is on the most
    significant delay.

    exposures: frames by fluoroscope, in temporal order. corrected: returns the corrected view of a
    frame.
    """
    first, *others = orientation.fluoroscopes
    delays: dict[str, Delay] = {}
    corrected = _corrected_once(corrected)
    for name in others:
        views = ViewsOfPair(exposures, corrected, EpipolarGeometry(orientation, first, name))
        track = views.track(range(len(views.exposures)))
        lost = find_lost_frames(views, track)
        if lost is not None:
            return lost
        delay = fitted_delay(track)
        if delay is not None and delay.is_cause:
            delays[name] = delay
    if not delays:
        return None
    name = max(delays, key=lambda n: abs(delays[n].frames) / delays[n].sd)
    return delay_finding((first, name), delays[name], _interval_s(exposures, first))


def _corrected_once(
    corrected: Callable[[AnyFrame], CorrectedView],
) -> Callable[[AnyFrame], CorrectedView]:
    """Return a function that corrects each frame only once."""
    views: dict[int, CorrectedView] = {}

    def view(frame: AnyFrame) -> CorrectedView:
        if id(frame) not in views:
            views[id(frame)] = corrected(frame)
        return views[id(frame)]

    return view


class RecentExposures(Generic[AnyFrame]):
    """Recent exposures of a stream, whose rays and timing are judged.

    corrected: returns the corrected view of a frame.
    """

    def __init__(self, corrected: Callable[[AnyFrame], CorrectedView]) -> None:
        self._corrected = corrected
        # Exposures, and counts of their points; see `recent_misses`.
        self._recent: deque[tuple[Mapping[str, AnyFrame], Counts]] = deque(maxlen=RECENT)

    def add(self, exposure: Mapping[str, AnyFrame], points: IntersectedPoints) -> None:
        """Add an exposure, frames by fluoroscope, with its points."""
        self._recent.append((exposure, counts_of(points.status)))

    def faults(
        self, orientation: RigOrientation, is_doubtful: bool
    ) -> tuple[Finding | None, Finding | None]:
        """Return why most rays miss each other, and the fault of the timing, each or None.

        The timing, which takes 0.05 s, is only judged if most rays miss each other, or if the rig
        is doubtful for another reason.
        """
        recent = list(self._recent)
        counts = [each for _, each in recent]
        timing = None
        if is_doubtful or recent_misses(counts) is not None:
            exposures = [exposure for exposure, _ in recent]
            timing = timing_fault(exposures, self._corrected, orientation)
        return recent_misses(counts, timing), timing


def timing_of_recording(recording: RigRecording) -> Finding | None:
    """Return the fault of the timing of a recording, or None; see `timing_fault`."""
    return timing_fault(recording.exposures, recording.corrected, recording.orientation)


@dataclass(frozen=True)
class Motion:
    """Epipolar residuals of n points in motion, in fluoroscopes a and b."""

    target_id: NDArray[np.int64]  #: (n,)
    #: (n, 3), residuals of a's points with b's points in the frames before, at and after a lag
    #: [px]
    residual: NDArray[np.float64]
    #: (n,), variance of the residuals by the noise of image points, and the part due to b [px^2]
    variance: NDArray[np.float64]
    noise: NDArray[np.float64]
    #: (n, 9), derivatives by the elements of the essential matrix, apart from its scale, which
    #: changes no epipolar line
    by_rig: NDArray[np.float64]


@dataclass(frozen=True)
class Points:
    """Corrected image points of n targets of a, and of the same in frames of b at all lags."""

    target_id: NDArray[np.int64]  #: (n,)
    exposure: NDArray[np.int64]  #: (n,), rows of the exposures, ascending
    uv: NDArray[np.float64]  #: (n, 1 + lags, 2) in a, then in b [px]; NaN if not seen
    sigma: NDArray[np.float64]  #: (n, 1 + lags) standard deviations [px]
    noise: NDArray[np.float64]  #: (n, 1 + lags) variances without that of the correction [px^2]


@dataclass(frozen=True)
class Track:
    """Points of a recording with their epipolar residuals at all lags of b."""

    points: Points
    geometry: EpipolarGeometry
    residual: NDArray[np.float64]  #: (n, lags) [px]; NaN where b has no point
    variance: NDArray[np.float64]  #: (n,) by the noise of the image points at lag 0 [px^2]

    @property
    def lags(self) -> NDArray[np.int64]:
        """Frames of b that are compared with a frame of a, from k before to k after it."""
        most = self.residual.shape[1] // 2
        return np.arange(-most, most + 1)

    def at(self, lag: int) -> Motion:
        """Return the residuals of the points that b shows before, at and after a lag."""
        points = self.points
        column = len(self.lags) // 2 + lag
        near = slice(column - 1, column + 2)
        seen = np.isfinite(self.residual[:, near]).all(axis=1)
        uv = points.uv[seen][:, [0, 1 + column]]
        sigma = points.sigma[seen][:, [0, 1 + column]]
        noise = points.noise[seen][:, [0, 1 + column]]
        found = self.geometry.residuals(uv[:, 0], uv[:, 1], sigma[:, 0], sigma[:, 1])
        of_b = found.factor_b**2 * noise[:, 1]
        by_rig = self.geometry.by_essential(uv[:, 0], uv[:, 1])
        scale = self.geometry.essential.ravel() / np.linalg.norm(self.geometry.essential)
        return Motion(
            points.target_id[seen],
            self.residual[seen][:, near],
            found.factor_a**2 * noise[:, 0] + of_b,
            of_b,
            by_rig=by_rig - np.outer(by_rig @ scale, scale),
        )

    def losses(self) -> NDArray[np.float64]:
        """Return the negative log-likelihood (n, lags) of each point under Cauchy noise.

        That of a lag at which b has no point is the mean one of the most likely lag of the
        exposure, so that it decides nothing.
        """
        loss = np.log1p(self.residual**2 / (ROBUST**2 * self.variance[:, None]))
        _, exposure, count = np.unique(
            self.points.exposure, return_inverse=True, return_counts=True
        )
        missing = np.isnan(loss)
        total = np.zeros((len(count), loss.shape[1]))
        np.add.at(total, exposure, np.where(missing, 0.0, loss))
        seen = np.zeros_like(total)
        np.add.at(seen, exposure, ~missing)
        least = np.min(np.where(seen > 0, total / np.maximum(seen, 1), np.inf), axis=1)
        return np.where(missing, least[exposure, None] * (1 + TIE), loss)


@dataclass(frozen=True)
class Delay:
    """Delay of fluoroscope b behind a."""

    frames: float  #: delay in frame intervals
    sd: float  #: its standard deviation, for errors that are constant for each target
    #: share of the squared residuals that it explains, of those beyond their noise and not due to
    #: a change of the rig
    explained: float

    @property
    def is_cause(self) -> bool:
        """Whether it is significant, and the main cause of the residuals."""
        return self.margin < abs(self.frames) and self.explained > MIN_EXPLAINED

    @property
    def margin(self) -> float:
        """Largest error of the delay."""
        return MIN_SIGMAS * self.sd


def fitted_delay(track: Track) -> Delay | None:
    """Estimate the delay; return None if nothing moves.

    The lag by whole frames is the most likely one, if it is clearly more likely than none. The
    share that a lag explains is that of the squared residuals without it.
    """
    if not len(track.residual):
        return None
    loss = track.losses().sum(axis=0)
    best = int(track.lags[1:-1][np.argmin(loss[1:-1])])
    present = len(track.lags) // 2
    lag = best if loss[present] - loss[present + best] > MIN_GAIN else 0
    fitted = _fitted_near(track.at(lag))
    if fitted is None:
        return None
    delay, unexplained, total = fitted
    if abs(delay.frames) >= MAX_FRAMES + delay.margin:
        return None
    if lag:
        without = _fitted_near(track.at(0))
        total = without[2] if without is not None else 0.0
        explained = 1 - unexplained / max(total, 1e-300)
        delay = replace(delay, frames=delay.frames - lag, explained=explained)
    return delay


def _fitted_near(motion: Motion) -> tuple[Delay, float, float] | None:
    """Estimate the delay relative to a lag by reweighted least squares; None if nothing moves.

    Images that b takes late by the delay show the points after the time of a. The second
    differences of the residuals contribute half of the squared delay. Returns also the mean
    squared residuals beyond their noise, with the delay and without it.
    """
    if len(motion.target_id) <= 2 * motion.by_rig.shape[1]:
        return None
    previous, present, following = motion.residual.T
    change = 0.5 * (following - previous)
    bend = 0.5 * (following - 2 * present + previous)
    delay = 0.0
    rest = present - np.median(present)
    for _ in range(STEPS):
        size = max(1.4826 * float(np.median(np.abs(rest))), 1e-9)
        weight = 1 / (1 + (rest / (ROBUST * size)) ** 2)
        root = np.sqrt(weight)[:, None]
        moving = root * np.column_stack([change, present + delay**2 * bend])
        by_rig = root * motion.by_rig
        moving -= by_rig @ np.linalg.lstsq(by_rig, moving, rcond=1e-10)[0]
        changes, targets = moving.T
        # The noise of both neighbouring frames adds half its variance to the squared changes.
        of_noise = 0.5 * weight * motion.noise
        information = float(changes @ changes - of_noise.sum())
        if information <= 0:
            return None
        delay = float(np.clip(changes @ targets / information, -2 * MAX_FRAMES, 2 * MAX_FRAMES))
        rest = (targets - delay * changes) / root[:, 0]
    # Errors of survey and correction stay the same for a target: sums over each are independent.
    _, target = np.unique(motion.target_id, return_inverse=True)
    scores = changes * rest * root[:, 0] + delay * of_noise
    sums = np.bincount(target, weights=scores)
    unexplained = max(float(weight @ (rest * rest - KEPT * motion.variance)), 0.0)
    explained = float(targets @ targets - weight @ (rest * rest))
    share = explained / max(explained + unexplained, 1e-300)
    found = Delay(delay, float(np.sqrt(sums @ sums) / information), share)
    return found, unexplained / weight.sum(), (explained + unexplained) / weight.sum()


@dataclass(frozen=True)
class LostFrames:
    """Frames that a fluoroscope has lost."""

    fluoroscope: str
    exposure: int  #: number of the first exposure without them
    frames: int  #: how many

    def __str__(self) -> str:
        frames = 'a frame' if self.frames == 1 else f'{self.frames} frames'
        return f'fluoroscope {self.fluoroscope} has lost {frames} before exposure {self.exposure}'


@dataclass(frozen=True)
class LagChange:
    """Change of the lag of b; frames that b has lost leave exposures of a without a partner."""

    row: int  #: first exposure after the change
    before: int  #: columns of the lags
    after: int

    @property
    def frames(self) -> int:
        """Number of frames that b, or a if negative, has lost."""
        return self.before - self.after

    @property
    def end(self) -> int:
        """The first exposure with the new lag."""
        return self.row + max(self.frames, 0)


def find_lost_frames(views: ViewsOfPair[AnyFrame], track: Track) -> Finding | None:
    """Return a warning if the lag of b changes by whole frames, or None.

    Unlike that of a constant delay, this search cannot eliminate changes of the rig: nothing else
    may be wrong.
    """
    loss = track.losses()
    if not len(loss):
        return None
    exposure = track.points.exposure
    rows, first_rows = np.unique(exposure, return_index=True)
    course = _course(np.add.reduceat(loss, first_rows, axis=0))
    changes = _changes(views, rows, course)
    column = np.full(len(loss), course[0])
    is_paired = np.ones(len(loss), dtype=bool)
    for change in changes:
        column[exposure >= change.row] = change.after
        is_paired &= (exposure < change.row) | (exposure >= change.end)
    chosen = np.where(is_paired, loss[np.arange(len(loss)), column], 0.0)
    count = np.count_nonzero(is_paired)
    gain = float(loss[is_paired].sum(axis=0).min() - chosen.sum())
    excess = float(chosen.sum()) - LOSS * count
    if not changes or gain < MIN_GAIN or excess > min(gain, MAX_EXCESS * LOSS * count):
        return None
    a, b = track.geometry.fluoroscopes
    return lost_frames_finding(
        [
            LostFrames(b if one.frames > 0 else a, views.number(one.row), abs(one.frames))
            for one in changes
        ]
    )


def lost_frames_finding(lost: Sequence[LostFrames]) -> Finding:
    """Return the warning on one loss of frames or several, in temporal order."""
    first = lost[0]
    advice = f'add {first.frames} to the numbers of its frames from {first.exposure} on'
    if len(lost) > 1:
        advice = 'add the frames that are lost to the numbers of all later ones'
    return Finding(
        Kind.FRAME_LOST,
        first_few(lost, '; '),
        Place(
            tuple(dict.fromkeys(one.fluoroscope for one in lost)),
            tuple(one.exposure for one in lost),
            name='',
        ),
        advice,
        Severity.WARNING,
        numbers={'exposure': first.exposure, 'frames': sum(one.frames for one in lost)},
    )


def _changes(
    views: ViewsOfPair[AnyFrame], rows: NDArray[np.int64], course: NDArray[np.int64]
) -> list[LagChange]:
    """Return the changes of the lag, each at its exposure, of a course (T,) of some exposures.

    While exposures have no partner, the course may change in steps.
    """
    out: list[LagChange] = []
    since = 0
    for row in (np.flatnonzero(np.diff(course)) + 1).tolist():
        change = LagChange(int(rows[row]), int(course[row - 1]), int(course[row]))
        if out and change.frames * out[-1].frames > 0:
            joined = replace(out[-1], after=change.after)
            if change.row <= out[-1].row + abs(joined.frames) + 1:
                change = replace(joined, row=out[-1].row)
                out.pop()
        since = out[-1].end if out else 0
        out.append(_located(views, change, (max(since, int(rows[row - 1])), int(rows[row]))))
    return out


def _course(loss: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the most likely columns (T,) of losses (T, k); each change costs MIN_GAIN."""
    count, lags = loss.shape
    total = loss[0]
    origin = np.zeros((count, lags), dtype=np.int64)
    for row in range(1, count):
        best = int(np.argmin(total))
        stays = total <= total[best] + MIN_GAIN
        origin[row] = np.where(stays, np.arange(lags), best)
        total = np.where(stays, total, total[best] + MIN_GAIN) + loss[row]
    course = np.zeros(count, dtype=np.int64)
    course[-1] = np.argmin(total)
    for row in range(count - 1, 0, -1):
        course[row - 1] = origin[row, course[row]]
    return course


def _located(
    views: ViewsOfPair[AnyFrame], change: LagChange, between: tuple[int, int]
) -> LagChange:
    """Return a change between two exposures at the most likely one."""
    first, last = between
    while True:
        margin = abs(change.frames) + 1
        rows = range(max(first - margin, 0), min(last + margin, len(views.exposures)))
        track = views.track(rows)
        exposures, first_rows = np.unique(track.points.exposure, return_index=True)
        if not len(exposures):
            return change
        loss = np.add.reduceat(track.losses(), first_rows, axis=0)
        earlier = np.append(0.0, np.cumsum(loss[:, change.before]))
        later = np.append(np.cumsum(loss[::-1, change.after])[::-1], 0.0)
        ends = np.searchsorted(exposures, exposures + max(change.frames, 0))
        row = int(np.argmin(earlier[:-1] + later[ends]))
        change = replace(change, row=int(exposures[row]))
        if len(rows) <= MAX_EXPOSURES:
            return change
        step = -(-len(rows) // MAX_EXPOSURES)
        first, last = change.row - step, change.row + step


def delay_finding(names: tuple[str, str], delay: Delay, interval_s: float) -> Finding:
    """Return the warning that the second of two fluoroscopes is delayed.

    interval_s: frame interval [s], 0 if unknown.
    """
    first, name = names
    size = abs(delay.frames)
    shift = -round(delay.frames)
    may_be_whole = min(max(delay.margin, SURE_PART), WHOLE)
    if shift and abs(delay.frames + shift) < may_be_whole:  # the likelier cause
        cause = (
            f'the frame numbers of fluoroscope {name} are too {"small" if shift < 0 else "large"} '
            f'by {abs(shift)}'
        )
        return Finding(
            Kind.FRAMES_SHIFTED,
            cause,
            Place((name,), name=''),
            severity=Severity.WARNING,
            numbers={'shift': shift},
        )
    time = f' ({1e3 * interval_s * size:.1f} ms)' if interval_s else ''
    return Finding(
        Kind.FRAMES_DELAYED,
        f'fluoroscope {name} takes its images {size:.2f} frame intervals{time} '
        f'{"after" if delay.frames > 0 else "before"} fluoroscope {first}',
        Place((first, name), name=''),
        'points that move are wrong; trigger the fluoroscopes at the same time',
        Severity.WARNING,
        numbers={'frames': delay.frames, 'sd': delay.sd, 'interval_s': interval_s},
    )


def _interval_s(exposures: Sequence[Mapping[str, StampedFrame]], name: str) -> float:
    """Return the median interval of the frames of a fluoroscope [s], 0 without stamps."""
    stamps = [exposure[name].stamp_ns for exposure in exposures if name in exposure]
    return float(np.median(np.diff(stamps))) / NS_PER_S if len(stamps) > 1 else 0.0


class ViewsOfPair(Generic[AnyFrame]):
    """Corrected views of the exposures that two fluoroscopes a and b have in common."""

    def __init__(
        self,
        exposures: Sequence[Mapping[str, AnyFrame]],
        corrected: Callable[[AnyFrame], CorrectedView],
        geometry: EpipolarGeometry,
    ) -> None:
        a, b = geometry.fluoroscopes
        self.exposures = [(one[a], one[b]) for one in exposures if a in one and b in one]
        self._b = {one[b].number: one[b] for one in exposures if b in one}
        self._corrected = corrected
        self._geometry = geometry
        self._most = min(MAX_LAG, max(1, len(self.exposures) // LAG_SHARE))

    def number(self, row: int) -> int:
        """Return the number of an exposure."""
        return self.exposures[row][0].number

    def track(self, rows: range) -> Track:
        """Return the points of exposures, of at most MAX_EXPOSURES that are evenly spaced."""
        steps = np.linspace(0, len(rows) - 1, min(MAX_EXPOSURES, len(rows)))
        most = MAX_POINTS // max(len(steps), 1)
        parts = [self._points(rows[step], most) for step in steps.astype(int)]
        points = joined_rows([self._no_points(), *parts])
        in_a, in_b = points.uv[:, 0], points.uv[:, 1:]
        sigma_a, sigma_b = points.sigma[:, 0], points.sigma[:, 1:]
        present = self._geometry.residuals(
            in_a, in_b[:, self._most], sigma_a, sigma_b[:, self._most]
        )
        residual = np.column_stack(
            [self._geometry.misses(in_a, of_lag) for of_lag in in_b.swapaxes(0, 1)]
        )
        variance = present.factor_a**2 * points.noise[:, 0]
        variance += present.factor_b**2 * points.noise[:, 1 + self._most]
        columns = residual[:, self._most - 1 : self._most + 2]
        near = np.asarray(np.isfinite(columns).all(axis=1))
        return Track(
            chosen_rows(points, near), self._geometry, residual[near], variance=variance[near]
        )

    def _no_points(self) -> Points:
        count = 2 * self._most + 2
        ids = np.zeros(0, dtype=np.int64)
        return Points(
            ids, ids, np.zeros((0, count, 2)), np.zeros((0, count)), np.zeros((0, count))
        )

    def _points(self, row: int, most: int) -> Points:
        """Return the points of an exposure, at most so many of its targets."""
        of_a, of_b = self.exposures[row]
        numbers = range(of_b.number - self._most, of_b.number + self._most + 1)
        frames = [of_a, *map(self._b.get, numbers)]
        matched = match_views([None if f is None else self._corrected(f) for f in frames])
        seen = np.flatnonzero(np.isfinite(matched.uv[0, :, 0]))
        seen = seen[:: -(-len(seen) // most) or 1]
        sigma = matched.sigma[:, seen].T
        # An error of the correction is the same in neighbouring frames: it is no noise.
        noise = np.maximum(sigma**2 - matched.correction_sd[:, seen].T ** 2, MIN_NOISE_PX**2)
        return Points(
            np.asarray(matched.target_id)[seen],
            np.full(len(seen), row),
            np.swapaxes(matched.uv[:, seen], 0, 1),
            sigma=sigma,
            noise=noise,
        )
