# Copyright 2026 fluoro_calib_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Observations of images as CSV: `fluoroscope,exposure,target_id,u,v,sigma,overlapped`.

Markers that were followed have a further column `doubtful`.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from ..exposures.frame import Frame
from .access import check_safe_name
from .atomic import atomic_file
from .csv_table import write_rows
from .observations import COLUMNS

DECIMALS = 4  # of a pixel, and of its standard deviation


def write_extracted(
    path: str | os.PathLike[str],
    frames: Iterable[tuple[Frame, np.ndarray]],
    target_names: Mapping[int, str],
) -> None:
    """Write frames, each with its flags (n,) of overlapped beads, to a CSV file.

    Beads with a name are written by it. Raises DataError where the file cannot be written.
    """
    with atomic_file(path, 'w') as file:
        write_rows(file, [(*COLUMNS, 'sigma', 'overlapped')])
        for frame, overlapped in frames:
            write_rows(file, _rows(path, frame, [overlapped], target_names))


def write_markers(
    path: str | os.PathLike[str],
    frames: Iterable[tuple[Frame, np.ndarray, np.ndarray]],
    target_names: Mapping[int, str],
) -> None:
    """Write frames, with flags (n,) of overlapped markers and of doubtful ids, to a CSV file.

    Markers with a name are written by it. Raises DataError where the file cannot be written.
    """
    with atomic_file(path, 'w') as file:
        write_rows(file, [(*COLUMNS, 'sigma', 'overlapped', 'doubtful')])
        for frame, overlapped, doubtful in frames:
            write_rows(file, _rows(path, frame, [overlapped, doubtful], target_names))


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
