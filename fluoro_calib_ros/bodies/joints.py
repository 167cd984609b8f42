# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Joints: angles and translations between two bodies, with the covariance of all of them.

With proximal and distal anatomical axes P and D in the rig frame, R = P^T D is resolved into three
rotations about the axes e1, e2, e3 of the convention. Errors (dt, w) of the poses, as defined in
BodyPoses, rotate R by w_r = P^T (w_d - w_p). As w_r = E da with E = (e1 e2 e3), the angles change
by da = E^-1 w_r (the Jacobian of a joint coordinate system, Woltring, J. Biomech. 27, 1994).

E is singular where e1 and e3 are parallel (gimbal lock). Close to it the angle about e1 is the
direction of a short vector, with errors that are neither small nor Gaussian. There, and where
angles are uncertain for other reasons, the second moments of their errors are computed by
integration over the distribution of w_r.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..brief import brief_repr
from ..errors import DataError, ErrorsAt
from ..findings import Kind
from ..photogrammetry.rotations import cross_matrix, matrix_from_vector
from ..rows import chosen_rows
from .anatomical_frames import (
    AXES,
    BODY_FRAME,
    MAX_RATIO,
    AnatomicalFrame,
    Convention,
    convention,
)
from .body import Body, BodyPoses, PoseStatus

# Distance from gimbal lock in standard deviations. At this distance the first angle has a standard
# deviation of 0.2 rad (11 degrees), and one in two million of its errors crosses the lock.
LOCK_SDS = 5.0
# Standard deviation below which the second-order part of an angle's error is less than 1 % of the
# first-order part; translations of 50 mm along rotating axes are then linear to 0.01 mm.
LINEAR_SD_RAD = 0.02
MIN_VOLUME = 1e-9  # minimum of the triple product of the axes: keeps the Jacobian finite
BLOCK = 256  # exposures per integration


class JointStatus(IntEnum):
    """Origin of the motion of a joint; 0 to 4 are the PoseStatus of the worse body."""

    OK = 0
    WEAK = 1
    FILLED = 2
    FAILED = 3
    AMBIGUOUS = 4
    GIMBAL = 5  # so close to gimbal lock that the first and third angle are hardly meaningful


STATUS_NAMES = tuple(status.name for status in JointStatus)


@dataclass(frozen=True)
class Joint:
    """Joint between two bodies.

    Raises DataError for a joint of a body with itself, an unknown convention, and a missing side.

    Attributes
    ----------
    name, proximal, distal : str
        Names of the joint and of its bodies.
    convention : str
        Name in `anatomical_frames.CONVENTIONS`.
    proximal_frame, distal_frame : AnatomicalFrame
    side : {'left', 'right', ''}
        '' only if the convention does not depend on the side.
    neutral_covariance : (3, 3) ndarray
        Covariance of the neutral rotation, about the proximal axes [rad^2].
    """

    __repr__ = brief_repr

    name: str
    proximal: str
    distal: str
    convention: str
    proximal_frame: AnatomicalFrame = BODY_FRAME
    distal_frame: AnatomicalFrame = BODY_FRAME
    side: str = ''
    neutral_covariance: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        if not self.name:
            raise DataError('a joint has no name')
        if self.proximal == self.distal:
            raise DataError(f'joint {self.name}: both of its bodies are {self.distal}')
        try:
            convention(self.convention).check_side(self.side)
        except DataError as error:
            raise DataError(f'joint {self.name}: {error}') from None


@dataclass(frozen=True)
class JointMotion:
    """Motion of a joint over a trial; NaN where a body has no pose.

    Attributes
    ----------
    joint : Joint
    number, stamp_ns : (T,) ndarray
        Number and stamp of each exposure.
    angles : (T, 3) ndarray
        [rad], in the order of `angle_names`; full turns are counted over the trial.
    translations : (T, 3) ndarray
        Of the distal relative to the proximal origin [mm], in the order of `translation_names`.
    covariance : (T, 6, 6) ndarray
        Of angles and translations [rad, mm]; second moments of their errors near gimbal lock.
    status : (T,) ndarray
        JointStatus as uint8.
    determined : (T,) ndarray
        Whether there are angles away from gimbal lock, from which full turns are counted.
    """

    __repr__ = brief_repr

    joint: Joint
    number: NDArray[np.int64]
    stamp_ns: NDArray[np.int64]
    angles: NDArray[np.float64]
    translations: NDArray[np.float64]
    covariance: NDArray[np.float64]
    status: NDArray[np.uint8]
    determined: NDArray[np.bool_]

    @property
    def angle_names(self) -> tuple[str, str, str]:
        """Clinical names that state the positive direction."""
        return convention(self.joint.convention).angles

    @property
    def translation_names(self) -> tuple[str, str, str]:
        """Clinical names that state the positive direction."""
        return convention(self.joint.convention).translations

    @property
    def sd(self) -> NDArray[np.float64]:
        """Standard deviations (T, 6) of angles and translations [rad, mm]."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))


def joint_motion(
    joint: Joint,
    proximal: BodyPoses,
    distal: BodyPoses,
    before: NDArray[np.float64] | None = None,
) -> JointMotion:
    """Return the motion of a joint from the poses of its bodies.

    The covariance does not include errors of the anatomical frames themselves, which are constant
    over all trials of a person. before: angles (3,) [rad] from which full turns are counted; in
    live use, pass the last determined ones to get the same values as for the whole trial.
    Raises DataError for poses of other bodies or of different exposures.
    """
    _check_poses(joint, proximal, distal)
    relative = _relative(joint, proximal, distal)
    of = convention(joint.convention)
    angles = _angles(of, relative.rotation)
    axes = _axes(of, angles)
    jacobian = _jacobian(of, axes, relative.translation)
    covariance = jacobian @ relative.covariance @ np.swapaxes(jacobian, 1, 2)
    locked = _near_lock(of, angles, covariance)
    variance = np.diagonal(covariance, axis1=1, axis2=2)[:, :3].max(axis=1)
    is_nonlinear = variance > LINEAR_SD_RAD**2  # False for NaN
    # Number of Gauss-Hermite nodes per axis: 3 for quadratic errors, 9 near gimbal lock.
    for nodes, is_selected in ((3, is_nonlinear & ~locked), (9, locked)):
        exposures = np.flatnonzero(is_selected)
        for start in range(0, len(exposures), BLOCK):
            rows = exposures[start : start + BLOCK]
            covariance[rows] = _second_moments(
                of, chosen_rows(relative, rows), angles[rows], nodes
            )
    signs = np.array([*of.angle_signs, *of.translation_signs], dtype=float)
    determined = np.isfinite(angles).all(axis=1) & ~locked
    return JointMotion(
        joint,
        proximal.number,
        proximal.stamp_ns,
        angles=_unwrapped(angles * signs[:3], determined, before),
        translations=_translations(of, axes, relative.translation) * signs[3:],
        covariance=covariance * signs[:, None] * signs,
        status=_status(proximal.status, distal.status, locked, angles),
        determined=determined,
    )


def with_neutral(joint: Joint, proximal: BodyPoses, distal: BodyPoses) -> Joint:
    """Return a joint whose mean rotation over a neutral trial is zero.

    The distal axes become parallel to the proximal ones there, as the ISB defines it for the
    ankle; the origins do not change. The mean is that of rotation matrices (Moakher, SIAM J.
    Matrix Anal. 24, 2002). Its covariance is that of the random errors, independent between
    exposures. Constant errors would partly cancel: the standard deviations of angles are then too
    large, not too small. Raises DataError if no exposure has measured poses of both bodies.
    """
    _check_poses(joint, proximal, distal)
    measured = np.isin(proximal.status, (PoseStatus.OK, PoseStatus.WEAK))
    measured &= np.isin(distal.status, (PoseStatus.OK, PoseStatus.WEAK))
    measured &= np.isfinite(proximal.rotation + distal.rotation).all(axis=(1, 2))
    if not measured.any():
        raise DataError(f'joint {joint.name}: no exposure of the neutral trial has both bodies')
    relative = _relative(joint, proximal, distal, only_noise=True)
    mean = Rotation.from_matrix(relative.rotation[measured]).mean().as_matrix()
    covariance = relative.covariance[measured][:, :3, :3].mean(axis=0) / measured.sum()
    mirror = convention(joint.convention).mirror(joint.side)
    offset = mirror @ mean.T @ mirror
    frame = replace(joint.distal_frame, rotation=joint.distal_frame.rotation @ offset)
    return replace(joint, distal_frame=frame, neutral_covariance=covariance)


def check_joints(joints: Sequence[Joint], bodies: Iterable[str]) -> None:
    """Raise DataError for two joints of the same name, unknown bodies, and cycles."""
    known = tuple(bodies)
    names: set[str] = set()
    children: dict[str, list[str]] = {}
    for joint in joints:
        if joint.name in names:
            raise DataError(f'two joints are called {joint.name}')
        names.add(joint.name)
        for body in (joint.proximal, joint.distal):
            if body not in known:
                raise DataError(
                    f'joint {joint.name}: there is no body {body}, only {", ".join(known)}'
                )
        children.setdefault(joint.proximal, []).append(joint.distal)
    for joint in joints:
        descendants = [joint.distal]
        for body in descendants:
            descendants += [child for child in children.get(body, ()) if child not in descendants]
        if joint.proximal in descendants:
            raise DataError(
                f'joint {joint.name} closes a cycle: {joint.proximal} is also distal of '
                f'{joint.distal}'
            )


def check_frames(joint: Joint, bodies: Iterable[Body]) -> None:
    """Raise DataError for a given frame that is not in the coordinates of its body."""
    frames = {joint.proximal: joint.proximal_frame, joint.distal: joint.distal_frame}
    for body in bodies:
        frame = frames.get(body.name, BODY_FRAME)
        if frame is BODY_FRAME:
            continue
        with ErrorsAt(f'joint {joint.name}, frame of {body.name}'):
            if np.count_nonzero(body.known) < 3:
                raise DataError(
                    'three markers of the body have no coordinates, in which a frame can be given'
                )
            frame.check_body(body.centre)
    extents = sorted(frame.extent_mm for frame in frames.values())
    if extents[1] < np.inf and extents[1] > MAX_RATIO * extents[0]:
        raise DataError(
            f'joint {joint.name}: the landmarks of one bone are {extents[1]:.3g} mm apart, those '
            f'of the other {extents[0]:.3g} mm: a coordinate or a unit is wrong',
            kind=Kind.WRONG_UNIT,
            numbers={'larger_mm': extents[1], 'smaller_mm': extents[0]},
        )


def main_rotation(motion: JointMotion) -> tuple[float, float] | None:
    """Return range [rad] and direction of the main rotation of a joint, or None.

    The direction is the larger angle [rad] between its axis and the first axis of the convention
    in both frames. The axis is that of the largest variance of the rotations about their mean;
    None if another axis has more than a ninth of it, and without known angles.
    """
    of = convention(motion.joint.convention)
    known = np.isfinite(motion.angles).all(axis=1)
    if not known.any():
        return None
    signed = motion.angles[known] * np.array(of.angle_signs)
    rotation = Rotation.from_euler(of.sequence.upper(), signed)
    mean = rotation.mean()
    vectors = (mean.inv() * rotation).as_rotvec()
    vectors -= vectors.mean(axis=0)
    variance, axes = np.linalg.eigh(vectors.T @ vectors)
    if variance[2] <= 9 * variance[1]:
        return None
    low, high = np.quantile(vectors @ axes[:, 2], (0.05, 0.95))
    along = [axes[:, 2], mean.apply(axes[:, 2])]
    cosine = np.abs(along)[:, AXES.index(of.sequence[0])].min()
    return float(high - low), float(np.arccos(min(cosine, 1.0)))


def _check_poses(joint: Joint, proximal: BodyPoses, distal: BodyPoses) -> None:
    """Raise DataError for poses that do not belong to the joint."""
    for expected, poses in ((joint.proximal, proximal), (joint.distal, distal)):
        if poses.body != expected:
            raise DataError(
                f'joint {joint.name}: the poses are of {poses.body}, not of {expected}'
            )
    if not np.array_equal(proximal.number, distal.number):
        raise DataError(
            f'joint {joint.name}: the poses of its two bodies are of different exposures'
        )


@dataclass(frozen=True)
class _Relative:
    """Transformation from distal to proximal anatomical axes, for a right limb.

    rotation (T, 3, 3); translation (T, 3) [mm]; covariance (T, 6, 6) of the rotation errors about
    the proximal axes and of the translation.
    """

    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    covariance: NDArray[np.float64]


def _relative(
    joint: Joint, proximal: BodyPoses, distal: BodyPoses, only_noise: bool = False
) -> _Relative:
    """Return the pose of the distal frame in the proximal one, and its covariance."""
    mirror = convention(joint.convention).mirror(joint.side)
    frame_p, frame_d = joint.proximal_frame, joint.distal_frame
    to_p = mirror @ np.swapaxes(proximal.rotation @ frame_p.rotation, 1, 2)
    arm_p = proximal.rotation @ frame_p.origin_mm
    arm_d = distal.rotation @ frame_d.origin_mm
    between = (arm_d + distal.position_mm) - (arm_p + proximal.position_mm)
    rotation = to_p @ distal.rotation @ frame_d.rotation @ mirror
    translation = (to_p @ between[..., None])[..., 0]

    # Rotation errors are axial vectors: a mirror also reverses them.
    to_p_axial = np.linalg.det(mirror) * to_p
    by_p = np.zeros((len(rotation), 6, 6))
    by_d = np.zeros_like(by_p)
    by_p[:, :3, 3:] = -to_p_axial
    by_d[:, :3, 3:] = to_p_axial
    # w x a = -[a]x w; the proximal axes rotate in the opposite sense to what is seen in them.
    by_p[:, 3:, :3] = -to_p
    by_p[:, 3:, 3:] = to_p @ cross_matrix(arm_p + between)
    by_d[:, 3:, :3] = to_p
    by_d[:, 3:, 3:] = -to_p @ cross_matrix(arm_d)

    covariance = np.zeros_like(by_p)
    for jacobian, poses in ((by_p, proximal), (by_d, distal)):
        pose_covariance = poses.covariance_noise
        if not only_noise:
            pose_covariance = pose_covariance + poses.covariance_fixed
        covariance += jacobian @ pose_covariance @ np.swapaxes(jacobian, 1, 2)
    if not only_noise:
        root = by_p @ proximal.rig_root + by_d @ distal.rig_root
        covariance += root @ np.swapaxes(root, 1, 2)
        if joint.neutral_covariance is not None:
            neutral_covariance = rotation @ joint.neutral_covariance @ np.swapaxes(rotation, 1, 2)
            covariance[:, :3, :3] += neutral_covariance
    return _Relative(rotation, translation, covariance)


def _angles(of: Convention, rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the angles (..., 3) [rad] of R = R_i R_j R_k, matrices (..., 3, 3).

    The third angle is computed from R_i^T R, so that the angles reproduce R even in gimbal lock.
    """
    i, j, k = (AXES.index(axis) for axis in of.sequence)
    m = 3 - i - j
    sign = 1.0 if (j - i) % 3 == 1 else -1.0
    r = rotation
    if of.is_euler:
        sine = np.hypot(r[..., i, j], r[..., i, m])
        second = of.branch * np.arctan2(sine, r[..., i, i])
        first = np.arctan2(of.branch * r[..., j, i], -of.branch * sign * r[..., m, i])
    else:
        second = np.arctan2(sign * r[..., i, k], np.hypot(r[..., i, i], r[..., i, j]))
        first = np.arctan2(-sign * r[..., j, k], r[..., k, k])
    row = np.cos(first)[..., None] * r[..., j, :] + sign * np.sin(first)[..., None] * r[..., m, :]
    sine_of_third = -sign * row[..., m] if of.is_euler else sign * row[..., i]
    return np.stack([first, second, np.arctan2(sine_of_third, row[..., j])], axis=-1)


def _axes(of: Convention, angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation axes (..., 3, 3) in the proximal frame, as columns.

    They are the unit vectors i, R_i j and R_i R_j k.
    """
    i, j, _ = (AXES.index(axis) for axis in of.sequence)
    m = 3 - i - j
    sign = 1.0 if (j - i) % 3 == 1 else -1.0
    sine_1, sine_2 = np.moveaxis(np.sin(angles[..., :2]), -1, 0)
    cosine_1, cosine_2 = np.moveaxis(np.cos(angles[..., :2]), -1, 0)
    # Components of R_j k along i and along the third unit vector, which R_i rotates.
    part_i, part_m = (cosine_2, -sign * sine_2) if of.is_euler else (sign * sine_2, cosine_2)
    axes = np.zeros((*angles.shape, 3))
    axes[..., i, 0] = 1.0
    axes[..., j, 1] = cosine_1
    axes[..., m, 1] = sign * sine_1
    axes[..., i, 2] = part_i
    axes[..., j, 2] = -sign * part_m * sine_1
    axes[..., m, 2] = part_m * cosine_1
    return axes


def _translations(
    of: Convention, axes: NDArray[np.float64], translation: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the translations (..., 3) of the convention [mm]."""
    if not of.along_axes:
        return translation
    return (np.swapaxes(axes, -1, -2) @ translation[..., None])[..., 0]


def _jacobian(
    of: Convention, axes: NDArray[np.float64], translation: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return derivatives (T, 6, 6) of angles and translations by rotation error, translation."""
    e1, e2, e3 = (axes[..., n] for n in range(3))
    by_1, by_2, between = np.cross(np.stack([e1, e1, e2]), np.stack([e2, e3, e3]))
    volume = np.sum(between * e1, axis=1)
    volume = np.where(np.abs(volume) < MIN_VOLUME, MIN_VOLUME, volume)
    by_turn = np.stack([between, -by_2, by_1], axis=1) / volume[:, None, None]  # E^-1

    jacobian = np.zeros((len(axes), 6, 6))
    jacobian[:, :3, :3] = by_turn
    if not of.along_axes:
        jacobian[:, 3:, 3:] = np.eye(3)
        return jacobian
    # The second axis rotates about the first one, the third axis about both.
    by_angle = np.zeros_like(axes)
    by_angle[:, 1, 0] = np.sum(by_1 * translation, axis=1)
    by_angle[:, 2, 0] = np.sum(by_2 * translation, axis=1)
    by_angle[:, 2, 1] = np.sum(between * translation, axis=1)
    jacobian[:, 3:, :3] = by_angle @ by_turn
    jacobian[:, 3:, 3:] = np.swapaxes(axes, 1, 2)
    return jacobian


def _near_lock(
    of: Convention, angles: NDArray[np.float64], covariance: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return whether exposures with covariances (T, 6, 6) are within LOCK_SDS of gimbal lock.

    The third axis has the polar coordinates (distance from the lock, first angle) about the first.
    """
    second = np.abs(angles[:, 1])
    distance = np.minimum(second, np.pi - second) if of.is_euler else np.pi / 2 - second
    sd = np.sqrt(np.maximum(covariance[:, 1, 1], covariance[:, 0, 0] * np.sin(distance) ** 2))
    return distance < LOCK_SDS * sd  # False for NaN


def _second_moments(
    of: Convention, relative: _Relative, angles: NDArray[np.float64], nodes: int
) -> NDArray[np.float64]:
    """Return second moments (T, 6, 6) of the errors of angles and translations.

    Gauss-Hermite rule over the rotation error; the independent part of the translation is linear.
    """
    node, weight = np.polynomial.hermite_e.hermegauss(nodes)
    z = np.stack(np.meshgrid(node, node, node, indexing='ij'), axis=-1).reshape(-1, 3)
    weight = np.einsum('i,j,k->ijk', weight, weight, weight).ravel() / weight.sum() ** 3

    turn_covariance = relative.covariance[:, :3, :3]
    values, vectors = np.linalg.eigh(turn_covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    turn = z @ np.swapaxes(root, 1, 2)
    gain = relative.covariance[:, 3:, :3] @ np.linalg.pinv(turn_covariance, hermitian=True)
    remainder = relative.covariance[:, 3:, 3:] - gain @ relative.covariance[:, :3, 3:]

    rotation = matrix_from_vector(turn) @ relative.rotation[:, None]
    translation = relative.translation[:, None] + turn @ np.swapaxes(gain, 1, 2)
    node_angles = _angles(of, rotation)
    difference = angle_errors(of, node_angles, angles[:, None])
    axes = _axes(of, node_angles)
    before = _translations(of, _axes(of, angles), relative.translation)
    shift = _translations(of, axes, translation) - before[:, None]
    error = np.concatenate([difference, shift], axis=-1)
    moments = np.swapaxes(error * weight[:, None], 1, 2) @ error
    if of.along_axes:
        along_axes = np.swapaxes(axes, -1, -2) @ remainder[:, None] @ axes
        moments[:, 3:, 3:] += np.sum(weight[:, None, None] * along_axes, axis=1)
    else:
        moments[:, 3:, 3:] += remainder
    return moments


def angle_errors(
    of: Convention, angles: NDArray[np.float64], true: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the differences (..., 3) [rad] of two sets of angles, without full turns.

    Close to gimbal lock the sum or difference of the first and third angle is known well even if
    neither angle is. Full turns are therefore taken from it, not from the third angle alone.
    """
    difference = angles - true
    i, j, _ = (AXES.index(axis) for axis in of.sequence)
    if of.is_euler:
        sign = np.where(np.cos(angles[..., 1]) > 0, 1, -1)
    else:
        sign = np.where(angles[..., 1] > 0, 1, -1) * (1 if (j - i) % 3 == 1 else -1)
    first = difference[..., 0] - 2 * np.pi * _turns(difference[..., 0])
    combined = difference[..., 2] + sign * difference[..., 0]
    third = combined - 2 * np.pi * _turns(combined) - sign * first
    return np.stack([first, difference[..., 1], third], axis=-1)


def _unwrapped(
    angles: NDArray[np.float64], determined: NDArray[np.bool_], before: NDArray[np.float64] | None
) -> NDArray[np.float64]:
    """Return angles (T, 3) without jumps by full turns.

    Near gimbal lock noise may turn an angle, so each is compared with the last angle away from it.
    """
    known = np.isfinite(angles).all(axis=1)
    unwrapped = angles[determined]
    # Count whole turns, so that processing one exposure at a time gives the same values.
    turns = -np.cumsum(_turns(np.diff(unwrapped, axis=0, prepend=unwrapped[:1])), axis=0)
    start = np.zeros(3) if before is None else np.asarray(before, dtype=float)
    unwrapped = unwrapped + 2 * np.pi * (turns - _turns(unwrapped[:1] - start))
    out = np.concatenate([start[None], unwrapped])[np.cumsum(determined)]
    near_lock = known & ~determined
    out[near_lock] = angles[near_lock] - 2 * np.pi * _turns(angles[near_lock] - out[near_lock])
    out[~known] = np.nan
    return out


def _turns(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the nearest number of full turns."""
    return np.round(angle / (2 * np.pi))


def _status(
    proximal: NDArray[np.uint8],
    distal: NDArray[np.uint8],
    locked: NDArray[np.bool_],
    angles: NDArray[np.float64],
) -> NDArray[np.uint8]:
    """Return the JointStatus (T,) from the worse body and gimbal lock."""
    status = np.full(len(angles), JointStatus.OK, dtype=np.uint8)
    # Later assignments have priority: the most important status comes last.
    status[(proximal == PoseStatus.WEAK) | (distal == PoseStatus.WEAK)] = JointStatus.WEAK
    status[locked] = JointStatus.GIMBAL
    for code in (PoseStatus.AMBIGUOUS, PoseStatus.FILLED, PoseStatus.FAILED):
        status[(proximal == code) | (distal == code)] = code
    status[np.isnan(angles).any(axis=1)] = JointStatus.FAILED
    return status
