# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Observations of images as CSV: `fluoroscope,exposure,target_id,u,v,sigma,overlapped`.

Markers that were followed have a further column `doubtful`, and images with the angle of a C-arm
have `angle_deg` as the last one.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from ..exposures.frame import Frame, angle_in_degrees
from .access import check_safe_name
from .atomic import atomic_file
from .csv_table import format_float, write_rows
from .observations import ANGLE, COLUMNS

DECIMALS = 4  # of a pixel, and of its standard deviation


def write_extracted(
    path: str | os.PathLike[str],
    frames: Iterable[tuple[Frame, np.ndarray]],
    target_names: Mapping[int, str],
) -> None:
    """Write frames, each with its flags (n,) of overlapped beads, to a CSV file.

    Beads with a name are written by it. Raises DataError where the file cannot be written.
    """
    flagged = [(frame, [overlapped]) for frame, overlapped in frames]
    _write(path, flagged, ('overlapped',), target_names)


def write_markers(
    path: str | os.PathLike[str],
    frames: Iterable[tuple[Frame, np.ndarray, np.ndarray]],
    target_names: Mapping[int, str],
) -> None:
    """Write frames, with flags (n,) of overlapped markers and of doubtful ids, to a CSV file.

    Markers with a name are written by it. Raises DataError where the file cannot be written.
    """
    flagged = [(frame, [overlapped, doubtful]) for frame, overlapped, doubtful in frames]
    _write(path, flagged, ('overlapped', 'doubtful'), target_names)


def _write(
    path: str | os.PathLike[str],
    frames: Sequence[tuple[Frame, Sequence[np.ndarray]]],
    flags: tuple[str, ...],
    target_names: Mapping[int, str],
) -> None:
    """Write frames with their flags, and with the angle if any frame has one."""
    with_angle = any(frame.angle is not None for frame, _ in frames)
    with atomic_file(path, 'w') as file:
        write_rows(file, [(*COLUMNS, 'sigma', *flags, *(ANGLE,) * with_angle)])
        for frame, values in frames:
            angle = '' if frame.angle is None else format_float(angle_in_degrees(frame.angle))
            rows = _rows(path, frame, values, target_names)
            write_rows(file, ([*row, angle] if with_angle else row for row in rows))


def _rows(
    path: str | os.PathLike[str],
    frame: Frame,
    flags: Sequence[np.ndarray],
    target_names: Mapping[int, str],
) -> Iterator[list[object]]:
    """Yield the rows of a frame, with flags (n,) as the last columns."""
    check_safe_name(frame.fluoroscope, path)
    assert frame.sigma is not None
    numbers = np.round(np.column_stack([frame.uv, frame.sigma]), DECIMALS).tolist()
    flagged = np.column_stack(flags).astype(int).tolist()
    for target, row, flag in zip(frame.target_id.tolist(), numbers, flagged):
        yield [frame.fluoroscope, frame.number, target_names.get(target, target), *row, *flag]
