# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Points and bodies as the formats of motion analysis hold them: every frame, at one rate."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...bodies.body import BodyPoses
from ...errors import DataError
from ...exposures.names import without_trivial
from .content import Bodies, Content, FileSettings, Points

# Names of targets in formats that need one.


def default_name(target_id: int) -> str:
    """Return the name of a target without one, as XMALab calls its markers: marker001."""
    return f'marker{target_id:03d}'


def named_targets(ids: Mapping[str, int]) -> dict[str, int]:
    """Return the ids of the names that a person has given."""
    return {name: i for name, i in without_trivial(ids).items() if name != default_name(i)}


MAX_FRAMES = 10**6
NS = 1e9  # of a second


@dataclass(frozen=True)
class Frames:
    """All frames of a recording: the first, how many there are, and their rate, NaN if unknown."""

    first: int
    count: int
    rate_hz: float

    @property
    def numbers(self) -> NDArray[np.int64]:
        """Numbers (m,) of the frames."""
        return np.arange(self.first, self.first + self.count)

    @property
    def times_s(self) -> NDArray[np.float64]:
        """Times (m,) after the first frame [s]."""
        return np.arange(self.count) / self.rate_hz

    def expanded(self, frame: np.ndarray, values: np.ndarray) -> NDArray[np.float64]:
        """Return values (m, ...) of all frames, NaN for those that are not in frame (k,)."""
        out = np.full((self.count, *values.shape[1:]), np.nan)
        out[frame - self.first] = values
        return out


def frames_of(
    path: Path,
    parts: Sequence[Points | Bodies],
    settings: FileSettings,
    needs_rate: bool = True,
) -> Frames:
    """Return the frames from the first to the last one of points and bodies.

    Raises DataError where a rate is needed and unknown, and for too many frames.
    """
    rates = (settings.rate_hz, *(part.rate_hz for part in parts))
    rate = next((rate for rate in rates if rate), None if needs_rate else math.nan)
    if rate is None:
        raise DataError(f'{path}: the source does not contain the frame rate, --rate HZ is needed')
    first = min(int(part.frame[0]) for part in parts)
    count = max(int(part.frame[-1]) for part in parts) - first + 1
    if count > MAX_FRAMES:
        raise DataError(f'{path}: frames {first} to {first + count - 1} are too many to write')
    return Frames(first, count, float(rate))


def points_of(points: Points, frames: Frames) -> Points:
    """Return points with all frames."""
    return replace(
        points,
        frame=frames.numbers,
        xyz_mm=frames.expanded(points.frame, points.xyz_mm),
        sd_mm=frames.expanded(points.frame, points.sd_mm),
        residual_px=frames.expanded(points.frame, points.residual_px),
        rate_hz=frames.rate_hz,
    )


def bodies_of(bodies: Bodies, frames: Frames) -> Bodies:
    """Return bodies with all frames."""
    return replace(
        bodies,
        frame=frames.numbers,
        rotation=frames.expanded(bodies.frame, bodies.rotation),
        translation_mm=frames.expanded(bodies.frame, bodies.translation_mm),
        rate_hz=frames.rate_hz,
    )


def rate_of(frame: np.ndarray, stamp_ns: np.ndarray) -> float | None:
    """Return the frames per second between the first and the last time stamp, None without."""
    first = int(np.argmin(frame))
    last = int(np.argmax(frame))
    seconds = (stamp_ns[last] - stamp_ns[first]) / NS
    if not seconds > 0:
        return None
    rate = (frame[last] - frame[first]) / seconds
    whole = round(rate)
    # Stamps are rounded to nanoseconds, clocks to some millionths.
    return float(whole) if whole and abs(rate - whole) < 1e-5 * whole else float(rate)


def bodies_of_poses(poses: Sequence[BodyPoses]) -> Bodies:
    """Return the poses of bodies as a part of a Content; the rate is that of their stamps.

    Raises DataError for no bodies and for poses of other exposures.
    """
    if not poses or any(not np.array_equal(p.number, poses[0].number) for p in poses):
        raise DataError('poses of bodies are written of one body at least, and the same exposures')
    return Bodies(
        tuple(p.body for p in poses),
        poses[0].number,
        np.stack([p.rotation for p in poses], axis=1),
        np.stack([p.position_mm for p in poses], axis=1),
        rate_hz=rate_of(poses[0].number, poses[0].stamp_ns),
    )


def labels(content: Content) -> list[str]:
    """Return the names of the targets; those without a name are marker001, marker002, ..."""
    assert content.points is not None
    named = content.names.target_names()
    return [named.get(i, default_name(i)) for i in content.points.target_id.tolist()]
