# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Targets of a recording that are rejected in most of their exposures, and the cause.

False matches come and go. A target whose rays miss each other most of the time has another id in
one of the images, often that of a second such target.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ..exposures.frame import Frame
from ..findings import Finding, Kind, Place, Severity
from .epipolar import BETTER, MAX_REJECTED, MAX_TRIED, MIN_POINTS
from .intersection import FAILED, OK, OUTSIDE, REJECTED
from .reconstruct import ReconstructedFrame, RigRecording

MAX_PAIRED = 8  # targets of which each pair is tried: 28 pairs


def lost_targets(
    recording: RigRecording, reconstruction: Sequence[ReconstructedFrame]
) -> list[Finding]:
    """Return findings on targets that are rejected in most of their exposures.

    Pairs that are exchanged in one fluoroscope come first. Two fluoroscopes do not show in which.
    """
    lost = _lost(reconstruction)
    if len(lost) > 1:
        recording = recording.numbered()
    findings = []
    for pair in combinations(lost[:MAX_PAIRED], 2):
        if not set(pair) <= set(lost):
            continue
        numbers = _exposures_of(reconstruction, pair)
        some = recording.selected(numbers)
        fitting = []
        for name in recording.fluoroscopes:
            changed = {**some, name: [_exchanged(frame, pair) for frame in some[name]]}
            rejected, total = _counts(recording.with_frames(changed).reconstruct(), pair)
            if total.all() and (rejected < BETTER * total).all():
                fitting.append(name)
        if fitting:
            findings.append(_exchange(pair, fitting))
            lost = [target for target in lost if target not in pair]
    return [*findings, *([_rejected(lost)] if lost else [])]


def _lost(reconstruction: Sequence[ReconstructedFrame]) -> list[int]:
    """Return the targets that are rejected in most of the exposures that show them twice."""
    targets = np.unique(np.concatenate([frame.target_id for frame in reconstruction]))
    rejected, total = _counts(reconstruction, targets)
    is_lost = (total >= MIN_POINTS) & (rejected > MAX_REJECTED * total)
    return [int(target) for target in targets[is_lost]]


def _counts(
    reconstruction: Sequence[ReconstructedFrame], targets: Sequence[int] | NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return in how many exposures (n,) targets, in order, are rejected, and seen twice."""
    target_id = np.concatenate([frame.target_id for frame in reconstruction])
    status = np.concatenate([frame.points.status for frame in reconstruction])
    chosen = np.isin(target_id, targets)
    row = np.searchsorted(targets, target_id[chosen])
    rejected = np.isin(status[chosen], (REJECTED, FAILED))
    seen_twice = rejected | np.isin(status[chosen], (OK, OUTSIDE))
    count = len(targets)
    return np.bincount(row, rejected, count), np.bincount(row, seen_twice, count)


def _exposures_of(reconstruction: Sequence[ReconstructedFrame], pair: Sequence[int]) -> set[int]:
    """Return the numbers of some exposures that show both targets."""
    shown = [frame.number for frame in reconstruction if np.isin(pair, frame.target_id).all()]
    return set(shown[:: len(shown) // MAX_TRIED + 1])


def _exchanged(frame: Frame, pair: Sequence[int]) -> Frame:
    """Return a frame with the ids of two targets exchanged."""
    target_id = frame.target_id.copy()
    for old, new in zip(pair, reversed(pair)):
        target_id[frame.target_id == old] = new
    return replace(frame, target_id=target_id)


def _exchange(pair: Sequence[int], names: Sequence[str]) -> Finding:
    cause = (
        f'targets {pair[0]} and {pair[1]} are exchanged in fluoroscope {" or ".join(names)}: most '
        'of their rays miss each other, and meet with exchanged ids'
    )
    return Finding(
        Kind.TARGETS_EXCHANGED,
        cause,
        Place(tuple(names), target_id=tuple(pair), name=''),
        severity=Severity.WARNING,
        numbers={'targets': len(pair)},
    )


def _rejected(lost: Sequence[int]) -> Finding:
    targets = ', '.join(str(target) for target in lost)
    return Finding(
        Kind.TARGETS_REJECTED,
        f'most rays of the targets {targets} miss each other',
        Place(target_id=tuple(lost), name=''),
        advice='check their ids in each fluoroscope',
        severity=Severity.WARNING,
        numbers={'targets': len(lost)},
    )
