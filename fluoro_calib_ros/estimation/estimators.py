# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""How the correction models are obtained: the only place that lists their estimators.

The coefficients of a model are unknowns of the adjustment (`adjusted_terms`), or the model is
fitted to the residuals between adjustments (`regression`), or both. A model over the k nearest
residuals needs no entry: it is fitted by `NeighbourRegression`.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..correction.models import CollocationModel, NoCorrection, ParametricModel, no_correction
from ..correction.neighbours import HybridModel, NeighbourModel
from ..correction.registry import model_type, selectable_models
from ..correction.series import Series
from .collocation import CollocationTerms
from .estimator import Estimator, RegressionStep
from .neighbour_regression import NeighbourRegression
from .parametric import StepwiseTerms
from .user_regressor import user_estimator


class NoRegression(RegressionStep[NoCorrection]):
    """The regression step of the model that corrects nothing."""

    iterates = False

    def choose(self, values: np.ndarray, q: np.ndarray, information: np.ndarray) -> None:
        """Update the inliers and sum up their weighted residuals."""
        self.inliers = self._updated_inliers(q)
        inside = values[self.inliers]
        self.score = float(np.einsum('na,nab,nb', inside, information[self.inliers], inside))

    def without_gauge(self, values: np.ndarray, interior: np.ndarray) -> np.ndarray:
        """Return the values."""
        return values

    def smooth(self, values: np.ndarray) -> NDArray[np.float64]:
        """Return zeros (N, 2)."""
        return np.zeros_like(values)

    def model(self, values: np.ndarray, series: Series | None = None) -> NoCorrection:
        """Return the model that corrects nothing."""
        return no_correction()


ESTIMATORS = {
    estimator.kind: estimator
    for estimator in (
        Estimator(NoCorrection.kind, regression=lambda points, k: NoRegression(points)),
        Estimator(ParametricModel.kind, StepwiseTerms),
        Estimator(
            HybridModel.kind,
            partial(CollocationTerms, modes=0),
            partial(NeighbourRegression, HybridModel),
        ),
        Estimator(CollocationModel.kind, CollocationTerms),
    )
}


def estimator_of(model: Any) -> Estimator:
    """Return the estimator of a model.

    model: the name of a model, or a scikit-learn regressor. Raises ValueError for a name that a
    user cannot ask for.
    """
    if not isinstance(model, str):
        return user_estimator(model)
    if model not in selectable_models():
        raise ValueError(
            f'correction model is one of {", ".join(selectable_models())}, not {model!r}'
        )
    if model in ESTIMATORS:
        return ESTIMATORS[model]
    kind = model_type(model)
    if not issubclass(kind, NeighbourModel):
        raise ValueError(f'correction model {model} has no estimator')
    return Estimator(model, regression=partial(NeighbourRegression, kind))
