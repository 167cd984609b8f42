# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Registry of the correction models, the only place that lists them, and the model `lookup`.

The model `lookup` interpolates corrections bilinearly between the nodes of a regular grid. The
calibration of a user-defined regressor is saved as this model, so that neither files nor messages
contain executable code.

A new model is a subclass of `CorrectionModel` and one line here; `estimation.self_calibration`
defines how a self-calibration obtains it. The options of a calibration, the command line, the
node's parameters, calibration files and messages take the names from this module.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates

from .base import CorrectionModel, convex_hull
from .grid_cells import CELL_PX, nodes_of, pixels_of
from .neighbours import HybridModel, KnnModel, LocalLinearModel
from .series import SERIES_FIELDS, Series, unpacked

# The model `none`: it corrects nothing.


class NoCorrection(CorrectionModel):
    """Model without any correction: zero everywhere, and no pixel is outside."""

    kind = 'none'
    description = 'no correction'
    corrects = False
    keeps_training_points = False

    def predict(self, uv: ArrayLike) -> NDArray[np.float64]:
        """Return zeros (n, 2)."""
        return np.zeros_like(np.asarray(uv, dtype=float).reshape(-1, 2))

    def outside(self, uv: ArrayLike) -> NDArray[np.bool_]:
        """Return False (n,): there is no calibrated area."""
        return np.zeros(len(np.asarray(uv)), dtype=bool)


def no_correction() -> NoCorrection:
    """Return the model that corrects nothing."""
    return NoCorrection(0, np.zeros((0, 2)), np.zeros((0, 2)))


# Models that consist of a series alone, estimated as a whole in the adjustment.


class SeriesModel(CorrectionModel):
    """Series of functions; the training points only bound the calibrated area."""

    has_series = True
    series: Series

    def predict(self, uv: ArrayLike) -> NDArray[np.float64]:
        """Return corrections (n, 2) [px] at pixels uv (n, 2)."""
        return self.series.predict_in_chunks(np.asarray(uv, dtype=float).reshape(-1, 2))


class ParametricModel(SeriesModel):
    """Polynomial terms of lens and image-intensifier distortion, selected by significance."""

    kind = 'parametric'
    description = 'physical terms in the adjustment, selected stepwise'


class CollocationModel(SeriesModel):
    """Cubic polynomials and a random field of sines, estimated in the adjustment."""

    kind = 'collocation'
    description = 'cubic trend and random field in the adjustment'


MAX_CELLS = 128  # maximum number along an image side, to bound the size of files and messages


class LookupModel(CorrectionModel):
    """Bilinear interpolation of corrections at grid nodes.

    The training points are the nodes, row by row from edge to edge of the image, followed by the
    corners of the convex hull of the calibrated area with the corrections there.
    """

    kind = 'lookup'
    description = "lookup grid, as which the calibration of a user's regressor is saved"
    selectable = False
    keeps_training_points = False

    def _prepare(self) -> None:
        columns, rows = _grid_shape(self.train_uv)
        nodes = columns * rows
        origin = self.train_uv[0]
        self._set(
            _low=origin,
            _per_px=(np.array([columns, rows]) - 1) / (self.train_uv[nodes - 1] - origin),
            _du=self.train_duv[:nodes, 0].reshape(rows, columns),
            _dv=self.train_duv[:nodes, 1].reshape(rows, columns),
        )

    def _calibrated_points(self, uv: NDArray[np.float64]) -> NDArray[np.float64]:
        columns, rows = _grid_shape(uv)
        return uv[columns * rows :]

    def predict(self, uv: ArrayLike) -> NDArray[np.float64]:
        """Return corrections (n, 2) [px] at uv (n, 2); off the image, those at its edge."""
        uv = np.asarray(uv, dtype=float).reshape(-1, 2)
        place = ((uv - self._low) * self._per_px)[:, ::-1].T
        values = [
            map_coordinates(grid, place, order=1, mode='nearest') for grid in (self._du, self._dv)
        ]
        return np.stack(values, axis=1)

    _low: NDArray[np.float64]
    _per_px: NDArray[np.float64]
    _du: NDArray[np.float64]
    _dv: NDArray[np.float64]


def grid_nodes(image_size: tuple[int, int]) -> NDArray[np.float64]:
    """Return the nodes (n, 2) [px] of the lookup grid of an image (width, height), by rows."""
    size = max(*CELL_PX, max(image_size) / MAX_CELLS)
    return pixels_of(nodes_of(image_size, size, 1))


def hull_corners(uv: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the convex hull corners (h, 2) of uv (N, 2); all points if they span no area."""
    outline = convex_hull(uv)
    return uv if outline is None else uv[outline.vertices]


def _grid_shape(uv: NDArray[np.float64]) -> tuple[int, int]:
    """Return the number of columns and rows of the grid at the beginning of uv (N, 2).

    Raises ValueError if uv does not begin with a grid.
    """
    in_first_row = np.cumprod(uv[:, 1] == uv[:1, 1])
    columns = int(in_first_row.sum())
    complete = uv[: len(uv) - len(uv) % columns] if columns else uv[:0]
    table = complete.reshape(-1, max(columns, 1), 2)
    same_columns = (table[:, :, 0] == table[:1, :, 0]).all(axis=1)
    same_row = (table[:, :, 1] == table[:, :1, 1]).all(axis=1)
    rows = int(np.cumprod(same_columns & same_row).sum())
    steps = np.diff(uv[:columns, 0]), np.diff(table[:rows, 0, 1]) if columns else np.zeros(0)
    regular = all(len(step) and step.min() > 0 and np.ptp(step) < 1e-6 for step in steps)
    if columns < 2 or rows < 2 or not regular:
        raise ValueError('the training points of the model lookup do not begin with a grid')
    return columns, rows


# The order is used in messages and help texts.
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


# Fields of a calibration's record that define a model.
MODEL_FIELDS = tuple(no_correction().to_values())


def model_type(kind: str) -> type[CorrectionModel]:
    """Return the model class of a kind. Raises ValueError for an unknown kind."""
    try:
        return MODELS[kind]
    except KeyError:
        raise ValueError(
            f'correction model must be one of {", ".join(MODELS)}, not {kind!r}'
        ) from None


def selectable_models() -> tuple[str, ...]:
    """Return the names of the models that a user can select."""
    return tuple(name for name, model in MODELS.items() if model.selectable)


def neighbour_models() -> tuple[str, ...]:
    """Return the names of the models that have a number of neighbours k."""
    return tuple(name for name, model in MODELS.items() if model.min_k is not None)


def model_from_values(values: Mapping[str, Any], image_size: tuple[int, int]) -> CorrectionModel:
    """Return the model from which `CorrectionModel.to_values` made the values.

    image_size: width and height [px], needed for the functions of a series. Raises ValueError.
    """
    return model_type(values['model_kind'])(
        values['model_k'],
        train_uv=values['train_uv'],
        train_duv=values['train_duv'],
        noise_px=values['noise_px'],
        bias_px=values['bias_px'],
        series=unpacked(image_size, *(values[name] for name in SERIES_FIELDS)),
    )
