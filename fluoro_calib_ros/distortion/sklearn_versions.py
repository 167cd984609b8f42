# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What scikit-learn 1.6 has renamed, for 1.4 (Ubuntu 24.04) and later."""

from __future__ import annotations

from typing import Any

from sklearn.base import BaseEstimator

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
