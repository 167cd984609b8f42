# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The image correction job: correct a file, or a folder on all cores or a cluster."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from ..correction.fluoroscope_calibration import FluoroscopeCalibration
from ..errors import DataError
from ..images.angle_maps import AngleMaps
from ..images.corrector import ImageCorrector
from ..io.image_reading import VIDEO_SUFFIXES, suffix_of
from ..io.image_writing import (
    CorrectedImages,
    ImageFolder,
    Progress,
    correct_images,
    folder_like,
    list_images,
)
from .scheduling import Cluster, open_workers

PER_PROCESS = 50  # number of images that justifies starting a process


@dataclass(frozen=True)
class ImageCorrectionRequest:
    """Images of one fluoroscope, and how to correct them."""

    #: `out` is a folder if `source` is one, else a file
    source: Path
    out: Path
    calibration: FluoroscopeCalibration
    interpolation: str = 'linear'  #: {'linear', 'cubic'}
    #: processes for the files of a folder; 0: as many as are worthwhile, at most one per core
    workers: int = 0
    #: a Dask cluster, or the address of its scheduler, used instead of processes; its workers
    #: access the same folders by the same paths
    scheduler: Cluster | str | None = None
    recursive: bool = False  #: whether subfolders are included
    #: whether to correct the other files of a folder if some cannot be corrected
    keep_going: bool = False
    #: angle of the C-arm [rad] for images of a file, by image number from 1; images without an
    #: angle get the mean correction, as do all if this is None
    angles: Mapping[int, float] | None = None


def run_image_correction(
    request: ImageCorrectionRequest, progress: Progress | None = None
) -> CorrectedImages:
    """Correct an image file, a stack, a video, or all of these in a folder.

    progress is called with the completed number and the total: images of a file, files of a
    folder. Raises DataError if a source cannot be read, is damaged, or is no grey image of the
    size of the calibration; if `out` cannot be written, or its format cannot hold the images; if
    workers are lost; and for angles of a folder. `out` is then left unchanged.
    """
    if not request.source.is_dir():
        if request.angles is None:
            corrector = ImageCorrector(request.calibration, request.interpolation)
            return correct_images(request.source, request.out, corrector, progress)
        angles: Mapping[int, float] = request.angles
        maps = AngleMaps(request.calibration, request.interpolation)
        return correct_images(
            request.source, request.out, lambda number: maps.at(angles.get(number)), progress
        )
    if request.angles is not None:
        raise DataError(f'{request.source}: angles are those of the images of one file')
    folder = list_images(request.source, request.recursive)
    with folder_like(request.out, folder) as temporary:
        outcomes = list(_corrected_files(request, folder, temporary, progress))
        counts = [outcome for outcome in outcomes if isinstance(outcome, int)]
        failed = tuple(outcome for outcome in outcomes if isinstance(outcome, str))
        if not sum(counts):
            raise DataError(f'none of {len(outcomes)} files can be corrected, {failed[0]}')
    return CorrectedImages('folder', sum(counts), len(counts), folder.passed_over, failed)


def _corrected_files(
    request: ImageCorrectionRequest, folder: ImageFolder, out: Path, progress: Progress | None
) -> Iterator[int | str]:
    """Correct the files of a folder into another; yield the number of images of each.

    A file that cannot be corrected raises DataError; with keep_going, yield its problem instead.
    """
    # Absolute paths, valid for workers with another working directory.
    source = Path(os.path.abspath(folder.path))
    tasks = [(source / file, out / name) for file, name in zip(folder.files, folder.written)]
    correct = partial(_correct_file, request.calibration, request.interpolation)
    with open_workers(_count(request, folder), request.scheduler, len(tasks)) as workers:
        for number, outcome in enumerate(workers.map(correct, tasks), 1):
            if isinstance(outcome, str):
                outcome = outcome.replace(str(out), str(request.out))
                if request.scheduler is not None:
                    outcome += ' (seen by a worker of the cluster)'
                if not request.keep_going:
                    raise DataError(outcome)
            yield outcome
            if progress is not None:
                progress(number, len(tasks))


def _count(request: ImageCorrectionRequest, folder: ImageFolder) -> int:
    """Return the number of processes that is worthwhile for a folder."""
    if request.workers:
        return request.workers
    videos = sum(suffix_of(path) in VIDEO_SUFFIXES for path in folder.files)
    process_count = videos + (len(folder.files) - videos) // PER_PROCESS
    return min(max(process_count, 1), os.cpu_count() or 1)


_correctors: dict[tuple[str, str], ImageCorrector] = {}  # the last corrector of this process


def _correct_file(
    calibration: FluoroscopeCalibration, interpolation: str, task: tuple[Path, Path]
) -> int | str:
    """Correct a file in a worker; return the number of its images, or its problem."""
    key = (calibration.calibration_id, interpolation)
    if key not in _correctors:
        _correctors.clear()
        _correctors[key] = ImageCorrector(calibration, interpolation)
    try:
        return correct_images(*task, _correctors[key]).images
    except DataError as error:
        return str(error)
