# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Exposures of a phantom that stands still, which count as one.

The frames of a film of a standing phantom differ by a part of their noise only: their errors of
extraction, which depend on what is round a bead, are the same. Taken as so many exposures they
would be believed more than they know, and take their time. Their mean is one exposure.
"""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..findings import Finding, Kind, Place, Severity
from .collector import MIN_COMMON_TARGETS, StillOptions
from .frame import Frame

STILL_PX = StillOptions().still_px  # median displacement of the targets
SHARE = 0.5  # of the targets of a frame that another one of the same pose has
SAME_ANGLE_RAD = 1e-3  # of the C-arm

Frames = Mapping[str, Sequence[Frame]]


def without_repeats(
    frames: Frames, known: Container[str] = ()
) -> tuple[dict[str, list[Frame]], list[Finding]]:
    """Return the frames with those of one pose joined, and a finding for each fluoroscope.

    Fluoroscopes of one rig see the same phantom: exposures are of one pose where they are so in
    the images of all fluoroscopes that have both. known: fluoroscopes of which a repeated pose is
    no repeated exposure, as their orientation is given.
    """
    images = {
        name: {frame.number: frame for frame in of_one}
        for name, of_one in frames.items()
        if name not in known
    }
    groups = _groups(images)
    repeated = {later for group in groups for later in group[1:]}
    out = {}
    findings = []
    for name, of_one in frames.items():
        if name not in images:
            out[name] = list(of_one)
            continue
        joined = []
        for group in groups:
            own = [images[name][number] for number in group if number in images[name]]
            if own:
                joined.append(_joined(own, group[0]))
        out[name] = joined
        numbers = tuple(sorted(int(number) for number in images[name] if number in repeated))
        if numbers:
            findings.append(
                Finding(
                    Kind.REPEATED_POSE,
                    f'{len(numbers)} exposures show the phantom in the pose of an earlier one, '
                    'and count as one exposure with it',
                    Place((name,), numbers, name=f'fluoroscope {name}'),
                    severity=Severity.NOTE,
                    numbers={'exposures': len(numbers)},
                )
            )
    return out, findings


def _groups(images: Mapping[str, Mapping[int, Frame]]) -> list[list[int]]:
    """Numbers of the exposures of each pose, in order."""
    numbers = sorted({number for of_one in images.values() for number in of_one})
    tables = [_Table(list(of_one.values())) for of_one in images.values()]
    groups: list[list[int]] = []
    for number in numbers:
        first = np.array([group[0] for group in groups], dtype=np.int64)
        same = np.zeros(len(first), dtype=bool)
        other = np.zeros(len(first), dtype=bool)
        for table in tables:
            is_same, is_other = table.compare(number, first)
            same |= is_same
            other |= is_other
        there = np.flatnonzero(same & ~other)
        if len(there):
            groups[there[0]].append(number)
        else:
            groups.append([number])
    return groups


class _Table:
    """Image points of the frames of a fluoroscope by frame and target, NaN where not seen."""

    def __init__(self, frames: Sequence[Frame]) -> None:
        ids = np.unique(np.concatenate([frame.target_id for frame in frames]))
        self._row = {frame.number: row for row, frame in enumerate(frames)}
        self._uv = np.full((len(frames), len(ids), 2), np.nan)
        self._angle = np.array([np.nan if f.angle is None else f.angle for f in frames])
        for own, frame in zip(self._uv, frames):
            own[np.searchsorted(ids, frame.target_id)] = frame.uv

    def compare(self, number: int, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return whether exposures (k,) have the pose of one, and whether they have another."""
        same = np.zeros(len(others), dtype=bool)
        has = np.array([other in self._row for other in others.tolist()], dtype=bool)
        if number not in self._row or not has.any():
            return same, same.copy()
        row = self._row[number]
        rows = np.array([self._row[other] for other in others[has].tolist()])
        distance = np.linalg.norm(self._uv[rows] - self._uv[row], axis=2)
        common = np.isfinite(distance)
        seen = np.isfinite(self._uv[..., 0]).sum(axis=1)
        enough = SHARE * np.minimum(seen[rows], seen[row])
        comparable = common.sum(axis=1) >= np.maximum(MIN_COMMON_TARGETS, enough)
        still = np.zeros(len(rows), dtype=bool)
        for place in np.flatnonzero(comparable):
            still[place] = np.median(distance[place][common[place]]) <= STILL_PX
        turned = np.abs(self._angle[rows] - self._angle[row]) > SAME_ANGLE_RAD
        same[has] = still & ~turned
        return same, has & ~same


def _joined(frames: Sequence[Frame], number: int) -> Frame:
    """Frame of a number with the medians of the image points of frames, of two their mean."""
    first = frames[0]
    if len(frames) == 1:
        return first if first.number == number else replace(first, number=number)
    ids = np.unique(np.concatenate([frame.target_id for frame in frames]))
    values = np.full((len(frames), len(ids), 3), np.nan)
    for own, frame in zip(values, frames):
        at = np.searchsorted(ids, frame.target_id)
        own[at, :2] = frame.uv
        if frame.sigma is not None:
            own[at, 2] = frame.sigma
    sigma = None
    if all(frame.sigma is not None for frame in frames):
        sigma = np.nanmedian(values[..., 2], axis=0)
    uv = np.nanmedian(values[..., :2], axis=0)
    return replace(first, number=number, target_id=ids, uv=uv, sigma=sigma)
