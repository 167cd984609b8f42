"""Grey images in the formats of image files, in memory: what is damaged is told, not shown half."""

import zlib

import cv2
import numpy as np

from ..errors import DataError

PNG = b'\x89PNG\r\n\x1a\n'
# of compression: higher ones take several times as long for a few per cent of an image with noise
PNG_LEVEL = 1

# What is wrong is told by who decodes, in one sentence: OpenCV's own lines beside it would be a
# second one.
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)


def decode(content):
    """Grey image (h, w) uint8 or uint16 of the bytes of an image file: PNG, JPEG, TIFF (its first
    page), BMP, PGM.

    An image with colours that are all the same is grey. Raises DataError where content is no
    image, is damaged or cut off, as far as its format tells: PNG has checksums, the others tell
    where they end.
    """
    content = np.frombuffer(content, dtype=np.uint8)
    if not len(content):
        raise DataError('the image is empty, it has no data')
    if content[: len(PNG)].tobytes() == PNG:
        _check_png(memoryview(content))
    try:
        image = cv2.imdecode(content, cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None:
        raise DataError('this is no image that can be decoded, or it is damaged')
    return grey(image)


def grey(image):
    """Image (h, w) of an image (h, w) or (h, w, channels) uint8 or uint16 whose colours are all
    the same.

    Raises DataError where they are not, or where the pixels are of another type.
    """
    if image.dtype not in (np.uint8, np.uint16):
        raise DataError(f'the image has pixels of {image.dtype}, not of 8 or 16 bits')
    if image.ndim == 2:
        return image
    first = image[:, :, 0]
    if image.shape[2] >= 3 and not all(np.array_equal(first, image[:, :, k]) for k in (1, 2)):
        raise DataError(
            'this is a colour image, it has to be made grey before: which of its colours are X-rays is not '
            'known here'
        )
    return np.ascontiguousarray(first)


def encode(image, ending, quality=95):
    """Bytes of an image file of image (h, w) uint8 or uint16: ending such as '.png'; quality of
    JPEG, 1 to 100.

    Raises DataError where the format does not hold that many bits.
    """
    if image.dtype == np.uint16 and ending in EIGHT_BITS:
        raise DataError(f'an image of 16 bits cannot be written as {ending[1:]}, take png or tif')
    parameters = {'.png': [cv2.IMWRITE_PNG_COMPRESSION, PNG_LEVEL]}.get(ending, [])
    if ending in ('.jpg', '.jpeg'):
        parameters = [cv2.IMWRITE_JPEG_QUALITY, quality]
    return cv2.imencode(ending, image, parameters)[1].tobytes()


EIGHT_BITS = ('.jpg', '.jpeg', '.bmp')


def _check_png(content):
    """Raise DataError unless all chunks of a PNG are there and have their checksums."""
    at = len(PNG)
    kind = b''
    while kind != b'IEND':
        length = int.from_bytes(content[at : at + 4], 'big')
        chunk = content[at + 4 : at + 8 + length]
        checksum = content[at + 8 + length : at + 12 + length]
        if len(checksum) < 4:
            raise DataError('the PNG image is cut off')
        if zlib.crc32(chunk) != int.from_bytes(checksum, 'big'):
            raise DataError('the PNG image is damaged: a checksum is wrong')
        at = at + 12 + length
        kind = bytes(chunk[:4])


__all__ = ['decode', 'encode', 'grey']
