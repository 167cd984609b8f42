# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Intersect beads from the images alone and compare them with their survey."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..estimation.result import CalibrationResult, Targets
from ..exposures.frame import Frames
from ..exposures.phantom import Phantom
from ..photogrammetry.collinearity import project_with_jacobian
from ..photogrammetry.network import MIN_RAYS, similarity_directions
from ..photogrammetry.noise import INLIER_Q
from ..photogrammetry.rotations import matrix_from_quaternion
from ..rows import chosen_rows

STEPS_L1 = 12  # iterations that minimise residual lengths (L1)
STEPS_L2 = 6  # iterations of least squares
MAX_SD_MM = 2.0  # maximum standard deviation of a usable bead
DAMPING = 1e-9  # [1/mm^2]; keeps a bead that is seen once in place along its ray


@dataclass(frozen=True)
class Beads:
    """Beads intersected from images, and their survey."""

    target_id: NDArray[np.int64]  #: (n,)
    xyz_mm: NDArray[np.float64]  #: (n, 3)
    covariance: NDArray[np.float64]  #: (n, 3, 3) [mm^2]
    views: NDArray[np.int64]  #: (n,) number of image points that agree
    survey_mm: NDArray[np.float64]  #: (n, 3)
    survey_sd_mm: NDArray[np.float64]  #: (n,)

    def without(self, target_id: NDArray[np.int64]) -> Beads:
        """Return the beads except those with a target id."""
        return chosen_rows(self, ~np.isin(self.target_id, target_id))

    @property
    def misclosure(self) -> NDArray[np.float64]:
        """Coordinates from images minus survey (n, 3) [mm]."""
        return self.xyz_mm - self.survey_mm

    @property
    def total_covariance(self) -> NDArray[np.float64]:
        """Covariance (n, 3, 3) of the misclosures, from images and survey [mm^2]."""
        return self.covariance + self.survey_sd_mm[:, None, None] ** 2 * np.eye(3)

    @property
    def chi2(self) -> NDArray[np.float64]:
        """Squared misclosures (n,), weighted by their inverse covariance; the expectation is 3."""
        weight = np.linalg.inv(self.total_covariance)
        return np.einsum('na,nab,nb->n', self.misclosure, weight, self.misclosure)


@dataclass(frozen=True)
class DistanceComparison:
    """Comparison of the distances between beads with the survey."""

    #: RMS difference from the survey, and its expected value [mm]
    rmse_mm: float
    expected_mm: float
    #: degrees of freedom of the chi-square distribution that approximates the distribution of the
    #: squared RMS difference
    freedom: float
    #: scale of the images relative to the survey, minus 1, and its standard deviation
    scale: float
    scale_sd: float


@dataclass(frozen=True)
class Rays:
    """Image points with the orientation of their exposures."""

    rotation: NDArray[np.float64]  #: (n, 3, 3)
    position_mm: NDArray[np.float64]  #: (n, 3)
    interior: NDArray[np.float64]  #: (n, 3) xp, yp, c [px]
    uv: NDArray[np.float64]  #: (n, 2) corrected pixels
    #: (n,) variance of a coordinate, from observation and correction [px^2]
    variance: NDArray[np.float64]
    target_id: NDArray[np.int64]  #: (n,)
    exposure: NDArray[np.int64]  #: (n,) running number over all fluoroscopes


def intersect(rays: Rays, targets: Targets, phantom: Phantom) -> Beads:
    """Intersect the beads of an adjustment from the images of all its fluoroscopes.

    The survey only enters through the orientations, which depend on all beads together. The
    intersection is robust: it first minimises residual lengths, then squares of points that agree.
    """
    target_id, bead = np.unique(rays.target_id, return_inverse=True)
    start = targets.xyz_mm[np.searchsorted(targets.target_id, target_id)]
    return _beads(rays, target_id, bead, start, phantom)


def least_chi2_without_a_ray(
    rays: Rays, targets: Targets, phantom: Phantom, target_id: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the smallest weighted squared misclosures (n,) of beads without one of their rays.

    A false match that agrees with the other rays by chance displaces a bead; without this ray the
    bead is in place. The result is zero where too few rays remain.

    rays, targets, phantom: as in `intersect`. target_id: (n,) beads. Returns (n,).
    """
    out = np.zeros(len(target_id))
    for number, target in enumerate(target_id):
        bead_rays = np.flatnonzero(rays.target_id == target)
        count = len(bead_rays)
        # One copy of the bead for each excluded ray.
        copy, remaining = np.nonzero(~np.eye(count, dtype=bool))
        part = chosen_rows(rays, bead_rays[remaining])
        start = targets.xyz_mm[np.searchsorted(targets.target_id, target)]
        ids = np.full(count, target)
        beads = _beads(part, ids, copy, np.tile(start, (count, 1)), phantom)
        if len(beads.target_id) == count:
            out[number] = beads.chi2.min()
    return out


def _beads(
    rays: Rays,
    target_id: NDArray[np.int64],
    bead: NDArray[np.int64],
    start: NDArray[np.float64],
    phantom: Phantom,
) -> Beads:
    """Intersect beads from rays.

    target_id: (n,). bead: (N,) row of the bead of each ray. start: (n, 3) initial values [mm].
    Returns the beads that are well determined.
    """
    points = start.copy()
    for step in range(STEPS_L1 + STEPS_L2):
        ideal, _, d_point, _ = project_with_jacobian(
            rays.rotation, rays.position_mm, points[bead], rays.interior
        )
        r = rays.uv - ideal
        q = np.nan_to_num(np.sum(r * r, axis=1) / rays.variance, nan=np.inf)
        is_inlier = q <= INLIER_Q
        weight = 1 / np.sqrt(np.maximum(q, 1.0)) if step < STEPS_L1 else is_inlier
        weight = weight / rays.variance
        normal = np.zeros((len(points), 3, 3))
        right = np.zeros((len(points), 3))
        np.add.at(normal, bead, weight[:, None, None] * (d_point.transpose(0, 2, 1) @ d_point))
        np.add.at(
            right, bead, weight[:, None] * np.einsum('nia,ni->na', d_point, np.nan_to_num(r))
        )
        normal += DAMPING * np.eye(3)
        points = points + np.linalg.solve(normal, right[..., None])[..., 0]
    covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    views = np.bincount(bead, is_inlier, len(points)).astype(int)
    seen = np.bincount(bead, minlength=len(points))
    valid = (views >= MIN_RAYS) & (2 * views > seen)
    valid &= np.sqrt(np.trace(covariance, axis1=1, axis2=2)) < MAX_SD_MM
    row = phantom.index(target_id[valid])
    return Beads(
        target_id[valid],
        points[valid],
        covariance=covariance[valid],
        views=views[valid],
        survey_mm=phantom.xyz_mm[row],
        survey_sd_mm=phantom.sd_mm[row],
    )


def distances(beads: Beads) -> DistanceComparison:
    """Compare the distances between all pairs of beads with the survey; needs two or more."""
    i, j = np.triu_indices(len(beads.target_id), 1)
    offset = beads.xyz_mm[j] - beads.xyz_mm[i]
    surveyed = beads.survey_mm[j] - beads.survey_mm[i]
    length = np.linalg.norm(surveyed, axis=1)
    direction = surveyed / np.maximum(length, 1e-9)[:, None]
    total = beads.total_covariance
    variance = np.stack(
        [np.einsum('na,nab,nb->n', direction, total[k], direction) for k in (i, j)]
    )
    error = np.linalg.norm(offset, axis=1) - length
    scale, scale_sd = _scale(beads)
    return DistanceComparison(
        float(np.sqrt(np.mean(error**2))),
        float(np.sqrt(np.mean(variance.sum(axis=0)))),
        _degrees_of_freedom(direction, total, variance),
        scale,
        scale_sd,
    )


def _degrees_of_freedom(
    direction: NDArray[np.float64], covariance: NDArray[np.float64], variance: NDArray[np.float64]
) -> float:
    """Return the degrees of freedom of the sum of squared errors of all distances between n beads.

    The sum is a quadratic form e^T A e of the errors e of the beads, with covariance C. It
    approximately follows a chi-square distribution with (tr AC)^2 / tr (AC)^2 degrees of freedom
    (Box, "Some theorems on quadratic forms", Annals of Mathematical Statistics 25, 1954). A has
    the off-diagonal blocks -d d^T for directions d (n (n - 1) / 2, 3) of distances, in the order
    of numpy.triu_indices, and their sums on the diagonal. covariance (n, 3, 3); variance (2, n
    (n - 1) / 2): d^T C d of both beads.
    """
    diagonal = np.zeros_like(covariance)
    products = direction[:, :, None] * direction[:, None, :]
    for index in np.triu_indices(len(covariance), 1):
        np.add.at(diagonal, index, products)
    product = diagonal @ covariance
    squares = 2 * np.sum(variance[0] * variance[1]) + np.sum(product * product.transpose(0, 2, 1))
    return float(np.sum(variance) ** 2 / squares)


def rays_of(job: CalibrationResult, frames: Frames) -> Rays:
    """Return the image points of all exposures of an adjustment as rays."""
    parts: list[tuple[np.ndarray, ...]] = []
    for name, figures in job.fluoroscopes.items():
        calibration = job.calibrations[name]
        by_number = {frame.number: frame.sorted() for frame in frames[name]}
        for e in figures.exposures:
            frame = by_number[e.exposure]
            n = len(frame.target_id)
            correction = calibration.correction(frame.uv, frame.angle)
            parts.append(
                (
                    np.broadcast_to(matrix_from_quaternion(e.quaternion_wxyz), (n, 3, 3)),
                    np.broadcast_to(e.position_mm, (n, 3)),
                    np.broadcast_to(figures.interior, (n, 3)),
                    frame.uv - correction.duv,
                    calibration.noise_sd(frame) ** 2 + correction.sd**2,
                    frame.target_id,
                    np.full(n, len(parts)),
                )
            )
    return Rays(*(np.concatenate(column) for column in zip(*parts)))


def _scale(beads: Beads) -> tuple[float, float]:
    """Return scale - 1 of the similarity from survey to images, and its standard deviation."""
    design = similarity_directions(beads.survey_mm, beads.survey_mm.mean(axis=0))
    information = np.linalg.inv(beads.total_covariance)
    normal = np.einsum('nai,nab,nbj->ij', design, information, design)
    right = np.einsum('nai,nab,nb->i', design, information, beads.misclosure)
    covariance = np.linalg.pinv(normal, hermitian=True)
    return float((covariance @ right)[6]), float(np.sqrt(covariance[6, 6]))
