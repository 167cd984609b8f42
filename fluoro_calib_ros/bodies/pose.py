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
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, chdtri, erfc

from ..photogrammetry.collinearity import project_with_jacobian
from ..photogrammetry.rig_orientation import ORIENTATION_SIZE, RigOrientation
from ..photogrammetry.rotations import cross_matrix, matrix_from_vector
from ..reconstruction.intersection import OK, OUTSIDE
from ..reconstruction.reconstruct import IntersectedViews
from .body import POSE_SIZE, Body
from .motion import PoseInformation
from .rigid import fitted_pose

MAX_STEPS = 8
# Square of a step in standard deviations after which the iteration ends: what remains after a
# Gauss-Newton step is far smaller.
LAST_STEP = 1e-3
# Rotation [rad] up to which derivatives hold: the neglected part of a marker's place is half of its
# square, 0.1 % of its distance from the centre.
LINEAR_RAD = 0.05
# An exposure alone gives a pose if it determines the rotation so that derivatives hold at two
# standard deviations.
ALONE_SD_RAD = LINEAR_RAD / 2


@dataclass(frozen=True)
class Prediction:
    """Poses (B) that are expected: rotation, centre [mm], covariance (6, 6), and whether there is one."""

    rotation: NDArray[np.float64]
    centre_mm: NDArray[np.float64]
    covariance: NDArray[np.float64]
    known: NDArray[np.bool_]


@dataclass(frozen=True)
class FramePoses:
    """Poses of B bodies in one exposure, of the centres of their markers.

    Attributes
    ----------
    rotation : (B, 3, 3) ndarray
        NaN where the exposure alone gives no pose.
    centre_mm : (B, 3) ndarray
    alone : (B,) ndarray of bool
        Whether the exposure alone gives the pose.
    covariance_noise, covariance_fixed : (B, 6, 6) ndarray
        See BodyPoses; of the pose by the exposure alone.
    rig_root : (B, 6, k) ndarray
    information : PoseInformation
        For a filter, by the random errors.
    fixed : (B, 6, 6) ndarray
        Covariance of the errors that stay, of a pose by this information.
    used : (B, M) ndarray of bool
        Markers, by their row in the body.
    test : (B, M) ndarray
        Test of each marker over its limit; NaN for one that is not seen.
    chi2, freedom : (B,) ndarray
        Weighted sum of squares of the used image points, and its expectation.
    """

    rotation: NDArray[np.float64]
    centre_mm: NDArray[np.float64]
    alone: NDArray[np.bool_]
    covariance_noise: NDArray[np.float64]
    covariance_fixed: NDArray[np.float64]
    rig_root: NDArray[np.float64]
    information: PoseInformation
    fixed: NDArray[np.float64]
    used: NDArray[np.bool_]
    test: NDArray[np.float64]
    chi2: NDArray[np.float64]
    freedom: NDArray[np.float64]

    @property
    def markers(self) -> NDArray[np.int64]:
        """Number (B,) of markers that are used."""
        return self.used.sum(axis=1)


@dataclass(frozen=True)
class _Points:
    """Image points of markers (B, M) in views F: uv, variances of noise and of correction, seen."""

    uv: np.ndarray
    noise: np.ndarray
    correction: np.ndarray
    seen: np.ndarray


@dataclass(frozen=True)
class _Linear:
    """Image points at a pose: residuals (B, M, F, 2), derivatives by place and orientation."""

    residual: np.ndarray
    by_place: np.ndarray
    by_orientation: np.ndarray
    by_pose: np.ndarray  # (B, M, 3, 6), derivatives D of places by the pose


@dataclass(frozen=True)
class _Marker:
    """What markers tell: S, s, r'Wr (B, M), M, and M S, M s."""

    s_matrix: np.ndarray
    s_vector: np.ndarray
    squares: np.ndarray
    m: np.ndarray
    ms_matrix: np.ndarray
    ms_vector: np.ndarray


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
        self._views = len(orientation.fluoroscopes)
        self._root = orientation.covariance_root().reshape(self._views, ORIENTATION_SIZE, -1)
        tail = erfc(reject / np.sqrt(2))
        freedom = np.arange(2 * self._views + 1)
        self._limit = np.where(freedom > 0, chdtri(np.maximum(freedom, 1), tail), np.inf)
        self._ids: np.ndarray | None = None
        self._rows = np.zeros(0, dtype=int)

    def solve(self, exposure: IntersectedViews, prediction: Prediction) -> FramePoses:
        """Solve for the poses of one exposure; the views are those of the orientation."""
        points = self._points(exposure)
        rotation, centre, started = self._start(exposure, prediction)
        used = points.seen.any(axis=2) & started[:, None]
        prior = np.where(
            prediction.known[:, None, None],
            np.linalg.inv(prediction.covariance + 1e-12 * np.eye(POSE_SIZE)),
            0.0,
        )
        test = np.full(used.shape, np.nan)
        for _ in range(self.xyz.shape[1]):
            rotation, centre, alone = self._converge((rotation, centre), points, used, prior)
            linear = self._linear(rotation, centre, points)
            marker = self._marker(linear, points, used, points.noise + points.correction)
            current = self._test(
                marker, linear, points, used, np.where(alone[:, None, None], 0, prior)
            )
            test = np.where(used, current, test)
            worst = np.argmax(np.where(used, current, 0), axis=1)
            rows = np.arange(len(worst))
            wrong = np.flatnonzero(np.where(used, current, 0)[rows, worst] > 1)
            if not len(wrong):
                break
            used[wrong, worst[wrong]] = False
        return self._result((rotation, centre, alone), points, used, test, prior)

    def _points(self, exposure: IntersectedViews) -> _Points:
        """Sort the image points of an exposure by bodies and their markers."""
        views = exposure.views
        ids = views.target_id
        if self._ids is None or len(ids) != len(self._ids) or (ids != self._ids).any():
            order = np.argsort(ids)
            found = np.searchsorted(ids[order], self.target_id.ravel())
            rows = order[np.minimum(found, len(ids) - 1)] if len(ids) else found * 0 - 1
            known = (ids[rows] == self.target_id.ravel()) if len(ids) else rows >= 0
            self._rows = np.where(known, rows, len(ids))
            self._ids = ids
        shape = (*self.target_id.shape, self._views)
        # One row more for markers that are not there.
        padded = np.full((self._views, len(ids) + 1, 4), np.nan)
        padded[:, :-1, :2] = views.uv
        padded[:, :-1, 2] = views.sigma
        padded[:, :-1, 3] = views.correction_sd
        dropped = exposure.points.dropped_view
        hit = np.flatnonzero(dropped >= 0)
        padded[dropped[hit].astype(int), hit] = np.nan
        sorted_ = padded[:, self._rows].transpose(1, 0, 2).reshape(*shape, 4)
        seen = np.isfinite(sorted_).all(axis=-1)
        sorted_ = np.where(seen[..., None], sorted_, 0.0)
        total = sorted_[..., 2] ** 2
        correction = np.minimum(sorted_[..., 3] ** 2, 0.99 * total)
        noise = np.where(seen, total - correction, 1.0)
        return _Points(sorted_[..., :2], noise, correction, seen)

    def _start(
        self, exposure: IntersectedViews, prediction: Prediction
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """First rotations and centres, and whether (B,) there are any."""
        rotation = np.where(prediction.known[:, None, None], prediction.rotation, np.eye(3))
        centre = np.where(prediction.known[:, None], prediction.centre_mm, 0.0)
        started = prediction.known.copy()
        missing = np.flatnonzero(~started)
        if len(missing):
            points = exposure.points
            good = np.isin(points.status, (OK, OUTSIDE))
            xyz = np.concatenate([np.where(good[:, None], points.xyz_mm, np.nan), [[np.nan] * 3]])
            xyz = xyz[self._rows].reshape(*self.target_id.shape, 3)
            for row in missing:
                seen = np.isfinite(xyz[row]).all(axis=1)
                if np.count_nonzero(seen) >= 3:
                    rotation[row], centre[row] = fitted_pose(self.xyz[row, seen], xyz[row, seen])
                    started[row] = True
        return rotation, centre, started

    def _converge(
        self,
        pose: tuple[np.ndarray, np.ndarray],
        points: _Points,
        used: np.ndarray,
        prior: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Iterate rotations and centres; also return whether (B,) the exposure alone gives them.

        Where it does not, the prediction of variance prior^-1 holds what is not seen.
        """
        first_rotation, first_centre = rotation, centre = pose
        alone = np.zeros(len(rotation), dtype=bool)
        for _ in range(MAX_STEPS):
            linear = self._linear(rotation, centre, points)
            marker = self._marker(linear, points, used, points.noise + points.correction)
            normal, right = _sum(marker, linear.by_pose)
            alone = _is_determined(normal)
            held = np.where(alone[:, None, None], 0.0, prior)
            away = np.concatenate(
                [
                    first_centre - centre,
                    _small_vector(first_rotation @ np.swapaxes(rotation, 1, 2)),
                ],
                axis=1,
            )
            normal = normal + held
            right = right + (held @ away[:, :, None])[:, :, 0]
            step = _solved(normal, right)
            centre = centre + step[:, :3]
            rotation = matrix_from_vector(step[:, 3:]) @ rotation
            if not (np.sum(step * right, axis=1) > LAST_STEP).any():
                break
        return rotation, centre, alone

    def _linear(self, rotation: np.ndarray, centre: np.ndarray, points: _Points) -> _Linear:
        """Derivatives of all image points at poses."""
        shape = points.seen.shape
        arm = self.xyz @ np.swapaxes(rotation, 1, 2)
        place = arm + centre[:, None]
        count = shape[0] * shape[1]
        orientation = self.orientation
        tiled = np.repeat(place.reshape(-1, 3), self._views, axis=0)
        uv, by_exterior, by_place, by_interior = project_with_jacobian(
            np.tile(orientation.rotation, (count, 1, 1)),
            np.tile(orientation.position_mm, (count, 1)),
            tiled,
            np.tile(orientation.interior, (count, 1)),
        )
        by_pose = np.zeros((*shape[:2], 3, POSE_SIZE))
        by_pose[..., :3] = np.eye(3)
        by_pose[..., 3:] = -cross_matrix(arm)
        residual = points.uv - uv.reshape(*shape, 2)
        good = points.seen & np.isfinite(residual).all(axis=-1)
        return _Linear(
            np.where(good[..., None], residual, 0.0),
            np.where(good[..., None, None], by_place.reshape(*shape, 2, 3), 0.0),
            by_orientation=np.concatenate([by_exterior, by_interior], axis=2).reshape(
                *shape, 2, ORIENTATION_SIZE
            ),
            by_pose=by_pose,
        )

    def _marker(
        self, linear: _Linear, points: _Points, used: np.ndarray, variance: np.ndarray
    ) -> _Marker:
        """Sum up the image points of each marker with weights by a variance (B, M, F)."""
        weight = np.where(used[..., None] & points.seen, 1 / variance, 0.0)
        weighted = (linear.by_place * weight[..., None, None]).reshape(*used.shape, -1, 3)
        transposed = np.swapaxes(weighted, 2, 3)
        s_matrix = transposed @ linear.by_place.reshape(*used.shape, -1, 3)
        residual = linear.residual.reshape(*used.shape, -1, 1)
        s_vector = (transposed @ residual)[..., 0]
        squares = np.sum(np.sum(linear.residual**2, axis=-1) * weight, axis=-1)
        m = np.linalg.inv(np.eye(3) + self.variance[..., None, None] * s_matrix)
        return _Marker(
            s_matrix,
            s_vector,
            squares,
            m,
            ms_matrix=m @ s_matrix,
            ms_vector=(m @ s_vector[..., None])[..., 0],
        )

    def _test(
        self,
        marker: _Marker,
        linear: _Linear,
        points: _Points,
        used: np.ndarray,
        prior: np.ndarray,
    ) -> np.ndarray:
        """Return the test (B, M) of each marker over its limit."""
        d = linear.by_pose
        own = np.swapaxes(d, 2, 3) @ marker.ms_matrix @ d
        normal = own.sum(axis=1) + prior
        others = normal[:, None] - own
        gradient = np.swapaxes(d, 2, 3) @ marker.ms_vector[..., None]
        alone = self._own_squares(marker)
        # A marker that the others do not predict is tested by its own rays only.
        scale = np.sqrt(np.maximum(np.diagonal(others, axis1=2, axis2=3), 1e-12))
        unit = others / (scale[..., :, None] * scale[..., None, :])
        tested = np.linalg.eigvalsh(unit)[..., 0] > 1e-9
        inverse = np.linalg.inv(np.where(tested[..., None, None], unit, np.eye(POSE_SIZE)))
        reduced = gradient[..., 0] / scale
        gain = np.sum(reduced * (inverse @ reduced[..., None])[..., 0], axis=-1)
        squares = alone + np.where(tested, gain, 0.0)
        return squares / self._limit[2 * points.seen.sum(axis=2) * used]

    def _own_squares(self, marker: _Marker) -> np.ndarray:
        """Weighted sum of squares (B, M) of each marker, its shape being unsure."""
        shape = self.variance * np.sum(marker.s_vector * marker.ms_vector, axis=-1)
        return np.maximum(marker.squares - shape, 0.0)

    def _result(
        self,
        pose: tuple[np.ndarray, np.ndarray, np.ndarray],
        points: _Points,
        used: np.ndarray,
        test: np.ndarray,
        prior: np.ndarray,
    ) -> FramePoses:
        """Return the poses with their covariances."""
        rotation, centre, alone = pose
        linear = self._linear(rotation, centre, points)
        total = self._marker(linear, points, used, points.noise + points.correction)
        normal, _ = _sum(total, linear.by_pose)
        noise, fixed, rig_root = self._covariances(
            _inverse(normal, alone), total, linear, points, points.noise + points.correction
        )
        random = self._marker(linear, points, used, points.noise)
        # A filter takes the shape as it is; its errors stay.
        of_noise = np.swapaxes(linear.by_pose, 2, 3)
        information = (of_noise @ random.s_matrix @ linear.by_pose).sum(axis=1)
        right = (of_noise @ random.s_vector[..., None])[..., 0].sum(axis=1)
        held = information + np.where(alone[:, None, None], 0.0, prior)
        unweighted = _Marker(
            random.s_matrix,
            random.s_vector,
            random.squares,
            m=np.broadcast_to(np.eye(3), random.m.shape),
            ms_matrix=random.s_matrix,
            ms_vector=random.s_vector,
        )
        _, filter_fixed, _ = self._covariances(
            _inverse(held, used.any(axis=1)), unweighted, linear, points, points.noise
        )
        return FramePoses(
            np.where(alone[:, None, None], rotation, np.nan),
            np.where(alone[:, None], centre, np.nan),
            alone=alone,
            covariance_noise=noise,
            covariance_fixed=fixed,
            rig_root=rig_root,
            information=PoseInformation(rotation, centre, information, right),
            fixed=filter_fixed,
            used=used,
            test=test,
            chi2=np.sum(self._own_squares(total), axis=1),
            freedom=2.0 * np.sum(points.seen & used[..., None], axis=(1, 2)) - POSE_SIZE,
        )

    def _covariances(
        self,
        inverse: np.ndarray,
        marker: _Marker,
        linear: _Linear,
        points: _Points,
        variance: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Covariances (B, 6, 6) of poses by noise and by what stays, and the root by the rig.

        inverse (B, 6, 6): of the normal matrix; variance (B, M, F): what the weights are made of.
        """
        weight = np.where(points.seen, 1 / variance, 0.0) * (marker.squares[..., None] >= 0)
        weight = weight * (np.trace(marker.s_matrix, axis1=2, axis2=3) > 0)[..., None]
        a = linear.by_place
        gain = np.swapaxes(linear.by_pose, 2, 3) @ marker.m  # (B, M, 6, 3)
        by_noise = np.swapaxes(a, 3, 4) @ a  # (B, M, F, 3, 3)
        of_noise = np.sum(by_noise * (weight**2 * points.noise)[..., None, None], axis=2)
        of_fixed = np.sum(by_noise * (weight**2 * points.correction)[..., None, None], axis=2)
        of_shape = self.variance[..., None, None] * (marker.s_matrix @ marker.s_matrix)
        back = np.swapaxes(gain, 2, 3)
        noise = inverse @ (gain @ of_noise @ back).sum(axis=1) @ inverse
        fixed = inverse @ (gain @ (of_fixed + of_shape) @ back).sum(axis=1) @ inverse
        pulled = np.swapaxes(a * weight[..., None, None], 3, 4) @ np.where(
            points.seen[..., None, None], linear.by_orientation, 0.0
        )
        by_view = (gain[:, :, None] @ pulled).sum(axis=1)  # (B, F, 6, 9)
        rig_root = -inverse @ (by_view @ self._root).sum(axis=1)
        return noise, fixed, rig_root


def misfit_probability(chi2: NDArray[np.float64], freedom: NDArray[np.float64]) -> np.ndarray:
    """Probability of a sum of squares as large as chi2, NaN without redundancy."""
    return np.where(freedom > 0, chdtrc(np.maximum(freedom, 1), chi2), np.nan)


def _sum(marker: _Marker, by_pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normal matrices (B, 6, 6) and right sides (B, 6) of poses."""
    transposed = np.swapaxes(by_pose, 2, 3)
    normal = (transposed @ marker.ms_matrix @ by_pose).sum(axis=1)
    right = (transposed @ marker.ms_vector[..., None])[..., 0].sum(axis=1)
    return (normal + np.swapaxes(normal, 1, 2)) / 2, right


def _scaled(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Matrices of unit diagonal, and the scale (B, 6)."""
    scale = np.sqrt(np.maximum(np.diagonal(normal, axis1=1, axis2=2), 1e-30))
    return normal / (scale[:, :, None] * scale[:, None, :]), scale


def _inverse(normal: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Inverses (B, 6, 6) of those that are wanted (B,), else NaN."""
    unit, scale = _scaled(normal)
    regular = wanted & (np.linalg.eigvalsh(unit)[:, 0] > 1e-11)
    inverse = np.linalg.inv(np.where(regular[:, None, None], unit, np.eye(POSE_SIZE)))
    inverse = inverse / (scale[:, :, None] * scale[:, None, :])
    return np.where(regular[:, None, None], inverse, np.nan)


def _is_determined(normal: np.ndarray) -> np.ndarray:
    """Whether (B,) normal matrices determine a pose so that derivatives hold about it."""
    inverse = _inverse(normal, np.ones(len(normal), dtype=bool))
    variance = np.diagonal(inverse, axis1=1, axis2=2)[:, 3:]
    return np.max(np.where(np.isnan(variance), np.inf, variance), axis=1) < ALONE_SD_RAD**2


def _solved(normal: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Steps (B, 6); 0 in directions that are not determined."""
    unit, scale = _scaled(normal)
    values, vectors = np.linalg.eigh(unit)
    inverse = np.where(values > 1e-10, 1 / np.maximum(values, 1e-10), 0.0)
    reduced = np.swapaxes(vectors, 1, 2) @ (right / scale)[:, :, None]
    return (vectors @ (inverse[:, :, None] * reduced))[:, :, 0] / scale


def _small_vector(rotation: np.ndarray) -> np.ndarray:
    """Rotation vectors (B, 3) of small rotations."""
    skew = (rotation - np.swapaxes(rotation, 1, 2)) / 2
    return np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
