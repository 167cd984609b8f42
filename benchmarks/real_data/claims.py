# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Expected residuals of unseen exposures, from the covariances of a calibration.

Redundancy numbers give the fraction of independent errors that remains in residuals. Errors of a
correction are strongly correlated between neighbouring pixels and between exposures; deviations of
the distortion of an exposure are correlated within it. Poses and targets of the tested exposures
therefore absorb more of them. The expected square sum is tr(R C R^T), where C is the covariance of
all errors and R = I - A N^-1 A^T W maps them to residuals, plus the contribution of survey errors
(Foerstner and Wrobel, "Photogrammetric Computer Vision", Springer 2016, 4.2).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fluoro_calib_ros.correction.series import Functions, without_absent_bands
from fluoro_calib_ros.correction.terms import CUBIC
from fluoro_calib_ros.estimation.fixed_calibration import SolvedNetwork
from fluoro_calib_ros.estimation.fluoroscope_terms import RINGS
from fluoro_calib_ros.estimation.rounds import SelfCalibration
from fluoro_calib_ros.photogrammetry.collinearity import (
    AdditionalParameters,
    project_with_jacobian,
)

JITTER = 1e-14  # px^2; keeps covariances positive definite
EXTERIOR = 6


def expected_square(
    run: SelfCalibration, tested: SolvedNetwork, claimed: np.ndarray, counted: np.ndarray
) -> float:
    """Return the expected square sum [px^2] of the residuals of tested exposures.

    run: collocation of one camera. tested: the adjustment of the tested exposures. claimed (N,):
    standard deviations [px] that the calibration claims for their image points. counted (N,):
    whether a residual is in the sum; outliers do not affect the adjustment.
    """
    rows = np.flatnonzero(tested.adjustment.inliers)
    to_residuals, by_survey, by_interior = _to_residuals(tested, rows)
    used = np.repeat(counted[rows], 2)
    to_residuals = to_residuals[used]
    network = tested.measured.network
    uv = network.uv[rows]
    common = _common_errors(run, uv, by_interior)
    between = float(np.mean(run.between_exposures.get(run.measured.fluoroscopes[0], 0.0)))
    variation, share = _variation(run, tested, rows)
    variance = np.sum(common[:, 3:] ** 2, axis=1).reshape(-1, 2).mean(axis=1)
    noise = np.maximum(claimed[rows] ** 2 - variance, 0.0)
    white = noise * max(1 - between / float(np.mean(noise)), 0.0)
    scale = np.sqrt(between / share) if share else 0.0
    return float(
        np.sum(to_residuals**2 @ np.repeat(white, 2))
        + np.sum(by_survey[used] ** 2)
        + np.sum((to_residuals @ common) ** 2)
        + np.sum((to_residuals @ (scale * variation)) ** 2)
    )


def _to_residuals(
    tested: SolvedNetwork, rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the maps from errors of the image points in rows (n,) and of the survey to residuals.

    The result is R (2n, 2n), a factor (2n, p) of the covariance due to the survey [px], and the
    derivatives (2n, 3) with respect to the interior orientation.
    """
    network = tested.measured.network
    adjustment = tested.adjustment
    points = network.per_image_point(adjustment.parameters)
    _, by_exterior, by_point, by_interior = project_with_jacobian(*(a[rows] for a in points))
    first_point = EXTERIOR * network.n_exposures
    design = np.zeros((len(rows), 2, first_point + 3 * network.n_points))
    at = np.arange(len(rows))[:, None]
    columns = EXTERIOR * network.exposure[rows][:, None] + np.arange(EXTERIOR)
    design[at, :, columns] = by_exterior.transpose(0, 2, 1)
    columns = first_point + 3 * network.point[rows][:, None] + np.arange(3)
    design[at, :, columns] = by_point.transpose(0, 2, 1)
    flat = design.reshape(2 * len(rows), -1)
    weight = adjustment.noise.weight(adjustment.q)[rows]
    weight = np.repeat(weight / (adjustment.noise.scale * network.sigma[rows]) ** 2, 2)
    prior = np.zeros(flat.shape[1])
    prior[first_point:] = np.repeat(1 / network.survey_sd_mm**2, 3)
    normal = flat.T @ (weight[:, None] * flat) + np.diag(prior)
    unit = 1 / np.sqrt(np.diagonal(normal))
    normal = normal * np.outer(unit, unit)
    inverse = np.linalg.inv(normal) * np.outer(unit, unit)
    projected = flat @ inverse
    to_residuals = np.eye(len(flat)) - projected @ (flat.T * weight)
    return to_residuals, projected * np.sqrt(prior), by_interior.reshape(-1, 3)


def _common_errors(run: SelfCalibration, uv: np.ndarray, by_interior: np.ndarray) -> np.ndarray:
    """Return a factor (2n, 3 + p) of the covariance of interior orientation and series at uv.

    Columns from the fourth on belong to the series given the interior orientation.
    """
    layout = run.measured.network.layout
    functions = _functions(run)
    values = functions(uv)
    size = len(functions)
    series = np.zeros((len(uv), 2, 2 * size))
    series[:, 0, :size] = values
    series[:, 1, size:] = values
    interior = layout.interiors[0]
    additional = layout.additional[0].start
    own = np.r_[interior.start : interior.stop, additional : additional + 2 * size]
    covariance = run.precision.all_global[np.ix_(own, own)]
    factor = np.linalg.cholesky(covariance + JITTER * np.eye(len(own)))
    return np.concatenate([by_interior, series.reshape(2 * len(uv), -1)], axis=1) @ factor


def _functions(run: SelfCalibration) -> Functions:
    """Return the functions of the series as used in the adjustment."""
    model = run.models[run.measured.fluoroscopes[0]]
    if model.series is None:
        raise ValueError('the model is not collocation')
    functions, _ = without_absent_bands(model.series.functions, model.series.coefficients)
    return replace(functions, degree=CUBIC, rings=RINGS if functions.modes else 0)


def _additional(run: SelfCalibration) -> AdditionalParameters:
    """Return the additional parameters of the camera."""
    additional = run.measured.network.additional[0]
    if additional is None:
        raise ValueError('the model is not collocation')
    return additional


def _variation(
    run: SelfCalibration, tested: SolvedNetwork, rows: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return a covariance factor (2n, q) of variations between tested exposures, and its size.

    The covariance uses the variances of the terms of the exposures; the size is the mean square
    [px^2] that the poses do not absorb.
    """
    additional = _additional(run)
    count = 2 * len(_functions(run))
    network = tested.measured.network
    if additional.grouped is None:
        return np.zeros((2 * len(rows), 0)), 0.0
    own = additional.grouped.values
    polynomials = Functions(run.measured.image_size[0], CUBIC)
    of_training = polynomials(run.measured.network.uv)
    of_tested = polynomials(network.uv[rows])
    sd = 1 / np.sqrt(np.diagonal(additional.prior)[count:][: own.shape[2]])
    values = [
        of_tested @ np.linalg.lstsq(of_training, own[:, axis], rcond=None)[0] * sd
        for axis in (0, 1)
    ]
    stacked = np.stack(values, axis=1)
    points = network.per_image_point(tested.adjustment.parameters)
    _, by_exterior, _, _ = project_with_jacobian(*(a[rows] for a in points))
    out = []
    square = 0.0
    for number in np.unique(network.exposure[rows]):
        at = network.exposure[rows] == number
        of_exposure = np.where(at[:, None, None], stacked, 0.0)
        out.append(of_exposure.reshape(2 * len(rows), -1))
        y = stacked[at].reshape(2 * int(at.sum()), -1)
        a = by_exterior[at].reshape(len(y), -1)
        a = a / np.linalg.norm(a, axis=0)
        square += float(np.sum((y - a @ np.linalg.lstsq(a, y, rcond=None)[0]) ** 2))
    return np.concatenate(out, axis=1), square / (2 * len(rows))
