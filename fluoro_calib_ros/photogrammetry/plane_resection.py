# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Resection from targets in one plane: grids, boards, and the visible face of a phantom.

The image of a plane is a homography (Hartley and Zisserman, "Multiple View Geometry", 2nd ed.,
2004, 4.1 and 8.1). It gives the exterior orientation if the interior orientation is known. If the
plane is tilted, it also gives one condition each for principal distance and principal point
(Zhang, "A flexible new technique for camera calibration", IEEE Trans. Pattern Anal. Mach. Intell.
22, 2000). A narrow beam images a plane nearly like a parallel projection, which cannot
discriminate a tilt from the opposite tilt: each pose has a second pose, mirrored at the line of
sight (Schweighofer and Pinz, "Robust pose estimation from a planar target", IEEE Trans. Pattern
Anal. Mach. Intell. 28, 2006).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError
from ..exposures.frame import Frame
from ..exposures.pairing import never_alone
from ..exposures.phantom import Phantom
from .resection import MIN_FLATNESS

# Smallest singular value of the conditions on the principal distance, over its largest possible
# value, below which no plane is tilted enough: some 3 degrees in a beam of 15 degrees.
MIN_TILT = 1e-3


@dataclass(frozen=True)
class Plane:
    """The plane of targets."""

    centre_mm: NDArray[np.float64]  #: (3,)
    #: (3, 3) right-handed axes as rows: two in the plane, and its normal
    axes: NDArray[np.float64]

    def coordinates(self, xyz: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the coordinates (n, 2) [mm] of targets (n, 3) in the plane."""
        return (xyz - self.centre_mm) @ self.axes[:2].T


def flatness(xyz: NDArray[np.float64]) -> float:
    """Return smallest over largest extent of targets (n, 3): 0 for a plane, about 1 for a cube."""
    extent = np.linalg.svd(xyz - xyz.mean(axis=0), compute_uv=False)
    return float(extent[-1] / extent[0]) if extent[0] > 0 else 0.0


def is_flat(xyz: NDArray[np.float64]) -> bool:
    """Return whether targets (n, 3) nearly lie in a plane."""
    return len(xyz) < 4 or flatness(xyz) < MIN_FLATNESS


def orients(shown: NDArray[np.float64], targets: NDArray[np.float64]) -> bool:
    """Return whether exposures of targets `shown` (k, 3) can show the orientation of a rig.

    targets (n, 3): of all exposures. If there are targets in space, flat ones are those of a grid
    that is placed in front of each detector in turn, and possibly without a mark.
    """
    return is_flat(targets) or not is_flat(shown)


def frames_without_partner(phantom: Phantom | None) -> Callable[[Frame], bool]:
    """Return a function that tells whether a frame is an exposure without its partners.

    It shows nothing but flat parts of a phantom that has others in space: `orients` does not hold.
    """
    parts = [] if phantom is None else phantom.parts()
    flat = [is_flat(part.xyz_mm) for part in parts]
    if all(flat) or not any(flat):
        return never_alone
    ids = np.concatenate([part.target_id for part, is_part in zip(parts, flat) if is_part])
    return lambda frame: bool(np.isin(frame.target_id, ids).all())


def plane_of(xyz: NDArray[np.float64]) -> Plane:
    """Return the plane that fits targets (n, 3) best. Raises DataError for targets on a line."""
    centre = xyz.mean(axis=0)
    _, extent, axes = np.linalg.svd(xyz - centre, full_matrices=False)
    if extent[1] <= MIN_FLATNESS * extent[0]:
        raise DataError('all targets are collinear or coincide')
    axes = axes * np.array([1, 1, np.linalg.det(axes)])[:, None]
    return Plane(centre, axes)


def principal_distance_of_planes(
    homographies: Sequence[NDArray[np.float64]], principal_point: NDArray[np.float64]
) -> float | None:
    """Return the principal distance [px] by homographies (3, 3) of planes in mm.

    None: no plane is tilted. Zhang's conditions are h1' B h2 = 0 and h1' B h1 = h2' B h2 with
    B = K^-T K^-1; for a known principal point (2,) [px] they are linear in 1/c^2. They are
    weighted by their information on it; a plane that is not tilted has none.
    """
    product = 0.0
    size = 0.0
    for h in homographies:
        centred = h.copy()
        centred[:2] -= np.outer(principal_point, h[2])
        a, b = centred[:2, :2].T
        l_a, l_b = centred[2, :2]
        # With x = 1/c^2: x a'b + l_a l_b = 0 and x (a'a - b'b) + l_a^2 - l_b^2 = 0.
        factors = np.array([a @ b, (a @ a - b @ b) / 2])
        constants = np.array([l_a * l_b, (l_a**2 - l_b**2) / 2])
        weight = 1 / (a @ a + b @ b) ** 2
        product -= weight * (factors @ constants)
        size += weight * (factors @ factors)
    if size < MIN_TILT**2 * len(homographies) or product <= 0:
        return None
    # Least squares with the errors in the constants, which are small and uncertain.
    return float(np.sqrt(size / product))


def poses_of_homography(
    homography: NDArray[np.float64], plane: Plane, interior: NDArray[np.float64]
) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return rotation (3, 3) and position (3,) [mm] by a homography, and the mirrored pose.

    interior (3,) [px]. The second pose is that of the plane mirrored at the line of sight to the
    centre of the targets.
    """
    xp, yp, c = interior
    m = np.linalg.solve(np.array([[c, 0, xp], [0, c, yp], [0, 0, 1.0]]), homography)
    m = m / np.sqrt(np.linalg.norm(m[:, 0]) * np.linalg.norm(m[:, 1]))
    if m[2, 2] < 0:  # the centre of the targets is in front of the source
        m = -m
    u, _, vt = np.linalg.svd(m[:, :2], full_matrices=False)
    first = u @ vt
    return [_pose(first, m[:, 2], plane), _pose(_mirrored(first, m[:, 2]), m[:, 2], plane)]


def mirrored_pose(
    rotation: NDArray[np.float64], position: NDArray[np.float64], plane: Plane
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return rotation (3, 3) and position (3,) of the pose mirrored at the line of sight."""
    middle = rotation @ (plane.centre_mm - position)
    return _pose(_mirrored(rotation @ plane.axes[:2].T, middle), middle, plane)


def _mirrored(axes: NDArray[np.float64], middle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mirror the axes (3, 2) of a plane in the sensor frame at the line of sight to its centre."""
    sight = middle / np.linalg.norm(middle)
    return axes - 2 * np.outer(sight, sight @ axes)


def _pose(
    axes: NDArray[np.float64], middle: NDArray[np.float64], plane: Plane
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the pose with these axes (3, 2) and centre (3,) of the plane in the sensor frame."""
    plane_axes = np.column_stack([axes, np.cross(axes[:, 0], axes[:, 1])])
    rotation = plane_axes @ plane.axes
    return rotation, plane.centre_mm - rotation.T @ middle


def tilt_of(rotation: NDArray[np.float64], plane: Plane) -> float:
    """Return the angle [rad] between the normal of a plane and the axis of the sensor."""
    return float(np.arccos(min(abs(rotation[2] @ plane.axes[2]), 1.0)))
