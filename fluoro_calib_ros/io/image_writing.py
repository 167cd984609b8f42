# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Write image files, stacks and videos, image by image.

A file appears under its name only once it is complete.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import cast

import cv2
import numpy as np
from tifffile import TiffWriter

from ..errors import DataError, ErrorsAt
from ..images.codec import encode
from ..images.corrector import ImageCorrector
from .access import PathLike, atomic_file, make_folder, sync_folder, write_bytes
from .folder import temporary_folder
from .image_reading import (
    CINE_SUFFIXES,
    DICOM_SUFFIXES,
    IMAGE_SUFFIXES,
    LOSSLESS_CODEC,
    STACK_SUFFIXES,
    SUPPORTS_16_BIT_VIDEOS,
    VIDEO_CODECS,
    ImageSource,
    check_name,
    image_suffix_of,
    listed,
    open_images,
    suffix_of,
)

# Called with the number of completed images and the total number.
Progress = Callable[[int, int], None]


def write_images(out: Path, source: ImageSource, progress: Progress) -> int:
    """Write the images of a source to one file; return their number.

    progress is called after every image. Raises DataError if the file cannot be written, if its
    format cannot represent the images, and if the source raises it.
    """
    suffix = suffix_of(out)
    if suffix in VIDEO_CODECS and source.kind == 'video':
        return write_video(out, source, progress)
    if suffix in STACK_SUFFIXES:
        return _write_stack(out, source, progress)
    if source.kind != 'image':
        suffixes: tuple[str, ...] = STACK_SUFFIXES
        if source.kind == 'video':
            suffixes = (*STACK_SUFFIXES, *VIDEO_CODECS)
        raise DataError(
            f'{out}: a {source.kind} cannot be written as {suffix or "a file without suffix"}, '
            f'use {listed(suffixes)}'
        )
    if suffix not in IMAGE_SUFFIXES:
        raise DataError(
            f'{out}: the suffix {suffix or "(none)"} is not that of an image '
            f'({listed(IMAGE_SUFFIXES)})'
        )
    _, image = next(source.images)
    with ErrorsAt(out):
        content = encode(image, suffix)
    write_bytes(out, content)
    progress(1, 1)
    return 1


CLASSIC_BYTES = 4 * 10**9  # larger files need 64-bit offsets; includes a reserve


def _write_stack(out: Path, source: ImageSource, progress: Progress) -> int:
    """Write an uncompressed TIFF file, page by page; return the number of pages."""
    _, image = next(source.images)
    is_big = max(source.count, 1) * (image.nbytes + 1024) > CLASSIC_BYTES  # 1024: page header
    with (
        atomic_file(out) as file,
        TiffWriter(file, bigtiff=is_big, byteorder='<') as writer,
    ):
        page = {'photometric': 'minisblack', 'metadata': None, 'contiguous': False}
        write = partial(writer.write, software=False, **page)
        return _write_each(source, image, write, progress)


def _write_each(
    source: ImageSource, image: np.ndarray, write: Callable[[np.ndarray], None], progress: Progress
) -> int:
    """Write the given first image and the following ones; return their number."""
    number = 1
    write(image)
    progress(number, source.count)
    for number, (_, image) in enumerate(source.images, 2):
        write(image)
        progress(number, source.count)
    return number


def write_video(out: Path, source: ImageSource, progress: Progress) -> int:
    """Write a video; return the number of frames. Raises as write_images does."""
    _, image = next(source.images)
    with temporary_folder(out) as folder:
        temporary = folder / out.name
        video = _open_video(out, temporary, image, cast(float, source.frame_rate))
        try:
            number = _write_each(source, image, video.write, progress)
        finally:
            video.release()
        _check_written(out, temporary, number)
        os.replace(temporary, out)
        sync_folder(out.absolute().parent)
    return number


def _open_video(
    out: Path, temporary: Path, image: np.ndarray, frame_rate: float
) -> cv2.VideoWriter:
    """Open a writer for images of the same size and type as `image`."""
    height, width = image.shape[:2]
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
    # OpenCV 4.6 does not know the property depth: it writes 8 bits.
    depth = [cv2.VIDEOWRITER_PROP_DEPTH, cv2.CV_16U] if is_16_bit else []
    video = cv2.VideoWriter(
        str(temporary),
        cv2.CAP_FFMPEG,
        cv2.VideoWriter_fourcc(*codec),
        frame_rate,
        (width, height),
        [cv2.VIDEOWRITER_PROP_IS_COLOR, int(image.ndim == 3), *depth],
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
    with open(path, 'rb+') as file:
        os.fsync(file.fileno())


# Correction of image files, stacks and videos.
#
# Images are grey and keep their 8 or 16 bits. If the output format cannot represent them, an error
# is raised and nothing is written. Videos are written losslessly (FFV1), except for MP4.


@dataclass(frozen=True)
class CorrectedImages:
    """Result of a correction of images."""

    kind: str  #: {'image', 'stack', 'video', 'folder'}
    images: int  #: number of images, pages and frames
    files: int = 1
    passed_over: tuple[str, ...] = ()  #: names of files in a folder that are not images
    #: errors of files in a folder that could not be corrected
    failed: tuple[str, ...] = ()


# Returns the corrector of an image from its number; the first image has number 1.
Correctors = Callable[[int], ImageCorrector]


def correct_images(
    source: PathLike,
    out: PathLike,
    corrector: ImageCorrector | Correctors,
    progress: Progress | None = None,
) -> CorrectedImages:
    """Correct an image file, a stack or a video.

    corrector: applies to all images, or is a function that returns the corrector of an image from
    its number, starting at 1. progress: called after every image with the number of completed
    images and the total number. Raises DataError if the source cannot be read, is damaged, or does
    not contain grey images of the size of the calibration; if `out` cannot be written, or its
    format cannot represent the images. `out` is then unchanged.
    """
    source = Path(source)
    out = Path(out)
    check_apart(source, out)
    if out.is_dir():
        raise DataError(f'this is a folder, but {source} is a file', at=out)
    images = open_images(source)
    correctors = (lambda number: corrector) if isinstance(corrector, ImageCorrector) else corrector
    corrected = replace(images, images=_corrected_images(images, correctors))
    count = write_images(out, corrected, progress or (lambda done, total: None))
    return CorrectedImages(images.kind, count)


def check_apart(source: Path, out: Path) -> None:
    """Raise DataError if the output is the source, or its parent folder does not exist."""
    if source.exists() and out.exists() and os.path.samefile(source, out):
        raise DataError('this is the source itself, corrected images need another name', at=out)
    if not out.absolute().parent.is_dir():
        raise DataError(f'cannot be written, there is no folder {out.absolute().parent}', at=out)


def _corrected_images(
    source: ImageSource, correctors: Correctors
) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the corrected images; all of them share one array."""
    buffer = None
    for number, (where, image) in enumerate(source.images, 1):
        corrector = correctors(number)
        with ErrorsAt(where):
            corrector.check(image)
        if buffer is None or buffer.dtype != image.dtype:
            buffer = np.empty(corrector.shape, dtype=image.dtype)
        yield where, corrector.correct(image, buffer)


# Folders of images and videos, and output folders with the same structure.

# Suffixes for images whose own format can be read but not written.
_WRITTEN_AS = dict.fromkeys(CINE_SUFFIXES, '.avi') | dict.fromkeys(DICOM_SUFFIXES, '.tif')


@dataclass(frozen=True)
class ImageFolder:
    """Image files in a folder."""

    path: Path
    #: images and videos, relative to the folder, sorted by name
    files: tuple[Path, ...]
    written: tuple[Path, ...]  #: names of the output files for `files`
    passed_over: tuple[str, ...]  #: other files
    recursive: bool  #: whether subfolders are included


def _written_as(path: Path, folder: Path) -> Path:
    """Return the name of the output for an image or video of a folder."""
    suffix = image_suffix_of(folder / path)
    new_suffix = _WRITTEN_AS.get(suffix, suffix)
    if suffix_of(path) == suffix:
        return path.with_suffix(new_suffix if suffix in _WRITTEN_AS else path.suffix)
    return path.with_name(path.name + new_suffix)  # its format was recognised by content


def list_images(folder: Path, recursive: bool = False) -> ImageFolder:
    """Return the image files in a folder; recursive: in its subfolders, too.

    Raises DataError if there are none, or if two would be written under the same name.
    """
    paths = folder.rglob('*') if recursive else folder.iterdir()
    files = sorted(path.relative_to(folder) for path in paths if path.is_file())
    images = tuple(path for path in files if image_suffix_of(folder / path))
    if not images:
        raise DataError(
            f'{folder}: there are no images in this folder ({listed(IMAGE_SUFFIXES)}), and no '
            'videos'
        )
    other_files = tuple(str(path) for path in files if path not in set(images))
    written = tuple(_written_as(path, folder) for path in images)
    by_name: dict[Path, Path] = {}
    for path, name in zip(images, written):
        if name in by_name:
            raise DataError(
                f'{folder}: {by_name[name]} and {path} would both be written as {name}, rename one'
            )
        by_name[name] = path
    return ImageFolder(folder, images, written, other_files, recursive)


@contextmanager
def folder_like(out: Path, source: ImageFolder) -> Iterator[Path]:
    """Yield a temporary folder with the subfolders of source; finally move its files to `out`.

    Files of the same names in `out` are replaced, others stay. After an error, `out` is unchanged.
    Raises DataError if `out` is a file, the source itself, or inside the source and would be read
    as part of it, and if a file would replace a folder.
    """
    check_apart(source.path, out)
    if out.exists() and not out.is_dir():
        raise DataError(f'{out}: this is a file, but {source.path} is a folder')
    if source.path.resolve() in out.resolve().parents and source.recursive:
        raise DataError(f'{out}: this is inside of {source.path}, which is read with its folders')
    with temporary_folder(out) as temporary:
        folders = sorted({path.parent for path in source.files})
        for folder in folders:
            (temporary / folder).mkdir(parents=True, exist_ok=True)
        yield temporary
        _move(temporary, out, folders, source.written)


def _move(temporary: Path, out: Path, folders: Sequence[Path], names: Sequence[Path]) -> None:
    """Move the written files to their places, or none if one of them cannot be moved."""
    names = [name for name in names if (temporary / name).exists()]
    make_folder(out)
    for name in names:  # check before any file is moved
        if (out / name).is_dir():
            raise DataError(f'{out / name}: cannot be written, this is a folder')
    for folder in folders:
        (out / folder).mkdir(parents=True, exist_ok=True)
    for name in names:
        os.replace(temporary / name, out / name)
    for folder in folders:
        sync_folder(out / folder)
