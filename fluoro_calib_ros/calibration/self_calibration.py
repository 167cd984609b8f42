"""The self-calibration of Chow et al.: a robust bundle adjustment in turn with a regressor of its residuals.

One round: a correction model is fitted to (residual + present correction) of the inliers, its k chosen by
cross-validation; the network is adjusted with that correction held. The rounds are a fixed-point iteration
of the values the model is fitted to; Anderson acceleration shortens it. Model and adjustment of a round
belong together.
"""

from dataclasses import dataclass, replace

import numpy as np

from ..distortion.regressor import Regressor
from ..distortion.smoothers import KINDS
from ..photogrammetry.adjustment import Adjustment, adjust, residuals_and_q
from ..photogrammetry.noise import LOSSES, Noise
from ..photogrammetry.observations import DataError
from ..photogrammetry.precision import Precision, geometric_redundancy, precision
from .anderson import Anderson
from .network import Measured

INTERIORS = ('estimated', 'fixed')
ROUND_TOLERANCE = 1e-4   # decrease of F that a round may leave to the next: a hundredth of a sigma
RESCALINGS = 6   # times that the redundancy numbers are renewed before the first adjustment counts
SETTLED_PX = 2e-3   # RMS change of the correction below which a round is taken as the last


@dataclass(frozen=True)
class Options:
    """Options of a self-calibration.

    model 'none', 'knn' or 'local_linear'; interior 'estimated' or 'fixed' (held, and learned by the model);
    loss 'student_t', 'huber' or 'gaussian'; k: neighbours, None: chosen; max_iterations of the loop;
    tolerance: relative change of F and G at which it ends. Raises ValueError for a value that is none of these.
    """

    model: str = 'local_linear'
    interior: str = 'estimated'
    loss: str = 'student_t'
    k: int | None = None
    max_iterations: int = 60
    tolerance: float = 1e-4

    def __post_init__(self):
        for name, values in (('model', KINDS), ('interior', INTERIORS), ('loss', LOSSES)):
            if getattr(self, name) not in values:
                raise ValueError(f'{name} is one of {", ".join(values)}, not {getattr(self, name)!r}')
        if self.max_iterations < 1 or not self.tolerance > 0:
            raise ValueError('max_iterations is at least 1 and tolerance above 0')


@dataclass(frozen=True)
class Round:
    """One round of the loop.

    F negative log-likelihood, G weighted square sum of the cross-validation; k and RMSE (2,) of the inlier
    residuals [px] by fluoroscope; quadratic: robustly weighted square sum of the residuals [px^2]; change:
    RMS change of the correction that the next round would make [px].
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

    measured network; adjustment before (without correction) and after; precision after; correction (N, 2)
    [px] of the image points; trained (N,) True for those the models were fitted to; models by fluoroscope;
    history of Rounds; converged: False where the largest number of rounds ended it.
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

    def __init__(self, measured, options):
        network = measured.network
        of_point = network.fluoroscope[network.exposure]
        self.rows = {name: np.flatnonzero(of_point == f) for f, name in enumerate(measured.fluoroscopes)}
        self.regressors = {
            name: Regressor(options.model, network.uv[rows], network.exposure[rows],
                            options.interior == 'fixed', options.k) for name, rows in self.rows.items()}

    def choose(self, values, adjustment, information):
        """Inliers and k of this round; returns G and whether anything changed."""
        for name, rows in self.rows.items():
            try:
                self.regressors[name].choose(values[rows], adjustment.q[rows], information[rows])
            except ValueError as error:
                raise DataError(f'fluoroscope {name}: {error}') from None
        return (sum(r.score for r in self.regressors.values()), any(r.changed for r in self.regressors.values()))

    def inliers(self):
        """True (N,) for the image points to which the models are fitted."""
        out = np.zeros(sum(len(rows) for rows in self.rows.values()), dtype=bool)
        for name, rows in self.rows.items():
            out[rows] = self.regressors[name].inliers
        return out

    def without_gauge(self, values, interior):
        """values (N, 2) with a fitted correction that is orthogonal to the gauge."""
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


def adjusted_with_precision(network, start, correction, noise, redundancy=None, tolerance=1e-8, check=None,
                            noise_held=False):
    """Adjustment and Precision of a network; redundancy (N,) or None: from its geometry; noise_held: as given.

    Raises DataError where the network does not determine the unknowns.
    """
    try:
        if redundancy is not None or noise_held:
            result = adjust(network, start, correction, noise, redundancy, tolerance, check=check,
                            noise_held=noise_held)
        else:
            result = _adjusted_from_afar(network, start, correction, noise, tolerance, check)
        return result, precision(network, result, correction)
    except np.linalg.LinAlgError:
        raise DataError('the exposures do not determine the unknowns: the normal matrix is singular; '
                        'add exposures with the phantom turned and moved') from None


def _adjusted_from_afar(network, start, correction, noise, tolerance, check):
    """Adjustment from start values, with redundancy numbers that belong to the noise scale it finds.

    Image points and survey share the redundancy according to their precision, so the numbers depend on the
    scale. The residuals at the start hold the errors of the survey too and give a scale that is rather too
    large: from there it comes down to its place, while from too small a one it could fall for ever.
    """
    _, q = residuals_and_q(network, start, correction, noise)
    if np.isfinite(q).all():
        noise = noise.estimated(q * noise.scale ** 2)
    parameters = start
    for _ in range(RESCALINGS):
        redundancy = geometric_redundancy(network, parameters, noise)
        result = adjust(network, parameters, correction, noise, redundancy, tolerance, check=check)
        settled = abs(result.noise.scale - noise.scale) <= 0.02 * noise.scale
        parameters, noise = result.parameters, result.noise
        if settled:
            break
    return result


def self_calibrate(measured, options=Options(), progress=None, check=None):
    """Self-calibrate the fluoroscopes of a network (section 3.1 of Chow et al.).

    measured: from measured_network; progress(Round) is called after every round; check() before every step
    of an adjustment, and may raise to stop. Returns SelfCalibration. Raises DataError where the observations
    do not suffice.
    """
    network = replace(measured.network, interior_free=np.full(
        len(measured.fluoroscopes), options.interior == 'estimated'))
    measured = replace(measured, network=network)
    correction = np.zeros_like(network.uv)
    before, precise = adjusted_with_precision(network, measured.start, correction, Noise(options.loss), check=check)
    state, after, history, accelerated = _State(measured, options), before, [], Anderson()
    converged = False
    values = before.residuals
    for iteration in range(1, options.max_iterations + 1):
        g_cost, changed = state.choose(values, after, np.linalg.inv(precise.residual))
        if changed:
            accelerated.restart()
        values = state.without_gauge(values, after.parameters.interior)
        correction = state.smooth(values)
        redundancy = geometric_redundancy(network, after.parameters, after.noise)
        after, precise = adjusted_with_precision(network, after.parameters, correction, after.noise,
                                                 redundancy, ROUND_TOLERANCE, check)
        image = state.without_gauge(after.residuals + correction, after.parameters.interior)
        core = state.inliers()
        change = float(np.sqrt(np.mean((state.smooth(image) - correction)[core] ** 2)))
        history.append(_round(iteration, after, g_cost, state, change))
        if progress is not None:
            progress(history[-1])
        if options.model == 'none' or (not changed and _settled(history, options.tolerance)):
            converged = after.converged
            break
        if iteration < options.max_iterations:
            # Outliers follow, but do not steer the acceleration.
            values = accelerated.next(values, image, core)
    # The correction of the last round stays; what its adjustment left to a next one is done here.
    after, precise = adjusted_with_precision(network, after.parameters, correction, after.noise, redundancy,
                                             check=check)
    models = {name: state.regressors[name].model(values[rows]) for name, rows in state.rows.items()}
    return SelfCalibration(measured, before, after, precise, correction, state.inliers(), models, tuple(history),
                           converged)


def _round(iteration, adjustment, g_cost, state, change):
    """The record of a round."""
    weighted = adjustment.noise.weight(adjustment.q)[:, None] * adjustment.residuals ** 2
    return Round(iteration, adjustment.cost, float(g_cost), {n: r.k for n, r in state.regressors.items()},
                 {n: rmse_of_inliers(adjustment, rows) for n, rows in state.rows.items()},
                 float(weighted.sum()), change)


def _settled(history, tolerance):
    """Whether F and G have stopped changing, and the correction with them."""
    if len(history) < 2:
        return False
    last, now = history[-2], history[-1]
    # F is a log-likelihood and may pass zero: its change counts against the number of image points' size.
    d_f = abs(now.F - last.F) / max(abs(now.F), now.G)
    d_g = abs(now.G - last.G) / max(now.G, 1e-300)
    return d_f <= tolerance and d_g <= tolerance and now.change <= SETTLED_PX
