# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Iteration over images of files, folders, stacks, videos and bags, with exposure numbers."""

from __future__ import annotations

import io
import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from ..errors import DataError
from ..exposures.angles import AngleOptions, JointAngles
from ..exposures.stamps import NS_PER_S, ExposureNumbers
from ..images.codec import END_OF_MARK, is_overlay
from ..io.bags.mcap_file import METADATA, is_bag
from ..io.bags.metadata import TARGET_OBSERVATIONS
from ..io.bags.reader import angles_in, image_topics, images_of, topics_of
from ..io.image_reading import (
    DICOM_SUFFIXES,
    EXPOSURE_SUFFIXES,
    VIDEO_SUFFIXES,
    image_suffix_of,
    listed,
    open_images,
)
from ..io.recordings import read_dicom_header

# Largest difference of the stamps of one exposure in a bag, below half of the frame interval:
# still phantoms are filmed seconds apart, and clocks of cameras may differ.
TOLERANCE_NS = NS_PER_S


@dataclass(frozen=True)
class SourceImage:
    """Image of a source."""

    exposure: int
    place: str  #: file, page or message, in words
    image: np.ndarray | DataError  #: (h, w), or the reason why it cannot be read
    frame: int | None = None  #: index in its video; None if it is not of a video
    angle: float | None = None  #: of the C-arm [rad], None if unknown


@dataclass(frozen=True)
class ImageAngles:
    """Angles of the C-arm in images."""

    #: joints whose states in a bag give the angle of its images
    joints: AngleOptions = field(default_factory=AngleOptions)
    angle: float | None = None  #: angle of images without a joint [rad]

    def check(self, sources: Sequence[Path], fluoroscopes: Iterable[str]) -> None:
        """Raise DataError for a joint of an unknown fluoroscope, or a joint without a bag."""
        try:
            joints = self.joints.joints(fluoroscopes)
        except ValueError as error:
            raise DataError(f'{sources[0]}: {error}') from None
        if joints and not self.joints.of_rig and not any(map(is_image_bag, sources)):
            raise DataError(
                f'{sources[0]}: the angle of a joint needs a bag, these images have no times'
            )

    def track(self, bag: Path, fluoroscope: str) -> JointAngles:
        """Return the angles of a fluoroscope in a bag. Raises DataError if a joint is missing."""
        joints = self.joints.joints((fluoroscope,), others=True)
        joint = joints.get(fluoroscope, '')
        return angles_in(bag, (fluoroscope,), replace(self.joints, angle_joint=joint))

    def note(self, fluoroscope: str, angles: Sequence[float | None]) -> tuple[str, ...]:
        """Return a note if images of a fluoroscope with a joint have no angle, else nothing."""
        count = sum(angle is None for angle in angles)
        joint = self.joints.joints((fluoroscope,), others=True).get(fluoroscope)
        if not joint or not count:
            return ()
        return (
            f'fluoroscope {fluoroscope}: {count} of {len(angles)} images have no angle, there is '
            f'no state of joint {joint} in the {self.joints.angle_max_age:g} s before them',
        )


@dataclass(frozen=True)
class ImageSources:
    """Images of one fluoroscope, and their number (0 if unknown)."""

    count: int
    images: Callable[[], Iterator[SourceImage]]

    def counted(self, progress: Callable[[int, int], None] | None) -> Iterator[SourceImage]:
        """Yield the images; after each, call progress with its number and the total."""
        for number, image in enumerate(self.images(), 1):
            yield image
            if progress is not None:
                progress(number, max(self.count, number))


def open_sources(
    sources: Sequence[Path], fluoroscope: str = '', angles: ImageAngles | None = None
) -> ImageSources:
    """Open images of one fluoroscope.

    Images of bags have the number of their exposure by the stamps of all fluoroscopes, as live.
    If all file names contain a number and these differ, they are the exposure numbers; otherwise
    exposures are numbered in the order of the sources. fluoroscope selects the images of a bag
    with several. Raises DataError for a source that cannot contain images.
    """
    files: list[Path] = []
    bags: dict[Path, str] = {}  # name of the fluoroscope in each bag
    names: set[str] = set()  # of all fluoroscopes in bags
    for source in sources:
        if is_image_bag(source):
            names.update(image_topics(source))
            bags[source] = _name_in(source, fluoroscope)
            files.append(source)
        elif source.is_dir():
            files += _images_in(source)
        else:
            files.append(source)
    if not files:
        raise DataError('there are no images')
    angles = angles or ImageAngles()
    readers = [_reader(path, bags.get(path), fluoroscope, angles) for path in files]
    single = all(count == 1 for count, _ in readers)
    numbers = [_number(path) for path in files]
    numbered = single and None not in numbers and len(set(numbers)) == len(numbers)

    def images() -> Iterator[SourceImage]:
        exposure = 0
        of_files = 0  # number of images so far that are not of a bag
        by_stamp = ExposureNumbers(names, TOLERANCE_NS)
        for path, (_, read), number in zip(files, readers, numbers):
            video = image_suffix_of(path) in VIDEO_SUFFIXES
            for frame, (in_bag, place, image, angle) in enumerate(read(by_stamp)):
                if in_bag is not None:
                    exposure = of_files + in_bag
                else:
                    of_files += 1
                    exposure = number if numbered and number is not None else exposure + 1
                yield SourceImage(exposure, place, image, frame if video else None, angle)

    return ImageSources(sum(count for count, _ in readers), images)


def is_image_bag(source: Path) -> bool:
    """Return whether a source is a bag with images. Raises DataError for a damaged bag."""
    return is_bag(source) and bool(image_topics(source))


def fluoroscope_folders(source: Path) -> dict[str, Path]:
    """Return the folders with images in a folder, by name; empty for any other source."""
    if not source.is_dir():
        return {}
    return {
        path.name: path
        for path in sorted(source.iterdir())
        if path.is_dir() and any(map(_is_exposure, path.iterdir()))
    }


def source_of_each(source: Path, names: Sequence[str]) -> dict[str, Path]:
    """Return the images of each fluoroscope: its folder in a folder, or the bag of all.

    Raises DataError for another source, and for a missing folder.
    """
    folders = fluoroscope_folders(source)
    if not folders and not is_image_bag(source):
        raise DataError(
            f'{source}: images of {" and ".join(names)} are expected in a folder for each, or in '
            'a bag'
        )
    for name in names:
        if folders and name not in folders:
            raise DataError(
                f'{source}: there is no folder {name} with images, only {", ".join(folders)}'
            )
    return {name: folders.get(name, source) for name in names}


def _is_exposure(path: Path) -> bool:
    """Return whether a file is a radiograph by its suffix, and no picture of our results."""
    if image_suffix_of(path) not in EXPOSURE_SUFFIXES:
        return False
    try:
        with path.open('rb') if path.is_file() else io.BytesIO() as file:
            head = file.read(END_OF_MARK)
    except OSError:  # the image reader reports the reason
        head = b''
    return not is_overlay(head)


def dose_texts(source: Path) -> dict[str, str]:
    """Return the dose stated in DICOM files, by fluoroscope; '' for images of a single one.

    Empty if no file states a dose. Files that cannot be read are skipped.
    """
    texts = {}
    for name, folder in (fluoroscope_folders(source) or {'': source}).items():
        files = sorted(folder.iterdir()) if folder.is_dir() else [folder]
        doses = [
            _dose(path, path.stat().st_mtime_ns)
            for path in files
            if image_suffix_of(path) in DICOM_SUFFIXES
        ]
        sums = []
        for values, unit in zip(zip(*doses), ('mAs', 'dGy cm2')):
            stated = [value for value in values if value is not None]
            if stated:
                part = '' if len(stated) == len(doses) else f' in {len(stated)} of them'
                sums.append(f'{sum(stated):.4g} {unit}{part}')
        if sums:
            count = f'{len(doses)} DICOM files' if len(doses) > 1 else '1 DICOM file'
            texts[name] = f'{count}: {", ".join(sums)}'
    return texts


@lru_cache(maxsize=10_000)  # a live page requests this repeatedly
def _dose(path: Path, changed_ns: int) -> tuple[float | None, float | None]:
    """Return tube load and dose area product of a DICOM file, None where unknown."""
    try:
        header = read_dicom_header(path)
    except DataError:  # the image reader reports the reason
        return None, None
    return header.tube_load, header.area_dose


def contains_images(source: Path) -> bool:
    """Return whether a source is an image, a folder of images, a video, or a bag of images."""
    is_folder = source.is_dir() and not (source / METADATA).exists()
    if is_folder and (any(map(_is_exposure, source.iterdir())) or fluoroscope_folders(source)):
        return True
    if not is_bag(source):
        return not source.is_dir() and bool(image_suffix_of(source))
    try:
        types = [info.type for info in topics_of(source).values()]
    except DataError:
        return False  # the reader of bags reports the reason
    return TARGET_OBSERVATIONS not in types and bool(image_topics(source))


def _images_in(folder: Path) -> list[Path]:
    """Return the images of a folder, ordered by number and name. Raises DataError if none."""
    images = [path for path in folder.iterdir() if _is_exposure(path)]
    if not images:
        raise DataError(
            f'{folder}: there are no images in this folder ({listed(EXPOSURE_SUFFIXES)})'
        )
    return sorted(images, key=lambda path: (_number(path) is None, _number(path) or 0, path.name))


def _number(path: Path) -> int | None:
    """Return the last number in a file name, or None."""
    numbers = re.findall(r'\d+', path.name if path.suffix[1:].isdigit() else path.stem)
    return int(numbers[-1][-9:]) if numbers else None


def _name_in(source: Path, fluoroscope: str) -> str:
    """Return the name of a fluoroscope in a bag, that of its only one if it is another.

    Raises DataError.
    """
    names = sorted(image_topics(source))
    if fluoroscope in names:
        return fluoroscope
    if len(names) == 1:
        return names[0]
    raise DataError(
        f'{source}: there are no images of fluoroscope {fluoroscope!r}, only of {", ".join(names)}'
    )


# number of the exposure in a bag, place, image, angle
_Placed = tuple[int | None, str, np.ndarray | DataError, float | None]
_Read = Callable[[ExposureNumbers], Iterator[_Placed]]


def _reader(
    path: Path, name: str | None, fluoroscope: str, angles: ImageAngles
) -> tuple[int, _Read]:
    """Return the number of images of a file, and a function that reads them."""
    if name is not None:
        count = topics_of(path)[image_topics(path)[name]].count
        return count, _bag_reader(path, name, fluoroscope, angles)
    try:
        count = open_images(path).count
    except DataError as error:
        if not os.path.exists(path):
            raise
        damaged = error
        return 1, lambda _: iter([(None, str(path), damaged, None)])
    return count, lambda _: _read(path, angles.angle)


def _bag_reader(path: Path, name: str, fluoroscope: str, angles: ImageAngles) -> _Read:
    """Return a function that reads the images of a bag. Raises DataError for a missing joint."""
    track = angles.track(path, fluoroscope)

    def read(numbers: ExposureNumbers) -> Iterator[_Placed]:
        for exposure, place, image, stamp_ns in images_of(path, name, numbers):
            angle = None if stamp_ns is None else track.at(fluoroscope, stamp_ns)
            yield exposure, place, image, angle if track.joints else angles.angle

    return read


def _read(path: Path, angle: float | None) -> Iterator[_Placed]:
    """Yield the images of a file; if one cannot be read, yield the error and stop."""
    try:
        for place, image in open_images(path).images:
            yield None, place, image.copy(), angle
    except DataError as error:
        yield None, str(path), error, None
