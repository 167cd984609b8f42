"""Robust bundle adjustment of one or more fluoroscopes that look at one phantom.

Maximum likelihood of the image points (Student-t, Huber or Gaussian) and of the surveyed coordinates
(Gaussian, they fix the datum) by Levenberg-Marquardt with Nielsen's damping (Madsen, Nielsen and Tingleff,
"Methods for non-linear least squares problems", DTU 2004), iteratively reweighted. Each step solves the
normal equations by the Schur complement (Triggs et al., "Bundle Adjustment - A Modern Synthesis", 2000),
eliminating object points or exposures, whichever leaves the smaller system.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from .collinearity import project, project_with_jacobian
from .noise import Noise
from .rotations import matrix_from_vector

# No target is measured better than this; where there is hardly any redundancy the scale could vanish.
SMALLEST_NOISE_PX = 0.01


@dataclass(frozen=True)
class Network:
    """Image points and what they connect.

    uv (N, 2) observed [px]; sigma (N,) a-priori standard deviation [px], or ones; exposure (N,) ascending
    and point (N,): row of the exposure and of the object point, each pair at most once;
    fluoroscope (m,) of each exposure; survey_mm (n, 3) and survey_sd_mm (n,) of the object points;
    interior_free (F,): whether the interior orientation of a fluoroscope is estimated.
    """

    uv: np.ndarray
    sigma: np.ndarray
    exposure: np.ndarray
    point: np.ndarray
    fluoroscope: np.ndarray
    survey_mm: np.ndarray
    survey_sd_mm: np.ndarray
    interior_free: np.ndarray

    @property
    def shape(self):
        """Numbers of image points, exposures, object points and fluoroscopes."""
        return len(self.uv), len(self.fluoroscope), len(self.survey_mm), len(self.interior_free)

    @property
    def unknowns(self):
        """Number of unknowns."""
        return 6 * len(self.fluoroscope) + self.survey_mm.size + 3 * int(np.sum(self.interior_free))


@dataclass(frozen=True)
class Parameters:
    """Values of the unknowns: interior (F, 3) xp, yp, c [px]; rotation (m, 3, 3); position_mm (m, 3);
    points_mm (n, 3)."""

    interior: np.ndarray
    rotation: np.ndarray
    position_mm: np.ndarray
    points_mm: np.ndarray

    def per_image_point(self, network):
        """Rotation, position, point and interior orientation of every image point."""
        e = network.exposure
        return (self.rotation[e], self.position_mm[e], self.points_mm[network.point],
                self.interior[network.fluoroscope[e]])


@dataclass(frozen=True)
class Adjustment:
    """Result of an adjustment.

    residuals (N, 2) observed - correction - projected [px]; q (N,) normalised squared residuals; cost F,
    the negative log-likelihood; steps of Levenberg-Marquardt taken; converged.
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


@dataclass(frozen=True)
class NormalEquations:
    """Blocks of the normal matrix and of its right side.

    Exposures ee (m, 6, 6), points pp (n, 3, 3) and interior ii (3F, 3F); mixed ei (m, 6, 3) with the
    fluoroscope of the exposure, pi (n, 3, 3F) and pe (N, 3, 6); right sides e, p and i.
    """

    ee: np.ndarray
    pp: np.ndarray
    ii: np.ndarray
    ei: np.ndarray
    pi: np.ndarray
    pe: np.ndarray
    e: np.ndarray
    p: np.ndarray
    i: np.ndarray


def residuals_and_q(network, parameters, correction, noise):
    """Residuals (N, 2) [px] and normalised squared residuals (N,); NaN where a point is behind the source."""
    r = network.uv - correction - project(*parameters.per_image_point(network))
    return r, np.sum(r * r, axis=1) / (noise.scale * network.sigma) ** 2


def total_cost(network, parameters, q, noise):
    """F: negative log-likelihood of image points and surveyed coordinates; infinite behind the source."""
    survey = np.sum(((parameters.points_mm - network.survey_mm) / network.survey_sd_mm[:, None]) ** 2) / 2
    value = noise.cost(q, network.sigma) + survey
    return value if np.isfinite(value) else np.inf


def _sum_by(index, values, count):
    """Sums (count, ...) of values (N, ...) that share an index; index (N,) ascending, none left out."""
    starts = np.searchsorted(index, np.arange(count))
    return np.add.reduceat(values, starts, axis=0)


def normal_equations(network, parameters, correction, noise, image_factor=1.0):
    """Normal equations of the weighted linearised problem; image_factor multiplies the image weights."""
    n_image, m, n, n_fluoro = network.shape
    uv, d_e, d_p, d_i = project_with_jacobian(*parameters.per_image_point(network))
    r = network.uv - correction - uv
    variance = (noise.scale * network.sigma) ** 2
    root = np.sqrt(image_factor * noise.weight(np.sum(r * r, axis=1) / variance) / variance)
    r = (root[:, None] * r)[..., None]
    a_e, a_p, a_i = (root[:, None, None] * a for a in (d_e, d_p, d_i))
    a_et, a_pt, a_it = (a.transpose(0, 2, 1) for a in (a_e, a_p, a_i))

    by_exposure = _sum_by(network.exposure, np.concatenate([a_et @ a_e, a_et @ a_i, a_et @ r], axis=2), m)
    own = _sum_by(network.exposure, np.concatenate([a_it @ a_i, a_it @ r], axis=2), m)
    order = np.argsort(network.point, kind='stable')
    by_point = _sum_by(network.point[order], np.concatenate([a_pt @ a_p, a_pt @ r], axis=2)[order], n)

    survey = 1 / network.survey_sd_mm ** 2
    pp = by_point[:, :, :3] + survey[:, None, None] * np.eye(3)
    p = by_point[:, :, 3] + survey[:, None] * (network.survey_mm - parameters.points_mm)
    ii, i = np.zeros((3 * n_fluoro, 3 * n_fluoro)), np.zeros(3 * n_fluoro)
    pi = np.zeros((n, 3, 3 * n_fluoro))
    a_pi, of_point = (a_pt @ a_i)[order], network.fluoroscope[network.exposure[order]]
    for f in range(n_fluoro):
        cols, mine = slice(3 * f, 3 * f + 3), network.fluoroscope == f
        ii[cols, cols], i[cols] = own[mine, :, :3].sum(axis=0), own[mine, :, 3].sum(axis=0)
        pi[:, :, cols] = _sum_by(network.point[order], a_pi * (of_point == f)[:, None, None], n)
    return NormalEquations(by_exposure[:, :, :6], pp, ii, by_exposure[:, :, 6:9], pi, a_pt @ a_e,
                           by_exposure[:, :, 9], p, i)


def eliminates_points(network):
    """Whether the object points are eliminated (else the exposures): what leaves the smaller system."""
    _, m, n, _ = network.shape
    return 6 * m < 3 * n


def bordered_blocks(network, equations):
    """The normal equations as a block-diagonal part and the rest.

    Returns bb (k, b, b), br (k, b, q), rr (q, q), right sides b (k, b) and r (q,). The rest ends with the
    interior orientation, of which only the free ones are kept.
    """
    n_image, m, n, n_fluoro = network.shape
    free = np.repeat(network.interior_free, 3)
    k = 3 * n_fluoro
    ei = np.zeros((m, 6, k))
    for f in range(n_fluoro):
        mine = network.fluoroscope == f
        ei[mine, :, 3 * f:3 * f + 3] = equations.ei[mine]
    if eliminates_points(network):
        br = np.zeros((n, 3, m, 6))
        br[network.point, :, network.exposure, :] = equations.pe
        br = np.concatenate([br.reshape(n, 3, 6 * m), equations.pi[:, :, free]], axis=2)
        bb, b, rest, rest_i, r = equations.pp, equations.p, equations.ee, ei, equations.e
    else:
        br = np.zeros((m, 6, n, 3))
        br[network.exposure, :, network.point, :] = equations.pe.transpose(0, 2, 1)
        br = np.concatenate([br.reshape(m, 6, 3 * n), ei[:, :, free]], axis=2)
        bb, b, rest, rest_i, r = equations.ee, equations.e, equations.pp, equations.pi, equations.p
    count, size = rest.shape[:2]
    rr = np.zeros((br.shape[2], br.shape[2]))
    diagonal = np.arange(count * size).reshape(count, size)
    rr[diagonal[:, :, None], diagonal[:, None, :]] = rest
    rr[:count * size, count * size:] = rest_i.reshape(count * size, k)[:, free]
    rr[count * size:, :count * size] = rr[:count * size, count * size:].T
    rr[count * size:, count * size:] = equations.ii[np.ix_(free, free)]
    return bb, br, rr, b, np.concatenate([r.ravel(), equations.i[free]])


def reduce_blocks(bb, br, rr):
    """Inverse blocks (k, b, b), G = bb^-1 br as (k b, q), and the Schur complement (q, q)."""
    inverse = np.linalg.inv(bb)
    g = inverse @ br
    q = br.shape[2]
    g = g.reshape(-1, q)
    return inverse, g, rr - br.reshape(-1, q).T @ g


def _damped_step(blocks, mu):
    """Solution of (H + mu diag H) x = b for the bordered blocks: x_b (k, b) and x_r (q,).

    Raises numpy.linalg.LinAlgError where the damped matrix is not positive definite.
    """
    bb, br, rr, b, r = blocks
    bb = bb + mu * bb * np.eye(bb.shape[1])
    rr = rr + mu * np.diag(np.diag(rr))
    inverse, g, schur = reduce_blocks(bb, br, rr)
    x_r = cho_solve(cho_factor(schur, lower=True, check_finite=True), r - g.T @ b.ravel())
    return (inverse @ b[..., None])[..., 0] - (g @ x_r).reshape(b.shape), x_r


def _moved(network, parameters, x_b, x_r):
    """Parameters after a step."""
    _, m, n, n_fluoro = network.shape
    free = np.flatnonzero(network.interior_free)
    if eliminates_points(network):
        d_p, d_e, d_i = x_b, x_r[:6 * m].reshape(m, 6), x_r[6 * m:]
    else:
        d_p, d_e, d_i = x_r[:3 * n].reshape(n, 3), x_b, x_r[3 * n:]
    interior = parameters.interior.copy()
    interior[free] += d_i.reshape(-1, 3)
    return Parameters(interior, matrix_from_vector(d_e[:, 3:]) @ parameters.rotation,
                      parameters.position_mm + d_e[:, :3], parameters.points_mm + d_p)


def adjust(network, start, correction=None, noise=Noise(), redundancy=None, tolerance=1e-8, max_steps=100,
           check=None, noise_held=False):
    """Adjust a network with the corrections held.

    start: Parameters; correction (N, 2) [px] or None; noise: start values, scale and nu are estimated along
    the way (redundancy: redundancy numbers (N,) of the image points, None: their mean by the count of unknowns);
    noise_held: scale and nu stay as they are; tolerance: largest decrease of F still to be had at the end;
    check(): called before every step, may raise to stop. Returns Adjustment; converged is False after max_steps.
    """
    correction = np.zeros_like(network.uv) if correction is None else correction
    if redundancy is None:
        redundancy = max(0.1, 1 - network.unknowns / (2 * len(network.uv) + network.survey_mm.size))

    def renewed(noise, q):
        return (noise, q) if noise_held else _renewed(network, noise, q, redundancy)

    parameters, damping, converged, step, blocks = start, _Damping(), False, 0, None
    r, q = residuals_and_q(network, parameters, correction, noise)
    noise, q = renewed(noise, q)
    cost = total_cost(network, parameters, q, noise)
    for step in range(1, max_steps + 1):
        if check is not None:
            check()
        if blocks is None:
            blocks = bordered_blocks(network, normal_equations(network, parameters, correction, noise))
        try:
            moved, predicted = _trial(network, parameters, blocks, damping.mu, 1 / noise.information_factor(q))
        except (np.linalg.LinAlgError, ValueError):
            if damping.refuse():
                break
            continue
        r_new, q_new = residuals_and_q(network, moved, correction, noise)
        cost_new = total_cost(network, moved, q_new, noise)
        if cost_new > cost + 1e-12 * abs(cost):
            converged = predicted <= 1e-3 * tolerance   # no decrease is left that rounding does not hide
            if converged or damping.refuse():
                break
            continue
        damping.accept((cost - cost_new) / max(predicted, 1e-300))
        last_scale = noise.scale
        parameters, r, blocks = moved, r_new, None
        noise, q = renewed(noise, q_new)
        cost = total_cost(network, parameters, q, noise)
        if predicted <= tolerance and abs(noise.scale - last_scale) <= 1e-4 * last_scale:
            converged = True
            break
    return Adjustment(parameters, r, q, noise, float(cost), step, converged)


class _Damping:
    """Nielsen's damping: mu follows the gain ratio, and grows ever faster while steps are refused."""

    def __init__(self):
        self.mu, self._growth = 1e-6, 2.0

    def accept(self, gain):
        """A step was taken; gain: its decrease over the predicted one."""
        self.mu, self._growth = max(self.mu * max(1 / 3, 1 - (2 * gain - 1) ** 3), 1e-15), 2.0

    def refuse(self):
        """A step was not taken; returns True when there is no use in going on."""
        self.mu, self._growth = max(self.mu, 1e-10) * self._growth, 2 * self._growth
        return self.mu > 1e12


def _trial(network, parameters, blocks, mu, stretch):
    """Parameters after a damped step, and the decrease of F that the linearised problem predicts.

    stretch: the weighted normal matrix is larger than the information by this factor; a longer step converges
    in a third of the steps where the tails are heavy. Raises numpy.linalg.LinAlgError, or ValueError for NaN.
    """
    bb, _, rr, b, right = blocks
    x_b, x_r = _damped_step(blocks, mu)
    undamped = np.sum(x_b * b) + np.sum(x_r * right)
    damping = mu * (np.einsum('ki,kii,ki', x_b, bb, x_b) + np.sum(x_r * x_r * np.diag(rr)))
    return _moved(network, parameters, stretch * x_b, stretch * x_r), (undamped + damping) / 2


def _renewed(network, noise, q, redundancy):
    """Noise model estimated anew from q, and q under it."""
    if not np.isfinite(q).all():
        return noise, q
    new = noise.estimated(q * noise.scale ** 2, redundancy)
    new = replace(new, scale=max(new.scale, SMALLEST_NOISE_PX / float(np.median(network.sigma))))
    return new, q * (noise.scale / new.scale) ** 2
