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

"""The extraction job: images of a fluoroscope to observations, on all cores."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from threadpoolctl import threadpool_limits

from ..bags.images import image_topics
from ..errors import DataError
from ..exposures.frame import Frame
from ..exposures.phantom import Phantom
from ..files.access import check_safe_name, make_folder
from ..files.atomic import write_bytes
from ..radiographs.assumptions import assumed_lens, may_be_found, shared_lens
from ..radiographs.extraction import Extraction, extract_beads
from ..radiographs.matching import PhantomModel
from ..radiographs.overlay import draw_overlay
from ..radiographs.view import Lens, View
from .image_sources import SourceImage, fluoroscope_folders, is_image_bag, open_sources
from .sources import Recording, Survey

QUEUED = 3  # images that wait for each process

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class ImageResult:
    """What was found in one image.

    Attributes
    ----------
    exposure : int
    place : str
        File, page or message.
    frame : Frame or None
        None where the image gives no observations; reason says why.
    overlapped : (n,) ndarray of bool
    reason : str
    expected : int
        Beads of the phantom in the field of view.
    found, explained : float
        Shares of the expected beads that are found, and of what is found that is expected.
    view : View or None
    seconds : float
    """

    exposure: int
    place: str
    frame: Frame | None = None
    overlapped: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=bool))
    reason: str = ''
    expected: int = 0
    found: float = 0.0
    explained: float = 0.0
    view: View | None = None
    seconds: float = 0.0


@dataclass(frozen=True)
class ExtractionRequest:
    """Images of one fluoroscope and the phantom in them.

    Attributes
    ----------
    sources : sequence of Path
        Image files, folders, stacks, videos and bags.
    phantom : Phantom
    fluoroscope : str
    principal_distance_px : float or None
        None: not known.
    overlay : Path or None
        Folder for pictures of what was found.
    workers : int
        Processes; 0: as many as there are cores.
    """

    sources: Sequence[Path]
    phantom: Phantom
    fluoroscope: str
    principal_distance_px: float | None = None
    overlay: Path | None = None
    workers: int = 0


@dataclass(frozen=True)
class ExtractionOutcome:
    """Results of all images of a fluoroscope, in the order of their exposures."""

    fluoroscope: str
    results: tuple[ImageResult, ...]

    @property
    def frames(self) -> list[Frame]:
        """Observations of the images that have some."""
        return [result.frame for result in self.results if result.frame is not None]

    @property
    def refused(self) -> list[ImageResult]:
        """Images without observations."""
        return [result for result in self.results if result.frame is None]


@dataclass(frozen=True)
class _Task:
    """An image for a worker."""

    source: SourceImage
    fluoroscope: str
    lens: Lens
    overlay: Path | None


class _Worker:
    """What a process keeps between images: the phantom, prepared for matching."""

    phantom: Phantom
    model: PhantomModel

    @classmethod
    def prepare(cls, phantom: Phantom) -> None:
        cv2.setNumThreads(1)
        cls.phantom = phantom
        cls.model = PhantomModel.of(phantom.xyz_mm, phantom.diameter_mm)

    @classmethod
    def run(cls, task: _Task) -> ImageResult:
        start = time.perf_counter()
        source = task.source
        image = source.image
        result = ImageResult(source.exposure, source.place)
        if isinstance(image, DataError):
            return replace(result, reason=_without_place(str(image), source.place))
        extraction: Extraction | None = None
        try:
            size = image.shape[::-1]
            if size != task.lens.image_size:
                expected = task.lens.image_size
                raise DataError(
                    f'the image is {size[0]} x {size[1]} px, but the first one is '
                    f'{expected[0]} x {expected[1]} px'
                )
            with threadpool_limits(1):
                extraction = extract_beads(image, cls.model, task.lens)
            result = cls._observed(result, extraction, task)
        except DataError as error:
            result = replace(result, reason=str(error))
        if task.overlay is not None:
            picture = draw_overlay(image, extraction, result.reason)
            name = f'{task.fluoroscope}_{source.exposure:04d}.png'
            write_bytes(task.overlay / name, cv2.imencode('.png', picture)[1].tobytes())
        return replace(result, seconds=time.perf_counter() - start)

    @classmethod
    def _observed(cls, result: ImageResult, extraction: Extraction, task: _Task) -> ImageResult:
        frame = Frame(
            task.fluoroscope,
            result.exposure,
            cls.phantom.target_id[extraction.bead],
            extraction.uv,
            task.lens.image_size,
            extraction.sigma,
        )
        return replace(
            result,
            frame=frame,
            overlapped=extraction.overlapped,
            expected=extraction.match.expected,
            found=extraction.match.found,
            explained=extraction.match.explained,
            view=extraction.view,
        )


def run_extraction(
    request: ExtractionRequest, progress: Progress | None = None
) -> ExtractionOutcome:
    """Extract the beads of all images of a fluoroscope.

    A damaged image, or one without the phantom, is passed over, and its result says why. Images
    whose pose is not found are tried again with the distortion that the others have.

    Parameters
    ----------
    request : ExtractionRequest
    progress : callable, optional
        Called after every image with the number of images that are done, and their total.

    Returns
    -------
    ExtractionOutcome

    Raises
    ------
    DataError
        For sources that cannot be read, and where no image gives observations.
    """
    sources = open_sources(request.sources, request.fluoroscope)
    if request.overlay is not None:
        make_folder(request.overlay)
    lens: Lens | None = None

    def tasks(chosen: Iterable[SourceImage]) -> Iterator[_Task]:
        nonlocal lens
        for source in chosen:
            if lens is None:
                lens = _first_lens(request, source.image)
            usable = lens or Lens((1, 1), 1.0)  # for an image that cannot be read
            yield _Task(source, request.fluoroscope, usable, request.overlay)

    results: list[ImageResult] = []
    workers = min(request.workers or os.cpu_count() or 1, max(sources.count, 1))
    with _Pool(request.phantom, workers) as pool:
        for result in pool.map(tasks(sources.images())):
            results.append(result)
            if progress is not None:
                progress(len(results), max(sources.count, len(results)))
        views = [result.view for result in results if result.view is not None]
        shared = None if lens is None else shared_lens(lens, views)
        again = {number for number, result in enumerate(results) if may_be_found(result.reason)}
        if shared is not None and again:
            lens = shared
            second = (s for number, s in enumerate(sources.images()) if number in again)
            for number, result in zip(sorted(again), pool.map(tasks(second))):
                if result.frame is not None:
                    results[number] = result
    if not any(result.frame is not None for result in results):
        raise DataError(_all_refused(results))
    results.sort(key=lambda result: result.exposure)
    return ExtractionOutcome(request.fluoroscope, tuple(results))


def recording_of_images(
    source: Path,
    survey: Survey,
    fluoroscopes: Sequence[str] | None = None,
    principal_distance_px: float | None = None,
    progress: Progress | None = None,
) -> Recording:
    """Extract the beads of all images of a rig.

    Parameters
    ----------
    source : Path
        A folder with a folder of images for each fluoroscope, a bag with images, or the images of
        a single fluoroscope.
    survey : Survey
    fluoroscopes : sequence of str, optional
        Names of those to read; needed for the images of a single one.
    principal_distance_px : float, optional
    progress : callable, optional

    Returns
    -------
    Recording

    Raises
    ------
    DataError
        Where a fluoroscope has no image with observations.
    """
    folders = fluoroscope_folders(source)
    known = list(folders) or (list(image_topics(source)) if is_image_bag(source) else [])
    if not known and (fluoroscopes is None or len(fluoroscopes) != 1):
        raise DataError(
            f'{source}: these are images of one fluoroscope, name it with --fluoroscopes NAME; '
            'images of several are expected in a folder for each'
        )
    names = list(fluoroscopes or known)
    frames: dict[str, list[Frame]] = {}
    notes: list[str] = []
    for name in names:
        if known and name not in known:
            raise DataError(f'{source}: there is no fluoroscope {name!r}, only {", ".join(known)}')
        check_safe_name(name, source)
        request = ExtractionRequest(
            [folders.get(name, source)], survey.phantom, name, principal_distance_px
        )
        outcome = run_extraction(request, progress)
        frames[name] = outcome.frames
        notes += [f'not used: {result.place}: {result.reason}' for result in outcome.refused]
    return Recording(frames, {}, survey.names, tuple(notes))


def _first_lens(request: ExtractionRequest, image: np.ndarray | DataError) -> Lens | None:
    """Return what is assumed of the fluoroscope of an image, None for one that cannot be read."""
    if isinstance(image, DataError):
        return None
    return assumed_lens((image.shape[1], image.shape[0]), request.principal_distance_px)


def _all_refused(results: Sequence[ImageResult]) -> str:
    """Return a sentence for sources without a usable image."""
    first = results[0]
    if len(results) == 1:
        return f'{first.place}: {first.reason}'
    return f'none of {len(results)} images gives observations, {first.place}: {first.reason}'


def _without_place(text: str, place: str) -> str:
    """Return the text of an error without the place that it begins with."""
    return text.removeprefix(f'{place}: ')


class _Pool:
    """Processes that extract images in order; none for a single one."""

    def __init__(self, phantom: Phantom, workers: int) -> None:
        self._workers = workers
        self._executor: ProcessPoolExecutor | None = None
        if workers > 1:
            self._executor = ProcessPoolExecutor(
                workers,
                multiprocessing.get_context('spawn'),
                initializer=_Worker.prepare,
                initargs=(phantom,),
            )
        else:
            _Worker.prepare(phantom)

    def __enter__(self) -> _Pool:
        return self

    def __exit__(self, *error: object) -> None:
        if self._executor is not None:
            self._executor.shutdown(wait=True, cancel_futures=True)

    def map(self, tasks: Iterator[_Task]) -> Iterator[ImageResult]:
        """Yield the results of tasks in their order; only a few images are in memory."""
        if self._executor is None:
            yield from map(_Worker.run, tasks)
            return
        waiting: deque[Future[ImageResult]] = deque()
        try:
            for task in tasks:
                waiting.append(self._executor.submit(_Worker.run, task))
                if len(waiting) >= QUEUED * self._workers:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        except BrokenProcessPool:
            raise DataError(
                'a process that extracts beads was ended from outside, perhaps for want of '
                'memory; start again with fewer processes (--workers)'
            ) from None
