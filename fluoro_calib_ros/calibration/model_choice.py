"""Choice of the kind of model by cross-validation, whole exposures held out."""

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from ..distortion.cross_validation import CrossValidation, candidate_k, exposure_folds
from ..distortion.series import Functions
from ..distortion.terms import HIGHEST

# a kind is preferred to collocation where its squared errors are smaller by more than 1 %
CLEARLY = 0.99
OTHERS = ('local_linear', 'knn', 'parametric')
MAX_NEIGHBOURS = {
    'local_linear': 100,
    'knn': 40,
}  # more follow a distortion no closer than collocation does
# image points of a fluoroscope from which on collocation is taken: no other model gains on it
# there
MAX_IMAGE_POINTS = 40_000


def better_kind(run, state):
    """The kind of model that predicts held-out exposures clearly better than the collocation of a
    run, or None.

    run: SelfCalibration by collocation, state: its Collocation. Compared are the squared errors of
    predictions of (residual + correction) of the inliers with their robust weights, Eq. 2 of Chow
    et al. with one variance for all image points, summed over the fluoroscopes.
    """
    network = run.measured.network
    after = run.after
    scores = dict.fromkeys(('collocation', *OTHERS), 0.0)
    for f in range(len(run.measured.fluoroscopes)):
        rows = network.rows(f)
        rows = rows[after.inliers[rows]]
        if len(rows) > MAX_IMAGE_POINTS:
            return None
        uv = network.uv[rows]
        values = (after.residuals + run.correction)[rows]
        weight = after.noise.weight(after.q[rows])
        fold = exposure_folds(network.exposure[rows])
        variance = (after.noise.scale * network.sigma[rows]) ** 2
        prior = network.additional[f].prior
        held_out = {
            'collocation': _held_out(
                state.functions[f](uv), prior, values, weight / variance, fold
            ),
            'parametric': _held_out(
                Functions(run.measured.image_size[f], HIGHEST)(uv),
                None,
                values,
                weight / variance,
                fold,
            ),
        }
        for kind in ('local_linear', 'knn'):
            candidates = candidate_k(kind, len(uv))
            validation = CrossValidation(
                kind, uv, fold, candidates[candidates <= MAX_NEIGHBOURS[kind]]
            )
            information = (weight / variance)[:, None, None] * np.eye(2)
            scores[kind] += float(np.min(validation.scores(values, information)))
        for kind, predicted in held_out.items():
            scores[kind] += float(np.sum((weight / variance)[:, None] * (values - predicted) ** 2))
    best = min(OTHERS, key=scores.get)
    return best if scores[best] < CLEARLY * scores['collocation'] else None


def _held_out(functions, prior, values, weight, fold):
    """Predictions (N, 2) of values (N, 2) by functions (N, m) fitted without the own fold; prior
    (2m, 2m) or None.
    """
    m = functions.shape[1]
    out = np.empty_like(values)
    for number in np.unique(fold):
        test = fold == number
        train = fold != number
        weighted = weight[train, None] * functions[train]
        gram = weighted.T @ functions[train]
        right = weighted.T @ values[train]
        if prior is None:
            out[test] = functions[test] @ np.linalg.lstsq(gram, right, rcond=1e-12)[0]
        else:
            matrix = prior.copy()
            matrix[:m, :m] += gram
            matrix[m:, m:] += gram
            found = cho_solve(cho_factor(matrix, lower=True), right.T.ravel())
            out[test] = functions[test] @ found.reshape(2, m).T
    return out
