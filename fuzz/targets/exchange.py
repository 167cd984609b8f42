# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Text files of other programs, in every format that is recognised or written."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.io.formats import registry
from fluoro_calib_ros.io.formats.content import (
    Bodies,
    Camera,
    Content,
    FileSettings,
    points_without_precision,
)

from ..harness import Target, both
from ..seeds import frames, rig

SETTINGS = FileSettings(image_size=(1024, 1024), units='mm', rate_hz=100.0)
# These formats have their own targets; C3D and SLEAP are read in another process.
OTHERS = ('observations', 'phantom', 'known_orientation', 'c3d', 'sleap', 'xmalab_project')
KINDS = tuple(kind for kind in registry.kinds(lambda f: f.read is not None) if kind not in OTHERS)


def _read(path: Path) -> None:
    both(
        lambda: registry.read(path, SETTINGS),
        *(lambda kind=kind: registry.read(path, SETTINGS, kind) for kind in KINDS),
    )


def _seeds() -> list[bytes]:
    matrix = np.array([[4000.0, 0, 500], [0, 4000, 380], [0, 0, 1]])
    camera = Camera('a', matrix, (1024, 1024), np.eye(3), np.array([0.0, 0, 1000]))
    content = Content(
        observations=frames(),
        survey=rig().phantom,
        cameras=(camera,),
        points=points_without_precision(
            np.array([1, 2]), np.array([1, 2]), np.arange(12.0).reshape(2, 2, 3), 100.0
        ),
        bodies=Bodies(('f',), np.array([1]), np.eye(3)[None, None], np.ones((1, 1, 3))),
        grids={'a': np.arange(8.0).reshape(2, 4)},
    )
    seeds = []
    for kind in registry.kinds(lambda f: f.write is not None and f.kind != 'bag'):
        with tempfile.TemporaryDirectory() as folder:
            try:
                done = registry.write(Path(folder) / 'file', kind, content, SETTINGS)
            except DataError:
                continue
            seeds += [Path(path).read_bytes() for path in done.paths]
    seeds.append(b'id,x_mm,y_mm,z_mm,sd\n1,0,0,0,1\n2,9,0,0,1\n3,0,9,0,1\n4,0,0,9,1\n')
    return [seed for seed in seeds if len(seed) < 20_000]


TARGET = Target('exchange', 'file.csv', _read, _seeds)
