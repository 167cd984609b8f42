# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Stacks of grey images in TIFF files: written page by page, and checked before they are read.

tifffile writes the pages and lists them; a stack needs no more memory than one page. If a file is
cut off, tifffile only logs it and goes on with the remaining pages: `count_pages` refuses such a
file.
"""

from __future__ import annotations

import logging
import math
import struct
from os import PathLike
from typing import IO

import numpy as np
from tifffile import TiffFile, TiffFileError, TiffWriter

from ..errors import DataError
from ..images.declared_size import check_size
from .access import os_error_reason

CLASSIC_BYTES = 4 * 10**9  # size from which a file needs 64-bit offsets, with some reserve
PAGE_OVERHEAD = 1024  # bytes

# tifffile logs what count_pages says in its one sentence.
logging.getLogger('tifffile').addHandler(logging.NullHandler())


class StackWriter:
    """Writes uncompressed pages into a seekable binary file; to be used in a with statement.

    Parameters
    ----------
    file : binary file
    pages, page_bytes : int
        Largest number of pages and the size of one; they decide the size of the offsets.
    """

    def __init__(self, file: IO[bytes], pages: int, page_bytes: int) -> None:
        size = pages * (page_bytes + PAGE_OVERHEAD)
        self._writer = TiffWriter(file, bigtiff=size > CLASSIC_BYTES, byteorder='<')

    def write(self, image: np.ndarray) -> None:
        """Add a page (h, w) of uint8 or uint16."""
        self._writer.write(
            image, photometric='minisblack', metadata=None, software=False, contiguous=False
        )

    def __enter__(self) -> StackWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()


def count_pages(path: str | PathLike[str]) -> int:
    """Number of pages of a TIFF file.

    Raises DataError for a file that cannot be read, is no TIFF file, is cut off or is damaged, and
    for pages that are too large.
    """
    try:
        with TiffFile(path) as file:
            count = len(file.pages)
            complete = _ends_with_last_page(file)
            size = max(
                ((int(page.imagewidth), int(page.imagelength)) for page in file.pages),
                key=math.prod,
                default=(0, 0),
            )
    except OSError as error:
        raise DataError(f'{path}: cannot be read ({os_error_reason(error)})') from None
    except (TiffFileError, struct.error, ValueError, TypeError, LookupError, OverflowError):
        count = 0
        complete = False
    if not count or not complete:
        raise DataError(f'{path}: this is no TIFF file, or it is cut off or damaged')
    try:
        check_size(*size)
    except DataError as error:
        raise DataError(f'{path}: {error}') from None
    return count


def _ends_with_last_page(file: TiffFile) -> bool:
    """Whether the last page that tifffile found is the last one by the file itself.

    Its link to the next page is 0 then.
    """
    position = file.pages.next_page_offset
    if position is None:
        return False
    file.filehandle.seek(position)
    link = file.filehandle.read(file.tiff.offsetsize)
    return link == bytes(file.tiff.offsetsize)
