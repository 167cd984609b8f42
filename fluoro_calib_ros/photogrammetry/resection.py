# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Resection: exterior orientation of one exposure from the phantom, without initial values.

The direct linear transformation (Abdel-Aziz and Karara 1971; Hartley and Zisserman, "Multiple View
Geometry", 2nd ed., 2004, 4.1 and 7.1) is computed from random samples. The one with the least
median of squared residuals is selected (Rousseeuw 1984), and refined on all points with robust
weights.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import rq

from ..errors import DataError
from ..findings import too_few
from .collinearity import project, project_with_jacobian
from .noise import Noise
from .rotations import matrix_from_vector

MIN_TARGETS = 8  # two more than the DLT needs
SAMPLE_SIZE = 6  # the DLT has 11 unknowns, and a target gives two equations
PLANE_SAMPLE_SIZE = 4  # a homography has 8 unknowns
SAMPLES = 200  # with 20 % false matches 1 - (1 - 0.8^6)^200: a good sample is certain
# Targets with a smaller ratio of smallest to largest extent are considered to lie in one plane.
MIN_FLATNESS = 1e-2
# Errors of such targets, by the dimension that they should have.
FLATTENED = {
    2: 'all targets are collinear',
    3: 'all targets are coplanar: the principal distance is undetermined',
}
DLT_ITERATIONS = 10
SETTLED_WEIGHTS = 0.02  # change of the robust weights at convergence
NU = 3.0  # degrees of freedom of the Student-t of the robust weights: heavy tails
MIN_VARIANCE = 1e-12  # [px^2], for exact observations
# Damping of the refinement: initial, least and largest value.
START_DAMPING = 1e-4
MIN_DAMPING = 1e-12
MAX_DAMPING = 1e10
MIN_EXTENT_MM = 1e-3
# Relative change of a cost, a redundancy or a distance that rounding errors can cause.
ROUNDING = 1e-9
# Squared step at convergence, in the metric of its normal matrix and noise variance.
TOLERANCE = 1e-4


@dataclass(frozen=True)
class Resection:
    """Exterior orientation of one exposure."""

    rotation: NDArray[np.float64]  #: (3, 3) rotation phantom -> sensor
    position_mm: NDArray[np.float64]  #: (3,) position of the source
    scale: float  #: scale of the residuals [px]
    inliers: NDArray[np.bool_]  #: (n,)


def least_vectors(forms: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unit vectors (..., k) with the least values of quadratic forms (..., k, k)."""
    return np.linalg.eigh(forms)[1][..., 0]


def least_vectors_with_last_one(forms: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return vectors (..., k) with the least values, and one as last component.

    It takes a tenth of the time. The last component of a projection is the depth of the centre of
    the points, which is not zero (Hartley and Zisserman 4.1.2, inhomogeneous solution).
    """
    k = forms.shape[-1] - 1
    # This small addition to the diagonal also solves singular equations.
    ridge = 1e-14 * np.trace(forms, axis1=-2, axis2=-1)[..., None, None] * np.eye(k)
    components = np.linalg.solve(forms[..., :k, :k] + ridge, -forms[..., :k, k:])
    return np.concatenate([components[..., 0], np.ones_like(components[..., :1, 0])], axis=-1)


def direct_linear_transformation(
    xyz: NDArray[np.float64],
    uv: NDArray[np.float64],
    least: Callable[[NDArray[np.float64]], NDArray[np.float64]] = least_vectors,
) -> Callable[[NDArray[np.float64] | None], NDArray[np.float64]]:
    """Return projections (..., 3, k + 1) with uv ~ P (xyz, 1) as a function of the weights.

    xyz (..., n, k), uv (..., n, 2) and weights (..., n), None for equal ones, of n >= 6 points in
    space (k = 3), or n >= 4 in a plane (k = 2). Coordinates are normalised (Hartley and Zisserman,
    algorithms 4.2 and 7.1). least: returns vectors (..., 3 k + 3) that minimise quadratic forms.
    """
    x, to_x = _normalised(xyz)
    u, to_u = _normalised(uv)
    zero = np.zeros_like(x)
    rows = np.concatenate(
        [
            np.concatenate([x, zero, -u[..., :1] * x], axis=-1),
            np.concatenate([zero, x, -u[..., 1:2] * x], axis=-1),
        ],
        axis=-2,
    )
    from_u = np.linalg.inv(to_u)

    def projections(weights: NDArray[np.float64] | None) -> NDArray[np.float64]:
        weighted = rows
        if weights is not None:
            weighted = rows * np.concatenate([weights, weights], axis=-1)[..., None]
        vectors = least(np.swapaxes(rows, -1, -2) @ weighted)
        return from_u @ vectors.reshape(*vectors.shape[:-1], 3, -1) @ to_x

    return projections


def _normalised(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Centre and scale points (..., n, k) to about one.

    Returns homogeneous coordinates (..., n, k + 1) and the transformation (..., k + 1, k + 1).
    """
    k = points.shape[-1]
    mean = points.mean(axis=-2)
    square = np.mean(np.sum((points - mean[..., None, :]) ** 2, axis=-1), axis=-1)
    scale = np.sqrt(k / np.maximum(square, 1e-300))[..., None]
    transformation = np.zeros((*mean.shape[:-1], k + 1, k + 1))
    transformation[..., range(k), range(k)] = scale
    transformation[..., :k, k] = -scale * mean
    transformation[..., k, k] = 1
    homogeneous = np.ones((*points.shape[:-1], k + 1))
    homogeneous[..., :k] = (points - mean[..., None, :]) * scale[..., None]
    return homogeneous, transformation


def decompose(
    projection: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], np.ndarray]:
    """Return calibration matrix (3, 3), rotation (3, 3) and source (3,) of a projection (3, 4).

    The calibration matrix has a positive diagonal and a one in the corner (Hartley and Zisserman
    6.2.4).
    """
    m = projection[:, :3]
    if np.linalg.det(m) < 0:
        projection = -projection
        m = -m
    k, rotation = rq(m)
    sign = np.sign(np.diag(k))
    k = k * sign
    rotation = sign[:, None] * rotation
    return k / k[2, 2], rotation, -np.linalg.solve(m, projection[:, 3])


def squared_residuals(
    projection: NDArray[np.float64], xyz: NDArray[np.float64], uv: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return squared residuals (..., n) of projections (..., 3, 4) or homographies (..., 3, 3).

    They are infinite for points in the plane of the source.
    """
    # Points are on the last axis: a sum over an axis of two would take ten times as long.
    # Arrays of many projections do not fit into the cache: work in place.
    x = projection[..., :-1] @ np.swapaxes(xyz, -1, -2)
    x += projection[..., -1:]
    with np.errstate(divide='ignore', invalid='ignore'):
        u, v = (x[..., axis, :] / x[..., 2, :] - uv[..., axis] for axis in (0, 1))
        u *= u
        v *= v
        u += v
    u[~np.isfinite(u)] = np.inf
    return u


def robust_variance(squared: NDArray[np.float64]) -> float:
    """Return the variance [px^2] of a coordinate by the median of squared residuals (n,)."""
    # The median of chi-square with two degrees of freedom is 2 ln 2.
    return max(np.median(squared) / (2 * np.log(2)), MIN_VARIANCE)


def robust_dlt(xyz: NDArray[np.float64], uv: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the projection (3, k + 1) of targets with up to half false matches.

    xyz (n, 3) in space, or (n, 2) in a plane [mm], and uv (n, 2) [px] of n >= 8 targets. Raises
    DataError if there are too few targets, or if they or their image points are degenerate.
    """
    points = (np.ascontiguousarray(array, dtype=float) for array in (xyz, uv))
    return _robust_dlt(xyz.shape[1], *(array.tobytes() for array in points)).copy()


@lru_cache(maxsize=256)
def _robust_dlt(columns: int, xyz_bytes: bytes, uv_bytes: bytes) -> NDArray[np.float64]:
    """Return `robust_dlt` of the bytes of its arrays: checks and start values need it in turn."""
    xyz = np.frombuffer(xyz_bytes).reshape(-1, columns)
    uv = np.frombuffer(uv_bytes).reshape(-1, 2)
    if len(xyz) < MIN_TARGETS:
        raise DataError(f'{too_few(len(xyz), "target")} for a resection, {MIN_TARGETS} are needed')
    extent = np.linalg.svd(xyz - xyz.mean(axis=0), compute_uv=False)
    if not extent[0] > MIN_EXTENT_MM:
        raise DataError('all targets coincide')
    if extent[-1] < MIN_FLATNESS * extent[0]:
        raise DataError(FLATTENED[len(extent)])
    spread = np.linalg.svd(uv - uv.mean(axis=0), compute_uv=False)
    if spread[1] <= MIN_FLATNESS * spread[0]:
        raise DataError('all image points are collinear or coincide')
    rng = np.random.default_rng(0)
    size = SAMPLE_SIZE if len(extent) == 3 else PLANE_SAMPLE_SIZE
    samples = np.argpartition(rng.random((SAMPLES, len(xyz))), size)[:, :size]
    candidates = direct_linear_transformation(
        xyz[samples], uv[samples], least_vectors_with_last_one
    )(None)
    squared = squared_residuals(candidates, xyz, uv)
    best = squared[np.argmin(np.median(squared, axis=1))]
    weights = np.zeros(len(xyz))
    weighted = direct_linear_transformation(xyz, uv)
    for _ in range(DLT_ITERATIONS):
        last = weights
        weights = Noise(nu=NU).weight(best / robust_variance(best))
        if np.max(np.abs(weights - last)) < SETTLED_WEIGHTS:
            break
        projection = weighted(weights)
        best = squared_residuals(projection, xyz, uv)
    return projection


def robust_p3p(
    xyz: NDArray[np.float64], uv: NDArray[np.float64], interior: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return rotation (3, 3) and position (3,) [mm] of few targets, up to half of them false.

    The first candidate is the solution of three targets (Ke and Roumeliotis, "An efficient
    algebraic solution to the perspective-three-point problem", CVPR 2017) with the least median of
    squared residuals. The solution of the half of the targets that fits it best (SQPnP of Terzakis
    and Lourakis, ECCV 2020) is used instead if it is better. xyz (n, 3), uv (n, 2), interior (3,)
    [px]. Raises DataError if there is no solution.
    """
    rng = np.random.default_rng(0)
    rays = (uv - interior[:2]) / interior[2]
    best: tuple[float, NDArray[np.float64], NDArray[np.float64]] | None = None

    def keep_better(
        turns: Sequence[NDArray[np.float64]], shifts: Sequence[NDArray[np.float64]]
    ) -> None:
        nonlocal best
        for turn, shift in zip(turns, shifts):
            rotation = matrix_from_vector(np.ravel(turn))
            x = xyz @ rotation.T + np.ravel(shift)
            if not (x[:, 2] > 0).all():
                continue
            median = float(np.median(np.sum((x[:, :2] / x[:, 2:] - rays) ** 2, axis=1)))
            if best is None or median < best[0]:
                best = (median, rotation, np.ravel(shift))

    for _ in range(SAMPLES):
        sample = rng.permutation(len(xyz))[:3]
        _, turns, shifts = cv2.solveP3P(
            xyz[sample, None], rays[sample, None], np.eye(3), None, cv2.SOLVEPNP_AP3P
        )
        keep_better(turns, shifts)
    if best is None:
        raise DataError(
            'the image points do not fit the phantom: targets would lie behind the source'
        )
    x = xyz @ best[1].T + best[2]
    nearest = np.argsort(np.sum((x[:, :2] / x[:, 2:] - rays) ** 2, axis=1))[
        : (len(xyz) + 1) // 2 + 1
    ]
    if len(nearest) >= 3:
        _, turns, shifts, _ = cv2.solvePnPGeneric(
            xyz[nearest, None], rays[nearest, None], np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP
        )
        keep_better(turns, shifts)
    _, rotation, shift = best
    return rotation, -rotation.T @ shift


def principal_distance_of(projection: NDArray[np.float64]) -> float:
    """Return principal distance [px] of a projection (3, 4): geometric mean of its scales."""
    k, _, _ = decompose(projection)
    return float(np.sqrt(abs(k[0, 0] * k[1, 1])))


def resect(
    xyz: NDArray[np.float64],
    uv: NDArray[np.float64],
    interior: NDArray[np.float64],
    projection: NDArray[np.float64] | None = None,
    tolerance: float = TOLERANCE,
) -> Resection:
    """Return the exterior orientation of one exposure for a given interior orientation.

    The result is robust to false matches.

    Parameters
    ----------
    xyz : (n, 3) ndarray
        Targets [mm].
    uv : (n, 2) ndarray
        Their image points [px].
    interior : (3,) ndarray
        xp, yp, c [px].
    projection : (3, 4) ndarray, optional
        Result of robust_dlt; computed by default.
    tolerance : float
        Squared step at convergence, in standard deviations.

    Raises
    ------
    DataError
        As robust_dlt, and if no orientation with the targets in front of the source is found.
    """
    projection = robust_dlt(xyz, uv) if projection is None else projection
    start = _start_orientation(projection, xyz, uv, interior)
    return refine_resection(xyz, uv, interior, *start, tolerance)


def refine_resection(
    xyz: NDArray[np.float64],
    uv: NDArray[np.float64],
    interior: NDArray[np.float64],
    rotation: NDArray[np.float64],
    position: NDArray[np.float64],
    tolerance: float = TOLERANCE,
) -> Resection:
    """Refine the exterior orientation of one exposure from initial values (3, 3) and (3,) [mm].

    The other arguments and the errors are those of `resect`.
    """
    problem = _Problem(xyz, uv, interior)
    mu = START_DAMPING
    for _ in range(100):  # a few are enough
        system = problem.linearise(rotation, position)
        rotation, position, step, mu = _damped_step(problem, system, rotation, position, mu)
        if step @ system.normal @ step <= tolerance * system.noise.scale**2:
            break
    noise = system.noise
    return Resection(
        rotation, position, noise.scale, noise.inliers(system.squared / noise.scale**2)
    )


def resection_at(
    rotation: NDArray[np.float64],
    position: NDArray[np.float64],
    xyz: NDArray[np.float64],
    uv: NDArray[np.float64],
    interior: NDArray[np.float64],
) -> Resection:
    """Return a known exterior orientation with the scale and inliers of its residuals.

    Targets that would lie behind the source are outliers. The other arguments are those of
    `resect`.
    """
    squared = _Problem(xyz, uv, interior).squared_residuals(rotation, position)
    squared = np.where(np.isfinite(squared), squared, np.inf)
    scale = float(np.sqrt(robust_variance(squared)))
    return Resection(rotation, position, scale, Noise(nu=NU).inliers(squared / scale**2))


@dataclass(frozen=True)
class _System:
    """Normal equations of the exterior orientation, with the noise model of their weights."""

    normal: NDArray[np.float64]
    right: NDArray[np.float64]
    squared: NDArray[np.float64]
    noise: Noise


@dataclass(frozen=True)
class _Problem:
    """Targets (n, 3) [mm] and image points (n, 2) [px] of one exposure, and xp, yp, c [px]."""

    xyz: NDArray[np.float64]
    uv: NDArray[np.float64]
    interior: NDArray[np.float64]

    def linearise(self, rotation: NDArray[np.float64], position: NDArray[np.float64]) -> _System:
        """Return robust normal equations. Raises DataError for a target behind the source."""
        predicted, jacobian, _, _ = project_with_jacobian(
            rotation, position, self.xyz, self.interior
        )
        r = self.uv - predicted
        if not np.isfinite(r).all():
            raise DataError(
                'the image points do not fit the phantom: targets would lie behind the source'
            )
        squared = np.sum(r * r, axis=1)
        noise = Noise(nu=NU, scale=float(np.sqrt(robust_variance(squared))))
        w = noise.weight(squared / noise.scale**2)
        jacobian = jacobian.reshape(-1, 6)
        weighted = (np.repeat(w, 2)[:, None] * jacobian).T
        return _System(weighted @ jacobian, weighted @ r.ravel(), squared, noise)

    def squared_residuals(
        self, rotation: NDArray[np.float64], position: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return squared residuals (n,) [px^2]; NaN behind the source."""
        predicted = project(rotation, position, self.xyz, self.interior)
        return np.sum((self.uv - predicted) ** 2, axis=1)


def _damped_step(
    problem: _Problem,
    system: _System,
    rotation: NDArray[np.float64],
    position: NDArray[np.float64],
    mu: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], np.ndarray, float]:
    """Return the orientation after a step that does not increase the cost.

    Also returns step (6,) and damping. Without such a step, nothing moves and the step is zero.
    """
    noise = system.noise
    sigma = np.ones(len(problem.xyz))
    cost = noise.cost(system.squared / noise.scale**2, sigma)
    while mu <= MAX_DAMPING:
        damped = system.normal + mu * np.diag(np.diag(system.normal))
        step = np.linalg.solve(damped, system.right)
        new_rotation = matrix_from_vector(step[3:]) @ rotation
        new_position = position + step[:3]
        squared = problem.squared_residuals(new_rotation, new_position)
        if noise.cost(squared / noise.scale**2, sigma) <= cost + ROUNDING * abs(cost):
            return new_rotation, new_position, step, max(mu / 10, MIN_DAMPING)
        mu *= 10
    return rotation, position, np.zeros(6), mu


def _start_orientation(
    projection: NDArray[np.float64],
    xyz: NDArray[np.float64],
    uv: NDArray[np.float64],
    interior: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return rotation (3, 3) and position (3,) by a projection matrix and interior orientation.

    The projection matrix has its own principal distance. The ratio of distance and principal
    distance is preserved, so that the image scale does not change. Then the sensor is rotated
    about the source until the centre of the targets is imaged at the median image point.
    """
    k, rotation, position = decompose(projection)
    xp, yp, c = interior
    centre = xyz.mean(axis=0)
    position = centre + (position - centre) * c / np.sqrt(k[0, 0] * k[1, 1])
    pixel = np.median(uv, axis=0)
    current = rotation @ (centre - position)
    target = np.array([(pixel[0] - xp) / c, (pixel[1] - yp) / c, 1.0])
    current = current / np.linalg.norm(current)
    target = target / np.linalg.norm(target)
    axis = np.cross(current, target)
    sine = np.linalg.norm(axis)
    if sine < 1e-12:
        return rotation, position
    angle = np.arctan2(sine, current @ target)
    return matrix_from_vector(axis / sine * angle) @ rotation, position
