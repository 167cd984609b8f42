# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The size that an image file declares, read before anything is decoded.

A file of a megabyte can declare an image of many gigabytes. The headers are those of the
specifications: PNG (ISO/IEC 15948, 11.2.2), JPEG (ITU-T T.81, B.2.2), BMP (BITMAPINFOHEADER), PNM
(netpbm) and TIFF 6.0.
"""

from __future__ import annotations

import io
import re

import tifffile

from ..errors import DataError
from ..limits import read_limits

PNG_SIGNATURE = b'\x89PNG\r\n\x1a\n'
TIFF_SIGNATURES = (b'II*\0', b'MM\0*', b'II+\0', b'MM\0+')
# Headers of a JPEG frame: SOF0 to SOF15 without DHT, JPG and DAC.
JPEG_FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
PNM = re.compile(rb'P[1-6]\s(?:\s*#[^\n]*\n)*\s*(\d{1,9})\s(?:\s*#[^\n]*\n)*\s*(\d{1,9})\s')


def check_declared_size(content: memoryview) -> None:
    """Raise DataError for an image file that declares more pixels than are read.

    Files of other formats, and headers that are damaged, are left to the decoder.
    """
    width, height = declared_size(content)
    check_size(width, height)


def check_size(width: int, height: int) -> None:
    """Raise DataError for an image of more pixels than are read."""
    limits = read_limits()
    if width * height > limits.max_pixels:
        raise DataError(
            f'the image is {width} x {height} px, images of more than '
            f'{limits.max_image_megapixels} megapixels are not read'
        )


def declared_size(content: memoryview) -> tuple[int, int]:
    """Width and height that an image file declares [px]; (0, 0) where they are not found."""
    start = bytes(content[:64])
    if start.startswith(PNG_SIGNATURE):
        return _number(start[16:20]), _number(start[20:24])
    if start.startswith(b'\xff\xd8'):
        return _jpeg_size(content)
    if start.startswith(b'BM'):
        width = int.from_bytes(start[18:22], 'little', signed=True)
        height = int.from_bytes(start[22:26], 'little', signed=True)
        return abs(width), abs(height)
    if start.startswith(TIFF_SIGNATURES):
        return _tiff_size(content)
    header = PNM.match(bytes(content[:1024]))
    return (int(header[1]), int(header[2])) if header else (0, 0)


def _number(data: bytes) -> int:
    return int.from_bytes(data, 'big')


def _jpeg_size(content: memoryview) -> tuple[int, int]:
    position = 2
    while position + 9 <= len(content):
        if content[position] != 0xFF:
            return 0, 0
        marker = content[position + 1]
        if marker == 0xFF:  # fill byte
            position += 1
            continue
        if marker in JPEG_FRAMES:
            height = _number(bytes(content[position + 5 : position + 7]))
            return _number(bytes(content[position + 7 : position + 9])), height
        position += 2 + _number(bytes(content[position + 2 : position + 4]))
    return 0, 0


def _tiff_size(content: memoryview) -> tuple[int, int]:
    try:
        with tifffile.TiffFile(io.BytesIO(content)) as file:
            page = file.pages.first
            return int(page.imagewidth), int(page.imagelength)
    except Exception:  # tifffile raises what its parsing stumbles over
        return 0, 0
