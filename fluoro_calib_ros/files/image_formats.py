# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The formats of images, stacks and videos, by the suffix of a file name."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import cv2

STACK_SUFFIXES = ('.tif', '.tiff')
IMAGE_SUFFIXES = ('.png', *STACK_SUFFIXES, '.jpg', '.jpeg', '.bmp', '.pgm')
# Read, but not written: recordings of Phantom cameras, and DICOM.
CINE_SUFFIXES = ('.cine',)
DICOM_SUFFIXES = ('.dcm', '.dicom')
LOSSLESS_CODEC = 'FFV1'
SUPPORTS_16_BIT_VIDEOS = tuple(map(int, cv2.__version__.split('.')[:2])) >= (4, 7)
# Codec by which videos are written. Players know MP4 with lossy codecs only.
VIDEO_CODECS = {'.avi': LOSSLESS_CODEC, '.mkv': LOSSLESS_CODEC, '.mp4': 'mp4v'}

# Files whose images follow each other in time.
VIDEO_SUFFIXES = (*VIDEO_CODECS, *CINE_SUFFIXES, *DICOM_SUFFIXES)
# Files with one image or more of which a folder may hold one for each exposure.
EXPOSURE_SUFFIXES = (*IMAGE_SUFFIXES, *DICOM_SUFFIXES)
READ_SUFFIXES = (*IMAGE_SUFFIXES, *VIDEO_CODECS, *CINE_SUFFIXES, *DICOM_SUFFIXES)


def suffix_of(path: str | os.PathLike[str]) -> str:
    """Suffix of a path in lower case, with its dot."""
    return Path(path).suffix.lower()


def is_image_source(path: str | os.PathLike[str]) -> bool:
    """Whether a path is a folder, or a file with the suffix of an image or a video."""
    return os.path.isdir(path) or suffix_of(path) in READ_SUFFIXES


def listed(suffixes: Iterable[str]) -> str:
    """Suffixes as a text, without their dots."""
    return ', '.join(suffix[1:] for suffix in suffixes)
