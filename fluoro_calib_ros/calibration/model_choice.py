# Copyright 2026 fluoro_calib_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Automatic choice of the model by cross-validation, whole exposures held out."""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from ..distortion.collocation import CollocationTerms
from ..distortion.cross_validation import CrossValidation
from ..distortion.estimation import (
    AdjustedTerms,
    AdjustmentProblem,
    exposure_folds,
    prior_of_additional,
)
from ..distortion.knn import KnnModel
from ..distortion.local_linear import LocalLinearModel
from ..distortion.neighbour_model import NeighbourModel
from ..distortion.parametric import StepwiseTerms
from .rounds import SelfCalibration

START_MODEL = 'collocation'
# Another model is preferred where its squared errors are smaller by more than 1 %.
MAX_RATIO = 0.99
ALTERNATIVES = ('local_linear', 'knn', 'parametric')
# Neighbour models with the largest k that is tried: more neighbours follow a distortion no closer
# than collocation does.
MAX_NEIGHBOURS: dict[type[NeighbourModel], int] = {LocalLinearModel: 100, KnnModel: 40}
# With more image points of a fluoroscope no other model was better than collocation.
MAX_IMAGE_POINTS = 40_000


def better_model(run: SelfCalibration, terms: AdjustedTerms) -> str | None:
    """Return the model that predicts held-out exposures clearly better than collocation, or None.

    The criterion is the square sum of the errors of predictions of (residual + correction) of the
    inliers with their robust weights: Eq. 2 of Chow et al. with one variance for all image points,
    summed over the fluoroscopes.

    run: self-calibration by collocation; terms: its terms.
    """
    assert isinstance(terms, CollocationTerms)
    if any(own is not None for own in terms.exposure_terms):
        return None  # no other model knows what differs between exposures
    network = run.measured.network
    after = run.after
    inside = after.inliers
    parametric = StepwiseTerms(
        AdjustmentProblem(terms.network, run.measured.image_size, run.before, terms.gauge_kinds)
    )
    scores = dict.fromkeys((START_MODEL, *ALTERNATIVES), 0.0)
    for f in range(len(run.measured.fluoroscopes)):
        rows = network.rows(f)
        rows = rows[inside[rows]]
        if len(rows) > MAX_IMAGE_POINTS:
            return None
        uv = network.uv[rows]
        values = (after.residuals + run.correction)[rows]
        weight = after.noise.weight(after.q[rows])
        weight = weight / (after.noise.scale * network.sigma[rows]) ** 2
        fold = exposure_folds(network.exposure[rows])
        for model_type, max_k in MAX_NEIGHBOURS.items():
            candidates = model_type.candidate_k(len(uv))
            validation = CrossValidation(model_type, uv, fold, candidates[candidates <= max_k])
            information = weight[:, None, None] * np.eye(2)
            scores[model_type.kind] += float(np.min(validation.scores(values, information)))
        held_out = {
            START_MODEL: _held_out(
                terms.functions[f](uv), prior_of_additional(network, f), values, weight, fold
            ),
            'parametric': _held_out_of_terms(
                parametric.values[f][inside[network.rows(f)]], values, weight, fold
            ),
        }
        for kind, predicted in held_out.items():
            scores[kind] += float(np.sum(weight[:, None] * (values - predicted) ** 2))
    best = min(ALTERNATIVES, key=lambda kind: scores[kind])
    return best if scores[best] < MAX_RATIO * scores[START_MODEL] else None


def _held_out(
    functions: np.ndarray,
    prior: np.ndarray,
    values: np.ndarray,
    weight: np.ndarray,
    fold: np.ndarray,
) -> np.ndarray:
    """Predictions (N, 2) of values (N, 2) by functions fitted without the own fold.

    Parameters
    ----------
    functions : (N, m) ndarray
    prior : (2m, 2m) ndarray
        Precision matrix of the coefficients.
    values : (N, 2) ndarray
    weight, fold : (N,) ndarray

    Returns
    -------
    (N, 2) ndarray
    """
    m = functions.shape[1]
    out = np.empty_like(values)
    for number in np.unique(fold):
        test = fold == number
        train = fold != number
        weighted = weight[train, None] * functions[train]
        gram = weighted.T @ functions[train]
        right = weighted.T @ values[train]
        matrix = prior.copy()
        matrix[:m, :m] += gram
        matrix[m:, m:] += gram
        found = cho_solve(cho_factor(matrix, lower=True), right.T.ravel())
        out[test] = functions[test] @ found.reshape(2, m).T
    return out


def _held_out_of_terms(
    terms: np.ndarray, values: np.ndarray, weight: np.ndarray, fold: np.ndarray
) -> np.ndarray:
    """Predictions (N, 2) of values (N, 2) by terms (N, 2, t) fitted without the own fold.

    weight, fold (N,).
    """
    out = np.empty_like(values)
    root = np.sqrt(weight)[:, None]
    scaled = terms * root[:, :, None]
    right = values * root
    for number in np.unique(fold):
        test = fold == number
        design = scaled[~test].reshape(-1, terms.shape[2])
        found = np.linalg.lstsq(design, right[~test].ravel(), rcond=1e-12)[0]
        out[test] = terms[test] @ found
    return out
