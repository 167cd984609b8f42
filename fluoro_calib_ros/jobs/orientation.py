# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The orientation job: orient the rig from a capture of the phantom."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from ..brief import brief_repr
from ..checks.inputs import require_phantom
from ..correction.fluoroscope_calibration import Calibrations, uncorrected
from ..errors import DataError
from ..estimation.rig_orientation import orientation_of_capture, standing_frames
from ..exposures.frame import Frames
from ..exposures.phantom import Phantom
from ..findings import Finding, Kind, Place, Severity
from ..photogrammetry.rig_orientation import RigOrientation
from ..photogrammetry.rotations import rotation_angle
from ..reconstruction.intersection import Intersector
from ..reconstruction.reconstruct import ReconstructedFrame, reconstruct_exposure

MIN_MET = 0.5  # minimum share of targets in two views whose rays meet
MIN_MET_SURELY = 0.9  # below this share the orientation is doubtful
MIN_MATCHED = 10  # minimum number of targets in two views for judging a capture
MAX_SD = 2.0  # maximum median distance of targets from their survey, relative to its expectation
# Changes of the relative orientation since the previous one above which they are reported.
MAX_SHIFT = 0.002  # relative to the distance of the sources
MAX_TURN_RAD = np.deg2rad(0.2)


@dataclass(frozen=True)
class OrientationOutcome:
    """Orientation of the rig, and a check of it.

    Attributes
    ----------
    orientation : RigOrientation
    targets : int
        Number of targets of the capture that were intersected as a check.
    rms_mm : float
        Root mean square of their distances from the survey, NaN without targets.
    findings : tuple of Finding
        Doubts about the orientation, and what has changed.
    """

    __repr__ = brief_repr

    orientation: RigOrientation
    targets: int
    rms_mm: float
    findings: tuple[Finding, ...] = ()


def orient(
    frames: Frames,
    phantom: Phantom,
    calibrations: Calibrations,
    frame_id: str = 'rig',
    present: RigOrientation | None = None,
) -> OrientationOutcome:
    """Orient the rig in the frame of a phantom that stands still.

    Parameters
    ----------
    frames : mapping of str to sequence of Frame
        One or more frames of every fluoroscope.
    phantom : Phantom
    calibrations : mapping of str to FluoroscopeCalibration
    frame_id : str
        Name of the rig frame.
    present : RigOrientation, optional
        The previous orientation, with which the new one is compared.

    Raises
    ------
    DataError
        For fewer than two fluoroscopes, missing calibrations, frames that do not suffice, cannot
        be of the phantom or are already corrected, and if most rays do not meet.
    """
    require_phantom(frames, phantom)
    orientation = orientation_of_capture(frames, phantom, calibrations, frame_id)
    reconstructed = _intersected(frames, calibrations, orientation)
    met = _met(reconstructed, phantom)
    if not met.is_good and _fits_uncorrected(frames, phantom, calibrations, frame_id):
        raise DataError(
            'the image points are already corrected, their rays meet only without the correction '
            'of the calibrations',
            kind=Kind.CORRECTED_ALREADY,
            advice='give the observed image points',
        )
    offset = reconstructed.points.xyz_mm - phantom.xyz_mm[phantom.index(reconstructed.target_id)]
    offset = offset[np.isfinite(offset).all(axis=1)]
    rms = float(np.sqrt(np.mean(np.sum(offset**2, axis=1)))) if len(offset) else float('nan')
    findings = (_doubt(met), _change(present, orientation))
    return OrientationOutcome(orientation, len(offset), rms, tuple(filter(None, findings)))


@dataclass(frozen=True)
class _Met:
    """Quality of the intersection of the targets that a capture shows in two views.

    matched: number of targets; met: number of those whose rays meet; ratio: of their distances
    from the survey to the expected distances, NaN if there are none.
    """

    matched: int
    met: int
    ratio: float

    @property
    def is_good(self) -> bool:
        """Whether nothing is doubtful, or too few targets are seen to decide."""
        if self.matched < MIN_MATCHED:
            return True
        return self.met >= MIN_MET_SURELY * self.matched and self.ratio <= MAX_SD


def _intersected(
    frames: Frames, calibrations: Calibrations, orientation: RigOrientation
) -> ReconstructedFrame:
    """Return the targets of a capture, intersected with its orientation."""
    standing = standing_frames(frames, calibrations)
    return reconstruct_exposure(standing, calibrations, Intersector(orientation))


def _met(reconstructed: ReconstructedFrame, phantom: Phantom) -> _Met:
    """Return how well intersected targets fit the phantom."""
    points = reconstructed.points
    matched = int(np.sum(points.rays > 1))
    rows = phantom.index(reconstructed.target_id)
    offset = points.xyz_mm - phantom.xyz_mm[rows]
    met = np.isfinite(offset).all(axis=1)
    if not met.any():
        return _Met(matched, 0, np.nan)
    survey_variance = phantom.sd_mm[rows[met]] ** 2
    covariance = points.covariance[met] + survey_variance[:, None, None] * np.eye(3)
    scaled = np.linalg.solve(covariance, offset[met][:, :, None])[:, :, 0]
    square = np.einsum('ni,ni->n', offset[met], scaled)
    return _Met(matched, int(met.sum()), float(np.sqrt(np.median(square) / chdtri(3, 0.5))))


def _fits_uncorrected(
    frames: Frames, phantom: Phantom, calibrations: Calibrations, frame_id: str
) -> bool:
    """Return whether a capture fits the calibrations without their corrections."""
    if not any(calibrations[name].model.corrects for name in frames):
        return False
    without_correction = uncorrected(calibrations)
    try:
        orientation = orientation_of_capture(frames, phantom, without_correction, frame_id)
        return _met(_intersected(frames, without_correction, orientation), phantom).is_good
    except DataError:
        return False


def _doubt(met: _Met) -> Finding | None:
    """Return why an orientation is doubtful, None if it is not.

    Raises DataError if most rays do not meet.
    """
    if met.is_good:
        return None
    finding = Finding(
        Kind.RAYS_DO_NOT_MEET,
        f'the rays of only {met.met} of {met.matched} targets in two views meet',
        advice='the fluoroscopes are interchanged, their calibrations do not hold for these '
        'images, or the frames are from different exposures',
        numbers={'met': met.met, 'matched': met.matched, 'ratio': met.ratio},
    )
    if met.met < MIN_MET * met.matched:
        raise DataError(finding)
    cause = (
        f'doubtful: the rays of {met.met} of {met.matched} targets in two views meet, '
        f'{met.ratio:.1f} times as far from their survey as expected'
    )
    return replace(finding, cause=cause, severity=Severity.WARNING)


def _change(present: RigOrientation | None, new: RigOrientation) -> Finding | None:
    """Return a finding if the relative orientation of fluoroscopes has changed, else None."""
    if present is None or present.fluoroscopes != new.fluoroscopes:
        return None
    first, *others = range(len(new.fluoroscopes))
    for b in others:
        turns = [o.rotation[b] @ o.rotation[first].T for o in (present, new)]
        shifts = [
            o.rotation[first] @ (o.position_mm[b] - o.position_mm[first]) for o in (present, new)
        ]
        baseline = float(np.linalg.norm(shifts[0]))
        moved = float(np.linalg.norm(shifts[1] - shifts[0]))
        turned = float(rotation_angle(turns[1] @ turns[0].T))
        if moved > MAX_SHIFT * baseline or turned > MAX_TURN_RAD:
            names = (new.fluoroscopes[first], new.fluoroscopes[b])
            turned_deg = float(np.rad2deg(turned))
            scale = float(np.linalg.norm(shifts[1])) / baseline
            return Finding(
                Kind.RIG_MOVED,
                f'the relative orientation of fluoroscopes {" and ".join(names)} differs from '
                f'the previous one by {moved:.1f} mm and {turned_deg:.2f} degrees (distance of '
                f'the sources {scale:.4f} times)',
                place=Place(names, name=''),
                advice='one of them was moved since, the frames are from different exposures, or '
                'this is another phantom',
                severity=Severity.WARNING,
                numbers={'shift_mm': moved, 'turn_deg': turned_deg, 'scale': scale},
            )
    return None
