# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A user's own scikit-learn regressor as correction model.

Any regressor with `fit(X, y)` and `predict(X)` will do: it is fitted to the residuals of the
inliers between adjustments, as other models are. X (n, 2) are image coordinates relative to the
centre of the image in units of half its longer side, so from -1 to 1; y (n, 2) is (du, dv) [px]. A
regressor of one output is fitted to each of them. What is saved is the fitted correction on a
grid, the model `lookup`.
"""

from __future__ import annotations

import importlib
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..correction.registry import LookupModel, grid_nodes, hull_corners
from ..correction.series import Series
from .estimator import Estimator, RegressionStep, TrainingPoints, require_training
from .gauge import gauge_basis, gauge_coefficients
from .neighbour_regression import weighted_square_sum

CV_FOLDS = 5  # fewer than for the other models: each costs a fit


def resolve_model(name: str) -> Any:
    """Return what the option --model means: a name as it is, or the regressor of 'module:Class'.

    The module is imported from the Python path. The object may be a class or function, which is
    called without arguments, or a regressor. It must never come from a file or a message, as it
    runs code.

    Raises ValueError if there is no such object, or if it is not a regressor.
    """
    if ':' not in name:
        return name
    module, _, attribute = name.partition(':')
    try:
        found = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f'model {name!r} cannot be imported: {error}') from None
    if not is_regressor(found):
        try:
            found = found()
        except TypeError as error:
            raise ValueError(f'model {name!r} cannot be made without arguments: {error}') from None
    if not is_regressor(found):
        raise ValueError(f'model {name!r} is not a scikit-learn regressor')
    return found


def is_regressor(thing: Any) -> bool:
    """Whether an object has the interface of a scikit-learn regressor."""
    if isinstance(thing, type):
        return False
    return all(callable(getattr(thing, name, None)) for name in ('fit', 'predict', 'get_params'))


def regressor_name(regressor: Any) -> str:
    """Module and class of a regressor, 'module:Class'."""
    return f'{type(regressor).__module__}:{type(regressor).__qualname__}'


def user_estimator(regressor: Any) -> Estimator:
    """Return the estimator that fits a scikit-learn regressor to the residuals."""
    return Estimator(
        LookupModel.kind, regression=lambda points, k: UserRegression(regressor, points)
    )


class UserRegression(RegressionStep[LookupModel]):
    """A user's regressor of one fluoroscope through the rounds of a self-calibration.

    The correction is always that of the lookup grid, so that the saved model is the one with
    which the network was adjusted.
    """

    def __init__(self, regressor: Any, points: TrainingPoints) -> None:
        super().__init__(points)
        self._regressor = _repeatable_multi_output(regressor)
        self._nodes = grid_nodes(points.image_size)
        self._interior: np.ndarray | None = None
        self._held_out_error2 = 0.0
        # The fits of a round: of the values and of the next ones. `model` wants the first again,
        # with the gauge of its own round.
        self._last_fits: deque[tuple[np.ndarray, LookupModel]] = deque(maxlen=2)

    def choose(self, values: np.ndarray, q: np.ndarray, information: np.ndarray) -> None:
        """Update the inliers; G is that of held-out exposures."""
        from sklearn.model_selection import GroupKFold, cross_val_predict

        inliers = self._updated_inliers(q)
        require_training(int(inliers.sum()))
        self.inliers = inliers
        groups = self.points.exposure[inliers]
        held_out = cross_val_predict(
            self._regressor,
            self._features(self.points.uv[inliers]),
            values[inliers],
            groups=groups,
            cv=GroupKFold(min(CV_FOLDS, len(np.unique(groups)))),
        )
        error = values[inliers] - held_out
        self.score = float(weighted_square_sum(error[None], information[inliers])[0])
        self._held_out_error2 = float(np.mean(error**2))

    def without_gauge(self, values: np.ndarray, interior: np.ndarray) -> np.ndarray:
        """Return the values: `smooth` takes the gauge of this interior orientation out."""
        self._interior = interior
        return values

    def smooth(self, values: np.ndarray) -> NDArray[np.float64]:
        """Fit values (N, 2) [px] at the inliers; return the corrections (N, 2) at all points."""
        fitted = self._fit(values)
        self._last_fits.append((values.copy(), fitted))
        return fitted.predict(self.points.uv)

    def model(self, values: np.ndarray, series: Series | None = None) -> LookupModel:
        """Return the lookup grid of the regressor fitted to values (N, 2).

        For a least-squares fit and for a mean of neighbours, the error variance of a training
        point is below the noise variance by as much as that of a held-out point is above it
        (Efron, Journal of the American Statistical Association 81, 1986): by the variance of the
        prediction. Both are estimated so.
        """
        known = [fit for fitted_to, fit in self._last_fits if np.array_equal(fitted_to, values)]
        fitted = known[0] if known else self._fit(values)
        error2 = np.mean((values - fitted.predict(self.points.uv))[self.inliers] ** 2)
        noise2 = (error2 + self._held_out_error2) / 2
        prediction2 = max((self._held_out_error2 - error2) / 2, 0.0)
        return LookupModel(
            0, fitted.train_uv, fitted.train_duv, float(np.sqrt(noise2)), float(prediction2**0.5)
        )

    def _fit(self, values: np.ndarray) -> LookupModel:
        """Fit values (N, 2) at the inliers; return the correction without gauge, on the grid."""
        from sklearn.base import clone

        uv = self.points.uv[self.inliers]
        regressor = clone(self._regressor).fit(self._features(uv), values[self.inliers])
        pixels = np.concatenate([self._nodes, hull_corners(uv)])
        duv = np.asarray(regressor.predict(self._features(pixels)), dtype=float)
        fitted = LookupModel(0, pixels, duv).predict(uv)
        basis = self._gauge(uv)
        if not basis.shape[2]:
            return LookupModel(0, pixels, duv)
        assert self._interior is not None, 'without_gauge comes before smooth'
        coefficients = gauge_coefficients(uv, fitted, self._interior, self.points.gauge)
        return LookupModel(0, pixels, duv - self._gauge(pixels) @ coefficients)

    def _gauge(self, uv: np.ndarray) -> np.ndarray:
        assert self._interior is not None, 'without_gauge comes before smooth'
        return gauge_basis(uv, self._interior, self.points.gauge)

    def _features(self, uv: np.ndarray) -> np.ndarray:
        """Image coordinates (n, 2) from -1 to 1 along the longer side."""
        size = np.asarray(self.points.image_size)
        return (uv - (size - 1) / 2) / (size.max() / 2)


def _repeatable_multi_output(regressor: Any) -> Any:
    """Return a regressor of two outputs that gives the same numbers for the same observations."""
    from sklearn.base import clone
    from sklearn.multioutput import MultiOutputRegressor

    from .regressors import supports_multi_output

    regressor = clone(regressor)
    for name, value in regressor.get_params(deep=True).items():
        if name.rpartition('__')[2] == 'random_state' and value is None:
            regressor.set_params(**{name: 0})
    if supports_multi_output(regressor):
        return regressor
    return MultiOutputRegressor(regressor)
