# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The registry of the correction models: the only place that lists them.

A new model is a subclass of `CorrectionModel` and one line here; `estimators` says how a
self-calibration obtains it. The options of a calibration, the command line, the node's parameters,
calibration files and messages take the names from this module.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from .base import CorrectionModel
from .models import CollocationModel, LookupModel, NoCorrection, ParametricModel, no_correction
from .neighbours import HybridModel, KnnModel, LocalLinearModel
from .series import Series, series_from_values

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


# Fields of a calibration's record that hold a model.
MODEL_FIELDS = tuple(no_correction().to_values())


def model_type(kind: str) -> type[CorrectionModel]:
    """Return the class of the models of a kind. Raises ValueError for an unknown kind."""
    try:
        return MODELS[kind]
    except KeyError:
        raise ValueError(f'correction model is one of {", ".join(MODELS)}, not {kind!r}') from None


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


def model_from_values(values: Mapping[str, Any], image_size: tuple[int, int]) -> CorrectionModel:
    """Return the model whose `CorrectionModel.to_values` gave the values.

    image_size: width and height [px], which the functions of a series need. Raises ValueError.
    """
    return create_model(
        values['model_kind'],
        values['model_k'],
        train_uv=values['train_uv'],
        train_duv=values['train_duv'],
        noise_px=values['noise_px'],
        bias_px=values['bias_px'],
        series=series_from_values(image_size, values),
    )
