# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The reconstruction job: points in space from a recording, and the drift of the calibration."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ..bodies.body import Body
from ..brief import brief_repr
from ..checks.rig_watch import DriftVerdict, RecordingDriftWatch, RigEvidence
from ..correction.fluoroscope_calibration import Calibrations, ids_of
from ..errors import DataError
from ..exposures.frame import Frames
from ..exposures.names import Names
from ..exposures.pairing import RecordedPairing, disagreement_of_recording
from ..findings import Finding, Kind, Severity
from ..io.bodies import point_table
from ..options import option
from ..photogrammetry.noise import ObservedScatter
from ..photogrammetry.rig_orientation import RigOrientation
from ..reconstruction.epipolar import why_rays_miss
from ..reconstruction.intersection import STATUS_NAMES, Intersector
from ..reconstruction.lost_targets import lost_targets
from ..reconstruction.observed_noise import with_observed_noise
from ..reconstruction.reconstruct import (
    ReconstructedFrame,
    RigRecording,
    orientation_of_recorded,
)
from ..reconstruction.timing import timing_of_recording

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class ReconstructionOptions(RecordedPairing):
    """Options of a reconstruction.

    The drift watch also monitors the shapes of rigid bodies. A recording without time stamps
    (has_stamps False) can only be paired by frame number, and cannot show a drift. Raises
    ValueError for an invalid value.
    """

    reject: float = option(
        4.0,
        'epipolar distance above which a match is false',
        minimum=0.1,
        maximum=1e6,
        unit='standard deviations',
    )
    drift_watch: bool = True
    bodies: tuple[Body, ...] = ()
    has_stamps: bool = True


@dataclass(frozen=True)
class ReconstructionOutcome(RigEvidence):
    """Points of a recording, and what its rays say about the rig.

    Attributes
    ----------
    frames : list of ReconstructedFrame
        Ordered by time.
    unpaired : mapping of str to int
        Number of frames without partner, by fluoroscope.
    orientation : RigOrientation
        Of the fluoroscopes that were used.
    lost_targets : tuple of Finding
        On targets that are rejected in most of their exposures.
    """

    __repr__ = brief_repr

    frames: list[ReconstructedFrame]
    unpaired: Mapping[str, int]
    orientation: RigOrientation
    lost_targets: tuple[Finding, ...] = ()

    def to_dataframe(self, names: Names | None = None) -> pandas.DataFrame:
        """Return the points as a pandas DataFrame, with a column name if targets have names.

        Raises DataError if pandas is not installed.
        """
        return point_table(self.frames, names).to_dataframe()

    def plot(self, names: Names | None = None) -> Figure:
        """Return a matplotlib figure of the paths, gaps and standard deviations of targets."""
        from ..report.motion import points_figure

        return points_figure(self.frames, (names or Names()).target_names())

    @property
    def incomplete(self) -> int:
        """Number of frames that were not seen by all fluoroscopes."""
        count = len(self.orientation.fluoroscopes)
        return sum(len(frame.fluoroscopes) < count for frame in self.frames)

    @property
    def status_counts(self) -> dict[str, int]:
        """Number of points by status."""
        status = np.concatenate([frame.points.status for frame in self.frames])
        return dict(zip(STATUS_NAMES, np.bincount(status, minlength=len(STATUS_NAMES)).tolist()))


def reconstruct(
    frames: Frames,
    calibrations: Calibrations,
    orientation: RigOrientation,
    options: ReconstructionOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> ReconstructionOutcome:
    """Correct and intersect the observed image points of a recording.

    Parameters
    ----------
    frames : mapping of str to sequence of Frame
        By fluoroscope; two or more fluoroscopes of the orientation.
    calibrations : mapping of str to FluoroscopeCalibration
    orientation : RigOrientation
    options : ReconstructionOptions, optional
    progress : callable, optional
        Called with the number of reconstructed exposures and their total.

    Raises
    ------
    DataError
        For calibrations to which the orientation does not belong, for frames that cannot be paired
        or corrected, if most rays do not meet, and if all miss each other by a little and a trial
        identifies the cause.
    """
    outcome, recording = reconstructed_rays(
        frames, calibrations, orientation, options or ReconstructionOptions(), progress
    )
    return replace(outcome, lost_targets=tuple(lost_targets(recording, outcome.frames)))


def reconstructed_rays(
    frames: Frames,
    calibrations: Calibrations,
    orientation: RigOrientation,
    options: ReconstructionOptions,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[ReconstructionOutcome, RigRecording]:
    """Reconstruct a recording as `reconstruct` does, without a search for lost targets.

    Also returns the recording with the observed noise.
    """
    if options.pair_by == 'stamp' and not options.has_stamps:
        raise DataError(
            'the recording does not contain the times of its exposures, pair them by frame_number'
        )
    orientation = orientation_of_recorded(frames, orientation)
    orientation.check_calibrations(ids_of(calibrations))
    names = orientation.fluoroscopes
    recording, noise = with_observed_noise(
        RigRecording(frames, calibrations, Intersector(orientation, options.reject), options)
    )
    watch, drift = _drift_watch(orientation, calibrations, options)
    scatter = ObservedScatter()
    reconstructed = recording.reconstruct(watch, scatter, progress)
    if not reconstructed:
        raise DataError(f'no frames of {" and ".join(names)} belong together by {options.pair_by}')
    timing = timing_of_recording(recording)
    finding = why_rays_miss(recording, reconstructed, scatter.factor, timing)
    if finding is not None:
        raise DataError(finding)
    disagreement = None
    if options.has_stamps and options.pair_by == 'frame_number':
        disagreement = disagreement_of_recording({name: frames[name] for name in names})
    drift = watch.verdict() if watch else drift
    outcome = ReconstructionOutcome(
        reconstructed,
        recording.unpaired,
        orientation=orientation,
        drift=drift and drift.beside(timing),
        disagreement=disagreement,
        widening=scatter.factor,
        noise=noise,
        timing=timing,
    )
    return outcome, recording


def _drift_watch(
    orientation: RigOrientation, calibrations: Calibrations, options: ReconstructionOptions
) -> tuple[RecordingDriftWatch | None, DriftVerdict | None]:
    """Return the drift watch of a recording, or a verdict that explains why there is none."""
    if not options.drift_watch:
        return None, None
    if not options.has_stamps:
        cause = 'the file does not contain the times of its exposures, a drift cannot be detected'
        return None, DriftVerdict(Finding(Kind.NOT_WATCHED, cause, severity=Severity.WARNING))
    sizes = {name: calibrations[name].image_size for name in orientation.fluoroscopes}
    try:
        return RecordingDriftWatch(orientation, sizes, bodies=options.bodies), None
    except DataError as error:
        cause = f'a drift cannot be detected: {error}'
        return None, DriftVerdict(Finding(Kind.NOT_WATCHED, cause, severity=Severity.WARNING))
