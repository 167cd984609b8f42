"""Beads found from the images alone, against their survey."""

from dataclasses import dataclass

import numpy as np

from ..photogrammetry.collinearity import project_with_jacobian
from ..photogrammetry.noise import INLIER_Q
from ..photogrammetry.rotations import matrix_from_quaternion

MIN_VIEWS = 3  # that agree, or a false match could pass for a bead out of place
STEPS_L1 = 12
STEPS = 6
MAX_SD_MM = 2.0  # of a bead that counts


@dataclass(frozen=True)
class Beads:
    """Beads intersected from images: target_id (n,), xyz_mm (n, 3), covariance (n, 3, 3) [mm^2],
    views (n,) that agree; survey_mm (n, 3) and survey_sd_mm (n,).
    """

    target_id: np.ndarray
    xyz_mm: np.ndarray
    covariance: np.ndarray
    views: np.ndarray
    survey_mm: np.ndarray
    survey_sd_mm: np.ndarray

    def without(self, target_id):
        """The beads that are not among target_id."""
        keep = ~np.isin(self.target_id, target_id)
        return Beads(*(getattr(self, name)[keep] for name in self.__dataclass_fields__))

    @property
    def misclosure(self):
        """Images less survey (n, 3) [mm]."""
        return self.xyz_mm - self.survey_mm

    @property
    def chi2(self):
        """Squared misclosures (n,) over their covariance of images and survey together; 3 is
        expected.
        """
        total = self.covariance + self.survey_sd_mm[:, None, None] ** 2 * np.eye(3)
        return np.einsum('na,nab,nb->n', self.misclosure, np.linalg.inv(total), self.misclosure)


@dataclass(frozen=True)
class Distances:
    """Distances between beads: rmse_mm against the survey, expected_mm of it; scale of the images
    over the survey less 1, and its standard deviation.
    """

    rmse_mm: float
    expected_mm: float
    scale: float
    scale_sd: float


def rays_of(job, name, frames):
    """Image points of a fluoroscope with what orients them.

    Returns rotation (n, 3, 3), position_mm (n, 3), interior (n, 3), corrected uv (n, 2), variance
    (n,) [px^2] of a coordinate, observation and correction together, and target_id (n,).
    """
    figures = job.fluoroscopes[name]
    calibration = job.calibrations[name]
    by_number = {frame.number: frame.sorted() for frame in frames}
    parts = []
    for e in figures.exposures:
        frame = by_number[e.exposure]
        n = len(frame.target_id)
        correction = calibration.model.evaluate(frame.uv)
        sigma = calibration.image_sd if frame.sigma is None else calibration.sigma0 * frame.sigma
        parts.append(
            (
                np.broadcast_to(matrix_from_quaternion(e.quaternion_wxyz), (n, 3, 3)),
                np.broadcast_to(e.position_mm, (n, 3)),
                np.broadcast_to(figures.interior, (n, 3)),
                frame.uv - correction.duv,
                sigma**2 + correction.sd**2,
                frame.target_id,
            )
        )
    return [np.concatenate(column) for column in zip(*parts)]


def intersect(job, frames, phantom):
    """Beads of a CalibrationResult from the images of all its fluoroscopes {name: [Frame, ...]}: Beads.

    The survey takes no part but by the orientations, which hang on all beads together. Robust:
    least absolute lengths first, then least squares of the image points that agree.
    """
    columns = [
        np.concatenate(c)
        for c in zip(*(rays_of(job, name, frames[name]) for name in job.fluoroscopes))
    ]
    rotation, position, interior, uv, variance, ids = columns
    target_id, bead = np.unique(ids, return_inverse=True)
    points = job.targets.xyz_mm[np.searchsorted(job.targets.target_id, target_id)].copy()
    agree = np.ones(len(uv), dtype=bool)
    for step in range(STEPS_L1 + STEPS):
        ideal, _, d_point, _ = project_with_jacobian(rotation, position, points[bead], interior)
        r = uv - ideal
        q = np.nan_to_num(np.sum(r * r, axis=1) / variance, nan=np.inf)
        agree = q <= INLIER_Q
        weight = (1 / np.sqrt(np.maximum(q, 1.0)) if step < STEPS_L1 else agree) / variance
        normal = np.zeros((len(points), 3, 3))
        right = np.zeros((len(points), 3))
        np.add.at(normal, bead, weight[:, None, None] * (d_point.transpose(0, 2, 1) @ d_point))
        np.add.at(
            right, bead, weight[:, None] * np.einsum('nia,ni->na', d_point, np.nan_to_num(r))
        )
        views = np.bincount(bead, agree, len(points)).astype(int)
        normal += 1e-9 * np.eye(3)  # a bead seen once stays where it is along its ray
        points = points + np.linalg.solve(normal, right[..., None])[..., 0]
    covariance = np.linalg.inv(normal)
    seen = np.bincount(bead, minlength=len(points))
    good = (views >= MIN_VIEWS) & (2 * views > seen)
    good &= np.sqrt(np.trace(covariance, axis1=1, axis2=2)) < MAX_SD_MM
    row = phantom.index(target_id[good])
    return Beads(
        target_id[good],
        points[good],
        covariance[good],
        views[good],
        phantom.xyz_mm[row],
        phantom.sd_mm[row],
    )


def distances(beads):
    """Distances between all pairs of beads against the survey: Distances. At least two beads are
    needed.
    """
    i, j = np.triu_indices(len(beads.target_id), 1)
    found = beads.xyz_mm[j] - beads.xyz_mm[i]
    surveyed = beads.survey_mm[j] - beads.survey_mm[i]
    length = np.linalg.norm(surveyed, axis=1)
    e = surveyed / np.maximum(length, 1e-9)[:, None]
    total = beads.covariance + beads.survey_sd_mm[:, None, None] ** 2 * np.eye(3)
    variance = np.einsum('na,nab,nb->n', e, total[i], e) + np.einsum(
        'na,nab,nb->n', e, total[j], e
    )
    error = np.linalg.norm(found, axis=1) - length
    scale, scale_sd = _scale(beads, total)
    return Distances(
        float(np.sqrt(np.mean(error**2))), float(np.sqrt(np.mean(variance))), scale, scale_sd
    )


def _scale(beads, total):
    """Scale less 1 and its standard deviation, from the similarity that takes the survey to the
    images.
    """
    x = beads.survey_mm - beads.survey_mm.mean(axis=0)
    n = len(x)
    design = np.zeros((n, 3, 7))
    design[:, :, :3] = np.eye(3)
    design[:, 0, 4] = x[:, 2]
    design[:, 0, 5] = -x[:, 1]
    design[:, 1, 3] = -x[:, 2]
    design[:, 1, 5] = x[:, 0]
    design[:, 2, 3] = x[:, 1]
    design[:, 2, 4] = -x[:, 0]
    design[:, :, 6] = x
    information = np.linalg.inv(total)
    normal = np.einsum('nai,nab,nbj->ij', design, information, design)
    right = np.einsum('nai,nab,nb->i', design, information, beads.misclosure)
    covariance = np.linalg.pinv(normal, hermitian=True)
    return float((covariance @ right)[6]), float(np.sqrt(covariance[6, 6]))
