# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Analysis files of SLEAP; the process that runs HDF5 is forked, as for C3D."""

from __future__ import annotations

from pathlib import Path
from unittest import mock

import h5py
import numpy as np

from fluoro_calib_ros.exposures.frame import Frame, validate_frame
from fluoro_calib_ros.io.formats import image_points, reader_process
from fluoro_calib_ros.io.formats.content import Content, FileSettings

from ..harness import Target
from ..seeds import written
from .c3d import run_forked

SIZE = (64, 64)
SETTINGS = FileSettings(image_size=SIZE)
assert h5py  # import it before the forks


def _read(path: Path) -> None:
    with mock.patch.object(reader_process, 'run_module', run_forked):
        content = image_points.read_sleap(path, SETTINGS)
    for frames in (content.observations or {}).values():
        for frame in frames:
            validate_frame(frame)


def _write(path: Path, count: int) -> None:
    uv = np.arange(4.0).reshape(2, 2)
    frames = [Frame('a', k, np.array([1, 2]), uv + k, SIZE) for k in range(count)]
    folder = path.with_name('cameras')
    image_points.write_sleap(folder, Content(observations={'a': frames}), SETTINGS)
    (folder / 'a.analysis.h5').rename(path)


TARGET = Target(
    'sleap',
    'trial.analysis.h5',
    _read,
    lambda: written(lambda path: _write(path, 1), lambda path: _write(path, 3)),
)
