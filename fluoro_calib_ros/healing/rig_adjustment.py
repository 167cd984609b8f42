# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Adjustment of a rig by the bodies that it sees: orientation, interior, distortion and shapes.

The unknowns have a normal prior: the knowledge of the rig and of the shapes, widened for the
changes of a hypothesis. With L L' the covariance of the prior, the unknowns are L z, and poses are
eliminated exposure by exposure (Foerstner and Wrobel, "Photogrammetric Computer Vision", Springer
2016, 4.2.6 and 15.3.3). With the reduced normal equations H, h, a step is

    (I + L'HL) dz = L'h - z.

An image point is either an inlier with its own standard deviation, or a false match anywhere in
the image (Hogg, Bovy and Lang, "Data analysis recipes: fitting a model to data", 2010, section 3).
The evidence of a hypothesis is Laplace's approximation at the solution (MacKay, "Information
Theory, Inference, and Learning Algorithms", Cambridge 2003, ch. 28):

    log Z = -1/2 (loss + z'z) - 1/2 log det(I + L'HL).

The correction of an image point has an error that is constant while a marker stands still, and
that neighbouring markers share (see `correction_errors`). Its mean over the exposures is an
unknown of each marker and view; its variation between exposures is a smooth field over the image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..bodies.body import Body, padded
from ..bodies.correction_errors import covariance_of_means
from ..bodies.image_points import linear_at
from ..correction.series import MARGIN, Functions
from ..correction.terms import CUBIC
from ..photogrammetry.rig_orientation import ORIENTATION_SIZE, RigOrientation
from ..photogrammetry.rotations import cross_matrix, matrix_from_vector
from ..photogrammetry.unknowns import POSE_SIZE
from ..reconstruction.cameras import Cameras
from ..rows import chosen_rows
from .sizes import ChangeStatistics

FALSE_SHARE = 0.01  # expected share of false matches among the image points
MAX_STEPS = 20
MAX_REPEATS = 3
LAST_GAIN = 0.1  # gain of log evidence that ends repeats; differences of about 3 decide
# Square of a step in standard deviations below which the iteration ends.
LAST_STEP = 1e-2
# Half waves along the longer side of a drift of the distortion, in addition to a cubic trend.
DRIFT_MODES = 4
FITTING = 0.8  # minimum share of the image points of a body that are not false matches
MAX_NOISE_PX = 10.0  # maximum noise of image points that are not false matches
LOOSEST = 1e-6  # weight of a pose [1/mm^2, 1/rad^2] that keeps an unseen one in place
ROUNDING = POSE_SIZE * np.finfo(float).eps  # of a pose's normal matrix, relative to its trace


_BY_EXPOSURE = ('uv', 'pixel', 'variance', 'seen')


@dataclass(frozen=True)
class ObservedBodies:
    """Image points of the markers (B, M) of bodies in T exposures and F views."""

    uv: NDArray[np.float64]  #: (T, B, M, F, 2) corrected [px]
    pixel: NDArray[np.float64]  #: (T, B, M, F, 2) as observed [px]
    variance: NDArray[np.float64]  #: (T, B, M, F) variance of the noise [px^2]
    correction: NDArray[np.float64]  #: (B, M, F) constant errors of the correction [px^2]
    seen: NDArray[np.bool_]  #: (T, B, M, F)

    def exposures(self, chosen: NDArray[np.int64]) -> ObservedBodies:
        """Return a subset of the exposures."""
        return replace(self, **{name: getattr(self, name)[chosen] for name in _BY_EXPOSURE})

    def changed(self, change: NDArray[np.float64]) -> ObservedBodies:
        """Return a copy with change (T, B, M, F, 2) added to the corrected image points."""
        return replace(self, uv=self.uv + change)

    def without(self, rows: NDArray[np.bool_]) -> ObservedBodies:
        """Return a copy without the image points of some markers (B, M)."""
        return replace(self, seen=self.seen & ~rows[..., None])

    def exchanged(self, body: int, first: int, second: int) -> ObservedBodies:
        """Return a copy with two markers of a body exchanged."""
        order = np.arange(self.uv.shape[2])
        order[[first, second]] = second, first
        arrays = {}
        for name in _BY_EXPOSURE:
            array = getattr(self, name).copy()
            array[:, body] = array[:, body][:, order]
            arrays[name] = array
        return replace(self, **arrays)


@dataclass(frozen=True)
class Poses:
    """Rotations (T, B, 3, 3), centres (T, B, 3) of bodies, and whether (T, B) they are known."""

    rotation: NDArray[np.float64]
    centre_mm: NDArray[np.float64]
    known: NDArray[np.bool_]

    def exposures(self, chosen: NDArray[np.int64]) -> Poses:
        """Return a subset of the exposures."""
        return chosen_rows(self, chosen)

    def or_else(self, other: Poses, fits: NDArray[np.bool_]) -> Poses:
        """Return these poses where they fit (T, B), and the other ones elsewhere."""
        chosen = fits[..., None]
        return Poses(
            np.where(chosen[..., None], self.rotation, other.rotation),
            np.where(chosen, self.centre_mm, other.centre_mm),
            self.known,
        )


@dataclass(frozen=True)
class Prior:
    """Prior of the unknowns."""

    #: (9F, 9F) covariance of the orientation, as it was calibrated
    orientation: NDArray[np.float64]
    #: (K,) standard deviations of changes in addition to the knowledge of rig and shapes, and of
    #: the other unknowns
    sd: NDArray[np.float64]
    #: (F, B M, B M) covariance of the mean errors of the correction, per coordinate [px^2]
    correction: NDArray[np.float64]
    #: (B, M) factor of the standard deviations of the image points of a marker
    inflation: NDArray[np.float64]

    def widened(self, sd: NDArray[np.float64]) -> Prior:
        """Return the prior widened by further changes of the unknowns (K,)."""
        return replace(self, sd=np.hypot(self.sd, sd))


@dataclass(frozen=True)
class RigSolution:
    """Solution of a hypothesis."""

    values: NDArray[np.float64]  #: (K,) changes of the unknowns
    covariance: NDArray[np.float64]  #: (K, K)
    poses: Poses
    evidence: float  #: log evidence, up to a constant that all hypotheses share
    #: (B, M) minus twice the log likelihood of the image points of each marker
    losses: NDArray[np.float64]
    #: (B, M) weighted squared residuals of the inliers of each marker, and their expectation
    squares: NDArray[np.float64]
    freedom: NDArray[np.float64]
    #: (B, M) mean inlier probability of the image points of a marker; NaN if unseen
    inliers: NDArray[np.float64]
    #: (T, B) the same for the image points of a body in an exposure
    inliers_of_pose: NDArray[np.float64]


@dataclass(frozen=True)
class _Normal:
    """Reduced normal equations H (K, K), h (K,), and back-substitution of the poses by body."""

    matrix: NDArray[np.float64]
    right: NDArray[np.float64]
    back: list[_Back]


class _Back(NamedTuple):
    """Back-substitution of the poses of a body: N = C C' of its poses, and their mixed matrix."""

    columns: NDArray[np.int64]  # (L,) unknowns
    inverse: NDArray[np.float64]  # (T, 6, 6) C^-1
    half: NDArray[np.float64]  # (T, 6, L + 1) C^-1 (D'J, D'r)

    def poses(self, step: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the changes of the poses (T, 6) for a step (K,) of the other unknowns."""
        half = self.half[..., -1] - self.half[..., :-1] @ step[self.columns]
        return np.asarray((np.swapaxes(self.inverse, 1, 2) @ half[..., None])[..., 0])


class RigAdjustment:
    """Adjustment of one recording for any hypothesis.

    orientation: calibrated orientation. bodies: with known places of all markers. image_size: of
    each fluoroscope [px].
    """

    def __init__(
        self,
        orientation: RigOrientation,
        bodies: Sequence[Body],
        image_size: Sequence[tuple[int, int]],
    ) -> None:
        self.orientation = orientation
        self.bodies = tuple(bodies)
        self.functions = [Functions(size, CUBIC, DRIFT_MODES) for size in image_size]
        self._area = np.array([float(w * h) for w, h in image_size])
        self.target_id = padded([body.target_id for body in bodies], -1)
        self.xyz = padded([body.xyz_mm - body.centre for body in bodies], 0.0)
        count = self.target_id.shape[1]
        self._of_shapes = [_shape_covariance(body, count) for body in bodies]
        self._views = len(orientation.fluoroscopes)
        sizes = [
            ORIENTATION_SIZE * self._views,
            2 * len(self.functions[0]) * self._views,
            self.xyz.size,
            1,
            2 * self._views * self.target_id.size,
        ]
        ends = np.cumsum(sizes)
        self.rig, self.drift, self.shape, self.scale, self.bias = (
            slice(int(end - size), int(end)) for end, size in zip(ends, sizes)
        )
        self.size = int(ends[-1])

    # -- the unknowns

    def healthy_prior(self, observed: ObservedBodies, shape_scale: float) -> Prior:
        """Return the prior of a rig that has not changed.

        shape_scale: standard deviation of the common scale of all shapes.
        """
        sd = np.zeros(self.size)
        sd[self.scale] = shape_scale
        drift = sd[self.drift].reshape(self._views, -1)
        longer_sides = [max(functions.image_size) for functions in self.functions]
        pixel = np.where(observed.seen[..., None], observed.pixel, np.nan)
        pixel = pixel.reshape(len(pixel), -1, *pixel.shape[3:]) / np.array(longer_sides)[:, None]
        correction_sd = np.sqrt(observed.correction).reshape(-1, self._views).T
        means = covariance_of_means(pixel) * correction_sd[:, :, None] * correction_sd[:, None]
        constant_part = np.diagonal(means, axis1=1, axis2=2).T.reshape(observed.correction.shape)
        varying_part = np.broadcast_to(observed.correction - constant_part, observed.seen.shape)
        for f in range(self._views):
            seen = observed.seen[..., f]
            one_px = self.sd_of_drift(f)
            values = self.functions[f](observed.pixel[..., f, :][seen])
            # A drift of 1 px at the edges does not have a variance of 1 px^2 at the markers.
            variance = np.sum((values * one_px[: values.shape[1]]) ** 2)
            if variance > 0:
                smooth = max(0.0, varying_part[..., f][seen].sum())
                drift[f] = one_px * np.sqrt(smooth / variance)
        return Prior(self.orientation.covariance, sd, means, np.ones(self.target_id.shape))

    def sd_of_drift(self, fluoroscope: int) -> NDArray[np.float64]:
        """Return standard deviations (2n,) of the coefficients of a drift of 1 px."""
        return np.tile(_share_of_functions(self.functions[fluoroscope]), 2)

    def root(self, prior: Prior) -> NDArray[np.float64]:
        """Return L (K, k) of a prior; unknowns without uncertainty have no columns."""
        sd = prior.sd
        root = np.diag(sd)
        covariance = prior.orientation + np.diag(sd[self.rig] ** 2)
        root[self.rig, self.rig] = replace(
            self.orientation, covariance=covariance
        ).covariance_root()
        shape_sds = sd[self.shape].reshape(len(self.bodies), -1)
        for row, (covariance, widened) in enumerate(zip(self._of_shapes, shape_sds)):
            first = self.shape.start + row * len(widened)
            rows = slice(first, first + len(widened))
            root[rows, rows] = root_of(covariance + np.diag(widened**2))
        number = np.arange(self.size)[self.bias].reshape(-1, self._views, 2)
        for f, covariance in enumerate(prior.correction):
            correction_root = root_of(covariance)
            for axis in range(2):
                root[np.ix_(number[:, f, axis], number[:, f, axis])] = correction_root
        return root[:, (root != 0).any(axis=0)]

    def rig_at(self, values: NDArray[np.float64]) -> RigOrientation:
        """Return the orientation including the changes of the unknowns."""
        change = values[self.rig].reshape(self._views, ORIENTATION_SIZE)
        return replace(
            self.orientation,
            position_mm=self.orientation.position_mm + change[:, :3],
            rotation=matrix_from_vector(change[:, 3:6]) @ self.orientation.rotation,
            interior=self.orientation.interior + change[:, 6:],
        )

    def functions_at(self, pixel: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the functions (..., F, n) of a drift at pixels (..., F, 2)."""
        shape = pixel.shape[:-2]
        return np.stack(
            [
                functions(pixel[..., f, :].reshape(-1, 2)).reshape(*shape, -1)
                for f, functions in enumerate(self.functions)
            ],
            axis=-2,
        )

    def drift_at(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the coefficients (F, 2, n) of the drifts of the distortion [px]."""
        return values[self.drift].reshape(self._views, 2, -1)

    def shapes_at(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the coordinates (B, M, 3) of the markers relative to their centres."""
        return (self.xyz + values[self.shape].reshape(self.xyz.shape)) * (
            1 + values[self.scale][0]
        )

    def normal_at(
        self, observed: ObservedBodies, prior: Prior, solution: RigSolution
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the reduced normal equations H (K, K), h (K,) of all unknowns at a solution."""
        linear = LinearPoints.of(self, observed, solution.values, solution.poses)
        weight = Mixture.of(self, linear, observed, prior).weight(1.0)
        normal = self.normal_of(linear, weight, np.ones(self.size, dtype=bool))
        return normal.matrix, normal.right

    def change_statistics(
        self,
        observed: ObservedBodies,
        prior: Prior,
        solution: RigSolution,
        known: NDArray[np.float64] | float = 0.0,
    ) -> ChangeStatistics:
        """Return the information of the data on changes of the unknowns (K,) beyond a prior.

        The solution may be that of another prior. known (K,): changes that are certain.
        """
        normal, right = self.normal_at(observed, prior, solution)
        system = np.column_stack([normal, right + normal @ (solution.values - known)])
        root = self.root(prior)
        whitened = np.eye(root.shape[1]) + root.T @ normal @ root
        system -= normal @ root @ np.linalg.solve(whitened, root.T @ system)
        return ChangeStatistics((system[:, :-1] + system[:, :-1].T) / 2, system[:, -1])

    def covariance_at(
        self, observed: ObservedBodies, prior: Prior, solution: RigSolution
    ) -> NDArray[np.float64]:
        """Return the covariance (K, K) of the unknowns with a different prior, at a solution."""
        root = self.root(prior)
        normal, _ = self.normal_at(observed, prior, solution)
        whitened = np.eye(root.shape[1]) + root.T @ normal @ root
        return np.asarray(root @ np.linalg.solve(whitened, root.T))

    def places_at(self, solution: RigSolution) -> NDArray[np.float64]:
        """Return places (n, 3) [mm] of all markers in the exposures that show their bodies."""
        poses = solution.poses
        xyz = self.shapes_at(solution.values) @ np.swapaxes(poses.rotation, 2, 3)
        known = poses.known[..., None] & (self.target_id >= 0)
        return np.asarray((xyz + poses.centre_mm[:, :, None])[known])

    # -- the solution

    def with_fixed(
        self, observed: ObservedBodies, prior: Prior, solution: RigSolution, free: np.ndarray
    ) -> RigSolution:
        """Return the solution in which unknowns of the rig change only if they are free (K,).

        The others stay as they were calibrated, with their covariance C. The free ones are
        estimated with the others fixed, but also get their errors: with the derivatives G of the
        free unknowns by the fixed ones, G C G' is added to the covariance, and G C is the
        covariance of both (consider covariance analysis; Tapley, Schutz and Born, "Statistical
        Orbit Determination", 2004, 6.2).
        """
        fixed = np.zeros(self.size, dtype=bool)
        fixed[self.rig] = ~free[self.rig]
        fixed_prior = replace(
            prior,
            orientation=np.where(
                fixed[self.rig] | fixed[self.rig][:, None], 0.0, prior.orientation
            ),
        )
        values = np.where(fixed, 0.0, solution.values)
        refined = self.refine(observed, fixed_prior, (values, solution.poses))
        normal, _ = self.normal_at(observed, fixed_prior, refined)
        fixed_covariance = np.zeros((self.size, self.size))
        fixed_covariance[self.rig, self.rig] = prior.orientation
        fixed_covariance[~fixed] = 0.0
        fixed_covariance[:, ~fixed] = 0.0
        derivative = np.eye(self.size) - refined.covariance @ np.where(fixed, normal, 0.0)
        covariance = refined.covariance + derivative @ fixed_covariance @ derivative.T
        return replace(refined, covariance=covariance)

    def solve(
        self, observed: ObservedBodies, prior: Prior, start: tuple[NDArray[np.float64], Poses]
    ) -> RigSolution:
        """Solve for a hypothesis, from values (K,) of the unknowns and poses.

        The solution is repeated from its result while this helps: a pose misled by false matches
        recovers once the rig is right.
        """
        solution = self._converge(observed, prior, start, np.inf)
        for _ in range(MAX_REPEATS):
            repeated = self._converge(observed, prior, (solution.values, solution.poses), np.inf)
            gain = repeated.evidence - solution.evidence
            solution = repeated if gain > 0 else solution
            if gain < LAST_GAIN:
                break
        return solution

    def refine(
        self, observed: ObservedBodies, prior: Prior, start: tuple[NDArray[np.float64], Poses]
    ) -> RigSolution:
        """Solve for a hypothesis from values (K,) and poses that identify the false points."""
        return self._converge(observed, prior, start, 1.0)

    def _converge(
        self,
        observed: ObservedBodies,
        prior: Prior,
        start: tuple[NDArray[np.float64], Poses],
        widest: float,
    ) -> RigSolution:
        """Iterate; standard deviations start larger, by up to widest, halved with each step."""
        root = self.root(prior)
        is_uncertain = (root != 0).any(axis=1)
        values, poses = start
        z = np.linalg.lstsq(root, values, rcond=None)[0]
        widening = np.full((1, 1, 1, 1), widest)
        for _ in range(MAX_STEPS):
            values = root @ z
            linear = LinearPoints.of(self, observed, values, poses)
            terms = Mixture.of(self, linear, observed, prior)
            widening = np.clip(terms.scale, 1.0, np.maximum(widening / 2, 1.0))
            weight = terms.weight(widening)
            normal = self.normal_of(linear, weight, is_uncertain)
            whitened = np.eye(root.shape[1]) + root.T @ normal.matrix @ root
            right = root.T @ normal.right - z
            step = np.linalg.solve(whitened, right)
            if self._is_impossible(root @ (z + step)):
                break
            z = z + step
            poses = moved_poses(poses, normal, root @ step)
            if (widening == 1.0).all() and right @ step < LAST_STEP:
                break
        covariance = root @ np.linalg.solve(whitened, root.T)
        evidence = -0.5 * (terms.losses.sum() + z @ z + np.linalg.slogdet(whitened)[1])
        return RigSolution(
            root @ z,
            covariance,
            poses,
            evidence=float(evidence),
            **terms.shares(),
        )

    def _is_impossible(self, values: NDArray[np.float64]) -> bool:
        """Return whether a principal distance is below half of the original: wrong hypothesis."""
        c = self.orientation.interior[:, 2]
        return bool((c + values[self.rig].reshape(self._views, -1)[:, 8] < c / 2).any())

    def normal_of(
        self, linear: LinearPoints, weight: NDArray[np.float64], unsure: NDArray[np.bool_]
    ) -> _Normal:
        """Sum the image points with weights (T, B, M, F); poses are eliminated.

        unsure (K,): unknowns that may change.
        """
        matrix = np.zeros((self.size, self.size))
        right = np.zeros(self.size)
        substitutions = []
        unit = np.eye(POSE_SIZE)
        for row in range(len(self.bodies)):
            columns, system, cross, normal = _summed(self, linear, row, weight[:, row], unsure)
            normal[~linear.poses.known[:, row]] = unit
            damping = LOOSEST + ROUNDING * np.trace(normal, axis1=1, axis2=2)
            normal += damping[:, None, None] * unit
            inverse = np.linalg.inv(np.linalg.cholesky(normal))
            half = inverse @ cross
            flat = half.reshape(-1, half.shape[2])
            system -= flat.T @ flat
            matrix[np.ix_(columns, columns)] += system[:-1, :-1]
            right[columns] += system[:-1, -1]
            substitutions.append(_Back(columns, inverse, half))
        return _Normal(matrix, right, substitutions)

    def of_body(self, row: int) -> _Unknowns:
        """Return the indices of the unknowns on which the points of a body depend."""
        number = np.arange(self.size)
        return _Unknowns(
            number[self.rig].reshape(self._views, ORIENTATION_SIZE),
            number[self.drift].reshape(self._views, 2, -1),
            number[self.shape].reshape(len(self.bodies), -1)[row],
            number[self.scale],
            number[self.bias].reshape(*self.target_id.shape, self._views, 2)[row],
        )


class _Unknowns(NamedTuple):
    """Indices of the unknowns of the rig and of a body."""

    rig: NDArray[np.int64]  # (F, 9)
    drift: NDArray[np.int64]  # (F, 2, n)
    shape: NDArray[np.int64]  # (3 M,)
    scale: NDArray[np.int64]  # (1,)
    bias: NDArray[np.int64]  # (M, F, 2)

    def of_coordinate(self, view: int, axis: int) -> NDArray[np.int64]:
        """Return the indices for a coordinate of a view, in the order of `_design`."""
        unknowns = self.rig[view], self.drift[view, axis], self.shape, self.scale
        return np.concatenate([*unknowns, self.bias[:, view, axis]])


def _summed(
    adjustment: RigAdjustment,
    linear: LinearPoints,
    row: int,
    weight: NDArray[np.float64],
    unsure: NDArray[np.bool_],
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Sum the image points of a body with weights (T, M, F).

    Returns the unknowns (L,) on which it depends, their normal matrix with the right-hand side in
    the last row and column, the mixed matrix with poses (T, 6, L + 1), and that of poses
    (T, 6, 6). A coordinate of a view depends on few of the unknowns, so each is summed separately.
    """
    unknowns = adjustment.of_body(row)
    columns = np.concatenate([part.ravel() for part in unknowns])
    columns = columns[unsure[columns]]
    place = np.zeros(adjustment.size, dtype=int)
    place[columns] = np.arange(len(columns))
    system = np.zeros((len(columns) + 1,) * 2)
    cross = np.zeros((len(columns) + 1, len(weight), POSE_SIZE))
    normal = np.zeros((len(weight), POSE_SIZE, POSE_SIZE))
    pose_derivatives = linear.by_pose(row)
    for f, axis in np.ndindex(*unknowns.drift.shape[:2]):
        root = np.sqrt(weight[..., f])[..., None]
        number = unknowns.of_coordinate(f, axis)
        is_uncertain = unsure[number]
        design = _design(linear, row, f, axis)[..., np.append(is_uncertain, True)] * root
        by_pose = np.swapaxes(pose_derivatives[:, :, f, axis] * root, 1, 2)
        rows = np.append(place[number[is_uncertain]], len(columns))
        flat = design.reshape(-1, len(rows))
        system[np.ix_(rows, rows)] += flat.T @ flat
        cross[rows] += (by_pose @ design).transpose(2, 0, 1)
        normal += by_pose @ np.swapaxes(by_pose, 1, 2)
    return columns, system, cross.transpose(1, 2, 0), normal


def _design(linear: LinearPoints, row: int, view: int, axis: int) -> NDArray[np.float64]:
    """Return derivatives (T, M, 9 + n + 3 M + 1 + M) of a coordinate in a view, and residuals.

    The derivatives are by the orientation of the view, the drift along the axis, shape, scale and
    the mean errors of the correction.
    """
    by_place = linear.by_place[:, row, :, view, axis]  # (T, M, 3)
    by_marker = by_place @ linear.poses.rotation[:, row]
    exposures, count, _ = by_marker.shape
    marker = np.arange(count)
    by_shape = np.zeros((exposures, count, count, 3))
    by_shape[:, marker, marker] = by_marker
    return np.concatenate(
        [
            linear.by_orientation[:, row, :, view, axis],
            linear.functions[:, row, :, view],
            by_shape.reshape(exposures, count, -1),
            np.sum(by_marker * linear.shape[row], axis=2, keepdims=True),
            np.broadcast_to(np.eye(count), (exposures, count, count)),
            linear.residual[:, row, :, view, axis, None],
        ],
        axis=2,
    )


@dataclass(frozen=True)
class LinearPoints:
    """Image points (T, B, M, F) at values of the unknowns: residuals and derivatives."""

    residual: NDArray[np.float64]  # (..., 2)
    by_place: NDArray[np.float64]  # (..., 2, 3)
    by_orientation: NDArray[np.float64]  # (..., 2, 9)
    functions: NDArray[np.float64]  # (..., n), functions of a drift
    place_by_pose: NDArray[np.float64]  # (T, B, M, 3, 6)
    seen: NDArray[np.bool_]  # by poses that are known
    good: NDArray[np.bool_]  # seen, and the marker in front of the source
    shape: NDArray[np.float64]  # (B, M, 3)
    poses: Poses

    @classmethod
    def of(
        cls,
        adjustment: RigAdjustment,
        observed: ObservedBodies,
        values: NDArray[np.float64],
        poses: Poses,
    ) -> LinearPoints:
        """Linearise at values of the unknowns and at poses."""
        grid = observed.seen.shape  # (T, B, M, F)
        shape = adjustment.shapes_at(values)
        valid = observed.seen & poses.known[:, :, None, None]
        bias = values[adjustment.bias].reshape(*grid[1:], 2)
        pose = poses.rotation, poses.centre_mm
        cameras = Cameras(adjustment.rig_at(values))
        linear = linear_at(cameras, shape, pose, observed.uv - bias, valid)
        by_orientation = linear.by_orientation()
        rotation_change = values[adjustment.rig].reshape(-1, ORIENTATION_SIZE)[:, 3:6]
        by_orientation[..., 3:6] = by_orientation[..., 3:6] @ _by_vector(rotation_change)
        residual = linear.residual
        coefficients = adjustment.drift_at(values)
        # Evaluate the drift at the image point predicted by the model. At the observed pixel,
        # which has noise, a drift that shrinks the image would also shrink the noise, and be
        # preferred for it.
        pixel = np.where(valid[..., None], observed.pixel, 0.0)
        drift = _drift(adjustment.functions_at(pixel), coefficients)
        noise = np.clip(residual - drift, -MAX_NOISE_PX, MAX_NOISE_PX)
        functions = adjustment.functions_at(pixel - np.where(valid[..., None], noise, 0.0))
        residual = residual - np.where(valid[..., None], _drift(functions, coefficients), 0.0)
        return cls(
            residual,
            linear.by_place,
            by_orientation,
            functions,
            place_by_pose=linear.by_pose,
            seen=valid,
            good=linear.valid,
            shape=shape,
            poses=poses,
        )

    def by_pose(self, row: int) -> NDArray[np.float64]:
        """Return derivatives (T, M, F, 2, 6) of the image points of a body by its pose."""
        return self.by_place[:, row] @ self.place_by_pose[:, row, :, None]


def _drift(
    functions: NDArray[np.float64], coefficients: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the drift (T, B, M, F, 2), from functions (T, B, M, F, n), coefficients (F, 2, n)."""
    return np.asarray((coefficients @ functions[..., None])[..., 0])


@dataclass(frozen=True)
class Mixture:
    """Squared standardised residuals (T, B, M, F), and the density of false matches there.

    Image points of markers behind a source are seen, but not good: they are false matches.
    """

    squares: NDArray[np.float64]
    variance: NDArray[np.float64]
    inflation: NDArray[np.float64]
    false: NDArray[np.float64]  # density relative to that of a residual of 0
    seen: NDArray[np.bool_]
    good: NDArray[np.bool_]

    @classmethod
    def of(
        cls,
        adjustment: RigAdjustment,
        linear: LinearPoints,
        observed: ObservedBodies,
        prior: Prior,
    ) -> Mixture:
        """Standardise the residuals of image points."""
        inflation = prior.inflation[..., None] ** 2
        variance = observed.variance * inflation
        squares = np.sum(linear.residual**2, axis=-1) / variance
        false = FALSE_SHARE / (1 - FALSE_SHARE) * 2 * np.pi * observed.variance / adjustment._area
        inflation = np.broadcast_to(inflation, squares.shape)
        return cls(squares, variance, inflation, false, seen=linear.seen, good=linear.good)

    @property
    def scale(self) -> NDArray[np.float64]:
        """Scales (T, B, 1, 1) of the standardised residuals of bodies, from a quantile.

        A median would be small if one of two views fits, and the other one not at all.
        """
        squares = np.where(self.good, self.squares, np.nan).reshape(*self.good.shape[:2], -1)
        seen = np.isfinite(squares).any(axis=2)
        scale = np.ones(seen.shape)
        # Chi-square with two degrees of freedom is below -2 log(1 - q) with probability q.
        scale[seen] = _quantile(squares[seen], FITTING) / (-2 * np.log(1 - FITTING))
        return np.sqrt(scale)[..., None, None]

    def inlier(self, widening: NDArray[np.float64] | float = 1.0) -> NDArray[np.float64]:
        """Return inlier probabilities, with standard deviations larger by a factor."""
        density = np.exp(-0.5 * self.squares / widening**2) / self.inflation
        return np.where(self.good, density / (density + self.false), 0.0)

    def weight(self, widening: NDArray[np.float64] | float) -> NDArray[np.float64]:
        """Return weights of the image points, with standard deviations larger by a factor."""
        return self.inlier(widening) / (self.variance * widening**2)

    @property
    def losses(self) -> NDArray[np.float64]:
        """Minus twice the log likelihoods."""
        density = np.where(self.good, np.exp(-0.5 * self.squares) / self.inflation, 0.0)
        return np.where(self.seen, -2 * np.log(density + self.false), 0.0)

    def shares(self) -> dict[str, NDArray[np.float64]]:
        """Return losses, squares and their expectation by marker, and shares of inliers."""
        inlier = self.inlier()
        # A pose absorbs six of the residuals of its body, in proportion to their number.
        count = 2 * inlier.sum(axis=(2, 3))
        share = np.where(count > 2 * POSE_SIZE, 1 - POSE_SIZE / np.maximum(count, 1), 0.0)
        weighted = inlier * (share > 0)[..., None, None]
        with np.errstate(invalid='ignore', divide='ignore'):
            marker_share = inlier.sum(axis=(0, 3)) / self.seen.sum(axis=(0, 3))
            pose_share = inlier.sum(axis=(2, 3)) / self.seen.sum(axis=(2, 3))
        return {
            'losses': self.losses.sum(axis=(0, 3)),
            'squares': (weighted * self.squares * self.inflation).sum(axis=(0, 3)),
            'freedom': (2 * weighted * share[..., None, None]).sum(axis=(0, 3)),
            'inliers': marker_share,
            'inliers_of_pose': pose_share,
        }


def _quantile(values: NDArray[np.float64], share: float) -> NDArray[np.float64]:
    """Return the quantile (n,) of each row (n, k) without NaN; np.nanquantile loops over rows.

    It is linear between two values, as in np.nanquantile (Hyndman and Fan, "Sample Quantiles in
    Statistical Packages", 1996, definition 7).
    """
    ordered = np.sort(values, axis=1)  # NaN last
    position = share * (np.count_nonzero(np.isfinite(ordered), axis=1) - 1)
    below = np.floor(position).astype(int)
    row = np.arange(len(ordered))
    lower = ordered[row, below]
    return lower + (position - below) * (ordered[row, np.ceil(position).astype(int)] - lower)


def _shape_covariance(body: Body, count: int) -> NDArray[np.float64]:
    """Return the covariance (3 count, 3 count) of the shape of a body; 0 for padding."""
    out = np.zeros((3 * count, 3 * count))
    block = slice(3 * len(body.sd_mm))
    known = body.covariance_mm2
    out[block, block] = np.diag(np.repeat(body.sd_mm**2, 3)) if known is None else known
    return out


def root_of(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the root L of a covariance L L', which may be singular, as for free motions."""
    variance, axes = np.linalg.eigh(covariance)
    rounding = len(variance) * np.finfo(float).eps * variance[-1]
    return np.asarray(axes * np.sqrt(np.where(variance > rounding, variance, 0.0)))


def _share_of_functions(functions: Functions) -> NDArray[np.float64]:
    """Return standard deviations (n,) of coefficients that yield a field of unit variance.

    The mean square of a product of two sines over their rectangle is 1 / (4 extent_u extent_v).
    Polynomials have 1 px at the edges.
    """
    extent = MARGIN * np.asarray(functions.image_size) / 2
    sines = len(functions) - functions.trend
    out = np.ones(len(functions))
    out[functions.trend :] = np.sqrt(4 * np.prod(extent) / sines)
    return out


def _by_vector(w: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return derivatives (F, 3, 3) of a further small rotation by rotation vectors (F, 3).

    exp([w + dw]x) = exp([J dw]x) exp([w]x) with J = sum [w]x^n / (n + 1)! (Chirikjian, "Stochastic
    Models, Information Theory, and Lie Groups", vol. 2, 2012, 10.6); changes are small.
    """
    cross = cross_matrix(w)
    return np.eye(3) + cross @ (np.eye(3) / 2 + cross @ (np.eye(3) / 6 + cross / 24))


def moved_poses(poses: Poses, normal: _Normal, step: NDArray[np.float64]) -> Poses:
    """Move the poses according to a step (K,) of the other unknowns."""
    rotation = poses.rotation.copy()
    centre = poses.centre_mm.copy()
    for row, substitution in enumerate(normal.back):
        pose_step = np.where(poses.known[:, row, None], substitution.poses(step), 0.0)
        centre[:, row] += pose_step[:, :3]
        rotation[:, row] = matrix_from_vector(pose_step[:, 3:]) @ rotation[:, row]
    return replace(poses, rotation=rotation, centre_mm=centre)
