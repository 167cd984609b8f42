# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The bodies job: shapes, poses and joints from a recording of markers, and films."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..bodies.anatomical_frames import BODY_FRAME, convention
from ..bodies.body import AXIS_MM, STATUS_NAMES, Body, BodyPoses, check_bodies, solvable_bodies
from ..bodies.butterworth import filtered_poses
from ..bodies.joints import (
    Joint,
    JointMotion,
    JointStatus,
    joint_motion,
    main_rotation,
    with_neutral,
)
from ..bodies.shapes import EstimatedShape, estimate_shape, places_of
from ..bodies.tracking import BodyTracker, TrackedExposure, poses_alone, poses_of
from ..brief import brief_repr
from ..checks.rig_watch import RigEvidence
from ..correction.fluoroscope_calibration import Calibrations, FluoroscopeCalibration
from ..errors import DataError
from ..exposures.frame import Frames
from ..exposures.pairing import RecordedPairing
from ..exposures.stamps import NS_PER_S
from ..findings import Finding, Kind, Place, Severity, sentences
from ..images.corrector import iterated
from ..images.overlay import BodyView, draw_bodies
from ..io.access import PathLike, write_text
from ..io.bodies import JointEntry, joint_table, motion_table, pose_table, shape_table
from ..io.csv_table import Table, dataframe_of
from ..io.folder import FolderKind, replaced_folder
from ..io.formats.bodies import write_joint_motion
from ..io.image_reading import ImageSource
from ..io.image_writing import write_video
from ..options import option
from ..photogrammetry.collinearity import project
from ..photogrammetry.rig_orientation import RigOrientation
from ..reconstruction.intersection import OK, OUTSIDE
from ..reconstruction.reconstruct import (
    IntersectedViews,
    orientation_of_recorded,
)
from .image_sources import open_sources, source_of_each
from .reconstruction import ReconstructionOptions, ReconstructionOutcome, reconstructed_rays

FILM_HZ = 25.0  # slow motion, because players cannot show 250 images per second


@dataclass(frozen=True)
class Film:
    """Input data of films."""

    source: Path  #: bag of images, or folder with one folder per fluoroscope
    calibrations: Calibrations
    orientation: RigOrientation  #: orientation of the fluoroscopes of the recording
    #: called after each image of a fluoroscope with the numbers of images read and in total
    progress: Callable[[int, int], None] | None = None


def write_films(
    folder: Path, film: Film, bodies: Sequence[Body], poses: Sequence[BodyPoses]
) -> None:
    """Write folder/film_<fluoroscope>.mp4 of the exposures that have an image.

    Raises DataError for images that cannot be read, or belong to other exposures.
    """
    for name, source in source_of_each(film.source, film.orientation.fluoroscopes).items():
        frames = _frames(source, film, name, bodies=bodies, poses=poses)
        first = next(frames, None)
        if first is None:
            raise DataError(f'{source}: there is no image of an exposure with poses')
        images = ImageSource('video', 0, chain([first], frames), FILM_HZ)
        write_video(folder / f'film_{name}.mp4', images, lambda done, total: None)


def _frames(
    source: Path, film: Film, name: str, bodies: Sequence[Body], poses: Sequence[BodyPoses]
) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the film pictures of a fluoroscope. Raises DataError for an unreadable image."""
    rows = {number: row for row, number in enumerate(poses[0].number.tolist())}
    for image in open_sources([source], name).counted(film.progress):
        if isinstance(image.image, DataError):
            raise image.image.at(image.place)
        row = rows.get(image.exposure)
        if row is not None:
            calibration = film.calibrations[name].at_angle(image.angle)
            views = [
                _view(
                    body,
                    body_poses.rows(body_poses.number == image.exposure),
                    film.orientation,
                    calibration,
                )
                for body, body_poses in zip(bodies, poses)
            ]
            yield image.place, draw_bodies(image.image, f'exposure {image.exposure}', views)


def _view(
    body: Body, pose: BodyPoses, orientation: RigOrientation, calibration: FluoroscopeCalibration
) -> BodyView:
    """Return a body at its position in the observed image of a fluoroscope."""
    row = orientation.fluoroscopes.index(calibration.fluoroscope)
    ends = body.centre + np.vstack([np.zeros(3), AXIS_MM * np.eye(3)])
    points = np.vstack([body.xyz_mm, ends]) @ pose.rotation[0].T + pose.position_mm[0]
    count = len(points)
    uv = project(
        np.broadcast_to(orientation.rotation[row], (count, 3, 3)),
        np.broadcast_to(orientation.position_mm[row], (count, 3)),
        points,
        orientation.interior[row],
    )
    if np.isfinite(uv).all():
        uv = iterated(calibration.grid, uv.T.copy()).T
    return BodyView(body.name, STATUS_NAMES[pose.status[0]], uv[:-4], uv[-4:])


if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

SMOOTH = ('auto', 'none', 'lag', 'butterworth')
# Findings on coordinates in whose frame no pose has a meaning.
WRONG_COORDINATES = (Kind.BODY_MIRRORED, Kind.WRONG_UNIT)
SHAPE_EXPOSURES = 600  # maximum number, evenly spread over a recording, used to estimate shapes


@dataclass(frozen=True)
class BodiesOptions(RecordedPairing):
    """Options of poses and joints. Raises ValueError for an invalid value.

    neutral: frames by fluoroscope of another recording with all joints in neutral position, which
    replaces the exposures named by the joints.
    """

    smooth: str = option(
        'auto',
        'smoothing of the poses: over the whole trial without a cutoff (auto), none, over the '
        'exposures up to --lag later as in live operation, or a Butterworth filter with --cutoff',
        choices=SMOOTH,
    )
    lag: int = option(
        0, 'exposures by which a live pose is delayed', minimum=0, maximum=100, unit='exposures'
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
    neutral: Frames | None = None


@dataclass(frozen=True)
class BodiesOutcome(RigEvidence):
    """Bodies of a recording, and what its rays say about the rig.

    Attributes
    ----------
    shapes : tuple of EstimatedShape
    exposures : list of TrackedExposure
        Tracked poses of the marker centres, ordered by time.
    poses : list of BodyPoses
        One entry per body.
    joints : list of JointMotion
    unpaired : mapping of str to int
        Number of frames without partner, by fluoroscope.
    findings : tuple of Finding
    """

    __repr__ = brief_repr

    shapes: tuple[EstimatedShape, ...]
    exposures: list[TrackedExposure]
    poses: list[BodyPoses]
    joints: list[JointMotion]
    unpaired: Mapping[str, int]
    findings: tuple[Finding, ...]

    @property
    def bodies(self) -> tuple[Body, ...]:
        """Bodies with their estimated shapes."""
        return tuple(shape.body for shape in self.shapes)

    def tables(self) -> dict[str, Table]:
        """Return tables of poses, motion, shapes and joints, by file name."""
        start_ns = int(self.exposures[0].stamp_ns)
        tables = {
            POSES: pose_table(self.poses, start_ns),
            MOTION: motion_table(self.bodies, self.exposures, start_ns),
            SHAPES: shape_table(self.bodies),
        }
        return {**tables, JOINTS: joint_table(self.joints, start_ns)} if self.joints else tables

    def to_dataframe(self, name: str = 'poses') -> pandas.DataFrame:
        """Return poses, motion, joints or shapes as a pandas DataFrame, as in their CSV files.

        Raises DataError for another name, and if pandas is not installed.
        """
        return dataframe_of(self.tables(), name)

    def plot(self, name: str | None = None) -> Figure:
        """Return a matplotlib figure of a joint or body; without a name, of all paths in space.

        Raises DataError for an unknown name.
        """
        from ..report.motion import body_figure, joint_figure, paths_figure

        if name is None:
            return paths_figure(self.poses)
        for motion in self.joints:
            if motion.joint.name == name:
                return joint_figure(motion)
        for poses in self.poses:
            if poses.body == name:
                return body_figure(poses)
        names = [motion.joint.name for motion in self.joints] + [
            body_poses.body for body_poses in self.poses
        ]
        raise DataError(f'no joint or body is named {name!r}, but {", ".join(names)}')

    def summary(self) -> dict[str, Any]:
        """Return the quality of bodies and joints, with median standard deviations."""
        bodies: dict[str, Any] = {}
        for poses, shape in zip(self.poses, self.shapes):
            known = poses.known
            sd = np.median(poses.sd[known], axis=0) if known.any() else np.full(6, np.nan)
            status, count = np.unique(poses.status, return_counts=True)
            bodies[poses.body] = {
                'poses': int(np.count_nonzero(known)),
                'status': {STATUS_NAMES[s]: int(n) for s, n in zip(status, count)},
                'sd_mm': float(np.sqrt(np.mean(sd[:3] ** 2))),
                'sd_deg': float(np.degrees(np.sqrt(np.mean(sd[3:] ** 2)))),
                'condition_per_m': shape.condition,
                'mean_error_mm': shape.mean_error_mm,
            }
        joints = {}
        for motion in self.joints:
            is_known = np.isfinite(motion.angles).all(axis=1)
            least = most = sd = np.full(3, np.nan)
            if is_known.any():
                least = np.degrees(motion.angles[is_known].min(axis=0))
                most = np.degrees(motion.angles[is_known].max(axis=0))
                sd = np.degrees(np.nanmedian(motion.sd[is_known, :3], axis=0))
            joints[motion.joint.name] = {
                name: {
                    'range_deg': float(most[k] - least[k]),
                    'sd_deg': float(sd[k]),
                    'least_deg': float(least[k]),
                    'most_deg': float(most[k]),
                }
                for k, name in enumerate(motion.angle_names)
            }
        return {'bodies': bodies, 'joints': joints}


def track_bodies(
    frames: Frames,
    calibrations: Calibrations,
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
        Orientation to which the calibrations belong.
    bodies : sequence of Body
    joints : sequence of JointEntry
    options : BodiesOptions, optional
    progress : callable, optional
        Called with the number of completed steps and their total, which is two per exposure.

    Raises
    ------
    DataError
        For frames that cannot be paired or corrected, bodies without a shape or with coordinates
        that are mirrored or in another unit, a recording without times, and one that shows no
        body.
    """
    options = options or BodiesOptions()
    check_bodies(bodies)
    orientation = orientation_of_recorded(frames, orientation)
    step = progress or (lambda done, total: None)
    recording = intersected(
        frames, calibrations, orientation, options, lambda done, total: step(done, 2 * total)
    )
    exposures = recording.frames
    shapes = _shapes(bodies, recording, calibrations, options)
    solvable = solvable_bodies([shape.body for shape in shapes])
    lag = options.lag if options.smooth == 'lag' else None
    tracker = BodyTracker(orientation, solvable, options.reject, lag)
    tracked = []
    for count, exposure in enumerate(exposures, 1):
        tracker.use(exposure.orientation)
        tracked_exposure = tracker.add(exposure.intersected, exposure.number, exposure.stamp_ns)
        if tracked_exposure is not None:
            tracked.append(tracked_exposure)
        step(len(exposures) + count, 2 * len(exposures))
    tracked = tracker.smoothed() if lag is None else tracked + tracker.flush()
    poses = _poses(solvable, tracked, options)
    rest_poses = []
    if options.neutral is not None:
        rest_poses = _poses_alone(options.neutral, calibrations, orientation, solvable, options)
        joints = [replace(entry, neutral=(0, sys.maxsize)) for entry in joints]
    motions = _joints(joints, poses, rest_poses or poses)
    findings = [*_on_bodies(shapes, poses), *_on_joints(joints, motions, poses)]
    return BodiesOutcome(
        tuple(shapes),
        tracked,
        poses=poses,
        joints=motions,
        unpaired=recording.unpaired,
        findings=tuple(findings),
        **{field.name: getattr(recording, field.name) for field in fields(RigEvidence)},
    )


def intersected(
    frames: Frames,
    calibrations: Calibrations,
    orientation: RigOrientation,
    options: BodiesOptions,
    progress: Callable[[int, int], None] | None = None,
) -> ReconstructionOutcome:
    """Pair and intersect the frames of a recording. Raises DataError, as `reconstruct` does."""
    if options.rate is not None and not has_times(frames):
        frames = _stamped(frames, options.rate)
    outcome, _ = reconstructed_rays(
        frames,
        calibrations,
        orientation,
        ReconstructionOptions(options.pair_by, options.pair_tolerance, reject=options.reject),
        progress,
    )
    stamps = np.array([frame.stamp_ns for frame in outcome.frames])
    if len(stamps) > 1 and not (np.diff(stamps) > 0).all():
        raise DataError(
            'the exposures have no times, or times out of order; give the rate of the recording'
        )
    return outcome


def has_times(frames: Frames) -> bool:
    """Return whether frames have stamps."""
    return any(frame.stamp_ns for exposures in frames.values() for frame in exposures)


def _stamped(frames: Frames, rate: float) -> Frames:
    """Return the frames of a recording with the times of their numbers at a rate [Hz]."""
    return {
        name: [
            replace(frame, stamp_ns=1 + round(frame.number * NS_PER_S / rate))
            for frame in view_frames
        ]
        for name, view_frames in frames.items()
    }


def estimated_shapes(
    bodies: Sequence[Body], recording: ReconstructionOutcome, calibrations: Calibrations
) -> list[EstimatedShape]:
    """Estimate the shapes of bodies from exposures spread evenly over the recording."""
    exposures = recording.frames
    rows = np.unique(np.linspace(0, len(exposures) - 1, SHAPE_EXPOSURES).astype(int))
    sampled = [exposures[row].intersected for row in rows]
    names = recording.orientation.fluoroscopes
    sides = np.array([float(max(calibrations[name].image_size)) for name in names])
    ids = [views.target_id for views in sampled]
    points = [_split(views, sides) for views in sampled]
    return [estimate_shape(body, places_of(body, ids, points)) for body in bodies]


def _shapes(
    bodies: Sequence[Body],
    recording: ReconstructionOutcome,
    calibrations: Calibrations,
    options: BodiesOptions,
) -> list[EstimatedShape]:
    """Return estimated or given shapes. Raises DataError for coordinates that are wrong."""
    shapes = estimated_shapes(bodies, recording, calibrations)
    wrong = [f for shape in shapes for f in shape.findings if f.kind in WRONG_COORDINATES]
    if wrong:
        raise DataError(*wrong)
    if options.estimate_shapes:
        return shapes
    return [EstimatedShape(body, np.nan, np.nan, 0, ()) for body in bodies]


def _split(
    exposure: IntersectedViews, sides: NDArray[np.float64]
) -> dict[str, NDArray[np.float64]]:
    """Return the points of an exposure with separate covariances of noise and corrections.

    sides (F,): longer sides of the images [px].
    """
    views = exposure.views
    points = exposure.points
    good = np.isin(points.status, (OK, OUTSIDE))
    seen = np.isfinite(views.sigma) & good
    share = np.where(seen, (views.correction_sd / views.sigma) ** 2, 0.0).sum(axis=0)
    share = np.clip(share / np.maximum(seen.sum(axis=0), 1), 0.0, 0.99)[:, None, None]
    covariance = points.covariance_noise
    return {
        'xyz_mm': np.where(good[:, None], points.xyz_mm, np.nan),
        'noise': (1 - share) * covariance,
        'fixed': share * covariance,
        'uv': np.swapaxes(views.uv / sides[:, None, None], 0, 1),
    }


def _poses(
    bodies: Sequence[Body], tracked: Sequence[TrackedExposure], options: BodiesOptions
) -> list[BodyPoses]:
    """Return the poses of the frames of the bodies, smoothed according to the options."""
    if options.smooth in ('auto', 'lag'):
        return poses_of(bodies, tracked)
    unsmoothed = poses_alone(bodies, tracked)
    if options.smooth == 'none':
        return unsmoothed
    return [filtered_poses(poses, options.cutoff) for poses in unsmoothed]


def _poses_alone(
    frames: Frames,
    calibrations: Calibrations,
    orientation: RigOrientation,
    bodies: Sequence[Body],
    options: BodiesOptions,
) -> list[BodyPoses]:
    """Return the unsmoothed poses in another recording. Raises DataError."""
    exposures = intersected(frames, calibrations, orientation, options).frames
    tracker = BodyTracker(orientation, bodies, options.reject)
    tracked = [
        tracker.add(exposure.intersected, exposure.number, exposure.stamp_ns)
        for exposure in exposures
    ]
    return poses_alone(bodies, [exposure for exposure in tracked if exposure is not None])


def _joints(
    requests: Sequence[JointEntry], poses: Sequence[BodyPoses], at_rest: Sequence[BodyPoses]
) -> list[JointMotion]:
    """Return the motion of joints; poses at rest give neutral positions. Raises DataError."""
    by_name = {body_poses.body: body_poses for body_poses in poses}
    neutral = {body_poses.body: body_poses for body_poses in at_rest}
    out = []
    for request in requests:
        joint = request.joint
        proximal = by_name[joint.proximal]
        distal = by_name[joint.distal]
        if request.neutral is not None:
            first, last = request.neutral
            neutral_poses = neutral[joint.proximal], neutral[joint.distal]
            rows = (neutral_poses[0].number >= first) & (neutral_poses[0].number <= last)
            joint = with_neutral(joint, neutral_poses[0].rows(rows), neutral_poses[1].rows(rows))
        out.append(joint_motion(joint, proximal, distal))
    return out


def _on_bodies(shapes: Sequence[EstimatedShape], poses: Sequence[BodyPoses]) -> list[Finding]:
    """Return findings on shapes, and on bodies without poses, each body once."""
    findings = [finding for shape in shapes for finding in shape.findings]
    unseen_places = {finding.place for finding in findings if finding.kind is Kind.BODY_UNSEEN}
    unseen = [_unseen(body_poses) for body_poses in poses if not body_poses.known.any()]
    return findings + [finding for finding in unseen if finding.place not in unseen_places]


def _on_joints(
    requests: Sequence[JointEntry], motions: Sequence[JointMotion], poses: Sequence[BodyPoses]
) -> list[Finding]:
    """Return findings on joints that no anatomy has.

    Angles relative to a neutral position may have any sign: those of the given frames are judged.
    """
    absolute = [
        replace(request, neutral=None)
        for request in requests
        if request.neutral is None or _has_frames(request.joint)
    ]
    given = _joints(absolute, poses, poses)
    doubts = [*map(_apart, motions), *(_impossible(one) or _bends_elsewhere(one) for one in given)]
    return [finding for finding in doubts if finding is not None]


def _unseen(poses: BodyPoses) -> Finding:
    return Finding(
        Kind.BODY_UNSEEN,
        'no exposure shows three of its markers where they fit its shape; it has no pose',
        place=Place(name=f'body {poses.body}'),
        severity=Severity.WARNING,
        numbers={'exposures': float(len(poses.number))},
    )


# Largest distance of two origins at one joint [mm]: twice that in the knee, or from the acromial
# angle to the head of the humerus, of adults (30 to 50 mm). In a bone of any size, it is less than
# half the distance between its landmarks, and it is exceeded in no more than a few exposures.
MAX_ORIGINS_MM = 100.0
MAX_ORIGINS = 0.5
# Largest angle between the axis about which a hinge is seen to bend, by as much or more, and the
# flexion axis of its bones. In the knee, where rotation accompanies flexion, it is 10 degrees.
MAX_AXIS_RAD = np.deg2rad(30.0)
FEW = 0.05  # share of exposures whose poses may be wrong


def _has_frames(joint: Joint) -> bool:
    """Return whether both frames of a joint are given; their axes and origins are then judged."""
    return all(frame is not BODY_FRAME for frame in (joint.proximal_frame, joint.distal_frame))


def _severity(joint: Joint) -> Severity:
    return Severity.ERROR if _has_frames(joint) else Severity.WARNING


def _apart(motion: JointMotion) -> Finding | None:
    """Return a finding if the bones of a joint do not meet, or None."""
    joint = motion.joint
    distance = np.linalg.norm(motion.translations, axis=1)
    if not convention(joint.convention).origins_meet or not np.isfinite(distance).any():
        return None
    largest = float(np.nanquantile(distance, 1 - FEW))
    extent = min(joint.proximal_frame.extent_mm, joint.distal_frame.extent_mm)
    if largest <= min(MAX_ORIGINS_MM, MAX_ORIGINS * extent):
        return None
    return Finding(
        Kind.JOINT_APART,
        f'the origins of {joint.proximal} and {joint.distal} are {largest:.0f} mm apart',
        place=Place(name=f'joint {joint.name}'),
        advice='check which body is proximal, and the landmarks and their unit',
        severity=_severity(joint),
        numbers={'distance_mm': largest},
    )


def _impossible(motion: JointMotion) -> Finding | None:
    """Return a finding if an angle is outside the limits of anatomy, or None."""
    joint = motion.joint
    of = convention(joint.convention)
    known = np.isfinite(motion.angles).all(axis=1) & (motion.status != JointStatus.GIMBAL)
    if not known.any():
        return None
    degrees = np.rad2deg(np.quantile(motion.angles[known], (FEW, 1 - FEW), axis=0).T)
    for name, (least, most), (low, high) in zip(of.angles, degrees, of.limits_deg):
        if least < low or most > high:
            cause = (
                f'{name} is {least:.0f} to {most:.0f} degrees, which no joint reaches (limits '
                f'{low:.0f} and {high:.0f})'
            )
            return _wrong_frames(joint, cause, least_deg=float(least), most_deg=float(most))
    return None


def _bends_elsewhere(motion: JointMotion) -> Finding | None:
    """Return a finding if a hinge bends about another axis than that of its frames, or None."""
    joint = motion.joint
    main = main_rotation(motion) if convention(joint.convention).hinge else None
    if main is None or not main[0] > MAX_AXIS_RAD < main[1]:
        return None
    degrees = float(np.rad2deg(main[1]))
    cause = f'it bends about an axis {degrees:.0f} degrees from the flexion axis of its bones'
    return _wrong_frames(joint, cause, axis_deg=degrees)


def _wrong_frames(joint: Joint, cause: str, **numbers: float) -> Finding:
    """Return the finding that a joint moves as none does between frames of these bones."""
    return Finding(
        Kind.JOINT_IMPOSSIBLE,
        cause,
        place=Place(name=f'joint {joint.name}'),
        advice='check the side, which body is proximal, and the landmarks',
        severity=_severity(joint),
        numbers=numbers,
    )


# Result folder of the bodies of a recording.

POSES = 'poses.csv'
MOTION = 'motion.csv'
SHAPES = 'shapes.csv'
JOINTS = 'joints.csv'
OPENSIM = 'joints.mot'
REPORT = 'report.html'
BODIES_FOLDER = FolderKind(
    'a folder of bodies',
    parts=(POSES, MOTION, SHAPES, JOINTS, OPENSIM, REPORT, 'film_*.mp4'),
    marks=(POSES,),
)


def save_bodies(
    directory: PathLike, outcome: BodiesOutcome, report: bool = False, film: Film | None = None
) -> None:
    """Write poses, motion, shapes and joints, all or nothing; report and films on request.

    Raises DataError.
    """
    start_ns = int(outcome.exposures[0].stamp_ns)
    with replaced_folder(directory, BODIES_FOLDER) as folder:
        for name, table in outcome.tables().items():
            table.write(folder / name)
        known = [np.isfinite(motion.angles).all(axis=1) for motion in outcome.joints]
        if known and np.all(known, axis=0).any():  # OpenSim needs the motion of all joints
            write_joint_motion(folder / OPENSIM, outcome.joints, start_ns)
        if report:
            from ..report.motion import bodies_html

            title = os.path.basename(os.path.abspath(directory))
            text = bodies_html(
                title,
                outcome.poses,
                outcome.joints,
                summary=outcome.summary(),
                findings=sentences(outcome.findings),
            )
            write_text(folder / REPORT, text)
        if film is not None:
            write_films(folder, film, outcome.bodies, outcome.poses)
