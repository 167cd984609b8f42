# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Grey images in the formats of image files, in memory. Damaged files are refused."""

from __future__ import annotations

import zlib

import cv2
import numpy as np

from ..errors import DataError
from ..findings import Kind
from .declared_size import PNG_SIGNATURE, check_declared_size, declared_size

# Higher levels take several times as long and save a few per cent of an image with noise.
PNG_COMPRESSION = 1
EIGHT_BIT_SUFFIXES = ('.jpg', '.jpeg', '.bmp')

LOG_LEVEL_SILENT = 0
JPEG_START = b'\xff\xd8'
JPEG_END = b'\xff\xd9'
MAX_JPEG_TRAILER = 4096  # what some cameras append to an image [bytes]


def silence_opencv() -> None:
    """Keep OpenCV from printing: callers report errors in one sentence."""
    if hasattr(cv2.utils, 'logging'):
        cv2.utils.logging.setLogLevel(LOG_LEVEL_SILENT)
    else:  # OpenCV 4.6, as Ubuntu 24.04 has it
        cv2.setLogLevel(LOG_LEVEL_SILENT)


silence_opencv()


def decode(content: bytes | bytearray | memoryview | np.ndarray) -> np.ndarray:
    """Grey image (h, w) of uint8 or uint16 from the bytes of an image file.

    The formats are PNG, JPEG, TIFF (the first page), BMP and PGM. An image whose colours are all
    equal is grey. Raises DataError if the content is no image, is too large, is damaged or is cut
    off, as far as its format shows it: PNG has checksums, the others an end.
    """
    data = np.frombuffer(content, dtype=np.uint8)
    if not len(data):
        raise DataError('the image is empty, it has no data')
    is_png = data[: len(PNG_SIGNATURE)].tobytes() == PNG_SIGNATURE
    if declared_size(data.data) == (0, 0):
        if is_png:
            _check_png(data.data)  # says what is damaged
        # OpenCV knows more formats, but nothing tells their size before they are decoded.
        raise DataError('this is no image that can be decoded, or it is damaged')
    check_declared_size(data.data)
    if is_png:
        _check_png(data.data)
    if data[:2].tobytes() == JPEG_START and JPEG_END not in data[-MAX_JPEG_TRAILER:].tobytes():
        raise DataError('the image is cut off, the end of its JPEG data is missing')
    try:
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None:
        raise DataError('this is no image that can be decoded, or it is damaged')
    return as_grey(image)


def as_grey(image: np.ndarray) -> np.ndarray:
    """Grey image (h, w) from an image (h, w) or (h, w, channels) with equal colours.

    Raises DataError if the colours differ, or if the pixels are not uint8 or uint16.
    """
    if image.dtype not in (np.uint8, np.uint16):
        raise DataError(
            f'the image has pixels of {image.dtype}, not of 8 or 16 bits', kind=Kind.IMAGE_ENCODING
        )
    if image.ndim == 2:
        return image
    first = image[:, :, 0]
    if image.shape[2] >= 3 and not all(np.array_equal(first, image[:, :, k]) for k in (1, 2)):
        raise DataError(
            'this is a colour image, convert it to grey first: it is not known which of its '
            'colours show X-rays',
            kind=Kind.IMAGE_ENCODING,
        )
    return np.ascontiguousarray(first)


def encode(image: np.ndarray, suffix: str, quality: int = 95) -> bytes:
    """Bytes of an image file of an image (h, w) of uint8 or uint16.

    suffix, such as '.png', is the format; quality, from 1 to 100, is that of JPEG. Raises
    DataError if the format cannot hold 16 bits.
    """
    if image.dtype == np.uint16 and suffix in EIGHT_BIT_SUFFIXES:
        raise DataError(f'an image of 16 bits cannot be written as {suffix[1:]}, use png or tif')
    parameters: list[int] = []
    if suffix == '.png':
        parameters = [cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION]
    elif suffix in ('.jpg', '.jpeg'):
        parameters = [cv2.IMWRITE_JPEG_QUALITY, quality]
    return bytes(cv2.imencode(suffix, image, parameters)[1].tobytes())


def _check_png(content: memoryview) -> None:
    """Raise DataError unless all chunks of a PNG are there, with their checksums."""
    position = len(PNG_SIGNATURE)
    kind = b''
    while kind != b'IEND':
        length = int.from_bytes(content[position : position + 4], 'big')
        chunk = content[position + 4 : position + 8 + length]
        checksum = content[position + 8 + length : position + 12 + length]
        if len(checksum) < 4:
            raise DataError('the PNG image is cut off')
        if zlib.crc32(chunk) != int.from_bytes(checksum, 'big'):
            raise DataError('the PNG image is damaged: a checksum is wrong')
        position += 12 + length
        kind = bytes(chunk[:4])
