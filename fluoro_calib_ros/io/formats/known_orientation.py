# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Known orientations of this package: K, R and t_mm of every fluoroscope as YAML.

`io.known_orientation` describes the layout; a calibration takes the orientations from it. It
has no image size.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...errors import DataError
from ...photogrammetry.known_orientation import KnownOrientation
from ..known_orientation import read_known_orientations, write_known_orientations
from .camera_files import common_focal_length, refuse_distortion
from .content import Camera, Content, FileSettings, Format, Sample, Written, camera_at

TITLE = 'known orientations'


def recognise(sample: Sample) -> bool:
    """Return whether the file has the entry fluoroscopes and matrices K."""
    keys = {line.split(':')[0] for line in sample.lines}
    return {'fluoroscopes', 'K'} <= keys


def read(path: Path, settings: FileSettings) -> Content:
    """Read the cameras. Raises DataError."""
    return Content(
        cameras=tuple(
            _camera(name, known, settings) for name, known in read_known_orientations(path).items()
        )
    )


def _camera(name: str, known: KnownOrientation, settings: FileSettings) -> Camera:
    xp, yp, c = known.interior.tolist()
    matrix = np.array([[c, 0, xp], [0, c, yp], [0, 0, 1]])
    return camera_at(name, matrix, settings.image_size, known.rotation, known.position_mm)


def write(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write all cameras into one file. Raises DataError."""
    known = {}
    for camera in content.cameras:
        refuse_distortion(path, camera, TITLE)
        common_focal_length(path, camera, TITLE)
        try:
            known[camera.name] = KnownOrientation.from_matrices(camera.matrix, *camera.pose)
        except DataError as error:
            raise error.at(f'camera {camera.name}') from None
    write_known_orientations(path, known)
    return Written((str(path),))


FORMAT = Format(
    'known_orientation',
    f'{TITLE} of fluoro_calib_ros',
    parts=('cameras',),
    recognise=recognise,
    read=read,
    write=write,
    looks_like='fluoroscopes: with K, R and t_mm',
)
