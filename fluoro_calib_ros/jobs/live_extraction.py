# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Extraction of a stream: image after image of one fluoroscope, each helped by those before."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Protocol

import numpy as np

from ..errors import DataError
from ..exposures.phantom import Phantom
from ..radiographs.assumptions import assumed_lens, may_be_found, shared_lens
from ..radiographs.extraction import Extraction, Nearby, extract_beads
from ..radiographs.following import Far, moved_on
from ..radiographs.matching import PhantomModel
from ..radiographs.overlay import draw_overlay
from ..radiographs.view import Lens, View
from .service_process import ServiceProcess

VIEWS = 30  # solved images whose distortion helps where a pose is not found


@dataclass(frozen=True)
class LiveObservations:
    """What was found in one image of a stream.

    Attributes
    ----------
    target_id : (n,) ndarray of int
    uv : (n, 2) ndarray
        Centres [px].
    sigma : (n,) ndarray
        Standard deviation of a coordinate [px].
    overlapped : (n,) ndarray of bool
    reason : str
        Why there are no observations; '' where there are.
    note : str
        What should be known of the observations, such as ids that may have been exchanged.
    expected : int
        Targets that should be visible.
    found, explained : float
        Shares of the expected targets that are found, and of what is found that is expected.
    followed : bool
        Whether the image before gave the start.
    doubtful : int
        Targets whose id may be wrong.
    picture : (h, w, 3) ndarray or None
        Overlay of uint8, blue, green, red, if it was asked for.
    seconds : float
    """

    target_id: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    uv: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    sigma: np.ndarray = field(default_factory=lambda: np.zeros(0))
    overlapped: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=bool))
    reason: str = ''
    note: str = ''
    expected: int = 0
    found: float = 0.0
    explained: float = 0.0
    followed: bool = False
    doubtful: int = 0
    picture: np.ndarray | None = None
    seconds: float = 0.0


class LiveExtractor(Protocol):
    """Extracts the targets of one fluoroscope, image after image."""

    def extract(self, image: np.ndarray, number: int, overlay: bool = False) -> LiveObservations:
        """Return what is found in an image (h, w) of uint8 or uint16; never raises DataError.

        number is that of its exposure: it grows, and tells how many images are left out.
        """


# Makes the extractor of a fluoroscope, in the process in which it is to run.
MakeExtractor = Callable[[], LiveExtractor]


def extraction_process(make: MakeExtractor) -> ServiceProcess:
    """Return a process that extracts the images of one fluoroscope; it is called as `extract`."""
    return ServiceProcess(partial(_extract_of, make), 'the extraction')


def _extract_of(make: MakeExtractor) -> Callable[..., LiveObservations]:
    return make().extract


@dataclass(frozen=True)
class PhantomSettings:
    """What a PhantomFollower is made of: phantom, and principal distance [px] or None."""

    phantom: Phantom
    principal_distance_px: float | None = None

    def __call__(self) -> PhantomFollower:
        """Return a new PhantomFollower."""
        return PhantomFollower(self)


class PhantomFollower:
    """Extracts the beads of a phantom: from the pose of the image before, else from nothing.

    The observations are those of `run_extraction`: both extract an image by the same function.
    """

    def __init__(self, settings: PhantomSettings) -> None:
        phantom = settings.phantom
        self._target_id = phantom.target_id
        self._model = PhantomModel.of(phantom.xyz_mm, phantom.diameter_mm)
        self._distance = settings.principal_distance_px
        self._lens: Lens | None = None
        self._views: deque[View] = deque(maxlen=VIEWS)
        self._near: Nearby | None = None
        # Numbers and views of the last two exposures that were solved.
        self._track: deque[tuple[int, View]] = deque(maxlen=2)

    def extract(self, image: np.ndarray, number: int, overlay: bool = False) -> LiveObservations:
        """Return what is found in an image (h, w) of uint8 or uint16."""
        start = time.perf_counter()
        extraction: Extraction | None = None
        try:
            extraction = self._extraction(image, number)
            result = self._observed(extraction)
            self._near = extraction.nearby
            self._track.append((number, extraction.view))
            self._views.append(extraction.view)
        except DataError as error:
            result = LiveObservations(reason=str(error))
        picture = draw_overlay(image, extraction, result.reason) if overlay else None
        return replace(result, picture=picture, seconds=time.perf_counter() - start)

    def _extraction(self, image: np.ndarray, number: int) -> Extraction:
        """Extract the beads, if need be with the distortion of the images before.

        Raises DataError.
        """
        size = (image.shape[1], image.shape[0])
        if self._lens is None or self._lens.image_size != size:
            self._lens = assumed_lens(size, self._distance)
            self._views.clear()
            self._track.clear()
            self._near = None
        try:
            return extract_beads(image, self._model, self._lens, self._nearby(number))
        except DataError as error:
            shared = shared_lens(self._lens, list(self._views))
            if shared is None or not may_be_found(str(error)):
                raise
            return extract_beads(image, self._model, shared)

    def _nearby(self, number: int) -> Nearby | None:
        """Return the exposure before, and where the phantom may be after those left out.

        Without exposures left out, observations are those of `run_extraction`, to the bit, unless
        the phantom has hardly moved.
        """
        if self._near is None:
            return None
        last, view = self._track[-1]
        if number <= last + 1:
            return self._near
        first, before = self._track[0]
        ahead: View | None = None
        if first < last:
            centre = self._model.xyz.mean(axis=0)
            ahead = moved_on(before, view, centre, (number - last) / (last - first))
        return replace(self._near, far=Far(ahead))

    def _observed(self, extraction: Extraction) -> LiveObservations:
        return LiveObservations(
            self._target_id[extraction.bead],
            extraction.uv,
            extraction.sigma,
            extraction.overlapped,
            expected=extraction.match.expected,
            found=extraction.match.found,
            explained=extraction.match.explained,
            followed=extraction.followed,
        )
