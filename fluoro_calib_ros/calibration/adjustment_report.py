# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Statistics and residuals of adjustments, as they are reported."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..photogrammetry.adjustment import Adjustment
from ..photogrammetry.precision import Precision
from ..photogrammetry.relative_orientation import discrepancies
from .initial_network import Measured


@dataclass(frozen=True)
class AdjustmentStatistics:
    """Statistics of one adjustment and of its network.

    Attributes
    ----------
    fluoroscopes : tuple of str
    loss : str
        Noise model of the image points.
    sigma0 : float
        Scale of the noise: standard deviation of an image coordinate of weight one [px], or its
        ratio to sigma where sigma is given.
    nu : float
        Degrees of freedom of the Student-t; infinite for other noise models.
    variance_factor : float
        Weighted square sum of all residuals over the degrees of freedom; expected: 1.
    observations, unknowns : int
        Scalar observations without priors, and unknowns.
    degrees_of_freedom : float
        Sum of the redundancy numbers. With priors, as those of a signal, it is more than
        observations - unknowns.
    image_points, outliers, exposures, targets : int
    least_redundancy, mean_redundancy : float
        Of the image coordinates of weight one half or more.
    least_rays, mean_rays : float
        Image points of a target.
    """

    fluoroscopes: tuple[str, ...]
    loss: str
    sigma0: float
    nu: float
    variance_factor: float
    observations: int
    unknowns: int
    degrees_of_freedom: float
    image_points: int
    outliers: int
    exposures: int
    targets: int
    least_redundancy: float
    mean_redundancy: float
    least_rays: float
    mean_rays: float


@dataclass(frozen=True)
class ResidualTable:
    """Residuals of all image points of adjustments.

    Attributes
    ----------
    fluoroscope : (N,) ndarray of str
    exposure, target_id : (N,) ndarray of int
    uv : (N, 2) ndarray
        Observed pixels.
    correction : (N, 2) ndarray
        Correction [px].
    residual : (N, 2) ndarray
        Observed - correction - projected [px].
    redundancy : (N, 2) ndarray
        Redundancy numbers: part of an error that the residual shows.
    weight : (N,) ndarray
        Robust weights, 0 to about 1.
    outlier : (N,) ndarray of bool
        Beyond the core of the noise: four standard deviations, more where the tails are heavy or
        the image points of the exposure scatter more than those of others.
    """

    fluoroscope: np.ndarray
    exposure: np.ndarray
    target_id: np.ndarray
    uv: np.ndarray
    correction: np.ndarray
    residual: np.ndarray
    redundancy: np.ndarray
    weight: np.ndarray
    outlier: np.ndarray

    @classmethod
    def joined(cls, parts: Sequence[ResidualTable]) -> ResidualTable:
        """Return one table from several."""
        return cls(
            *(
                np.concatenate([getattr(part, name) for part in parts])
                for name in cls.__dataclass_fields__
            )
        )


def statistics_of(
    measured: Measured, adjustment: Adjustment, precise: Precision
) -> AdjustmentStatistics:
    """Return the statistics of an adjustment."""
    network = measured.network
    noise = adjustment.noise
    weight = noise.weight(adjustment.q)
    square = float(np.sum(weight * adjustment.q)) + _square_of_others(measured, adjustment)
    redundancy = float(
        precise.redundancy.sum()
        + precise.survey_redundancy.sum()
        + sum(part.sum() for part in precise.relative_redundancy)
    )
    good = precise.redundancy[weight >= 0.5]
    rays = np.bincount(network.point, minlength=network.n_points)
    return AdjustmentStatistics(
        tuple(measured.fluoroscopes),
        noise.loss,
        float(noise.scale),
        float(noise.nu),
        square / redundancy if redundancy > 0 else float('nan'),
        network.n_observations,
        network.n_unknowns,
        redundancy,
        network.n_image_points,
        int((~adjustment.inliers).sum()),
        network.n_exposures,
        network.n_points,
        float(good.min()) if len(good) else float('nan'),
        float(good.mean()) if len(good) else float('nan'),
        float(rays.min()),
        float(rays.mean()),
    )


def _square_of_others(measured: Measured, adjustment: Adjustment) -> float:
    """Weighted square sum of the residuals of survey and relative orientation constraints."""
    network = measured.network
    parameters = adjustment.parameters
    out = 0.0
    if network.datum == 'survey':
        difference = (parameters.points_mm - network.survey_mm) / network.survey_sd_mm[:, None]
        out += float(np.sum(difference**2))
    for constraint, pose in zip(network.relative, parameters.relative):
        out += float(np.sum(discrepancies(constraint, pose, parameters) ** 2 @ constraint.weights))
    return out


def residuals_of_adjustment(
    measured: Measured, adjustment: Adjustment, precise: Precision, correction: np.ndarray
) -> ResidualTable:
    """Return the residuals of an adjustment; correction (N, 2) [px], all parts of it."""
    network = measured.network
    frames = measured.frames
    name = np.array([frame.fluoroscope for frame in frames])
    number = np.array([frame.number for frame in frames], dtype=np.int64)
    return ResidualTable(
        name[network.exposure],
        number[network.exposure],
        measured.target_id[network.point],
        network.uv,
        correction,
        adjustment.residuals,
        precise.redundancy,
        adjustment.noise.weight(adjustment.q),
        ~adjustment.inliers,
    )
