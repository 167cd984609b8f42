"""The self-calibration of Chow et al. and beyond: a robust bundle adjustment and a model of the
distortion.

knn, local_linear and hybrid are the paper's way. One round: a correction model is fitted to
(residual + present correction) of the inliers, its k chosen by cross-validation; the network is
adjusted with that correction held. The rounds are a fixed-point iteration of the values the model
is fitted to; Anderson acceleration shortens it. In hybrid a trend is adjusted along. collocation
and parametric are adjusted as a whole (see turns). Model and adjustment of a round belong
together.
"""

from dataclasses import dataclass, replace

import numpy as np

from ..distortion.models import CorrectionModel
from ..distortion.regressor import MIN_TRAINING, Regressor
from ..errors import DataError
from ..photogrammetry.adjustment import Adjustment, SolverOptions, adjust
from ..photogrammetry.elimination import factorize
from ..photogrammetry.noise import Noise
from ..photogrammetry.noise_estimation import SETTLED, adjust_and_estimate_noise, estimate_noise
from ..photogrammetry.normal_equations import normal_equations
from ..photogrammetry.precision import (
    Precision,
    covariance_blocks,
    precision,
    residual_covariance,
)
from .anderson import Anderson
from .collocation import Collocation
from .initial_network import Measured
from .joint import constrained, refuse_undetermined, what_is_open
from .model_choice import better_kind
from .options import CalibrationOptions
from .stepwise import Terms
from .turns import adjust_in_turns

ROUND_TOLERANCE = 1e-4  # decrease of F that a round may leave to the next: a hundredth of a sigma
START_GROSS = 0.01  # share of gross errors with which the estimation of the noise begins
SETTLED_PX = 2e-3  # RMS change of the correction below which a round is taken as the last


@dataclass(frozen=True)
class Round:
    """One round of the loop.

    F negative log-likelihood; G weighted square sum of the cross-validation, or of the inlier
    residuals where the model is adjusted as a whole; k (0 for a model without neighbours) and RMSE
    (2,) of the inlier residuals [px] by fluoroscope; quadratic: robustly weighted square sum of
    the residuals [px^2]; change: RMS change of the correction that the next round would make [px].
    """

    iteration: int
    F: float
    G: float
    k: dict
    rmse: dict
    quadratic: float
    change: float


@dataclass(frozen=True)
class SelfCalibration:
    """Result of a self-calibration.

    measured network, with the additional parameters of the model; adjustment before (without
    correction) and after; precision after; correction (N, 2) [px] of the image points, additional
    parameters included; trained (N,) True for those the models were fitted to; models by
    fluoroscope; history of Rounds; converged: False where the largest number of rounds ended it.
    """

    measured: Measured
    before: Adjustment
    after: Adjustment
    precision: Precision
    correction: np.ndarray
    trained: np.ndarray
    models: dict
    history: tuple
    converged: bool


class _State:
    """Regressors of all fluoroscopes of a network, as one smoother of values (N, 2)."""

    def __init__(self, measured, options, trend):
        network = measured.network
        self.rows = {name: network.rows(f) for f, name in enumerate(measured.fluoroscopes)}
        self.regressors = {
            name: Regressor(
                options.model,
                network.uv[rows],
                network.exposure[rows],
                options.interior == 'fixed',
                options.k,
                None if trend is None else trend.values[f],
            )
            for f, (name, rows) in enumerate(self.rows.items())
        }

    def choose(self, values, adjustment, information):
        """Inliers and k of this round; returns G and whether anything changed."""
        for name, rows in self.rows.items():
            try:
                self.regressors[name].choose(values[rows], adjustment.q[rows], information[rows])
            except ValueError as error:
                raise DataError(f'fluoroscope {name}: {error}') from None
        return (
            sum(r.score for r in self.regressors.values()),
            any(r.changed for r in self.regressors.values()),
        )

    def inliers(self):
        """True (N,) for the image points to which the models are fitted."""
        out = np.zeros(sum(len(rows) for rows in self.rows.values()), dtype=bool)
        for name, rows in self.rows.items():
            out[rows] = self.regressors[name].inliers
        return out

    def without_gauge(self, values, interior):
        """Values (N, 2) with a fitted correction that is orthogonal to the gauge."""
        out = values.copy()
        for f, (name, rows) in enumerate(self.rows.items()):
            out[rows] = self.regressors[name].without_gauge(values[rows], interior[f])
        return out

    def smooth(self, values):
        """Fitted corrections (N, 2) of values (N, 2)."""
        out = np.zeros_like(values)
        for name, rows in self.rows.items():
            out[rows] = self.regressors[name].smooth(values[rows])
        return out


def rmse_of_inliers(adjustment, rows):
    """RMSE (2,) [px] in u and v of the raw inlier residuals of the image points rows."""
    r = adjustment.residuals[rows][adjustment.inliers[rows]]
    return np.sqrt(np.mean(r * r, axis=0)) if len(r) else np.full(2, np.nan)


def start_noise(loss):
    """Noise model with which an estimation begins: beside a Student-t, gross errors are looked
    for.
    """
    return Noise(loss, gross=START_GROSS if loss == 'student_t' else 0.0)


def adjusted_with_precision(
    network, start, correction, noise, tolerance=1e-8, raise_if_cancelled=None, noise_held=False
):
    """Adjustment and Precision of a network; noise: start values, or the noise model where
    noise_held.

    Raises DataError where the network does not determine the unknowns.
    """
    try:
        if noise_held:
            result = adjust(
                network, start, correction, noise, SolverOptions(tolerance), raise_if_cancelled
            )
        else:
            result = adjust_and_estimate_noise(
                network, start, correction, noise, SolverOptions(tolerance), raise_if_cancelled
            )
        return result, precision(network, result, correction)
    except np.linalg.LinAlgError:
        raise DataError(
            'the exposures do not determine the unknowns: the normal matrix is singular; '
            'add exposures with the phantom turned and moved'
        ) from None


def self_calibrate(measured, options=CalibrationOptions(), progress=None, raise_if_cancelled=None):
    """Self-calibrate the fluoroscopes of a network (section 3.1 of Chow et al.).

    measured: from measured_network; progress(Round) is called after every round;
    raise_if_cancelled() before every step of an adjustment, and may raise to stop. Returns
    SelfCalibration. Raises DataError where the observations do not suffice.
    """
    network = replace(
        measured.network,
        interior_free=np.full(len(measured.fluoroscopes), options.interior == 'estimated'),
    )
    measured = constrained(replace(measured, network=network), options)
    network = measured.network
    try:
        before, precise = adjusted_with_precision(
            network,
            measured.start,
            np.zeros_like(network.uv),
            start_noise(options.loss),
            raise_if_cancelled=raise_if_cancelled,
        )
    except DataError as error:
        raise DataError(what_is_open(measured) or str(error)) from None
    refuse_undetermined(measured, before, precise)
    if options.model not in ('auto', 'collocation', 'parametric'):
        return _alternate(measured, before, options, progress, raise_if_cancelled)
    try:
        run, state = _adjust_as_a_whole(measured, before, options, progress, raise_if_cancelled)
    except np.linalg.LinAlgError:
        raise DataError(
            'the exposures do not determine orientation and distortion: the normal matrix is singular; '
            'add exposures with the phantom turned and moved'
        ) from None
    if options.model != 'auto':
        return run
    kind = better_kind(run, state)
    return (
        run
        if kind is None
        else self_calibrate(measured, replace(options, model=kind), progress, raise_if_cancelled)
    )


def _adjust_as_a_whole(measured, before, options, progress, raise_if_cancelled):
    """SelfCalibration with the model among the unknowns, collocation or stepwise terms, and the
    model's state.
    """
    history = []

    def report(adjustment, change):
        square = float(np.sum(adjustment.q[adjustment.inliers]))
        for f, name in enumerate(measured.fluoroscopes):
            count = int(adjustment.inliers[measured.network.rows(f)].sum())
            if count < MIN_TRAINING:
                raise DataError(
                    f'fluoroscope {name}: {count} inliers are too few for the correction model, '
                    f'{MIN_TRAINING} are needed'
                )
        history.append(
            _round(
                len(history) + 1,
                measured,
                adjustment,
                square,
                dict.fromkeys(measured.fluoroscopes, 0),
                change,
            )
        )
        if progress is not None:
            progress(history[-1])

    kind = 'parametric' if options.model == 'parametric' else 'collocation'
    state = {'parametric': Terms, 'collocation': Collocation}[kind](
        measured, before, options.interior == 'fixed'
    )
    network, after, converged = adjust_in_turns(
        measured, before, state, options.max_iterations, report, raise_if_cancelled
    )
    correction = network.additional_correction(after.parameters)
    precise = precision(network, after)
    measured = replace(measured, network=network)
    inliers = after.inliers
    models = {}
    for f, name in enumerate(measured.fluoroscopes):
        rows = network.rows(f)
        rows = rows[inliers[rows]]
        models[name] = CorrectionModel(
            kind,
            0,
            network.uv[rows],
            (after.residuals + correction)[rows],
            series=state.series(f, after.parameters.additional[f], precise.additional[f]),
        )
    return SelfCalibration(
        measured, before, after, precise, correction, inliers, models, tuple(history), converged
    ), state


def _alternate(measured, before, options, progress, raise_if_cancelled):
    """SelfCalibration by adjustment and regression in turn."""
    network = measured.network
    trend = None
    if options.model == 'hybrid':
        trend = Collocation(measured, before, options.interior == 'fixed', modes=0)
        network = trend.with_additional(network)
        before_parameters = replace(before.parameters, additional=trend.zeros())
    else:
        before_parameters = before.parameters
    state = _State(measured, options, trend)
    history = []
    accelerated = Anderson()
    after = replace(before, parameters=before_parameters)
    noise = before.noise
    converged = False
    values = before.residuals
    information = _information(network, after, np.zeros_like(network.uv))[0]
    for iteration in range(1, options.max_iterations + 1):
        g_cost, changed = state.choose(values, after, information)
        if changed:
            accelerated.restart()
        values = state.without_gauge(values, after.parameters.interior)
        correction = state.smooth(values)
        after = adjust(
            network,
            after.parameters,
            correction,
            noise,
            SolverOptions(ROUND_TOLERANCE),
            raise_if_cancelled,
        )
        information, noise = _information(network, after, correction)
        image = state.without_gauge(after.residuals + correction, after.parameters.interior)
        core = state.inliers()
        change = float(np.sqrt(np.mean((state.smooth(image) - correction)[core] ** 2)))
        k = {name: regressor.k for name, regressor in state.regressors.items()}
        history.append(_round(iteration, measured, after, g_cost, k, change))
        if progress is not None:
            progress(history[-1])
        steady = abs(noise.scale - after.noise.scale) <= SETTLED * noise.scale
        if options.model == 'none' or (
            not changed and steady and _settled(history, options.tolerance)
        ):
            converged = after.converged
            break
        if iteration < options.max_iterations:
            # Outliers follow, but do not steer the acceleration.
            values = accelerated.next(values, image, core)
    # The correction of the last round stays; what its adjustment left to a next one is done here.
    after, precise = adjusted_with_precision(
        network,
        after.parameters,
        correction,
        noise,
        raise_if_cancelled=raise_if_cancelled,
        noise_held=True,
    )
    added = network.additional_correction(after.parameters)
    models = {
        name: state.regressors[name].model(
            values[rows],
            None
            if trend is None
            else trend.series(f, after.parameters.additional[f], precise.additional[f]),
        )
        for f, (name, rows) in enumerate(state.rows.items())
    }
    return SelfCalibration(
        replace(measured, network=network),
        before,
        after,
        precise,
        correction + added,
        state.inliers(),
        models,
        tuple(history),
        converged,
    )


def _information(network, adjustment, correction):
    """C_r^-1 (N, 2, 2) [1/px^2] of the residuals, and the noise model that they show. Raises
    DataError.
    """
    try:
        matrix = factorize(
            network, normal_equations(network, adjustment.parameters, correction, adjustment.noise)
        )
    except np.linalg.LinAlgError:
        raise DataError(
            'the exposures do not determine the unknowns: the normal matrix is singular; '
            'add exposures with the phantom turned and moved'
        ) from None
    blocks = covariance_blocks(matrix)
    return np.linalg.inv(residual_covariance(network, adjustment, blocks)), estimate_noise(
        network, adjustment, blocks
    )


def _round(iteration, measured, adjustment, g_cost, k, change):
    """The record of a round."""
    weighted = adjustment.noise.weight(adjustment.q)[:, None] * adjustment.residuals**2
    rmse = {
        name: rmse_of_inliers(adjustment, measured.network.rows(f))
        for f, name in enumerate(measured.fluoroscopes)
    }
    return Round(iteration, adjustment.cost, float(g_cost), k, rmse, float(weighted.sum()), change)


def _settled(history, tolerance):
    """Whether F and G have stopped changing, and the correction with them."""
    if len(history) < 2:
        return False
    last = history[-2]
    now = history[-1]
    # F is a log-likelihood and may pass zero: its change counts against the number of image
    # points' size.
    d_f = abs(now.F - last.F) / max(abs(now.F), now.G)
    d_g = abs(now.G - last.G) / max(now.G, 1e-300)
    return d_f <= tolerance and d_g <= tolerance and now.change <= SETTLED_PX
