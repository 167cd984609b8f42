# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Poses of rigid bodies in one exposure, straight from corrected image points of any views.

Least squares of the image residuals by Gauss-Newton (Foerstner and Wrobel, "Photogrammetric
Computer Vision", Springer 2016, 4.8 and 12.2). An image point of one view counts as one of two
views does. Let the image points of a marker have the derivatives A by its place in space, weights
W and residuals r. About its place they tell S = A'WA and s = A'Wr; a coordinate of the shape that
has a standard deviation x changes this to M S and M s with M = (I + x^2 S)^-1. With the
derivatives D = [I, -[Rx]x] of the place by the pose, the normal equations are

    N = sum D'MSD,  b = sum D'Ms.

Each marker has one test, whether its image points agree with all others (Baarda, "A testing
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
from .body import Body, robust_pose
from .image_points import Cameras, ImagePoints, Linear
from .motion import EYE_3, EYE_6, PoseInformation, turn_of_twists, twist_between

MAX_STEPS = 8  # of Gauss-Newton
# Square of the next step in standard deviations below which the iteration ends. A step of
# Gauss-Newton leaves a share of about its own rotation, and of its shift over the distance.
LAST_STEP = 1e-8  # a ten-thousandth of a standard deviation
# Rotation [rad] up to which derivatives hold: what they neglect of a marker's place is half of its
# square, 0.1 % of the distance from the centre.
LINEAR_RAD = 0.05
# An exposure alone gives a pose if it determines the rotation so that derivatives hold at two
# standard deviations.
ALONE_SD_RAD = LINEAR_RAD / 2
# One below which others do not predict a marker, and with which a matrix is held that may be
# singular: far above rounding, which a constant beside large elements is not.
WEAK = 1e-9


@dataclass(frozen=True)
class Prediction:
    """Poses that are expected: rotations (B, 3, 3), centres (B, 3) [mm], covariances (B, 6, 6).

    known (B,): whether there is one. weak (B,): exposures since one alone gave the pose, with the
    one that is expected.
    """

    rotation: NDArray[np.float64]
    centre_mm: NDArray[np.float64]
    covariance: NDArray[np.float64]
    known: NDArray[np.bool_]
    weak: NDArray[np.int64]


@dataclass(frozen=True)
class FramePoses:
    """Poses of B bodies in one exposure, of the centres of their markers."""

    rotation: NDArray[np.float64]  #: (B, 3, 3) NaN where the exposure alone gives no pose
    centre_mm: NDArray[np.float64]  #: (B, 3)
    alone: NDArray[np.bool_]  #: (B,) whether the exposure alone gives the pose
    #: (B,) whether a second pose fits as well, and the prediction does not tell which is right
    ambiguous: NDArray[np.bool_]
    #: (B, 6, 6) see BodyPoses; where the exposure alone does not give the pose, by its prediction,
    #: too
    covariance_noise: NDArray[np.float64]
    covariance_fixed: NDArray[np.float64]
    rig_root: NDArray[np.float64]  #: (B, 6, k)
    information: PoseInformation  #: for a filter, by the random errors
    used: NDArray[np.bool_]  #: (B, M) markers, by their row in the body
    test: NDArray[np.float64]  #: (B, M) test of a marker over its limit; NaN where it needs none
    #: (B,) weighted sum of squares of the used image points, and its expectation
    chi2: NDArray[np.float64]
    freedom: NDArray[np.float64]

    @property
    def markers(self) -> NDArray[np.int64]:
        """Number (B,) of markers that are used."""
        return self.used.sum(axis=1)


@dataclass(frozen=True)
class _Marker:
    """What markers tell: S, s, r'Wr (B, M), M, and M S, M s."""

    weight: NDArray[np.float64]  # (B, M, F), W
    s_matrix: NDArray[np.float64]
    s_vector: NDArray[np.float64]
    squares: NDArray[np.float64]
    m: NDArray[np.float64]
    ms_matrix: NDArray[np.float64]
    ms_vector: NDArray[np.float64]


@dataclass(frozen=True)
class _Solution:
    """Poses of B bodies, whether (B,) the exposure alone gives them, parts of normal matrices."""

    rotation: NDArray[np.float64]
    centre: NDArray[np.float64]
    alone: NDArray[np.bool_]
    parts: _Eigen
    linear: Linear
    marker: _Marker


class PoseSolver:
    """Poses of bodies for one RigOrientation, built once for all exposures.

    Parameters
    ----------
    orientation : RigOrientation
    bodies : sequence of Body
        With known places of all markers.
    reject : float
        Standardised deviation above which a marker does not belong to its body; the limit of
        chi-square is the quantile of the same probability.
    """

    def __init__(
        self, orientation: RigOrientation, bodies: Sequence[Body], reject: float = 4.0
    ) -> None:
        self.bodies = tuple(bodies)
        self.orientation = orientation
        most = max(len(body.target_id) for body in bodies)
        shape = (len(bodies), most)
        self.target_id = np.full(shape, -1)
        self.centre = np.array([body.centre for body in bodies])
        self.xyz = np.zeros((*shape, 3))
        self.variance = np.zeros(shape)
        for row, body in enumerate(bodies):
            count = len(body.target_id)
            self.target_id[row, :count] = body.target_id
            self.xyz[row, :count] = body.xyz_mm - self.centre[row]
            self.variance[row, :count] = body.sd_mm**2
        self._variance_3 = self.variance[..., None, None]
        self.cameras = Cameras(orientation, self.target_id)
        # Of each element of a step, how much of it the next one is about.
        source = orientation.position_mm
        far = np.linalg.norm(source - source.mean(axis=0), axis=1).max()
        self._share_left = np.repeat([1 / max(far, 1.0), 1.0], 3)
        tail = erfc(reject / np.sqrt(2))
        freedom = np.arange(max(2 * len(orientation.fluoroscopes), 3) + 1)
        self._limit = np.where(freedom > 0, chdtri(np.maximum(freedom, 1), tail), np.inf)

    def solve(self, exposure: IntersectedViews, prediction: Prediction) -> FramePoses:
        """Solve for the poses of one exposure; the views are those of the orientation."""
        points = self.cameras.sorted(exposure)
        rotation = np.where(prediction.known[:, None, None], prediction.rotation, np.eye(3))
        centre = np.where(prediction.known[:, None], prediction.centre_mm, 0.0)
        started = prediction.known.copy()
        if not started.all():
            self._start(exposure, points, np.flatnonzero(~started), (rotation, centre, started))
        seen = points.seen.any(axis=2)
        used = seen & started[:, None]
        test = np.full(used.shape, np.nan)
        from_prediction = prediction.known
        # Each body may lose all its markers, one at a time, and is started again once.
        for _ in range(self.xyz.shape[1] + len(self.bodies)):
            solution = self._converge((rotation, centre), points, used, prediction)
            wrong, worst = self._false_markers(solution, (points, used), prediction, test)
            rotation, centre = solution.rotation, solution.centre
            # From a prediction that is far off, as after two stamps that are nearly the same, an
            # iteration may end elsewhere: the points in space tell where to start.
            doubted = ~solution.alone & from_prediction
            doubted[wrong] = from_prediction[wrong]
            again = self._start(
                exposure, points, np.flatnonzero(doubted), (rotation, centre, started)
            )
            from_prediction = from_prediction & ~doubted
            if again:
                test[doubted] = np.nan
                continue
            if not len(wrong):
                break
            used[wrong, worst] = False
        ambiguous = self._ambiguous(solution, points, used, prediction)
        return self._result(solution, (points, used), prediction, test, ambiguous)

    def _ambiguous(
        self, solution: _Solution, points: ImagePoints, used: np.ndarray, prediction: Prediction
    ) -> NDArray[np.bool_]:
        """Whether (B,) a body that one view sees alone fits in a second pose, too.

        Under a weak perspective, markers near a plane look the same when the plane is tilted the
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
            # The centre of these markers stays where it is.
            centre = solution.centre.copy()
            centre[row] += (solution.rotation[row] - rotation[row]) @ markers.mean(axis=0)
            only = used & (np.arange(len(used)) == row)[:, None]
            second = self._converge((rotation, centre), points, only, None)
            squares = [
                _own_squares(one.marker, self.variance)[row].sum() for one in (solution, second)
            ]
            turn = second.rotation[row] @ solution.rotation[row].T
            away = float(np.linalg.norm(vector_from_matrix(turn)))
            fits = squares[1] - squares[0] < self._limit[1] and away > LINEAR_RAD
            out[row] = fits and not _excludes(prediction, row, second, self._limit[3])
        return out

    def _start(
        self,
        exposure: IntersectedViews,
        points: ImagePoints,
        rows: NDArray[np.int64],
        pose: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]],
    ) -> bool:
        """Start bodies at points in space; returns whether there are enough of any.

        pose: rotations, centres, and whether (B,) there are any; they are changed.
        """
        if not len(rows):
            return False
        rotation, centre, started = pose
        xyz = self.cameras.places(exposure)
        seen = np.isfinite(xyz).all(axis=2) & (points.seen.sum(axis=2) > 1)
        enough = rows[np.count_nonzero(seen[rows], axis=1) >= 3]
        for row in enough.tolist():
            markers = seen[row]
            rotation[row], centre[row] = robust_pose(self.xyz[row, markers], xyz[row, markers])
            started[row] = True
        return len(enough) > 0

    def _converge(
        self,
        pose: tuple[NDArray[np.float64], NDArray[np.float64]],
        points: ImagePoints,
        used: NDArray[np.bool_],
        prediction: Prediction | None,
    ) -> _Solution:
        """Iterate from rotations and centres.

        Where an exposure alone does not give a pose, the prediction holds what is not seen.
        """
        rotation, centre = pose
        weight = _weight(points, used, points.noise + points.correction)
        for _ in range(MAX_STEPS):
            linear = self.cameras.linear(self.xyz, (rotation, centre), points)
            marker = self._marker(linear, weight)
            normal, right = _sum(marker, linear.by_pose)
            parts = _eigen(normal)
            alone = _is_determined(parts)
            if prediction is not None and not alone.all():
                held, away = _pull_of(prediction, (rotation, centre))
                held = np.where(alone[:, None, None], 0.0, held)
                normal = normal + held
                right = right + (held @ away[:, :, None])[:, :, 0]
                parts = _eigen(normal)
            step = _solved(parts, right)
            centre = centre + step[:, :3]
            rotation = Rotation.from_rotvec(step[:, 3:]).as_matrix() @ rotation
            left = ((step * self._share_left) ** 2).sum(axis=1)
            if not (left * (step * right).sum(axis=1) > LAST_STEP).any():
                break
        # The derivatives hold; only the residuals change by the last step.
        moved = (linear.by_pose @ step[:, None, :, None])[:, :, None]
        linear = replace(linear, residual=linear.residual - (linear.by_place @ moved)[..., 0])
        s_vector = _vectors(_weighted(linear, weight), linear.residual)
        marker = replace(
            marker,
            s_vector=s_vector,
            squares=_squares(linear, weight),
            ms_vector=(marker.m @ s_vector[..., None])[..., 0],
        )
        return _Solution(
            rotation,
            centre,
            alone,
            parts=parts,
            linear=linear,
            marker=marker,
        )

    def _marker(self, linear: Linear, weight: NDArray[np.float64]) -> _Marker:
        """Sum up the image points of each marker with weights (B, M, F)."""
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
        """Rows of bodies that contain a false marker, and its row in each; fill in the tests.

        observed: image points, and whether (B, M) a marker is used.

        The sum of squares of a body is at least that which one of its markers adds: most bodies
        need no test of single markers.
        """
        points, used = observed
        marker = solution.marker
        d = solution.linear.by_pose
        transposed = np.swapaxes(d, 2, 3)
        by_marker = transposed @ marker.ms_matrix @ d
        gradient = (transposed @ marker.ms_vector[..., None])[..., 0]
        # Markers are compared with each other. A prediction that they contradict is no reason to
        # reject them: the body may have been hit.
        normal = by_marker.sum(axis=1)
        own = _own_squares(marker, self.variance)
        if not solution.alone.all():
            away = _solved(_eigen(normal), gradient.sum(axis=1))[:, None, :, None]
            change = (by_marker @ away)[..., 0]
            own = own + np.sum((change - 2 * gradient) * away[..., 0], axis=-1)
            gradient = gradient - change
        limit = self._limit[2 * points.seen.sum(axis=2) * used]
        suspect = np.flatnonzero((own.sum(axis=1)[:, None] > limit).any(axis=1))
        if not len(suspect):
            return suspect, suspect
        limit = limit[suspect]
        gradient = gradient[suspect]
        others = normal[suspect, None] - by_marker[suspect]
        # A marker that the others do not predict is tested by its own rays only.
        unit, scale = _of_unit_diagonal(others)
        predicted = np.linalg.eigvalsh(unit)[..., 0] > WEAK
        inverse = np.linalg.inv(np.where(predicted[..., None, None], unit, EYE_6))
        reduced = gradient / scale
        gain = np.sum(reduced * (inverse @ reduced[..., None])[..., 0], axis=-1)
        excess = (own[suspect] + np.where(predicted, gain, 0.0)) / limit
        excess = np.where(used[suspect], excess, 0.0)
        if (excess > 1).any():
            excess = excess / _growth_by_rig(self.cameras, solution, points, normal, suspect)
        test[suspect] = np.where(used[suspect], excess, test[suspect])
        if not (excess > 1).any():
            return suspect[:0], suspect[:0]
        # Of several that contradict each other, the one goes without which the rest agrees best,
        # with the prediction, too.
        held, away = _pull_of(prediction, (solution.rotation, solution.centre))
        held = held[suspect]
        pulled = (held @ away[suspect, :, None])[:, None, :, 0] - gradient
        unit, scale = _of_unit_diagonal(others + held[:, None])
        pulled = pulled / scale
        rest = np.linalg.inv(unit + WEAK * EYE_6)
        left = own[suspect] + np.sum(pulled * (rest @ pulled[..., None])[..., 0], axis=-1)
        worst = np.argmax(np.where(excess > 1, left, -np.inf), axis=1)
        wrong = np.flatnonzero((excess > 1).any(axis=1))
        return suspect[wrong], worst[wrong]

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
        # A filter takes shape and correction as they are: their errors stay.
        linear = solution.linear
        variance = points.noise
        held = np.flatnonzero(seen & ~alone)
        if len(held):
            turned = turn_of_twists(prediction.rotation[held], solution.rotation[held])
            expected = turned @ prediction.covariance[held] @ np.swapaxes(turned, 1, 2)
            squares = _curvature(linear.by_place[held], linear.by_pose[held], expected)
            variance = variance.copy()
            variance[held] = _variance_of_last(
                variance[held], squares, prediction.weak[held, None, None]
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


def _excludes(prediction: Prediction, row: int, second: _Solution, limit: float) -> bool:
    """Whether the prediction of a body excludes a second pose."""
    if not prediction.known[row]:
        return False
    turn = second.rotation[row] @ prediction.rotation[row].T
    w = vector_from_matrix(turn)
    squares = w @ np.linalg.solve(prediction.covariance[row, 3:, 3:], w)
    return bool(squares > limit)


def _growth_by_rig(
    cameras: Cameras,
    solution: _Solution,
    points: ImagePoints,
    normal: NDArray[np.float64],
    rows: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Factor (S, M) of the expected squares of markers by errors of the rig's orientation.

    What the pose takes up of these errors is no part of it. rows (S,): bodies.
    """
    linear = solution.linear
    weight = solution.marker.weight[rows]
    by_place = linear.by_place[rows]
    by_rig = cameras.by_orientation(linear)[rows] @ cameras.root  # (S, M, F, 2, k)
    pulled = (np.swapaxes(by_place * weight[..., None, None], 3, 4) @ by_rig).sum(axis=2)
    d = linear.by_pose[rows]
    right = (np.swapaxes(d, 2, 3) @ solution.marker.m[rows] @ pulled).sum(axis=1)
    unit, scale = _of_unit_diagonal(normal[rows])
    moved = np.linalg.solve(unit + WEAK * EYE_6, right / scale[..., None]) / scale[..., None]
    taken = by_place @ (d @ moved[:, None])[:, :, None]
    squares = np.sum((by_rig - taken) ** 2, axis=(3, 4)) * weight
    return 1 + squares.sum(axis=2) / np.maximum(2 * points.seen[rows].sum(axis=2), 1)


def _of_unit_diagonal(
    normal: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Normal matrices (..., 6, 6) in units in which their diagonal is 1, and these (..., 6)."""
    scale = np.sqrt(np.maximum(np.diagonal(normal, axis1=-2, axis2=-1), 1e-12))
    return normal / (scale[..., :, None] * scale[..., None, :]), scale


def _own_squares(marker: _Marker, variance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weighted sum of squares (B, M) of each marker, its shape having a variance (B, M)."""
    shape = variance * np.sum(marker.s_vector * marker.ms_vector, axis=-1)
    return np.maximum(marker.squares - shape, 0.0)


def _variance_of_last(
    noise: NDArray[np.float64], fixed: NDArray[np.float64], number: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Variance of the last of `number` observations that have an error in common.

    With a variance r of their noise and c of this error, n of them tell n / (r + n c), and the
    last of them adds r / ((r + n c) (r + (n - 1) c)) to this.
    """
    return (noise + number * fixed) * (noise + (number - 1) * fixed) / noise


def _curvature(
    by_place: NDArray[np.float64], by_pose: NDArray[np.float64], covariance: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Mean squares (B, M, F) of what derivatives neglect of image points, per coordinate.

    Where few markers are seen, a turn is unsure by more than derivatives hold for. Exposures that
    are linearised at different turns would seem to see it together, so what is neglected counts
    as noise (second-order filter: Bar-Shalom, Li and Kirubarajan 2001, 10.3). A twist (s, w) moves
    a marker p by u = s + w x p and, to second order, w x u / 2. With the derivatives a of an image
    coordinate this is u'[a]x w / 2, whose mean square follows from Isserlis' theorem.
    """
    by_turn = covariance[:, None, 3:, :] @ np.swapaxes(by_pose, 2, 3)
    by_move = (by_pose @ covariance[:, None] @ np.swapaxes(by_pose, 2, 3))[:, :, None, None]
    cross = cross_matrix(by_place)  # (B, M, F, 2, 3, 3)
    mixed = cross @ by_turn[:, :, None, None]
    turned = cross @ covariance[:, None, None, None, 3:, 3:] @ np.swapaxes(cross, -1, -2)
    squares = (
        np.trace(mixed, axis1=-2, axis2=-1) ** 2
        + np.trace(turned @ by_move, axis1=-2, axis2=-1)
        + np.trace(mixed @ mixed, axis1=-2, axis2=-1)
    )
    return squares.mean(axis=-1) / 4


def _covariances(
    inverse: NDArray[np.float64],
    solution: _Solution,
    observed: tuple[ImagePoints, NDArray[np.float64]],
    cameras: Cameras,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Covariances (B, 6, 6) of poses by noise and by what stays, and the root by the rig.

    inverse (B, 6, 6): of the normal matrix; observed: image points, and variances (B, M) of the
    coordinates of the shape.
    """
    points, variance = observed
    marker = solution.marker
    linear = solution.linear
    gain = np.swapaxes(linear.by_pose, 2, 3) @ marker.m  # (B, M, 6, 3)
    weighted = linear.by_place * marker.weight[..., None, None]
    pulled = np.swapaxes(weighted, 3, 4)
    rows = (*marker.weight.shape[:2], -1, 3)
    by_noise = (weighted * points.noise[..., None, None]).reshape(rows)
    by_correction = (weighted * points.correction[..., None, None]).reshape(rows)
    flat = np.swapaxes(weighted.reshape(rows), 2, 3)
    stays = flat @ by_correction + variance[..., None, None] * (marker.s_matrix @ marker.s_matrix)
    back = np.swapaxes(gain, 2, 3)
    noise = inverse @ (gain @ (flat @ by_noise) @ back).sum(axis=1) @ inverse
    fixed = inverse @ (gain @ stays @ back).sum(axis=1) @ inverse
    by_view = (gain[:, :, None] @ (pulled @ cameras.by_orientation(linear))).sum(axis=1)
    rig_root = -inverse @ (by_view @ cameras.root).sum(axis=1)
    return noise, fixed, rig_root


def _sum(
    marker: _Marker, by_pose: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Normal matrices (B, 6, 6) and right sides (B, 6) of poses."""
    transposed = np.swapaxes(by_pose, 2, 3)
    normal = (transposed @ marker.ms_matrix @ by_pose).sum(axis=1)
    right = (transposed @ marker.ms_vector[..., None])[..., 0].sum(axis=1)
    return (normal + np.swapaxes(normal, 1, 2)) / 2, right


def _weight(
    points: ImagePoints, used: NDArray[np.bool_], variance: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Weights (B, M, F) of image points by their variances; 0 for those that are not used."""
    return np.where(used[..., None] & points.seen, 1 / variance, 0.0)


def marker_sums(
    linear: Linear, weight: NDArray[np.float64]
) -> tuple[np.ndarray, NDArray[np.float64]]:
    """S (B, M, 3, 3) and s (B, M, 3) of markers."""
    weighted = _weighted(linear, weight)
    s_matrix = weighted @ linear.by_place.reshape(*weight.shape[:2], -1, 3)
    return s_matrix, _vectors(weighted, linear.residual)


def _weighted(linear: Linear, weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """A'W (B, M, 3, 2 F) of markers."""
    weighted = linear.by_place * weight[..., None, None]
    return np.swapaxes(weighted.reshape(*weight.shape[:2], -1, 3), 2, 3)


def _vectors(weighted: NDArray[np.float64], residual: NDArray[np.float64]) -> NDArray[np.float64]:
    """Vectors s (B, M, 3) of markers."""
    return (weighted @ residual.reshape(*weighted.shape[:2], -1, 1))[..., 0]


def _squares(linear: Linear, weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums r'Wr (B, M) of markers."""
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
    """Inverses (B, 6, 6) of those normal matrices that are wanted (B,), else NaN."""
    values, vectors, scale = parts
    regular = (wanted & (values[:, 0] > SINGULAR))[:, None]
    scaled = vectors / scale[:, :, None]
    divided = scaled / np.where(regular, values, np.nan)[:, None]
    return divided @ np.swapaxes(scaled, 1, 2)


def _is_determined(parts: _Eigen) -> NDArray[np.bool_]:
    """Whether (B,) normal matrices determine a pose so that derivatives hold about it."""
    values = np.maximum(parts.values, SINGULAR)
    variance = (
        np.sum(parts.vectors[:, 3:] ** 2 / values[:, None], axis=2) / parts.scale[:, 3:] ** 2
    )
    return (parts.values[:, 0] > SINGULAR) & (np.max(variance, axis=1) < ALONE_SD_RAD**2)


def _solved(parts: _Eigen, right: NDArray[np.float64]) -> NDArray[np.float64]:
    """Steps (B, 6); 0 in directions that are not determined."""
    values, vectors, scale = parts
    inverse = np.where(values > 1e-10, 1 / np.maximum(values, 1e-10), 0.0)
    reduced = np.swapaxes(vectors, 1, 2) @ (right / scale)[:, :, None]
    return (vectors @ (inverse[:, :, None] * reduced))[:, :, 0] / scale


def _mirror(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Reflection (3, 3) along a direction (3,)."""
    unit = direction / np.linalg.norm(direction)
    return np.eye(3) - 2 * np.outer(unit, unit)


def _pull_of(
    prediction: Prediction, pose: tuple[NDArray[np.float64], NDArray[np.float64]]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Normal matrices (B, 6, 6) of predictions at poses, and twists (B, 6) to the predictions."""
    normal = np.linalg.inv(prediction.covariance + 1e-12 * EYE_6)
    normal = np.where(prediction.known[:, None, None], normal, 0.0)
    turned = turn_of_twists(prediction.rotation, pose[0])
    away = twist_between((prediction.rotation, prediction.centre_mm), pose)
    held = turned @ normal @ np.swapaxes(turned, 1, 2)
    return held, -(turned @ away[:, :, None])[:, :, 0]
