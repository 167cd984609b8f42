# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Writing image files, stacks and videos, image by image.

A file appears under its name only once it is complete.
"""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import cast

import cv2
import numpy as np

from ..errors import DataError
from ..images.codec import encode
from .access import os_error_reason
from .atomic import atomic_file, sync_folder, write_bytes
from .image_formats import (
    IMAGE_SUFFIXES,
    LOSSLESS_CODEC,
    STACK_SUFFIXES,
    SUPPORTS_16_BIT_VIDEOS,
    VIDEO_CODECS,
    listed,
    suffix_of,
)
from .image_reading import ImageSource, check_name
from .tiff import StackWriter

# Called with the number of images that are done, and their total.
Progress = Callable[[int, int], None]


def write_images(out: Path, source: ImageSource, progress: Progress) -> int:
    """Write the images of a source to one file; returns their number.

    progress is called after every image. Raises DataError if the file cannot be written, if its
    format cannot hold the images, and as the source.
    """
    suffix = suffix_of(out)
    if suffix in VIDEO_CODECS and source.kind == 'video':
        return write_video(out, source, progress)
    if suffix in STACK_SUFFIXES:
        return _write_stack(out, source, progress)
    if source.kind != 'image':
        possible: tuple[str, ...] = STACK_SUFFIXES
        if source.kind == 'video':
            possible = (*STACK_SUFFIXES, *VIDEO_CODECS)
        raise DataError(
            f'{out}: a {source.kind} cannot be written as {suffix or "a file without ending"}, '
            f'use {listed(possible)}'
        )
    if suffix not in IMAGE_SUFFIXES:
        raise DataError(
            f'{out}: the ending {suffix or "(none)"} is none of an image '
            f'({listed(IMAGE_SUFFIXES)})'
        )
    _, image = next(source.images)
    try:
        content = encode(image, suffix)
    except DataError as error:
        raise DataError(f'{out}: {error}') from None
    write_bytes(out, content)
    progress(1, 1)
    return 1


def _write_stack(out: Path, source: ImageSource, progress: Progress) -> int:
    """Write an uncompressed TIFF file; returns the number of pages."""
    _, image = next(source.images)
    with (
        atomic_file(out) as file,
        StackWriter(file, max(source.count, 1), image.nbytes) as writer,
    ):
        writer.write(image)
        number = 1
        progress(number, source.count)
        for _, image in source.images:
            writer.write(image)
            number += 1
            progress(number, source.count)
    return number


def write_video(out: Path, source: ImageSource, progress: Progress) -> int:
    """Write a video; returns the number of frames. Raises as write_images."""
    _, image = next(source.images)
    with temporary_path(out) as temporary:
        video = _open_video(out, temporary, image, cast(float, source.frame_rate))
        number = 0
        try:
            video.write(image)
            number += 1
            progress(number, source.count)
            for _, image in source.images:
                video.write(image)
                number += 1
                progress(number, source.count)
        finally:
            video.release()
        _check_written(out, temporary, number)
        os.replace(temporary, out)
        sync_folder(out.absolute().parent)
    return number


def _open_video(
    out: Path, temporary: Path, image: np.ndarray, frame_rate: float
) -> cv2.VideoWriter:
    """Open a writer for images like this one."""
    height, width = image.shape
    is_16_bit = image.dtype == np.uint16
    codec = VIDEO_CODECS[suffix_of(out)]
    if width % 2 or height % 2:
        raise DataError(
            f'{out}: a video cannot have images of {width} x {height} px, both must be even'
        )
    if is_16_bit and codec != LOSSLESS_CODEC:
        raise DataError(
            f'{out}: grey values of 16 bits cannot be written as {suffix_of(out)[1:]}, '
            'use avi or mkv'
        )
    check_name(out.absolute())
    # OpenCV 4.6 knows no depth: it writes 8 bits.
    depth = [cv2.VIDEOWRITER_PROP_DEPTH, cv2.CV_16U] if is_16_bit else []
    video = cv2.VideoWriter(
        str(temporary),
        cv2.CAP_FFMPEG,
        cv2.VideoWriter_fourcc(*codec),
        frame_rate,
        (width, height),
        [cv2.VIDEOWRITER_PROP_IS_COLOR, 0, *depth],
    )
    if not video.isOpened() and is_16_bit and not SUPPORTS_16_BIT_VIDEOS:
        raise DataError(
            f'{out}: this version of OpenCV ({cv2.__version__}) cannot write videos of 16 bits, '
            'write a TIFF stack'
        )
    if not video.isOpened():
        raise DataError(f'{out}: cannot be written')
    return video


def _check_written(out: Path, path: Path, count: int) -> None:
    """Raise DataError unless a video is complete: OpenCV does not report a full disk."""
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    complete = video.isOpened() and video.get(cv2.CAP_PROP_FRAME_COUNT) >= count - 1
    video.release()
    if not complete:
        raise DataError(f'{out}: cannot be written (is the disk full?)')
    with open(path, 'rb') as file:
        os.fsync(file.fileno())


@contextmanager
def temporary_path(out: Path) -> Iterator[Path]:
    """Path next to a file or folder, with its suffix; whatever is there at the end is removed.

    An OSError in the block becomes a DataError that names `out`.
    """
    path = out.absolute().parent / f'.{out.stem[:100]}.{secrets.token_hex(8)}.tmp{out.suffix}'
    try:
        yield path
    except OSError as error:
        raise DataError(f'{out}: cannot be written ({os_error_reason(error)})') from None
    finally:
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            with suppress(OSError):
                path.unlink()
