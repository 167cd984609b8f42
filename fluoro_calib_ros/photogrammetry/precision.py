"""Precision of an adjustment: covariances of unknowns and residuals, and redundancy numbers.

C_r = C_l - A C_x A^T (Foerstner and Wrobel, "Photogrammetric Computer Vision", Springer 2016, 4.2), with
C_l the covariance of the image points divided by their robust weights.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from .collinearity import project_with_jacobian
from .noise import Noise
from .normal import bordered_blocks, eliminates_points, normal_equations, reduce_blocks

SMALLEST_WEIGHT = 1e-9   # of a gross error
CHUNK = 5_000   # image points handled at once, to bound the memory


@dataclass(frozen=True)
class Precision:
    """Covariances of an adjustment.

    interior (F, 3, 3) [px^2], zeros where held; exterior (m, 6, 6) of T [mm] and w [rad]; points (n, 3, 3)
    [mm^2]; residual (N, 2, 2) [px^2]; redundancy (N, 2) of the image coordinates and survey_redundancy
    (n, 3) of the surveyed ones: together their sum is the number of observations less that of the unknowns, where
    no prior adds to them; additional: (p, p) of the additional parameters by fluoroscope, None where there are none.
    """

    interior: np.ndarray
    exterior: np.ndarray
    points: np.ndarray
    residual: np.ndarray
    redundancy: np.ndarray
    survey_redundancy: np.ndarray
    additional: tuple = ()


@dataclass(frozen=True)
class CovarianceBlocks:
    """Blocks of the inverse normal matrix: ee (m, 6, 6), pp (n, 3, 3), gg (G, G), eg (m, 6, G), pg (n, 3, G), zeros where
    a global unknown is held; pe(e, p): blocks (k, 3, 6) of points p (k,) with exposures e (k,)."""

    ee: np.ndarray
    pp: np.ndarray
    gg: np.ndarray
    eg: np.ndarray
    pg: np.ndarray
    pe: object


@dataclass(frozen=True)
class Solved:
    """A normal matrix after the elimination: inverse Cholesky factors (k, b, b) of the block-diagonal part, H (k b, q)
    as in reduce_blocks, and the lower Cholesky factor (q, q) of the Schur complement."""

    inverse: np.ndarray
    h: np.ndarray
    factor: np.ndarray


def solved(network, equations):
    """Solved normal equations. Raises numpy.linalg.LinAlgError where the matrix is singular."""
    bb, br, rr, _, _ = bordered_blocks(network, equations)
    inverse, h, schur = reduce_blocks(bb, br, rr)
    return Solved(inverse, h, cho_factor(schur, lower=True, overwrite_a=True)[0])


def covariance_blocks(network, matrix):
    """CovarianceBlocks of a Solved normal matrix."""
    _, m, n, _ = network.shape
    k, size = matrix.inverse.shape[:2]
    q = len(matrix.factor)
    c_rr = cho_solve((matrix.factor, True), np.eye(q))
    back = matrix.inverse.transpose(0, 2, 1)
    g = back @ matrix.h.reshape(k, size, q)
    c_br = -(g.reshape(-1, q) @ c_rr).reshape(k, size, q)
    c_bb = back @ matrix.inverse - c_br @ g.transpose(0, 2, 1)

    points = eliminates_points(network)
    cells, width = (m, 6) if points else (n, 3)
    rest = np.arange(cells * width).reshape(cells, width)
    c_rest = c_rr[rest[:, :, None], rest[:, None, :]]
    free, count = network.global_free, len(network.global_free)
    c_gg, c_rest_g, c_b_g = np.zeros((count, count)), np.zeros((cells, width, count)), np.zeros((k, size, count))
    c_gg[np.ix_(free, free)] = c_rr[cells * width:, cells * width:]
    c_rest_g[:, :, free] = c_rr[:cells * width, cells * width:].reshape(cells, width, -1)
    c_b_g[:, :, free] = c_br[:, :, cells * width:]
    c_pairs = c_br[:, :, :cells * width].reshape(k, size, cells, width)
    if points:
        return CovarianceBlocks(c_rest, c_bb, c_gg, c_rest_g, c_b_g, lambda e, p: c_pairs[p, :, e, :])
    return CovarianceBlocks(c_bb, c_rest, c_gg, c_b_g, c_rest_g,
                            lambda e, p: c_pairs[e, :, p, :].transpose(0, 2, 1))


def information_of_additional(network, matrix, f):
    """Information (p, p) of the additional parameters of fluoroscope f, prior included, all else eliminated.

    In a Cholesky factor the last rows are the factor of their Schur complement.
    """
    first = len(matrix.factor) - int(np.sum(network.global_free[3 * network.shape[3]:]))
    factor = np.tril(matrix.factor[first:, first:])
    everything = factor @ factor.T
    columns = network.additional_columns[f]
    offset = 3 * network.shape[3]
    own = np.arange(columns.start, columns.stop) - offset
    rest = np.setdiff1d(np.arange(len(everything)), own)
    out = everything[np.ix_(own, own)]
    if len(rest):
        mixed = everything[np.ix_(rest, own)]
        out = out - mixed.T @ np.linalg.solve(everything[np.ix_(rest, rest)], mixed)
    return out


def covariance_of_projection(network, parameters, blocks):
    """A C_x A^T (N, 2, 2) [px^2] of the image points, their additional parameters among the unknowns."""
    out = np.empty((len(network.uv), 2, 2))
    everything = parameters.per_image_point(network)
    for f in range(network.shape[3]):
        rows = network.rows(f)
        for start in range(0, len(rows), CHUNK):
            local = slice(start, start + CHUNK)
            part = rows[local]
            _, d_e, d_p, d_i = project_with_jacobian(*(a[part] for a in everything))
            a = np.concatenate([d_e, d_p, d_i], axis=2)
            e, p = network.exposure[part], network.point[part]
            out[part] = a @ _covariance_of_orientation(blocks, f, e, p) @ a.transpose(0, 2, 1)
            additional = network.additional[f] if network.additional else None
            if additional is not None:
                cols = network.additional_columns[f]
                out[part] += additional.variance(blocks.gg[cols, cols], local)
                own = np.broadcast_to(blocks.gg[3 * f:3 * f + 3, cols], (len(e), 3, additional.count))
                mixed = a @ np.concatenate([additional.against(c, local) for c in (
                    blocks.eg[e][:, :, cols], blocks.pg[p][:, :, cols], own)], axis=1)
                out[part] += mixed + mixed.transpose(0, 2, 1)
    return out


def _covariance_of_orientation(blocks, f, e, p):
    """Covariances (k, 12, 12) of exterior orientation, object point and interior orientation for image points."""
    cols = slice(3 * f, 3 * f + 3)
    c = np.empty((len(e), 12, 12))
    c[:, :6, :6], c[:, 6:9, 6:9], c[:, 9:, 9:] = blocks.ee[e], blocks.pp[p], blocks.gg[cols, cols]
    c[:, 6:9, :6] = blocks.pe(e, p)
    c[:, :6, 9:], c[:, 6:9, 9:] = blocks.eg[e][:, :, cols], blocks.pg[p][:, :, cols]
    c[:, :6, 6:9] = c[:, 6:9, :6].transpose(0, 2, 1)
    c[:, 9:, :9] = c[:, :9, 9:].transpose(0, 2, 1)
    return c


def precision(network, adjustment, correction=None):
    """Covariances and redundancy numbers of an adjustment.

    Covariances of the unknowns hold under the true noise distribution (Fisher information), those of the
    residuals and the redundancy numbers belong to the weighted least squares problem at the solution.
    Raises numpy.linalg.LinAlgError where the network does not determine the unknowns.
    """
    correction = np.zeros_like(network.uv) if correction is None else correction
    parameters, noise = adjustment.parameters, adjustment.noise
    weighted = covariance_blocks(network, solved(network, normal_equations(network, parameters, correction, noise)))
    projected = covariance_of_projection(network, parameters, weighted)
    residual = residual_covariance(network, adjustment, weighted, projected)
    variance = _variance(network, adjustment)
    redundancy = 1 - np.diagonal(projected, axis1=1, axis2=2) / variance[:, None]
    survey = 1 - np.diagonal(weighted.pp, axis1=1, axis2=2) / network.survey_sd_mm[:, None] ** 2

    factor = noise.information_factor(adjustment.q)
    honest = weighted if factor == 1.0 else covariance_blocks(
        network, solved(network, normal_equations(network, parameters, correction, noise, factor)))
    interior = np.stack([honest.gg[3 * f:3 * f + 3, 3 * f:3 * f + 3] for f in range(network.shape[3])])
    additional = tuple(None if a is None else honest.gg[columns, columns]
                       for a, columns in zip(network.additional, network.additional_columns))
    return Precision(interior, honest.ee, honest.pp, residual, redundancy, survey, additional)


def _variance(network, adjustment):
    """Variances (N,) [px^2] of the image points of the weighted least squares problem."""
    weight = np.maximum(adjustment.noise.weight(adjustment.q), SMALLEST_WEIGHT)
    return (adjustment.noise.scale * network.sigma) ** 2 / weight


def residual_covariance(network, adjustment, blocks, projected=None):
    """C_r (N, 2, 2) [px^2] of the residuals, of the CovarianceBlocks of the unknowns; projected: A C_x A^T if at hand."""
    if projected is None:
        projected = covariance_of_projection(network, adjustment.parameters, blocks)
    return _variance(network, adjustment)[:, None, None] * np.eye(2) - projected


def geometric_redundancy(network, parameters, noise):
    """Redundancy numbers (N,) of the image points, mean of u and v, from the geometry: all weights equal.

    Unlike those of the weighted problem they do not follow the residuals, and so can be used to estimate
    the noise from them. Raises numpy.linalg.LinAlgError where the network does not determine the unknowns.
    """
    plain = Noise('gaussian', noise.scale)
    blocks = covariance_blocks(network, solved(network, normal_equations(network, parameters, 0.0, plain)))
    projected = covariance_of_projection(network, parameters, blocks)
    return 1 - np.trace(projected, axis1=1, axis2=2) / (2 * (noise.scale * network.sigma) ** 2)
