# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Points in space as the formats of motion analysis hold them: every frame, at a constant rate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...errors import DataError
from ...exposures.names import without_trivial
from .content import Content, FileSettings, Points

# Names of targets in formats that need one.


def default_name(target_id: int) -> str:
    """Return the name of a target without one, as XMALab calls its markers: marker001."""
    return f'marker{target_id:03d}'


def named_targets(ids: Mapping[str, int]) -> dict[str, int]:
    """Return the ids of the names that a person has given."""
    return {name: i for name, i in without_trivial(ids).items() if name != default_name(i)}


MAX_FRAMES = 10**6


def at_constant_rate(path: Path, content: Content, settings: FileSettings) -> Points:
    """Return the points of a content with all frames from the first to the last, and their rate.

    Frames that are missing have no points. Raises DataError without a rate.
    """
    points = content.points
    assert points is not None
    rate = settings.rate_hz or points.rate_hz
    if rate is None:
        raise DataError(f'{path}: the source does not contain the frame rate, --rate HZ is needed')
    first = int(points.frame[0])
    count = int(points.frame[-1]) - first + 1
    if count > MAX_FRAMES:
        raise DataError(f'{path}: frames {first} to {first + count - 1} are too many to write')
    row = points.frame - first

    def expanded(values: np.ndarray) -> np.ndarray:
        out = np.full((count, *values.shape[1:]), np.nan)
        out[row] = values
        return out

    return replace(
        points,
        frame=np.arange(first, first + count),
        xyz_mm=expanded(points.xyz_mm),
        sd_mm=expanded(points.sd_mm),
        residual_px=expanded(points.residual_px),
        rate_hz=float(rate),
    )


def labels(content: Content) -> list[str]:
    """Return the names of the targets; those without a name are marker001, marker002, ..."""
    assert content.points is not None
    named = content.names.target_names()
    return [named.get(i, default_name(i)) for i in content.points.target_id.tolist()]
