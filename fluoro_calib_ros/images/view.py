# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""View of a fluoroscope in one exposure: orientation, principal distance and a polynomial.

The polynomial models the distortion as a function of the undistorted pixel. It only has to predict
the places of beads, so its coefficients have a prior: where observations do not determine them, a
prediction falls back to the expected distortion, by default none. All unknowns are estimated at
once by robust Gauss-Newton steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from ..findings import Finding, Kind
from ..photogrammetry.collinearity import project_with_jacobian
from ..photogrammetry.rotations import matrix_from_vector

# Prior standard deviations of the coefficients by degree, as displacements at the border of the
# image relative to half its width. Pincushion has degree 3; image intensifiers reach about 6 %.
PRIOR_SD = (0.01, 0.012, 0.03, 0.008, 0.008, 0.003, 0.003)
TAIL = 2.5  # residual at which the weight is halved [robust standard deviations]
POSE = 7  # unknowns before the coefficients: position, rotation, log of the principal distance
DAMPING = 1e-6  # relative increase of the diagonal of the normal matrix
CONTOUR = 12  # points on the border of a shadow


@dataclass(frozen=True)
class Lens:
    """Prior knowledge of a fluoroscope before an exposure is evaluated."""

    image_size: tuple[int, int]  #: width and height [px]
    principal_distance_px: float
    principal_distance_sd: float = 0.08  #: relative standard deviation
    #: (2, k), expected coefficients [px], of any degree; empty for zero
    coefficients: NDArray[np.float64] = field(default_factory=lambda: np.zeros((2, 0)))
    certainty: float = 1.0  #: factor on the prior standard deviations of the coefficients

    @property
    def centre(self) -> NDArray[np.float64]:
        """Middle of the image (2,) [px], where the principal point is assumed."""
        return (np.asarray(self.image_size, dtype=float) - 1) / 2

    @property
    def half_px(self) -> float:
        """Half the larger side of the image [px]."""
        return max(self.image_size) / 2

    def expected(self, degree: int) -> NDArray[np.float64]:
        """Return the expected coefficients (2, k) of a polynomial of some degree."""
        out = np.zeros((2, len(exponents(degree))))
        count = min(out.shape[1], self.coefficients.shape[1])
        out[:, :count] = self.coefficients[:, :count]
        return out

    def deviations(self, degree: int) -> NDArray[np.float64]:
        """Return the prior standard deviations (k,) of the coefficients [px]."""
        order = exponents(degree).sum(axis=1)
        return self.certainty * self.half_px * np.asarray(PRIOR_SD)[order - 1]


@dataclass(frozen=True)
class View:
    """Orientation and distortion of an exposure."""

    lens: Lens
    rotation: NDArray[np.float64]  #: (3, 3), phantom -> sensor
    position: NDArray[np.float64]  #: (3,), source in the frame of the phantom [mm]
    principal_distance_px: float
    coefficients: NDArray[np.float64]  #: (2, k), coefficients of the polynomial [px]
    degree: int

    @property
    def interior(self) -> NDArray[np.float64]:
        """Interior orientation (3,): xp, yp, c [px]."""
        return np.append(self.lens.centre, self.principal_distance_px)

    def with_degree(self, degree: int) -> View:
        """Return the view with a polynomial of another degree."""
        coefficients = np.zeros((2, len(exponents(degree))))
        count = min(coefficients.shape[1], self.coefficients.shape[1])
        coefficients[:, :count] = self.coefficients[:, :count]
        return replace(self, coefficients=coefficients, degree=degree)

    def project(self, xyz: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return predicted pixels (n, 2) of points (n, 3) [mm]; NaN if behind the source."""
        x = (xyz - self.position) @ self.rotation.T
        z = np.where(x[:, 2] > 1e-9, x[:, 2], np.nan)
        ideal = self.lens.centre + self.principal_distance_px * x[:, :2] / z[:, None]
        return ideal + self._distortion(ideal)[0]

    def shadow_shift(self, xyz: NDArray[np.float64], radius_px: np.ndarray) -> NDArray[np.float64]:
        """Return shifts (n, 2) of the shadows of spheres from their projected centres [px].

        xyz (n, 3) [mm]; radius_px (n,). The rays that touch a sphere form a cone, whose section is
        an ellipse that is not centred on the projected centre (Luhmann, "Eccentricity in images of
        circular and spherical targets and its impact on spatial intersection", Photogrammetric
        Record 29, 2014), and the distortion bends it. A circle fitted to its border is shifted by
        twice the mean of the displacements along the normals.
        """
        x = (xyz - self.position) @ self.rotation.T
        distance = np.linalg.norm(x, axis=1, keepdims=True)
        radius = np.asarray(radius_px)[:, None] * x[:, 2:] / self.principal_distance_px
        sine2 = (radius / distance) ** 2
        across = np.stack([x[:, 2], np.zeros(len(x)), -x[:, 0]], axis=1)
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        down = np.cross(x / distance, across)
        turn = 2 * np.pi * np.arange(CONTOUR) / CONTOUR
        normal = np.stack([np.cos(turn), np.sin(turn)], axis=1)
        rays = (1 - sine2)[:, None] * x[:, None] + (radius * np.sqrt(1 - sine2))[:, None] * (
            normal[:, :1] * across[:, None] + normal[:, 1:] * down[:, None]
        )
        points = np.concatenate([x[:, None], rays], axis=1)
        ideal = self.lens.centre + self.principal_distance_px * points[..., :2] / points[..., 2:]
        distortion = self._distortion(ideal.reshape(-1, 2))[0].reshape(ideal.shape)
        offset = (ideal + distortion)[:, 1:] - (ideal + distortion)[:, :1]
        radial = np.einsum('nkc,kc->nk', offset, normal)
        return np.asarray(2 / CONTOUR * radial @ normal)

    def depth(self, xyz: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return distances (n,) of points (n, 3) from the source along the axis [mm]."""
        return (xyz - self.position) @ self.rotation[2]

    def outlines(self, xyz: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return matrices (n, 2, 2) from unit circles to borders of shadows of spheres [px/mm].

        xyz: (n, 3) centres of the spheres [mm]. The rays that touch a small sphere form a cone.
        Its section is longer in the direction from the principal point, by one over the cosine of
        the angle there. The matrix is zero for spheres behind the source.
        """
        x = (xyz - self.position) @ self.rotation.T
        depth = np.where(x[:, 2] > 0, x[:, 2], np.inf)
        tangent = x[:, :2] / depth[:, None]
        squared = np.sum(tangent**2, axis=1)[:, None, None]
        along = tangent[:, :, None] * tangent[:, None] / (1 + np.sqrt(1 + squared))
        slope = self._distortion(self.lens.centre + self.principal_distance_px * tangent)[1]
        factor = (self.principal_distance_px / depth)[:, None, None]
        return np.asarray(factor * (np.eye(2) + slope) @ (np.eye(2) + along))

    def _distortion(
        self, ideal: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return distortion (n, 2) [px] at undistorted pixels, derivatives (n, 2, 2), basis."""
        # Far outside the image the polynomial is constant, from 1.5 times half the image size.
        x = np.clip((ideal - self.lens.centre) / self.lens.half_px, -1.5, 1.5)
        basis, by_x, by_y = _monomials(x, self.degree)
        slope = np.stack([by_x @ self.coefficients.T, by_y @ self.coefficients.T], axis=2)
        return basis @ self.coefficients.T, slope / self.lens.half_px, basis


@cache
def exponents(degree: int) -> NDArray[np.int64]:
    """Return exponents (k, 2) of the monomials of degree 1 to `degree`, in order of degree."""
    out = np.array([(n - j, j) for n in range(1, degree + 1) for j in range(n + 1)])
    out.flags.writeable = False
    return out


def _monomials(
    x: NDArray[np.float64], degree: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return values (n, k) of the monomials at points (n, 2), and their derivatives."""
    powers = np.ones((degree + 1, *x.shape))
    for n in range(1, degree + 1):
        powers[n] = powers[n - 1] * x
    i, j = exponents(degree).T
    value = powers[i, :, 0] * powers[j, :, 1]
    by_x = i[:, None] * powers[np.maximum(i - 1, 0), :, 0] * powers[j, :, 1]
    by_y = j[:, None] * powers[i, :, 0] * powers[np.maximum(j - 1, 0), :, 1]
    return value.T, by_x.T, by_y.T


def fit_view(
    view: View,
    xyz: NDArray[np.float64],
    uv: NDArray[np.float64],
    steps: int = 2,
    floor_px: float = 0.05,
) -> tuple[View, float]:
    """Refine a view with matched beads.

    Parameters
    ----------
    view : View
    xyz : (n, 3) ndarray
        Beads [mm].
    uv : (n, 2) ndarray
        Observed pixels of the beads.
    steps : int
        Number of robust Gauss-Newton steps.
    floor_px : float
        Smallest standard deviation of a residual [px].

    Returns
    -------
    view : View
    scale : float
        Robust standard deviation of the residual of a coordinate before the last step [px];
        infinite with fewer than three finite residuals.
    """
    lens = view.lens
    expected = lens.expected(view.degree).ravel()
    prior = np.concatenate(
        [
            np.zeros(6),
            [1 / lens.principal_distance_sd**2],
            np.tile(lens.deviations(view.degree) ** -2.0, 2),
        ]
    )
    scale = floor_px
    for _ in range(steps):
        residual, jacobian = _linearised(view, xyz, uv)
        valid = np.isfinite(residual).all(axis=1)
        residual = residual[valid]
        if len(residual) < 3:
            return view, np.inf
        squared = np.sum(residual**2, axis=1)
        scale = max(float(np.sqrt(np.median(squared) / (2 * np.log(2)))), floor_px)
        weight = 1 / (1 + squared / (TAIL * scale) ** 2)
        rows = jacobian[valid].reshape(-1, jacobian.shape[2])
        weighted = rows * np.repeat(weight / scale**2, 2)[:, None]
        deviation = np.concatenate(
            [
                np.zeros(6),
                [np.log(view.principal_distance_px / lens.principal_distance_px)],
                view.coefficients.ravel() - expected,
            ]
        )
        normal = weighted.T @ rows + np.diag(prior)
        normal[np.diag_indices_from(normal)] *= 1 + DAMPING
        step = np.linalg.solve(normal, weighted.T @ residual.ravel() - prior * deviation)
        view = _moved(view, step)
    return view, scale


def _linearised(
    view: View, xyz: NDArray[np.float64], uv: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return residuals (n, 2) and derivatives (n, 2, 7 + 2 k) of the predictions.

    The first unknowns are those of `project_with_jacobian`: position, rotation vector.
    """
    n = len(xyz)
    ideal, d_exterior, _, _ = project_with_jacobian(
        np.broadcast_to(view.rotation, (n, 3, 3)),
        np.broadcast_to(view.position, (n, 3)),
        xyz,
        view.interior,
    )
    shift, slope, basis = view._distortion(ideal)
    stretch = np.eye(2) + slope
    count = basis.shape[1]
    jacobian = np.zeros((n, 2, POSE + 2 * count))
    jacobian[:, :, :6] = stretch @ d_exterior
    jacobian[:, :, 6] = (stretch @ (ideal - view.lens.centre)[..., None])[..., 0]
    jacobian[:, 0, POSE : POSE + count] = basis
    jacobian[:, 1, POSE + count :] = basis
    return uv - ideal - shift, jacobian


def _moved(view: View, step: NDArray[np.float64]) -> View:
    """Return the view after a step of all unknowns."""
    turn = step[3:6]
    angle = float(np.linalg.norm(turn))
    if angle > 0.3:  # a first step from three beads may be far too large
        turn = turn * (0.3 / angle)
    return replace(
        view,
        rotation=matrix_from_vector(turn) @ view.rotation,
        position=view.position + step[:3],
        principal_distance_px=view.principal_distance_px
        * float(np.exp(np.clip(step[6], -0.1, 0.1))),
        coefficients=view.coefficients + step[POSE:].reshape(2, -1),
    )


# Assumptions about a fluoroscope before an image, and from its other images.

# Principal distance in image widths, if none is given: image intensifiers and those of biplane
# laboratories are three to five times as far from the source as they are wide.
USUAL_DISTANCE = 4.0
USUAL_SD = 0.25  # relative standard deviation of that distance
GIVEN_SD = 0.08  # relative standard deviation of a given principal distance
SHARED_SD = 0.03  # the same, once other images of the fluoroscope are solved
SHARED_CERTAINTY = 0.3  # factor on the standard deviations of the coefficients then
# Images in which beads were seen, and may be matched with the distortion of the other images.
NOT_FOUND = (Kind.NO_POSE, Kind.POSE_UNSURE, Kind.POSE_AMBIGUOUS, Kind.BEADS_NOT_MEASURED)
MIN_SHARED = 3  # solved images that are needed to share their distortion


def assumed_lens(image_size: tuple[int, int], principal_distance_px: float | None) -> Lens:
    """Return the lens assumed before the first image; a principal distance of None is unknown."""
    if principal_distance_px is not None:
        return Lens(image_size, principal_distance_px, GIVEN_SD)
    return Lens(image_size, USUAL_DISTANCE * max(image_size), USUAL_SD)


def shared_lens(lens: Lens, views: Sequence[View]) -> Lens | None:
    """Return the lens with the distortion of the solved views, None if there are too few."""
    if len(views) < MIN_SHARED:
        return None
    return replace(
        lens,
        principal_distance_px=float(np.median([view.principal_distance_px for view in views])),
        principal_distance_sd=SHARED_SD,
        coefficients=np.median([view.coefficients for view in views], axis=0),
        certainty=SHARED_CERTAINTY,
    )


def lacks_certain_pose(finding: Finding | None) -> bool:
    """Return whether an image was refused because no certain pose was found for its beads."""
    return finding is not None and finding.kind in NOT_FOUND
