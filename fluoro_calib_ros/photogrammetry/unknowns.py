# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Unknowns of a bundle adjustment; relative orientations that are the same in all exposures.

The unknowns of each exposure and of each object point form small blocks. All other unknowns are
global, as they affect many image points: interior orientations, relative orientations, additional
parameters, in this order.

If the relative orientation of two fluoroscopes is the same in every common exposure, Q = R_b R_a^T
and t = R_a (T_b - T_a) [mm, sensor frame of a] are unknowns of the adjustment, six for each pair
of fluoroscopes. Each common exposure observes them: R_a (T_b - T_a) - t = 0 and log(R_b R_a^T Q^T)
= 0, with standard deviations. A rigid mounting is the limit of small standard deviations.
Relative orientation constraints: Lerma, Navarro, Cabrelles and Seguí, "Camera calibration with
baseline distance constraints", Photogrammetric Record 25, 2010. Derivatives of rotations: Barfoot,
"State Estimation for Robotics", Cambridge 2017, 7.1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .rotations import cross_matrix, matrix_from_vector, vector_from_matrix

# Source or translation [mm], and rotation vector [rad]: of an exposure, of a relative orientation,
# or of a body in the rig frame.
POSE_SIZE = 6
# Standard deviations for a rigid mounting, or a fixed orientation: a thousandth of what one pair
# of exposures determines from images with 0.25 px noise. The solution differs from the limit by
# some 1e-5 standard deviations, and rounding errors are still negligible.
RIGID_SD_MM = 3e-4
RIGID_SD_RAD = 1e-7
# Eigenvalue of a normal matrix of unit diagonal below which it is a rounding error.
SINGULAR = 1e-11


@dataclass(frozen=True)
class RelativeConstraint:
    """Constraint that the relative orientation of two fluoroscopes is the same in all pairs."""

    fluoroscopes: tuple[int, int]  #: numbers of the fluoroscopes a and b
    pairs: NDArray[np.int64]  #: (k, 2) rows of the common exposures of a and of b
    #: standard deviations of each component of translation and rotation
    sd_mm: float
    sd_rad: float
    #: distance of the sources at which `sd_mm` holds; the constraint then follows the scale of a
    #: free network; None if the scale is fixed
    length_mm: float | None = None

    @property
    def weights(self) -> NDArray[np.float64]:
        """Weights (6,) of the components of the constraint."""
        return np.repeat([self.sd_mm**-2.0, self.sd_rad**-2.0], 3)


@dataclass(frozen=True)
class RelativePose:
    """Relative orientation of fluoroscope b with respect to a.

    rotation (3, 3): from the sensor frame of a to that of b; translation_mm (3,): source of b in
    the sensor frame of a.
    """

    rotation: NDArray[np.float64]
    translation_mm: NDArray[np.float64]

    def updated(self, step: np.ndarray) -> RelativePose:
        """Return the pose after a step (6,): translation [mm], rotation [rad] from the left."""
        step = np.asarray(step)
        return RelativePose(
            matrix_from_vector(step[3:]) @ self.rotation, self.translation_mm + step[:3]
        )


POINT_SIZE = 3  # coordinates [mm]
INTERIOR_SIZE = 3  # xp, yp, c [px]


@dataclass(frozen=True)
class ReducedLayout:
    """Order of the unknowns after an elimination: blocks of one kind, then the free globals."""

    #: number and size of the blocks: exposures or object points
    n_blocks: int
    block_size: int
    n_globals: int  #: number of free global unknowns

    @property
    def blocks(self) -> slice:
        """Rows of all blocks."""
        return slice(0, self.n_blocks * self.block_size)

    @property
    def globals(self) -> slice:
        """Rows of the free global unknowns."""
        return slice(self.blocks.stop, self.size)

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.blocks.stop + self.n_globals

    @property
    def block_rows(self) -> NDArray[np.int64]:
        """Rows (n_blocks, block_size) of each block."""
        return np.arange(self.blocks.stop).reshape(self.n_blocks, self.block_size)


@dataclass(frozen=True)
class UnknownLayout:
    """Layout of the unknowns of a network."""

    #: numbers of the block unknowns
    n_exposures: int
    n_points: int
    #: columns of the interior orientation of each fluoroscope among the global unknowns
    interiors: tuple[slice, ...]
    #: columns of each constrained relative orientation among the global unknowns
    relative: tuple[slice, ...]
    #: columns of the additional parameters of each fluoroscope among the global unknowns, or empty
    additional: tuple[slice, ...]
    free: NDArray[np.bool_]  #: (G,) whether each global unknown is estimated
    datum_defect: int  #: number of unknowns that the datum of a free network fixes

    @property
    def n_globals(self) -> int:
        """Number G of global unknowns, free or fixed."""
        return len(self.free)

    @cached_property
    def n_free_globals(self) -> int:
        """Number of estimated global unknowns."""
        return int(self.free.sum())

    @cached_property
    def free_columns(self) -> slice | NDArray[np.int64]:
        """Columns of the estimated global unknowns; a slice is copied ten times as fast."""
        columns = np.flatnonzero(self.free)
        if not np.all(np.diff(columns) == 1) or not len(columns):
            return columns
        return slice(int(columns[0]), int(columns[-1]) + 1)

    @property
    def n_unknowns(self) -> int:
        """Number of scalar unknowns, less those that the datum of a free network fixes."""
        blocks = POSE_SIZE * self.n_exposures + POINT_SIZE * self.n_points
        return blocks + self.n_free_globals - self.datum_defect

    @property
    def all_interiors(self) -> slice:
        """Columns of all interior orientations among the global unknowns."""
        return slice(0, INTERIOR_SIZE * len(self.interiors))

    @property
    def all_orientations(self) -> slice:
        """Columns of all interior and relative orientations among the global unknowns."""
        return slice(0, self.all_interiors.stop + POSE_SIZE * len(self.relative))

    @property
    def all_additional(self) -> slice:
        """Columns of the additional parameters of all fluoroscopes among the global unknowns."""
        return slice(self.all_orientations.stop, self.n_globals)

    @cached_property
    def without_points(self) -> ReducedLayout:
        """Order of the unknowns after the elimination of the object points."""
        return ReducedLayout(self.n_exposures, POSE_SIZE, self.n_free_globals)

    @cached_property
    def without_exposures(self) -> ReducedLayout:
        """Order of the unknowns after the elimination of the exposures."""
        return ReducedLayout(self.n_points, POINT_SIZE, self.n_free_globals)

    def expand_globals(self, free_values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return all global unknowns (G, ...) from the free unknowns; fixed unknowns are zero."""
        out = np.zeros((self.n_globals, *free_values.shape[1:]))
        out[self.free] = free_values
        return out


@dataclass(frozen=True)
class UnknownVector:
    """A vector, or columns of vectors, over the unknowns of a network, split by kind."""

    exteriors: NDArray[np.float64]  #: (m, 6, ...) of T [mm] and w [rad] of the exposures
    points: NDArray[np.float64]  #: (n, 3, ...) of the object points [mm]
    globals: NDArray[np.float64]  #: (G, ...) of the global unknowns; zeros if fixed


@dataclass(frozen=True)
class Parameters:
    """Values of the unknowns of a network."""

    interior: NDArray[np.float64]  #: (F, 3) xp, yp, c of the fluoroscopes [px]
    rotation: NDArray[np.float64]  #: (m, 3, 3) rotations phantom -> sensor of the exposures
    position_mm: NDArray[np.float64]  #: (m, 3) positions of the source
    points_mm: NDArray[np.float64]  #: (n, 3) object points
    #: (p,) coefficients of the additional parameters of each fluoroscope
    additional: tuple[NDArray[np.float64] | None, ...] = ()
    #: relative orientation of each constraint of the network
    relative: tuple[RelativePose, ...] = ()

    def additional_of(self, f: int) -> NDArray[np.float64]:
        """Return the additional parameters of fluoroscope f, which must have some."""
        coefficients = self.additional[f]
        assert coefficients is not None
        return coefficients


def inverse_left_jacobian(w: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return derivatives (..., 3, 3) of log(exp(v) exp(w)) with respect to v at v = 0.

    w (..., 3): rotation vectors [rad] (Barfoot 7.1.3).
    """
    half = np.linalg.norm(w, axis=-1)[..., None, None] / 2
    k = cross_matrix(w)
    # (1 - h cot h) / (4 h^2) is 0/0 at zero, where its limit is 1/12.
    is_small = half < 1e-3
    safe = np.where(is_small, 1.0, half)
    factor = np.where(is_small, 1 / 12 + half**2 / 180, (1 - safe / np.tan(safe)) / (4 * safe**2))
    return np.eye(3) - k / 2 + factor * (k @ k)


def relative_poses(
    parameters: Parameters, pairs: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return rotations (k, 3, 3) and translations (k, 3) [mm] of b relative to a.

    pairs (k, 2): rows of exposures of a and b.
    """
    a, b = pairs.T
    r_a = parameters.rotation[a]
    shift = parameters.position_mm[b] - parameters.position_mm[a]
    return parameters.rotation[b] @ r_a.transpose(0, 2, 1), (r_a @ shift[..., None])[..., 0]


def discrepancies(
    constraint: RelativeConstraint, pose: RelativePose, parameters: Parameters
) -> NDArray[np.float64]:
    """Return discrepancies (k, 6) of the pairs from a pose: translation [mm], rotation [rad]."""
    turn, shift = relative_poses(parameters, constraint.pairs)
    scale, _ = _translation_scale(constraint, pose)
    return np.concatenate(
        [scale * (shift - pose.translation_mm), vector_from_matrix(turn @ pose.rotation.T)], axis=1
    )


def _translation_scale(
    constraint: RelativeConstraint, pose: RelativePose
) -> tuple[float, NDArray[np.float64]]:
    """Return the factor of the translations, and its derivative (3,) by the pose translation."""
    if constraint.length_mm is None:
        return 1.0, np.zeros(3)
    length = np.linalg.norm(pose.translation_mm)
    derivative = -constraint.length_mm / length**3 * pose.translation_mm
    return constraint.length_mm / length, derivative


def discrepancies_with_jacobian(
    constraint: RelativeConstraint, pose: RelativePose, parameters: Parameters
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return discrepancies (k, 6) and their derivatives.

    The derivatives (k, 6, 6) are by the exposure of a, by the exposure of b (T [mm] and w [rad]
    each), and by the pose (as in RelativePose.updated).
    """
    a, _ = constraint.pairs.T
    turn, shift = relative_poses(parameters, constraint.pairs)
    scale, d_scale = _translation_scale(constraint, pose)
    w = vector_from_matrix(turn @ pose.rotation.T)
    inverse_jacobian = inverse_left_jacobian(w)
    d_a = np.zeros((len(a), POSE_SIZE, POSE_SIZE))
    d_b = np.zeros_like(d_a)
    d_pose = np.zeros_like(d_a)
    d_a[:, :3, :3] = -scale * parameters.rotation[a]
    d_b[:, :3, :3] = scale * parameters.rotation[a]
    d_a[:, :3, 3:] = -scale * cross_matrix(shift)
    d_a[:, 3:, 3:] = -inverse_jacobian @ turn
    d_b[:, 3:, 3:] = inverse_jacobian
    d_pose[:, :3, :3] = -scale * np.eye(3) + (shift - pose.translation_mm)[:, :, None] * d_scale
    d_pose[:, 3:, 3:] = -inverse_left_jacobian(-w)
    return np.concatenate([scale * (shift - pose.translation_mm), w], axis=1), d_a, d_b, d_pose


def mean_pose(
    parameters: Parameters, pairs: NDArray[np.int64], weights: np.ndarray | None = None
) -> RelativePose:
    """Return the mean relative orientation of pairs (k, 2) of exposures.

    With weights (k, 6, 6) of translation and rotation of each pair, it is the weighted mean;
    without weights, the component-wise median, an initial value that is robust to single pairs.
    """
    turn, shift = relative_poses(parameters, pairs)
    median = np.median(shift, axis=0)
    start = int(np.argmin(np.sum((shift - median) ** 2, axis=1)))
    pose = RelativePose(turn[start], median)
    for _ in range(10):  # a few are enough
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
        if np.max(np.abs(step)) < 1e-12:  # mm, rad
            break
    return pose


def exposures_from_pose(
    parameters: Parameters,
    constraint: RelativeConstraint,
    pose: RelativePose,
    offset: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return exterior orientations of b's exposures from those of a and a relative orientation.

    Parameters
    ----------
    parameters : Parameters
        Exterior orientations of a's exposures.
    constraint : RelativeConstraint
        The pairs of exposures.
    pose : RelativePose
        Relative orientation of b with respect to a.
    offset : (k, 6) ndarray, optional
        Discrepancies of the result from the pose; zeros by default.

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
    """Return parameters after a step, with b's exposures moved along their constraints.

    Their discrepancies become those that the linearised constraint predicts. To first order they
    already are, but a stiff constraint is curved, and a straight step would leave it by more than
    its standard deviation.

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
