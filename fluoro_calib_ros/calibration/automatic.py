"""Choice of the kind of model by cross-validation, whole exposures held out."""

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from ..distortion.selection import CrossValidation, candidate_k, exposure_folds
from ..distortion.terms import HIGHEST
from ..distortion.series import Functions

CLEARLY = 0.99   # a kind is preferred to collocation where its squared errors are smaller by more than 1 %
OTHERS = ('local_linear', 'knn', 'parametric')
MOST_NEIGHBOURS = {'local_linear': 100, 'knn': 40}   # more follow a distortion no closer than collocation does
LARGEST = 40_000   # image points of a fluoroscope from which on collocation is taken: no other model gains on it there


def better_kind(run, state):
    """The kind of model that predicts held-out exposures clearly better than the collocation of a run, or None.

    run: SelfCalibration by collocation, state: its Collocation. Compared are the squared errors of predictions of
    (residual + correction) of the inliers with their robust weights, Eq. 2 of Chow et al. with one variance
    for all image points, summed over the fluoroscopes.
    """
    network, after = run.measured.network, run.after
    scores = dict.fromkeys(('collocation', *OTHERS), 0.0)
    for f in range(len(run.measured.fluoroscopes)):
        rows = network.rows(f)
        rows = rows[after.inliers[rows]]
        if len(rows) > LARGEST:
            return None
        uv, values = network.uv[rows], (after.residuals + run.correction)[rows]
        weight, fold = after.noise.weight(after.q[rows]), exposure_folds(network.exposure[rows])
        variance = (after.noise.scale * network.sigma[rows]) ** 2
        prior = network.additional[f].prior
        held_out = {'collocation': _held_out(state.functions[f](uv), prior, values, weight / variance, fold),
                    'parametric': _held_out(Functions(run.measured.image_size[f], HIGHEST)(uv), None, values,
                                            weight / variance, fold)}
        for kind in ('local_linear', 'knn'):
            candidates = candidate_k(kind, len(uv))
            validation = CrossValidation(kind, uv, fold, candidates[candidates <= MOST_NEIGHBOURS[kind]])
            information = (weight / variance)[:, None, None] * np.eye(2)
            scores[kind] += float(np.min(validation.scores(values, information)))
        for kind, predicted in held_out.items():
            scores[kind] += float(np.sum((weight / variance)[:, None] * (values - predicted) ** 2))
    best = min(OTHERS, key=scores.get)
    return best if scores[best] < CLEARLY * scores['collocation'] else None


def _held_out(functions, prior, values, weight, fold):
    """Predictions (N, 2) of values (N, 2) by functions (N, m) fitted without the own fold; prior (2m, 2m) or None."""
    m = functions.shape[1]
    out = np.empty_like(values)
    for number in np.unique(fold):
        test, train = fold == number, fold != number
        weighted = weight[train, None] * functions[train]
        gram, right = weighted.T @ functions[train], weighted.T @ values[train]
        if prior is None:
            out[test] = functions[test] @ np.linalg.lstsq(gram, right, rcond=1e-12)[0]
        else:
            matrix = prior.copy()
            matrix[:m, :m] += gram
            matrix[m:, m:] += gram
            found = cho_solve(cho_factor(matrix, lower=True), right.T.ravel())
            out[test] = functions[test] @ found.reshape(2, m).T
    return out
