# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The job of the bodies: shapes, poses and joints from a recording of markers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..bodies.body import Body, BodyPoses, check_bodies, solvable_bodies
from ..bodies.butterworth import filtered_poses
from ..bodies.joints import JointMotion, joint_motion, with_neutral
from ..bodies.shapes import EstimatedShape, estimate_shape, places_of
from ..bodies.tracking import BodyTracker, TrackedExposure, poses_alone, poses_of
from ..correction.fluoroscope_calibration import FluoroscopeCalibration
from ..errors import DataError
from ..exposures.frame import Frame
from ..exposures.pairing import RecordedPairing
from ..findings import Finding, Kind, Place, Severity
from ..io.access import PathLike
from ..io.bodies import write_bodies
from ..io.folder import FolderKind, check_output_folder, replaced_folder
from ..io.formats.opensim import write_joint_motion
from ..io.joints import JointEntry, write_joints
from ..io.poses import write_motion, write_poses
from ..options import option
from ..photogrammetry.noise import ObservedScatter
from ..photogrammetry.rig_orientation import RigOrientation
from ..reconstruction.intersection import OK, OUTSIDE, Intersector
from ..reconstruction.reconstruct import (
    IntersectedViews,
    intersect_frames,
    orientation_of_recorded,
    pair_recording,
)

SMOOTH = ('auto', 'none', 'lag', 'butterworth')
SHAPE_EXPOSURES = 600  # of a recording that shapes are estimated from, evenly spread
NS_PER_S = 1_000_000_000


@dataclass(frozen=True)
class BodiesOptions(RecordedPairing):
    """Options of poses and joints. Raises ValueError for a value that an option cannot have."""

    smooth: str = option(
        'auto',
        'how poses are smoothed: by the whole trial without a cutoff (auto), not at all, with the '
        'exposures up to --lag later as live, or with a Butterworth filter of --cutoff',
        choices=SMOOTH,
    )
    lag: int = option(
        0, 'exposures that a live pose waits for', minimum=0, maximum=100, unit='exposures'
    )
    cutoff: float = option(
        10.0, 'cutoff of the Butterworth filter', minimum=0.01, maximum=1e5, unit='Hz'
    )
    reject: float = option(
        4.0,
        'deviation above which a marker does not belong to its body',
        minimum=1.0,
        maximum=1000.0,
        unit='standard deviations',
    )
    estimate_shapes: bool = True
    rate: float | None = None


@dataclass(frozen=True)
class BodiesOutcome:
    """Bodies of a recording.

    Attributes
    ----------
    shapes : tuple of EstimatedShape
    exposures : list of TrackedExposure
        In the order of time, of the centres of the markers.
    poses : list of BodyPoses
        A body each.
    joints : list of JointMotion
    unpaired : mapping of str to int
        Frames without partner, by fluoroscope.
    findings : tuple of Finding
    """

    shapes: tuple[EstimatedShape, ...]
    exposures: list[TrackedExposure]
    poses: list[BodyPoses]
    joints: list[JointMotion]
    unpaired: Mapping[str, int]
    findings: tuple[Finding, ...]

    @property
    def bodies(self) -> tuple[Body, ...]:
        """The bodies with their estimated shapes."""
        return tuple(shape.body for shape in self.shapes)


def track_bodies(
    frames: Mapping[str, Sequence[Frame]],
    calibrations: Mapping[str, FluoroscopeCalibration],
    orientation: RigOrientation,
    bodies: Sequence[Body],
    joints: Sequence[JointEntry] = (),
    options: BodiesOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> BodiesOutcome:
    """Find the poses of bodies and the motion of joints in a recording of observed image points.

    Parameters
    ----------
    frames : mapping of str to sequence of Frame
        By fluoroscope.
    calibrations : mapping of str to FluoroscopeCalibration
    orientation : RigOrientation
        That they belong to.
    bodies : sequence of Body
    joints : sequence of JointEntry
    options : BodiesOptions, optional
    progress : callable, optional
        Called with the number of exposures that are solved, and of all.

    Returns
    -------
    BodiesOutcome

    Raises
    ------
    DataError
        For frames that cannot be paired or corrected, bodies without a shape, a recording without
        times, and one that shows no body.
    """
    options = options or BodiesOptions()
    check_bodies(bodies)
    orientation = orientation_of_recorded(frames, orientation)
    exposures, unpaired = _intersected(frames, calibrations, orientation, options)
    shapes = _shapes(bodies, [one.views for one in exposures], options)
    usable = solvable_bodies([shape.body for shape in shapes])
    lag = options.lag if options.smooth == 'lag' else None
    tracker = BodyTracker(orientation, usable, options.reject, lag)
    tracked = []
    for count, one in enumerate(exposures, 1):
        found = tracker.add(one.views, one.number, one.stamp_ns)
        if found is not None:
            tracked.append(found)
        if progress is not None:
            progress(count, len(exposures))
    tracked = tracker.smoothed() if lag is None else tracked + tracker.flush()
    poses = _poses(usable, tracked, options)
    findings = [finding for shape in shapes for finding in shape.findings]
    named = {one.place for one in findings if one.kind is Kind.BODY_UNSEEN}
    unseen = [_unseen(one) for one in poses if not one.known.any()]
    findings += [one for one in unseen if one.place not in named]
    return BodiesOutcome(
        tuple(shapes),
        tracked,
        poses=poses,
        joints=_joints(joints, poses),
        unpaired=unpaired,
        findings=tuple(findings),
    )


@dataclass(frozen=True)
class _Exposure:
    number: int
    stamp_ns: int
    views: IntersectedViews


def _intersected(
    frames: Mapping[str, Sequence[Frame]],
    calibrations: Mapping[str, FluoroscopeCalibration],
    orientation: RigOrientation,
    options: BodiesOptions,
) -> tuple[list[_Exposure], dict[str, int]]:
    """Pair and intersect the frames of a recording. Raises DataError."""
    names = orientation.fluoroscopes
    paired, unpaired = pair_recording(frames, names, options.pair_by, options.pair_tolerance)
    if not paired:
        raise DataError(f'no frames of {" and ".join(names)} belong together by {options.pair_by}')
    intersector = Intersector(orientation, options.reject)
    scatter = ObservedScatter()
    out = []
    for exposure in paired:
        views, present = intersect_frames(exposure, calibrations, intersector, scatter)
        stamp = present[0].stamp_ns
        if options.rate is not None:
            stamp = 1 + round(present[0].number * NS_PER_S / options.rate)
        out.append(_Exposure(present[0].number, stamp, views))
    stamps = np.array([one.stamp_ns for one in out])
    if len(out) > 1 and not (np.diff(stamps) > 0).all():
        raise DataError(
            'the exposures have no times, or not in their order; give the rate of the recording'
        )
    return out, unpaired


def _shapes(
    bodies: Sequence[Body], exposures: Sequence[IntersectedViews], options: BodiesOptions
) -> list[EstimatedShape]:
    """Estimate the shapes of bodies from exposures that are spread over the recording."""
    if not options.estimate_shapes:
        exposures = []
    rows = np.unique(np.linspace(0, len(exposures) - 1, SHAPE_EXPOSURES).astype(int))
    chosen = [exposures[row] for row in rows] if len(exposures) else []
    ids = [one.target_id for one in chosen]
    points = [_split(one) for one in chosen]
    if not options.estimate_shapes:
        return [EstimatedShape(body, np.nan, np.nan, 0, ()) for body in bodies]
    return [estimate_shape(body, places_of(body, ids, points)) for body in bodies]


def _split(exposure: IntersectedViews) -> dict[str, np.ndarray]:
    """Points of an exposure with the covariances of noise, and of the corrections."""
    views = exposure.views
    points = exposure.points
    good = np.isin(points.status, (OK, OUTSIDE))
    with np.errstate(invalid='ignore'):
        share = np.nanmean((views.correction_sd / views.sigma) ** 2, axis=0, where=good)
    share = np.where(good, np.clip(share, 0.0, 0.99), 0.0)[:, None, None]
    covariance = points.covariance_noise
    return {
        'xyz_mm': np.where(good[:, None], points.xyz_mm, np.nan),
        'noise': (1 - share) * covariance,
        'fixed': share * covariance,
    }


def _poses(
    bodies: Sequence[Body], tracked: Sequence[TrackedExposure], options: BodiesOptions
) -> list[BodyPoses]:
    """Poses of the frames of the bodies, smoothed as the options say."""
    if options.smooth in ('auto', 'lag'):
        return poses_of(bodies, tracked)
    alone = poses_alone(bodies, tracked)
    if options.smooth == 'none':
        return alone
    return [filtered_poses(poses, options.cutoff) for poses in alone]


def _joints(requests: Sequence[JointEntry], poses: Sequence[BodyPoses]) -> list[JointMotion]:
    """Motion of joints, with their neutral position. Raises DataError."""
    by_name = {one.body: one for one in poses}
    out = []
    for request in requests:
        joint = request.joint
        proximal = by_name[joint.proximal]
        distal = by_name[joint.distal]
        if request.neutral is not None:
            first, last = request.neutral
            rows = (proximal.number >= first) & (proximal.number <= last)
            joint = with_neutral(joint, proximal.rows(rows), distal.rows(rows))
        out.append(joint_motion(joint, proximal, distal))
    return out


def _unseen(poses: BodyPoses) -> Finding:
    return Finding(
        Kind.BODY_UNSEEN,
        'no exposure shows three of its markers where they fit its shape; it has no pose',
        place=Place(name=f'body {poses.body}'),
        severity=Severity.WARNING,
        numbers={'exposures': float(len(poses.number))},
    )


# The folder with the bodies of a recording.

POSES = 'poses.csv'
MOTION = 'motion.csv'
SHAPES = 'shapes.csv'
JOINTS = 'joints.csv'
OPENSIM = 'joints.mot'
FIGURES = 'figures'
BODIES_FOLDER = FolderKind(
    'a folder of bodies',
    parts=(POSES, MOTION, SHAPES, JOINTS, OPENSIM, FIGURES),
    marks=(POSES,),
)


def check_bodies_folder(directory: PathLike, inputs: Iterable[PathLike]) -> None:
    """Raise DataError unless the bodies of a recording may be written to a folder."""
    check_output_folder(directory, BODIES_FOLDER, inputs)


def save_bodies(directory: PathLike, outcome: BodiesOutcome, figures: bool = False) -> None:
    """Write poses, motion, shapes and joints, all or nothing; with pictures of them on request.

    Raises DataError.
    """
    start_ns = int(outcome.exposures[0].stamp_ns)
    with replaced_folder(directory, BODIES_FOLDER) as folder:
        write_poses(folder / POSES, outcome.poses, start_ns)
        write_motion(folder / MOTION, outcome.bodies, outcome.exposures, start_ns)
        write_bodies(folder / SHAPES, outcome.bodies)
        if outcome.joints:
            write_joints(folder / JOINTS, outcome.joints, start_ns)
        if _some_exposure_has_all(outcome.joints):
            write_joint_motion(folder / OPENSIM, outcome.joints, start_ns)
        if figures:
            from ..report.motion_figure import write_motion_figures

            write_motion_figures(folder / FIGURES, outcome.joints, outcome.poses)


def _some_exposure_has_all(joints: Sequence[JointMotion]) -> bool:
    """Return whether the motion of all joints is known in an exposure, as OpenSim needs it."""
    known = [np.isfinite(motion.angles).all(axis=1) for motion in joints]
    return bool(known) and bool(np.all(known, axis=0).any())
