# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Image files: PNG, TIFF, JPEG and others, including stacks."""

from __future__ import annotations

import io
from pathlib import Path

import tifffile

from fluoro_calib_ros.io.image_reading import open_images

from ..harness import Target, both
from ..seeds import encoded_images, images

ENDINGS = ('.png', '.tif')


def _read(path: Path) -> None:
    def with_ending(ending: str) -> None:
        other = path.with_suffix(ending)
        other.write_bytes(path.read_bytes())
        for _ in open_images(other).images:
            pass

    both(*(lambda ending=ending: with_ending(ending) for ending in ENDINGS))


def _seeds() -> list[bytes]:
    stack = io.BytesIO()
    tifffile.imwrite(stack, [images()[0]] * 3, photometric='minisblack')
    found = [
        one
        for ending in ('.png', '.tif', '.jpg', '.bmp', '.pgm')
        for one in encoded_images(ending)
    ]
    return [*found, stack.getvalue()]


TARGET = Target('images', 'image', _read, _seeds)
