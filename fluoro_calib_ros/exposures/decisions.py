# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Doubtful image points and exposures, and decisions of a person on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError
from .frame import Frame, Frames
from .phantom import first_repeated


@dataclass(frozen=True)
class Doubtful:
    """An image point whose id may be wrong, or an exposure that may be unusable."""

    fluoroscope: str
    #: first and last exposure
    first: int
    last: int
    target_id: int | None  #: None: the whole exposure
    reason: str
    others: tuple[int, ...] = ()  #: ids that the target may have, likeliest first
    uv: tuple[float, float] | None = None  #: position of a single image point [px]
    residual_px: float = np.nan


@dataclass(frozen=True)
class PointDecision:
    """Decision of a person: exclude an image point or an exposure, or change the id of a point."""

    where: str  #: file and row
    fluoroscope: str
    #: first and last exposure to which it applies
    first: int
    last: int
    target_id: int | None  #: id in the source; None: the whole exposure
    new_id: int | None = None  #: None: exclude


def decided(
    frames: Frames, decisions: Sequence[PointDecision]
) -> tuple[dict[str, list[Frame]], tuple[int, int, int]]:
    """Apply decisions to frames; return them, and counts of exclusions and changes.

    The counts are those of excluded exposures, excluded points and changed ids. Frames without
    points are excluded. Raises DataError that names the row, for a decision on something that does
    not exist, and for one that gives an id twice in an exposure.
    """
    result_frames: dict[str, list[Frame]] = {}
    counts = np.zeros(3, dtype=int)
    applied: set[int] = set()
    for name, view_frames in frames.items():
        result_frames[name] = []
        view_decisions = [(k, d) for k, d in enumerate(decisions) if d.fluoroscope == name]
        for frame in view_frames:
            frame_decisions = [
                (k, d) for k, d in view_decisions if d.first <= frame.number <= d.last
            ]
            matching = [(k, d) for k, d in frame_decisions if _rows(frame, d).any()]
            applied.update(k for k, _ in matching)
            remaining_frame, points, renamed = _decided(frame, [d for _, d in matching])
            counts += (remaining_frame is None, points, renamed)
            result_frames[name] += [] if remaining_frame is None else [remaining_frame]
    for k, decision in enumerate(decisions):
        if k not in applied:
            raise DataError(f'{decision.where}: {_missing(frames, decision)}')
    exposures, points, renamed = counts.tolist()
    return result_frames, (exposures, points, renamed)


def _decided(frame: Frame, decisions: Sequence[PointDecision]) -> tuple[Frame | None, int, int]:
    """Apply decisions to a frame; return it, and counts of excluded points and changed ids."""
    if not decisions:
        return frame, 0, 0
    keep = np.ones(len(frame.target_id), dtype=bool)
    ids = np.array(frame.target_id)
    for decision in decisions:
        rows = _rows(frame, decision)
        if decision.new_id is None:
            keep &= ~rows
        else:
            ids[rows] = decision.new_id
    if not keep.any():
        return None, 0, 0
    pair = first_repeated(ids[keep])
    if pair is not None:
        repeated_id = int(ids[keep][pair[0]])
        cause = next((d for d in decisions if d.new_id == repeated_id), decisions[0])
        raise DataError(
            f'{cause.where}: exposure {frame.number} then has target {repeated_id} twice; decide '
            'on the other image point as well'
        )
    changed = replace(frame, target_id=ids).rows(keep)
    renamed = int(np.count_nonzero(ids[keep] != frame.target_id[keep]))
    return changed, int((~keep).sum()), renamed


def _rows(frame: Frame, decision: PointDecision) -> NDArray[np.bool_]:
    """Return the image points (n,) of a frame to which a decision applies, as a mask."""
    if decision.target_id is None:
        return np.ones(len(frame.target_id), dtype=bool)
    return np.asarray(frame.target_id) == decision.target_id


def _missing(frames: Frames, decision: PointDecision) -> str:
    """Return a clause that names the missing object of a decision."""
    name = decision.fluoroscope
    if name not in frames:
        return f'there is no fluoroscope {name!r}, only {", ".join(frames)}'
    span = range(decision.first, decision.last + 1)
    range_text = f'{span[0]} to {span[-1]}' if len(span) > 1 else f'{span[0]}'
    if not any(frame.number in span for frame in frames[name]):
        return f'fluoroscope {name} has no exposure {range_text}'
    return f'exposure {range_text} of fluoroscope {name} has no target {decision.target_id}'
