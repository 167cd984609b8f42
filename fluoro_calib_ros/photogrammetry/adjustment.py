# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Robust bundle adjustment of one or more fluoroscopes that observe one phantom.

For a given noise model, maximise the likelihood of the image points (Student-t, Huber or Gaussian)
and of the surveyed coordinates (Gaussian; they define the datum unless inner constraints do). The
solver is Levenberg-Marquardt with Nielsen's damping (Madsen, Nielsen and Tingleff, "Methods for
non-linear least squares problems", DTU 2004), iteratively reweighted. Between two linearisations
it takes quasi-Newton steps. `outliers` estimates the noise model in an outer loop.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .elimination import (
    BorderedFactor,
    BorderedSystem,
    Elimination,
    FactorizedNormalMatrix,
)
from .network import Network, transform_to_datum
from .noise import DEFAULT_NOISE, Noise, widening_by_group
from .normal_equations import normal_equations, project_network, right_sides
from .unknowns import Parameters, discrepancies

# Relative increase of the cost that rounding errors can cause.
ROUNDING = 1e-12
UNDAMPED = 1e-6  # damping that changes no covariance visibly
# Largest decrease of F for each image point with the last normal matrix: a larger one changes the
# weights of the image points, and outliers would keep points that are lost on the way.
SAME_WEIGHTS_DECREASE = 0.01
SECANTS = 10  # secants of quasi-Newton steps; 3 to 20 are usual (Nocedal and Wright, p. 177)
TOLERANCE = 1e-8  # predicted decrease of the cost F at which an adjustment ends
MAX_STEPS = 100  # largest number of steps of an adjustment, including refused steps


@dataclass(frozen=True)
class Adjustment:
    """Result of an adjustment."""

    parameters: Parameters
    residuals: NDArray[np.float64]  #: (N, 2) observed - correction - projected [px]
    q: NDArray[np.float64]  #: (N,) normalised squared residuals
    noise: Noise  #: noise model of the adjustment
    cost: float  #: F, the negative log-likelihood
    steps: int  #: number of steps, including refused steps
    converged: bool
    exposure: NDArray[np.int64]  #: (N,) exposure of each image point

    @cached_property
    def inliers(self) -> NDArray[np.bool_]:
        """True (N,) for the image points in the core of the noise distribution.

        The limit is wider for an exposure whose image points scatter more than those of others.
        """
        size = np.sqrt(self.q / self.noise.median)
        limit = float(np.sqrt(self.noise.limit / self.noise.median))
        return self.noise.accepts(self.q / widening_by_group(size, limit, self.exposure) ** 2)


def residuals_and_q(
    network: Network, parameters: Parameters, correction: NDArray[np.float64] | float, noise: Noise
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return residuals (N, 2) [px] and normalised squared residuals (N,).

    Both are NaN if a point is behind the source.
    """
    additional = network.additional_correction(parameters)
    r = network.uv - correction - additional - project_network(network, parameters)
    return r, np.sum(r * r, axis=1) / (noise.scale * network.sigma) ** 2


def total_cost(
    network: Network, parameters: Parameters, q: NDArray[np.float64], noise: Noise
) -> float:
    """Return F, the negative log-likelihood of all observations, constraints and priors.

    Infinite if a point is behind the source. Constants of Gaussian terms are omitted.
    """
    if not np.isfinite(q).all():
        return np.inf
    square = 0.0
    for f, additional in enumerate(network.additional):
        if additional is not None:
            square += additional.penalty(parameters.additional_of(f))
    if network.datum == 'survey':
        survey_residuals = parameters.points_mm - network.survey_mm
        square += float(np.sum((survey_residuals / network.survey_sd_mm[:, None]) ** 2))
    if network.interior_mean is not None:
        difference = parameters.interior - network.interior_mean
        square += float(np.sum(network.interior_weight * difference**2))
    if network.exterior is not None:
        discrepancy = network.exterior.discrepancies(parameters.rotation, parameters.position_mm)
        square += float(np.sum(network.exterior.weights * discrepancy**2))
    for constraint, pose in zip(network.relative, parameters.relative):
        discrepancy = discrepancies(constraint, pose, parameters)
        square += float(np.sum(discrepancy**2 @ constraint.weights))
    value = noise.cost(q, network.sigma) + square / 2
    return float(value) if np.isfinite(value) else np.inf


@dataclass(frozen=True)
class _Iterate:
    """Parameters of one iteration with their residuals, normalised squares and cost."""

    parameters: Parameters
    residuals: NDArray[np.float64]
    q: NDArray[np.float64]
    cost: float


@dataclass(frozen=True)
class _Solver:
    """Normal equations, and their factors with damping mu."""

    system: BorderedSystem
    factor: BorderedFactor
    mu: float


@dataclass(frozen=True)
class _Step:
    """A step (x,) of the unknowns in the order of elimination, and its predicted decrease of F."""

    x: NDArray[np.float64]
    predicted: float


class _Secants:
    """Inverse of the matrix of second derivatives of F, corrected by the last steps.

    Limited-memory BFGS (Nocedal and Wright, "Numerical Optimization", 2nd ed. 2006, algorithm
    7.4), with a factorized normal matrix as initial approximation. With redescending weights the
    normal matrix is far larger than the second derivatives in some directions, and steps with it
    alone creep. Call `arrived` at each position, and `moved` with the step from there.
    """

    def __init__(self) -> None:
        self._pairs: deque[tuple[NDArray[np.float64], NDArray[np.float64]]] = deque(maxlen=SECANTS)
        self._right: NDArray[np.float64] | None = None  # at the last position
        self._step: NDArray[np.float64] | None = None  # from there

    def moved(self, step: NDArray[np.float64]) -> None:
        """Note the step (x,) that was accepted at the last position."""
        self._step = step

    def arrived(self, right: NDArray[np.float64]) -> None:
        """Note the right side (x,), the negative gradient, at the present position."""
        if self._step is not None and self._right is not None:
            change = self._right - right
            if self._step @ change > 0:  # keeps the matrix positive definite
                self._pairs.append((self._step, change))
        self._right, self._step = right, None

    def step(
        self, solve: Callable[[NDArray[np.float64]], NDArray[np.float64]]
    ) -> NDArray[np.float64]:
        """Return the quasi-Newton step (x,); solve: multiply by the initial approximation."""
        assert self._right is not None
        remainder = self._right
        shares = []
        for step, change in reversed(self._pairs):
            shares.append((step @ remainder) / (step @ change))
            remainder = remainder - shares[-1] * change
        out = solve(remainder)
        for (step, change), share in zip(self._pairs, reversed(shares)):
            out = out + (share - (change @ out) / (step @ change)) * step
        return out


@dataclass(frozen=True)
class _Problem:
    """Minimisation problem: the cost of a network for a correction and a noise model."""

    network: Network
    correction: NDArray[np.float64] | float
    noise: Noise
    elimination: Elimination

    def evaluate(self, parameters: Parameters) -> _Iterate:
        """Evaluate the cost at some parameters."""
        r, q = residuals_and_q(self.network, parameters, self.correction, self.noise)
        return _Iterate(parameters, r, q, total_cost(self.network, parameters, q, self.noise))

    def linearise(self, parameters: Parameters) -> BorderedSystem:
        """Return the normal equations at some parameters."""
        equations = normal_equations(self.network, parameters, self.correction, self.noise)
        return self.elimination.bordered_system(equations)

    def factorize(self, system: BorderedSystem, mu: float) -> _Solver:
        """Factorize normal equations that are damped by mu.

        Raises numpy.linalg.LinAlgError if the damped matrix is singular, ValueError if it is not
        finite.
        """
        return _Solver(system, system.damped(mu).factorize(), mu)

    def right(self, parameters: Parameters) -> NDArray[np.float64]:
        """Return the right side (x,) of the normal equations, without their matrix."""
        right = right_sides(self.network, parameters, self.correction, self.noise)
        block_right, rest_right = self.elimination.right_sides(right)
        return np.concatenate([block_right.ravel(), rest_right])

    def newton_step(self, solver: _Solver, iterate: _Iterate) -> _Step:
        """Return the step that solves the normal equations at an iterate.

        The robustly weighted normal matrix is larger than the Fisher information. With heavy
        tails, steps stretched by their ratio converge in a third of the iterations.
        """
        system = solver.system
        x_blocks, x_rest = solver.factor.solve(system.block_right, system.rest_right)
        predicted = system.predicted_decrease(x_blocks, x_rest, solver.mu)
        stretch = 1 / self.noise.information_factor(iterate.q)
        return _Step(stretch * np.concatenate([x_blocks.ravel(), x_rest]), predicted)

    def secant_step(self, solver: _Solver, iterate: _Iterate, secants: _Secants) -> _Step:
        """Return the quasi-Newton step at an iterate, with a solver of an earlier one."""
        stretch = 1 / self.noise.information_factor(iterate.q)
        right = self.right(iterate.parameters)
        secants.arrived(right)

        def solve(values: NDArray[np.float64]) -> NDArray[np.float64]:
            x_blocks, x_rest = solver.factor.solve(*self._split(values))
            return stretch * np.concatenate([x_blocks.ravel(), x_rest])

        x = secants.step(solve)
        return _Step(x, float(right @ x) / 2)

    def after(self, iterate: _Iterate, step: _Step) -> _Iterate:
        """Return the iterate after a step."""
        x = self.elimination.to_unknowns(*self._split(step.x))
        return self.evaluate(self.network.parameters_after(iterate.parameters, x))

    def _split(
        self, values: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return eliminated (k, s) and remaining (q,) values from those of all unknowns (x,)."""
        eliminated = values[: len(values) - self.elimination.layout.size]
        return eliminated.reshape(self.elimination.n_cells, -1), values[len(eliminated) :]


class _NielsenDamping:
    """Damping mu that follows the gain ratio, and grows faster with each consecutive refusal."""

    START = 1e-10
    MIN = 1e-15
    MAX = 1e12

    def __init__(self) -> None:
        self.mu = self.START
        self._growth = 2.0

    def accept(self, gain: float) -> None:
        """Update after an accepted step; gain: actual over predicted decrease.

        At a minimum both decreases are rounding errors, and their ratio may be any number.
        """
        gain = min(max(gain, 0.0), 2.0)
        self.mu = max(self.mu * max(1 / 3, 1 - (2 * gain - 1) ** 3), self.MIN)
        self._growth = 2.0

    def refuse(self) -> bool:
        """Update after a refused step; return True if the damping exceeds its maximum."""
        self.mu = max(self.mu, self.START) * self._growth
        self._growth = 2 * self._growth
        return self.mu > self.MAX


class _LevenbergMarquardt:
    """Levenberg-Marquardt iteration.

    `current` is the best iterate so far; `steps` is the number of steps, including refused steps.
    `finished` ends the iteration; `converged` is True at a minimum. `used` has the normal
    equations at the minimum, or near it; None with relative orientations.
    """

    def __init__(self, problem: _Problem, start: Parameters, tolerance: float) -> None:
        self.current = problem.evaluate(start)
        self.steps = 0
        self.finished = False
        self.converged = False
        self._problem = problem
        self._tolerance = tolerance
        self._damping = _NielsenDamping()
        self._secants = _Secants()
        self._system: BorderedSystem | None = None  # at the current parameters
        self._last: _Solver | None = None  # solver of the last step, if it may be used again
        self._cost_of_last = np.inf  # F where it was linearised
        self._predicted = 0.0  # decrease of F by the last step that solves linearised equations
        self._may_use_again = not problem.network.relative
        self._same_weights = SAME_WEIGHTS_DECREASE * problem.network.n_image_points

    @property
    def used(self) -> _Solver | None:
        """Solver of the last step, if the weights have hardly changed since."""
        decrease = self._cost_of_last - self.current.cost
        return self._last if decrease <= self._same_weights else None

    def step(self) -> None:
        """Take or refuse one step."""
        self.steps += 1
        if self._last is not None and self._system is None and self._secant_step(self._last):
            return
        if self._system is None:
            self._last = None  # free its memory before the next matrix is allocated
            self._system = self._problem.linearise(self.current.parameters)
            self._secants.arrived(self._system.right)
        try:
            solver = self._problem.factorize(self._system, self._damping.mu)
            step = self._problem.newton_step(solver, self.current)
        except (np.linalg.LinAlgError, ValueError):
            self.finished = self._damping.refuse()
            return
        trial = self._problem.after(self.current, step)
        if self._is_worse(trial):
            self.converged = step.predicted <= self._tolerance
            if self.converged:
                self._use(solver)
            self.finished = self.converged or self._damping.refuse()
            return
        self._damping.accept((self.current.cost - trial.cost) / max(step.predicted, 1e-300))
        self._predicted = step.predicted
        self._use(solver)
        self._accept(trial, step)

    def _use(self, solver: _Solver) -> None:
        """Keep the normal equations at the current parameters."""
        if self._may_use_again:
            self._last = solver
            self._cost_of_last = self.current.cost

    def _secant_step(self, solver: _Solver) -> bool:
        """Take a quasi-Newton step with the factors of the last step; return False if it fails.

        It takes a fraction of the time of a linearisation.
        """
        step = self._problem.secant_step(solver, self.current, self._secants)
        # Where the secants mislead, or an exposure had almost no weight, it may be of any size.
        if not step.predicted <= min(self._predicted, self._same_weights):
            return False
        trial = self._problem.after(self.current, step)
        if self._is_worse(trial):
            self.converged = step.predicted <= self._tolerance
            self.finished = self.converged
            return self.converged
        self._accept(trial, step)
        return True

    def _is_worse(self, trial: _Iterate) -> bool:
        return not trial.cost <= self.current.cost + ROUNDING * abs(self.current.cost)

    def _accept(self, trial: _Iterate, step: _Step) -> None:
        self.current = trial
        self._system = None
        self._secants.moved(step.x)
        self.converged = step.predicted <= self._tolerance
        self.finished = self.converged


def adjust(
    network: Network,
    start: Parameters,
    correction: NDArray[np.float64] | float = 0.0,
    noise: Noise = DEFAULT_NOISE,
    tolerance: float = TOLERANCE,
) -> Adjustment:
    """Adjust a network for a given noise model.

    Parameters
    ----------
    network : Network
    start : Parameters
        Initial values.
    correction : (N, 2) ndarray or float
        Correction of the image points [px], excluding the additional parameters.
    noise : Noise
        Noise model; it is fixed.
    tolerance : float
        Predicted decrease of the cost F at which the iteration ends.

    Returns
    -------
    Adjustment
        `converged` is False if MAX_STEPS ended the iteration or no step was found.
    """
    return adjust_with_matrix(
        network,
        start,
        correction=correction,
        noise=noise,
        tolerance=tolerance,
    )[0]


def adjust_with_matrix(
    network: Network,
    start: Parameters,
    correction: NDArray[np.float64] | float = 0.0,
    noise: Noise = DEFAULT_NOISE,
    tolerance: float = TOLERANCE,
) -> tuple[Adjustment, FactorizedNormalMatrix | None]:
    """Adjust a network; also return the normal matrix of the last steps.

    The matrix belongs to parameters near the solution. It is None for a free network, with
    relative orientations, and if the steps were damped. Arguments as in `adjust`.
    """
    elimination = Elimination(network)
    problem = _Problem(network, correction, noise, elimination)
    iteration = _LevenbergMarquardt(problem, start, tolerance)
    while not iteration.finished and iteration.steps < MAX_STEPS:
        iteration.step()
    solution = iteration.current
    adjustment = Adjustment(
        parameters=transform_to_datum(network, solution.parameters),
        residuals=solution.residuals,
        q=solution.q,
        noise=noise,
        cost=solution.cost,
        steps=iteration.steps,
        converged=iteration.converged,
        exposure=network.exposure,
    )
    solver = iteration.used
    if solver is None or solver.mu > UNDAMPED or network.datum != 'survey':
        return adjustment, None
    factor = noise.information_factor(solution.q)
    return adjustment, FactorizedNormalMatrix(elimination, solver.factor, None, factor)
