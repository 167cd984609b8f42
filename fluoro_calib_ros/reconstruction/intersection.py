"""Intersection of rays: points in space from their image points in two or more corrected views.

Maximum likelihood (Hartley and Zisserman, "Multiple View Geometry", 2nd ed., 2004, ch. 12):
weighted least squares of the image residuals by Gauss-Newton, from the linear solution (12.2,
inhomogeneous). Its covariance is by the law of propagation that of the image points and that of
the rig's orientation o together,

    P = X + dP/do do,  dP/do = -(A^T W A)^-1 A^T W B,  A and B the derivatives of the image points
    by P and by o

(Foerstner and Wrobel, "Photogrammetric Computer Vision", Springer 2016, 2.7 and 4.2). Everything
is calculated for all points of a frame at once: a frame has a few dozen points and a millisecond,
and a numpy call costs a microsecond.
"""

from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.special import chdtri, erfc

from ..errors import DataError
from ..photogrammetry.rig_orientation import ORIENTATION_SIZE

# status of a point
OK = 0
OUTSIDE = 1
REJECTED = 2
FAILED = 3
SINGLE_VIEW = 4
STATUS = ('OK', 'OUTSIDE', 'REJECTED', 'FAILED', 'SINGLE_VIEW')  # text of each status
MAX_STEPS = 10
# Square of a step, in standard deviations, after which none is taken: the error shrinks by the
# residual over the principal distance in each, a thousandth, so that what is left is 1e-4 standard
# deviations.
SETTLED = 1e-2
# Determinant of a normal matrix over the cube of its mean diagonal: rays that meet under 1e-4 rad
# are parallel.
MIN_DETERMINANT = 1e-8
_FUNCTIONS = (
    9  # of x, y and 1/Z, of which the derivatives of an image point by T, w, xp, yp, c consist
)
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
    """Points in the rig frame.

    xyz_mm (n, 3); covariance (n, 3, 3) [mm^2] by image points and orientation of the rig;
    covariance_noise (n, 3, 3) by the image points alone (noise and correction), which is that of
    one point against another; residual (n,) RMS of the image residuals [px]; rays (n,) used;
    standardised (n,): the root of the weighted square sum of the residuals over its expectation,
    for two rays the epipolar distance over its standard deviation (sd_total); status (n,) OK,
    OUTSIDE (one of the image points lies beyond the calibrated area), REJECTED (a false match: the
    rays do not meet), FAILED (they are parallel, or meet behind a source) or SINGLE_VIEW (one
    fluoroscope alone sees it, or none); left_out (n,): number of the fluoroscope whose ray was
    thrown out, else -1. But for OK and OUTSIDE coordinates and covariances are NaN.
    """

    xyz_mm: np.ndarray
    covariance: np.ndarray
    covariance_noise: np.ndarray
    residual: np.ndarray
    rays: np.ndarray
    standardised: np.ndarray
    status: np.ndarray
    left_out: np.ndarray

    @property
    def sd_mm(self):
        """Standard deviations (n, 3) of the coordinates [mm]."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))


@dataclass(frozen=True)
class _Solution:
    """IntersectedPoints before the judgement: rays (n,) of each, bad: no intersection."""

    xyz: np.ndarray
    covariance: np.ndarray
    noise: np.ndarray
    residual: np.ndarray
    standardised: np.ndarray
    bad: np.ndarray


class Intersector:
    """Intersection of rays for one RigOrientation, built once for all frames.

    reject: standardised epipolar distance above which two rays do not belong together; None:
    never; with more rays the quantile of chi-square of the same probability, and the one ray
    without which the others agree is left out. Raises DataError for a rig of one fluoroscope,
    ValueError for reject that is not above 0.
    """

    def __init__(self, orientation, reject=4.0):
        if len(orientation.fluoroscopes) < 2:
            raise DataError(
                'rig orientation: a single fluoroscope sees no third dimension, two are needed'
            )
        if reject is not None and not reject > 0:
            raise ValueError(f'reject is a number above 0, not {reject}')
        self.orientation = orientation
        self.reject = reject
        interior = orientation.interior
        count = len(orientation.fluoroscopes)
        camera = np.zeros((count, 3, 3))
        camera[:, 0, 0] = camera[:, 1, 1] = interior[:, 2]
        camera[:, :, 2] = np.column_stack([interior[:, :2], np.ones(count)])
        rows = camera @ orientation.rotation
        shift = -(rows @ orientation.position_mm[:, :, None])[:, :, 0]
        self._count = count
        self._matrix = rows.reshape(-1, 3).T.copy()
        self._shift = shift.reshape(-1)
        self._uv_rows = rows[:, :2]
        self._depth_rows = rows[:, 2:]
        self._point = interior[:, :2]
        self._distance = interior[:, 2:]
        depth = _depth_of_axes(orientation)
        self._start_rows = rows / depth[:, None, None], shift / depth[:, None]
        self._by_orientation = _through(
            _derivative_functions(orientation), orientation.covariance_root()
        )
        self._limit = _limits(np.inf if reject is None else float(reject), count)

    def intersect(self, uv, sigma, outside=None):
        """IntersectedPoints of corrected image points uv (F, n, 2) [px] with standard deviations
        sigma (F, n) of their coordinates [px], in the order of the orientation's fluoroscopes; NaN
        where a fluoroscope does not see a point.

        outside (F, n): True for image points beyond the calibrated area; None: there are none.
        Raises ValueError for arrays of other shapes; nothing that the points themselves are
        raises.
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
                f'image points are ({self._count}, n, 2) and sigma ({self._count}, n), '
                f'not {uv.shape} and {sigma.shape}'
            )
        with np.errstate(all='ignore'):
            found = self._intersect(uv.transpose(1, 0, 2), sigma.T**-2.0)
        if outside is not None and np.any(outside):
            used = np.isfinite(sigma) & (np.arange(self._count)[:, None] != found.left_out)
            found.status[(found.status == OK) & (used & outside).any(axis=0)] = OUTSIDE
        return found

    def _intersect(self, uv, weight):
        """IntersectedPoints of image points uv (n, F, 2) of weights (n, F) [1/px^2]; NaN for those
        that are not there.
        """
        seen = np.isfinite(uv.sum(axis=2) + weight)
        rays = seen.sum(axis=1)
        if rays.min(initial=self._count) == self._count:  # the usual frame: nothing to mask
            return self._judged(uv, weight, rays, self._solve(uv, weight, rays))
        uv = np.where(seen[:, :, None], uv, 0.0)
        weight = np.where(seen, weight, 0.0)
        enough = rays >= 2
        found = self._judged(
            uv[enough],
            weight[enough],
            rays[enough],
            self._solve(uv[enough], weight[enough], rays[enough]),
        )
        return found if enough.all() else _scattered(found, enough, rays)

    def _solve(self, uv, weight, rays):
        """_Solution of image points uv (n, F, 2), of weights (n, F) [1/px^2], zero for those that
        are not there.
        """
        n, count = weight.shape
        flat = np.repeat(weight, 2, axis=1)[:, :, None]
        xyz = self._start(uv, flat)
        for _ in range(MAX_STEPS):
            image = (xyz @ self._matrix + self._shift).reshape(n, count, 3)
            depth = image[:, :, 2]
            predicted = image[:, :, :2] / depth[:, :, None]
            a = (
                (self._uv_rows - predicted[:, :, :, None] * self._depth_rows)
                / depth[:, :, None, None]
            ).reshape(n, 2 * count, 3)
            weighted = (a * flat).transpose(0, 2, 1)
            r = (uv - predicted).reshape(n, 2 * count, 1)
            right = weighted @ r
            inverse, determinant = _inverse(weighted @ a)
            step = inverse @ right
            xyz = xyz + step[:, :, 0]
            if not (
                (right * step).sum(axis=1) > SETTLED
            ).any():  # NaN, of rays that do not meet, is no step
                break
        r = r - a @ step
        squares = flat[:, :, 0] * (r * r)[:, :, 0]
        by_image = self._by_image(predicted, depth)
        by_point = (inverse @ weighted) @ by_image
        left = by_image - a @ by_point
        freedom = 2 * rays - 3
        expected = freedom + ((left * left).sum(axis=2) * flat[:, :, 0]).sum(axis=1)
        residual = np.sqrt(((r * r)[:, :, 0] * (flat[:, :, 0] > 0)).sum(axis=1) / (2 * rays))
        bad = ~(np.where(weight > 0, depth, 1.0).min(axis=1, initial=1.0) > 0) | ~(
            determinant > MIN_DETERMINANT
        )
        return _Solution(
            xyz,
            inverse + by_point @ by_point.transpose(0, 2, 1),
            inverse,
            residual,
            np.sqrt(squares.sum(axis=1) / expected),
            bad,
        )

    def _start(self, uv, flat):
        """Linear solution (n, 3) for image points uv (n, F, 2); flat (n, 2F, 1): weights of the
        coordinates.

        (P_1 - u P_3) (X, 1) = 0 and the same of v, with the projection matrices scaled so that a
        point where the axes meet has depth one.
        """
        rows, shift = self._start_rows
        a = (rows[:, :2] - uv[:, :, :, None] * rows[:, 2:]).reshape(-1, 2 * self._count, 3)
        b = (uv * shift[:, 2:] - shift[:, :2]).reshape(-1, 2 * self._count, 1)
        weighted = (a * flat).transpose(0, 2, 1)
        return (_inverse(weighted @ a)[0] @ (weighted @ b))[:, :, 0]

    def _by_image(self, predicted, depth):
        """Derivatives (n, 2F, 9F) of the image points by independent unknowns of the orientation
        of variance one.
        """
        n, count = depth.shape
        functions = np.empty((count, n, _FUNCTIONS))
        xy = ((predicted - self._point) / self._distance).transpose(1, 0, 2)
        near = 1 / depth.T
        functions[:, :, 0] = 1
        functions[:, :, 1:3] = xy
        functions[:, :, 3:5] = xy * xy
        functions[:, :, 5] = xy[:, :, 0] * xy[:, :, 1]
        functions[:, :, 6] = near
        functions[:, :, 7:9] = xy * near[:, :, None]
        return (
            (functions @ self._by_orientation)
            .transpose(1, 0, 2)
            .reshape(n, 2 * count, ORIENTATION_SIZE * count)
        )

    def _judged(self, uv, weight, rays, found):
        """IntersectedPoints of a _Solution: rays that do not agree are thrown out, and points that
        stay in doubt.
        """
        wrong = found.bad | (found.standardised > self._limit[rays])
        left_out = np.full(len(rays), -1)
        if wrong.any():
            again = np.flatnonzero(wrong & (rays > 2))
            if len(again):
                found, left_out[again] = self._without_one(
                    uv[again], weight[again], rays[again], again, found
                )
                rays = rays - (left_out >= 0)
                wrong = wrong & (left_out < 0)
            found = _blanked(found, wrong)
        status = np.where(wrong, np.where(found.bad, FAILED, REJECTED), OK).astype(np.uint8)
        return IntersectedPoints(
            found.xyz,
            found.covariance,
            found.noise,
            found.residual,
            rays,
            found.standardised,
            status,
            left_out,
        )

    def _without_one(self, uv, weight, rays, rows, found):
        """A _Solution in which the points in rows (m,) are, and number (m,) of the ray each does
        without.

        Of image points uv (m, F, 2) every ray is left out in turn. Where the others agree in one
        case alone, that is the solution; where in none or in more, -1: which ray is the false one
        cannot be told.
        """
        m, count = weight.shape
        kept = (weight[:, None, :] * (1 - np.eye(count))).reshape(m * count, count)
        fewer = np.repeat(rays - 1, count)
        tried = self._solve(np.repeat(uv, count, axis=0), kept, fewer)
        agree = (~tried.bad & (tried.standardised <= self._limit[fewer])).reshape(m, count) & (
            weight > 0
        )
        out = np.where(agree.sum(axis=1) == 1, agree.argmax(axis=1), -1)
        settled = np.flatnonzero(out >= 0)
        if not len(settled):
            return found, out
        values = {}
        for field in fields(_Solution):
            values[field.name] = getattr(found, field.name).copy()
            values[field.name][rows[settled]] = getattr(tried, field.name)[
                settled * count + out[settled]
            ]
        return _Solution(**values), out


def _blanked(found, wrong):
    """The _Solution with NaN for what is wrong (n,)."""
    xyz = found.xyz.copy()
    covariance = found.covariance.copy()
    noise = found.noise.copy()
    for value in (xyz, covariance, noise):
        value[wrong] = np.nan
    return replace(found, xyz=xyz, covariance=covariance, noise=noise)


def _scattered(found, enough, rays):
    """IntersectedPoints of all points, of those (n,) that enough fluoroscopes see."""
    n = len(enough)
    out = IntersectedPoints(
        np.full((n, 3), np.nan),
        np.full((n, 3, 3), np.nan),
        np.full((n, 3, 3), np.nan),
        np.full(n, np.nan),
        rays.copy(),
        np.full(n, np.nan),
        np.full(n, SINGLE_VIEW, dtype=np.uint8),
        np.full(n, -1),
    )
    for field in fields(IntersectedPoints):
        getattr(out, field.name)[enough] = getattr(found, field.name)
    return out


def _inverse(normal):
    """Inverse of symmetric matrices (n, 3, 3) by cofactors, and their determinant (n,) over the
    cube of the mean of their diagonal; a singular matrix gives infinite numbers, not an exception.
    """
    flat = normal.reshape(-1, 9)
    one, two, three, four = (flat[:, index] for index in _COFACTORS)
    cofactors = one * two - three * four
    determinant = (flat[:, :3] * cofactors[:, :3]).sum(axis=1)
    mean = (flat[:, 0] + flat[:, 4] + flat[:, 8]) / 3
    return (cofactors / determinant[:, None]).reshape(-1, 3, 3), determinant / mean**3


def _limits(reject, count):
    """Largest standardised misfit (count + 1,) of points of 0, 1, .. rays that agree.

    Q = r^T W r is chi-square with 2 rays - 3 degrees of freedom, and the misfit the root of Q over
    these; two rays have one, and reject is their limit.
    """
    freedom = np.maximum(2.0 * np.arange(count + 1) - 3, 1)
    tail = erfc(reject / np.sqrt(2))
    # So far out that the probability is no number any more, all degrees of freedom come to the
    # same.
    return np.sqrt((chdtri(freedom, tail) if tail > 1e-200 else reject**2) / freedom)


def _depth_of_axes(orientation):
    """Depths (F,) [mm] of the point that is nearest to the axes of all fluoroscopes."""
    axis = orientation.rotation[:, 2]
    across = np.eye(3) - axis[:, :, None] * axis[:, None, :]
    right = (across @ orientation.position_mm[:, :, None]).sum(axis=0)[:, 0]
    point = np.linalg.lstsq(across.sum(axis=0), right)[0]
    depth = np.sum(axis * (point - orientation.position_mm), axis=1)
    return np.where(depth > 0, depth, 1.0)


def _derivative_functions(orientation):
    """Coefficients (F, 9, 2, 9) of the functions 1, x, y, x^2, y^2, xy, 1/Z, x/Z, y/Z (x = X/Z, y
    = Y/Z) in the derivatives of u and v by T, w, xp, yp, c: those of collinearity, multiplied out.
    """
    out = np.zeros((len(orientation.fluoroscopes), _FUNCTIONS, 2, ORIENTATION_SIZE))
    for k, r, c in zip(out, orientation.rotation, orientation.interior[:, 2]):
        k[6, 0, :3] = -c * r[0]
        k[6, 1, :3] = -c * r[1]
        k[7, 0, :3] = k[8, 1, :3] = c * r[2]
        k[5, 0, 3] = -c
        k[0, 0, 4] = c
        k[3, 0, 4] = c
        k[2, 0, 5] = -c
        k[0, 1, 3] = -c
        k[4, 1, 3] = -c
        k[5, 1, 4] = c
        k[1, 1, 5] = c
        k[0, 0, 6] = k[0, 1, 7] = k[1, 0, 8] = k[2, 1, 8] = 1
    return out


def _through(functions, root):
    """Coefficients (F, 9, 18F) of the derivatives by independent unknowns: functions times root
    (9F, 9F).
    """
    count = len(functions)
    out = functions.reshape(count, 2 * _FUNCTIONS, ORIENTATION_SIZE) @ root.reshape(
        count, ORIENTATION_SIZE, -1
    )
    return out.reshape(count, _FUNCTIONS, -1)
