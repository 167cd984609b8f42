# Copyright 2026 fluoro_calib_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The self-calibration of a network: a robust bundle adjustment and a model of the distortion.

How a model is obtained is up to the model: by regression of the residuals between adjustments (see
`alternation`), in the adjustment itself (see `combined_adjustment`), or both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ..distortion.base import CorrectionModel, ModelSource
from ..distortion.estimation import (
    AdjustedTerms,
    AdjustmentProblem,
    RegressionStep,
    TrainingPoints,
)
from ..distortion.registry import model_source
from ..errors import DataError
from ..photogrammetry.adjustment import Adjustment
from .alternation import Regressions, calibrate_by_regression
from .combined_adjustment import calibrate_by_adjustment
from .constraints import gauges_of, interiors_to_estimate, with_constraints
from .diagnostics import raise_if_undetermined, undetermined_unknowns
from .initial_network import Measured
from .model_choice import START_MODEL, better_model
from .options import AUTO, CalibrationOptions
from .robust_adjustment import adjusted_with_precision, start_noise
from .rounds import Round, SelfCalibration


def self_calibrate(
    measured: Measured,
    options: CalibrationOptions | None = None,
    progress: Callable[[Round], None] | None = None,
    raise_if_cancelled: Callable[[], None] | None = None,
) -> SelfCalibration:
    """Self-calibrate the fluoroscopes of a network.

    Parameters
    ----------
    measured : Measured
        From `measured_network`.
    options : CalibrationOptions, optional
    progress : callable, optional
        Called with the Round after every round.
    raise_if_cancelled : callable, optional
        Called before every step of an adjustment; may raise to stop.

    Returns
    -------
    SelfCalibration

    Raises
    ------
    DataError
        If the observations do not suffice.
    """
    options = options or CalibrationOptions()
    network = replace(measured.network, interior_free=interiors_to_estimate(measured, options))
    measured = with_constraints(replace(measured, network=network), options)
    before = _adjusted_without_correction(measured, options, raise_if_cancelled)
    automatic = options.model == AUTO
    source = model_source(START_MODEL if automatic else options.model)
    gauges = gauges_of(measured, options)
    problem = AdjustmentProblem(measured.network, measured.image_size, before, gauges)
    terms = source.adjusted_terms(problem)
    steps = _regression_steps(measured, options, source, terms)
    if steps is not None:
        regressions = Regressions(measured, steps)
        return calibrate_by_regression(
            measured, before, options, terms, regressions, progress, raise_if_cancelled
        )
    if terms is None:
        raise TypeError(f'the correction model {source.kind} has neither terms nor a regression')
    run = calibrate_by_adjustment(
        measured, before, source, terms, options.max_iterations, progress, raise_if_cancelled
    )
    if not automatic:
        return run
    better = better_model(run, terms)
    if better is None:
        return run
    return self_calibrate(measured, replace(options, model=better), progress, raise_if_cancelled)


def _adjusted_without_correction(
    measured: Measured,
    options: CalibrationOptions,
    raise_if_cancelled: Callable[[], None] | None,
) -> Adjustment:
    """Adjustment without correction. Raises DataError where it leaves unknowns undetermined."""
    try:
        before, precise = adjusted_with_precision(
            measured.network,
            measured.start,
            np.zeros_like(measured.network.uv),
            start_noise(options.loss),
            raise_if_cancelled=raise_if_cancelled,
        )
    except DataError as error:
        raise DataError(undetermined_unknowns(measured) or str(error)) from None
    raise_if_undetermined(measured, before, precise)
    return before


def _regression_steps(
    measured: Measured,
    options: CalibrationOptions,
    source: ModelSource,
    terms: AdjustedTerms | None,
) -> dict[str, RegressionStep[CorrectionModel]] | None:
    """The regression step of every fluoroscope; None for a model that needs none."""
    network = measured.network
    steps = {}
    for f, name in enumerate(measured.fluoroscopes):
        rows = network.rows(f)
        points = TrainingPoints(
            network.uv[rows],
            network.exposure[rows],
            measured.image_size[f],
            gauges_of(measured, options)[f],
            None if terms is None else terms.values[f],
        )
        step = source.regression(points, options.k)
        if step is None:
            return None
        steps[name] = step
    return steps
