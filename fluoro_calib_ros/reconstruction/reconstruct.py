"""From observed image points to points in space: the frames of one exposure, and whole recordings.

A recording is gone through frame by frame, so that its numbers are those the live node gives. What
is done with the corrected views of an exposure is the same here and there.
"""

from dataclasses import dataclass

import numpy as np

from ..calibration.result import OUTSIDE
from ..errors import DataError
from ..exposures.pairing import recorded_pairer
from .correspondence import matched
from .intersection import IntersectedPoints


@dataclass(frozen=True)
class CorrectedView:
    """Corrected image points of one view of an exposure: target_id (n,), each once; uv (n, 2),
    sigma (n,) and correction_sd (n,), that of the correction alone [px]; outside (n,): beyond the
    calibrated area.
    """

    target_id: np.ndarray
    uv: np.ndarray
    sigma: np.ndarray
    correction_sd: np.ndarray
    outside: np.ndarray


@dataclass(frozen=True)
class IntersectedViews:
    """The points of an exposure: target_id (n,), uv (F, n, 2) and sigma (F, n) [px] of the views,
    NaN where a fluoroscope does not see a target; outside (F, n): True for what lies beyond the
    calibrated area; points: IntersectedPoints.
    """

    target_id: np.ndarray
    uv: np.ndarray
    sigma: np.ndarray
    outside: np.ndarray
    points: IntersectedPoints


def intersect_views(views, intersector):
    """IntersectedViews of the CorrectedViews of an exposure, in the order of the orientation's
    fluoroscopes; None for one that is missing.
    """
    target_id, uv, sigma, outside = matched(
        *(
            [None if view is None else getattr(view, name) for view in views]
            for name in ('target_id', 'uv', 'sigma', 'outside')
        )
    )
    return IntersectedViews(
        target_id, uv, sigma, outside, intersector.intersect(uv, sigma, outside)
    )


def watch_views(watch, stamp_ns, views, found):
    """Give a RigDriftWatch the CorrectedViews of an exposure, None for a missing one, with their
    IntersectedViews, if it wants it.

    Image points beyond the calibrated area are left out: there the correction is extrapolated, and
    markers that come to other places there would look like a drift.
    """
    if watch.is_due(stamp_ns):
        correction_sd = matched(
            *(
                [None if view is None else getattr(view, name) for view in views]
                for name in ('target_id', 'uv', 'correction_sd')
            )
        )[2]
        inside = np.where(found.outside[:, :, None], np.nan, found.uv)
        watch.add_exposure(stamp_ns, found.target_id, inside, found.sigma, correction_sd, found.points)


@dataclass(frozen=True)
class ReconstructedFrame:
    """Points of one exposure: number and stamp_ns of the frame of its first fluoroscope; target_id
    (n,); points; fluoroscopes: names of those that are in it.
    """

    number: int
    stamp_ns: int
    target_id: np.ndarray
    points: IntersectedPoints
    fluoroscopes: tuple


def reconstruct_frame(exposure, calibrations, intersector, watch=None):
    """ReconstructedFrame of an exposure {fluoroscope: Frame} of OBSERVED image points: corrected,
    then intersected.

    Two fluoroscopes of the orientation or more have to be there. calibrations {fluoroscope:
    FluoroscopeCalibration}; watch: RigDriftWatch that looks at it, None: none does. Raises DataError
    for an image of another size than that of the calibration, and for a target that is there
    twice.
    """
    frames = [exposure.get(name) for name in intersector.orientation.fluoroscopes]
    views = [
        None if frame is None else _corrected(frame, calibrations[frame.fluoroscope])
        for frame in frames
    ]
    found = intersect_views(views, intersector)
    there = [frame for frame in frames if frame is not None]
    if watch is not None:
        watch_views(watch, there[0].stamp_ns, views, found)
    return ReconstructedFrame(
        there[0].number,
        there[0].stamp_ns,
        found.target_id,
        found.points,
        tuple(frame.fluoroscope for frame in there),
    )


def _corrected(frame, calibration):
    """CorrectedView of a Frame. Raises DataError."""
    where = f'fluoroscope {frame.fluoroscope}, frame {frame.number}'
    if tuple(frame.image_size) != tuple(calibration.image_size):
        (width, height) = frame.image_size
        (w, h) = calibration.image_size
        raise DataError(
            f'{where}: the image is {width} x {height} px, but the calibration is for {w} x {h} px'
        )
    ids, counts = np.unique(frame.target_id, return_counts=True)
    if (counts > 1).any():
        raise DataError(f'{where}: target {ids[counts > 1][0]} occurs {counts.max()} times')
    u, v, sigma, correction_sd, status = calibration.correct_arrays(
        frame.uv[:, 0], frame.uv[:, 1], frame.sigma
    )
    return CorrectedView(
        frame.target_id, np.stack([u, v], axis=1), sigma, correction_sd, status == OUTSIDE
    )


def reconstruct_recording(frames, calibrations, intersector, pair_by='frame_number', watch=None):
    """ReconstructedFrames of a recording in order of time, and the number of frames {fluoroscope:
    n} whose partners are missing.

    frames {fluoroscope: [Frame, ...]}; pair_by 'frame_number' or 'stamp'; watch: RigDriftWatch that
    looks at the exposures. Of three or more fluoroscopes views may be missing. Raises DataError as
    reconstruct_frame, and where a fluoroscope of the rig has no frames.
    """
    names = intersector.orientation.fluoroscopes
    for name in names:
        if name not in frames:
            raise DataError(
                f'there are no frames of fluoroscope {name}, only of {", ".join(frames)}'
            )
    pairer = recorded_pairer(names, pair_by)
    out = []
    everything = sorted(
        (frame for name in names for frame in frames[name]), key=lambda f: (f.stamp_ns, f.number)
    )
    for exposures in (*map(pairer.add, everything), pairer.flush()):
        out += [
            reconstruct_frame(exposure, calibrations, intersector, watch) for exposure in exposures
        ]
    return out, dict(pairer.unpaired)
