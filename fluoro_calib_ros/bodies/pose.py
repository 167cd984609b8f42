# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Poses of rigid bodies in one exposure, directly from corrected image points of any views.

The image residuals are minimised by Gauss-Newton least squares (Foerstner and Wrobel,
"Photogrammetric Computer Vision", Springer 2016, 4.8 and 12.2). An image point seen in one view
contributes as one seen in two views does. Let the image points of a marker have the derivatives A
with respect to its place in space, weights W and residuals r. Their information on its place is
S = A'WA and s = A'Wr; a coordinate of the shape with standard deviation x changes this to
M S and M s with M = (I + x^2 S)^-1. With the derivatives D = [I, -[Rx]x] of the place with respect
to the pose, the normal equations are

    N = sum D'MSD,  b = sum D'Ms.

Each marker has one test of whether its image points agree with all others (Baarda, "A testing
procedure for use in geodetic networks", Delft 1968): the sum of squares that they add,

    T = r'Wr - x^2 s'Ms + g'(N - D'MSD)^-1 g,  g = D'Ms,

is chi-square with two degrees of freedom for each image point. The marker with the largest excess
is excluded, and the body solved again. All bodies of an exposure are solved at once: a frame must
take less than a millisecond, and each numpy call costs a microsecond.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import chdtri, erfc

from ..photogrammetry.rig_orientation import RigOrientation
from ..photogrammetry.rotations import cross_matrix, vector_from_matrix
from ..photogrammetry.unknowns import POSE_SIZE, SINGULAR
from ..reconstruction.reconstruct import IntersectedViews
from .body import Body, padded, robust_pose
from .image_points import BodyCameras, ImagePoints, Linear, linear_at
from .motion import EYE_3, EYE_6, PoseInformation, turn_of_twists, twist_between

MAX_STEPS = 8  # maximum number of Gauss-Newton steps
# Square of the next step in standard deviations below which the iteration ends. The error after a
# Gauss-Newton step is about the step times its own rotation, and its shift over the distance.
LAST_STEP = 1e-8  # a ten-thousandth of a standard deviation
# Rotation [rad] up to which derivatives are valid: the neglected part of a marker's place is half
# of its square, 0.1 % of the distance from the centre.
LINEAR_RAD = 0.05
# Maximum standard deviation of the rotation for which an exposure alone gives a pose: the
# derivatives are then valid at two standard deviations.
ALONE_SD_RAD = LINEAR_RAD / 2
# Eigenvalue of a matrix of unit diagonal below which the other markers do not predict a marker;
# also added to regularise such matrices. It is far above rounding errors.
WEAK = 1e-9


@dataclass(frozen=True)
class Prediction:
    """Expected poses: rotations (B, 3, 3), centres (B, 3) [mm], covariances (B, 6, 6).

    known (B,): whether there is one. weak (B,): number of exposures since one alone gave the pose,
    including the expected one. near (B,): whether an iteration may start at a pose that is not
    known, that of a body that has just appeared; None for no body.
    """

    rotation: NDArray[np.float64]
    centre_mm: NDArray[np.float64]
    covariance: NDArray[np.float64]
    known: NDArray[np.bool_]
    weak: NDArray[np.int64]
    near: NDArray[np.bool_] | None = None


@dataclass(frozen=True)
class FramePoses:
    """Poses of B bodies in one exposure, relative to the centres of their markers."""

    rotation: NDArray[np.float64]  #: (B, 3, 3) NaN if the exposure alone gives no pose
    centre_mm: NDArray[np.float64]  #: (B, 3)
    alone: NDArray[np.bool_]  #: (B,) whether the exposure alone gives the pose
    #: (B,) whether a second pose fits as well, and the prediction does not exclude it
    ambiguous: NDArray[np.bool_]
    #: (B, 6, 6) see BodyPoses; if the exposure alone does not give the pose, the prediction
    #: contributes
    covariance_noise: NDArray[np.float64]
    covariance_fixed: NDArray[np.float64]
    rig_root: NDArray[np.float64]  #: (B, 6, k)
    information: PoseInformation  #: for a filter, from the random errors only
    used: NDArray[np.bool_]  #: (B, M) markers used, by their row in the body
    test: NDArray[np.float64]  #: (B, M) test of a marker over its limit; NaN if not needed
    #: (B,) weighted sum of squares of the image points used, and its expectation
    chi2: NDArray[np.float64]
    freedom: NDArray[np.float64]

    @property
    def markers(self) -> NDArray[np.int64]:
        """Number (B,) of markers used."""
        return self.used.sum(axis=1)


@dataclass(frozen=True)
class _Marker:
    """Sums of markers: S, s, r'Wr (B, M), M, and M S, M s."""

    weight: NDArray[np.float64]  # (B, M, F), W
    s_matrix: NDArray[np.float64]
    s_vector: NDArray[np.float64]
    squares: NDArray[np.float64]
    m: NDArray[np.float64]
    ms_matrix: NDArray[np.float64]
    ms_vector: NDArray[np.float64]


@dataclass(frozen=True)
class _Solution:
    """Poses of B bodies, whether (B,) the exposure alone gives them, normal matrix parts."""

    rotation: NDArray[np.float64]
    centre: NDArray[np.float64]
    alone: NDArray[np.bool_]
    parts: _Eigen
    linear: Linear
    marker: _Marker


class PoseSolver:
    """Solver for the poses of bodies and one RigOrientation, built once for all exposures.

    Parameters
    ----------
    orientation : RigOrientation
    bodies : sequence of Body
        Bodies with known places of all markers.
    reject : float
        Standardised deviation above which a marker does not belong to its body; the limit of
        chi-square is the quantile of the same probability.
    """

    def __init__(
        self, orientation: RigOrientation, bodies: Sequence[Body], reject: float = 4.0
    ) -> None:
        self.bodies = tuple(bodies)
        self.orientation = orientation
        self.target_id = padded([body.target_id for body in bodies], -1)
        self.centre = np.array([body.centre for body in bodies])
        self.xyz = padded([body.xyz_mm - body.centre for body in bodies], 0.0)
        self.variance = padded([body.sd_mm**2 for body in bodies], 0.0)
        self._variance_3 = self.variance[..., None, None]
        self.cameras = BodyCameras(orientation, self.target_id)
        # Fraction of each element of a step that remains as the next step.
        source = orientation.position_mm
        radius = np.linalg.norm(source - source.mean(axis=0), axis=1).max()
        self._share_left = np.repeat([1 / max(radius, 1.0), 1.0], 3)
        tail = erfc(reject / np.sqrt(2))
        freedom = np.arange(max(2 * len(orientation.fluoroscopes), 3) + 1)
        self._limit = np.where(freedom > 0, chdtri(np.maximum(freedom, 1), tail), np.inf)

    def solve(self, exposure: IntersectedViews, prediction: Prediction) -> FramePoses:
        """Solve for the poses in one exposure; the views are those of the orientation."""
        points = self.cameras.sorted(exposure)
        rotation = np.where(prediction.known[:, None, None], prediction.rotation, np.eye(3))
        centre = np.where(prediction.known[:, None], prediction.centre_mm, 0.0)
        started = prediction.known.copy()
        pose = rotation, centre, started
        self._start(exposure, points, np.flatnonzero(~started), pose)
        near = _start_nearby(points, prediction, pose)
        seen = points.seen.any(axis=2)
        used = seen & started[:, None]
        test = np.full(used.shape, np.nan)
        from_prediction = prediction.known
        # Each body may lose all its markers, one at a time, and is restarted once.
        for _ in range(self.xyz.shape[1] + len(self.bodies)):
            solution = self._converge((rotation, centre), points, used, prediction)
            contradicting, worst = self._false_markers(solution, (points, used), prediction, test)
            rotation, centre = solution.rotation, solution.centre
            # From a prediction that is far off, as after two almost equal stamps, an iteration may
            # converge elsewhere. Then restart from the points in space.
            is_doubtful = ~solution.alone & from_prediction
            is_doubtful[contradicting] = from_prediction[contradicting]
            restarted = self._start(
                exposure, points, np.flatnonzero(is_doubtful), (rotation, centre, started)
            )
            from_prediction = from_prediction & ~is_doubtful
            if restarted:
                test[is_doubtful] = np.nan
                continue
            if not len(contradicting):
                break
            used[contradicting, worst] = False
            used[contradicting[near[contradicting]]] = False  # it may have been elsewhere
            # Of contradicting points, those that are left must agree beyond what fits any pose.
            left = (points.seen & used[..., None]).sum(axis=(1, 2))
            used[contradicting[2 * left[contradicting] <= POSE_SIZE]] = False
        ambiguous = self._ambiguous(solution, points, used, prediction)
        return self._result(solution, (points, used), prediction, test, ambiguous)

    def _ambiguous(
        self, solution: _Solution, points: ImagePoints, used: np.ndarray, prediction: Prediction
    ) -> NDArray[np.bool_]:
        """Return whether (B,) a body that only one view sees also fits in a second pose.

        Under weak perspective, markers near a plane look the same when the plane is tilted the
        other way: R and S_l R S_n, where S reflects along the line of sight l and along the normal
        n of the plane (Schweighofer and Pinz, "Robust pose estimation from a planar target", IEEE
        PAMI 28, 2006).
        """
        by_view = (points.seen & used[..., None]).any(axis=1)
        out = np.zeros(len(used), dtype=bool)
        for row in np.flatnonzero(solution.alone & (by_view.sum(axis=1) == 1)).tolist():
            sight = solution.centre[row] - self.orientation.position_mm[by_view[row].argmax()]
            markers = self.xyz[row, used[row]]
            normal = np.linalg.svd(markers - markers.mean(axis=0))[2][-1]
            rotation = solution.rotation.copy()
            rotation[row] = _mirror(sight) @ rotation[row] @ _mirror(normal)
            # The centre of these markers does not move.
            centre = solution.centre.copy()
            centre[row] += (solution.rotation[row] - rotation[row]) @ markers.mean(axis=0)
            markers_of_row = used & (np.arange(len(used)) == row)[:, None]
            second = self._converge((rotation, centre), points, markers_of_row, None)
            squares = [
                _own_squares(pose.marker, self.variance)[row].sum() for pose in (solution, second)
            ]
            turn = second.rotation[row] @ solution.rotation[row].T
            angle = float(np.linalg.norm(vector_from_matrix(turn)))
            fits = squares[1] - squares[0] < self._limit[1] and angle > LINEAR_RAD
            out[row] = fits and not _excludes(prediction, row, second, self._limit[3])
        return out

    def _start(
        self,
        exposure: IntersectedViews,
        points: ImagePoints,
        rows: NDArray[np.int64],
        pose: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]],
    ) -> bool:
        """Start bodies at points in space; return whether any body has enough of them.

        pose: rotations, centres, and whether (B,) they are known; modified in place.
        """
        if not len(rows):
            return False
        rotation, centre, started = pose
        xyz = self.cameras.places(exposure)
        seen = np.isfinite(xyz).all(axis=2) & (points.seen.sum(axis=2) > 1)
        solvable = rows[np.count_nonzero(seen[rows], axis=1) >= 3]
        for row in solvable.tolist():
            markers = seen[row]
            rotation[row], centre[row] = robust_pose(self.xyz[row, markers], xyz[row, markers])
            started[row] = True
        return len(solvable) > 0

    def _converge(
        self,
        pose: tuple[NDArray[np.float64], NDArray[np.float64]],
        points: ImagePoints,
        used: NDArray[np.bool_],
        prediction: Prediction | None,
    ) -> _Solution:
        """Iterate from given rotations and centres.

        If an exposure alone does not give a pose, the prediction determines what is not observed.
        """
        rotation, centre = pose
        weight = _weight(points, used, points.noise + points.correction)
        for _ in range(MAX_STEPS):
            linear = linear_at(self.cameras, self.xyz, (rotation, centre), points.uv, points.seen)
            marker = self._marker(linear, weight)
            normal, right = _sum(marker, linear.by_pose)
            parts = _eigen(normal)
            alone = _is_determined(parts)
            if prediction is not None and not alone.all():
                prior_normal, prior_step = _pull_of(prediction, (rotation, centre))
                prior_normal = np.where(alone[:, None, None], 0.0, prior_normal)
                normal = normal + prior_normal
                right = right + (prior_normal @ prior_step[:, :, None])[:, :, 0]
                parts = _eigen(normal)
            step = _solved(parts, right)
            centre = centre + step[:, :3]
            rotation = Rotation.from_rotvec(step[:, 3:]).as_matrix() @ rotation
            remaining = ((step * self._share_left) ** 2).sum(axis=1)
            if not (remaining * (step * right).sum(axis=1) > LAST_STEP).any():
                break
        # The derivatives remain valid; only the residuals change by the last step.
        linear = _after(linear, step)
        return _Solution(
            rotation,
            centre,
            alone,
            parts=parts,
            linear=linear,
            marker=self._marker(linear, weight),
        )

    def _marker(self, linear: Linear, weight: NDArray[np.float64]) -> _Marker:
        """Sum the image points of each marker with weights (B, M, F)."""
        s_matrix, s_vector = marker_sums(linear, weight)
        m = np.linalg.inv(EYE_3 + self._variance_3 * s_matrix)
        return _Marker(
            weight,
            s_matrix,
            s_vector,
            _squares(linear, weight),
            m,
            ms_matrix=m @ s_matrix,
            ms_vector=(m @ s_vector[..., None])[..., 0],
        )

    def _false_markers(
        self,
        solution: _Solution,
        observed: tuple[ImagePoints, NDArray[np.bool_]],
        prediction: Prediction,
        test: NDArray[np.float64],
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return rows of bodies with a false marker, and its row in each; fill in the tests.

        observed: image points, and whether (B, M) a marker is used.

        The sum of squares of a body is at least the contribution of any of its markers: most
        bodies need no test of single markers.
        """
        points, used = observed
        marker = solution.marker
        d = solution.linear.by_pose
        transposed = np.swapaxes(d, 2, 3)
        by_marker = transposed @ marker.ms_matrix @ d
        gradient = (transposed @ marker.ms_vector[..., None])[..., 0]
        # Markers are compared with each other only. A prediction that they contradict is no reason
        # to reject them: the body may have been hit.
        normal = by_marker.sum(axis=1)
        squares = _own_squares(marker, self.variance)
        own_step = np.zeros((len(used), 1, POSE_SIZE, 1))
        if not solution.alone.all():
            own_step = _solved(_eigen(normal), gradient.sum(axis=1))[:, None, :, None]
            change = (by_marker @ own_step)[..., 0]
            squares = squares + np.sum((change - 2 * gradient) * own_step[..., 0], axis=-1)
            gradient = gradient - change
        limit = self._limit[2 * points.seen.sum(axis=2) * used]
        suspect = np.flatnonzero((squares.sum(axis=1)[:, None] > limit).any(axis=1))
        if not len(suspect):
            return suspect, suspect
        limit = limit[suspect]
        gradient = gradient[suspect]
        normal_of_others = normal[suspect, None] - by_marker[suspect]
        # A marker that the others do not predict is tested by its own rays only.
        others = _inverse_where_regular(normal_of_others)
        gain = np.sum(gradient * (others @ gradient[..., None])[..., 0], axis=-1)
        excess = np.where(used[suspect], (squares[suspect] + gain) / limit, 0.0)
        if (excess > 1).any():
            own = replace(solution, linear=_after(solution.linear, own_step[:, 0, :, 0]))
            squares_by_rig = _squares_by_rig(self, own, suspect, normal, others)
            excess = np.where(used[suspect], excess - squares_by_rig / limit, 0.0)
        test[suspect] = np.where(used[suspect], excess, test[suspect])
        if not (excess > 1).any():
            return suspect[:0], suspect[:0]
        # If several contradict each other, exclude the one without which the others agree best
        # with each other and with the prediction.
        prior_normal, pose_step = _pull_of(prediction, (solution.rotation, solution.centre))
        prior_normal = prior_normal[suspect]
        pull = (prior_normal @ pose_step[suspect, :, None])[:, None, :, 0] - gradient
        unit, scale = _of_unit_diagonal(normal_of_others + prior_normal[:, None])
        pull = pull / scale
        cofactor = np.linalg.inv(unit + WEAK * EYE_6)
        remaining = squares[suspect] + np.sum(pull * (cofactor @ pull[..., None])[..., 0], axis=-1)
        worst = np.argmax(np.where(excess > 1, remaining, -np.inf), axis=1)
        contradicting = np.flatnonzero((excess > 1).any(axis=1))
        return suspect[contradicting], worst[contradicting]

    def _result(
        self,
        solution: _Solution,
        observed: tuple[ImagePoints, NDArray[np.bool_]],
        prediction: Prediction,
        test: NDArray[np.float64],
        ambiguous: NDArray[np.bool_],
    ) -> FramePoses:
        """Return the poses with their covariances."""
        points, used = observed
        alone = solution.alone
        seen = used.any(axis=1)
        inverse = _inverse(solution.parts, np.asarray(seen))
        noise, fixed, rig_root = _covariances(
            inverse, solution, (points, self.variance), self.cameras
        )
        # A filter treats shape and correction as exact, since their errors are constant.
        linear = solution.linear
        variance = points.noise
        predicted = np.flatnonzero(seen & ~alone)
        if len(predicted):
            turn = turn_of_twists(prediction.rotation[predicted], solution.rotation[predicted])
            expected = turn @ prediction.covariance[predicted] @ np.swapaxes(turn, 1, 2)
            squares = _curvature(linear.by_place[predicted], linear.by_pose[predicted], expected)
            variance = variance.copy()
            variance[predicted] = _variance_of_last(
                variance[predicted], squares, prediction.weak[predicted, None, None]
            )
        s_matrix, s_vector = marker_sums(linear, _weight(points, used, variance))
        transposed = np.swapaxes(linear.by_pose, 2, 3)
        information = (transposed @ s_matrix @ linear.by_pose).sum(axis=1)
        right = (transposed @ s_vector[..., None])[..., 0].sum(axis=1)
        return FramePoses(
            np.where(alone[:, None, None], solution.rotation, np.nan),
            np.where(alone[:, None], solution.centre, np.nan),
            alone=alone,
            ambiguous=ambiguous,
            covariance_noise=np.where(alone[:, None, None], noise, np.nan),
            covariance_fixed=fixed,
            rig_root=rig_root,
            information=PoseInformation(solution.rotation, solution.centre, information, right),
            used=used,
            test=test,
            chi2=np.sum(_own_squares(solution.marker, self.variance), axis=1),
            freedom=2.0 * np.sum(points.seen & used[..., None], axis=(1, 2)) - POSE_SIZE,
        )


def _start_nearby(
    points: ImagePoints,
    prediction: Prediction,
    pose: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]],
) -> NDArray[np.bool_]:
    """Start bodies near which they may be; return which ones (B,).

    They need more coordinates than a pose has, so that a false one is noticed. pose: as in
    `PoseSolver._start`; modified in place.
    """
    rotation, centre, started = pose
    near = np.zeros_like(started)
    if prediction.near is not None:
        near = prediction.near & ~started & (2 * points.seen.sum(axis=(1, 2)) > POSE_SIZE)
        rotation[near] = prediction.rotation[near]
        centre[near] = prediction.centre_mm[near]
        started |= near
    return near


def _excludes(prediction: Prediction, row: int, second: _Solution, limit: float) -> bool:
    """Return whether the prediction of a body excludes a second pose."""
    if not prediction.known[row]:
        return False
    turn = second.rotation[row] @ prediction.rotation[row].T
    w = vector_from_matrix(turn)
    squares = w @ np.linalg.solve(prediction.covariance[row, 3:, 3:], w)
    return bool(squares > limit)


def _after(linear: Linear, step: NDArray[np.float64]) -> Linear:
    """Return image points with the residuals after steps (B, 6) of the poses."""
    shift = (linear.by_pose @ step[:, None, :, None])[:, :, None]
    return replace(linear, residual=linear.residual - (linear.by_place @ shift)[..., 0])


def _squares_by_rig(
    solver: PoseSolver,
    solution: _Solution,
    rows: NDArray[np.int64],
    normal: NDArray[np.float64],
    others: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the parts (S, M) of squares of markers that errors of the rig orientation explain.

    The squares of a marker are a quadratic form Q of the residuals r at the best pose. Errors of
    the orientation, in k directions of unit variance, add B, whose part that the pose absorbs does
    not count. With both, the squares are Q(r, r) - Q(r, B) (I + Q(B, B))^-1 Q(B, r) (Woodbury).

    rows (S,): bodies. normal (B, 6, 6): normal matrices of the poses. others (S, M, 6, 6): inverse
    normal matrices of the other markers, 0 if these do not predict the marker.
    """
    linear = solution.linear
    weight = solution.marker.weight[rows]
    by_place = linear.by_place[rows]
    d = linear.by_pose[rows]
    weighted = np.swapaxes(by_place * weight[..., None, None], 3, 4)
    by_rig = linear.by_orientation()[rows] @ solver.cameras.root  # (S, M, F, 2, k)
    by_marker = np.swapaxes(d, 2, 3) @ solution.marker.m[rows]
    right = (by_marker @ (weighted @ by_rig).sum(axis=2)).sum(axis=1)
    unit, scale = _of_unit_diagonal(normal[rows])
    pose_change = np.linalg.solve(unit + WEAK * EYE_6, right / scale[..., None]) / scale[..., None]
    absorbed = by_place @ (d @ pose_change[:, None])[:, :, None]
    both = np.concatenate([by_rig - absorbed, linear.residual[rows][..., None]], axis=-1)
    place = (weighted @ both).sum(axis=2)
    pose = by_marker @ place
    both = (both * np.sqrt(weight)[..., None, None]).reshape(*weight.shape[:2], -1, both.shape[-1])
    shape = solver.variance[rows][..., None, None] * (solution.marker.m[rows] @ place)
    form = np.swapaxes(both, 2, 3) @ both - np.swapaxes(place, 2, 3) @ shape
    form = form + np.swapaxes(pose, 2, 3) @ others @ pose
    mixed = form[..., :-1, -1:]
    inner = np.eye(form.shape[-1] - 1) + form[..., :-1, :-1]
    return np.asarray((mixed * np.linalg.solve(inner, mixed)).sum(axis=(2, 3)))


def _of_unit_diagonal(
    normal: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Scale normal matrices (..., 6, 6) to unit diagonal; also return the scale (..., 6)."""
    scale = np.sqrt(np.maximum(np.diagonal(normal, axis1=-2, axis2=-1), 1e-12))
    return normal / (scale[..., :, None] * scale[..., None, :]), scale


def _inverse_where_regular(normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return inverses (..., 6, 6) of normal matrices, 0 for matrices that are nearly singular."""
    unit, scale = _of_unit_diagonal(normal)
    regular = (np.linalg.eigvalsh(unit)[..., 0] > WEAK)[..., None, None]
    inverse = np.linalg.inv(np.where(regular, unit, EYE_6))
    return np.where(regular, inverse / (scale[..., :, None] * scale[..., None, :]), 0.0)


def _own_squares(marker: _Marker, variance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the weighted squares (B, M) of each marker, with shape variances (B, M)."""
    shape = variance * np.sum(marker.s_vector * marker.ms_vector, axis=-1)
    return np.maximum(marker.squares - shape, 0.0)


def _variance_of_last(
    noise: NDArray[np.float64], fixed: NDArray[np.float64], number: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the variance of the last of `number` observations that share an error.

    With variance r of their noise and c of the shared error, n observations have the information
    n / (r + n c), and the last one contributes r / ((r + n c) (r + (n - 1) c)) to it.
    """
    return (noise + number * fixed) * (noise + (number - 1) * fixed) / noise


def _curvature(
    by_place: NDArray[np.float64], by_pose: NDArray[np.float64], covariance: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return mean squares (B, M, F) of the nonlinearity of image points, per coordinate.

    If few markers are seen, a rotation is more uncertain than the range in which derivatives are
    valid. Exposures linearised at different rotations would then together seem to observe it, so
    the neglected part counts as noise (second-order filter: Bar-Shalom, Li and Kirubarajan 2001,
    10.3). A twist (s, w) moves a marker p by u = s + w x p and, to second order, w x u / 2. With
    the derivatives a of an image coordinate this is u'[a]x w / 2, whose mean square follows from
    Isserlis' theorem.
    """
    by_turn = covariance[:, None, 3:, :] @ np.swapaxes(by_pose, 2, 3)
    by_move = (by_pose @ covariance[:, None] @ np.swapaxes(by_pose, 2, 3))[:, :, None, None]
    cross = cross_matrix(by_place)  # (B, M, F, 2, 3, 3)
    mixed = cross @ by_turn[:, :, None, None]
    turn_variance = cross @ covariance[:, None, None, None, 3:, 3:] @ np.swapaxes(cross, -1, -2)
    squares = (
        np.trace(mixed, axis1=-2, axis2=-1) ** 2
        + np.trace(turn_variance @ by_move, axis1=-2, axis2=-1)
        + np.trace(mixed @ mixed, axis1=-2, axis2=-1)
    )
    return squares.mean(axis=-1) / 4


def _covariances(
    inverse: NDArray[np.float64],
    solution: _Solution,
    observed: tuple[ImagePoints, NDArray[np.float64]],
    cameras: BodyCameras,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return covariances (B, 6, 6) of poses from noise and constant errors, and the rig's root.

    inverse (B, 6, 6): of the normal matrix. observed: image points, and variances (B, M) of the
    coordinates of the shape.
    """
    points, variance = observed
    marker = solution.marker
    linear = solution.linear
    gain = np.swapaxes(linear.by_pose, 2, 3) @ marker.m  # (B, M, 6, 3)
    weighted = linear.by_place * marker.weight[..., None, None]
    weighted_transposed = np.swapaxes(weighted, 3, 4)
    rows = (*marker.weight.shape[:2], -1, 3)
    by_noise = (weighted * points.noise[..., None, None]).reshape(rows)
    by_correction = (weighted * points.correction[..., None, None]).reshape(rows)
    flat = np.swapaxes(weighted.reshape(rows), 2, 3)
    steady = flat @ by_correction + variance[..., None, None] * (marker.s_matrix @ marker.s_matrix)
    gain_transposed = np.swapaxes(gain, 2, 3)
    noise = inverse @ (gain @ (flat @ by_noise) @ gain_transposed).sum(axis=1) @ inverse
    fixed = inverse @ (gain @ steady @ gain_transposed).sum(axis=1) @ inverse
    by_view = (gain[:, :, None] @ (weighted_transposed @ linear.by_orientation())).sum(axis=1)
    rig_root = -inverse @ (by_view @ cameras.root).sum(axis=1)
    return noise, fixed, rig_root


def _sum(
    marker: _Marker, by_pose: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return normal matrices (B, 6, 6) and right-hand sides (B, 6) of poses."""
    transposed = np.swapaxes(by_pose, 2, 3)
    normal = (transposed @ marker.ms_matrix @ by_pose).sum(axis=1)
    right = (transposed @ marker.ms_vector[..., None])[..., 0].sum(axis=1)
    return (normal + np.swapaxes(normal, 1, 2)) / 2, right


def _weight(
    points: ImagePoints, used: NDArray[np.bool_], variance: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return weights (B, M, F) of image points from variances; 0 for those that are not used."""
    return np.where(used[..., None] & points.seen, 1 / variance, 0.0)


def marker_sums(
    linear: Linear, weight: NDArray[np.float64]
) -> tuple[np.ndarray, NDArray[np.float64]]:
    """Return S (B, M, 3, 3) and s (B, M, 3) of markers."""
    rows = (*weight.shape[:2], -1)
    weighted = np.swapaxes((linear.by_place * weight[..., None, None]).reshape(*rows, 3), 2, 3)
    s_matrix = weighted @ linear.by_place.reshape(*rows, 3)
    return s_matrix, (weighted @ linear.residual.reshape(*rows, 1))[..., 0]


def _squares(linear: Linear, weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return sums r'Wr (B, M) of markers."""
    return ((linear.residual**2).sum(axis=-1) * weight).sum(axis=-1)


class _Eigen(NamedTuple):
    """Eigenvalues (B, 6) and vectors of normal matrices of unit diagonal, and scale (B, 6)."""

    values: NDArray[np.float64]
    vectors: NDArray[np.float64]
    scale: NDArray[np.float64]


def _eigen(normal: NDArray[np.float64]) -> _Eigen:
    scale = np.sqrt(np.maximum(np.diagonal(normal, axis1=1, axis2=2), 1e-30))
    return _Eigen(*np.linalg.eigh(normal / (scale[:, :, None] * scale[:, None, :])), scale)


def _inverse(parts: _Eigen, wanted: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return inverses (B, 6, 6) of the wanted (B,) normal matrices; NaN for the others."""
    values, vectors, scale = parts
    regular = (wanted & (values[:, 0] > SINGULAR))[:, None]
    scaled = vectors / scale[:, :, None]
    divided = scaled / np.where(regular, values, np.nan)[:, None]
    return divided @ np.swapaxes(scaled, 1, 2)


def _is_determined(parts: _Eigen) -> NDArray[np.bool_]:
    """Return whether (B,) normal matrices determine a pose to the validity of derivatives."""
    values = np.maximum(parts.values, SINGULAR)
    variance = (
        np.sum(parts.vectors[:, 3:] ** 2 / values[:, None], axis=2) / parts.scale[:, 3:] ** 2
    )
    return (parts.values[:, 0] > SINGULAR) & (np.max(variance, axis=1) < ALONE_SD_RAD**2)


def _solved(parts: _Eigen, right: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return steps (B, 6); 0 in directions that are not determined."""
    values, vectors, scale = parts
    inverse = np.where(values > 1e-10, 1 / np.maximum(values, 1e-10), 0.0)
    reduced = np.swapaxes(vectors, 1, 2) @ (right / scale)[:, :, None]
    return (vectors @ (inverse[:, :, None] * reduced))[:, :, 0] / scale


def _mirror(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the reflection (3, 3) along a direction (3,)."""
    unit = direction / np.linalg.norm(direction)
    return np.eye(3) - 2 * np.outer(unit, unit)


def _pull_of(
    prediction: Prediction, pose: tuple[NDArray[np.float64], NDArray[np.float64]]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return normal matrices (B, 6, 6) of predictions at poses, and twists (B, 6) to them."""
    normal = np.linalg.inv(prediction.covariance + 1e-12 * EYE_6)
    normal = np.where(prediction.known[:, None, None], normal, 0.0)
    turn = turn_of_twists(prediction.rotation, pose[0])
    twist = twist_between((prediction.rotation, prediction.centre_mm), pose)
    prior_normal = turn @ normal @ np.swapaxes(turn, 1, 2)
    return prior_normal, -(turn @ twist[:, :, None])[:, :, 0]
