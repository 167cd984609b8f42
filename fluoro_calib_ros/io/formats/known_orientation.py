# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Known orientations of this package: K, R and t_mm of every fluoroscope as YAML.

A calibration takes the orientations from it. It has no image size.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ...errors import DataError, ErrorsAt
from ...photogrammetry.known_orientation import KnownOrientation
from ..access import PathLike, read_text, write_text
from ..documents import read_yaml
from .content import (
    Camera,
    Content,
    FileSettings,
    Format,
    Sample,
    Written,
    camera_at,
    common_focal_length,
    refuse_distortion,
)

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
        with ErrorsAt(f'camera {camera.name}'):
            known[camera.name] = KnownOrientation.from_matrices(camera.matrix, *camera.pose)
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


# Known orientations of fluoroscopes as YAML; docs/special_rigs.md describes the file.

VERSION = 1
KEYS = ('K', 'R', 't_mm', 'interior_sd_px', 'exterior_sd')


def holds_known_orientations(path: PathLike) -> bool:
    """Return whether a file is a YAML file with an entry of fluoroscopes. Raises DataError."""
    if Path(path).suffix.lower() not in ('.yaml', '.yml'):
        return False
    return any(line.startswith('fluoroscopes:') for line in read_text(path).splitlines())


def read_known_orientations(path: PathLike) -> dict[str, KnownOrientation]:
    """Read the known orientations of a YAML file by fluoroscope.

    Raises DataError with path and fluoroscope for a file that cannot be read or is wrong.
    """
    document = read_yaml(path)
    if not isinstance(document, Mapping) or not isinstance(document.get('fluoroscopes'), Mapping):
        raise DataError(f'{path}: there is no entry "fluoroscopes" with names and K, R, t_mm')
    version = document.get('format_version', VERSION)
    if version != VERSION:
        raise DataError(
            f'{path}: the file has layout version {version}, this program knows version {VERSION}'
        )
    return {
        str(name): _orientation(entry, f'{path}, fluoroscope {name}')
        for name, entry in document['fluoroscopes'].items()
    }


def _orientation(entry: Any, where: str) -> KnownOrientation:
    """Return one entry of the file. Raises DataError."""
    if not isinstance(entry, Mapping):
        raise DataError(f'{where}: the entry has no K, R and t_mm')
    for key in entry:
        if key not in KEYS:
            raise DataError(f'{where}: {key!r} is unknown, an entry has {", ".join(KEYS)}')
    for key in KEYS[:3]:
        if key not in entry:
            raise DataError(f'{where}: {key} is missing')
    try:
        k, r, t = (np.array(entry[key], dtype=float) for key in KEYS[:3])
        return KnownOrientation.from_matrices(
            k, r, t, entry.get('interior_sd_px'), entry.get('exterior_sd')
        )
    except (TypeError, ValueError, OverflowError) as error:
        # DataError is a ValueError.
        sentence = error if isinstance(error, DataError) else 'a value is not a number'
        raise DataError(f'{where}: {sentence}') from None


def write_known_orientations(path: PathLike, known: Mapping[str, KnownOrientation]) -> None:
    """Write known orientations, from which the same are read again. Raises DataError."""
    entries: dict[str, Any] = {}
    for name, one in known.items():
        xp, yp, c = one.interior.tolist()
        entry: dict[str, Any] = {
            'K': [[c, 0.0, xp], [0.0, c, yp], [0.0, 0.0, 1.0]],
            'R': one.rotation.tolist(),
            't_mm': (-one.rotation @ one.position_mm).tolist(),
        }
        if one.interior_sd is not None:
            entry['interior_sd_px'] = list(one.interior_sd)
        if one.exterior_sd is not None:
            entry['exterior_sd'] = list(one.exterior_sd)
        entries[name] = entry
    document = {'format_version': VERSION, 'fluoroscopes': entries}
    write_text(path, yaml.safe_dump(document, sort_keys=False))
