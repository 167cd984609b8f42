# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Intersection of rays: points in space from image points in two or more corrected views.

The points are maximum likelihood estimates (Hartley and Zisserman, "Multiple View Geometry", 2nd
ed., 2004, ch. 12): weighted least squares of the image residuals by Gauss-Newton, started from the
linear solution (12.2, inhomogeneous). The covariance is propagated jointly from the image points
and the orientation o of the rig,

    P = X + dP/do do,  dP/do = -(A^T W A)^-1 A^T W B,

where A and B are the derivatives of the image points by P and by o (Foerstner and Wrobel,
"Photogrammetric Computer Vision", Springer 2016, 2.7 and 4.2). Everything is calculated for all
points of a frame at once: a frame has a few dozen points and must take less than a millisecond,
and each numpy call costs a microsecond.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtri, erfc

from ..errors import DataError
from ..photogrammetry.noise import ObservedScatter
from ..photogrammetry.rig_orientation import RigOrientation
from .cameras import Cameras


class PointStatus(IntEnum):
    """Status of an intersected point; the values are those of the message ReconstructedPoints."""

    OK = 0
    OUTSIDE = 1  # one of the image points is beyond the calibrated area
    REJECTED = 2  # a false match: the rays do not meet
    FAILED = 3  # the rays are parallel, or meet behind a source
    SINGLE_VIEW = 4  # seen by one fluoroscope, or by none


# Plain integers: numpy compares arrays with them faster than with members of the enumeration.
OK = int(PointStatus.OK)
OUTSIDE = int(PointStatus.OUTSIDE)
REJECTED = int(PointStatus.REJECTED)
FAILED = int(PointStatus.FAILED)
SINGLE_VIEW = int(PointStatus.SINGLE_VIEW)
STATUS_NAMES = tuple(status.name for status in PointStatus)
MAX_STEPS = 10
# Square of a step, in standard deviations, below which the iteration ends. A step reduces the
# error by the residual over the principal distance, a thousandth, so 1e-4 standard deviations
# remain.
MAX_LAST_STEP = 1e-2
# Minimum determinant of a normal matrix over the cube of its mean diagonal: rays that meet at less
# than 1e-4 rad count as parallel.
MIN_DETERMINANT = 1e-8
_COFACTORS = np.array(
    [
        [4, 5, 3, 7, 8, 6, 1, 2, 0],
        [8, 6, 7, 2, 0, 1, 5, 3, 4],
        [5, 3, 4, 8, 6, 7, 2, 0, 1],
        [7, 8, 6, 1, 2, 0, 4, 5, 3],
    ]
)


@dataclass(frozen=True)
class IntersectedPoints:
    """Intersected points in the rig frame.

    Coordinates and covariances are NaN unless the status is OK or OUTSIDE.
    """

    xyz_mm: NDArray[np.float64]  #: (n, 3)
    #: (n, 3, 3) from the image points and the orientation of the rig [mm^2]
    covariance: NDArray[np.float64]
    #: (n, 3, 3) from the image points alone, that is from noise and correction [mm^2]; use it for
    #: positions of points relative to each other
    covariance_noise: NDArray[np.float64]
    residual: NDArray[np.float64]  #: (n,) RMS of the image residuals [px]
    rays: NDArray[np.int64]  #: (n,) number of rays used
    #: (n,) root of the weighted sum of squared residuals over its expectation; for two rays, the
    #: epipolar distance over its standard deviation (sd_total)
    standardised: NDArray[np.float64]
    status: NDArray[np.uint8]  #: (n,) PointStatus as uint8
    #: (n,) index of the fluoroscope whose ray was dropped as false, else -1
    dropped_view: NDArray[np.int64]

    @property
    def sd_mm(self) -> NDArray[np.float64]:
        """Standard deviations (n, 3) of the coordinates [mm]."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))


class Intersector:
    """Intersection of rays for one RigOrientation, built once for all frames.

    orientation: of two or more fluoroscopes. reject: standardised epipolar distance above which
    two rays do not belong together; None accepts all. With more rays, the limit is the chi-square
    quantile of the same probability, and a ray is dropped if the others agree without it. If the
    points of a recording scatter more than stated, the limit is wider. Raises DataError for a rig
    of one fluoroscope, and ValueError if reject is not above 0.
    """

    def __init__(self, orientation: RigOrientation, reject: float | None = 4.0) -> None:
        if len(orientation.fluoroscopes) < 2:
            raise DataError(
                'rig orientation: a single fluoroscope sees no third dimension, two are needed'
            )
        if reject is not None and not reject > 0:
            raise ValueError(f'reject must be above 0, not {reject}')
        self.orientation = orientation
        self.reject = reject
        count = len(orientation.fluoroscopes)
        self._count = count
        self._cameras = Cameras(orientation)
        depth = _depth_of_axes(orientation)
        self._start_rows = self._cameras.rows / depth[:, None, None]
        self._start_shift = self._cameras.shift / depth[:, None]
        self._limit = largest_lack_of_fit(np.inf if reject is None else float(reject), count)
        self._median = _medians(count)

    def intersect(
        self,
        uv: ArrayLike,
        sigma: ArrayLike,
        outside: ArrayLike | None = None,
        scatter: ObservedScatter | None = None,
    ) -> IntersectedPoints:
        """Intersect the rays of n points.

        Parameters
        ----------
        uv : array_like
            (F, n, 2), corrected pixels in the order of the orientation's fluoroscopes, NaN where a
            fluoroscope does not see a point.
        sigma : array_like
            (F, n), standard deviations of the coordinates [px]; a coordinate with an infinite one
            counts as not seen.
        outside : array_like, optional
            (F, n), True for image points beyond the calibrated area.
        scatter : ObservedScatter, optional
            Scatter of the recording, which is updated with these points. It widens the limit.

        Raises
        ------
        ValueError
            For arrays of unexpected shape. Values of the points never raise; see PointStatus.
        """
        uv = np.asarray(uv, dtype=float)
        sigma = np.asarray(sigma, dtype=float)
        if (
            uv.ndim != 3
            or uv.shape[0] != self._count
            or uv.shape[2] != 2
            or sigma.shape != uv.shape[:2]
        ):
            raise ValueError(
                f'image points must be ({self._count}, n, 2) and sigma ({self._count}, n), '
                f'not {uv.shape} and {sigma.shape}'
            )
        with np.errstate(all='ignore'):
            weight = sigma.T**-2.0
            points = self._intersect(uv.transpose(1, 0, 2), weight, scatter)
        if outside is not None and np.any(outside):
            used = (weight.T > 0) & (np.arange(self._count)[:, None] != points.dropped_view)
            points.status[(points.status == OK) & (used & outside).any(axis=0)] = OUTSIDE
        return points

    def _intersect(
        self, uv: NDArray[np.float64], weight: NDArray[np.float64], scatter: ObservedScatter | None
    ) -> IntersectedPoints:
        """Intersect image points uv (n, F, 2), NaN where unseen.

        weight (n, F) [1/px^2]: NaN or 0 where unseen.
        """
        seen = np.isfinite(uv.sum(axis=2) + weight) & (weight > 0)
        rays = seen.sum(axis=1)
        if rays.min(initial=self._count) == self._count:  # the usual frame needs no masks
            return self._classified(uv, weight, rays, scatter)
        uv = np.where(seen[:, :, None], uv, 0.0)
        weight = np.where(seen, weight, 0.0)
        intersecting = rays >= 2
        points = self._classified(
            uv[intersecting], weight[intersecting], rays[intersecting], scatter
        )
        return points if intersecting.all() else _expanded(points, intersecting, rays)

    def _solve(
        self, uv: NDArray[np.float64], weight: NDArray[np.float64], rays: NDArray[np.int64]
    ) -> tuple[IntersectedPoints, NDArray[np.float64]]:
        """Return the points of image points uv (n, F, 2), with the status OK or FAILED.

        weight (n, F) [1/px^2]: 0 where a point is unseen. rays (n,): number of rays. Also returns
        the part (n,) of the expected squared lack of fit that the orientation of the rig causes.
        """
        n, count = weight.shape
        flat = np.repeat(weight, 2, axis=1)[:, :, None]
        xyz = self._start(uv, flat)
        for _ in range(MAX_STEPS):
            image = self._cameras.image(xyz)
            depth = image[:, :, 2]
            predicted = image[:, :, :2] / depth[:, :, None]
            by_place = self._cameras.by_place(predicted, depth)
            a = by_place.reshape(n, 2 * count, 3)
            weighted = (a * flat).transpose(0, 2, 1)
            r = (uv - predicted).reshape(n, 2 * count, 1)
            right = weighted @ r
            inverse, determinant = _inverse(weighted @ a)
            step = inverse @ right
            xyz = xyz + step[:, :, 0]
            # NaN, for rays that do not meet, does not prolong the iteration.
            if not ((right * step).sum(axis=1) > MAX_LAST_STEP).any():
                break
        r = r - a @ step
        squares = flat[:, :, 0] * (r * r)[:, :, 0]
        by_rig = self._cameras.by_orientation(predicted, by_place) @ self._cameras.root
        by_rig = by_rig.reshape(n, 2 * count, by_rig.shape[-1])
        by_point = (inverse @ weighted) @ by_rig
        by_residual = by_rig - a @ by_point
        freedom = 2 * rays - 3
        expected = freedom + ((by_residual * by_residual).sum(axis=2) * flat[:, :, 0]).sum(axis=1)
        residual = np.sqrt(((r * r)[:, :, 0] * (flat[:, :, 0] > 0)).sum(axis=1) / (2 * rays))
        in_front = np.where(weight > 0, depth, 1.0).min(axis=1, initial=1.0) > 0
        failed = ~in_front | ~(determinant > MIN_DETERMINANT)
        points = IntersectedPoints(
            xyz,
            inverse + by_point @ by_point.transpose(0, 2, 1),
            covariance_noise=inverse,
            residual=residual,
            rays=rays,
            standardised=np.sqrt(squares.sum(axis=1) / expected),
            status=np.where(failed, FAILED, OK).astype(np.uint8),
            dropped_view=np.full(n, -1),
        )
        return points, 1 - freedom / expected

    def _start(self, uv: NDArray[np.float64], flat: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the linear solution (n, 3) for image points uv (n, F, 2).

        flat (n, 2F, 1): weights of the coordinates. It solves (P_1 - u P_3) (X, 1) = 0, and
        likewise for v, with the projection matrices scaled so that a point where the axes meet has
        depth one.
        """
        rows, shift = self._start_rows, self._start_shift
        a = (rows[:, :2] - uv[:, :, :, None] * rows[:, 2:]).reshape(-1, 2 * self._count, 3)
        b = (uv * shift[:, 2:] - shift[:, :2]).reshape(-1, 2 * self._count, 1)
        weighted = (a * flat).transpose(0, 2, 1)
        return (_inverse(weighted @ a)[0] @ (weighted @ b))[:, :, 0]

    def _classified(
        self,
        uv: NDArray[np.float64],
        weight: NDArray[np.float64],
        rays: NDArray[np.int64],
        scatter: ObservedScatter | None,
    ) -> IntersectedPoints:
        """Return the points with their status; drop false rays if the others agree."""
        points, by_rig = self._solve(uv, weight, rays)
        failed = points.status == FAILED
        limit = self._limit
        if scatter is not None and self.reject is not None:
            size = np.where(failed, np.nan, points.standardised) / self._median[rays]
            scatter.add(size, by_rig, limit[2] / self._median[2])
            limit = scatter.factor * limit
        is_wrong = failed | (points.standardised > limit[rays])
        if not is_wrong.any():
            return points
        rows = np.flatnonzero(is_wrong & (rays > 2))
        if len(rows):
            points = self._without_false_rays(uv[rows], weight[rows], points, rows, limit)
            is_wrong = is_wrong & (points.dropped_view < 0)
        unknown = np.where(is_wrong, np.nan, 1.0)[:, None]
        return replace(
            points,
            xyz_mm=points.xyz_mm * unknown,
            covariance=points.covariance * unknown[..., None],
            covariance_noise=points.covariance_noise * unknown[..., None],
            status=np.where(is_wrong & (points.status == OK), REJECTED, points.status),
        )

    def _without_false_rays(
        self,
        uv: NDArray[np.float64],
        weight: NDArray[np.float64],
        points: IntersectedPoints,
        rows: NDArray[np.int64],
        limit: NDArray[np.float64],
    ) -> IntersectedPoints:
        """Replace points by those without their false rays.

        Each ray of the image points uv (m, F, 2) of the points in rows (m,) is dropped in turn. If
        the remaining rays agree in exactly one case, that case is the solution. Otherwise the
        false ray cannot be identified. limit (F + 1,): maximum lack of fit by the number of rays.
        """
        m, count = weight.shape
        remaining = (weight[:, None, :] * (1 - np.eye(count))).reshape(m * count, count)
        remaining_rays = np.repeat(points.rays[rows] - 1, count)
        candidates, _ = self._solve(np.repeat(uv, count, axis=0), remaining, remaining_rays)
        agree = (candidates.status == OK) & (candidates.standardised <= limit[remaining_rays])
        agree = agree.reshape(m, count) & (weight > 0)
        identified = np.flatnonzero(agree.sum(axis=1) == 1)
        dropped = agree[identified].argmax(axis=1)
        candidates = replace(candidates, dropped_view=np.tile(np.arange(count), m))
        values = {}
        for field in fields(points):
            values[field.name] = getattr(points, field.name).copy()
            chosen = getattr(candidates, field.name)[identified * count + dropped]
            values[field.name][rows[identified]] = chosen
        return IntersectedPoints(**values)


def _expanded(
    intersected: IntersectedPoints, enough: NDArray[np.bool_], rays: NDArray[np.int64]
) -> IntersectedPoints:
    """Return the points of all n targets, given those that enough (n,) fluoroscopes see."""
    unknown = {'rays': rays, 'status': SINGLE_VIEW, 'dropped_view': -1}
    values = {}
    for field in fields(IntersectedPoints):
        value = getattr(intersected, field.name)
        values[field.name] = np.empty((len(enough), *value.shape[1:]), dtype=value.dtype)
        values[field.name][:] = unknown.get(field.name, np.nan)
        values[field.name][enough] = value
    return IntersectedPoints(**values)


def _inverse(normal: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the inverses of symmetric matrices (n, 3, 3), computed by cofactors.

    Also returns their determinants (n,) over the cube of the mean of their diagonals. A singular
    matrix yields non-finite numbers, not an exception.
    """
    flat = normal.reshape(-1, 9)
    first, second, third, fourth = (flat[:, index] for index in _COFACTORS)
    cofactors = first * second - third * fourth
    determinant = (flat[:, :3] * cofactors[:, :3]).sum(axis=1)
    mean = (flat[:, 0] + flat[:, 4] + flat[:, 8]) / 3
    return (cofactors / determinant[:, None]).reshape(-1, 3, 3), determinant / mean**3


def largest_lack_of_fit(reject: float, count: int) -> NDArray[np.float64]:
    """Return the maximum standardised lack of fit (count + 1,) of points of 0, 1, ... rays.

    Q = r^T W r is chi-square with 2 rays - 3 degrees of freedom, and the lack of fit is the root
    of Q over this number. Two rays have one degree of freedom, and reject is their limit.
    """
    freedom = np.maximum(2.0 * np.arange(count + 1) - 3, 1)
    tail = erfc(reject / np.sqrt(2))
    # If the probability underflows, the degrees of freedom make no difference.
    quantile = chdtri(freedom, tail) if tail > 1e-200 else reject**2
    return np.sqrt(quantile / freedom)


def _medians(count: int) -> NDArray[np.float64]:
    """Return the median standardised lack of fit (count + 1,) of points of 0, 1, ... rays."""
    freedom = np.maximum(2.0 * np.arange(count + 1) - 3, 1)
    return np.sqrt(chdtri(freedom, 0.5) / freedom)


def _depth_of_axes(orientation: RigOrientation) -> NDArray[np.float64]:
    """Return the depths (F,) [mm] of the point nearest to the axes of all fluoroscopes."""
    axis = orientation.rotation[:, 2]
    projector = np.eye(3) - axis[:, :, None] * axis[:, None, :]
    right = (projector @ orientation.position_mm[:, :, None]).sum(axis=0)[:, 0]
    point = np.linalg.lstsq(projector.sum(axis=0), right)[0]
    depth = np.sum(axis * (point - orientation.position_mm), axis=1)
    return np.where(depth > 0, depth, 1.0)
