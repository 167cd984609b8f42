# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Encode and decode grey images in memory. Damaged image files are refused."""

from __future__ import annotations

import io
import re
import zlib
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from ..errors import DataError, quoted
from ..findings import Kind
from ..limits import read_limits

# Higher levels take several times as long and reduce an image with noise by only a few per cent.
PNG_COMPRESSION = 1
EIGHT_BIT_SUFFIXES = ('.jpg', '.jpeg', '.bmp')

LOG_LEVEL_SILENT = 0
JPEG_START = b'\xff\xd8'
JPEG_END = b'\xff\xd9'
MAX_JPEG_TRAILER = 4096  # largest trailer that some cameras append to an image [bytes]


def silence_opencv() -> None:
    """Keep OpenCV from printing: callers report errors in one sentence."""
    if hasattr(cv2.utils, 'logging'):
        cv2.utils.logging.setLogLevel(LOG_LEVEL_SILENT)
    else:  # OpenCV 4.6, as in Ubuntu 24.04
        cv2.setLogLevel(LOG_LEVEL_SILENT)


silence_opencv()


def decode(content: bytes | bytearray | memoryview | NDArray[np.uint8]) -> np.ndarray:
    """Return the grey image (h, w) of uint8 or uint16 in the bytes of an image file.

    The formats are PNG, JPEG, TIFF (the first page), BMP and PGM. An image whose colours are all
    equal is grey. Raises DataError if the content is not an image, is too large, is damaged or is
    truncated, as far as its format shows it: PNG has checksums, the other formats an end marker.
    """
    data = np.frombuffer(content, dtype=np.uint8)
    if not len(data):
        raise DataError('the image is empty, it has no data')
    is_png = data[: len(PNG_SIGNATURE)].tobytes() == PNG_SIGNATURE
    if declared_size(data.data) == (0, 0):
        if is_png:
            _check_png(data.data)  # reports what is damaged
        # OpenCV decodes more formats, but their size is unknown before they are decoded.
        raise DataError('this is not an image that can be decoded, or it is damaged')
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
        raise DataError('this is not an image that can be decoded, or it is damaged')
    return as_grey(image)


# Pixel type of each encoding; 8UC1 and 16UC1 are the same, but do not state that they are grey.
PIXEL_TYPES = {'mono8': np.uint8, '8UC1': np.uint8, 'mono16': np.uint16, '16UC1': np.uint16}


def raw_image(message: Any) -> np.ndarray:
    """Return the grey image (h, w) uint8 or uint16 of a sensor_msgs/Image, or of its fields.

    The array shares the memory of the message if byte order and row step allow. Raises DataError
    for another encoding, and if the bytes are not those of an image of its size.
    """
    pixel_type = PIXEL_TYPES.get(message.encoding)
    if pixel_type is None:
        raise DataError(
            f'its encoding {quoted(message.encoding)} is not mono8 or mono16',
            kind=Kind.IMAGE_ENCODING,
        )
    dtype = np.dtype(pixel_type)
    width, height, step = message.width, message.height, message.step
    size = len(message.data)
    row_size = width * dtype.itemsize
    min_size = (height - 1) * step + row_size
    if not width or not height or step < row_size or not min_size <= size <= height * step:
        raise DataError(
            f'{size} bytes in rows of {step} are not an image of {width} x {height} px of '
            f'{message.encoding}'
        )
    image = np.ndarray((height, width), dtype, message.data, strides=(step, dtype.itemsize))
    if dtype == np.uint16 and message.is_bigendian:
        return image.byteswap()
    # OpenCV does not accept rows that begin within a pixel.
    return image if step % dtype.itemsize == 0 else image.copy()


def as_grey(image: np.ndarray) -> np.ndarray:
    """Return the grey image (h, w) of an image (h, w) or (h, w, channels) with equal colours.

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
    """Return the bytes of an image file for an image (h, w) of uint8 or uint16.

    suffix, such as '.png', selects the format; quality, from 1 to 100, applies to JPEG. Raises
    DataError if the format does not support 16 bits.
    """
    if image.dtype == np.uint16 and suffix in EIGHT_BIT_SUFFIXES:
        raise DataError(f'an image of 16 bits cannot be written as {suffix[1:]}, use png or tif')
    parameters: list[int] = []
    if suffix == '.png':
        parameters = [cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION]
    elif suffix in ('.jpg', '.jpeg'):
        parameters = [cv2.IMWRITE_JPEG_QUALITY, quality]
    return bytes(cv2.imencode(suffix, image, parameters)[1].tobytes())


def encode_overlay(picture: np.ndarray) -> bytes:
    """Return the bytes of a PNG file for a picture (h, w, 3) of results, marked as one."""
    content = encode(picture, '.png')
    text = b'tEXt' + OVERLAY_MARK
    chunk = len(OVERLAY_MARK).to_bytes(4, 'big') + text + zlib.crc32(text).to_bytes(4, 'big')
    return content[:END_OF_HEADER] + chunk + content[END_OF_HEADER:]


def is_overlay(head: bytes) -> bool:
    """Return whether the first END_OF_MARK bytes of a file are those of `encode_overlay`."""
    return head.startswith(PNG_SIGNATURE) and OVERLAY_MARK in head


def _check_png(content: memoryview) -> None:
    """Raise DataError unless all chunks of a PNG are present, with correct checksums."""
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


OVERLAY_MARK = b'Software\0overlay of fluoro_calib_ros'
END_OF_HEADER = 33  # of a PNG: signature and the chunk IHDR [bytes]
END_OF_MARK = END_OF_HEADER + 8 + len(OVERLAY_MARK)
PNG_SIGNATURE = b'\x89PNG\r\n\x1a\n'
TIFF_SIGNATURES = (b'II*\0', b'MM\0*', b'II+\0', b'MM\0+')
# Headers of a JPEG frame: SOF0 to SOF15 without DHT, JPG and DAC.
JPEG_FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
PNM = re.compile(rb'P[1-6]\s(?:\s*#[^\n]*\n)*\s*(\d{1,9})\s(?:\s*#[^\n]*\n)*\s*(\d{1,9})\s')


def check_declared_size(content: memoryview) -> None:
    """Raise DataError if an image file declares more pixels than the limit.

    Files of other formats and damaged headers are left to the decoder.
    """
    width, height = declared_size(content)
    check_size(width, height)


def check_size(width: int, height: int) -> None:
    """Raise DataError if an image has more pixels than the limit."""
    limits = read_limits()
    if width * height > limits.max_pixels:
        raise DataError(
            f'the image is {width} x {height} px, images of more than '
            f'{limits.max_image_megapixels} megapixels are not read'
        )


def declared_size(content: memoryview) -> tuple[int, int]:
    """Return width and height that an image file declares [px], (0, 0) if they are not found."""
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
    except Exception:  # tifffile raises whatever its parser runs into
        return 0, 0
