# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Errors of models that cannot follow a distortion, from their difference to one that can.

The residuals of a forced model show only a part of its errors: orientations and object points
absorb the rest, in every round. Collocation of the same exposures gives the distortion as the
posterior of a random field, with its covariance. The expected squared error of any other
correction is then its squared difference from the posterior mean plus the posterior variance
(Rasmussen and Williams, "Gaussian Processes for Machine Learning", 2006, 2.4). The same holds for
object points and orientations, which take up what the correction leaves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..distortion.base import CorrectionModel
from ..distortion.gauge import GaugeKind, gauge_basis
from ..distortion.series import sd_grid_pixels
from ..distortion.series_model import SeriesModel
from ..photogrammetry.precision import Precision
from ..photogrammetry.rotations import vector_from_matrix
from .rounds import SelfCalibration

MIN_PIXELS = 20  # of the grid that are within both calibrated areas


def with_errors_by(
    reference: SelfCalibration, run: SelfCalibration, gauges: Sequence[GaugeKind]
) -> SelfCalibration:
    """Return a self-calibration whose models and unknowns state their errors by a reference.

    reference: self-calibration of the same exposures by collocation; gauges: what the orientation
    of each fluoroscope can express.
    """
    models = {}
    for f, (name, model) in enumerate(run.models.items()):
        rows = run.measured.network.rows(f)
        uv = run.measured.network.uv[rows[run.trained[rows]]]
        interior = run.after.parameters.interior[f]
        other = reference.models[name]
        size = run.measured.image_size[f]
        pixels = sd_grid_pixels(size)
        inside = ~(model.outside(pixels) | other.outside(pixels))
        if inside.sum() < MIN_PIXELS:
            models[name] = model
            continue
        # What the gauges differ is no error.
        basis = gauge_basis(uv, interior, gauges[f])
        flat = (model.predict(uv) - other.predict(uv)).ravel()
        shared = np.linalg.lstsq(basis.reshape(len(flat), -1), flat, rcond=None)[0]
        found = other.evaluate(pixels)
        difference = model.predict(pixels) - found.duv
        difference = difference - gauge_basis(pixels, interior, gauges[f]) @ shared
        square = np.mean(difference**2, axis=1) + found.sd**2
        models[name] = _with_variance(model, pixels, square, inside)
    return replace(run, models=models, stated=_precision_by(reference, run))


def _precision_by(reference: SelfCalibration, run: SelfCalibration) -> Precision:
    """Precision of a run: covariances of a reference, and the products of the differences.

    Its covariances with additional parameters and other global unknowns are those of the network.
    """
    found = run.after.parameters
    other = reference.after.parameters
    points = found.points_mm - other.points_mm
    turn = vector_from_matrix(found.rotation @ other.rotation.transpose(0, 2, 1))
    exterior = np.concatenate([found.position_mm - other.position_mm, turn], axis=1)
    interior = found.interior - other.interior
    precise = reference.precision
    joint = precise.joint_points
    return replace(
        run.precision,
        interior=precise.interior + _squares(interior),
        exterior=precise.exterior + _squares(exterior),
        points=precise.points + _squares(points),
        joint_points=None if joint is None else joint + np.outer(points, points),
    )


def _squares(differences: np.ndarray) -> np.ndarray:
    """Products (n, s, s) of the components of differences (n, s)."""
    return differences[:, :, None] * differences[:, None, :]


def _with_variance(
    model: CorrectionModel, pixels: np.ndarray, square: np.ndarray, inside: np.ndarray
) -> CorrectionModel:
    """Return a model with variances (n,) [px^2] at the pixels (n, 2) of the grid of a series.

    A series has them as they are; of any other model the mean over the calibrated area, where
    inside (n,), is that of the variances.
    """
    if isinstance(model, SeriesModel):
        sd = np.sqrt(square).reshape(model.series.sd.shape)
        return replace(model, series=replace(model.series, sd=sd))
    random = model.standard_deviation(pixels[inside]) ** 2 - model.bias_px**2
    bias2 = float(np.mean(square[inside] - random))
    return replace(model, bias_px=float(np.sqrt(max(bias2, 0.0))))
