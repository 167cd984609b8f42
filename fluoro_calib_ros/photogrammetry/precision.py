"""Precision of an adjustment: covariances of unknowns and residuals, and redundancy numbers.

C_r = C_l - A C_x A^T (Foerstner and Wrobel, "Photogrammetric Computer Vision", Springer 2016,
4.2), with C_l the covariance of the image points divided by their robust weights.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from .collinearity import project_with_jacobian
from .datum import Gauge, STransformation
from .noise import Noise
from .normal_equations import bordered_blocks, eliminates_points, normal_equations, reduce_blocks
from .relative_orientation import UNKNOWNS, discrepancies_with_jacobian

MIN_WEIGHT = 1e-9  # of a gross error
CHUNK = 5_000  # image points handled at once, to bound the memory


@dataclass(frozen=True)
class Precision:
    """Covariances of an adjustment.

    interior (F, 3, 3) [px^2], zeros where held; exterior (m, 6, 6) of T [mm] and w [rad]; points
    (n, 3, 3) [mm^2]; residual (N, 2, 2) [px^2]; redundancy (N, 2) of the image coordinates and
    survey_redundancy (n, 3) of the surveyed ones: together their sum is the number of observations
    less that of the unknowns, where no prior adds to them; additional: (p, p) of the additional
    parameters by fluoroscope, None where there are none; relative: (6, 6) of every relative
    orientation, translation [mm] and rotation [rad], that is constrained, and relative_redundancy
    (k, 6) of its pairs; all_global (G, G) of the global unknowns and exterior_global (m, 6, G) of
    the exposures with them.
    """

    interior: np.ndarray
    exterior: np.ndarray
    points: np.ndarray
    residual: np.ndarray
    redundancy: np.ndarray
    survey_redundancy: np.ndarray
    additional: tuple = ()
    relative: tuple = ()
    relative_redundancy: tuple = ()
    all_global: np.ndarray | None = None
    exterior_global: np.ndarray | None = None


@dataclass(frozen=True)
class CovarianceBlocks:
    """Blocks of the inverse normal matrix: ee (m, 6, 6), pp (n, 3, 3), gg (G, G), eg (m, 6, G), pg
    (n, 3, G), zeros where a global unknown is held; pe(e, p): blocks (k, 3, 6) of points p (k,)
    with exposures e (k,); between(e, f): blocks (k, 6, 6) of exposures e (k,) with others f (k,).
    """

    ee: np.ndarray
    pp: np.ndarray
    gg: np.ndarray
    eg: np.ndarray
    pg: np.ndarray
    pe: object
    between: object


@dataclass(frozen=True)
class Solved:
    """A normal matrix after the elimination: inverse Cholesky factors (k, b, b) of the
    block-diagonal part, H (k b, q) as in reduce_blocks, and the lower Cholesky factor (q, q) of
    the Schur complement; gauge: the directions that the network leaves open, None where there are
    none.
    """

    inverse: np.ndarray
    h: np.ndarray
    factor: np.ndarray
    gauge: Gauge | None = None


def solved(network, equations):
    """Solved normal equations. Raises numpy.linalg.LinAlgError where the matrix is singular."""
    bb, br, rr, _, _ = bordered_blocks(network, equations)
    inverse, h, schur = reduce_blocks(bb, br, rr)
    return Solved(inverse, h, cho_factor(schur, lower=True, overwrite_a=True)[0], equations.gauge)


def covariance_blocks(network, matrix):
    """CovarianceBlocks of a Solved normal matrix, those of a free network in its datum."""
    _, m, n, _ = network.shape
    k, size = matrix.inverse.shape[:2]
    q = len(matrix.factor)
    c_rr = cho_solve((matrix.factor, True), np.eye(q))
    back = matrix.inverse.transpose(0, 2, 1)
    g = back @ matrix.h.reshape(k, size, q)
    c_br = -(g.reshape(-1, q) @ c_rr).reshape(k, size, q)
    own = back @ matrix.inverse
    c_bb = own - c_br @ g.transpose(0, 2, 1)

    points = eliminates_points(network)
    cells, width = (m, 6) if points else (n, 3)
    rest = np.arange(cells * width).reshape(cells, width)
    c_rest = c_rr[rest[:, :, None], rest[:, None, :]]
    if not points:
        between = _between_eliminated(network, own, c_br, g)
        c_bb, c_br = _of_exposures(network, c_bb, c_br)
    free = network.global_free
    count = len(network.global_free)
    c_gg = np.zeros((count, count))
    c_rest_g = np.zeros((cells, width, count))
    c_b_g = np.zeros(c_br.shape[:2] + (count,))
    c_gg[np.ix_(free, free)] = c_rr[cells * width :, cells * width :]
    c_rest_g[:, :, free] = c_rr[: cells * width, cells * width :].reshape(cells, width, -1)
    c_b_g[:, :, free] = c_br[:, :, cells * width :]
    c_pairs = c_br[:, :, : cells * width].reshape(c_br.shape[:2] + (cells, width))
    if points:
        blocks = CovarianceBlocks(
            c_rest,
            c_bb,
            c_gg,
            c_rest_g,
            c_b_g,
            lambda e, p: c_pairs[p, :, e, :],
            lambda e, f: c_rr[rest[e][:, :, None], rest[f][:, None, :]],
        )
    else:
        blocks = CovarianceBlocks(
            c_bb,
            c_rest,
            c_gg,
            c_b_g,
            c_rest_g,
            lambda e, p: c_pairs[e, :, p, :].transpose(0, 2, 1),
            between,
        )
    return blocks if matrix.gauge is None else _in_datum(network, matrix, blocks)


def _of_exposures(network, c_bb, c_br):
    """Blocks (m, 6, 6) and (m, 6, q) of the exposures, of those of their cells."""
    cell, place, places = network.cells
    k, size, q = c_br.shape
    return (
        c_bb.reshape(k, places, 6, places, 6)[cell, place, :, place, :],
        c_br.reshape(k, places, 6, q)[cell, place],
    )


def _between_eliminated(network, own, c_br, g):
    """Function of exposures e (k,) and f (k,) for their mixed covariances (k, 6, 6)."""
    cell, place, places = network.cells
    k, size, q = c_br.shape
    own = own.reshape(k, places, 6, places, 6)
    c_br, g = (a.reshape(k, places, 6, q) for a in (c_br, g))

    def between(e, f):
        same = (cell[e] == cell[f])[:, None, None]
        return np.where(same, own[cell[e], place[e], :, place[f], :], 0.0) - c_br[
            cell[e], place[e]
        ] @ g[cell[f], place[f]].transpose(0, 2, 1)

    return between


def _in_datum(network, matrix, blocks):
    """CovarianceBlocks of a free network, of those with other directions held, in its datum."""
    gauge = matrix.gauge
    s = STransformation(gauge, *_covariance_times(network, matrix, gauge.constraint))

    def rows(pair, index):
        return pair[0][index], pair[1][index]

    free = network.global_free
    return CovarianceBlocks(
        s.block(blocks.ee, s.e, s.e),
        s.block(blocks.pp, s.p, s.p),
        s.block(blocks.gg, s.g, s.g) * np.outer(free, free),
        s.block(blocks.eg, s.e, s.g) * free,
        s.block(blocks.pg, s.p, s.g) * free,
        lambda e, p: s.block(blocks.pe(e, p), rows(s.p, p), rows(s.e, e)),
        lambda e, f: s.block(blocks.between(e, f), rows(s.e, e), rows(s.e, f)),
    )


def _covariance_times(network, matrix, of_points):
    """Products of the inverse of a Solved matrix with columns that are of_points (n, 3, d), zero
    for other unknowns: exposures (m, 6, d), points (n, 3, d) and global unknowns (G, d).
    """
    _, m, n, _ = network.shape
    k, size = matrix.inverse.shape[:2]
    d = of_points.shape[2]
    q = len(matrix.factor)
    points = eliminates_points(network)
    half = np.zeros((k * size, d))
    right = np.zeros((q, d))
    if points:
        half = (matrix.inverse @ of_points).reshape(-1, d)
    else:
        right[: 3 * n] = of_points.reshape(-1, d)
    x_r = cho_solve((matrix.factor, True), right - matrix.h.T @ half)
    x_b = matrix.inverse.transpose(0, 2, 1) @ (half - matrix.h @ x_r).reshape(k, size, d)
    x_g = np.zeros((len(network.global_free), d))
    x_g[network.global_free] = x_r[6 * m if points else 3 * n :]
    if points:
        return x_r[: 6 * m].reshape(m, 6, d), x_b, x_g
    cell, place, places = network.cells
    return x_b.reshape(-1, places, 6, d)[cell, place], x_r[: 3 * n].reshape(n, 3, d), x_g


def information_of_additional(network, matrix, f):
    """Information (p, p) of the additional parameters of fluoroscope f, prior included, all else
    eliminated.

    In a Cholesky factor the last rows are the factor of their Schur complement.
    """
    offset = 3 * network.shape[3] + UNKNOWNS * len(network.relative)
    first = len(matrix.factor) - int(np.sum(network.global_free[offset:]))
    factor = np.tril(matrix.factor[first:, first:])
    everything = factor @ factor.T
    columns = network.additional_columns[f]
    own = np.arange(columns.start, columns.stop) - offset
    rest = np.setdiff1d(np.arange(len(everything)), own)
    out = everything[np.ix_(own, own)]
    if len(rest):
        mixed = everything[np.ix_(rest, own)]
        out = out - mixed.T @ np.linalg.solve(everything[np.ix_(rest, rest)], mixed)
    return out


def covariance_of_projection(network, parameters, blocks):
    """A C_x A^T (N, 2, 2) [px^2] of the image points, their additional parameters among the
    unknowns.
    """
    out = np.empty((len(network.uv), 2, 2))
    everything = parameters.per_image_point(network)
    for f in range(network.shape[3]):
        rows = network.rows(f)
        for start in range(0, len(rows), CHUNK):
            local = slice(start, start + CHUNK)
            part = rows[local]
            _, d_e, d_p, d_i = project_with_jacobian(*(a[part] for a in everything))
            a = np.concatenate([d_e, d_p, d_i], axis=2)
            e = network.exposure[part]
            p = network.point[part]
            out[part] = a @ _covariance_of_orientation(blocks, f, e, p) @ a.transpose(0, 2, 1)
            additional = network.additional[f] if network.additional else None
            if additional is not None:
                cols = network.additional_columns[f]
                out[part] += additional.variance(blocks.gg[cols, cols], local)
                own = blocks.gg[None, 3 * f : 3 * f + 3, cols]
                mixed = a @ np.concatenate(
                    [
                        additional.against(c, index, local)
                        for c, index in (
                            (blocks.eg[:, :, cols], e),
                            (blocks.pg[:, :, cols], p),
                            (own, np.zeros_like(e)),
                        )
                    ],
                    axis=1,
                )
                out[part] += mixed + mixed.transpose(0, 2, 1)
    return out


def _covariance_of_orientation(blocks, f, e, p):
    """Covariances (k, 12, 12) of exterior orientation, object point and interior orientation for
    image points.
    """
    cols = slice(3 * f, 3 * f + 3)
    c = np.empty((len(e), 12, 12))
    c[:, :6, :6] = blocks.ee[e]
    c[:, 6:9, 6:9] = blocks.pp[p]
    c[:, 9:, 9:] = blocks.gg[cols, cols]
    c[:, 6:9, :6] = blocks.pe(e, p)
    c[:, :6, 9:] = blocks.eg[:, :, cols][e]
    c[:, 6:9, 9:] = blocks.pg[:, :, cols][p]
    c[:, :6, 6:9] = c[:, 6:9, :6].transpose(0, 2, 1)
    c[:, 9:, :9] = c[:, :9, 9:].transpose(0, 2, 1)
    return c


def precision(network, adjustment, correction=None):
    """Covariances and redundancy numbers of an adjustment.

    Covariances of the unknowns hold under the true noise distribution (Fisher information), those
    of the residuals and the redundancy numbers belong to the weighted least squares problem at the
    solution. Raises numpy.linalg.LinAlgError where the network does not determine the unknowns.
    """
    correction = np.zeros_like(network.uv) if correction is None else correction
    parameters = adjustment.parameters
    noise = adjustment.noise
    weighted = covariance_blocks(
        network, solved(network, normal_equations(network, parameters, correction, noise))
    )
    projected = covariance_of_projection(network, parameters, weighted)
    residual = residual_covariance(network, adjustment, weighted, projected)
    variance = _variance(network, adjustment)
    redundancy = 1 - np.diagonal(projected, axis1=1, axis2=2) / variance[:, None]
    survey = np.zeros_like(network.survey_mm)
    if network.datum == 'survey':
        survey = (
            1 - np.diagonal(weighted.pp, axis1=1, axis2=2) / network.survey_sd_mm[:, None] ** 2
        )

    factor = noise.information_factor(adjustment.q)
    honest = (
        weighted
        if factor == 1.0
        else covariance_blocks(
            network,
            solved(network, normal_equations(network, parameters, correction, noise, factor)),
        )
    )
    interior = np.stack(
        [honest.gg[3 * f : 3 * f + 3, 3 * f : 3 * f + 3] for f in range(network.shape[3])]
    )
    additional = tuple(
        None if a is None else honest.gg[columns, columns]
        for a, columns in zip(network.additional, network.additional_columns)
    )
    relative = tuple(honest.gg[columns, columns] for columns in network.relative_columns)
    return Precision(
        interior,
        honest.ee,
        honest.pp,
        residual,
        redundancy,
        survey,
        additional,
        relative,
        _relative_redundancy(network, parameters, weighted),
        honest.gg,
        honest.eg,
    )


def _relative_redundancy(network, parameters, blocks):
    """Redundancy numbers (k, 6) of the pairs of every relative orientation constraint."""
    out = []
    for constraint, pose, cols in zip(
        network.relative, parameters.relative, network.relative_columns
    ):
        (a, b) = constraint.pairs.T
        (_, d_a, d_b, d_pose) = discrepancies_with_jacobian(constraint, pose, parameters)
        a_x = np.concatenate([d_a, d_b, d_pose], axis=2)
        c = np.empty((len(a), 18, 18))
        c[:, :6, :6] = blocks.ee[a]
        c[:, 6:12, 6:12] = blocks.ee[b]
        c[:, 12:, 12:] = blocks.gg[cols, cols]
        c[:, :6, 6:12] = blocks.between(a, b)
        c[:, :6, 12:] = blocks.eg[a][:, :, cols]
        c[:, 6:12, 12:] = blocks.eg[b][:, :, cols]
        for rows, columns in ((slice(6, 12), slice(0, 6)), (slice(12, 18), slice(0, 12))):
            c[:, rows, columns] = c[:, columns, rows].transpose(0, 2, 1)
        out.append(1 - np.einsum('kia,kab,kib->ki', a_x, c, a_x) * constraint.weights)
    return tuple(out)


def _variance(network, adjustment):
    """Variances (N,) [px^2] of the image points of the weighted least squares problem."""
    weight = np.maximum(adjustment.noise.weight(adjustment.q), MIN_WEIGHT)
    return (adjustment.noise.scale * network.sigma) ** 2 / weight


def residual_covariance(network, adjustment, blocks, projected=None):
    """C_r (N, 2, 2) [px^2] of the residuals, of the CovarianceBlocks of the unknowns; projected: A
    C_x A^T, None if it is not at hand.
    """
    if projected is None:
        projected = covariance_of_projection(network, adjustment.parameters, blocks)
    return _variance(network, adjustment)[:, None, None] * np.eye(2) - projected


def geometric_redundancy(network, parameters, noise):
    """Redundancy numbers (N,) of the image points, mean of u and v, from the geometry: all weights
    equal.

    Unlike those of the weighted problem they do not follow the residuals, and so can be used to
    estimate the noise from them. Raises numpy.linalg.LinAlgError where the network does not
    determine the unknowns.
    """
    plain = Noise('gaussian', noise.scale)
    blocks = covariance_blocks(
        network, solved(network, normal_equations(network, parameters, 0.0, plain))
    )
    projected = covariance_of_projection(network, parameters, blocks)
    return 1 - np.trace(projected, axis1=1, axis2=2) / (2 * (noise.scale * network.sigma) ** 2)
