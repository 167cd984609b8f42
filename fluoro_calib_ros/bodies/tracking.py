# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Poses of all bodies of a rig over a trial, exposure by exposure, live and offline.

Each exposure is solved starting from the poses that the filter predicts, and then passed to the
filter. A body can thus be tracked with a single view or marker left. Live, an exposure is reported
`lag` exposures later, smoothed by the subsequent ones. Offline, the same object first tracks the
trial; then the whole trial is smoothed, or reported with the same lag and the same values.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError
from ..exposures.stamps import NS_PER_S
from ..photogrammetry.rig_orientation import RigOrientation
from ..photogrammetry.rotations import cross_matrix, rotation_angle
from ..photogrammetry.unknowns import POSE_SIZE
from ..reconstruction.reconstruct import IntersectedViews
from ..rows import joined_rows
from .body import Body, BodyPoses, PoseStatus
from .joints import Joint, JointMotion, JointStatus, joint_motion, with_neutral
from .motion import POSE, UNKNOWN_RAD2, Motion, MotionFilter, smooth_trial
from .pose import FramePoses, PoseSolver, Prediction

# Standard deviation of a predicted rotation beyond which the prediction cannot locate markers: at
# 20 mm from the centre it is as far as the next marker.
LOST_SD_RAD = 0.3
# Rotation from the predicted to the seen pose beyond which a filter, which is linear about its
# prediction, fails: the second-order part is half of the first. Such a body appears anew.
ELSEWHERE_RAD = 1.0


@dataclass(frozen=True)
class TrackedExposure:
    """Poses of B bodies in one exposure."""

    number: int
    stamp_ns: int
    rotation: NDArray[np.float64]  #: (B, 3, 3) from body to rig; NaN for a lost body
    centre_mm: NDArray[np.float64]  #: (B, 3) centres of the markers
    #: (B, 6) [mm/s, rad/s] and [mm/s^2, rad/s^2]; NaN without a filter
    velocity: NDArray[np.float64]
    acceleration: NDArray[np.float64]
    #: (B, 18, 18) covariance of the random errors of pose, velocity and acceleration
    covariance: NDArray[np.float64]
    fixed: NDArray[np.float64]  #: (B, 6, 6) covariance of the constant errors of the pose
    rig_root: NDArray[np.float64]  #: (B, 6, k)
    frame: FramePoses  #: solution of the exposure alone
    status: NDArray[np.uint8]  #: (B,) PoseStatus as uint8


@dataclass(frozen=True)
class _Taken:
    """Exposure that the filter has processed, with the last known constant errors."""

    number: int
    stamp_ns: int
    frame: FramePoses
    alive: NDArray[np.bool_]
    fixed: NDArray[np.float64]
    rig_root: NDArray[np.float64]


class BodyTracker:
    """Tracks bodies from exposure to exposure.

    Parameters
    ----------
    orientation : RigOrientation
    bodies : sequence of Body
    reject : float
        Standardised deviation above which a marker does not belong to its body.
    lag : int or None
        Number of exposures after which a pose is reported; None: only by `smoothed`.
    """

    def __init__(
        self,
        orientation: RigOrientation,
        bodies: Sequence[Body],
        reject: float = 4.0,
        lag: int | None = 0,
    ) -> None:
        self.solver = PoseSolver(orientation, bodies, reject)
        self._reject = reject
        self.lag = lag
        count = len(bodies)
        self.filter = MotionFilter(count, lag)
        self._taken: list[_Taken] = []
        self._stamp_ns: int | None = None
        self._expected: tuple[int, Prediction] | None = None  # for a given time, until it is used
        self._weak = np.zeros(count, dtype=np.int64)  # exposures since one alone gave the pose
        columns = orientation.covariance.shape[0]
        self._fixed = np.full((count, POSE_SIZE, POSE_SIZE), np.nan)
        self._rig_root = np.full((count, POSE_SIZE, columns), np.nan)

    @property
    def bodies(self) -> tuple[Body, ...]:
        """Tracked bodies."""
        return self.solver.bodies

    def add(
        self, exposure: IntersectedViews, number: int, stamp_ns: int
    ) -> TrackedExposure | None:
        """Add an exposure; return the one `lag` exposures earlier, if any.

        An exposure that is not later than the previous one is ignored.
        """
        if self._stamp_ns is not None and stamp_ns <= self._stamp_ns:
            return None
        expected = self.predict(stamp_ns)
        self._expected = None
        self._stamp_ns = stamp_ns
        frame = self.solver.solve(exposure, expected)
        self._weak = np.where(frame.alone, 0, expected.weak)
        # A body that has just appeared has no useful prediction yet, as its speed is unknown: it
        # is near its last pose, and lost unless this exposure alone gives its pose.
        variance = np.diagonal(expected.covariance, axis1=1, axis2=2)[:, 3:].max(axis=1)
        angle = rotation_angle(frame.rotation @ np.swapaxes(expected.rotation, 1, 2))
        is_elsewhere = (variance > 3 * UNKNOWN_RAD2) | (angle > ELSEWHERE_RAD)
        self.filter.lose(is_elsewhere | (~expected.known & ~frame.alone))
        self.filter.update(frame.information, frame.alone & ~self.filter.alive)
        self._keep(number, stamp_ns, frame)
        if self.lag is None or len(self._taken) <= self.lag:
            return None
        return self._report(self._taken.pop(0), self.filter.smoothed(), 0)

    def predict(self, stamp_ns: int) -> Prediction:
        """Return the expected poses at a time after the last exposure."""
        if self._expected is not None and self._expected[0] == stamp_ns:
            return self._expected[1]
        dt_s = 0.0 if self._stamp_ns is None else (stamp_ns - self._stamp_ns) / NS_PER_S
        rotation, centre, covariance = self.filter.predict(dt_s)
        variance = np.diagonal(covariance, axis1=1, axis2=2)[:, 3:].max(axis=1)
        known = self.filter.alive & (variance < LOST_SD_RAD**2)
        near = self.filter.alive & ~known
        expected = Prediction(rotation, centre, covariance, known, self._weak + 1, near=near)
        self._expected = stamp_ns, expected
        return expected

    def lose(self, lost: NDArray[np.bool_]) -> None:
        """Discard the motion of bodies (B,) that are not where they were expected."""
        if lost.any():
            self.filter.lose(lost)
            self._expected = None

    def reshape(self, bodies: Sequence[Body]) -> None:
        """Replace the shapes of the bodies by better ones in the same frames."""
        before = self.solver.centre
        self.solver = PoseSolver(self.solver.orientation, bodies, self._reject)
        shift = self.filter.rotation @ (self.solver.centre - before)[:, :, None]
        self.filter.mean[:, :3] += shift[:, :, 0]
        self._expected = None

    def use(self, orientation: RigOrientation) -> None:
        """Use the same orientation with a different covariance from now on."""
        if orientation is not self.solver.orientation:
            self.solver = PoseSolver(orientation, self.bodies, self._reject)

    def flush(self) -> list[TrackedExposure]:
        """Return the exposures that have not been reported yet, at the end of a stream."""
        if not self._taken or self.lag is None:
            return []
        motion = self.filter.smoothed()
        first = len(motion.centre_mm) - len(self._taken)
        pending, self._taken = self._taken, []
        return [self._report(exposure, motion, first + k) for k, exposure in enumerate(pending)]

    def smoothed(self) -> list[TrackedExposure]:
        """Return all exposures smoothed by the whole trial; requires lag None."""
        if not self._taken:
            return []
        motion = smooth_trial(
            self.filter, [exposure.frame.information for exposure in self._taken]
        )
        exposures = _filled_backwards(self._taken)
        return [self._report(exposure, motion, k) for k, exposure in enumerate(exposures)]

    def _keep(self, number: int, stamp_ns: int, frame: FramePoses) -> None:
        """Store an exposure, and the constant errors of bodies that are seen."""
        seen = np.isfinite(frame.covariance_fixed[:, 0, 0])[:, None, None]
        self._fixed = np.where(seen, frame.covariance_fixed, self._fixed)
        self._rig_root = np.where(seen, frame.rig_root, self._rig_root)
        self._taken.append(
            _Taken(
                number,
                stamp_ns,
                frame=frame,
                alive=self.filter.alive.copy(),
                fixed=self._fixed,
                rig_root=self._rig_root,
            )
        )

    def _report(self, one: _Taken, motion: Motion, row: int) -> TrackedExposure:
        """Return an exposure with the given row of a motion."""
        frame = one.frame
        lost = ~one.alive
        status = np.full(len(lost), PoseStatus.FILLED, dtype=np.uint8)
        status[frame.markers > 0] = PoseStatus.WEAK
        status[frame.alone] = PoseStatus.OK
        status[frame.ambiguous] = PoseStatus.AMBIGUOUS
        status[lost] = PoseStatus.FAILED

        def kept(values: NDArray[np.float64]) -> NDArray[np.float64]:
            if not lost.any():
                return values
            shape = (-1,) + (1,) * (values.ndim - 1)
            return np.where(lost.reshape(shape), np.nan, values)

        return TrackedExposure(
            one.number,
            one.stamp_ns,
            rotation=kept(motion.rotation[row]),
            centre_mm=kept(motion.centre_mm[row]),
            velocity=kept(motion.velocity[row]),
            acceleration=kept(motion.acceleration[row]),
            covariance=kept(motion.covariance[row]),
            fixed=kept(one.fixed),
            rig_root=kept(one.rig_root),
            frame=frame,
            status=status,
        )


def _filled_backwards(exposures: Sequence[_Taken]) -> list[_Taken]:
    """Fill unknown constant errors of a body with those of the following exposures."""
    out: list[_Taken] = []
    fixed = exposures[-1].fixed
    root = exposures[-1].rig_root
    for exposure in reversed(exposures):
        fixed = np.where(np.isnan(exposure.fixed), fixed, exposure.fixed)
        root = np.where(np.isnan(exposure.rig_root), root, exposure.rig_root)
        out.append(replace(exposure, fixed=fixed, rig_root=root))
    return out[::-1]


def poses_of(bodies: Sequence[Body], exposures: Sequence[TrackedExposure]) -> list[BodyPoses]:
    """Return poses of the frames of the bodies from poses of the centres of their markers."""
    return _poses(
        bodies,
        exposures,
        pose=(_by_body(exposures, 'rotation'), _by_body(exposures, 'centre_mm')),
        noise=_by_body(exposures, 'covariance')[..., POSE, POSE],
        fixed=_by_body(exposures, 'fixed'),
        status=_by_body(exposures, 'status'),
    )


def twists_of(
    bodies: Sequence[Body], exposure: TrackedExposure
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return velocities (B, 6) of bodies along their own axes, and covariances (B, 6, 6).

    Velocity of the origin of a body [mm/s], then angular velocity [rad/s]; the covariance is that
    of the random errors, NaN for a lost body. With the velocity v of the centre x of the markers
    and the angular velocity w, both in the rig frame, they are R'v - R'w x x and R'w; a rotation
    error th changes R'v by R'(v x th).
    """
    to_body = np.swapaxes(exposure.rotation, 1, 2)
    velocity, angular_velocity = exposure.velocity[:, :3], exposure.velocity[:, 3:]
    centre = cross_matrix(np.array([body.centre for body in bodies]))
    angular = (to_body @ angular_velocity[:, :, None])[:, :, 0]
    linear = (to_body @ velocity[:, :, None] + centre @ angular[:, :, None])[:, :, 0]
    by_state = np.zeros((len(bodies), 6, exposure.covariance.shape[1]))
    by_state[:, 3:, 3:6] = to_body @ cross_matrix(angular_velocity)
    by_state[:, 3:, 9:12] = to_body
    by_state[:, :3] = centre @ by_state[:, 3:]
    by_state[:, :3, 3:6] += to_body @ cross_matrix(velocity)
    by_state[:, :3, 6:9] = to_body
    covariance = by_state @ exposure.covariance @ np.swapaxes(by_state, 1, 2)
    return np.concatenate([linear, angular], axis=1), covariance


def poses_alone(bodies: Sequence[Body], exposures: Sequence[TrackedExposure]) -> list[BodyPoses]:
    """Return the poses that each exposure gives alone, without a filter."""
    frames = [exposure.frame for exposure in exposures]
    status = np.where(_by_body(frames, 'ambiguous'), PoseStatus.AMBIGUOUS, PoseStatus.OK)
    return _poses(
        bodies,
        exposures,
        pose=(_by_body(frames, 'rotation'), _by_body(frames, 'centre_mm')),
        noise=_by_body(frames, 'covariance_noise'),
        fixed=_by_body(frames, 'covariance_fixed'),
        status=np.where(_by_body(frames, 'alone'), status, PoseStatus.FAILED).astype(np.uint8),
    )


def _by_body(exposures: Sequence[object], name: str) -> np.ndarray:
    """Stack values (B, T, ...) of T exposures."""
    return np.stack([getattr(exposure, name) for exposure in exposures], axis=1)


def _poses(
    bodies: Sequence[Body],
    exposures: Sequence[TrackedExposure],
    pose: tuple[NDArray[np.float64], NDArray[np.float64]],
    *,
    noise: NDArray[np.float64],
    fixed: NDArray[np.float64],
    status: NDArray[np.uint8],
) -> list[BodyPoses]:
    """Move poses from the centres of the markers to the origins of B bodies: t = c - R x_c.

    pose: rotations (B, T, 3, 3) and centres (B, T, 3). noise, fixed: (B, T, 6, 6).
    """
    rotation, centre = pose
    arm = (rotation @ np.array([body.centre for body in bodies])[:, None, :, None])[..., 0]
    transformation = np.zeros(noise.shape)
    transformation[..., range(POSE_SIZE), range(POSE_SIZE)] = 1.0
    transformation[..., :3, 3:] = cross_matrix(arm)
    transposed = np.swapaxes(transformation, 2, 3)
    frames = np.array([body.frame_covariance for body in bodies])
    if frames.any():
        axes = np.zeros_like(transformation)
        axes[..., :3, :3] = axes[..., 3:, 3:] = rotation
        fixed = fixed + axes @ frames[:, None] @ np.swapaxes(axes, 2, 3)
    position = centre - arm
    noise = transformation @ noise @ transposed
    fixed = transformation @ fixed @ transposed
    rig_root = transformation @ _by_body(exposures, 'rig_root')
    markers = _by_body([exposure.frame for exposure in exposures], 'markers')
    number = np.array([exposure.number for exposure in exposures])
    stamp_ns = np.array([exposure.stamp_ns for exposure in exposures])
    return [
        BodyPoses(
            body.name,
            number,
            stamp_ns,
            rotation=rotation[row],
            position_mm=position[row],
            covariance_noise=noise[row],
            covariance_fixed=fixed[row],
            rig_root=rig_root[row],
            markers=markers[row],
            status=status[row],
        )
        for row, body in enumerate(bodies)
    ]


# Motion of a joint exposure by exposure, with the same values as for the whole trial.

MAX_NEUTRAL = 10_000  # exposures of a neutral trial, some 60 MB


class JointTracker:
    """Tracks a joint from exposure to exposure.

    If a joint requires a neutral trial, its angles are unknown until that trial has ended.

    Parameters
    ----------
    joint : Joint
    neutral : (int, int) or None
        First and last exposure in neutral position. Raises DataError for more than MAX_NEUTRAL.
    """

    def __init__(self, joint: Joint, neutral: tuple[int, int] | None = None) -> None:
        if neutral is not None and neutral[1] - neutral[0] >= MAX_NEUTRAL:
            raise DataError(
                f'joint {joint.name}: the neutral trial lasts from exposure {neutral[0]} to '
                f'{neutral[1]}, but may have at most {MAX_NEUTRAL} exposures in live operation'
            )
        self.joint = joint
        self._neutral = neutral
        self._collected: list[tuple[BodyPoses, BodyPoses]] = []
        self._last: NDArray[np.float64] | None = None
        self.needs_neutral = neutral is not None  #: whether the neutral trial has not ended yet
        #: reason why a completed neutral trial gave no neutral position
        self.error: DataError | None = None

    def add(self, proximal: BodyPoses, distal: BodyPoses) -> JointMotion:
        """Return the motion in the next exposure, from the poses of both bodies in it."""
        if self.needs_neutral:
            self._collect(proximal, distal)
        motion = joint_motion(self.joint, proximal, distal, self._last)
        if self.needs_neutral:
            return unknown_motion(motion)
        if motion.determined[0]:
            self._last = motion.angles[0]
        return motion

    def _collect(self, proximal: BodyPoses, distal: BodyPoses) -> None:
        """Add an exposure of the neutral trial; set the neutral position at its end."""
        assert self._neutral is not None
        first, last = self._neutral
        number = int(proximal.number[0])
        if first <= number <= last:
            self._collected.append((proximal, distal))
        if number < last or self.error is not None:
            return
        collected, self._collected = self._collected, []
        if not collected:
            self.error = DataError(
                f'joint {self.joint.name}: no exposure of the neutral trial was received'
            )
            return
        try:
            trials = (joined_rows(poses) for poses in zip(*collected))
            self.joint = with_neutral(self.joint, *trials)
            self.needs_neutral = False
        except DataError as error:
            self.error = error


def unknown_motion(motion: JointMotion) -> JointMotion:
    """Return a copy without angles and translations."""
    return replace(
        motion,
        angles=np.full_like(motion.angles, np.nan),
        translations=np.full_like(motion.translations, np.nan),
        covariance=np.full_like(motion.covariance, np.nan),
        status=np.full_like(motion.status, JointStatus.FAILED),
        determined=np.zeros_like(motion.determined),
    )
