"""Precision of an adjustment: covariances of unknowns and residuals, and redundancy numbers.

C_r = C_l - A C_x A^T (Foerstner and Wrobel, "Photogrammetric Computer Vision", Springer 2016, 4.2), with
C_l the covariance of the image points divided by their robust weights.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from .adjustment import bordered_blocks, eliminates_points, normal_equations, reduce_blocks
from .collinearity import project_with_jacobian
from .noise import Noise

CHUNK = 50_000   # image points handled at once, to bound the memory


@dataclass(frozen=True)
class Precision:
    """Covariances of an adjustment.

    interior (F, 3, 3) [px^2], zeros where held; exterior (m, 6, 6) of T [mm] and w [rad]; points (n, 3, 3)
    [mm^2]; residual (N, 2, 2) [px^2]; redundancy (N, 2) of the image coordinates and survey_redundancy
    (n, 3) of the surveyed ones: together their sum is the number of observations less that of the unknowns.
    """

    interior: np.ndarray
    exterior: np.ndarray
    points: np.ndarray
    residual: np.ndarray
    redundancy: np.ndarray
    survey_redundancy: np.ndarray


def _covariance_blocks(network, equations):
    """Blocks of the inverse normal matrix: ee (m,6,6), pp (n,3,3), ii (3F,3F), ei (m,6,3), pi (n,3,3F), pe(i)."""
    _, m, n, n_fluoro = network.shape
    bb, br, rr, _, _ = bordered_blocks(network, equations)
    inverse, g, schur = reduce_blocks(bb, br, rr)
    c_rr = cho_solve(cho_factor(schur, lower=True), np.eye(len(schur)))
    c_br = -(g @ c_rr)
    k, size, q = br.shape
    c_bb = inverse - c_br.reshape(k, size, q) @ g.reshape(k, size, q).transpose(0, 2, 1)
    c_br = c_br.reshape(k, size, q)

    cells = m if eliminates_points(network) else n
    width = 6 if eliminates_points(network) else 3
    rest = np.arange(cells * width).reshape(cells, width)
    c_rest = c_rr[rest[:, :, None], rest[:, None, :]]
    free = np.repeat(network.interior_free, 3)
    c_ii = np.zeros((3 * n_fluoro, 3 * n_fluoro))
    c_ii[np.ix_(free, free)] = c_rr[cells * width:, cells * width:]
    c_rest_i, c_b_i = np.zeros((cells, width, 3 * n_fluoro)), np.zeros((k, size, 3 * n_fluoro))
    c_rest_i[:, :, free] = c_rr[:cells * width, cells * width:].reshape(cells, width, -1)
    c_b_i[:, :, free] = c_br[:, :, cells * width:]
    c_pairs = c_br[:, :, :cells * width].reshape(k, size, cells, width)
    if eliminates_points(network):
        return c_rest, c_bb, c_ii, c_rest_i, c_b_i, lambda e, p: c_pairs[p, :, e, :]
    return c_bb, c_rest, c_ii, c_b_i, c_rest_i, lambda e, p: c_pairs[e, :, p, :].transpose(0, 2, 1)


def _covariance_of_projection(network, parameters, blocks):
    """A C_x A^T (N, 2, 2) [px^2] of the image points."""
    ee, pp, ii, ei, pi, pe = blocks
    out = np.empty((len(network.uv), 2, 2))
    everything = parameters.per_image_point(network)
    for start in range(0, len(out), CHUNK):
        part = slice(start, start + CHUNK)
        e, p = network.exposure[part], network.point[part]
        f = network.fluoroscope[e]
        cols = 3 * f[:, None] + np.arange(3)
        _, d_e, d_p, d_i = project_with_jacobian(*(a[part] for a in everything))
        c = np.empty((len(e), 12, 12))
        c[:, :6, :6], c[:, 6:9, 6:9] = ee[e], pp[p]
        c[:, 9:, 9:] = ii[cols[:, :, None], cols[:, None, :]]
        c[:, 6:9, :6] = pe(e, p)
        c[:, :6, 9:] = np.take_along_axis(ei[e], cols[:, None, :], axis=2)
        c[:, 6:9, 9:] = np.take_along_axis(pi[p], cols[:, None, :], axis=2)
        c[:, :6, 6:9] = c[:, 6:9, :6].transpose(0, 2, 1)
        c[:, 9:, :9] = c[:, :9, 9:].transpose(0, 2, 1)
        a = np.concatenate([d_e, d_p, d_i], axis=2)
        out[part] = a @ c @ a.transpose(0, 2, 1)
    return out


def precision(network, adjustment, correction=None):
    """Covariances and redundancy numbers of an adjustment.

    Covariances of the unknowns hold under the true noise distribution (Fisher information), those of the
    residuals and the redundancy numbers belong to the weighted least squares problem at the solution.
    Raises numpy.linalg.LinAlgError where the network does not determine the unknowns.
    """
    correction = np.zeros_like(network.uv) if correction is None else correction
    parameters, noise = adjustment.parameters, adjustment.noise
    weighted = _covariance_blocks(network, normal_equations(network, parameters, correction, noise))
    projected = _covariance_of_projection(network, parameters, weighted)
    variance = (noise.scale * network.sigma) ** 2 / noise.weight(adjustment.q)
    residual = variance[:, None, None] * np.eye(2) - projected
    redundancy = 1 - np.diagonal(projected, axis1=1, axis2=2) / variance[:, None]
    survey = 1 - np.diagonal(weighted[1], axis1=1, axis2=2) / network.survey_sd_mm[:, None] ** 2

    factor = noise.information_factor(adjustment.q)
    honest = weighted if factor == 1.0 else _covariance_blocks(
        network, normal_equations(network, parameters, correction, noise, factor))
    interior = np.stack([honest[2][3 * f:3 * f + 3, 3 * f:3 * f + 3] for f in range(network.shape[3])])
    return Precision(interior, honest[0], honest[1], residual, redundancy, survey)


def geometric_redundancy(network, parameters, noise):
    """Redundancy numbers (N,) of the image points, mean of u and v, from the geometry: all weights equal.

    Unlike those of the weighted problem they do not follow the residuals, and so can be used to estimate
    the noise from them. Raises numpy.linalg.LinAlgError where the network does not determine the unknowns.
    """
    plain = Noise('gaussian', noise.scale)
    blocks = _covariance_blocks(network, normal_equations(network, parameters, 0.0, plain))
    projected = _covariance_of_projection(network, parameters, blocks)
    return 1 - np.trace(projected, axis1=1, axis2=2) / (2 * (noise.scale * network.sigma) ** 2)
