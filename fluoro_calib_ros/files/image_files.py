# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Correction of image files, stacks and videos.

Images are grey and keep their 8 or 16 bits; if the new file cannot hold them, an error is raised
and nothing is written. Videos are written without loss (FFV1), except for MP4.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..errors import DataError
from ..images.corrector import ImageCorrector
from .image_reading import ImageSource, open_images
from .image_writing import Progress, write_images


@dataclass(frozen=True)
class CorrectedImages:
    """What was corrected.

    Attributes
    ----------
    kind : {'image', 'stack', 'video', 'folder'}
    images : int
        Number of images, pages and frames.
    files : int
    passed_over : tuple of str
        Names of the files of a folder that are no images.
    failed : tuple of str
        What is wrong with the files of a folder that could not be corrected.
    """

    kind: str
    images: int
    files: int = 1
    passed_over: tuple[str, ...] = ()
    failed: tuple[str, ...] = ()


# Gives the corrector of an image from its number, the first being 1.
Correctors = Callable[[int], ImageCorrector]


def correct_images(
    source: str | os.PathLike[str],
    out: str | os.PathLike[str],
    corrector: ImageCorrector | Correctors,
    progress: Progress | None = None,
) -> CorrectedImages:
    """Correct an image file, a stack or a video.

    Parameters
    ----------
    source, out : path
    corrector : ImageCorrector or callable
        Of all images, or that gives the one of each image from its number, the first being 1.
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
    check_apart(source, out)
    if out.is_dir():
        raise DataError(f'{out}: this is a folder, but {source} is a file')
    images = open_images(source)
    correctors = (lambda number: corrector) if isinstance(corrector, ImageCorrector) else corrector
    written = write_images(out, _corrected(images, correctors), progress or _no_progress)
    return CorrectedImages(images.kind, written)


def check_apart(source: Path, out: Path) -> None:
    """Raise DataError where the output is the source, or has no folder to be in."""
    if source.exists() and out.exists() and os.path.samefile(source, out):
        raise DataError(f'{out}: this is the source itself, corrected images need another name')
    if not out.absolute().parent.is_dir():
        raise DataError(f'{out}: cannot be written, there is no folder {out.absolute().parent}')


def _no_progress(done: int, total: int) -> None:
    """Ignore the progress."""


def _corrected(source: ImageSource, correctors: Correctors) -> ImageSource:
    """A source of the corrected images of another."""
    return replace(source, images=_corrected_images(source, correctors))


def _corrected_images(
    source: ImageSource, correctors: Correctors
) -> Iterator[tuple[str, np.ndarray]]:
    """Corrected images, all in the same array."""
    out = None
    for number, (where, image) in enumerate(source.images, 1):
        corrector = correctors(number)
        try:
            corrector.check(image)
        except DataError as error:
            raise DataError(f'{where}: {error}') from None
        if out is None or out.dtype != image.dtype:
            out = np.empty(corrector.shape, dtype=image.dtype)
        yield where, corrector.correct(image, out)
