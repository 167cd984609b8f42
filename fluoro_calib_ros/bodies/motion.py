# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Motion of rigid bodies over a trial: Kalman filter and smoother without a cutoff to choose.

The state is the position of the centre of a body and its rotation about the axes of the rig frame,
with their velocities and accelerations. The jerk is white noise whose density changes in time,

    x' = F x + w,  w ~ N(0, Q),  Q = diag(q_t, q_r) (x) Q_3(dt)

(Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001,
6.2.3). The information of an exposure on a pose has the form of a normal matrix, which may be
singular: an image point of a single view also contributes.

Deviations of a pose are twists (s, w) about the predicted centre, exp(w) R and c + J(w) s with the
left Jacobian J (Sola et al. 2018, Eq. 172), and rotate with the body. A rotation about a line
through two markers, which is unobservable, is therefore the same deviation whatever its estimate
is. If differences of centres were used instead, the unobservable direction would depend on the
estimate, and exposures linearised at different estimates would together seem to observe it (Barrau
and Bonnabel, "The invariant extended Kalman filter as a stable observer", IEEE Trans. Autom.
Control 62, 2017; Huang, Mourikis and Roumeliotis, "Observability-based rules for designing
consistent EKF SLAM estimators", Int. J. Robot. Res. 29, 2010).

The smoother is that of de Jong ("Smoothing and interpolation with the state-space model", J. Am.
Stat. Assoc. 84, 1989), which runs backwards:

    r <- H'z + L'F'r,  N <- H'MH + L'F'N F L,  x_T = x + P r,  P_T = P - P N P.

The log of each density, h = log q, follows a random walk. The derivative of the likelihood of all
data with respect to h_k is (r'Qr - tr QN) / 2 with r and N of step k (Koopman, "Disturbance
smoother for state space models", Biometrika 80, 1993); its expected information is about
tr(QN) / 2. The most probable course of h therefore follows by Fisher scoring with a tridiagonal
matrix, and the variance of its steps by EM. The trial determines how quickly h changes, so there
is nothing to choose. Live, h is updated with the derivative of the likelihood of each exposure.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded
from scipy.spatial.transform import Rotation

from ..photogrammetry.rotations import left_jacobian, vector_from_matrix

STATE = 18  # pose, velocity and acceleration
POSE = slice(0, 6)
KINDS = (slice(0, 3), slice(3, 6))  # components of a pose: position, rotation

# For a body that appears: wide enough for any motion of a living joint. A fall from 2 m ends at
# 6 m/s, a golf swing rotates the forearm at 40 rad/s; impacts reach 100 g and 5000 rad/s^2.
RADIAN_MM = 150.0  # shift of a body for a radian of its rotation
START_SD = np.repeat([0.0, 6e3, 1e6], 6) * np.tile(np.repeat([1.0, 1 / RADIAN_MM], 3), 3)
# Variance of a rotation of which nothing is known, uniform within half a turn [rad^2]: two
# exposures do not show more turns. Velocity, acceleration and jerk of a body that appears may each
# move it as far until the next exposure, at most.
UNKNOWN_RAD2 = np.pi**2 / 3
# Log of the density of jerk of a body that appears, [mm^2/s^5] and [rad^2/s^5], and its standard
# deviation: from a body at rest (a jerk of 1 mm/s^3 for 1 s) to an impact (1e8 mm/s^3 for 1 ms).
START_LOG = np.array([18.0, 8.0])
START_LOG_SD = 6.0
# Initial variance of the random walk of h per second, later estimated: h changes by 3 in 0.1 s.
WALK = 90.0
ROUND_ENDS = 0.1  # change of h below which rounds end; changes a standard deviation by 1 %
MAX_STEP = 2.5  # maximum change of h in a round
LOST_DIGITS = 1e-9  # relative variance below which a difference has too few of sixteen digits
ADAPTATIONS = 4  # rounds of h per exposure, live
LOG_RANGE = (-20.0, 50.0)  # range of h, four standard deviations and more about START_LOG

EYE_3 = np.eye(3)
EYE_6 = np.eye(6)
_EYE_STATE = np.eye(STATE)
_POSE_ROWS = np.eye(6, STATE)
# Row in noise_factors of each element of the state, and the elements that each kind affects.
_FACTOR_ROWS = np.repeat(np.arange(3), 6)[:, None]
_KIND_SHARES = np.array(
    [
        np.kron(np.ones((3, 3)), np.diag(np.isin(np.arange(6), np.arange(6)[kind])))
        for kind in KINDS
    ]
)
_POWERS = np.array([[5, 4, 3], [4, 3, 2], [3, 2, 1]])
_DIVISORS = np.array([[20.0, 8, 6], [8, 3, 2], [6, 2, 1]])


@dataclass(frozen=True)
class PoseInformation:
    """Information of one exposure on the poses of B bodies, relative to a linearisation pose.

    Attributes
    ----------
    rotation : (B, 3, 3) ndarray
    centre_mm : (B, 3) ndarray
    normal : (B, 6, 6) ndarray
        Normal matrix of position and rotation for the random errors; 0 for an unseen body.
    right : (B, 6) ndarray
        Right-hand side; 0 at the most likely pose.
    """

    rotation: NDArray[np.float64]
    centre_mm: NDArray[np.float64]
    normal: NDArray[np.float64]
    right: NDArray[np.float64]


@dataclass
class _Step:
    """Exposure of the filter: its prediction, and the changes due to the exposure.

    into (B, 18, 18): transition from the previous exposure; 0 for a body that appears. dt_s: time
    since then. reference (B, 3, 3): predicted rotations. mean (B, 18): predicted state, without
    rotation. z (B, 6), m (B, 6, 6): for the smoother. log_q (B, 2): h of the noise into this
    exposure.
    """

    dt_s: float
    into: NDArray[np.float64]
    reference: NDArray[np.float64]
    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]
    z: NDArray[np.float64]
    m: NDArray[np.float64]
    log_q: NDArray[np.float64]
    started: NDArray[np.bool_]


@dataclass(frozen=True)
class Motion:
    """Smoothed motion of B bodies in T exposures.

    Values before a body appears mean nothing. Covariances are those of the random errors.

    Attributes
    ----------
    rotation : (T, B, 3, 3) ndarray
    centre_mm : (T, B, 3) ndarray
    velocity, acceleration : (T, B, 6) ndarray
        [mm/s, rad/s] and [mm/s^2, rad/s^2], about the axes of the rig frame.
    covariance : (T, B, 18, 18) ndarray
        Covariance of position, rotation, velocities and accelerations.
    log_q : (T, B, 2) ndarray
        Log of the densities of the jerk of position and rotation.
    """

    rotation: NDArray[np.float64]
    centre_mm: NDArray[np.float64]
    velocity: NDArray[np.float64]
    acceleration: NDArray[np.float64]
    covariance: NDArray[np.float64]
    log_q: NDArray[np.float64]


def pose_after(
    rotation: NDArray[np.float64], centre: NDArray[np.float64], twist: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return rotations (B, 3, 3) and centres (B, 3) after twists (B, 6) about these centres."""
    shift = left_jacobian(twist[:, 3:]) @ twist[:, :3, None]
    new_rotation = Rotation.from_rotvec(twist[:, 3:]).as_matrix() @ rotation
    return new_rotation, centre + shift[:, :, 0]


def twist_between(
    first: tuple[NDArray[np.float64], NDArray[np.float64]],
    second: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> NDArray[np.float64]:
    """Return twists (B, 6) with which pose_after moves first to second poses."""
    turn = _vector(second[0] @ np.swapaxes(first[0], 1, 2))
    shift = np.linalg.solve(left_jacobian(turn), (second[1] - first[1])[:, :, None])
    return np.concatenate([shift[:, :, 0], turn], axis=1)


def _vector(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rotation vectors (B, 3) of rotations (B, 3, 3), most of them small."""
    skew = (rotation - np.swapaxes(rotation, 1, 2)) / 2
    vector = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
    sine = np.sqrt((vector * vector).sum(axis=1))
    cosine = (rotation[:, 0, 0] + rotation[:, 1, 1] + rotation[:, 2, 2] - 1) / 2
    if (cosine < 0).any():  # above 90 degrees, a smaller angle has the same sine
        return vector_from_matrix(rotation)
    angle = np.arctan2(sine, cosine)
    return vector * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 1.0)[:, None]


def turn_of_twists(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return matrices (B, 6, 6) that turn deviations at first to second rotations (B, 3, 3)."""
    out = np.zeros((len(first), 6, 6))
    out[:, :3, :3] = out[:, 3:, 3:] = second @ np.swapaxes(first, 1, 2)
    return out


def noise_factors(dt_s: float) -> NDArray[np.float64]:
    """Return the covariance (3, 3) of position, velocity, acceleration by white jerk over dt_s."""
    return dt_s**_POWERS / _DIVISORS


class MotionFilter:
    """Kalman filter of the motion of bodies, exposure by exposure.

    Parameters
    ----------
    count : int
        Number of bodies B.
    lag : int
        Exposures that are stored for smoothing; None stores all.
    """

    def __init__(self, count: int, lag: int | None = 0) -> None:
        self.lag = lag
        self.steps: list[_Step] = []
        self.alive = np.zeros(count, dtype=bool)
        self.rotation = np.broadcast_to(np.eye(3), (count, 3, 3)).copy()
        self.mean = np.zeros((count, STATE))  # the rotation is a deviation, 0 after each step
        # For deviations at the last prediction; _turned converts them to those at the estimate.
        self.covariance = np.zeros((count, STATE, STATE))
        self._turned = np.broadcast_to(EYE_6, (count, 6, 6))
        self.log_q = np.broadcast_to(START_LOG, (count, 2)).copy()
        self._log_variance = np.full((count, 2), START_LOG_SD**2)
        # Derivatives of the covariance with respect to the two log densities.
        self._slope = np.zeros((count, 2, STATE, STATE))
        # For the prediction, which may be repeated before it is updated.
        self._predicted: _Step | None = None
        self._pending = self._slope, self._log_variance

    def predict(
        self, dt_s: float, log_q: NDArray[np.float64] | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Predict the next exposure, dt_s later; log_q (B, 2): given densities, if any.

        Returns rotations (B, 3, 3), centres (B, 3) and covariances (B, 6, 6) of the poses.
        """
        count = len(self.alive)
        if self.steps and self.steps[-1].started.any():
            self._limit_start(dt_s, self.steps[-1])
        if log_q is not None:
            self.log_q = log_q
        turn = dt_s * self.mean[:, 9:12] + dt_s**2 / 2 * self.mean[:, 15:18]
        transition = _transition(dt_s, turn)
        noise = _noise(dt_s, self.log_q)
        mean = (transition @ self.mean[:, :, None])[:, :, 0]
        mean[:, 3:6] = 0
        reference = transition[:, 3:6, 3:6] @ self.rotation
        transition[:, :, POSE] = transition[:, :, POSE] @ self._turned
        transposed = np.swapaxes(transition, 1, 2)
        covariance = transition @ self.covariance @ transposed + noise[:, 0] + noise[:, 1]
        self._pending = self._slope, self._log_variance
        if log_q is None:
            slope = transition[:, None] @ self._slope @ transposed[:, None] + noise
            variance = np.minimum(self._log_variance + WALK * dt_s, START_LOG_SD**2)
            self._pending = slope, variance
        self._predicted = _Step(
            dt_s,
            transition,
            reference=reference,
            mean=mean,
            covariance=covariance,
            z=np.zeros((count, 6)),
            m=np.zeros((count, 6, 6)),
            log_q=self.log_q,
            started=np.zeros(count, dtype=bool),
        )
        return reference, mean[:, :3], covariance[:, POSE, POSE]

    def update(self, seen: PoseInformation, start: NDArray[np.bool_], adapt: bool = True) -> None:
        """Update with an exposure; start (B,): bodies that appear, whose pose it determines.

        adapt: whether the densities are adapted to the exposure.
        """
        step = self._predicted
        assert step is not None
        self._slope, self._log_variance = self._pending
        if start.any():
            self._start(step, seen, start)
        normal = np.where(self.alive[:, None, None], seen.normal, 0)
        right = np.where(self.alive[:, None], seen.right, 0)
        predicted = step.reference, step.mean[:, :3]
        difference = twist_between(predicted, (seen.rotation, seen.centre_mm))
        turn = turn_of_twists(seen.rotation, step.reference)
        normal = turn @ normal @ np.swapaxes(turn, 1, 2)
        right = (turn @ right[:, :, None] + normal @ difference[:, :, None])[:, :, 0]
        _weigh(step, step.covariance[:, POSE, POSE], (normal, right))
        if adapt:
            self._adapt(step, (normal, right))
        gain = step.covariance[:, :, POSE]
        self.rotation, self.mean = _moved(step, (gain @ step.z[:, :, None])[:, :, 0])
        self._turned = turn_of_twists(step.reference, self.rotation)
        covariance = step.covariance - gain @ step.m @ np.swapaxes(gain, 1, 2)
        if adapt:
            factor = _EYE_STATE - gain @ step.m @ _POSE_ROWS
            self._slope = factor[:, None] @ self._slope @ np.swapaxes(factor, 1, 2)[:, None]
        self.covariance = (covariance + np.swapaxes(covariance, 1, 2)) / 2
        self.steps.append(step)
        if self.lag is not None:
            del self.steps[: -(self.lag + 1)]

    def lose(self, lost: NDArray[np.bool_]) -> None:
        """Discard bodies (B,) whose prediction has become useless."""
        self.alive = self.alive & ~lost

    def _start(self, step: _Step, seen: PoseInformation, start: NDArray[np.bool_]) -> None:
        """Start bodies at the pose of an exposure."""
        step.started = start
        step.into = np.where(start[:, None, None], 0, step.into)
        step.reference = np.where(start[:, None, None], seen.rotation, step.reference)
        mean = np.zeros((len(start), STATE))
        mean[:, :3] = seen.centre_mm
        step.mean = np.where(start[:, None], mean, step.mean)
        # The prior of the pose is diffuse: ten times the standard deviations of this exposure.
        diffuse = np.zeros((len(start), STATE, STATE)) + np.diag(START_SD**2)
        known = np.where(start[:, None, None], seen.normal, np.eye(6))
        diffuse[:, POSE, POSE] = 100 * np.linalg.inv(known)
        step.covariance = np.where(start[:, None, None], diffuse, step.covariance)
        self.alive = self.alive | start
        self.log_q = np.where(start[:, None], START_LOG, self.log_q)
        self._log_variance[start] = START_LOG_SD**2
        self._slope[start] = 0

    def _limit_start(self, dt_s: float, step: _Step) -> None:
        """Limit what bodies that have just appeared may do in dt_s, see UNKNOWN_RAD2."""
        dt_s = max(dt_s, 1e-9)  # stamps are in ns
        reach = np.sqrt(UNKNOWN_RAD2) * np.repeat([RADIAN_MM, 1.0], 3)
        limit = np.concatenate([np.zeros(6), reach / dt_s, 2 * reach / dt_s**2])
        variance = np.minimum(START_SD, limit) ** 2
        state = np.arange(6, STATE)
        for covariance in (step.covariance, self.covariance):
            covariance[np.ix_(step.started, state, state)] = np.diag(variance[6:])
        log_q = np.minimum(START_LOG, np.log(reach[::3] ** 2 / noise_factors(dt_s)[0, 0]))
        self.log_q = np.where(step.started[:, None], log_q, self.log_q)

    def _adapt(self, step: _Step, seen: tuple[NDArray[np.float64], NDArray[np.float64]]) -> None:
        """Improve the log densities with the likelihood of an exposure.

        With the covariance S of the prediction error and its derivative D with respect to h, the
        derivative of the log likelihood is (e'S^-1 D S^-1 e - tr S^-1 D) / 2, and its expected
        information is tr(S^-1 D S^-1 D) / 2 (Ljung, "System Identification", 1999, 7.4, for a
        prediction error that itself does not depend on h). Here S^-1 e is z, and S^-1 is M. Where
        a density increases, the prediction was less certain than it seemed, so its covariance
        increases too. All rounds have the same prior.
        """
        first = self._slope[:, :, POSE, POSE]
        prior = self.log_q
        growth = np.ones(self.log_q.shape)  # factor on the derivatives
        for _ in range(ADAPTATIONS):
            slope = growth[:, :, None, None] * first
            z = step.z[:, None, :, None]
            product = step.m[:, None] @ slope
            expected = product.trace(axis1=2, axis2=3)
            gradient = 0.5 * ((np.swapaxes(z, 2, 3) @ slope @ z)[..., 0, 0] - expected)
            information = 0.5 * (product * np.swapaxes(product, 2, 3)).sum(axis=(2, 3))
            variance = 1 / (1 / self._log_variance + information)
            gradient = gradient - (self.log_q - prior) / self._log_variance
            change = np.clip(variance * gradient, -MAX_STEP, MAX_STEP)
            self.log_q = np.clip(self.log_q + change, *LOG_RANGE)
            if not (change > ROUND_ENDS).any():
                break
            growth = growth * np.maximum(np.exp(change), 1)
            added = ((growth - 1)[:, :, None, None] * first).sum(axis=1)
            _weigh(step, step.covariance[:, POSE, POSE] + added, seen)
        self._log_variance = variance
        new_slope = growth[:, :, None, None] * self._slope
        step.covariance = step.covariance + (new_slope - self._slope).sum(axis=1)
        self._slope = new_slope

    def smoothed(self) -> Motion:
        """Return the motion in the stored exposures, smoothed by all of them."""
        if self.lag != 0:
            return _smooth(self.steps)
        return Motion(
            self.rotation[None],
            self.mean[None, :, :3],
            velocity=self.mean[None, :, 6:12],
            acceleration=self.mean[None, :, 12:],
            covariance=_turned_covariance(self.covariance, self._turned)[None],
            log_q=self.log_q[None],
        )


def _weigh(
    step: _Step,
    covariance: NDArray[np.float64],
    seen: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> None:
    """Weigh exposures (B, 6, 6), (B, 6) against covariances (B, 6, 6) of their prediction."""
    normal, right = seen
    inner = np.linalg.inv(EYE_6 + normal @ covariance)
    step.z = (inner @ right[:, :, None])[:, :, 0]
    m = inner @ normal
    step.m = (m + np.swapaxes(m, 1, 2)) / 2


def _backwards(
    steps: Sequence[_Step],
) -> Iterator[tuple[_Step, NDArray[np.float64], NDArray[np.float64]]]:
    """Yield the steps of a filter, the last one first, with r (B, 18) and N (B, 18, 18)."""
    count = len(steps[0].z)
    r = np.zeros((count, STATE))
    n = np.zeros((count, STATE, STATE))
    for step in reversed(steps):
        # r and n already contain L'F'r and L'F'N F L of the next step.
        factor = _EYE_STATE - step.covariance[:, :, POSE] @ step.m @ _POSE_ROWS
        transposed = np.swapaxes(factor, 1, 2)
        r = (transposed @ r[:, :, None])[:, :, 0]
        n = transposed @ n @ factor
        r[:, POSE] += step.z
        n[:, POSE, POSE] += step.m
        yield step, r, n
        forward = np.swapaxes(step.into, 1, 2)
        r = (forward @ r[:, :, None])[:, :, 0]
        n = forward @ n @ step.into


def _smooth(steps: Sequence[_Step]) -> Motion:
    """Smooth backwards over the steps of a filter."""
    rows = []
    for step, r, n in _backwards(steps):
        rotation, mean = _moved(step, (step.covariance @ r[:, :, None])[:, :, 0])
        turn = turn_of_twists(step.reference, rotation)
        covariance = _turned_covariance(_smoothed_covariance(step.covariance, n), turn)
        rows.append((rotation, mean[:, :3], mean[:, 6:12], mean[:, 12:], covariance))
    log_q = np.stack([step.log_q for step in steps])
    rotation, centre, velocity, acceleration, covariance = map(np.stack, zip(*rows[::-1]))
    return Motion(rotation, centre, velocity, acceleration, covariance=covariance, log_q=log_q)


def _scores(steps: Sequence[_Step]) -> NDArray[np.float64]:
    """Return derivatives of the log likelihood with respect to h, and their information.

    (2, T, B, 2), for the steps of a filter.
    """
    scores = []
    for step, r, n in _backwards(steps):
        noise = _noise(step.dt_s, step.log_q)
        information = np.trace(noise @ n[:, None], axis1=2, axis2=3)
        squared = (r[:, None, None] @ noise @ r[:, None, :, None])[..., 0, 0]
        score = np.stack([0.5 * (squared - information), 0.5 * information])
        scores.append(np.where(step.started[:, None], 0, score))
    return np.stack(scores[::-1], axis=1)


def _moved(
    step: _Step, change: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return rotations and states (B, 18) after a change of a prediction; deviations are 0."""
    mean = step.mean + change
    rotation, mean[:, :3] = pose_after(step.reference, step.mean[:, :3], change[:, POSE])
    mean[:, 3:6] = 0
    return rotation, mean


def _turned_covariance(
    covariance: NDArray[np.float64], turned: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return covariances (B, 18, 18) after turning pose deviations by matrices (B, 6, 6)."""
    out = covariance.copy()
    out[:, POSE] = turned @ out[:, POSE]
    out[:, :, POSE] = out[:, :, POSE] @ np.swapaxes(turned, 1, 2)
    return out


def _smoothed_covariance(
    covariance: NDArray[np.float64], n: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return P - P N P (B, 18, 18).

    Where a body appears, variances decrease by twelve digits, which cancel in the difference.
    There it is L (I - L'NL) L' with P = LL', whose middle factor gets no negative eigenvalues.
    """
    out = covariance - covariance @ n @ covariance
    after, before = (np.diagonal(matrix, axis1=1, axis2=2) for matrix in (out, covariance))
    rows = np.flatnonzero((after < LOST_DIGITS * before).any(axis=1))
    if len(rows):
        scale = np.sqrt(np.diagonal(covariance[rows], axis1=1, axis2=2))[:, :, None]
        correlation = covariance[rows] / (scale * np.swapaxes(scale, 1, 2))
        root = scale * np.array([_root(matrix) for matrix in correlation])
        values, vectors = np.linalg.eigh(_EYE_STATE - np.swapaxes(root, 1, 2) @ n[rows] @ root)
        root = root @ vectors * np.sqrt(np.maximum(values, 0))[:, None]
        out[rows] = root @ np.swapaxes(root, 1, 2)
    return out


def _root(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a root L of a matrix LL' (s, s).

    Cholesky's keeps the digits of small variances; eigenvalues, without negative ones, are the
    root of a matrix that rounding has made indefinite.
    """
    try:
        return np.asarray(np.linalg.cholesky(matrix), dtype=float)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(matrix)
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0)), dtype=float)


def smooth_trial(first: MotionFilter, seen: Sequence[PoseInformation]) -> Motion:
    """Smooth a whole trial with the most probable course of its densities.

    Parameters
    ----------
    first : MotionFilter
        Filter that has followed the trial and stored all of its exposures.
    seen : sequence of PoseInformation
        Information of these exposures.

    Returns
    -------
    Motion
    """
    steps = first.steps
    dt = np.array([step.dt_s for step in steps])
    log_q = np.stack([step.log_q for step in steps])
    walk = np.full(log_q.shape[1:], WALK)
    for _ in range(12 if len(steps) > 1 else 0):  # one exposure shows no change
        log_q, change, walk = _improved(log_q, _scores(steps), dt, walk)
        follower = MotionFilter(len(first.alive), lag=None)
        for k, step in enumerate(steps):
            follower.predict(step.dt_s, log_q[k])
            follower.update(seen[k], step.started, adapt=False)
        steps = follower.steps
        if change < ROUND_ENDS:
            break
    return _smooth(steps)


def _improved(
    log_q: NDArray[np.float64],
    scores: NDArray[np.float64],
    dt_s: NDArray[np.float64],
    walk: NDArray[np.float64],
) -> tuple[NDArray[np.float64], float, NDArray[np.float64]]:
    """Return log densities (T, B, 2) after a scoring step, its size, and walks (B, 2).

    scores: as from `_scores`.
    """
    out = log_q.copy()
    new_walk = walk.copy()
    largest = 0.0
    for body, kind in np.ndindex(*walk.shape):
        h = log_q[:, body, kind]
        prior = 1 / (walk[body, kind] * np.maximum(dt_s[1:], 1e-6))
        banded = np.zeros((2, len(h)))
        gradient, information = scores[:, :, body, kind]
        banded[1] = information + 1e-6
        banded[1, :-1] += prior
        banded[1, 1:] += prior
        banded[0, 1:] = -prior
        right = gradient.copy()
        pull = prior * np.diff(h)
        right[:-1] += pull
        right[1:] -= pull
        step = solveh_banded(banded, right)
        # At rest the likelihood hardly depends on h; a decreasing step is taken in q.
        step = np.where(step < 0, np.log1p(np.maximum(step, -0.99)), step)
        step = np.clip(step, -MAX_STEP, MAX_STEP)
        out[:, body, kind] = np.clip(h + step, *LOG_RANGE)
        largest = max(largest, float(np.abs(step).max()))
        spread = _variance_of_steps(banded)
        squares = np.diff(out[:, body, kind]) ** 2 + spread
        new_walk[body, kind] = np.sum(squares) / np.sum(dt_s[1:])
    return out, largest, new_walk


def _variance_of_steps(banded: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return variances (T - 1,) of differences of neighbours, from a tridiagonal normal matrix.

    The elements of its inverse near the diagonal follow from a forward and a backward elimination
    (Meurant, "A review on the inverse of symmetric tridiagonal and block tridiagonal matrices",
    SIAM J. Matrix Anal. Appl. 13, 1992).
    """
    diagonal = banded[1]
    off_diagonal = banded[0, 1:]
    size = len(diagonal)
    forward = np.empty(size)
    backward = np.empty(size)
    forward[0] = diagonal[0]
    backward[-1] = diagonal[-1]
    for k in range(1, size):
        forward[k] = diagonal[k] - off_diagonal[k - 1] ** 2 / forward[k - 1]
        backward[-1 - k] = diagonal[-1 - k] - off_diagonal[-k] ** 2 / backward[-k]
    variance = 1 / (forward + backward - diagonal)
    covariance = -off_diagonal / forward[:-1] * variance[1:]
    return variance[:-1] + variance[1:] - 2 * covariance


def _transition(dt_s: float, turn: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return transitions (B, 18, 18) over dt_s of bodies that rotate by vectors (B, 3)."""
    out = np.broadcast_to(_EYE_STATE, (len(turn), STATE, STATE)).copy()
    jacobian = left_jacobian(turn)
    out[:, 0:3, 6:9] = dt_s * EYE_3
    out[:, 0:3, 12:15] = dt_s**2 / 2 * EYE_3
    out[:, 3:6, 3:6] = Rotation.from_rotvec(turn).as_matrix()
    out[:, 3:6, 9:12] = dt_s * jacobian
    out[:, 3:6, 15:18] = dt_s**2 / 2 * jacobian
    out[:, 6:12, 12:18] = dt_s * EYE_6
    return out


def _noise(dt_s: float, log_q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return covariances (B, 2, 18, 18) of the noise of positions and rotations over dt_s."""
    shares = noise_factors(dt_s)[_FACTOR_ROWS, _FACTOR_ROWS.T] * _KIND_SHARES
    return np.exp(log_q)[:, :, None, None] * shares
