"""Relative orientation of two fluoroscopes, the same in every exposure that both took.

Q = R_b R_a^T and t = R_a (T_b - T_a) [mm, sensor frame of a] are unknowns of the adjustment, six
for a pair of fluoroscopes. An exposure of both observes them: R_a (T_b - T_a) - t = 0 and log(R_b
R_a^T Q^T) = 0, with standard deviations. A rigid mounting is the limit of small ones. Relative
orientation constraints: Lerma, Navarro, Cabrelles and Seguí, "Camera calibration with baseline
distance constraints", Photogrammetric Record 25, 2010; derivatives of rotations: Barfoot, "State
Estimation for Robotics", Cambridge 2017, 7.1.
"""

from dataclasses import dataclass, replace

import numpy as np

from .rotations import cross_matrix, matrix_from_vector, quaternion_from_matrix

UNKNOWNS = 6
# As good as rigid: a thousandth of what images of 0.25 px noise tell of a pair of exposures, so
# that the solution is that of the limit to some 1e-5 standard deviations, and far from where
# rounding errors begin.
RIGID_SD_MM = 3e-4
RIGID_SD_RAD = 1e-7


@dataclass(frozen=True)
class Relative:
    """Constraint between two fluoroscopes.

    fluoroscopes (a, b): their numbers; pairs (k, 2): rows of the exposures of a and of b taken
    together; sd_mm and sd_rad of each component; length_mm: distance of the sources at which sd_mm
    holds; it follows the scale of a free network, None: the network is not free.
    """

    fluoroscopes: tuple
    pairs: np.ndarray
    sd_mm: float
    sd_rad: float
    length_mm: float | None = None

    @property
    def weights(self):
        """Weights (6,) of the components of the constraint."""
        return np.repeat([self.sd_mm**-2.0, self.sd_rad**-2.0], 3)


@dataclass(frozen=True)
class RelativePose:
    """A relative orientation: rotation (3, 3) from the sensor frame of a to that of b;
    translation_mm (3,) of the source of b in the sensor frame of a.
    """

    rotation: np.ndarray
    translation_mm: np.ndarray

    def moved(self, step):
        """The pose after a step (6,): translation [mm], rotation [rad] on the left."""
        return RelativePose(
            matrix_from_vector(step[3:]) @ self.rotation, self.translation_mm + step[:3]
        )


def vector_of(rotation):
    """Rotation vectors (..., 3) [rad] of rotation matrices (..., 3, 3), of angles below pi."""
    q = quaternion_from_matrix(rotation)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[..., :1])
    return q[..., 1:] * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-300), 2.0)


def inverse_left_jacobian(w):
    """Derivatives (..., 3, 3) of log(exp(v) exp(w)) by v at v = 0, of rotation vectors w (..., 3)
    (Barfoot 7.1.3).
    """
    half = np.linalg.norm(w, axis=-1)[..., None, None] / 2
    k = cross_matrix(w)
    # (1 - h cot h) / (4 h^2), which is 1/12 at zero where it would be 0/0.
    small = half < 1e-3
    safe = np.where(small, 1.0, half)
    factor = np.where(small, 1 / 12 + half**2 / 180, (1 - safe / np.tan(safe)) / (4 * safe**2))
    return np.eye(3) - k / 2 + factor * (k @ k)


def poses_of_pairs(parameters, pairs):
    """Rotations (k, 3, 3) and translations (k, 3) [mm] of b against a in pairs (k, 2) of
    exposures.
    """
    a, b = pairs.T
    r_a = parameters.rotation[a]
    shift = parameters.position_mm[b] - parameters.position_mm[a]
    return parameters.rotation[b] @ r_a.transpose(0, 2, 1), (r_a @ shift[..., None])[..., 0]


def discrepancies(constraint, pose, parameters):
    """Discrepancies (k, 6) of the pairs from a RelativePose: translation [mm], rotation [rad]."""
    turn, shift = poses_of_pairs(parameters, constraint.pairs)
    scale, _ = _scale(constraint, pose)
    return np.concatenate(
        [scale * (shift - pose.translation_mm), vector_of(turn @ pose.rotation.T)], axis=1
    )


def _scale(constraint, pose):
    """Factor of the translations and its derivative (3,) by the translation of the pose."""
    if constraint.length_mm is None:
        return 1.0, np.zeros(3)
    length = np.linalg.norm(pose.translation_mm)
    return constraint.length_mm / length, -constraint.length_mm / length**3 * pose.translation_mm


def discrepancies_with_jacobian(constraint, pose, parameters):
    """Discrepancies (k, 6) and their derivatives (k, 6, 6) by the exposures of a and of b, and by
    the pose.

    Exposures by T [mm] and w [rad], as everywhere; the pose as in RelativePose.moved.
    """
    a, b = constraint.pairs.T
    turn, shift = poses_of_pairs(parameters, constraint.pairs)
    scale, d_scale = _scale(constraint, pose)
    w = vector_of(turn @ pose.rotation.T)
    back = inverse_left_jacobian(w)
    d_a, d_b, d_pose = (np.zeros((len(a), 6, 6)) for _ in range(3))
    d_a[:, :3, :3] = -scale * parameters.rotation[a]
    d_b[:, :3, :3] = scale * parameters.rotation[a]
    d_a[:, :3, 3:] = -scale * cross_matrix(shift)
    d_a[:, 3:, 3:] = -back @ turn
    d_b[:, 3:, 3:] = back
    d_pose[:, :3, :3] = -scale * np.eye(3) + (shift - pose.translation_mm)[:, :, None] * d_scale
    d_pose[:, 3:, 3:] = -inverse_left_jacobian(-w)
    return np.concatenate([scale * (shift - pose.translation_mm), w], axis=1), d_a, d_b, d_pose


def mean_pose(parameters, pairs, weights=None):
    """RelativePose of pairs (k, 2) of exposures; weights (k, 6, 6) of each (pose's translation and
    rotation).

    Without weights the component-wise median about the pair in the middle: a start value that no
    single pair steers. With them the weighted mean.
    """
    turn, shift = poses_of_pairs(parameters, pairs)
    middle = shift - np.median(shift, axis=0)
    start = int(np.argmin(np.sum(middle**2, axis=1)))
    pose = RelativePose(turn[start], np.median(shift, axis=0))
    for _ in range(10):
        off = np.concatenate(
            [shift - pose.translation_mm, vector_of(turn @ pose.rotation.T)], axis=1
        )
        if weights is None:
            step = np.median(off, axis=0)
        else:
            step = np.linalg.solve(
                weights.sum(axis=0), (weights @ off[..., None]).sum(axis=0)[:, 0]
            )
        pose = pose.moved(step)
        if np.max(np.abs(step)) < 1e-12:
            break
    return pose


def on_constraint(parameters, constraint, pose, off=None):
    """Rotations (k, 3, 3) and positions (k, 3) [mm] of b's exposures where the pose puts them
    beside a's, or where their discrepancies from it are off (k, 6).
    """
    off = np.zeros((len(constraint.pairs), 6)) if off is None else off
    scale, _ = _scale(constraint, pose)
    r_a = parameters.rotation[constraint.pairs[:, 0]]
    shift = (r_a.transpose(0, 2, 1) @ (pose.translation_mm + off[:, :3] / scale)[..., None])[
        ..., 0
    ]
    position = parameters.position_mm[constraint.pairs[:, 0]] + shift
    return matrix_from_vector(off[:, 3:]) @ pose.rotation @ r_a, position


def moved_along(network, parameters, moved, step_e, step_g):
    """Moved parameters with b's exposures put where the discrepancies are what the linearised
    constraint says.

    To first order they are there already. The way of a step along a stiff constraint is curved,
    and a straight one would leave it by more than its standard deviation. step_e (m, 6) and step_g
    (G,): the step of the exposures and of the global unknowns.
    """
    rotation = moved.rotation.copy()
    position = moved.position_mm.copy()
    for number, (constraint, cols) in enumerate(zip(network.relative, network.relative_columns)):
        a, b = constraint.pairs.T
        off, d_a, d_b, d_pose = discrepancies_with_jacobian(
            constraint, parameters.relative[number], parameters
        )
        off = (
            off
            + (d_a @ step_e[a][..., None] + d_b @ step_e[b][..., None])[..., 0]
            + d_pose @ step_g[cols]
        )
        rotation[b], position[b] = on_constraint(moved, constraint, moved.relative[number], off)
    return replace(moved, rotation=rotation, position_mm=position)
