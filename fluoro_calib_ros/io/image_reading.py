# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Read image files, stacks and videos, image by image."""

from __future__ import annotations

import logging
import math
import os
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from tifffile import TiffFile, TiffFileError

from ..errors import DataError, ErrorsAt
from ..images.codec import as_grey, check_size, decode
from .access import PathLike, check_regular_file, os_error_reason, read_bytes
from .csv_table import read_all
from .recordings import read_cine_header, read_cine_images, read_dicom_header, read_dicom_images

# Angles of a C-arm in the images of a stack or video, as CSV: `image,angle_deg`.
#
# The first image has number 1. Rows may be in any order. An image without an angle, or without a
# row, gets the mean correction.

COLUMNS = ('image', 'angle_deg')


def read_image_angles(path: PathLike) -> dict[int, float]:
    """Return the angle [rad] of each image by its number; the first image has number 1.

    Raises DataError for a file that cannot be read, an image that is given twice or has an
    impossible number, and a value that is not an angle. Images with an empty cell are omitted.
    """
    rows = read_all(path, COLUMNS)
    numbers = rows.ids('image')
    rows.require('image', numbers > 0, 'the first image is 1')
    angles = np.radians(rows.angles_deg('angle_deg'))
    rows.require_different(numbers, lambda row: f'image {numbers[row]}')
    known = ~np.isnan(angles)
    return dict(zip(numbers[known].tolist(), angles[known].tolist()))


# Formats of images, stacks and videos, by file name suffix.

STACK_SUFFIXES = ('.tif', '.tiff')
IMAGE_SUFFIXES = ('.png', *STACK_SUFFIXES, '.jpg', '.jpeg', '.bmp', '.pgm')
# Formats that are read only: recordings of Phantom cameras, and DICOM.
CINE_SUFFIXES = ('.cine',)
DICOM_SUFFIXES = ('.dcm', '.dicom', '.ima')
LOSSLESS_CODEC = 'FFV1'
SUPPORTS_16_BIT_VIDEOS = tuple(map(int, cv2.__version__.split('.')[:2])) >= (4, 7)
# Codecs for writing videos. Players support MP4 with lossy codecs only.
VIDEO_CODECS = {'.avi': LOSSLESS_CODEC, '.mkv': LOSSLESS_CODEC, '.mp4': 'mp4v'}

# Formats whose images are a time series.
VIDEO_SUFFIXES = (*VIDEO_CODECS, *CINE_SUFFIXES, *DICOM_SUFFIXES)
# Formats with one or more images; a folder may contain one file for each exposure.
EXPOSURE_SUFFIXES = (*IMAGE_SUFFIXES, *DICOM_SUFFIXES)
READ_SUFFIXES = (*IMAGE_SUFFIXES, *VIDEO_CODECS, *CINE_SUFFIXES, *DICOM_SUFFIXES)


def suffix_of(path: PathLike) -> str:
    """Return the suffix of a path in lower case, with its dot."""
    return Path(path).suffix.lower()


# First bytes of files: PNG, TIFF, JPEG, BMP and PGM; DICOM has a preamble (PS3.10, 7.1).
_BEGINNINGS = (
    (0, b'\x89PNG\r\n\x1a\n', '.png'),
    (0, b'II*\0', '.tif'),
    (0, b'MM\0*', '.tif'),
    (0, b'\xff\xd8\xff', '.jpg'),
    (0, b'BM', '.bmp'),
    (0, b'P5', '.pgm'),
    (128, b'DICM', '.dcm'),
)
_DIRECTORY = 'DICOMDIR'  # a DICOM file that lists others


def image_suffix_of(path: PathLike) -> str:
    """Return the suffix of the image format of a file, '' if it has none that is read.

    It is the suffix of the name. If the name has none, or a number, the content decides: scanners
    name files IM000001, or 1.2.840 and so on.
    """
    suffix = suffix_of(path)
    if suffix in READ_SUFFIXES:
        return suffix
    has_other_suffix = suffix and not suffix[1:].isdigit()
    if has_other_suffix or not os.path.isfile(path) or Path(path).name == _DIRECTORY:
        return ''
    try:
        with open(path, 'rb') as file:
            head = file.read(132)
    except OSError:
        return ''
    return next((s for at, mark, s in _BEGINNINGS if head[at:].startswith(mark)), '')


def is_image_source(path: PathLike) -> bool:
    """Return whether a path is a folder, or a file with images or a video."""
    return os.path.isdir(path) or bool(image_suffix_of(path))


def listed(suffixes: Iterable[str]) -> str:
    """Return suffixes as text, without their dots."""
    return ', '.join(suffix[1:] for suffix in suffixes)


# Stacks of grey images in TIFF files are checked before they are read.
#
# If a file is cut off, tifffile only logs that and continues with the remaining pages;
# `count_pages` refuses such a file.

# Silence the log messages of tifffile: count_pages raises one error instead.
logging.getLogger('tifffile').addHandler(logging.NullHandler())


def count_pages(path: PathLike) -> int:
    """Return the number of pages of a TIFF file.

    Raises DataError for a file that cannot be read, is not a TIFF file, is cut off or damaged, and
    for pages that are too large.
    """
    check_regular_file(path)
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
        raise DataError(f'cannot be read ({os_error_reason(error)})', at=path) from None
    except (TiffFileError, struct.error, ValueError, TypeError, LookupError, OverflowError):
        count = 0
        complete = False
    if not count or not complete:
        raise DataError('this is not a TIFF file, or it is cut off or damaged', at=path)
    with ErrorsAt(path):
        check_size(*size)
    return count


def _ends_with_last_page(file: TiffFile) -> bool:
    """Return whether the last page that tifffile found is the last page of the file.

    The link of the last page to the next one is 0.
    """
    position = file.pages.next_page_offset
    if position is None:
        return False
    file.filehandle.seek(position)
    link = file.filehandle.read(file.tiff.offsetsize)
    return link == bytes(file.tiff.offsetsize)


VIDEO_SIZE = (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
MAX_BATCH_BYTES = 64_000_000  # maximum size of pages that are read at once
# Tolerated relative error of the frame count of a video; some containers only state an estimate.
FRAME_COUNT_TOLERANCE = 0.01
GREY_16 = b'Y1\0\x10'  # OpenCV's name of the pixel format of a 16-bit grey video

# Silence FFmpeg: errors are raised as DataError.
os.environ.setdefault('OPENCV_FFMPEG_LOGLEVEL', '-8')


@dataclass(frozen=True)
class ImageSource:
    """Images of one file."""

    kind: str  #: {'image', 'stack', 'video'}
    count: int  #: number of images; for a video, as stated by its header
    #: pairs of a place in words, for error messages, and an image (h, w) of uint8 or uint16;
    #: raises DataError for an image that cannot be read
    images: Iterator[tuple[str, np.ndarray]]
    frame_rate: float | None = None  #: frame rate of a video [Hz]


def open_images(path: Path) -> ImageSource:
    """Open an image file, a stack or a video. Raises DataError if it cannot be read."""
    suffix = image_suffix_of(path)
    if suffix in VIDEO_CODECS:
        return _open_video(path)
    if suffix in CINE_SUFFIXES:
        header = read_cine_header(path)
        images = read_cine_images(path, header)
        return ImageSource('video', len(header.offsets), images, header.frame_rate)
    if suffix in DICOM_SUFFIXES:
        dicom = read_dicom_header(path)
        kind = 'stack' if dicom.frame_rate is None else 'video'
        kind = 'image' if dicom.count == 1 else kind
        rate = None if dicom.count == 1 else dicom.frame_rate
        return ImageSource(kind, dicom.count, read_dicom_images(path, dicom), rate)
    if suffix not in IMAGE_SUFFIXES:
        raise DataError(
            f'the suffix {suffix_of(path) or "(none)"} is not that of an image or a video '
            f'({listed(READ_SUFFIXES)})',
            at=path,
        )
    pages = count_pages(path) if suffix in STACK_SUFFIXES else 1
    if pages > 1:
        check_name(path)
        return ImageSource('stack', pages, _read_pages(path, pages))
    return ImageSource('image', 1, _read_image(path))


def check_name(path: Path) -> None:
    """Raise DataError for a name that is not valid UTF-8: OpenCV would abort the process."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise DataError('the name is not UTF-8 text, rename it', at=path) from None


def _read_image(path: Path) -> Iterator[tuple[str, np.ndarray]]:
    content = read_bytes(path)
    with ErrorsAt(path):
        image = decode(content)
    yield str(path), image


def _read_pages(path: Path, pages: int) -> Iterator[tuple[str, np.ndarray]]:
    """Read the pages of a stack in batches: OpenCV scans the file from its start for each call."""
    count = 0
    batch = 1
    while count < pages:
        batch_size = min(batch, pages - count)
        try:
            ok, images = cv2.imreadmulti(str(path), count, batch_size, flags=cv2.IMREAD_UNCHANGED)
        except cv2.error:
            ok = False
            images = ()
        if not ok or len(images) != batch_size:
            raise DataError(
                f'page {count + len(images) + 1} of {pages} is damaged or cut off', at=path
            )
        for image in images:
            count += 1
            where = f'{path}, page {count}'
            with ErrorsAt(where):
                yield where, as_grey(image)
        batch = max(1, MAX_BATCH_BYTES // images[0].nbytes)


def _open_video(path: Path) -> ImageSource:
    if not os.path.isfile(path):
        read_bytes(path)  # raises DataError with the cause
    check_name(path)
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    if not video.isOpened():
        raise DataError('this is not a video that can be read, or it is damaged', at=path)
    with ErrorsAt(path):
        check_size(*(int(video.get(key)) for key in VIDEO_SIZE))
    frame_rate = video.get(cv2.CAP_PROP_FPS)
    count = max(0, round(video.get(cv2.CAP_PROP_FRAME_COUNT)))
    if not 0 < frame_rate < 1e6:
        raise DataError('the video does not state its frame rate', at=path)
    # A damaged video may have no pixel format, which is -1.
    code = int(video.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT)) % 2**32
    pixel_format = code.to_bytes(4, 'little')
    if pixel_format == GREY_16:
        video.set(cv2.CAP_PROP_CONVERT_RGB, 0)
    elif pixel_format[:3] == GREY_16[:3]:
        raise DataError(
            f'the video has grey values of {pixel_format[3]} bits, only 8 and 16 are read', at=path
        )
    return ImageSource('video', count, _read_frames(path, video, count), frame_rate)


def _read_frames(
    path: Path, video: cv2.VideoCapture, count: int
) -> Iterator[tuple[str, np.ndarray]]:
    number = 0
    try:
        while True:
            ok, frame = video.read()
            if not ok:
                break
            number += 1
            # The channels of a grey video are equal except for rounding. Colours become luminance.
            grey = frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
            yield f'{path}, frame {number}', grey
    finally:
        video.release()
    if not number or number < count - 1 - FRAME_COUNT_TOLERANCE * count:
        raise DataError(
            f'only {number} of {count} frames can be read, the video is damaged or cut off',
            at=path,
        )
