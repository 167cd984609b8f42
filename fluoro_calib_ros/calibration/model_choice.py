# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Automatic choice of the model by cross-validation, whole exposures held out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from ..distortion.collocation import CollocationTerms
from ..distortion.cross_validation import CrossValidation
from ..distortion.estimation import AdjustedTerms, AdjustmentProblem, exposure_folds
from ..distortion.gauge import gauge_rows
from ..distortion.knn import KnnModel
from ..distortion.local_linear import LocalLinearModel
from ..distortion.neighbour_model import NeighbourModel
from ..distortion.neighbours import NeighbourTable
from ..distortion.parametric import StepwiseTerms
from ..distortion.priors import GAUGE_SD_PX, prior_precision
from .rounds import SelfCalibration

START_MODEL = 'collocation'
# Another model is preferred where its squared errors are smaller by more than 1 %.
MAX_RATIO = 0.99
ALTERNATIVES = ('local_linear', 'knn', 'parametric')
# Neighbour models with the largest k that is tried: more neighbours follow a distortion no closer
# than collocation does.
MAX_NEIGHBOURS: dict[type[NeighbourModel], int] = {LocalLinearModel: 100, KnnModel: 40}
# Image points of a fluoroscope whose predictions are compared: more tell the models no better.
MAX_TESTED = 5_000
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
        tested = np.unique(np.linspace(0, len(uv) - 1, MAX_TESTED).astype(int))
        near = NeighbourTable(uv, min(max(MAX_NEIGHBOURS.values()), len(uv)), tested)
        information = weight[:, None, None] * np.eye(2)
        for model_type, max_k in MAX_NEIGHBOURS.items():
            candidates = model_type.candidate_k(len(uv))
            candidates = candidates[candidates <= max_k]
            validation = CrossValidation(model_type, uv, fold, candidates, near, tested)
            scores[model_type.kind] += float(np.min(validation.scores(values, information)))
        held_out = {
            START_MODEL: _held_out(
                _prior_of(terms, f), terms.functions[f](uv), values, weight, fold
            ),
            'parametric': _held_out_of_terms(
                parametric.values[f][inside[network.rows(f)]], values, weight, fold
            ),
        }
        for kind, predicted in held_out.items():
            errors = (weight[:, None] * (values - predicted) ** 2)[tested]
            scores[kind] += float(np.sum(errors))
    best = min(ALTERNATIVES, key=lambda kind: scores[kind])
    return best if scores[best] < MAX_RATIO * scores[START_MODEL] else None


@dataclass(frozen=True)
class _SeriesPrior:
    """Prior precisions of the coefficients of a series, in parts.

    Attributes
    ----------
    trend : (2t, 2t) ndarray
        Of the trend, u first.
    signal : (s, s) ndarray
        Of the sines, the same for u and v.
    gauge : (2, g, t + s) ndarray
        Products with the coefficients of u and of v whose sums have the precision of one.
    """

    trend: np.ndarray
    signal: np.ndarray
    gauge: np.ndarray


def _prior_of(terms: CollocationTerms, f: int) -> _SeriesPrior:
    """Prior of the series of fluoroscope f."""
    functions = terms.functions[f]
    m = len(functions)
    t = functions.trend
    precision = prior_precision(functions, terms.priors[f])
    at = np.concatenate([np.arange(t), m + np.arange(t)])
    uv = terms.network.uv[terms.network.rows(f)]
    rows = gauge_rows(terms.values[f], uv, terms.interior[f], terms.gauge_kinds[f])
    return _SeriesPrior(
        precision[np.ix_(at, at)],
        precision[t:m, t:m],
        rows.reshape(-1, 2, m).transpose(1, 0, 2) / GAUGE_SD_PX,
    )


def _held_out(
    prior: _SeriesPrior,
    functions: np.ndarray,
    values: np.ndarray,
    weight: np.ndarray,
    fold: np.ndarray,
) -> np.ndarray:
    """Predictions (N, 2) of values (N, 2) by functions fitted without the own fold.

    Parameters
    ----------
    prior : _SeriesPrior
    functions : (N, m) ndarray
        Trend, then sines.
    values : (N, 2) ndarray
    weight, fold : (N,) ndarray

    Returns
    -------
    (N, 2) ndarray
    """
    out = np.empty_like(values)
    root = np.sqrt(weight)[:, None]
    scaled = root * functions
    goal = root * values
    folds = [np.flatnonzero(fold == number) for number in np.unique(fold)]
    grams = [scaled[rows].T @ scaled[rows] for rows in folds]
    rights = [scaled[rows].T @ goal[rows] for rows in folds]
    gram = np.sum(grams, axis=0)
    right = np.sum(rights, axis=0)
    for rows, own_gram, own_right in zip(folds, grams, rights):
        out[rows] = functions[rows] @ _solved(prior, gram - own_gram, right - own_right)
    return out


def _solved(prior: _SeriesPrior, gram: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Coefficients (m, 2) of u and v from their normal equations (m, m) and (m, 2).

    The sines, whose matrix u and v have in common, are eliminated first; what remains are trend
    and gauge, whose products are unknowns of their own.
    """
    t = len(gram) - len(prior.signal)
    g = prior.gauge.shape[1]
    of_trend = gram[t:, :t]
    of_gauge = prior.gauge[:, :, t:]
    columns = np.column_stack([of_trend, *of_gauge.transpose(0, 2, 1), right[t:]])
    factor = cho_factor(gram[t:, t:] + prior.signal, lower=True)
    solved = cho_solve(factor, columns)
    by_trend = solved[:, :t]
    by_gauge = [solved[:, t : t + g], solved[:, t + g : t + 2 * g]]
    by_right = solved[:, t + 2 * g :]
    size = 2 * t + g
    rest = np.zeros((size, size))
    rest_right = np.zeros(size)
    rest[: 2 * t, : 2 * t] = prior.trend
    rest[2 * t :, 2 * t :] = -np.eye(g)
    for axis in (0, 1):
        own = slice(axis * t, (axis + 1) * t)
        rest[own, own] += gram[:t, :t] - of_trend.T @ by_trend
        mixed = prior.gauge[axis, :, :t].T - of_trend.T @ by_gauge[axis]
        rest[own, 2 * t :] = mixed
        rest[2 * t :, own] = mixed.T
        rest[2 * t :, 2 * t :] -= of_gauge[axis] @ by_gauge[axis]
        rest_right[own] = right[:t, axis] - of_trend.T @ by_right[:, axis]
        rest_right[2 * t :] -= of_gauge[axis] @ by_right[:, axis]
    found = np.linalg.solve(rest, rest_right)
    out = np.empty((len(gram), 2))
    for axis in (0, 1):
        out[:t, axis] = found[axis * t : (axis + 1) * t]
        eliminated = by_trend @ out[:t, axis] + by_gauge[axis] @ found[2 * t :]
        out[t:, axis] = by_right[:, axis] - eliminated
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
    scaled = scaled / np.sqrt(np.sum(scaled**2, axis=(0, 1)))
    right = values * root
    folds = [np.flatnonzero(fold == number) for number in np.unique(fold)]
    parts = [scaled[rows].reshape(-1, terms.shape[2]) for rows in folds]
    grams = [part.T @ part for part in parts]
    rights = [part.T @ right[rows].ravel() for part, rows in zip(parts, folds)]
    gram = np.sum(grams, axis=0)
    everything = np.sum(rights, axis=0)
    for rows, part, own, own_right in zip(folds, parts, grams, rights):
        found = np.linalg.lstsq(gram - own, everything - own_right, rcond=1e-12)[0]
        out[rows] = (part @ found).reshape(-1, 2) / root[rows]
    return out
