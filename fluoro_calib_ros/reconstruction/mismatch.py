# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Recordings whose rays do not meet: most points are rejected, and why is found by trial.

A share of false matches is borne. Where most rays miss each other, the frames, ids, fluoroscopes
or coordinates are confused, or the orientation does not hold, and what meets does so by chance.
Where they miss each other by a little, the same trials may tell why.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from ..correction.fluoroscope_calibration import FluoroscopeCalibration
from ..correction.registry import no_correction
from ..exposures.frame import Frame
from ..findings import Finding, Kind
from .intersection import (
    FAILED,
    OK,
    OUTSIDE,
    REJECTED,
    SINGLE_VIEW,
    STATUS_NAMES,
    IntersectedPoints,
    Intersector,
)
from .reconstruct import ReconstructedFrame, reconstruct_recording

MIN_POINTS = 20  # of two views, by which a recording is judged
MAX_REJECTED = 0.5  # share of the points of two views
CORRECTED = Finding(Kind.CORRECTED_ALREADY, 'the image points are corrected already')
MAX_TRIED = 10  # exposures
UNKNOWN = Finding(
    Kind.RAYS_DO_NOT_MEET,
    'the frames, target ids or image coordinates do not belong together, the fluoroscopes are '
    'interchanged, or one was moved since its orientation was determined',
)
UNMATCHED = Finding(
    Kind.NO_COMMON_TARGETS,
    'no target is seen by two fluoroscopes in one exposure',
    advice='the target ids of the fluoroscopes, or the numbers of their frames, do not belong '
    'together',
)
RECENT = 100  # exposures of a stream
# Share of rejected points of a trial, and median miss of one, over those of the recording, from
# which the trial tells the cause.
BETTER = 0.3
CLOSER = 0.6

Frames = Mapping[str, Sequence[Frame]]
Trial = tuple[Finding, dict[str, list[Frame]]]


class RecentMisses:
    """Share of the rays of recent exposures of a stream that miss each other."""

    def __init__(self) -> None:
        self._recent: deque[tuple[int, int, int]] = deque(maxlen=RECENT)

    def add(self, points: IntersectedPoints) -> None:
        """Add the points of an exposure."""
        self._recent.append(_counts(points.status))

    def message(self) -> str:
        """Return a sentence where points of the recent exposures cannot be right, else ''."""
        bad, total, single = (sum(column) for column in zip(*list(self._recent) or [(0, 0, 0)]))
        if not total and single >= MIN_POINTS:
            return UNMATCHED.sentence
        if total < MIN_POINTS or bad <= MAX_REJECTED * total:
            return ''
        return _missing(bad / total, UNKNOWN).sentence


def _missing(share: float, why: Finding) -> Finding:
    """Return the finding that a share of the rays miss each other for a reason."""
    cause = f'{100 * share:.0f} % of the rays miss each other: {why.cause}'
    return replace(why, cause=cause, numbers={**why.numbers, 'share': share})


def share_rejected(found: Sequence[ReconstructedFrame]) -> tuple[float, int]:
    """Return the share of rejected points, and the number of points of two views."""
    status = np.concatenate([frame.points.status for frame in found] or [np.empty(0, int)])
    bad, total, _ = _counts(status)
    return bad / max(total, 1), total


def _counts(status: np.ndarray) -> tuple[int, int, int]:
    """Number of rejected points, of points of two views, and of points of a single one."""
    counts = np.bincount(status, minlength=len(STATUS_NAMES))
    bad = int(counts[REJECTED] + counts[FAILED])
    return bad, bad + int(counts[OK] + counts[OUTSIDE]), int(counts[SINGLE_VIEW])


def mismatch(
    found: Sequence[ReconstructedFrame],
    frames: Frames,
    calibrations: Mapping[str, FluoroscopeCalibration],
    intersector: Intersector,
    pair_by: str,
) -> Finding | None:
    """Return why a reconstruction cannot be right, None where nothing is wrong with it."""
    share, total = share_rejected(found)
    seen = sum(len(frame.target_id) for frame in found)
    if not total and seen >= MIN_POINTS:
        return UNMATCHED
    if total < MIN_POINTS or share <= MAX_REJECTED:
        return None
    names = intersector.orientation.fluoroscopes
    for why, changed in _trials(frames, names, _largest(found)):
        tried, _ = reconstruct_recording(changed, calibrations, intersector, pair_by)
        rejected, count = share_rejected(tried)
        if count >= MIN_POINTS and rejected < BETTER * share:
            return _missing(share, why)
    return _missing(share, UNKNOWN)


def cause_of_misses(
    found: Sequence[ReconstructedFrame],
    frames: Frames,
    calibrations: Mapping[str, FluoroscopeCalibration],
    intersector: Intersector,
    pair_by: str,
) -> Finding | None:
    """Return why rays miss each other by more than they should, None where no trial tells it.

    The trials are those of `mismatch`, and image points that are corrected already.
    """
    names = intersector.orientation.fluoroscopes
    numbers = _largest(found)
    limit = CLOSER * _miss([frame for frame in found if frame.number in numbers])
    uncorrected = {
        name: replace(calibrations[name], model=no_correction(), angle_field=None)
        for name in names
    }
    tried = {name: [f for f in frames[name] if f.number in numbers] for name in names}
    trials = [(CORRECTED, tried), *_trials(frames, names, numbers)]
    misses = []
    for why, changed in trials:
        used = uncorrected if why is CORRECTED else calibrations
        again, _ = reconstruct_recording(changed, used, intersector, pair_by)
        misses.append(_miss(again))
    best = int(np.argmin(misses))
    return trials[best][0] if misses[best] < limit else None


def _largest(found: Sequence[ReconstructedFrame]) -> set[int]:
    """Numbers of the frames with the most targets, on which causes are tried."""
    largest = sorted(found, key=lambda frame: -len(frame.target_id))[:MAX_TRIED]
    return {frame.number for frame in largest}


def _miss(found: Sequence[ReconstructedFrame]) -> float:
    """Median miss of the rays over its standard deviation, infinite where there are few."""
    points = [frame.points for frame in found]
    size = np.concatenate([p.standardised[p.status != SINGLE_VIEW] for p in points] or [[]])
    if len(size) < MIN_POINTS:
        return np.inf
    return float(np.median(np.where(np.isfinite(size), size, np.inf)))


def _trials(frames: Frames, names: Sequence[str], numbers: set[int]) -> list[Trial]:
    """Return findings on what may be confused, each with the frames put right.

    numbers are those of the frames to try.
    """
    tried = {name: [f for f in frames[name] if f.number in numbers] for name in names}
    out = []
    for one, other in pairwise(names):
        if _size(tried[one]) == _size(tried[other]):
            exchanged = {
                **tried,
                one: [replace(frame, fluoroscope=one) for frame in tried[other]],
                other: [replace(frame, fluoroscope=other) for frame in tried[one]],
            }
            cause = f'fluoroscopes {one} and {other} are interchanged'
            out.append((Finding(Kind.FLUOROSCOPES_INTERCHANGED, cause), exchanged))
    for name in names[1:]:
        for step, word in ((1, 'small'), (-1, 'large')):
            numbered = [replace(f, number=f.number + step) for f in frames[name]]
            numbered = [f for f in numbered if f.number in numbers]
            labelled = [replace(f, target_id=f.target_id + step) for f in tried[name]]
            for kind, what, right in (
                (Kind.FRAMES_SHIFTED, 'frame numbers', numbered),
                (Kind.IDS_SHIFTED, 'target ids', labelled),
            ):
                cause = f'the {what} of fluoroscope {name} are too {word} by 1'
                out.append(
                    (Finding(kind, cause, numbers={'shift': -step}), {**tried, name: right})
                )
    return out + _other_axes(tried)


def _other_axes(frames: Mapping[str, list[Frame]]) -> list[Trial]:
    """Return trials of other directions of u and v, in all fluoroscopes or one."""
    out = []
    for kind, cause, change in (
        (Kind.IMAGE_TRANSPOSED, 'u and v are interchanged', _transposed),
        (Kind.IMAGE_MIRRORED, 'v runs upwards', _upside_down),
    ):
        everywhere = {name: [change(f) for f in of_one] for name, of_one in frames.items()}
        out.append((Finding(kind, cause), everywhere))
        out += [
            (Finding(kind, f'{cause} in fluoroscope {name}'), {**frames, name: changed})
            for name, changed in everywhere.items()
        ]
    return out


def _size(frames: Sequence[Frame]) -> tuple[int, int] | None:
    return frames[0].image_size if frames else None


def _transposed(frame: Frame) -> Frame:
    return replace(frame, uv=frame.uv[:, ::-1].copy())


def _upside_down(frame: Frame) -> Frame:
    height = frame.image_size[1]
    return replace(frame, uv=np.column_stack([frame.uv[:, 0], height - 1 - frame.uv[:, 1]]))
