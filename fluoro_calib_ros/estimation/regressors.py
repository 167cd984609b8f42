# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Neighbour models as scikit-learn estimators, for pipelines and cross-validation.

A self-calibration does not use them: it searches neighbours once for all rounds (see
`neighbour_regression`). The predictions are the same.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import issparse
from scipy.spatial import cKDTree
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.neighbors import KNeighborsRegressor
from sklearn.preprocessing import PolynomialFeatures
from sklearn.utils.validation import _check_sample_weight, check_is_fitted

from ..correction.neighbours import RIDGE

if TYPE_CHECKING:
    from sklearn.utils import Tags

# Names that scikit-learn 1.6 has changed, for 1.4 (Ubuntu 24.04) and later.

try:
    from sklearn.utils import get_tags
    from sklearn.utils.validation import validate_data
except ImportError:  # before scikit-learn 1.6
    get_tags = None
    validate_data = None


def validated(estimator: BaseEstimator, *data: Any, **checks: Any) -> Any:
    """Validate the input of an estimator; see sklearn.utils.validation.validate_data."""
    if validate_data is not None:
        return validate_data(estimator, *data, **checks)
    return estimator._validate_data(*data, **checks)


def supports_multi_output(estimator: BaseEstimator) -> bool:
    """Return whether a regressor fits several outputs at once."""
    if get_tags is not None:
        return get_tags(estimator).target_tags.multi_output
    return estimator._get_tags()['multioutput']


MIN_BANDWIDTH = 1e-6  # bandwidth of coincident neighbours


class KnnRegressor(KNeighborsRegressor):
    """KNeighborsRegressor with a faster neighbour search and with sample weights.

    The parameters are those of scikit-learn. The search of scipy is used where it gives the same
    neighbours: for dense samples, uniform weights and Euclidean distances. Sample weights weight
    the mean of the neighbours; samples of weight 0 are ignored.
    """

    def fit(
        self, X: ArrayLike, y: ArrayLike, sample_weight: ArrayLike | None = None
    ) -> KnnRegressor:
        """Fit to samples X (N, d) with targets y (N,) or (N, outputs)."""
        self.sample_weight_ = None
        if sample_weight is not None:
            samples, targets = validated(self, X, y, multi_output=True, accept_sparse='csr')
            weight = _check_sample_weight(sample_weight, samples)
            has_weight = weight > 0
            X = samples[has_weight]
            y = targets[has_weight]
            self.sample_weight_ = weight[has_weight]
        super().fit(X, y)
        uses_scipy = self.weights == 'uniform' and self.effective_metric_ == 'euclidean'
        self._scipy_tree = None if issparse(X) or not uses_scipy else cKDTree(self._fit_X)
        return self

    def predict(self, X: ArrayLike) -> NDArray[np.float64]:
        """Predict the targets of samples X (n, d)."""
        if getattr(self, '_scipy_tree', None) is None or self.n_neighbors > self.n_samples_fit_:
            return super().predict(X)
        samples = validated(self, X, reset=False, dtype=float)
        assert self._scipy_tree is not None
        _, index = self._scipy_tree.query(samples, k=np.arange(1, self.n_neighbors + 1))
        values = self._y[:, None] if self._y.ndim == 1 else self._y
        if self.sample_weight_ is None:
            predicted = np.mean(values[index], axis=1)
        else:
            weight = self.sample_weight_[index][:, :, None]
            predicted = np.sum(weight * values[index], axis=1) / np.sum(weight, axis=1)
        return predicted[:, 0] if self._y.ndim == 1 else predicted


class LocalLinearRegressor(RegressorMixin, BaseEstimator):
    """The model `local_linear`: a polynomial trend, and planes fitted to the nearest remainders.

    n_neighbors: number of neighbours; at most the number of samples is used. trend_degree: degree
    of the trend; None: no trend, as in the model `hybrid`.
    """

    def __init__(self, n_neighbors: int = 30, trend_degree: int | None = 3) -> None:
        self.n_neighbors = n_neighbors
        self.trend_degree = trend_degree

    def __sklearn_tags__(self) -> Tags:
        tags = super().__sklearn_tags__()
        tags.target_tags.multi_output = True
        return tags

    def _more_tags(self) -> dict[str, Any]:  # before scikit-learn 1.6
        return {'multioutput': True}

    def fit(
        self, X: ArrayLike, y: ArrayLike, sample_weight: ArrayLike | None = None
    ) -> LocalLinearRegressor:
        """Fit to samples X (N, d) with targets y (N,) or (N, outputs).

        Sample weights weight the fits of trend and planes; samples of weight 0 are ignored.
        """
        samples, targets = validated(
            self, X, y, multi_output=True, y_numeric=True, dtype=np.float64
        )
        if self.n_neighbors < 1:
            raise ValueError(f'n_neighbors must be at least 1, not {self.n_neighbors}')
        weight = np.ones(len(samples))
        if sample_weight is not None:
            weight = _check_sample_weight(sample_weight, samples, dtype=np.float64)
        has_weight = weight > 0
        samples = samples[has_weight]
        self._single_output = targets.ndim == 1
        targets = targets[has_weight].reshape(len(samples), -1).astype(np.float64)
        self._weight = weight[has_weight]
        self._centre = samples.mean(axis=0)
        self._scale = max(float(np.max(np.abs(samples - self._centre))), 1e-300)
        basis = self._basis(samples)
        root = np.sqrt(self._weight)[:, None]
        self.trend_coefficients_ = np.linalg.pinv(root * basis) @ (root * targets)
        self._remainder = targets - basis @ self.trend_coefficients_
        self._tree = cKDTree(samples)
        self.n_neighbors_ = min(self.n_neighbors, len(samples))
        return self

    def predict(self, X: ArrayLike) -> NDArray[np.float64]:
        """Predict the targets of samples X (n, d)."""
        check_is_fitted(self)
        samples = validated(self, X, reset=False, dtype=np.float64)
        distance, index = self._tree.query(samples, k=np.arange(1, self.n_neighbors_ + 1))
        bandwidth = np.maximum(distance[:, -1:], MIN_BANDWIDTH)
        kernel = (1 - (distance / bandwidth) ** 3) ** 3
        kernel[kernel.sum(axis=1) <= 1e-9] = 1.0  # all neighbours at one distance
        kernel *= self._weight[index]
        offset = (self._tree.data[index] - samples[:, None]) / bandwidth[:, :, None]
        weights = _plane_weights(offset, kernel)
        predicted = self._basis(samples) @ self.trend_coefficients_
        predicted += np.einsum('nk,nko->no', weights, self._remainder[index])
        return predicted[:, 0] if self._single_output else predicted

    def _basis(self, X: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the values (n, p) of the polynomials of the trend."""
        if self.trend_degree is None:
            return np.zeros((len(X), 0))
        return PolynomialFeatures(self.trend_degree).fit_transform(
            (X - self._centre) / self._scale
        )


def _plane_weights(
    offset: NDArray[np.float64], kernel: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return weights (n, k) that evaluate at 0 a plane fitted at offset (n, k, d).

    kernel: (n, k). Offsets, and thus the ridge of the slopes, are in units of the bandwidth.
    """
    design = np.concatenate([np.ones((*kernel.shape, 1)), offset], axis=2)
    weighted = kernel[:, :, None] * design
    moments = weighted.transpose(0, 2, 1) @ design
    slopes = np.arange(1, design.shape[2])
    moments[:, slopes, slopes] += RIDGE * kernel.sum(axis=1)[:, None]
    at_origin = np.zeros((len(kernel), design.shape[2], 1))
    at_origin[:, 0] = 1.0
    return (weighted @ np.linalg.solve(moments, at_origin))[:, :, 0]
