# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Reading image files, stacks and videos, image by image."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ..errors import DataError
from ..images.codec import as_grey, decode
from ..images.declared_size import check_size
from .access import read_bytes
from .cine import read_cine_header, read_cine_images
from .dicom import read_dicom_header, read_dicom_images
from .image_formats import (
    CINE_SUFFIXES,
    DICOM_SUFFIXES,
    IMAGE_SUFFIXES,
    READ_SUFFIXES,
    STACK_SUFFIXES,
    VIDEO_CODECS,
    listed,
    suffix_of,
)
from .tiff import count_pages

VIDEO_SIZE = (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
MAX_BATCH_BYTES = 64_000_000  # of pages that are read at once
# Fraction of the frames by which the frame count of a video may be wrong; some containers only
# hold an estimate.
FRAME_COUNT_TOLERANCE = 0.01
GREY_16 = b'Y1\0\x10'  # OpenCV's name of the pixel format of a video of 16 bits

# Silence FFmpeg: errors are reported here, in one sentence.
os.environ.setdefault('OPENCV_FFMPEG_LOGLEVEL', '-8')


@dataclass(frozen=True)
class ImageSource:
    """Images of one file.

    Attributes
    ----------
    kind : {'image', 'stack', 'video'}
    count : int
        Number of images; of a video as its header states it.
    images : iterator
        Place in words, for error messages, and image (h, w) of uint8 or uint16. It raises
        DataError for an image that cannot be read.
    frame_rate : float or None
        Of a video [Hz].
    """

    kind: str
    count: int
    images: Iterator[tuple[str, np.ndarray]]
    frame_rate: float | None = None


def open_images(path: Path) -> ImageSource:
    """Open an image file, a stack or a video. Raises DataError if it cannot be read."""
    suffix = suffix_of(path)
    if suffix in VIDEO_CODECS:
        return _open_video(path)
    if suffix in CINE_SUFFIXES:
        header = read_cine_header(path)
        images = read_cine_images(path, header)
        return ImageSource('video', len(header.offsets), images, header.frame_rate)
    if suffix in DICOM_SUFFIXES:
        return _open_dicom(path)
    if suffix not in IMAGE_SUFFIXES:
        raise DataError(
            f'{path}: the ending {suffix or "(none)"} is none of an image or a video '
            f'({listed(READ_SUFFIXES)})'
        )
    pages = count_pages(path) if suffix in STACK_SUFFIXES else 1
    if pages > 1:
        check_name(path)
        return ImageSource('stack', pages, _read_pages(path, pages))
    return ImageSource('image', 1, _read_image(path))


def _open_dicom(path: Path) -> ImageSource:
    header = read_dicom_header(path)
    images = read_dicom_images(path, header)
    if header.count == 1:
        return ImageSource('image', 1, images)
    kind = 'stack' if header.frame_rate is None else 'video'
    return ImageSource(kind, header.count, images, header.frame_rate)


def check_name(path: Path) -> None:
    """Raise DataError for a name that is no UTF-8 text: OpenCV would end the process."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise DataError(f'{path}: the name is not UTF-8 text, rename it') from None


def _read_image(path: Path) -> Iterator[tuple[str, np.ndarray]]:
    content = read_bytes(path)
    try:
        image = decode(content)
    except DataError as error:
        raise DataError(f'{path}: {error}') from None
    yield str(path), image


def _read_pages(path: Path, pages: int) -> Iterator[tuple[str, np.ndarray]]:
    """Read the pages of a stack in batches: OpenCV goes through the file anew for each."""
    done = 0
    batch = 1
    while done < pages:
        wanted = min(batch, pages - done)
        try:
            ok, images = cv2.imreadmulti(str(path), done, wanted, flags=cv2.IMREAD_UNCHANGED)
        except cv2.error:
            ok = False
            images = ()
        if not ok or len(images) != wanted:
            raise DataError(
                f'{path}: page {done + len(images) + 1} of {pages} is damaged or cut off'
            )
        for image in images:
            done += 1
            where = f'{path}, page {done}'
            try:
                yield where, as_grey(image)
            except DataError as error:
                raise DataError(f'{where}: {error}') from None
        batch = max(1, MAX_BATCH_BYTES // images[0].nbytes)


def _open_video(path: Path) -> ImageSource:
    if not os.path.isfile(path):
        read_bytes(path)  # raises DataError with the reason
    check_name(path)
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    if not video.isOpened():
        raise DataError(f'{path}: this is no video that can be read, or it is damaged')
    try:
        check_size(*(int(video.get(key)) for key in VIDEO_SIZE))
    except DataError as error:
        raise DataError(f'{path}: {error}') from None
    frame_rate = video.get(cv2.CAP_PROP_FPS)
    count = max(0, round(video.get(cv2.CAP_PROP_FRAME_COUNT)))
    if not 0 < frame_rate < 1e6:
        raise DataError(f'{path}: the video does not state its frame rate')
    # A damaged video may have none, which is -1.
    code = int(video.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT)) % 2**32
    pixel_format = code.to_bytes(4, 'little')
    if pixel_format == GREY_16:
        video.set(cv2.CAP_PROP_CONVERT_RGB, 0)
    elif pixel_format[:3] == GREY_16[:3]:
        raise DataError(
            f'{path}: the video has grey values of {pixel_format[3]} bits, only 8 and 16 are read'
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
            # The colours of a grey video are equal except for rounding. Others are converted to
            # grey by their luminance.
            grey = frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
            yield f'{path}, frame {number}', grey
    finally:
        video.release()
    if not number or number < count - 1 - FRAME_COUNT_TOLERANCE * count:
        raise DataError(
            f'{path}: only {number} of {count} frames can be read, the video is damaged or cut off'
        )
