# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The folder DIR/radiographs: small JPEGs of the exposures that were found in images.

A file is named <fluoroscope>_<exposure>.jpg.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from ..errors import DataError
from ..images.codec import JPEG_START
from .access import PathLike, check_safe_name, make_folder, read_bytes, write_bytes

RADIOGRAPHS = 'radiographs'
MAX_BYTES = 2**20  # of a file: grey pixels of 512 x 512 px have a quarter of it

Radiographs = Mapping[str, Mapping[int, bytes]]  # JPEG by fluoroscope and exposure


def write_radiographs(directory: PathLike, radiographs: Radiographs) -> None:
    """Write the radiographs of a result into its folder. Raises DataError."""
    if any(radiographs.values()):
        make_folder(Path(directory) / RADIOGRAPHS)
    for name, of_exposures in radiographs.items():
        check_safe_name(name, directory)
        for exposure, content in of_exposures.items():
            write_bytes(_path(directory, name, exposure), content)


def read_radiographs(
    directory: PathLike, wanted: Iterable[tuple[str, int]]
) -> dict[str, dict[int, bytes]]:
    """Return the radiographs that are there, of the wanted fluoroscopes and exposures.

    Raises DataError for a file that is too large or no JPEG.
    """
    found: dict[str, dict[int, bytes]] = {}
    for name, exposure in wanted:
        path = _path(directory, name, exposure)
        if not path.is_file():
            continue
        if path.stat().st_size > MAX_BYTES:
            raise DataError(f'{path}: this is no small radiograph, it has over {MAX_BYTES} bytes')
        content = read_bytes(path)
        if not content.startswith(JPEG_START):
            raise DataError(f'{path}: this is no JPEG image')
        found.setdefault(name, {})[exposure] = content
    return found


def _path(directory: PathLike, name: str, exposure: int) -> Path:
    return Path(directory) / RADIOGRAPHS / f'{name}_{exposure}.jpg'
