# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Rotations as arrays: unit quaternions (w, x, y, z), rotation matrices and rotation vectors.

Source of the formulas: Diebel, "Representing Attitude: Euler Angles, Unit Quaternions, and
Rotation Vectors", Stanford 2006. Quaternion and matrix of a rotation rotate a vector the same way:
R(q) p = q p q*.

scipy.spatial.transform.Rotation is not used because recorded bags must be reproduced to the last
bit from their seed, under any version of SciPy. Its results differ by some 1e-16, enough to change
the bags. Speed is not the reason: for 15 rotations it takes 0.2 times (vector to matrix) to 9
times (angle of a matrix) as long, 15 to 125 microseconds per call.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import cho_factor, lapack


def mirror_lower(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the symmetric matrix (n, n) whose lower triangle is that of a matrix."""
    return np.where(np.tri(len(matrix), dtype=bool), matrix, matrix.T)


def inverse_of_positive(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the inverse of a positive definite matrix (n, n); raises LinAlgError for others."""
    factor, _ = cho_factor(matrix, lower=True)
    return mirror_lower(lapack.dpotri(factor, lower=1)[0])


# Tolerance of R^T R - I for matrices in files: three decimals leave an error of half a thousandth.
ROTATION_TOLERANCE = 1e-3
# Tolerance for matrices that are used unchanged: single precision, also of other programs.
TAKEN_TOLERANCE = 1e-4


def is_rotation(
    matrix: NDArray[np.float64], tolerance: float = ROTATION_TOLERANCE
) -> NDArray[np.bool_]:
    """Return True (...) for matrices (..., 3, 3) that are rotations, up to rounding in a file."""
    error = np.abs(matrix @ np.swapaxes(matrix, -1, -2) - np.eye(3)).max(axis=(-1, -2))
    return (error <= tolerance) & (np.linalg.det(matrix) > 0)


def nearest_rotation(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotations (..., 3, 3) nearest to matrices with a positive determinant.

    Source: Schoenemann, "A generalized solution of the orthogonal Procrustes problem", 1966.
    """
    u, _, vt = np.linalg.svd(matrix)
    return u @ vt


def matrix_from_quaternion(q: ArrayLike) -> NDArray[np.float64]:
    """Return rotation matrices (..., 3, 3) of quaternions (..., 4) in w, x, y, z of any norm."""
    q = np.asarray(q, dtype=float)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_from_matrix(rotation: ArrayLike) -> NDArray[np.float64]:
    """Return unit quaternions (..., 4) in w, x, y, z, with w >= 0, of matrices (..., 3, 3).

    Of four equivalent formulas, the one with the largest divisor is used (Shepperd's method).
    """
    r = np.asarray(rotation, dtype=float)
    xx = r[..., 0, 0]
    yy = r[..., 1, 1]
    zz = r[..., 2, 2]
    a = r[..., 2, 1] - r[..., 1, 2]
    b = r[..., 0, 2] - r[..., 2, 0]
    c = r[..., 1, 0] - r[..., 0, 1]
    d = r[..., 0, 1] + r[..., 1, 0]
    e = r[..., 0, 2] + r[..., 2, 0]
    f = r[..., 1, 2] + r[..., 2, 1]
    candidates = np.empty((*xx.shape, 4, 4))
    candidates[..., 0, 0] = 1 + xx + yy + zz
    candidates[..., 1, 1] = 1 + xx - yy - zz
    candidates[..., 2, 2] = 1 - xx + yy - zz
    candidates[..., 3, 3] = 1 - xx - yy + zz
    pairs = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
    for (i, j), value in zip(pairs, (a, b, c, d, e, f)):
        candidates[..., i, j] = candidates[..., j, i] = value
    largest = np.diagonal(candidates, axis1=-2, axis2=-1).argmax(axis=-1)
    q = np.take_along_axis(candidates, largest[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0, -q, q)


def cross_matrix(v: ArrayLike) -> NDArray[np.float64]:
    """Return matrices (..., 3, 3) of vectors v (..., 3) such that cross_matrix(v) w = v x w."""
    v = np.asarray(v, dtype=float)
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1] = -v[..., 2]
    out[..., 0, 2] = v[..., 1]
    out[..., 1, 2] = -v[..., 0]
    out[..., 1, 0] = v[..., 2]
    out[..., 2, 0] = -v[..., 1]
    out[..., 2, 1] = v[..., 0]
    return out


def matrix_from_vector(w: ArrayLike) -> NDArray[np.float64]:
    """Return rotation matrices (..., 3, 3) of vectors (..., 3) [rad] (Rodrigues' formula)."""
    w = np.asarray(w, dtype=float)
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    k = cross_matrix(w)
    # np.sinc(x) = sin(pi x)/(pi x) is exact at zero, where the plain quotients are 0/0.
    first = np.sinc(angle / np.pi)
    second = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    return np.eye(3) + first * k + second * (k @ k)


def vector_from_matrix(rotation: ArrayLike) -> NDArray[np.float64]:
    """Return rotation vectors (..., 3) [rad] of matrices (..., 3, 3) with angles below pi."""
    q = quaternion_from_matrix(rotation)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[..., :1])
    return q[..., 1:] * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-300), 2.0)


def rotation_angle(rotation: ArrayLike) -> np.ndarray:
    """Return the angles (...) [rad] in [0, pi] of rotation matrices (..., 3, 3)."""
    r = np.asarray(rotation, dtype=float)
    sine = 0.5 * np.sqrt(
        (r[..., 2, 1] - r[..., 1, 2]) ** 2
        + (r[..., 0, 2] - r[..., 2, 0]) ** 2
        + (r[..., 1, 0] - r[..., 0, 1]) ** 2
    )
    cosine = 0.5 * (np.trace(r, axis1=-2, axis2=-1) - 1)
    return np.arctan2(sine, cosine)


def left_jacobian(w: ArrayLike) -> NDArray[np.float64]:
    """Return J (..., 3, 3) of vectors (..., 3): exp(w + d) = exp(J d) exp(w) to first order.

    Source: Sola, Deray and Atchuthan, "A micro Lie theory for state estimation in robotics", 2018,
    Eq. 145.
    """
    w = np.asarray(w, dtype=float)
    square = (w * w).sum(axis=-1)[..., None, None]
    k = cross_matrix(w)
    # Use series where the quotients (1 - cos a) / a^2 and (a - sin a) / a^3 would lose digits.
    is_small = square < 0.05**2
    first = (1 - square / 12 * (1 - square / 30)) / 2
    second = (1 - square / 20 * (1 - square / 42)) / 6
    if not is_small.all():
        a = np.sqrt(np.where(is_small, 1.0, square))
        first = np.where(is_small, first, (1 - np.cos(a)) / a**2)
        second = np.where(is_small, second, (a - np.sin(a)) / a**3)
    out = first * k + second * (k @ k)
    out.reshape(*w.shape[:-1], 9)[..., ::4] += 1.0  # the diagonal
    return out
