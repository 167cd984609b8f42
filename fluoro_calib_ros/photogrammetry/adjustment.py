"""Robust bundle adjustment of one or more fluoroscopes that look at one phantom.

Maximum likelihood of the image points (Student-t, Huber or Gaussian) and of the surveyed
coordinates (Gaussian, they fix the datum, unless inner constraints do) by Levenberg-Marquardt with
Nielsen's damping (Madsen, Nielsen and Tingleff, "Methods for non-linear least squares problems",
DTU 2004), iteratively reweighted. Each step solves the normal equations by the Schur complement
(Triggs et al., "Bundle Adjustment - A Modern Synthesis", 2000), eliminating object points or
exposures, whichever leaves the smaller system.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from .datum import DEFECT, in_datum
from .noise import Noise
from .normal_equations import (
    bordered_blocks,
    damped_step,
    eliminates_points,
    normal_equations,
    projected,
)
from .relative_orientation import UNKNOWNS, discrepancies, moved_along
from .rotations import matrix_from_vector

# No target is measured better than this; where there is hardly any redundancy the scale could
# vanish.
MIN_NOISE_PX = 0.01


@dataclass(frozen=True)
class Network:
    """Image points and what they connect.

    uv (N, 2) observed [px]; sigma (N,) a-priori standard deviation [px], or ones; exposure (N,)
    ascending and point (N,): row of the exposure and of the object point, each pair at most once;
    fluoroscope (m,) of each exposure; survey_mm (n, 3) and survey_sd_mm (n,) of the object points;
    interior_free (F,): whether the interior orientation of a fluoroscope is estimated; additional
    (F): Additional parameters of each, or None; relative: a Relative constraint for every pair of
    fluoroscopes that has one, the first of the pair the same in all; interior_mean and interior_sd
    (F, 3): what is known of the interior orientations beforehand [px], sd infinite for nothing;
    datum 'survey', or 'inner': the surveyed coordinates weigh nothing and inner constraints over
    the object points give the datum.
    """

    uv: np.ndarray
    sigma: np.ndarray
    exposure: np.ndarray
    point: np.ndarray
    fluoroscope: np.ndarray
    survey_mm: np.ndarray
    survey_sd_mm: np.ndarray
    interior_free: np.ndarray
    additional: tuple = ()
    relative: tuple = ()
    interior_mean: np.ndarray | None = None
    interior_sd: np.ndarray | None = None
    datum: str = 'survey'

    @property
    def shape(self):
        """Numbers of image points, exposures, object points and fluoroscopes."""
        return len(self.uv), len(self.fluoroscope), len(self.survey_mm), len(self.interior_free)

    @property
    def unknowns(self):
        """Number of unknowns, less those that the datum of a free network fixes."""
        every = 6 * len(self.fluoroscope) + self.survey_mm.size + int(np.sum(self.global_free))
        return every - (DEFECT if self.datum == 'inner' else 0)

    @property
    def observations(self):
        """Number of observations, priors not counted."""
        survey = self.survey_mm.size if self.datum == 'survey' else 0
        return 2 * len(self.uv) + survey + UNKNOWNS * sum(len(r.pairs) for r in self.relative)

    @cached_property
    def relative_columns(self):
        """Columns of the relative orientations among the global unknowns."""
        first = 3 * len(self.interior_free)
        return tuple(
            slice(first + UNKNOWNS * i, first + UNKNOWNS * (i + 1))
            for i in range(len(self.relative))
        )

    @cached_property
    def additional_columns(self):
        """Columns of the additional parameters of each fluoroscope among the global unknowns."""
        counts = [0 if a is None else a.count for a in self.additional]
        ends = (
            3 * len(self.interior_free)
            + UNKNOWNS * len(self.relative)
            + np.cumsum(counts, dtype=int)
        )
        return tuple(slice(int(end - count), int(end)) for end, count in zip(ends, counts))

    @cached_property
    def global_free(self):
        """True (G,) for the global unknowns that are estimated: interior orientations, relative
        orientations, then additional parameters.
        """
        count = sum(a.count for a in self.additional if a is not None) + UNKNOWNS * len(
            self.relative
        )
        return np.concatenate(
            [np.repeat(np.asarray(self.interior_free, dtype=bool), 3), np.ones(count, dtype=bool)]
        )

    @cached_property
    def interior_weight(self):
        """Weights (F, 3) [1/px^2] of the interior orientations known beforehand."""
        if self.interior_sd is None:
            return np.zeros((len(self.interior_free), 3))
        return 1 / np.asarray(self.interior_sd, dtype=float) ** 2

    @cached_property
    def cells(self):
        """Cell (m,) of every exposure, place (m,) in it and places of a cell: exposures that a
        constraint couples share a cell, so that their part of the normal matrix is block-diagonal.
        """
        head = np.arange(len(self.fluoroscope))
        place = np.zeros(len(self.fluoroscope), dtype=int)
        for number, constraint in enumerate(self.relative):
            a, b = constraint.pairs.T
            head[b] = a
            place[b] = number + 1
        return np.unique(head, return_inverse=True)[1], place, len(self.relative) + 1

    @cached_property
    def by_point(self):
        """Order (N,) of the image points by object point."""
        return np.argsort(self.point, kind='stable')

    @cached_property
    def _rows(self):
        of_point = self.fluoroscope[self.exposure]
        return tuple(np.flatnonzero(of_point == f) for f in range(len(self.interior_free)))

    def rows(self, f):
        """Rows of the image points of fluoroscope number f."""
        return self._rows[f]

    def added(self, parameters):
        """Corrections (N, 2) [px] by the additional parameters; zero without them."""
        out = np.zeros_like(self.uv)
        for f, additional in enumerate(self.additional):
            if additional is not None:
                out[self.rows(f)] = additional.correction(parameters.additional[f])
        return out


@dataclass(frozen=True)
class Parameters:
    """Values of the unknowns: interior (F, 3) xp, yp, c [px]; rotation (m, 3, 3); position_mm (m,
    3); points_mm (n, 3); additional: coefficients (p,) of the additional parameters by
    fluoroscope; relative: a RelativePose for each constraint of the network.
    """

    interior: np.ndarray
    rotation: np.ndarray
    position_mm: np.ndarray
    points_mm: np.ndarray
    additional: tuple = ()
    relative: tuple = ()

    def per_image_point(self, network):
        """Rotation, position, point and interior orientation of every image point."""
        e = network.exposure
        return (
            self.rotation[e],
            self.position_mm[e],
            self.points_mm[network.point],
            self.interior[network.fluoroscope[e]],
        )


@dataclass(frozen=True)
class Adjustment:
    """Result of an adjustment.

    residuals (N, 2) observed - correction - projected [px]; q (N,) normalised squared residuals;
    cost F, the negative log-likelihood; steps of Levenberg-Marquardt taken; converged.
    """

    parameters: Parameters
    residuals: np.ndarray
    q: np.ndarray
    noise: Noise
    cost: float
    steps: int
    converged: bool

    @property
    def inliers(self):
        """True (N,) for the image points in the core of the noise distribution."""
        return self.noise.inliers(self.q)


def residuals_and_q(network, parameters, correction, noise):
    """Residuals (N, 2) [px] and normalised squared residuals (N,); NaN where a point is behind the
    source.
    """
    r = network.uv - correction - network.added(parameters) - projected(network, parameters)
    return r, np.sum(r * r, axis=1) / (noise.scale * network.sigma) ** 2


def total_cost(network, parameters, q, noise):
    """F: negative log-likelihood of image points, surveyed coordinates, constraints and priors;
    infinite behind the source. Constants of what is Gaussian are left out.
    """
    square = sum(
        a @ additional.prior @ a
        for additional, a in zip(network.additional, parameters.additional)
        if additional is not None
    )
    if network.datum == 'survey':
        square += np.sum(
            ((parameters.points_mm - network.survey_mm) / network.survey_sd_mm[:, None]) ** 2
        )
    if network.interior_sd is not None:
        square += np.sum(
            network.interior_weight * (parameters.interior - network.interior_mean) ** 2
        )
    for constraint, pose in zip(network.relative, parameters.relative):
        square += np.sum(discrepancies(constraint, pose, parameters) ** 2 @ constraint.weights)
    value = noise.cost(q, network.sigma) + square / 2
    return value if np.isfinite(value) else np.inf


def _moved(network, parameters, x_b, x_r):
    """Parameters after a step."""
    _, m, n, n_fluoro = network.shape
    if eliminates_points(network):
        d_p = x_b
        d_e = x_r[: 6 * m].reshape(m, 6)
        rest = x_r[6 * m :]
    else:
        cell, place, places = network.cells
        d_p = x_r[: 3 * n].reshape(n, 3)
        d_e = x_b.reshape(-1, places, 6)[cell, place]
        rest = x_r[3 * n :]
    step = np.zeros(len(network.global_free))
    step[network.global_free] = rest
    additional = tuple(
        a if network.additional[f] is None else a + step[network.additional_columns[f]]
        for f, a in enumerate(parameters.additional)
    )
    relative = tuple(
        pose.moved(step[columns])
        for pose, columns in zip(parameters.relative, network.relative_columns)
    )
    moved = Parameters(
        parameters.interior + step[: 3 * n_fluoro].reshape(-1, 3),
        matrix_from_vector(d_e[:, 3:]) @ parameters.rotation,
        parameters.position_mm + d_e[:, :3],
        parameters.points_mm + d_p,
        additional,
        relative,
    )
    return moved_along(network, parameters, moved, d_e, step)


def adjust(
    network,
    start,
    correction=None,
    noise=Noise(),
    redundancy=None,
    tolerance=1e-8,
    max_steps=100,
    raise_if_cancelled=None,
    noise_held=False,
):
    """Adjust a network with the corrections held.

    start: Parameters; correction (N, 2) [px] or None; noise: start values, scale and nu are
    estimated along the way (redundancy: redundancy numbers (N,) of the image points, None: their
    mean by the count of unknowns); noise_held: scale and nu stay as they are; tolerance: largest
    decrease of F still to be had at the end; raise_if_cancelled(): called before every step, may
    raise to stop. Returns Adjustment; converged is False after max_steps.
    """
    correction = np.zeros_like(network.uv) if correction is None else correction
    if redundancy is None:
        redundancy = max(0.1, 1 - network.unknowns / network.observations)

    def renewed(noise, q):
        return (noise, q) if noise_held else _renewed(network, noise, q, redundancy)

    parameters = start
    damping = _Damping()
    converged = False
    step = 0
    blocks = None
    r, q = residuals_and_q(network, parameters, correction, noise)
    noise, q = renewed(noise, q)
    cost = total_cost(network, parameters, q, noise)
    for step in range(1, max_steps + 1):
        if raise_if_cancelled is not None:
            raise_if_cancelled()
        if blocks is None:
            blocks = bordered_blocks(
                network, normal_equations(network, parameters, correction, noise)
            )
        try:
            moved, predicted = _trial(
                network, parameters, blocks, damping.mu, 1 / noise.information_factor(q)
            )
        except (np.linalg.LinAlgError, ValueError):
            if damping.refuse():
                break
            continue
        r_new, q_new = residuals_and_q(network, moved, correction, noise)
        cost_new = total_cost(network, moved, q_new, noise)
        if cost_new > cost + 1e-12 * abs(cost):
            converged = (
                predicted <= 1e-3 * tolerance
            )  # no decrease is left that rounding does not hide
            if converged or damping.refuse():
                break
            continue
        damping.accept((cost - cost_new) / max(predicted, 1e-300))
        last_scale = noise.scale
        parameters = moved
        r = r_new
        blocks = None
        noise, q = renewed(noise, q_new)
        cost = total_cost(network, parameters, q, noise)
        if predicted <= tolerance and abs(noise.scale - last_scale) <= 1e-4 * last_scale:
            converged = True
            break
    return Adjustment(in_datum(network, parameters), r, q, noise, float(cost), step, converged)


class _Damping:
    """Nielsen's damping: mu follows the gain ratio, and grows ever faster while steps are refused."""

    def __init__(self):
        self.mu = 1e-10
        self._growth = 2.0

    def accept(self, gain):
        """A step was taken; gain: its decrease over the predicted one."""
        self.mu = max(self.mu * max(1 / 3, 1 - (2 * gain - 1) ** 3), 1e-15)
        self._growth = 2.0

    def refuse(self):
        """A step was not taken; returns True when there is no use in going on."""
        self.mu = max(self.mu, 1e-10) * self._growth
        self._growth = 2 * self._growth
        return self.mu > 1e12


def _trial(network, parameters, blocks, mu, stretch):
    """Parameters after a damped step, and the decrease of F that the linearised problem predicts.

    stretch: the weighted normal matrix is larger than the information by this factor; a longer
    step converges in a third of the steps where the tails are heavy. Raises
    numpy.linalg.LinAlgError, or ValueError for NaN.
    """
    bb, _, rr, b, right = blocks
    x_b, x_r = damped_step(blocks, mu)
    undamped = np.sum(x_b * b) + np.sum(x_r * right)
    damping = mu * (np.einsum('ki,kii,ki', x_b, bb, x_b) + np.sum(x_r * x_r * np.diag(rr)))
    return _moved(network, parameters, stretch * x_b, stretch * x_r), (undamped + damping) / 2


def _renewed(network, noise, q, redundancy):
    """Noise model estimated anew from q, and q under it."""
    if not np.isfinite(q).all():
        return noise, q
    new = noise.estimated(q * noise.scale**2, 2 * (1 - np.asarray(redundancy)))
    new = replace(new, scale=max(new.scale, MIN_NOISE_PX / float(np.median(network.sigma))))
    return new, q * (noise.scale / new.scale) ** 2
