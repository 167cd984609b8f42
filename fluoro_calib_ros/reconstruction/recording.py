"""From observed image points to points in space: the frames of one exposure, and whole recordings.

A recording is gone through frame by frame, so that its numbers are those the live node gives.
"""

from dataclasses import dataclass

import numpy as np

from ..calibration.collector import FramePairer
from ..calibration.result import OUTSIDE
from ..photogrammetry.observations import DataError
from .intersection import IntersectedPoints
from .matching import matched


@dataclass(frozen=True)
class ReconstructedFrame:
    """Points of one exposure: number and stamp_ns of the frame of the first fluoroscope; target_id (n,); points."""

    number: int
    stamp_ns: int
    target_id: np.ndarray
    points: IntersectedPoints


def reconstruct_frame(exposure, calibrations, intersector):
    """ReconstructedFrame of an exposure {fluoroscope: Frame} of OBSERVED image points: corrected, then intersected.

    calibrations {fluoroscope: FluoroscopeCalibration}. Raises DataError for an image of another size than that of the
    calibration, and for a target that is there twice.
    """
    names = intersector.orientation.fluoroscopes
    frames = [exposure[name] for name in names]
    corrected = []
    for frame in frames:
        calibration = calibrations[frame.fluoroscope]
        _check(frame, calibration)
        corrected.append(calibration.correct(frame.uv, frame.sigma))
    target_id, uv, sigma, outside = matched(
        [frame.target_id for frame in frames], [c.uv for c in corrected], [c.sigma for c in corrected],
        [c.status == OUTSIDE for c in corrected])
    return ReconstructedFrame(frames[0].number, frames[0].stamp_ns, target_id,
                              intersector.intersect(uv, sigma, outside))


def _check(frame, calibration):
    where = f'fluoroscope {frame.fluoroscope}, frame {frame.number}'
    if tuple(frame.image_size) != tuple(calibration.image_size):
        (width, height), (w, h) = frame.image_size, calibration.image_size
        raise DataError(f'{where}: the image is {width} x {height} px, but the calibration is for {w} x {h} px')
    ids, counts = np.unique(frame.target_id, return_counts=True)
    if (counts > 1).any():
        raise DataError(f'{where}: target {ids[counts > 1][0]} is there {counts.max()} times')


def reconstruct_recording(frames, calibrations, intersector, pair_by='frame_number'):
    """ReconstructedFrames of a recording in order of time, and the number of frames {fluoroscope: n} whose partners
    are missing.

    frames {fluoroscope: [Frame, ...]}; pair_by 'frame_number' or 'stamp'. Raises DataError as reconstruct_frame, and
    where a fluoroscope of the rig has no frames.
    """
    names = intersector.orientation.fluoroscopes
    for name in names:
        if name not in frames:
            raise DataError(f'there are no frames of fluoroscope {name}, only of {", ".join(frames)}')
    pairer, out = FramePairer(names, pair_by, waiting=10 ** 9), []
    everything = sorted((frame for name in names for frame in frames[name]), key=lambda f: (f.stamp_ns, f.number))
    for frame in everything:
        exposure = pairer.add(frame)
        if exposure is not None:
            out.append(reconstruct_frame(exposure, calibrations, intersector))
    pairer.flush()
    return out, dict(pairer.unpaired)
