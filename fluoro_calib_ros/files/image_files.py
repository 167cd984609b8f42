# Copyright 2026 fluoro_calib_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Correction of image files, stacks, folders of images and videos.

Images are grey and keep their 8 or 16 bits; if the new file cannot hold them, an error is raised
and nothing is written. Videos are written without loss (FFV1), except for MP4.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..errors import DataError
from ..images.corrector import ImageCorrector
from .access import make_folder
from .atomic import sync_folder
from .image_formats import IMAGE_SUFFIXES, listed, suffix_of
from .image_reading import ImageSource, open_images
from .image_writing import Progress, temporary_path, write_images


@dataclass(frozen=True)
class CorrectedImages:
    """What was corrected.

    Attributes
    ----------
    kind : {'image', 'stack', 'video', 'folder'}
    images : int
        Number of images, pages or frames.
    passed_over : tuple of str
        Names of the files of a folder that are no images.
    """

    kind: str
    images: int
    passed_over: tuple[str, ...] = ()


def correct_images(
    source: str | os.PathLike[str],
    out: str | os.PathLike[str],
    corrector: ImageCorrector,
    progress: Progress | None = None,
) -> CorrectedImages:
    """Correct an image file, a stack, a folder of images or a video.

    Parameters
    ----------
    source, out : path
        `out` is a folder if `source` is one, else a file.
    corrector : ImageCorrector
    progress : callable, optional
        Called after every image with the number of images that are done, and their total.

    Returns
    -------
    CorrectedImages

    Raises
    ------
    DataError
        If the source cannot be read, is damaged, or is no grey image of the size of the
        calibration; if `out` cannot be written, or its format cannot hold the images. `out` is
        left as it was.
    """
    source = Path(source)
    out = Path(out)
    progress = progress or _no_progress
    if source.exists() and out.exists() and os.path.samefile(source, out):
        raise DataError(f'{out}: this is the source itself, corrected images need another name')
    if not out.absolute().parent.is_dir():
        raise DataError(f'{out}: cannot be written, there is no folder {out.absolute().parent}')
    if source.is_dir():
        return _correct_folder(source, out, corrector, progress)
    if out.is_dir():
        raise DataError(f'{out}: this is a folder, but {source} is a file')
    images = open_images(source)
    written = write_images(out, _corrected(images, corrector), progress)
    return CorrectedImages(images.kind, written)


def _no_progress(done: int, total: int) -> None:
    """Ignore the progress."""


def _corrected(source: ImageSource, corrector: ImageCorrector) -> ImageSource:
    """A source of the corrected images of another."""
    return replace(source, images=_corrected_images(source, corrector))


def _corrected_images(
    source: ImageSource, corrector: ImageCorrector
) -> Iterator[tuple[str, np.ndarray]]:
    """Corrected images, all in the same array."""
    out = None
    for where, image in source.images:
        try:
            corrector.check(image)
        except DataError as error:
            raise DataError(f'{where}: {error}') from None
        if out is None or out.dtype != image.dtype:
            out = np.empty(corrector.shape, dtype=image.dtype)
        yield where, corrector.correct(image, out)


def _correct_folder(
    source: Path, out: Path, corrector: ImageCorrector, progress: Progress
) -> CorrectedImages:
    """Write all images into a temporary folder first, then move them to their place."""
    files = sorted(path for path in source.iterdir() if path.is_file())
    images = [path for path in files if suffix_of(path) in IMAGE_SUFFIXES]
    if not images:
        raise DataError(f'{source}: there are no images in this folder ({listed(IMAGE_SUFFIXES)})')
    if out.exists() and not out.is_dir():
        raise DataError(f'{out}: this is a file, but {source} is a folder')
    with temporary_path(out) as temporary:
        make_folder(temporary)
        for number, path in enumerate(images, 1):
            corrected = _corrected(open_images(path), corrector)
            write_images(temporary / path.name, corrected, _no_progress)
            progress(number, len(images))
        make_folder(out)
        for path in images:  # before any file is moved: all or nothing
            if (out / path.name).is_dir():
                raise DataError(f'{out / path.name}: cannot be written, this is a folder')
        for path in images:
            os.replace(temporary / path.name, out / path.name)
        sync_folder(out)
    passed_over = tuple(path.name for path in files if path not in images)
    return CorrectedImages('folder', len(images), passed_over)
