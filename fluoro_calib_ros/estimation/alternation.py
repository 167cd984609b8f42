# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Self-calibration by alternating adjustment and regression (section 3.1 of Chow et al.).

Each round fits a correction model to (residual + present correction) of the inliers, with k chosen
by cross-validation, and then adjusts the network with that correction fixed. The rounds are a
fixed-point iteration of the values that the model is fitted to; Anderson acceleration shortens it.
The model and the adjustment of a round belong together.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..correction.base import CorrectionModel
from ..errors import DataError
from ..photogrammetry.adjustment import Adjustment, adjust
from ..photogrammetry.elimination import factorize
from ..photogrammetry.network import Network, in_determined_datum
from ..photogrammetry.noise import Noise
from ..photogrammetry.normal_equations import normal_equations
from ..photogrammetry.outliers import SETTLED, estimate_noise
from ..photogrammetry.precision import (
    Precision,
    covariance_blocks,
    covariance_of_projection,
    residual_covariance,
)
from .estimator import AdjustedTerms, RegressionStep
from .initial_network import (
    ROUND_TOLERANCE,
    Measured,
    adjusted_with_precision,
    undetermined,
    with_additional,
)
from .options import CalibrationOptions
from .rounds import History, Round, SelfCalibration, has_settled

# Anderson acceleration of a fixed-point iteration.
#
# Walker and Ni, "Anderson acceleration for fixed-point iterations", SIAM Journal on Numerical
# Analysis 49, 2011.

RELATIVE_RANK = 1e-6  # drop singular values of the differences below this part of the largest


class Anderson:
    """Mix the last iterates of x -> f(x) so that the residual f(x) - x is smallest.

    depth: number of earlier iterates used. The iterates are arrays of one shape.
    """

    def __init__(self, depth: int = 8) -> None:
        self._depth = depth
        self.restart()

    def restart(self) -> None:
        """Forget the earlier iterates, because the map has changed."""
        self._x: list[NDArray[np.float64]] = []
        self._f: list[NDArray[np.float64]] = []

    def next(
        self,
        x: NDArray[np.float64],
        f: NDArray[np.float64],
        counted: NDArray[np.bool_] | slice = slice(None),
    ) -> NDArray[np.float64]:
        """Return the next iterate from the present iterate x and its image f.

        counted: entries whose residual is minimised.
        """
        self._x = (self._x + [x])[-self._depth - 1 :]
        self._f = (self._f + [f])[-self._depth - 1 :]
        if len(self._x) == 1:
            return f
        residual = [(b - a)[counted].ravel() for a, b in zip(self._x, self._f)]
        d_residual = np.stack([b - a for a, b in pairwise(residual)], axis=1)
        # Scale the columns and drop small singular values: late differences are nearly parallel.
        scale = np.maximum(np.linalg.norm(d_residual, axis=0), 1e-300)
        gamma, *_ = np.linalg.lstsq(d_residual / scale, residual[-1], rcond=RELATIVE_RANK)
        return f - sum(g * (b - a) for g, a, b in zip(gamma / scale, self._f, self._f[1:]))


class Regressions:
    """Regression steps of all fluoroscopes of a network, as one smoother of values (N, 2).

    steps: {fluoroscope: RegressionStep}, in the order of the network.
    """

    def __init__(
        self, measured: Measured, steps: Mapping[str, RegressionStep[CorrectionModel]]
    ) -> None:
        self.steps = dict(steps)
        self._rows = {name: measured.network.rows(f) for f, name in enumerate(self.steps)}

    @property
    def iterate(self) -> bool:
        """Whether a second round can give another correction than the first."""
        return any(step.iterates for step in self.steps.values())

    @property
    def k(self) -> dict[str, int]:
        """Number of neighbours, by fluoroscope."""
        return {name: step.k for name, step in self.steps.items()}

    def choose(
        self, values: NDArray[np.float64], q: NDArray[np.float64], information: NDArray[np.float64]
    ) -> tuple[float, bool]:
        """Update the inliers and k of all fluoroscopes; return G and whether any of them changed.

        Raises DataError where a fluoroscope has too few inliers.
        """
        for name, rows in self._rows.items():
            try:
                self.steps[name].choose(values[rows], q[rows], information[rows])
            except ValueError as error:
                raise DataError(f'fluoroscope {name}: {error}') from None
        score = sum(step.score for step in self.steps.values())
        return score, any(step.changed for step in self.steps.values())

    def inliers(self) -> NDArray[np.bool_]:
        """Return True (N,) for the image points to which the models are fitted."""
        out = np.zeros(sum(len(rows) for rows in self._rows.values()), dtype=bool)
        for name, rows in self._rows.items():
            out[rows] = self.steps[name].inliers
        return out

    def without_gauge(
        self, values: NDArray[np.float64], interior: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Change values (N, 2) so that their fitted correction is orthogonal to the gauge."""
        out = values.copy()
        for f, (name, rows) in enumerate(self._rows.items()):
            out[rows] = self.steps[name].without_gauge(values[rows], interior[f])
        return out

    def smooth(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Fit values (N, 2) at the inliers; return the corrections (N, 2) at all image points."""
        out = np.zeros_like(values)
        for name, rows in self._rows.items():
            out[rows] = self.steps[name].smooth(values[rows])
        return out

    def models(
        self,
        values: NDArray[np.float64],
        terms: AdjustedTerms | None,
        after: Adjustment,
        precise: Precision,
    ) -> dict[str, CorrectionModel]:
        """Return the models of values (N, 2) by fluoroscope, with terms of the last adjustment."""
        out = {}
        for f, (name, rows) in enumerate(self._rows.items()):
            series = None if terms is None else terms.parts[f].fitted_series(after, precise)
            out[name] = self.steps[name].model(values[rows], series)
        return out


@dataclass(frozen=True)
class _Iterate:
    """State of the iteration after a round."""

    values: NDArray[np.float64]  #: (N, 2) values to which the models are fitted [px]
    information: NDArray[np.float64]  #: (N, 2, 2) inverse covariance of the residuals [1/px^2]
    after: Adjustment  #: adjustment of the round
    noise: Noise  #: noise model estimated from its residuals


class _Alternation:
    """Rounds of regression and adjustment for one network."""

    def __init__(
        self,
        network: Network,
        start: Adjustment,
        regressions: Regressions,
        history: History,
    ) -> None:
        #: (N, 2) fixed correction of the last round [px]
        self.correction = np.zeros_like(network.uv)
        self.changed = False  #: whether inliers or k changed in the last round
        self._network = network
        self._regressions = regressions
        self._history = history
        self._acceleration = Anderson()
        self._image = start.residuals
        information, _ = _information(network, start, self.correction)
        #: state after the last round
        self.state = _Iterate(start.residuals, information, start, start.noise)

    def advance(self) -> None:
        """Make one round: fit the models, adjust with their correction fixed, record the round."""
        regressions = self._regressions
        state = self.state
        score, self.changed = regressions.choose(state.values, state.after.q, state.information)
        if self.changed:
            self._acceleration.restart()
        values = regressions.without_gauge(state.values, state.after.parameters.interior)
        correction = regressions.smooth(values)
        after = adjust(
            self._network,
            state.after.parameters,
            correction=correction,
            noise=state.noise,
            tolerance=ROUND_TOLERANCE,
        )
        information, noise = _information(self._network, after, correction)
        image = regressions.without_gauge(after.residuals + correction, after.parameters.interior)
        inliers = regressions.inliers()
        change = float(np.sqrt(np.mean((regressions.smooth(image) - correction)[inliers] ** 2)))
        self._history.add(after, score, regressions.k, change)
        self.correction = correction
        self._image = image
        self.state = _Iterate(values, information, after, noise)

    def has_settled(self, tolerance: float) -> bool:
        """Whether another round would hardly change the result."""
        scale = self.state.noise.scale
        steady = abs(scale - self.state.after.noise.scale) <= SETTLED * scale
        return not self.changed and steady and has_settled(self._history.rounds, tolerance)

    def accelerate(self) -> None:
        """Replace the values of the next round by those that Anderson acceleration gives."""
        # Outliers are accelerated too, but only the residuals of inliers choose the mixture.
        values = self._acceleration.next(
            self.state.values, self._image, self._regressions.inliers()
        )
        self.state = replace(self.state, values=values)


def calibrate_by_regression(
    measured: Measured,
    before: Adjustment,
    options: CalibrationOptions,
    terms: AdjustedTerms | None,
    regressions: Regressions,
    progress: Callable[[Round], None] | None = None,
) -> SelfCalibration:
    """Self-calibrate by alternating adjustment and regression.

    before: adjustment without correction. terms: terms of the correction that the adjustments
    estimate. regressions: fit the remaining correction. progress: called with the Round after
    every round.

    Raises DataError if there are too few inliers, or the exposures do not determine the unknowns.
    """
    network = measured.network
    after = before
    if terms is not None:
        network = terms.with_additional(network)
        after = with_additional(before, terms.start())
    history = History(measured, progress)
    rounds = _Alternation(network, after, regressions, history)
    converged = False
    for iteration in range(1, options.max_iterations + 1):
        rounds.advance()
        if rounds.has_settled(options.tolerance) or not regressions.iterate:
            converged = rounds.state.after.converged
            break
        if iteration < options.max_iterations:
            rounds.accelerate()
    # Keep the correction of the last round, and complete its adjustment.
    last = rounds.state.after
    network, start = in_determined_datum(network, last.parameters, last.inliers)
    after, precise = adjusted_with_precision(
        network,
        start,
        rounds.correction,
        rounds.state.noise,
        noise_fixed=True,
    )
    return SelfCalibration(
        measured=replace(measured, network=network),
        before=before,
        after=after,
        precision=precise,
        correction=rounds.correction + network.additional_correction(after.parameters),
        trained=regressions.inliers(),
        models=regressions.models(rounds.state.values, terms, after, precise),
        history=tuple(history.rounds),
        converged=converged and after.converged,
    )


def _information(
    network: Network, adjustment: Adjustment, correction: NDArray[np.float64]
) -> tuple[np.ndarray, Noise]:
    """Return C_r^-1 (N, 2, 2) [1/px^2] of the residuals, and the noise model they show.

    Raises DataError where the normal matrix is singular.
    """
    try:
        matrix = factorize(
            network, normal_equations(network, adjustment.parameters, correction, adjustment.noise)
        )
    except np.linalg.LinAlgError:
        raise undetermined(network) from None
    blocks = covariance_blocks(matrix)
    projected = covariance_of_projection(network, adjustment.parameters, blocks)
    information = np.linalg.inv(residual_covariance(network, adjustment, projected))
    return information, estimate_noise(network, adjustment, projected)
