# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The extraction job: observations from images of a fluoroscope, on all cores."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path

import numpy as np

from ..brief import brief_repr
from ..errors import DataError
from ..exposures.frame import Frame
from ..exposures.phantom import Phantom
from ..findings import Finding, Kind, Place, Severity
from ..images.codec import encode_overlay
from ..images.extraction import BENT_LEFT
from ..images.lattice import NOT_MARKED, FlatGrid
from ..images.overlay import small_jpeg
from ..images.view import Lens, assumed_lens, lacks_certain_pose, shared_lens
from ..io.access import check_safe_name, make_folder, write_bytes
from ..io.bags.reader import image_topics
from ..io.folder import check_output_file
from .followers import Observations, PhantomSettings
from .image_sources import (
    ImageAngles,
    ImageSources,
    SourceImage,
    fluoroscope_folders,
    is_image_bag,
    open_sources,
)
from .scheduling import Cluster, Workers, open_workers
from .sources import Recording, Survey

FOLLOWED = 12  # images of a video after which the pose is searched for anew
RADIOGRAPH_PX = 512  # largest side of the radiographs of a report

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class ImageResult(Observations):
    """Result of the extraction from one image of a recording."""

    exposure: int = 0
    place: str = ''  #: file, page or message
    frame: Frame | None = None  #: None if there are no observations; see the finding
    png: bytes | None = None  #: overlay, if requested
    #: reduced image of full contrast, if requested and if the image gives observations
    jpeg: bytes = b''


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
        None if unknown.
    overlay : Path or None
        Folder for overlay pictures of the results.
    workers : int
        Number of processes; 0: one per core.
    scheduler : Cluster or str or None
        A Dask cluster, or the address of its scheduler, whose workers extract instead of local
        processes.
    regular_grid : bool
        The phantom is a regular flat grid. Its position and rotation are arbitrary by whole steps.
    angles : ImageAngles
        Angles of the C-arm.
    radiographs : bool
        Whether results keep their images, reduced to RADIOGRAPH_PX.
    """

    __repr__ = brief_repr

    sources: Sequence[Path]
    phantom: Phantom
    fluoroscope: str
    principal_distance_px: float | None = None
    overlay: Path | None = None
    workers: int = 0
    scheduler: Cluster | str | None = None
    regular_grid: bool = False
    angles: ImageAngles = field(default_factory=ImageAngles)
    radiographs: bool = False


@dataclass(frozen=True)
class ExtractionOutcome:
    """Results of all images of a fluoroscope, ordered by exposure, and notes."""

    __repr__ = brief_repr

    fluoroscope: str
    results: tuple[ImageResult, ...]
    notes: tuple[str | Finding, ...] = ()

    @property
    def frames(self) -> list[Frame]:
        """Observations of the images that have any."""
        return [result.frame for result in self.results if result.frame is not None]

    @property
    def refused(self) -> list[ImageResult]:
        """Images without observations."""
        return [result for result in self.results if result.frame is None]


@dataclass(frozen=True)
class _Task:
    """Images for a worker: a single one, or several successive ones of a video."""

    images: tuple[SourceImage, ...]
    settings: PhantomSettings
    overlay: bool = False
    radiographs: bool = False


def _extract(task: _Task) -> list[ImageResult]:
    """Extract the images of a task, each starting from the previous pose where possible."""
    follower = task.settings()
    name = task.settings.fluoroscope
    results = []
    for source in task.images:
        image = source.image
        if isinstance(image, DataError):
            observations = Observations(finding=image.finding)
        else:
            overlays = (name,) if task.overlay else ()
            observations = follower.extract({name: image}, source.exposure, overlays)[name]
            if observations.finding is not None:
                observations = replace(observations, finding=observations.finding.at(source.place))
        result = _result(observations, source, task.settings)
        if task.radiographs and result.frame is not None and isinstance(image, np.ndarray):
            result = replace(result, jpeg=small_jpeg(image, RADIOGRAPH_PX))
        results.append(result)
    return results


def _result(
    observations: Observations, source: SourceImage, settings: PhantomSettings
) -> ImageResult:
    """Return the observations found in an image as an ImageResult."""
    frame: Frame | None = None
    if observations.finding is None and settings.lens is not None:
        frame = Frame(
            settings.fluoroscope,
            source.exposure,
            observations.target_id,
            observations.uv,
            settings.lens.image_size,
            sigma=observations.sigma,
            angle=source.angle,
        )
    png: bytes | None = None
    if observations.picture is not None:
        png = encode_overlay(observations.picture)
    values = {**vars(observations), 'picture': None}
    return ImageResult(
        **values, exposure=source.exposure, place=source.place, frame=frame, png=png
    )


def run_extraction(
    request: ExtractionRequest, progress: Progress | None = None
) -> ExtractionOutcome:
    """Extract the beads of all images of a fluoroscope.

    An image that is damaged or does not show the phantom is skipped, and its result says why.
    Images whose pose is not found are tried again with the distortion found in the others.

    progress: called after every image with the number of finished images and their total. Raises
    DataError for sources that cannot be read, and if no image gives observations.
    """
    sources = open_sources(request.sources, request.fluoroscope, request.angles)
    if request.regular_grid and FlatGrid.of(request.phantom.xyz_mm) is None:
        raise DataError('the phantom is not a flat grid with rows and columns')
    if request.overlay is not None:
        make_picture_folder(request.overlay, request.fluoroscope, request.sources)
    with open_workers(request.workers, request.scheduler, sources.count) as workers:
        results = _first_pass(request, sources, workers, progress)
        _second_pass(request, sources, workers, results)
    if not any(result.frame is not None for result in results):
        mirrored = _mirrored(request, sources, results)
        raise DataError(mirrored or _first_of(results, results[0].finding))
    results.sort(key=lambda result: result.exposure)
    angles = [result.frame.angle for result in results if result.frame is not None]
    notes: tuple[str | Finding, ...] = request.angles.note(request.fluoroscope, angles)
    if any(part.regular_grid for part in _task(request, (), None).settings.parts):
        notes = (NOT_MARKED, *notes)
    bent = bent_shadows(request.fluoroscope, results)
    if bent is not None:
        notes = (*notes, bent)
    return ExtractionOutcome(request.fluoroscope, tuple(results), notes)


# Independent errors of a correction per coordinate: the median of `benchmarks.pathologies`.
FREE_ERRORS = 42


def bent_shadows(fluoroscope: str, results: Sequence[ImageResult]) -> Finding | None:
    """Return a warning if distortion within shadows shifts a correction beyond its noise.

    The exposures share that shift, so the standard deviation of a correction does not include it.
    """
    used = [result for result in results if result.frame is not None]
    sigma = np.concatenate([result.sigma for result in used])
    bent_px = float(np.sqrt(np.mean([result.bent_px**2 for result in used])))
    remaining_px = BENT_LEFT * bent_px
    if remaining_px < float(np.median(sigma)) * np.sqrt(FREE_ERRORS / len(sigma)):
        return None
    return Finding(
        Kind.SHADOWS_BENT,
        f'the distortion within the large shadows shifts their centres by {bent_px:.3f} px '
        f'(RMS); some {remaining_px:.3f} px of it may remain in the correction, in addition to '
        'its standard deviation',
        Place((fluoroscope,)),
        advice='smaller beads reduce it, with the square of their size',
        severity=Severity.WARNING,
        numbers={'bent_px': bent_px, 'left_px': remaining_px},
    )


def _first_pass(
    request: ExtractionRequest,
    sources: ImageSources,
    workers: Workers,
    progress: Progress | None,
) -> list[ImageResult]:
    """Extract all images, those of a video starting from the pose of the previous one."""
    lens: Lens | None = None

    def tasks() -> Iterator[_Task]:
        nonlocal lens
        for images in _groups(sources.images()):
            for image in images:
                lens = lens or _first_lens(request, image.image)
            yield _task(request, images, lens)

    results: list[ImageResult] = []
    for batch in workers.map(_extract, tasks()):
        for result in batch:
            results.append(_with_picture_written(request, result))
            if progress is not None:
                progress(len(results), max(sources.count, len(results)))
    return results


def _second_pass(
    request: ExtractionRequest,
    sources: ImageSources,
    workers: Workers,
    results: list[ImageResult],
) -> None:
    """Extract refused images again with the distortion of the others; update results in place."""
    refused = {
        number for number, result in enumerate(results) if lacks_certain_pose(result.finding)
    }
    views = [result.view for result in results if result.view is not None]
    lens = shared_lens(views[0].lens, views) if views else None
    if lens is None or not refused:
        return
    images = (image for number, image in enumerate(sources.images()) if number in refused)
    tasks = (_task(request, (image,), lens) for image in images)
    extracted = workers.map(_extract, tasks)
    for number, (result,) in zip(sorted(refused), extracted):
        if result.frame is not None:
            results[number] = _with_picture_written(request, result)


def _groups(images: Iterable[SourceImage]) -> Iterator[tuple[SourceImage, ...]]:
    """Yield images for one worker: a single one, or several successive ones of a video."""
    for _, group in groupby(enumerate(images), lambda item: _group(*item)):
        yield tuple(image for _, image in group)


def _group(number: int, image: SourceImage) -> tuple[int, int]:
    """Return a key that is equal for the images of a group."""
    if image.frame is None:
        return number, -1
    return number - image.frame, image.frame // FOLLOWED


def _task(request: ExtractionRequest, images: tuple[SourceImage, ...], lens: Lens | None) -> _Task:
    settings = PhantomSettings(
        request.fluoroscope,
        request.phantom,
        # Without a lens none of the images can be read, so this one is not used.
        lens=lens or Lens((1, 1), 1.0),
        regular_grid=request.regular_grid,
    )
    return _Task(images, settings, request.overlay is not None, request.radiographs)


def make_picture_folder(folder: Path, fluoroscope: str, sources: Iterable[Path]) -> None:
    """Create a folder for pictures FLUOROSCOPE_EXPOSURE.png.

    Raises DataError if they could replace images of the sources.
    """
    make_folder(folder)
    pattern = f'{fluoroscope}_*.png'
    for source in sources:
        for path in source.glob(pattern) if source.is_dir() else [source]:
            if path.match(pattern):
                check_output_file(folder / path.name, [path])


def _with_picture_written(request: ExtractionRequest, result: ImageResult) -> ImageResult:
    """Write the picture of a result; return the result without the picture."""
    if result.png is None or request.overlay is None:
        return result
    write_bytes(request.overlay / f'{request.fluoroscope}_{result.exposure:04d}.png', result.png)
    return replace(result, png=None)


def recording_of_images(
    source: Path,
    survey: Survey,
    fluoroscopes: Sequence[str] | None = None,
    principal_distance_px: float | None = None,
    scheduler: Cluster | str | None = None,
    progress: Progress | None = None,
    angles: ImageAngles | None = None,
) -> Recording:
    """Extract the beads of all images of a rig.

    Parameters
    ----------
    source : Path
        A folder with one folder of images per fluoroscope, a bag with images, or the images of a
        single fluoroscope.
    survey : Survey
    fluoroscopes : sequence of str, optional
        Names of those to read; required for the images of a single fluoroscope.
    principal_distance_px : float, optional
    scheduler : Cluster or str, optional
        A Dask cluster, or the address of its scheduler.
    progress : callable, optional
    angles : ImageAngles, optional
        Angles of the C-arms.

    Raises
    ------
    DataError
        If a fluoroscope has no image with observations.
    """
    folders = fluoroscope_folders(source)
    source_names = list(folders) or (list(image_topics(source)) if is_image_bag(source) else [])
    if not source_names and (fluoroscopes is None or len(fluoroscopes) != 1):
        raise DataError(
            f'{source}: these are images of one fluoroscope, name it with --fluoroscopes NAME; '
            'images of several are expected in a folder for each'
        )
    names = list(fluoroscopes or source_names)
    angles = angles or ImageAngles()
    angles.check([source], [*names, *source_names])
    frames: dict[str, list[Frame]] = {}
    radiographs: dict[str, dict[int, bytes]] = {}
    notes: list[str] = []
    for name in names:
        if source_names and name not in source_names:
            raise DataError(
                f'{source}: there is no fluoroscope {name!r}, only {", ".join(source_names)}'
            )
        check_safe_name(name, source)
        request = ExtractionRequest(
            [folders.get(name, source)],
            survey.phantom,
            name,
            principal_distance_px,
            scheduler=scheduler,
            angles=angles,
            radiographs=True,
        )
        outcome = run_extraction(request, progress)
        frames[name] = outcome.frames
        radiographs[name] = {r.exposure: r.jpeg for r in outcome.results if r.jpeg}
        notes += [f'not used: {result.finding}' for result in outcome.refused]
        notes += map(str, outcome.notes)
    return Recording(frames, {}, survey.names, tuple(notes), radiographs)


def _first_lens(request: ExtractionRequest, image: np.ndarray | DataError) -> Lens | None:
    """Return the lens assumed for the fluoroscope of an image, None for an unreadable image."""
    if isinstance(image, DataError):
        return None
    return assumed_lens((image.shape[1], image.shape[0]), request.principal_distance_px)


def _mirrored(
    request: ExtractionRequest, sources: ImageSources, results: Sequence[ImageResult]
) -> Finding | None:
    """Return a finding if the phantom is found in a mirrored image, else None.

    Two of the images are tried, none of which gives observations as it is.
    """
    refused = [result.exposure for result in results if lacks_certain_pose(result.finding)]
    tried = set(refused[:2])
    for source in sources.images():
        if source.exposure not in tried or isinstance(source.image, DataError):
            continue
        flipped = replace(source, image=np.ascontiguousarray(source.image[:, ::-1]))
        task = _task(request, (flipped,), _first_lens(request, flipped.image))
        (result,) = _extract(replace(task, overlay=False))
        if result.frame is not None:
            cause = 'the image is mirrored, the phantom is found with left and right interchanged'
            advice = 'flip the images before they are extracted'
            place = Place(name=source.place)
            return _first_of(results, Finding(Kind.IMAGE_MIRRORED, cause, place, advice))
    return None


def _first_of(results: Sequence[ImageResult], finding: Finding | None) -> Finding:
    """Return why no image gives observations, based on the finding on one of them."""
    assert finding is not None
    if len(results) == 1:
        return finding
    name = f'none of {len(results)} images gives observations, {finding.place}'
    return replace(finding, place=replace(finding.place, name=name))
