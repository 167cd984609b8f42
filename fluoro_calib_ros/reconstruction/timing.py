# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Delays between the fluoroscopes of a recording, estimated from rays that miss each other.

If fluoroscope b takes its images d frame intervals after a, the epipolar residual of a moving
point is d times its change from one frame of b to the next. Residuals due to any change of the
rig are linear in that of the essential matrix, and are eliminated (Frisch and Waugh, Econometrica
1, 1933), so that only a motion that no rig explains counts as a delay. If a frame is lost, later
ones are paired with those of the neighbouring exposure: the delay changes by one interval.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, permutations
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..exposures.stamps import NS_PER_S
from ..findings import Finding, Kind, Place, Severity
from ..photogrammetry.rig_orientation import RigOrientation
from ..rows import chosen_rows, joined_rows
from .epipolar import RECENT, EpipolarGeometry, RecentMisses
from .intersection import IntersectedPoints
from .reconstruct import CorrectedView, RigRecording, match_views

MAX_EXPOSURES = 200  # number of exposures tested: they determine a delay to 0.01 frame intervals
MIN_SIGMAS = 5.0  # minimum delay over its standard deviation: one in a million by chance
MAX_FRAMES = 1.0  # maximum delay: neighbouring frames show no motion beyond them
WHOLE = 0.1  # maximum difference of an uncertain delay from a frame interval that it may be
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
# Maximum share by which the loss that remains exceeds that of the noise. It is 0.12 if a frame is
# lost, and at least 0.14 if something else is wrong and a lost frame seems to explain it.
MAX_EXCESS = 0.25
KEPT = 0.796  # weighted variance of normal residuals over their variance, by these weights


class TimedFrame(Protocol):
    """Frame of a fluoroscope, such as a Frame."""

    @property
    def number(self) -> int:
        """Number of the frame."""

    @property
    def stamp_ns(self) -> int:
        """Time of the frame [ns], 0 if unknown."""


AnyFrame = TypeVar('AnyFrame', bound=TimedFrame)


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
    motions = {}
    delays: dict[str, Delay] = {}
    for name in others:
        geometry = EpipolarGeometry(orientation, first, name)
        motions[name] = _motion(exposures, corrected, geometry)
        delay = fitted_delay(motions[name])
        if delay is not None and delay.is_cause:
            delays[name] = delay
    if delays:
        name = max(delays, key=lambda n: abs(delays[n].frames) / delays[n].sd)
        return delay_finding((first, name), delays[name], _interval_s(exposures, first))
    lost = (find_lost_frame((first, name), motion) for name, motion in motions.items())
    return next((finding for finding in lost if finding is not None), None)


class RecentExposures(Generic[AnyFrame]):
    """Recent exposures of a stream, whose rays and timing are judged.

    corrected: returns the corrected view of a frame.
    """

    def __init__(self, corrected: Callable[[AnyFrame], CorrectedView]) -> None:
        self._corrected = corrected
        self._recent: deque[Mapping[str, AnyFrame]] = deque(maxlen=RECENT)
        self._misses = RecentMisses()

    def add(self, exposure: Mapping[str, AnyFrame], points: IntersectedPoints) -> None:
        """Add an exposure, frames by fluoroscope, with its points."""
        self._recent.append(exposure)
        self._misses.add(points)

    def faults(
        self, orientation: RigOrientation, is_doubtful: bool
    ) -> tuple[Finding | None, Finding | None]:
        """Return why most rays miss each other, and the fault of the timing, each or None.

        The timing, which takes 0.05 s, is only judged if most rays miss each other, or if the rig
        is doubtful for another reason.
        """
        timing = None
        if is_doubtful or self._misses.finding() is not None:
            timing = timing_fault(list(self._recent), self._corrected, orientation)
        return self._misses.finding(timing), timing


def timing_of_recording(recording: RigRecording) -> Finding | None:
    """Return the fault of the timing of a recording, or None; see `timing_fault`."""
    return timing_fault(recording.exposures, recording.corrected, recording.orientation)


@dataclass(frozen=True)
class Motion:
    """Epipolar residuals of n points in motion, in fluoroscopes a and b."""

    target_id: NDArray[np.int64]  #: (n,)
    exposure: NDArray[np.int64]  #: (n,), numbers of the exposures, ascending
    #: (n, 3), residuals of a's points with b's points in its previous, the same, and its next
    #: frame [px]
    residual: NDArray[np.float64]
    #: (n,), variance of the residuals by the noise of image points, and the part due to b [px^2]
    variance: NDArray[np.float64]
    noise: NDArray[np.float64]
    #: (n, 9), derivatives by the elements of the essential matrix, apart from its scale, which
    #: changes no epipolar line
    by_rig: NDArray[np.float64]


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
        is_significant = self.margin < abs(self.frames) < MAX_FRAMES + self.margin
        return is_significant and self.explained > MIN_EXPLAINED

    @property
    def margin(self) -> float:
        """Largest error of the delay."""
        return MIN_SIGMAS * self.sd


def fitted_delay(motion: Motion) -> Delay | None:
    """Estimate the delay by reweighted least squares; return None if nothing moves.

    Images that b takes late by the delay show the points after the time of a. The second
    differences of the residuals contribute half of the squared delay.
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
    return Delay(delay, float(np.sqrt(sums @ sums) / information), share)


def find_lost_frame(names: tuple[str, str], motion: Motion) -> Finding | None:
    """Return a warning if the delay of b changes by a frame interval, or None.

    The exposure at which it changes is the most likely one under Cauchy noise. Unlike that of a
    constant delay, this search cannot eliminate changes of the rig: nothing else may be wrong.
    """
    count = len(motion.exposure)
    begins = np.flatnonzero(np.diff(motion.exposure)) + 1  # first rows of the exposures
    if not len(begins):
        return None
    scale = ROBUST**2 * motion.variance[:, None]
    loss = np.cumsum(np.log1p(motion.residual**2 / scale), axis=0)
    # A point of a is that of the previous, the same or the next frame of b.
    sides = list(permutations(range(3), 2))
    totals = [loss[begins - 1, i] + loss[-1, j] - loss[begins - 1, j] for i, j in sides]
    side, row = np.unravel_index(np.argmin(totals), (len(sides), len(begins)))
    remaining = float(totals[side][row])
    gain = float(loss[-1].min()) - remaining
    excess = remaining - LOSS * count
    if gain < MIN_GAIN or excess > min(gain, MAX_EXCESS * LOSS * count):
        return None
    exposure = int(motion.exposure[begins[row]])
    first, then = sides[side]
    lost = names[1] if then < first else names[0]
    frames = abs(then - first)
    return Finding(
        Kind.FRAME_LOST,
        f'fluoroscope {lost} has lost {"a frame" if frames == 1 else f"{frames} frames"} before '
        f'exposure {exposure}',
        Place((lost,), (exposure,), name=''),
        f'add {frames} to the numbers of its frames from {exposure} on',
        Severity.WARNING,
        numbers={'exposure': exposure, 'frames': frames},
    )


def delay_finding(names: tuple[str, str], delay: Delay, interval_s: float) -> Finding:
    """Return the warning that the second of two fluoroscopes is delayed.

    interval_s: frame interval [s], 0 if unknown.
    """
    first, name = names
    size = abs(delay.frames)
    if size > 1 - min(delay.margin, WHOLE):  # a whole interval is the likelier cause
        shift = -1 if delay.frames > 0 else 1
        cause = (
            f'the frame numbers of fluoroscope {name} are too {"small" if shift < 0 else "large"} '
            'by 1'
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


def _interval_s(exposures: Sequence[Mapping[str, TimedFrame]], name: str) -> float:
    """Return the median interval of the frames of a fluoroscope [s], 0 without stamps."""
    stamps = [exposure[name].stamp_ns for exposure in exposures if name in exposure]
    return float(np.median(np.diff(stamps))) / NS_PER_S if len(stamps) > 1 else 0.0


def _motion(
    exposures: Sequence[Mapping[str, AnyFrame]],
    corrected: Callable[[AnyFrame], CorrectedView],
    geometry: EpipolarGeometry,
) -> Motion:
    """Return the residuals of exposures, evenly spaced, whose neighbours have frames of b."""
    a, b = geometry.fluoroscopes
    both = [exposure for exposure in exposures if a in exposure and b in exposure]
    successive = list(_successive(both, b))
    scale = geometry.essential.ravel() / np.linalg.norm(geometry.essential)
    ids, values = np.zeros(0, dtype=np.int64), np.zeros(0)
    parts = [Motion(ids, ids, np.zeros((0, 3)), values, values, by_rig=np.zeros((0, 9)))]
    steps = np.linspace(0, len(successive) - 1, min(MAX_EXPOSURES, len(successive)))
    for row in steps.astype(int):
        before, exposure, after = successive[row]
        frames = [exposure[a], before[b], exposure[b], after[b]]
        matched = match_views([corrected(frame) for frame in frames])
        in_a, *in_b = matched.uv
        sigma_a, _, sigma_b, _ = matched.sigma
        found = [geometry.residuals(in_a, uv, sigma_a, sigma_b) for uv in in_b]
        by_rig = geometry.by_essential(in_a, in_b[1])
        # An error of the correction is the same in neighbouring frames: it is no noise.
        noise = np.maximum(matched.sigma**2 - matched.correction_sd**2, MIN_NOISE_PX**2)
        noise_a, _, noise_b, _ = noise
        of_b = found[1].factor_b ** 2 * noise_b
        part = Motion(
            np.asarray(matched.target_id),
            np.full(len(matched.target_id), exposure[a].number),
            np.column_stack([one.residual for one in found]),
            found[1].factor_a ** 2 * noise_a + of_b,
            of_b,
            by_rig=by_rig - np.outer(by_rig @ scale, scale),
        )
        parts.append(chosen_rows(part, np.all(np.isfinite(part.residual), axis=1)))
    return joined_rows(parts)


def _successive(
    exposures: Sequence[Mapping[str, AnyFrame]], name: str
) -> Iterator[Sequence[Mapping[str, AnyFrame]]]:
    """Yield three exposures at a time whose frames of a fluoroscope follow each other."""
    follows = [two[name].number == one[name].number + 1 for one, two in pairwise(exposures)]
    for row, both in enumerate(pairwise(follows)):
        if all(both):
            yield exposures[row : row + 3]
