# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Videos: AVI, MP4 and others."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from fluoro_calib_ros.io.image_reading import ImageSource, open_images
from fluoro_calib_ros.io.image_writing import write_video

from ..harness import Target
from ..seeds import images

ENDINGS = ('.avi', '.mp4', '.mkv')
FRAMES = 3


def _read(path: Path) -> None:
    for _ in open_images(path).images:
        pass


def _video(ending: str, image: np.ndarray) -> bytes:
    """Return a video of an image that is larger than the minimum size of codecs."""
    frame = np.tile(image, (4, 4))
    source = ImageSource('video', FRAMES, (('', frame) for _ in range(FRAMES)), 30.0)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / f'video{ending}'
        write_video(out, source, lambda *_: None)
        return out.read_bytes()


def _seeds() -> list[bytes]:
    eight, sixteen = images()
    return [*(_video(ending, eight) for ending in ENDINGS), _video('.avi', sixteen)]


TARGET = Target('video', 'trial.avi', _read, _seeds)
