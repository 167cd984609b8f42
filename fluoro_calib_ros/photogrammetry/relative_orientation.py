# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Relative orientation of two fluoroscopes that is the same in every common exposure.

Q = R_b R_a^T and t = R_a (T_b - T_a) [mm, sensor frame of a] are unknowns of the adjustment, six
for each pair of fluoroscopes. Each common exposure observes them: R_a (T_b - T_a) - t = 0 and
log(R_b R_a^T Q^T) = 0, with standard deviations. A rigid mounting is the limit of small standard
deviations. Relative orientation constraints: Lerma, Navarro, Cabrelles and Seguí, "Camera
calibration with baseline distance constraints", Photogrammetric Record 25, 2010. Derivatives of
rotations: Barfoot, "State Estimation for Robotics", Cambridge 2017, 7.1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .rotations import cross_matrix, matrix_from_vector, vector_from_matrix
from .unknowns import (
    POSE_SIZE,
    Parameters,
    RelativeConstraint,
    RelativePose,
    UnknownLayout,
    UnknownVector,
)

# Iterations of the mean pose, and the step [mm, rad] at which they end.
MEAN_ITERATIONS = 10
MEAN_TOLERANCE = 1e-12


def inverse_left_jacobian(w: np.ndarray) -> np.ndarray:
    """Derivatives (..., 3, 3) of log(exp(v) exp(w)) with respect to v at v = 0.

    w (..., 3) are rotation vectors [rad] (Barfoot 7.1.3).
    """
    half = np.linalg.norm(w, axis=-1)[..., None, None] / 2
    k = cross_matrix(w)
    # (1 - h cot h) / (4 h^2) is 0/0 at zero, where its limit is 1/12.
    small = half < 1e-3
    safe = np.where(small, 1.0, half)
    factor = np.where(small, 1 / 12 + half**2 / 180, (1 - safe / np.tan(safe)) / (4 * safe**2))
    return np.eye(3) - k / 2 + factor * (k @ k)


def relative_poses(parameters: Parameters, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (k, 3, 3) and translations (k, 3) [mm] of b relative to a in pairs of exposures.

    pairs (k, 2) are rows of exposures.
    """
    a, b = pairs.T
    r_a = parameters.rotation[a]
    shift = parameters.position_mm[b] - parameters.position_mm[a]
    return parameters.rotation[b] @ r_a.transpose(0, 2, 1), (r_a @ shift[..., None])[..., 0]


def discrepancies(
    constraint: RelativeConstraint, pose: RelativePose, parameters: Parameters
) -> NDArray[np.float64]:
    """Discrepancies (k, 6) of the pairs from a pose: translation [mm], rotation [rad]."""
    turn, shift = relative_poses(parameters, constraint.pairs)
    scale, _ = _translation_scale(constraint, pose)
    return np.concatenate(
        [scale * (shift - pose.translation_mm), vector_from_matrix(turn @ pose.rotation.T)], axis=1
    )


def _translation_scale(
    constraint: RelativeConstraint, pose: RelativePose
) -> tuple[float, np.ndarray]:
    """Factor of the translations, and its derivative (3,) by the translation of the pose."""
    if constraint.length_mm is None:
        return 1.0, np.zeros(3)
    length = np.linalg.norm(pose.translation_mm)
    derivative = -constraint.length_mm / length**3 * pose.translation_mm
    return constraint.length_mm / length, derivative


def discrepancies_with_jacobian(
    constraint: RelativeConstraint, pose: RelativePose, parameters: Parameters
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Discrepancies (k, 6) and their derivatives.

    Returns the discrepancies and their derivatives (k, 6, 6) by the exposure of a, by the exposure
    of b (T [mm] and w [rad] each), and by the pose (as in RelativePose.updated).
    """
    a, _ = constraint.pairs.T
    turn, shift = relative_poses(parameters, constraint.pairs)
    scale, d_scale = _translation_scale(constraint, pose)
    w = vector_from_matrix(turn @ pose.rotation.T)
    back = inverse_left_jacobian(w)
    d_a = np.zeros((len(a), POSE_SIZE, POSE_SIZE))
    d_b = np.zeros_like(d_a)
    d_pose = np.zeros_like(d_a)
    d_a[:, :3, :3] = -scale * parameters.rotation[a]
    d_b[:, :3, :3] = scale * parameters.rotation[a]
    d_a[:, :3, 3:] = -scale * cross_matrix(shift)
    d_a[:, 3:, 3:] = -back @ turn
    d_b[:, 3:, 3:] = back
    d_pose[:, :3, :3] = -scale * np.eye(3) + (shift - pose.translation_mm)[:, :, None] * d_scale
    d_pose[:, 3:, 3:] = -inverse_left_jacobian(-w)
    return np.concatenate([scale * (shift - pose.translation_mm), w], axis=1), d_a, d_b, d_pose


def mean_pose(
    parameters: Parameters, pairs: np.ndarray, weights: np.ndarray | None = None
) -> RelativePose:
    """Mean relative orientation of pairs (k, 2) of exposures.

    With weights (k, 6, 6) of translation and rotation of each pair, the weighted mean. Without
    them the component-wise median: a start value that is robust to single pairs.
    """
    turn, shift = relative_poses(parameters, pairs)
    median = np.median(shift, axis=0)
    start = int(np.argmin(np.sum((shift - median) ** 2, axis=1)))
    pose = RelativePose(turn[start], median)
    for _ in range(MEAN_ITERATIONS):
        difference = np.concatenate(
            [shift - pose.translation_mm, vector_from_matrix(turn @ pose.rotation.T)], axis=1
        )
        if weights is None:
            step = np.median(difference, axis=0)
        else:
            step = np.linalg.solve(
                weights.sum(axis=0), (weights @ difference[..., None]).sum(axis=0)[:, 0]
            )
        pose = pose.updated(step)
        if np.max(np.abs(step)) < MEAN_TOLERANCE:
            break
    return pose


def exposures_from_pose(
    parameters: Parameters,
    constraint: RelativeConstraint,
    pose: RelativePose,
    offset: NDArray[np.float64] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Exterior orientations of b's exposures from those of a and a relative orientation.

    Parameters
    ----------
    parameters : Parameters
        Exterior orientations of a's exposures.
    constraint : RelativeConstraint
        The pairs of exposures.
    pose : RelativePose
        Relative orientation of b with respect to a.
    offset : (k, 6) ndarray, optional
        Discrepancies from the pose that the result has; zeros by default.

    Returns
    -------
    rotation : (k, 3, 3) ndarray
    position_mm : (k, 3) ndarray
    """
    if offset is None:
        offset = np.zeros((len(constraint.pairs), POSE_SIZE))
    scale, _ = _translation_scale(constraint, pose)
    a = constraint.pairs[:, 0]
    r_a = parameters.rotation[a]
    translation = pose.translation_mm + offset[:, :3] / scale
    shift = (r_a.transpose(0, 2, 1) @ translation[..., None])[..., 0]
    rotation = matrix_from_vector(offset[:, 3:]) @ pose.rotation @ r_a
    return rotation, parameters.position_mm[a] + shift


def exposures_after_step(
    constraints: Sequence[RelativeConstraint],
    layout: UnknownLayout,
    before: Parameters,
    after: Parameters,
    step: UnknownVector,
) -> Parameters:
    """Parameters after a step, with b's exposures moved along their constraints.

    Their discrepancies become what the linearised constraint predicts. To first order they are so
    already, but a stiff constraint is curved, and a straight step would leave it by more than its
    standard deviation.

    constraints: the constraints of the network. before, after: parameters before and after the
    straight step.
    """
    rotation = after.rotation.copy()
    position = after.position_mm.copy()
    for number, (constraint, columns) in enumerate(zip(constraints, layout.relative)):
        a, b = constraint.pairs.T
        offset, d_a, d_b, d_pose = discrepancies_with_jacobian(
            constraint, before.relative[number], before
        )
        by_exposures = d_a @ step.exteriors[a][..., None] + d_b @ step.exteriors[b][..., None]
        offset = offset + by_exposures[..., 0] + d_pose @ step.globals[columns]
        rotation[b], position[b] = exposures_from_pose(
            after, constraint, after.relative[number], offset
        )
    return replace(after, rotation=rotation, position_mm=position)
