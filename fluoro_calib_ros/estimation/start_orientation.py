# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Initial exterior orientations of one fluoroscope, and its initial principal distance.

For targets in space, an exposure starts with a direct linear transformation; for targets in a
plane, with a homography, in the better of its two poses. If there are few targets, or they are
nearly in a plane, minimal samples with known interior orientation (P3P) compete with both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ..correction.series import Functions
from ..correction.terms import CUBIC
from ..errors import DataError
from ..exposures.frame import Frame
from ..findings import Finding, Kind
from ..photogrammetry.collinearity import project
from ..photogrammetry.noise import Noise
from ..photogrammetry.plane_resection import (
    Plane,
    flatness,
    mirrored_pose,
    plane_of,
    poses_of_homography,
    principal_distance_of_planes,
)
from ..photogrammetry.resection import (
    MIN_FLATNESS,
    NU,
    Resection,
    principal_distance_of,
    refine_resection,
    resect,
    robust_dlt,
    robust_p3p,
    robust_variance,
)

# Below this flatness, the plane of the targets is tried too.
NEARLY_FLAT = 0.08
START_TOLERANCE = 1e-2  # a tenth of a standard deviation; the adjustment continues from there
# With fewer targets, a direct linear transformation may be far off.
FEW_TARGETS = 20
# Iterations that alternate between poses of planes and a preliminary correction.
ROUNDS = 4
# Range of principal distances, relative to the longer side of the image.
DISTANCES = (0.5, 30.0)

UNTILTED = Finding(
    Kind.UNTILTED_TARGETS,
    'the targets are flat and not tilted: the principal distance is undetermined',
    advice='tilt the target by 20 degrees or more, or give the principal distance',
)


@dataclass(frozen=True)
class View:
    """The targets of an exposure, with all that is known before its orientation."""

    frame: Frame
    xyz: NDArray[np.float64]  #: (n, 3) targets [mm]
    #: (n, 2) image points without the distortion, as far as it is known [px]
    uv: NDArray[np.float64]
    projection: NDArray[np.float64] | None = None  #: (3, 4), unless the targets are in a plane
    plane: Plane | None = None  #: plane of the targets, if they are nearly in a plane
    plane_image: NDArray[np.float64] | None = None  #: (3, 3) homography of the plane
    error: Finding | None = None  #: reason why projection and homography are unknown

    @property
    def is_flat(self) -> bool:
        """Whether the targets lie in one plane."""
        return self.projection is None and self.plane_image is not None

    @property
    def needs_samples(self) -> bool:
        """Whether a direct linear transformation may be far off."""
        return len(self.xyz) < FEW_TARGETS or self.plane is not None


def view_of(frame: Frame, xyz: NDArray[np.float64], uv: NDArray[np.float64]) -> View:
    """Return the view of an exposure."""
    flat = flatness(xyz)
    view = View(frame, xyz, uv)
    try:
        if flat >= MIN_FLATNESS:
            view = replace(view, projection=robust_dlt(xyz, uv))
        if flat < NEARLY_FLAT:
            plane = plane_of(xyz)
            image = robust_dlt(plane.coordinates(xyz), uv)
            view = replace(view, plane=plane, plane_image=image)
    except DataError as error:
        return replace(view, error=error.finding)
    return view


def principal_distance_of_views(
    views: Sequence[View], principal_point: NDArray[np.float64], image_size: tuple[int, int]
) -> float:
    """Return the median principal distance [px] of views in space, else that of views of planes.

    Raises DataError if there are only planes that are not tilted.
    """
    certain = [v.projection for v in views if v.projection is not None and not v.needs_samples]
    in_space = certain or [v.projection for v in views if v.projection is not None]
    distances = [principal_distance_of(projection) for projection in in_space]
    if distances:
        return float(np.median(distances))
    planes = [v.plane_image for v in views if v.plane_image is not None]
    distance = principal_distance_of_planes(planes, principal_point) if planes else None
    low, high = (factor * max(image_size) for factor in DISTANCES)
    if distance is None or not low <= distance <= high:
        raise DataError(UNTILTED)
    return distance


def orient_view(view: View, interior: NDArray[np.float64]) -> Resection:
    """Return the exterior orientation of a view with the smallest residuals. Raises DataError."""
    if view.projection is not None and not view.needs_samples:
        return resect(view.xyz, view.uv, interior, view.projection, tolerance=START_TOLERANCE)
    resections = []
    errors: list[Finding] = []
    for start in _starts(view, interior):
        try:
            resections.append(start())
        except DataError as error:
            errors.append(error.finding)
        except np.linalg.LinAlgError as error:
            errors.append(Finding(Kind.NOT_ORIENTED, str(error)))
    if not resections:
        raise DataError(errors[0] if errors else view.error)
    return min(resections, key=lambda resection: resection.scale)


def _starts(view: View, interior: NDArray[np.float64]) -> list[Callable[[], Resection]]:
    """Return the candidate resections."""
    xyz = view.xyz
    uv = view.uv
    out: list[Callable[[], Resection]] = []
    if view.projection is not None:
        out.append(lambda: resect(xyz, uv, interior, view.projection))
    if view.plane_image is not None and view.plane is not None:
        for pose in poses_of_homography(view.plane_image, view.plane, interior):
            out.append(partial(refine_resection, xyz, uv, interior, *pose))
    if not view.is_flat:
        out.append(lambda: refine_resection(xyz, uv, interior, *robust_p3p(xyz, uv, interior)))
    return out


def settle_planes(
    views: Sequence[View], resections: Sequence[Resection | None], interior: np.ndarray
) -> list[Resection | None]:
    """Return resections in which views of planes have the better of their two poses.

    Distortion bends a plane like a tilt, but is the same in all exposures. The estimation
    alternates between a preliminary correction of all residuals and the poses with it.
    """
    out = list(resections)
    if not any(view.is_flat and resection is not None for view, resection in zip(views, out)):
        return out
    for _ in range(ROUNDS):
        correction = _preliminary_correction(views, out, interior)
        for row, (view, resection) in enumerate(zip(views, out)):
            if resection is not None:
                corrected = replace(view, uv=view.uv - correction(view.uv))
                out[row] = _better_pose(corrected, resection, interior)
    return out


def _better_pose(view: View, present: Resection, interior: NDArray[np.float64]) -> Resection:
    """Refine the pose of a view; for a plane, return the better of its two poses."""
    starts = [(present.rotation, present.position_mm)]
    if view.is_flat and view.plane is not None:
        starts.append(mirrored_pose(*starts[0], view.plane))
    refined = []
    for start in starts:
        try:
            refined.append(refine_resection(view.xyz, view.uv, interior, *start))
        except (DataError, np.linalg.LinAlgError):
            continue
    return min(refined, key=lambda resection: resection.scale, default=present)


def _preliminary_correction(
    views: Sequence[View], resections: Sequence[Resection | None], interior: NDArray[np.float64]
) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """Return a polynomial correction fitted robustly to the residuals of all views."""
    functions = Functions(views[0].frame.image_size, CUBIC)
    pixels = []
    residuals = []
    for view, resection in zip(views, resections):
        if resection is None:
            continue
        predicted = project(resection.rotation, resection.position_mm, view.xyz, interior)
        in_front = np.isfinite(predicted).all(axis=1)
        pixels.append(view.uv[in_front])
        residuals.append((view.uv - predicted)[in_front])
    basis = functions(np.concatenate(pixels))
    values = np.concatenate(residuals)
    weight = np.ones(len(values))
    for _ in range(ROUNDS):
        root = np.sqrt(weight)[:, None]
        coefficients = np.linalg.lstsq(root * basis, root * values, rcond=1e-9)[0]
        squared = np.sum((values - basis @ coefficients) ** 2, axis=1)
        weight = Noise(nu=NU).weight(squared / robust_variance(squared))
    return lambda uv: functions(uv) @ coefficients
