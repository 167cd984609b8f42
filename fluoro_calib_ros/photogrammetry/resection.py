"""Resection: exterior orientation of one exposure from the phantom, without start values.

The direct linear transformation (Abdel-Aziz and Karara 1971; Hartley and Zisserman, "Multiple View
Geometry", 2nd ed., 2004, 7.1 and 6.2) on random samples, the one with the least median of squared
residuals kept (Rousseeuw 1984), refined on all points with robust weights.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import rq

from ..errors import DataError
from .collinearity import project, project_with_jacobian
from .noise import Noise
from .rotations import matrix_from_vector

MIN_TARGETS = 8
SAMPLE_SIZE = 6  # the DLT has 11 unknowns, a target gives two equations
SAMPLES = 200  # with 20 % false matches 1 - (1 - 0.8^6)^200: a good sample is certain
# smallest over largest extent of the targets below which they lie in one plane, but for the survey
FLATNESS = 1e-2


@dataclass(frozen=True)
class Resection:
    """Exterior orientation: rotation (3, 3) phantom -> sensor, position_mm (3,) of the source,
    scale [px] of the residuals, inliers (n,) True or False.
    """

    rotation: np.ndarray
    position_mm: np.ndarray
    scale: float
    inliers: np.ndarray


def direct_linear_transformation(xyz, uv, weights=None):
    """Projection matrices (..., 3, 4) with uv ~ P (xyz, 1), of xyz (..., n, 3), uv (..., n, 2), n
    >= 6.

    Coordinates are normalised (Hartley and Zisserman, algorithm 7.1); weights (..., n) of the
    points.
    """
    mean_x = xyz.mean(axis=-2, keepdims=True)
    mean_u = uv.mean(axis=-2, keepdims=True)
    scale_x = np.sqrt(3 / np.mean(np.sum((xyz - mean_x) ** 2, axis=-1), axis=-1))[..., None, None]
    scale_u = np.sqrt(2 / np.mean(np.sum((uv - mean_u) ** 2, axis=-1), axis=-1))[..., None, None]
    x = (xyz - mean_x) * scale_x
    u = (uv - mean_u) * scale_u
    x1 = np.concatenate([x, np.ones_like(x[..., :1])], axis=-1)
    zero = np.zeros_like(x1)
    rows = np.concatenate(
        [
            np.concatenate([x1, zero, -u[..., :1] * x1], axis=-1),
            np.concatenate([zero, x1, -u[..., 1:] * x1], axis=-1),
        ],
        axis=-2,
    )
    if weights is not None:
        rows = rows * np.sqrt(np.concatenate([weights, weights], axis=-1))[..., None]
    _, vectors = np.linalg.eigh(np.swapaxes(rows, -1, -2) @ rows)
    normalised = vectors[..., 0].reshape(vectors.shape[:-2] + (3, 4))
    to_x = np.zeros(normalised.shape[:-2] + (4, 4))
    to_x[..., range(3), range(3)] = scale_x[..., 0]
    to_x[..., :3, 3] = -(scale_x * mean_x)[..., 0, :]
    to_x[..., 3, 3] = 1
    from_u = np.zeros(normalised.shape[:-2] + (3, 3))
    from_u[..., [0, 1], [0, 1]] = 1 / scale_u[..., 0]
    from_u[..., :2, 2] = mean_u[..., 0, :]
    from_u[..., 2, 2] = 1
    return from_u @ normalised @ to_x


def decompose(projection):
    """Calibration matrix (3, 3), rotation (3, 3) and source (3,) of one projection matrix (3, 4).

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


def _squared_residuals(projection, xyz, uv):
    """Squared residuals (..., n) of projection matrices (..., 3, 4); infinite on the plane of the
    source.
    """
    x = xyz @ np.swapaxes(projection[..., :3], -1, -2) + projection[..., None, :, 3]
    with np.errstate(divide='ignore', invalid='ignore'):
        r = np.sum((x[..., :2] / x[..., 2:] - uv) ** 2, axis=-1)
    return np.where(np.isfinite(r), r, np.inf)


def robust_dlt(xyz, uv, seed=0):
    """Projection matrix (3, 4) of n >= 8 targets xyz (n, 3) [mm] at uv (n, 2) [px], up to half
    false.

    Raises DataError where the targets are too few or lie in one plane.
    """
    if len(xyz) < MIN_TARGETS:
        raise DataError(
            f'{len(xyz)} targets are too few for a resection, {MIN_TARGETS} are needed'
        )
    extent = np.linalg.svd(xyz - xyz.mean(axis=0), compute_uv=False)
    if extent[2] < FLATNESS * extent[0]:
        raise DataError(
            'all targets lie in one plane, from which the principal distance cannot be found'
        )
    rng = np.random.default_rng(seed)
    samples = np.argsort(rng.random((SAMPLES, len(xyz))), axis=1)[:, :SAMPLE_SIZE]
    candidates = direct_linear_transformation(xyz[samples], uv[samples])
    squared = _squared_residuals(candidates, xyz, uv)
    best = squared[np.argmin(np.median(squared, axis=1))]
    for _ in range(10):
        scale2 = max(np.median(best) / (2 * np.log(2)), 1e-12)  # median of chi-square, two degrees
        projection = direct_linear_transformation(xyz, uv, Noise(nu=3.0).weight(best / scale2))
        best = _squared_residuals(projection, xyz, uv)
    return projection


def principal_distance_of(projection):
    """Principal distance [px] of a projection matrix (3, 4): mean of its two scale factors."""
    k, _, _ = decompose(projection)
    return float(np.sqrt(abs(k[0, 0] * k[1, 1])))


def resect(xyz, uv, interior, projection=None, max_steps=100):
    """Exterior orientation of one exposure under a given interior orientation, robust to false
    matches.

    xyz (n, 3) [mm], uv (n, 2) [px], interior (3,) xp, yp, c [px]; projection (3, 4) from
    robust_dlt where it is known already. Returns Resection. Raises DataError as robust_dlt does,
    and where no orientation with the targets in front of the source is found.
    """
    projection = robust_dlt(xyz, uv) if projection is None else projection
    k, rotation, position = decompose(projection)
    # The distance found goes with the principal distance found: keep the ratio, so the image scale
    # stays.
    centre = xyz.mean(axis=0)
    position = centre + (position - centre) * interior[2] / np.sqrt(k[0, 0] * k[1, 1])
    rotation, position = _pointed_at(rotation, position, centre, np.median(uv, axis=0), interior)
    mu = 1e-4
    for _ in range(max_steps):
        predicted, jacobian, _, _ = project_with_jacobian(
            np.broadcast_to(rotation, (len(xyz), 3, 3)),
            np.broadcast_to(position, (len(xyz), 3)),
            xyz,
            interior,
        )
        r = uv - predicted
        if not np.isfinite(r).all():
            raise DataError(
                'the image points do not fit the phantom: targets would lie behind the source'
            )
        squared = np.sum(r * r, axis=1)
        noise = Noise(
            nu=3.0, scale=float(np.sqrt(max(np.median(squared) / (2 * np.log(2)), 1e-12)))
        )
        w = noise.weight(squared / noise.scale**2)
        weighted = (np.repeat(w, 2)[:, None] * jacobian.reshape(-1, 6)).T
        h = weighted @ jacobian.reshape(-1, 6)
        g = weighted @ r.ravel()
        cost = noise.cost(squared / noise.scale**2, np.ones(len(xyz)))
        while True:
            step = np.linalg.solve(h + mu * np.diag(np.diag(h)), g)
            moved = matrix_from_vector(step[3:]) @ rotation, position + step[:3]
            squared_new = np.sum((uv - project(moved[0], moved[1], xyz, interior)) ** 2, axis=1)
            if noise.cost(squared_new / noise.scale**2, np.ones(len(xyz))) <= cost + 1e-9 * abs(
                cost
            ):
                mu = max(mu / 10, 1e-12)
                break
            mu *= 10
            if mu > 1e10:
                moved = (rotation, position)
                step = np.zeros(6)
                break
        rotation, position = moved
        if step @ h @ step <= 1e-4 * noise.scale**2:
            break
    return Resection(rotation, position, noise.scale, noise.inliers(squared / noise.scale**2))


def _pointed_at(rotation, position, centre, pixel, interior):
    """The orientation turned about the source until the centre of the targets falls on its pixel."""
    there = rotation @ (centre - position)
    wanted = np.array(
        [(pixel[0] - interior[0]) / interior[2], (pixel[1] - interior[1]) / interior[2], 1.0]
    )
    there = there / np.linalg.norm(there)
    wanted = wanted / np.linalg.norm(wanted)
    axis = np.cross(there, wanted)
    sine = np.linalg.norm(axis)
    if sine < 1e-12:
        return rotation, position
    return matrix_from_vector(axis / sine * np.arctan2(sine, there @ wanted)) @ rotation, position
