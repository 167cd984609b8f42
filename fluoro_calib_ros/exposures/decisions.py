# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Doubtful image points and exposures, and what a person decides on them."""

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
    """An image point whose id may be wrong, or an exposure that may not be usable."""

    fluoroscope: str
    #: exposures
    first: int
    last: int
    target_id: int | None  #: None: the exposure as a whole
    reason: str
    others: tuple[int, ...] = ()  #: targets that it may be, the likeliest first
    uv: tuple[float, float] | None = None  #: [px], of a single image point
    residual_px: float = np.nan


@dataclass(frozen=True)
class PointDecision:
    """What a person decides: an image point or an exposure is left out, or gets another id."""

    where: str  #: file and row
    fluoroscope: str
    #: exposures that it holds for
    first: int
    last: int
    target_id: int | None  #: as it is in the source; None: all of the exposure
    new_id: int | None = None  #: None: it is left out


def decided(
    frames: Frames, decisions: Sequence[PointDecision]
) -> tuple[dict[str, list[Frame]], tuple[int, int, int]]:
    """Return the frames after decisions; how many exposures and points are left out, and renamed.

    Frames without points are left out. Raises DataError, which names the row, for a decision on
    what is not there, and for one that gives an id twice in an exposure.
    """
    out: dict[str, list[Frame]] = {}
    counts = np.zeros(3, dtype=int)
    met: set[int] = set()
    for name, of_one in frames.items():
        out[name] = []
        own = [(k, d) for k, d in enumerate(decisions) if d.fluoroscope == name]
        for frame in of_one:
            here = [(k, d) for k, d in own if d.first <= frame.number <= d.last]
            found = [(k, d) for k, d in here if _rows(frame, d).any()]
            met.update(k for k, _ in found)
            left, points, renamed = _decided(frame, [d for _, d in found])
            counts += (left is None, points, renamed)
            out[name] += [] if left is None else [left]
    for k, decision in enumerate(decisions):
        if k not in met:
            raise DataError(f'{decision.where}: {_missing(frames, decision)}')
    exposures, points, renamed = counts.tolist()
    return out, (exposures, points, renamed)


def _decided(frame: Frame, decisions: Sequence[PointDecision]) -> tuple[Frame | None, int, int]:
    """Return a frame after decisions on it, and how many points are left out, and renamed."""
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
        again = int(ids[keep][pair[0]])
        cause = next((d for d in decisions if d.new_id == again), decisions[0])
        raise DataError(
            f'{cause.where}: exposure {frame.number} then has target {again} twice; decide on '
            'the other image point, too'
        )
    sigma = None if frame.sigma is None else frame.sigma[keep]
    changed = replace(frame, target_id=ids[keep], uv=frame.uv[keep], sigma=sigma)
    renamed = int(np.count_nonzero(ids[keep] != frame.target_id[keep]))
    return changed, int((~keep).sum()), renamed


def _rows(frame: Frame, decision: PointDecision) -> NDArray[np.bool_]:
    """Return which image points (n,) of a frame a decision is on."""
    if decision.target_id is None:
        return np.ones(len(frame.target_id), dtype=bool)
    return np.asarray(frame.target_id) == decision.target_id


def _missing(frames: Frames, decision: PointDecision) -> str:
    """Return what is not there of a decision, in words."""
    name = decision.fluoroscope
    if name not in frames:
        return f'there is no fluoroscope {name!r}, only {", ".join(frames)}'
    span = range(decision.first, decision.last + 1)
    where = f'{span[0]} to {span[-1]}' if len(span) > 1 else f'{span[0]}'
    if not any(frame.number in span for frame in frames[name]):
        return f'fluoroscope {name} has no exposure {where}'
    return f'exposure {where} of fluoroscope {name} has no target {decision.target_id}'
