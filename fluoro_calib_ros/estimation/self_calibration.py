# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The self-calibration of a network: a robust bundle adjustment and a model of the distortion.

How a model is obtained is up to the model. Its coefficients are unknowns of the adjustment
(`adjusted_terms`, see `combined_adjustment`), or it is fitted to the residuals between adjustments
(`regression`, see `alternation`), or both. `ESTIMATORS` is the only place that lists them; a model
over the k nearest residuals needs no entry there, `NeighbourRegression` fits it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..correction.base import CorrectionModel
from ..correction.neighbours import HybridModel, NeighbourModel
from ..correction.registry import (
    CollocationModel,
    NoCorrection,
    ParametricModel,
    SeriesModel,
    model_type,
    no_correction,
    selectable_models,
)
from ..correction.series import Series
from ..errors import DataError
from ..photogrammetry.adjustment import Adjustment, residuals_and_q
from .alternation import Regressions, calibrate_by_regression
from .collocation import CollocationTerms, EarlierTerms
from .combined_adjustment import calibrate_by_adjustment
from .constraints import gauges_of, interiors_to_estimate, with_constraints
from .estimator import (
    FINAL_TOLERANCE,
    AdjustedTerms,
    AdjustmentProblem,
    Estimator,
    GaugeKind,
    RegressionStep,
    TrainingPoints,
)
from .initial_network import EarlierCalibration, Measured, adjusted_with_precision, start_noise
from .model_choice import START_MODEL, better_model, with_errors_by
from .neighbour_regression import NeighbourRegression
from .options import AUTO, CalibrationOptions, user_estimator
from .parametric import StepwiseTerms
from .rounds import Round, SelfCalibration, raise_if_undetermined, undetermined_unknowns


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


TOLERANCE = 1e-8  # decrease of F that an adjustment that is a result may leave


def self_calibrate(
    measured: Measured,
    options: CalibrationOptions | None = None,
    progress: Callable[[Round], None] | None = None,
    earlier: EarlierCalibration | None = None,
) -> SelfCalibration:
    """Self-calibrate the fluoroscopes of a network.

    The standard deviations of models other than collocation hold their difference from it (see
    `model_errors`), so it is calibrated, too.

    measured: from `measured_network`. progress: called with the Round after every round. earlier:
    by collocation, with these exposures and others; the network starts with its solution; the
    adjustment without correction is then not made: its residuals are those of the start. Raises
    DataError if the observations do not suffice.
    """
    options = options or CalibrationOptions()
    network = replace(measured.network, interior_free=interiors_to_estimate(measured, options))
    measured = with_constraints(replace(measured, network=network), options)
    if earlier is not None:
        return _continued(measured, earlier, options, progress)
    before = _adjusted_without_correction(measured, options)
    job = _Job(measured, before, gauges_of(measured, options), options)
    if options.model == AUTO:
        run, terms = job.by_collocation(progress)
        better = better_model(run, terms)
        if better is None:
            return run
        return with_errors_by(run, job.by_model(estimator_of(better), progress), job.gauges)
    source = estimator_of(options.model)
    run = job.by_model(source, progress)
    if source.kind in (START_MODEL, NoCorrection.kind):
        return run
    try:
        reference, _ = job.by_collocation(None)
    except DataError:  # what its own residuals show has to do
        return run
    return with_errors_by(reference, run, job.gauges)


def _continued(
    measured: Measured,
    earlier: EarlierCalibration,
    options: CalibrationOptions,
    progress: Callable[[Round], None] | None,
) -> SelfCalibration:
    """Self-calibrate by collocation from the solution of an earlier calibration."""
    network = measured.network
    residuals, q = residuals_and_q(network, measured.start, 0.0, earlier.noise)
    start = Adjustment(
        parameters=measured.start,
        residuals=residuals,
        q=q,
        noise=earlier.noise,
        cost=np.inf,
        steps=0,
        converged=False,
        exposure=network.exposure,
    )
    problem = AdjustmentProblem(
        network, measured.image_size, start, gauges_of(measured, options), measured.angles
    )
    names = measured.fluoroscopes
    terms = CollocationTerms(
        problem,
        earlier=EarlierTerms(
            [earlier.series[name] for name in names],
            [earlier.priors.get(name) for name in names],
            not earlier.varying.isdisjoint(names),
        ),
    )
    run = calibrate_by_adjustment(
        measured,
        start,
        model_type=CollocationModel,
        terms=terms,
        max_rounds=options.max_iterations,
        progress=progress,
    )
    earlier.priors.update(zip(names, terms.priors))
    return run


@dataclass(frozen=True)
class _Job:
    """A network that is calibrated with one model or more."""

    measured: Measured
    before: Adjustment  #: without correction
    gauges: Sequence[GaugeKind]
    options: CalibrationOptions

    @property
    def problem(self) -> AdjustmentProblem:
        """What terms in the adjustment are made for."""
        measured = self.measured
        return AdjustmentProblem(
            measured.network, measured.image_size, self.before, self.gauges, measured.angles
        )

    def by_model(
        self, source: Estimator, progress: Callable[[Round], None] | None
    ) -> SelfCalibration:
        """Self-calibrate with a model in the way it asks for."""
        terms = source.adjusted_terms(self.problem)
        steps = self._regression_steps(source, terms)
        if steps is None:
            return self._by_terms(source, terms, progress)
        return calibrate_by_regression(
            self.measured,
            self.before,
            options=self.options,
            terms=terms,
            regressions=Regressions(self.measured, steps),
            progress=progress,
        )

    def by_collocation(
        self, progress: Callable[[Round], None] | None
    ) -> tuple[SelfCalibration, CollocationTerms]:
        """Self-calibrate with collocation; return its terms, too."""
        terms = CollocationTerms(self.problem)
        return self._by_terms(estimator_of(START_MODEL), terms, progress), terms

    def _by_terms(
        self,
        source: Estimator,
        terms: AdjustedTerms | None,
        progress: Callable[[Round], None] | None,
    ) -> SelfCalibration:
        model = model_type(source.kind)
        if terms is None or not issubclass(model, SeriesModel):
            raise TypeError(
                f'the correction model {source.kind} has neither terms nor a regression'
            )
        return calibrate_by_adjustment(
            self.measured,
            self.before,
            model_type=model,
            terms=terms,
            max_rounds=self.options.max_iterations,
            progress=progress,
        )

    def _regression_steps(
        self, source: Estimator, terms: AdjustedTerms | None
    ) -> dict[str, RegressionStep[CorrectionModel]] | None:
        """The regression step of every fluoroscope; None for a model that needs none."""
        network = self.measured.network
        steps = {}
        for f, name in enumerate(self.measured.fluoroscopes):
            rows = network.rows(f)
            points = TrainingPoints(
                network.uv[rows],
                network.exposure[rows],
                self.measured.image_size[f],
                self.gauges[f],
                None if terms is None else terms.values[f],
            )
            step = source.regression(points, self.options.k)
            if step is None:
                return None
            steps[name] = step
        return steps


def _adjusted_without_correction(
    measured: Measured,
    options: CalibrationOptions,
) -> Adjustment:
    """Adjustment without correction. Raises DataError where it leaves unknowns undetermined."""
    try:
        before, precise = adjusted_with_precision(
            measured.network,
            measured.start,
            correction=np.zeros_like(measured.network.uv),
            noise=start_noise(options.loss),
            tolerance=TOLERANCE if options.model == NoCorrection.kind else FINAL_TOLERANCE,
        )
    except DataError as error:
        raise DataError(undetermined_unknowns(measured) or error.finding) from None
    raise_if_undetermined(measured, before, precise)
    return before
