# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The registry of the correction models: the only place that lists them.

A new model is a file with a subclass of `CorrectionModel` and one line here. The options of a
calibration, the command line, the node's parameters, calibration files and messages take the names
from this module.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .base import CorrectionModel
from .collocation import CollocationModel
from .hybrid import HybridModel
from .knn import KnnModel
from .local_linear import LocalLinearModel
from .lookup import LookupModel
from .none import NoCorrection
from .parametric import ParametricModel
from .series import Series, series_from_arrays
from .user_regressor import UserRegressor

# The order is that of messages and help texts.
MODELS: dict[str, type[CorrectionModel]] = {
    model.kind: model
    for model in (
        NoCorrection,
        KnnModel,
        LocalLinearModel,
        ParametricModel,
        HybridModel,
        CollocationModel,
        LookupModel,
    )
}


def model_type(kind: str) -> type[CorrectionModel]:
    """Return the class of the models of a kind. Raises ValueError for an unknown kind."""
    try:
        return MODELS[kind]
    except KeyError:
        raise ValueError(f'correction model is one of {", ".join(MODELS)}, not {kind!r}') from None


def model_source(model: Any) -> Any:
    """Return what a self-calibration obtains a model from (`base.ModelSource`).

    model: the name of a model, or a scikit-learn regressor. Raises ValueError for a name that a
    user cannot ask for.
    """
    if not isinstance(model, str):
        return UserRegressor(model)
    if model not in selectable_models():
        raise ValueError(
            f'correction model is one of {", ".join(selectable_models())}, not {model!r}'
        )
    return MODELS[model]


def selectable_models() -> tuple[str, ...]:
    """Names of the models that a user can ask for."""
    return tuple(name for name, model in MODELS.items() if model.selectable)


def neighbour_models() -> tuple[str, ...]:
    """Names of the models that have a number of neighbours k."""
    return tuple(name for name, model in MODELS.items() if model.min_k is not None)


def create_model(
    kind: str,
    k: int,
    train_uv: np.ndarray,
    train_duv: np.ndarray,
    noise_px: float = 0.0,
    bias_px: float = 0.0,
    series: Series | None = None,
) -> CorrectionModel:
    """Return the model of a kind with this content; see `CorrectionModel` for the arguments.

    Raises ValueError for an unknown kind, and for a content that the model does not accept.
    """
    return model_type(kind)(k, train_uv, train_duv, noise_px, bias_px, series)


def model_from_arrays(content: dict[str, Any], image_size: tuple[int, int]) -> CorrectionModel:
    """Return the model whose `CorrectionModel.to_arrays` gave content.

    image_size: width and height [px], which the functions of a series need. Raises ValueError.
    """
    return create_model(
        content['kind'],
        content['k'],
        content['train_uv'],
        content['train_duv'],
        content['noise_px'],
        content['bias_px'],
        series_from_arrays(image_size, content),
    )
