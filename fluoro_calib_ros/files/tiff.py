"""Stacks of grey images in TIFF files: written page by page, and looked through before they are
read.

OpenCV writes a stack from a list of all its images and reads what is left of a cut one without a
word. A baseline file of uncompressed pages (TIFF 6.0; BigTIFF from 4 GB on) needs neither much
memory nor time, and its directories tell how many pages there are.
"""

import os
import struct

import numpy as np

from ..errors import DataError
from .access import os_error_reason

CLASSIC_BYTES = 4 * 10**9  # what a file with 32 bit offsets holds, with something to spare
MAX_PAGES = 10**6
# types of a field
SHORT = 3
LONG = 4
LONG8 = 16


class TiffWriter:
    """Writes pages (h, w) uint8 or uint16 into a binary file that can be searched; pages: most of
    them of nbytes each, which decides the size of offsets.
    """

    def __init__(self, file, pages, nbytes):
        self._file = file
        self._big = pages * (nbytes + 1024) > CLASSIC_BYTES
        self._link = (
            8 if self._big else 4
        )  # where the place of the next directory is to be written
        file.write(
            struct.pack('<2sHHHQ', b'II', 43, 8, 0, 0)
            if self._big
            else struct.pack('<2sHI', b'II', 42, 0)
        )

    def write(self, image):
        """Add a page."""
        file = self._file
        at = file.tell()
        file.write(np.ascontiguousarray(image, dtype=image.dtype.newbyteorder('<')).data)
        file.write(b'\0' * (-file.tell() % 8))
        directory = file.tell()
        height, width = image.shape
        place = LONG8 if self._big else LONG
        fields = [
            (256, LONG, width),
            (257, LONG, height),
            (258, SHORT, 8 * image.itemsize),
            (259, SHORT, 1),
            (262, SHORT, 1),
            (273, place, at),
            (277, SHORT, 1),
            (278, LONG, height),
            (279, place, image.nbytes),
            (339, SHORT, 1),
        ]
        number, field, link = ('<Q', '<HHQQ', '<Q') if self._big else ('<H', '<HHII', '<I')
        file.write(struct.pack(number, len(fields)))
        for tag, kind, value in fields:
            file.write(struct.pack(field, tag, kind, 1, value))
        end = file.tell()
        file.write(struct.pack(link, 0))
        file.seek(self._link)
        file.write(struct.pack(link, directory))
        file.seek(0, os.SEEK_END)
        self._link = end


def count_pages(path):
    """Number of pages of the TIFF file path. Raises DataError where it is none, or where it is cut
    off.
    """
    try:
        with open(path, 'rb') as file:
            return _count(file, os.fstat(file.fileno()).st_size)
    except OSError as error:
        raise DataError(f'{path}: cannot be read ({os_error_reason(error)})') from None
    except (struct.error, _Damaged):
        raise DataError(f'{path}: this is no TIFF file, or it is cut off or damaged') from None


class _Damaged(Exception):
    pass


def _count(file, size):
    order = {b'II': '<', b'MM': '>'}.get(file.read(2))
    version = order and struct.unpack(order + 'H', file.read(2))[0]
    if version not in (42, 43):
        raise _Damaged
    big = version == 43
    number, width, link = (order + 'Q', 20, order + 'Q') if big else (order + 'H', 12, order + 'I')
    if big:
        file.seek(8)

    def read(code):
        return struct.unpack(code, file.read(struct.calcsize(code)))[0]

    pages = 0
    at = read(link)
    while at:
        pages += 1
        if at >= size or pages > MAX_PAGES:
            raise _Damaged
        file.seek(at)
        file.seek(at + struct.calcsize(number) + width * read(number))
        at = read(link)
    if not pages:
        raise _Damaged
    return pages
