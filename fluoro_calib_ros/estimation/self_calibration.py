# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Self-calibration of a network: robust bundle adjustment and a model of the distortion.

Each model determines how it is obtained. Its coefficients are unknowns of the adjustment
(`adjusted_terms`, see `calibrate_by_adjustment`), or it is fitted to the residuals between
adjustments (`regression`, see `alternation`), or both. `ESTIMATORS` is the only place that lists
them; a model over the k nearest residuals needs no entry, because `NeighbourRegression` fits it.
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
from ..findings import Place
from ..photogrammetry.adjustment import (
    TOLERANCE,
    Adjustment,
    adjust_with_matrix,
    residuals_and_q,
)
from ..photogrammetry.elimination import factorize
from ..photogrammetry.network import Network, in_determined_datum
from ..photogrammetry.normal_equations import normal_equations
from ..photogrammetry.outliers import estimate_noise, shows_noise
from ..photogrammetry.precision import (
    Precision,
    covariance_blocks,
    covariance_of_projection,
    precision,
)
from .alternation import Regressions, calibrate_by_regression
from .collocation import CollocationTerms, EarlierTerms
from .constraints import gauges_of, interiors_to_estimate, with_constraints
from .estimator import (
    FINAL_TOLERANCE,
    AdjustedTerms,
    AdjustmentProblem,
    Estimator,
    GaugeKind,
    RegressionStep,
    TrainingPoints,
    require_training,
)
from .initial_network import (
    TOO_FLAT,
    EarlierCalibration,
    Measured,
    adjusted_with_precision,
    is_hardly_tilted,
    start_noise,
    undetermined,
    with_additional,
)
from .lack_of_fit import FittedPoints, sd_with_lack_of_fit
from .model_choice import START_MODEL, better_model, with_errors_by
from .neighbour_regression import NeighbourRegression
from .options import AUTO, CalibrationOptions, user_estimator
from .parametric import StepwiseTerms
from .rounds import History, Round, SelfCalibration, raise_if_undetermined, undetermined_unknowns


class NoRegression(RegressionStep[NoCorrection]):
    """Regression step of the model that corrects nothing."""

    iterates = False

    def choose(
        self, values: NDArray[np.float64], q: NDArray[np.float64], information: NDArray[np.float64]
    ) -> None:
        """Update the inliers and sum their weighted squared residuals."""
        self.inliers = self._updated_inliers(q)
        inside = values[self.inliers]
        self.score = float(np.einsum('na,nab,nb', inside, information[self.inliers], inside))

    def without_gauge(
        self, values: NDArray[np.float64], interior: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the values."""
        return values

    def smooth(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return zeros (N, 2)."""
        return np.zeros_like(values)

    def model(self, values: NDArray[np.float64], series: Series | None = None) -> NoCorrection:
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

    model: name of a model, or a scikit-learn regressor. Raises ValueError for a name that a user
    cannot select.
    """
    if not isinstance(model, str):
        return user_estimator(model)
    if model not in selectable_models():
        raise ValueError(
            f'correction model must be one of {", ".join(selectable_models())}, not {model!r}'
        )
    if model in ESTIMATORS:
        return ESTIMATORS[model]
    model_class = model_type(model)
    if not issubclass(model_class, NeighbourModel):
        raise ValueError(f'correction model {model} has no estimator')
    return Estimator(model, regression=partial(NeighbourRegression, model_class))


def self_calibrate(
    measured: Measured,
    options: CalibrationOptions | None = None,
    progress: Callable[[Round], None] | None = None,
    earlier: EarlierCalibration | None = None,
) -> SelfCalibration:
    """Self-calibrate the fluoroscopes of a network.

    The standard deviations of models other than collocation include the difference from
    collocation (see `model_choice`), so that a collocation is calibrated too.

    measured: from `measured_network`. progress: called with the Round after every round. earlier:
    calibration by collocation with these exposures and others; the network starts with its
    solution. The adjustment without correction is then skipped: its residuals are those of the
    initial values. Raises DataError if the observations do not suffice.
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
        alternative = better_model(run, terms)
        if alternative is None:
            return run
        return with_errors_by(run, job.by_model(estimator_of(alternative), progress), job.gauges)
    source = estimator_of(options.model)
    run = job.by_model(source, progress)
    if source.kind in (START_MODEL, NoCorrection.kind):
        return run
    try:
        reference, _ = job.by_collocation(None)
    except DataError:  # only the model's own residuals are available to state its errors
        return run
    return with_errors_by(reference, run, job.gauges)


def _continued(
    measured: Measured,
    earlier: EarlierCalibration,
    options: CalibrationOptions,
    progress: Callable[[Round], None] | None,
) -> SelfCalibration:
    """Self-calibrate by collocation, starting at the solution of an earlier calibration."""
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
    names = measured.fluoroscopes
    earlier_terms = EarlierTerms(
        [earlier.series[name] for name in names],
        [earlier.priors.get(name) for name in names],
        not earlier.varying.isdisjoint(names),
    )
    job = _Job(measured, start, gauges_of(measured, options), options)
    run, terms = job.by_collocation(progress, earlier_terms)
    earlier.priors.update(zip(names, terms.priors))
    return run


@dataclass(frozen=True)
class _Job:
    """A network to calibrate with one model or more."""

    measured: Measured
    before: Adjustment  #: adjustment without correction
    gauges: Sequence[GaugeKind]
    options: CalibrationOptions

    @property
    def problem(self) -> AdjustmentProblem:
        """The problem that terms in the adjustment are made for."""
        measured = self.measured
        return AdjustmentProblem(
            measured.network, measured.image_size, self.before, self.gauges, measured.angles
        )

    def by_model(
        self, source: Estimator, progress: Callable[[Round], None] | None
    ) -> SelfCalibration:
        """Self-calibrate with a model by its estimator."""
        terms = None if source.adjusted_terms is None else source.adjusted_terms(self.problem)
        if source.regression is None:
            return self._by_terms(source, terms, progress)
        steps = self._regression_steps(source.regression, terms)
        return calibrate_by_regression(
            self.measured,
            self.before,
            options=self.options,
            terms=terms,
            regressions=Regressions(self.measured, steps),
            progress=progress,
        )

    def by_collocation(
        self, progress: Callable[[Round], None] | None, earlier: EarlierTerms | None = None
    ) -> tuple[SelfCalibration, CollocationTerms]:
        """Self-calibrate with collocation; return its terms too."""
        terms = CollocationTerms(self.problem, earlier=earlier)
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
        self,
        regression: Callable[[TrainingPoints, int | None], RegressionStep[Any]],
        terms: AdjustedTerms | None,
    ) -> dict[str, RegressionStep[CorrectionModel]]:
        """Return the regression step of every fluoroscope."""
        network = self.measured.network
        steps = {}
        for f, name in enumerate(self.measured.fluoroscopes):
            rows = network.rows(f)
            points = TrainingPoints(
                network.uv[rows],
                network.exposure[rows],
                self.measured.image_size[f],
                self.gauges[f],
                None if terms is None else terms.parts[f].values,
            )
            steps[name] = regression(points, self.options.k)
        return steps


def _adjusted_without_correction(
    measured: Measured,
    options: CalibrationOptions,
) -> Adjustment:
    """Adjust without correction. Raises DataError if unknowns are undetermined."""
    is_result = options.model == NoCorrection.kind
    try:
        before, precise = adjusted_with_precision(
            measured.network,
            measured.start,
            correction=0.0,
            noise=start_noise(options.loss),
            tolerance=TOLERANCE if is_result else FINAL_TOLERANCE,
        )
    except DataError as error:
        raise DataError(undetermined_unknowns(measured) or error.finding) from None
    raise_if_undetermined(measured, before, precise)
    return before


# Self-calibration with the distortion among the unknowns of the adjustment.
#
# In the alternation of Chow et al. the orientations and object points absorb part of the
# distortion before the regressor sees it. Here all are adjusted together. Between adjustments,
# only the noise model and the assumptions of the distortion terms are updated: the prior of a
# signal, or the selection of terms.

# Decrease of F for each image point that the first adjustment may leave: its noise is still that
# of an adjustment without correction.
FIRST_TOLERANCE = 1e-3
# Information factor above which the matrix of the last step is used to estimate noise and prior.
NEARLY_ONE = 0.98


def calibrate_by_adjustment(
    measured: Measured,
    before: Adjustment,
    model_type: type[CorrectionModel],
    terms: AdjustedTerms,
    max_rounds: int,
    progress: Callable[[Round], None] | None = None,
) -> SelfCalibration:
    """Self-calibrate with the coefficients of the model as unknowns.

    before: adjustment without correction. model_type: a model that is a series. terms: of this
    model, for the network of measured. progress: called with the Round after every adjustment.

    Raises DataError if there are too few inliers, or the exposures do not determine the unknowns.
    """
    history = History(measured, progress)

    def report(adjustment: Adjustment, change: float) -> None:
        _require_inliers(measured, adjustment)
        square = float(np.sum(adjustment.q[adjustment.inliers]))
        history.add(adjustment, square, dict.fromkeys(measured.fluoroscopes, 0), change)

    try:
        network, after, converged = adjust_with_terms(
            measured.network,
            before,
            terms=terms,
            max_rounds=max_rounds,
            report=report,
        )
        network, parameters = in_determined_datum(network, after.parameters, after.inliers)
        after = replace(after, parameters=parameters)
        precise = precision(network, after)
        parts = dict(zip(measured.fluoroscopes, terms.parts))
        fields = {name: part.fit_angles(after, precise) for name, part in parts.items()}
        between = {
            name: part.variance_between_exposures(network, after, precise)
            for name, part in parts.items()
        }
    except np.linalg.LinAlgError:
        raise undetermined(measured.network) from None
    measured = replace(measured, network=network)
    return SelfCalibration(
        measured=measured,
        before=before,
        after=after,
        precision=precise,
        correction=network.additional_correction(after.parameters),
        trained=after.inliers,
        models=_models(model_type, terms, measured, after, precise),
        history=tuple(history.rounds),
        converged=converged,
        between_exposures=between,
        angle_fields={name: field for name, field in fields.items() if field is not None},
    )


def _models(
    model_type: type[CorrectionModel],
    terms: AdjustedTerms,
    measured: Measured,
    after: Adjustment,
    precise: Precision,
) -> dict[str, CorrectionModel]:
    """Return models by fluoroscope, from the terms that an adjustment has estimated.

    measured: network with these terms as additional parameters.
    """
    network = measured.network
    values = after.residuals + network.additional_correction(after.parameters)
    models = {}

    for name, part in zip(measured.fluoroscopes, terms.parts):
        rows = part.rows[after.inliers[part.rows]]
        series = part.fitted_series(after, precise)
        inliers = FittedPoints(
            network.uv[rows],
            after.residuals[rows],
            network.exposure[rows],
            precise.redundancy[rows].mean(axis=1),
        )
        sd = sd_with_lack_of_fit(inliers, series, part.left_out())
        models[name] = model_type(0, network.uv[rows], values[rows], series=replace(series, sd=sd))
    return models


def _require_inliers(measured: Measured, adjustment: Adjustment) -> None:
    """Raise DataError if a fluoroscope has too few inliers for a correction model."""
    for f, name in enumerate(measured.fluoroscopes):
        try:
            require_training(int(adjustment.inliers[measured.network.rows(f)].sum()))
        except ValueError as error:
            if measured.network.interior_free[f] and is_hardly_tilted(measured):
                # The principal distance has diverged, and the residuals with it.
                raise DataError(replace(TOO_FLAT, place=Place((name,)))) from None
            raise DataError(f'fluoroscope {name}: {error}') from None


def adjust_with_terms(
    plain: Network,
    before: Adjustment,
    terms: AdjustedTerms,
    max_rounds: int,
    report: Callable[[Adjustment, float], None],
) -> tuple[Network, Adjustment, bool]:
    """Adjust a network together with terms of its distortion.

    plain: network without additional parameters. before: its adjustment without correction.
    report: called with every Adjustment and the RMS change of the correction [px].

    Returns the network with the terms as additional parameters, its adjustment, and whether it
    converged. Raises LinAlgError if the network does not determine the unknowns.
    """
    correction = np.zeros_like(plain.uv)
    parameters = with_additional(before, terms.start()).parameters
    noise = before.noise
    least_scale = 0.0  # of a noise of which the residuals say something
    converged = False
    for number in range(max_rounds):
        network = terms.with_additional(plain)
        is_final = converged or number == max_rounds - 1
        tolerance = terms.final_tolerance if is_final else terms.intermediate_tolerance
        if not number and not is_final:
            tolerance = max(tolerance, FIRST_TOLERANCE * network.n_image_points)
        result, matrix = adjust_with_matrix(
            network,
            parameters,
            noise=noise,
            tolerance=tolerance,
        )
        last = correction
        correction = network.additional_correction(result.parameters)
        report(result, float(np.sqrt(np.mean((correction - last) ** 2))))
        if is_final:
            break
        factor = noise.information_factor(result.q)
        if matrix is None or factor < NEARLY_ONE or terms.needs_solution:
            matrix = factorize(
                network, normal_equations(network, result.parameters, 0.0, noise, factor)
            )
        blocks = covariance_blocks(matrix)
        projected = covariance_of_projection(network, result.parameters, blocks)
        if shows_noise(network, noise, projected):
            estimated = estimate_noise(network, result, projected, matrix.information_factor)
            new_noise = replace(estimated, scale=max(estimated.scale, least_scale))
        else:
            least_scale = np.sqrt(2) * noise.scale
            new_noise = replace(noise, scale=least_scale)
        converged, coefficients = terms.renew(network, matrix, result)
        converged &= abs(new_noise.scale - noise.scale) <= terms.noise_tolerance * noise.scale
        parameters = replace(result.parameters, additional=coefficients)
        noise = new_noise
    return network, result, bool(converged and result.converged)
