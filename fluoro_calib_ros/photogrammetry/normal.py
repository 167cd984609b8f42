"""Normal equations of a bundle adjustment and their solution by the Schur complement.

Triggs, McLauchlan, Hartley and Fitzgibbon, "Bundle Adjustment - A Modern Synthesis", 2000, section 6. Object
points or exposures are eliminated, whichever leaves the smaller system. Interior orientations and
additional parameters, which touch everything, come last.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import blas, cho_factor, cho_solve

from .collinearity import project_with_jacobian


@dataclass(frozen=True)
class NormalEquations:
    """Blocks of the normal matrix and of its right side.

    Exposures ee (m, 6, 6), points pp (n, 3, 3) and global unknowns gg (G, G): interior orientations (3F), then
    the additional parameters of each fluoroscope; mixed eg (m, 6, G), pg (n, 3, G) and pe (N, 3, 6); right sides
    e, p and g.
    """

    ee: np.ndarray
    pp: np.ndarray
    gg: np.ndarray
    eg: np.ndarray
    pg: np.ndarray
    pe: np.ndarray
    e: np.ndarray
    p: np.ndarray
    g: np.ndarray


def _sum_by(index, values, count):
    """Sums (count, ...) of values (N, ...) that share an index; index (N,) ascending, none left out."""
    starts = np.searchsorted(index, np.arange(count))
    return np.add.reduceat(values, starts, axis=0)


def normal_equations(network, parameters, correction, noise, image_factor=1.0):
    """Normal equations of the weighted linearised problem; image_factor multiplies the image weights."""
    _, m, n, n_fluoro = network.shape
    uv, d_e, d_p, d_i = project_with_jacobian(*parameters.per_image_point(network))
    r = network.uv - correction - network.added(parameters) - uv
    variance = (noise.scale * network.sigma) ** 2
    root = np.sqrt(image_factor * noise.weight(np.sum(r * r, axis=1) / variance) / variance)
    r = (root[:, None] * r)[..., None]
    a_e, a_p, a_i = (root[:, None, None] * a for a in (d_e, d_p, d_i))
    a_et, a_pt, a_it = (a.transpose(0, 2, 1) for a in (a_e, a_p, a_i))

    by_exposure = _sum_by(network.exposure, np.concatenate([a_et @ a_e, a_et @ a_i, a_et @ r], axis=2), m)
    own = _sum_by(network.exposure, np.concatenate([a_it @ a_i, a_it @ r], axis=2), m)
    order = network.by_point
    by_point = _sum_by(network.point[order], np.concatenate([a_pt @ a_p, a_pt @ r], axis=2)[order], n)

    survey = 1 / network.survey_sd_mm ** 2
    pp = by_point[:, :, :3] + survey[:, None, None] * np.eye(3)
    p = by_point[:, :, 3] + survey[:, None] * (network.survey_mm - parameters.points_mm)
    size = len(network.global_free)
    gg, g = np.zeros((size, size)), np.zeros(size)
    eg, pg = np.zeros((m, 6, size)), np.zeros((n, 3, size))
    a_pi, of_point = (a_pt @ a_i)[order], network.fluoroscope[network.exposure[order]]
    for f in range(n_fluoro):
        cols, mine = slice(3 * f, 3 * f + 3), network.fluoroscope == f
        gg[cols, cols], g[cols] = own[mine, :, :3].sum(axis=0), own[mine, :, 3].sum(axis=0)
        eg[mine, :, cols] = by_exposure[mine, :, 6:9]
        pg[:, :, cols] = _sum_by(network.point[order], a_pi * (of_point == f)[:, None, None], n)
    _add_additional(network, parameters, root, (a_e, a_p, a_i, r[..., 0]), (gg, eg, pg, g))
    return NormalEquations(by_exposure[:, :, :6], pp, gg, eg, pg, a_pt @ a_e, by_exposure[:, :, 9], p, g)


def _add_additional(network, parameters, root, weighted, blocks):
    """Fill in the rows and columns of the additional parameters; root (N,) of the weights."""
    a_e, a_p, a_i, r = weighted
    gg, eg, pg, g = blocks
    _, m, n, _ = network.shape
    for f, (additional, cols) in enumerate(zip(network.additional, network.additional_columns)):
        if additional is None:
            continue
        rows = network.rows(f)
        w = root[rows, None, None]
        eg[:, :, cols] = additional.sums(network.exposure[rows], m, w * a_e[rows])
        pg[:, :, cols] = additional.sums(network.point[rows], n, w * a_p[rows])
        mixed = additional.sums(np.zeros(len(rows), dtype=int), 1, w * a_i[rows])[0]
        gg[3 * f:3 * f + 3, cols], gg[cols, 3 * f:3 * f + 3] = mixed, mixed.T
        gg[cols, cols] = additional.gram(root[rows] ** 2) + additional.prior
        g[cols] = additional.transposed(w[:, 0] * r[rows]) - additional.prior @ parameters.additional[f]


def eliminates_points(network):
    """Whether the object points are eliminated (else the exposures): what leaves the smaller system."""
    _, m, n, _ = network.shape
    return 6 * m < 3 * n


def bordered_blocks(network, equations):
    """The normal equations as a block-diagonal part and the rest.

    Returns bb (k, b, b), br (k, b, q), rr (q, q), right sides (k, b) and (q,). The rest ends with the
    global unknowns, of which only the free ones are kept.
    """
    _, m, n, _ = network.shape
    free = network.global_free
    if eliminates_points(network):
        br = np.zeros((n, 3, 6 * m + int(free.sum())))
        br[:, :, :6 * m].reshape(n, 3, m, 6)[network.point, :, network.exposure, :] = equations.pe
        br[:, :, 6 * m:] = equations.pg[:, :, free]
        bb, b, rest, rest_g, r = equations.pp, equations.p, equations.ee, equations.eg, equations.e
    else:
        br = np.zeros((m, 6, 3 * n + int(free.sum())))
        br[:, :, :3 * n].reshape(m, 6, n, 3)[network.exposure, :, network.point, :] = equations.pe.transpose(0, 2, 1)
        br[:, :, 3 * n:] = equations.eg[:, :, free]
        bb, b, rest, rest_g, r = equations.ee, equations.e, equations.pp, equations.pg, equations.p
    count, size = rest.shape[:2]
    rr = np.zeros((br.shape[2], br.shape[2]))
    diagonal = np.arange(count * size).reshape(count, size)
    rr[diagonal[:, :, None], diagonal[:, None, :]] = rest
    rr[:count * size, count * size:] = rest_g.reshape(count * size, -1)[:, free]
    rr[count * size:, :count * size] = rr[:count * size, count * size:].T
    rr[count * size:, count * size:] = equations.gg[np.ix_(free, free)]
    return bb, br, rr, b, np.concatenate([r.ravel(), equations.g[free]])


def reduce_blocks(bb, br, rr):
    """Inverse Cholesky factors (k, b, b) of bb, H = L^-1 br as (k b, q), and the Schur complement (q, q).

    Only the lower triangle of the Schur complement is set. Raises numpy.linalg.LinAlgError where bb is not
    positive definite.
    """
    inverse = np.linalg.inv(np.linalg.cholesky(bb))
    h = (inverse @ br).reshape(-1, br.shape[2])
    # In BLAS's order of storage h is its transpose: half the operations of a full product, and no copy.
    schur = blas.dsyrk(-1.0, h.T, beta=1.0, c=np.asfortranarray(rr), trans=0, lower=1, overwrite_c=0)
    return inverse, h, schur


def damped_step(blocks, mu):
    """Solution of (H + mu diag H) x = b for the bordered blocks: x_b (k, b) and x_r (q,).

    Raises numpy.linalg.LinAlgError where the damped matrix is not positive definite.
    """
    bb, br, rr, b, r = blocks
    bb = bb + mu * bb * np.eye(bb.shape[1])
    rr = rr + mu * np.diag(np.diag(rr))
    inverse, h, schur = reduce_blocks(bb, br, rr)
    half = (inverse @ b[..., None]).ravel()
    x_r = cho_solve(cho_factor(schur, lower=True, overwrite_a=True, check_finite=True), r - h.T @ half)
    x_b = inverse.transpose(0, 2, 1) @ (half - h @ x_r).reshape(b.shape)[..., None]
    return x_b[..., 0], x_r
