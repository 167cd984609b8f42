# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Reconstruct points in space from observed image points of exposures and whole recordings.

A recording is processed exposure by exposure, with the functions that the live node calls, so that
both yield the same numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..correction.base import CorrectionStatus
from ..correction.fluoroscope_calibration import Calibrations, FluoroscopeCalibration
from ..errors import DataError
from ..exposures.frame import Frame, Frames, image_size_error, repeated_target_error
from ..exposures.pairing import RecordedPairing, exposure_pairer, recorded_exposures
from ..photogrammetry.noise import ObservedScatter
from ..photogrammetry.rig_orientation import RigOrientation
from .intersection import IntersectedPoints, Intersector

# Matching of the image points of an exposure that have the same target id in several views.


@dataclass(frozen=True)
class CorrectedView:
    """Corrected image points of one view of an exposure."""

    target_id: NDArray[np.integer]  #: (n,) unique
    uv: NDArray[np.float64]  #: (n, 2) corrected pixels
    #: (n,) standard deviations of the coordinates, and of the correction alone [px]
    sigma: NDArray[np.float64]
    correction_sd: NDArray[np.float64]
    outside: NDArray[np.bool_]  #: (n,) True beyond the calibrated area

    @classmethod
    def of_columns(
        cls, target_id: NDArray[np.integer], columns: Sequence[NDArray[Any]]
    ) -> CorrectedView:
        """Return the view of columns (n,): u, v, sigma, correction_sd [px] and status."""
        u, v, sigma, correction_sd, status = columns
        outside = status == int(CorrectionStatus.OUTSIDE)
        return cls(target_id, np.array([u, v]).T, sigma, correction_sd, outside)


class MatchedViews(CorrectedView):
    """Corrected image points of F views of an exposure, by target.

    Arrays are (F, n, ...), apart from target_id (n,): ascending, or in the common order if all
    views have the same ids in the same order. If a view does not see a target, values are NaN, and
    `outside` is False.
    """


def match_views(views: Sequence[CorrectedView | None]) -> MatchedViews:
    """Match the views of an exposure by target id; None represents a missing view.

    At least one view is required.
    """
    present = [view for view in views if view is not None]
    first = present[0].target_id
    if all(_equal(first, view.target_id) for view in present[1:]):
        target_id = first
        rows: list[NDArray[np.int64] | slice] = [slice(None)] * len(present)
    else:
        target_id = np.unique(np.concatenate([view.target_id for view in present]))
        rows = [np.searchsorted(target_id, view.target_id) for view in present]
    shape = (len(views), len(target_id))
    uv = np.full((*shape, 2), np.nan)
    sigma = np.full(shape, np.nan)
    correction_sd = np.full(shape, np.nan)
    outside = np.zeros(shape, dtype=bool)
    numbers = [number for number, view in enumerate(views) if view is not None]
    for number, view, row in zip(numbers, present, rows):
        uv[number, row] = view.uv
        sigma[number, row] = view.sigma
        correction_sd[number, row] = view.correction_sd
        outside[number, row] = view.outside
    return MatchedViews(target_id, uv, sigma, correction_sd, outside)


def _equal(one: NDArray[np.integer], other: NDArray[np.integer]) -> bool:
    """Return whether two views have the same ids in the same order."""
    return len(one) == len(other) and bool((one == other).all())


@dataclass(frozen=True)
class IntersectedViews:
    """Matched views of an exposure and their intersected points."""

    views: MatchedViews
    points: IntersectedPoints

    @property
    def target_id(self) -> np.ndarray:
        """Target ids (n,) of the points."""
        return self.views.target_id


class ExposureWatch(Protocol):
    """Protocol of an object that examines exposures, such as a RigDriftWatch."""

    def is_due(self, stamp_ns: int) -> bool:
        """Return whether the exposure with this stamp is to be examined."""

    def add_exposure(self, stamp_ns: int, exposure: IntersectedViews) -> Any:
        """Examine an exposure."""

    def widened(self, intersector: Intersector) -> tuple[Intersector, float]:
        """Return the intersector of the next exposure, and the addition to sigma [px]."""


@dataclass(frozen=True)
class ReconstructedFrame:
    """Points of one exposure."""

    #: number and stamp of the frame of its first fluoroscope
    number: int
    stamp_ns: int
    intersected: IntersectedViews
    fluoroscopes: tuple[str, ...]  #: fluoroscopes with a frame of the exposure
    orientation: RigOrientation  #: with the covariance widened after a drift alarm

    @property
    def target_id(self) -> NDArray[np.integer]:
        """Target ids (n,) of the points."""
        return self.intersected.target_id

    @property
    def points(self) -> IntersectedPoints:
        """The points in space."""
        return self.intersected.points


def intersect_exposure(
    views: Sequence[CorrectedView | None],
    intersector: Intersector,
    scatter: ObservedScatter | None = None,
    image_sd: float = 0.0,
) -> IntersectedViews:
    """Match and intersect the views of an exposure.

    views: in the order of the orientation's fluoroscopes, None if missing. scatter: scatter of the
    recording, which widens the limit of false matches. image_sd: standard deviation that is added
    to that of the corrections [px].
    """
    matched = match_views(views)
    if image_sd:
        matched = replace(
            matched,
            sigma=np.hypot(matched.sigma, image_sd),
            correction_sd=np.hypot(matched.correction_sd, image_sd),
        )
    points = intersector.intersect(matched.uv, matched.sigma, matched.outside, scatter)
    return IntersectedViews(matched, points)


def watch_exposure(watch: ExposureWatch, stamp_ns: int, exposure: IntersectedViews) -> None:
    """Pass an exposure to a watch, if it is due.

    Image points beyond the calibrated area are omitted: the correction is extrapolated there, and
    markers that move to other places would look like a drift.
    """
    if watch.is_due(stamp_ns):
        views = exposure.views
        inside = np.where(views.outside[:, :, None], np.nan, views.uv)
        watch.add_exposure(stamp_ns, replace(exposure, views=replace(views, uv=inside)))


def reconstruct_exposure(
    exposure: Mapping[str, Frame],
    calibrations: Calibrations,
    intersector: Intersector,
    watch: ExposureWatch | None = None,
    scatter: ObservedScatter | None = None,
) -> ReconstructedFrame:
    """Correct and intersect the observed image points of one exposure.

    exposure: frames by fluoroscope, of two or more fluoroscopes of the orientation. watch:
    examines the exposure. scatter: scatter of the recording so far. Raises DataError for an image
    whose size differs from that of the calibration, and for a repeated target.
    """
    frames = [exposure.get(name) for name in intersector.orientation.fluoroscopes]
    views = [
        None if frame is None else corrected_view(frame, calibrations[frame.fluoroscope])
        for frame in frames
    ]
    available = [frame for frame in frames if frame is not None]
    widened, image_sd = (intersector, 0.0) if watch is None else watch.widened(intersector)
    intersected = intersect_exposure(views, widened, scatter, image_sd)
    if watch is not None:
        watch_exposure(watch, available[0].stamp_ns, intersected)
    return ReconstructedFrame(
        available[0].number,
        available[0].stamp_ns,
        intersected,
        fluoroscopes=tuple(frame.fluoroscope for frame in available),
        orientation=widened.orientation,
    )


def corrected_view(frame: Frame, calibration: FluoroscopeCalibration) -> CorrectedView:
    """Correct a frame. Raises DataError for a wrong image size, and for a repeated target."""
    label = f'fluoroscope {frame.fluoroscope}, frame {frame.number}'
    error = image_size_error(frame.image_size, calibration.image_size)
    error = error or repeated_target_error(frame.target_id)
    if error:
        raise DataError(f'{label}: {error}')
    columns = calibration.correct_arrays(frame.uv[:, 0], frame.uv[:, 1], frame.sigma, frame.angle)
    return CorrectedView.of_columns(frame.target_id, columns)


@dataclass(frozen=True)
class RigRecording:
    """Observed frames of a recording by fluoroscope, and the rig that took them.

    With three or more fluoroscopes, some views of an exposure may be missing. Properties and
    methods raise DataError if a fluoroscope of the rig has no frames.
    """

    frames: Frames
    calibrations: Calibrations
    intersector: Intersector
    #: criterion by which frames belong to an exposure
    pairing: RecordedPairing = field(default_factory=RecordedPairing)

    @property
    def orientation(self) -> RigOrientation:
        """Orientation of the fluoroscopes that are used."""
        return self.intersector.orientation

    @property
    def fluoroscopes(self) -> tuple[str, ...]:
        """Fluoroscopes that are used."""
        return self.orientation.fluoroscopes

    @property
    def exposures(self) -> list[dict[str, Frame]]:
        """Frames of each exposure by fluoroscope, in temporal order."""
        return self._paired[0]

    @property
    def unpaired(self) -> dict[str, int]:
        """Number of frames without partners, by fluoroscope."""
        return self._paired[1]

    @cached_property
    def _paired(self) -> tuple[list[dict[str, Frame]], dict[str, int]]:
        for name in self.fluoroscopes:
            if name not in self.frames:
                raise DataError(
                    f'there are no frames of fluoroscope {name}, only of {", ".join(self.frames)}'
                )
        pairer = exposure_pairer(self.fluoroscopes, self.pairing.unlimited())
        exposures = list(
            recorded_exposures(pairer, [self.frames[name] for name in self.fluoroscopes])
        )
        return exposures, dict(pairer.unpaired)

    def with_frames(self, frames: Frames) -> RigRecording:
        """Return a recording of the same rig with other frames."""
        return replace(self, frames=frames)

    def numbered(self) -> RigRecording:
        """Return the recording with the numbers of its exposures, see ReconstructedFrame.

        Frames that are paired by stamp may be numbered differently, or not at all.
        """
        if self.pairing.pair_by == 'frame_number':
            return self
        names = self.fluoroscopes
        return self.with_frames(
            {name: [frame[name] for frame in self.exposures if name in frame] for name in names}
        )

    def selected(self, numbers: Container[int]) -> dict[str, list[Frame]]:
        """Return the frames with some numbers, by fluoroscope."""
        return {
            name: [frame for frame in self.frames[name] if frame.number in numbers]
            for name in self.fluoroscopes
        }

    def corrected(self, frame: Frame) -> CorrectedView:
        """Return the corrected view of a frame. Raises DataError, as `corrected_view` does."""
        return corrected_view(frame, self.calibrations[frame.fluoroscope])

    def reconstruct(
        self,
        watch: ExposureWatch | None = None,
        scatter: ObservedScatter | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> list[ReconstructedFrame]:
        """Return the points of the exposures, in temporal order.

        Parameters
        ----------
        watch : ExposureWatch, optional
            Examines the exposures.
        scatter : ObservedScatter, optional
            Learns the scatter of the recording, and widens the limit of false matches
            accordingly. By default a new one is created.
        progress : callable, optional
            Called with the number of reconstructed exposures, and their total number.

        Raises
        ------
        DataError
            As `reconstruct_exposure`.
        """
        scatter = scatter or ObservedScatter()
        out = []
        for count, exposure in enumerate(self.exposures, 1):
            out.append(
                reconstruct_exposure(exposure, self.calibrations, self.intersector, watch, scatter)
            )
            if progress is not None:
                progress(count, len(self.exposures))
        return out


def orientation_of_recorded(frames: Frames, orientation: RigOrientation) -> RigOrientation:
    """Return the orientation of the recorded fluoroscopes. Raises DataError for fewer than two."""
    names = [name for name in orientation.fluoroscopes if name in frames]
    if len(names) < 2:
        raise DataError(
            f'there are image points of {", ".join(frames) or "none"}, but two fluoroscopes of '
            f'the orientation ({", ".join(orientation.fluoroscopes)}) are needed'
        )
    return orientation.subset(names)
