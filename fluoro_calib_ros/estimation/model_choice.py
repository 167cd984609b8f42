# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Automatic choice of the model by cross-validation with whole exposures held out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, cho_factor, cho_solve

from ..correction.base import CorrectionModel
from ..correction.neighbours import KnnModel, LocalLinearModel, NeighbourModel, NeighbourTable
from ..correction.registry import SeriesModel
from ..correction.series import sd_grid_pixels
from ..photogrammetry.precision import Precision
from ..photogrammetry.rotations import vector_from_matrix
from .collocation import CollocationTerms
from .estimator import (
    AdjustedTerms,
    AdjustmentProblem,
    GaugeKind,
    exposure_folds,
    gauge_basis,
)
from .neighbour_regression import CrossValidation
from .parametric import StepwiseTerms
from .priors import prior_precision
from .rounds import SelfCalibration

# Errors of models that cannot follow a distortion, from their difference to a model that can.
#
# The residuals of a forced model show only a part of its errors, because orientations and object
# points absorb the remainder in every round. Collocation of the same exposures gives the
# distortion as the posterior of a random field, with its covariance. The expected squared error of
# any other correction is then its squared difference from the posterior mean plus the posterior
# variance (Rasmussen and Williams, "Gaussian Processes for Machine Learning", 2006, 2.4). The same
# holds for object points and orientations, which absorb what the correction does not follow.

MIN_PIXELS = 20  # grid pixels needed within both calibrated areas


def with_errors_by(
    reference: SelfCalibration, run: SelfCalibration, gauges: Sequence[GaugeKind]
) -> SelfCalibration:
    """Return a self-calibration that states errors of models and unknowns by a reference.

    reference: self-calibration of the same exposures by collocation; gauges: changes that the
    orientation of each fluoroscope can absorb.
    """
    models = {}
    for f, (name, model) in enumerate(run.models.items()):
        rows = run.measured.network.rows(f)
        uv = run.measured.network.uv[rows[run.trained[rows]]]
        interior = run.after.parameters.interior[f]
        reference_model = reference.models[name]
        size = run.measured.image_size[f]
        pixels = sd_grid_pixels(size)
        inside = ~(model.outside(pixels) | reference_model.outside(pixels))
        if inside.sum() < MIN_PIXELS:
            models[name] = model
            continue
        # A difference of the gauges is no error.
        basis = gauge_basis(uv, interior, gauges[f])
        flat = (model.predict(uv) - reference_model.predict(uv)).ravel()
        shared = np.linalg.lstsq(basis.reshape(len(flat), -1), flat, rcond=None)[0]
        expected = reference_model.evaluate(pixels)
        difference = model.predict(pixels) - expected.duv
        difference = difference - gauge_basis(pixels, interior, gauges[f]) @ shared
        square = np.mean(difference**2, axis=1) + expected.sd**2
        models[name] = _with_variance(model, pixels, square, inside)
    return replace(run, models=models, stated=_precision_by(reference, run))


def _precision_by(reference: SelfCalibration, run: SelfCalibration) -> Precision:
    """Add the products of the differences from a reference to its covariances.

    Covariances with additional parameters and other global unknowns are those of the network.
    """
    estimated = run.after.parameters
    expected = reference.after.parameters
    points = estimated.points_mm - expected.points_mm
    turn = vector_from_matrix(estimated.rotation @ expected.rotation.transpose(0, 2, 1))
    exterior = np.concatenate([estimated.position_mm - expected.position_mm, turn], axis=1)
    interior = estimated.interior - expected.interior
    precise = reference.precision
    joint = precise.joint_points
    return replace(
        run.precision,
        interior=precise.interior + _squares(interior),
        exterior=precise.exterior + _squares(exterior),
        points=precise.points + _squares(points),
        joint_points=None if joint is None else joint + np.outer(points, points),
    )


def _squares(differences: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return products (n, s, s) of the components of differences (n, s)."""
    return differences[:, :, None] * differences[:, None, :]


def _with_variance(
    model: CorrectionModel,
    pixels: NDArray[np.float64],
    square: NDArray[np.float64],
    inside: NDArray[np.bool_],
) -> CorrectionModel:
    """Return a model with variances (n,) [px^2] at the pixels (n, 2) of the grid of a series.

    A series gets these variances. For any other model, the mean variance over the calibrated area,
    inside (n,), becomes that of the given variances.
    """
    if isinstance(model, SeriesModel):
        sd = np.sqrt(square).reshape(model.series.sd.shape)
        return replace(model, series=replace(model.series, sd=sd))
    random_variance = model.standard_deviation(pixels[inside]) ** 2 - model.bias_px**2
    bias2 = float(np.mean(square[inside] - random_variance))
    return replace(model, bias_px=float(np.sqrt(max(bias2, 0.0))))


START_MODEL = 'collocation'
# Another model is preferred if its squared errors are smaller by more than 1 %.
MAX_RATIO = 0.99
ALTERNATIVES = ('local_linear', 'knn', 'parametric')
# Neighbour models and the largest k to try: with more neighbours they follow a distortion no
# better than collocation does.
MAX_NEIGHBOURS: dict[type[NeighbourModel], int] = {LocalLinearModel: 100, KnnModel: 40}
# Most predictions compared for a fluoroscope. If two models differ by a share d of the noise, the
# ratio of their squared errors scatters by 2 d / sqrt(2 MAX_TESTED): by 0.004 where one has 1 %
# more. With five times as many, ratios of 13 calibrations below 1.05 changed by 0.01 at most.
MAX_TESTED = 1_000
# With more image points of a fluoroscope, no other model was better than collocation.
MAX_IMAGE_POINTS = 40_000


def better_model(run: SelfCalibration, terms: AdjustedTerms) -> str | None:
    """Return the model that predicts held-out exposures clearly better than collocation, or None.

    The criterion is the weighted square sum of the errors of predicted (residual + correction) of
    the inliers, with their robust weights: Eq. 2 of Chow et al. with one variance for all image
    points, summed over the fluoroscopes.

    run: self-calibration by collocation; terms: its terms.
    """
    assert isinstance(terms, CollocationTerms)
    if any(part.own is not None for part in terms.parts):
        return None  # no other model can follow differences between exposures
    network = run.measured.network
    after = run.after
    inside = after.inliers
    gauges = [part.gauge_kind for part in terms.parts]
    parametric = StepwiseTerms(
        AdjustmentProblem(terms.network, run.measured.image_size, run.before, gauges)
    )
    scores = dict.fromkeys((START_MODEL, *ALTERNATIVES), 0.0)
    for f, part in enumerate(terms.parts):
        rows = network.rows(f)
        rows = rows[inside[rows]]
        if len(rows) > MAX_IMAGE_POINTS:
            return None
        uv = network.uv[rows]
        values = (after.residuals + run.correction)[rows]
        weight = after.noise.weight(after.q[rows])
        weight = weight / (after.noise.scale * network.sigma[rows]) ** 2
        fold = exposure_folds(network.exposure[rows])
        tested = np.unique(np.linspace(0, len(uv) - 1, MAX_TESTED).astype(int))
        neighbours = NeighbourTable(uv, min(max(MAX_NEIGHBOURS.values()), len(uv)), tested)
        information = weight[:, None, None] * np.eye(2)
        for model_type, max_k in MAX_NEIGHBOURS.items():
            candidates = model_type.candidate_k(len(uv))
            candidates = candidates[candidates <= max_k]
            validation = CrossValidation(
                model_type, uv, fold=fold, candidates=candidates, near=neighbours, tested=tested
            )
            scores[model_type.kind] += float(np.min(validation.scores(values, information)))
        prior = prior_precision(part.functions, part.prior) + part.gauge
        held_out = {
            START_MODEL: _held_out(prior, part.functions(uv), values, weight, fold),
            'parametric': _held_out_of_terms(
                parametric.parts[f].values[inside[network.rows(f)]], values, weight, fold
            ),
        }
        for kind, predicted in held_out.items():
            errors = (weight[:, None] * (values - predicted) ** 2)[tested]
            scores[kind] += float(np.sum(errors))
    best = min(ALTERNATIVES, key=lambda kind: scores[kind])
    return best if scores[best] < MAX_RATIO * scores[START_MODEL] else None


def _held_out(
    prior: NDArray[np.float64],
    functions: NDArray[np.float64],
    values: NDArray[np.float64],
    weight: NDArray[np.float64],
    fold: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Predict values (N, 2) by functions (N, m) fitted without the fold of each value.

    prior: (2m, 2m) precision of the coefficients, those of u first. weight, fold: (N,).
    """

    def solve(gram: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
        factor = cho_factor(prior + block_diag(gram, gram), lower=True, overwrite_a=True)
        return cho_solve(factor, right.T.ravel()).reshape(2, -1).T

    root = np.sqrt(weight)[:, None]
    return _by_other_folds(root * functions, root * values, fold, solve) / root


def _held_out_of_terms(
    terms: NDArray[np.float64],
    values: NDArray[np.float64],
    weight: NDArray[np.float64],
    fold: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Predict values (N, 2) by terms (N, 2, t) fitted without the fold of each value.

    weight, fold (N,).
    """
    root = np.sqrt(weight)[:, None]
    scaled = terms * root[:, :, None]
    scaled = scaled / np.sqrt(np.sum(scaled**2, axis=(0, 1)))
    predicted = _by_other_folds(
        scaled.reshape(-1, terms.shape[2]),
        (root * values).ravel(),
        np.repeat(fold, 2),
        lambda gram, right: np.asarray(np.linalg.lstsq(gram, right, rcond=1e-12)[0], dtype=float),
    )
    return predicted.reshape(-1, 2) / root


def _by_other_folds(
    design: NDArray[np.float64],
    observed: NDArray[np.float64],
    fold: NDArray[np.int64],
    solve: Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]],
) -> NDArray[np.float64]:
    """Predict observations (n, ...) by a design (n, p) fitted to the other folds (n,).

    solve: returns coefficients (p, ...) of normal equations (p, p), (p, ...).
    """
    folds = [np.flatnonzero(fold == number) for number in np.unique(fold)]
    grams = [design[rows].T @ design[rows] for rows in folds]
    rights = [design[rows].T @ observed[rows] for rows in folds]
    gram = np.sum(grams, axis=0)
    right = np.sum(rights, axis=0)
    out = np.empty_like(observed)
    for rows, held_out_gram, held_out_right in zip(folds, grams, rights):
        out[rows] = design[rows] @ solve(gram - held_out_gram, right - held_out_right)
    return out
