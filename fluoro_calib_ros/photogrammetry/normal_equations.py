"""Normal equations of a bundle adjustment and their solution by the Schur complement.

Triggs, McLauchlan, Hartley and Fitzgibbon, "Bundle Adjustment - A Modern Synthesis", 2000, section
6. Object points or exposures are eliminated, whichever leaves the smaller system; exposures that a
relative orientation couples are eliminated together. Interior orientations, relative orientations
and additional parameters, which touch everything, come last.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import blas, cho_factor, cho_solve

from .datum import Gauge, gauge_of, held_directions
from .relative_orientation import discrepancies_with_jacobian

CHUNK = 8_000  # image points linearised at once: what belongs to them stays in the cache
# Of a gross error in a free network, where no survey holds a point that is left with one ray: it
# moves nothing, and the point is found to be undetermined instead of the whole network.
MIN_WEIGHT = 1e-8


@dataclass(frozen=True)
class NormalEquations:
    """Blocks of the normal matrix and of its right side.

    Exposures ee (m, 6, 6), points pp (n, 3, 3) and global unknowns gg (G, G): interior
    orientations (3F), relative orientations, then the additional parameters of each fluoroscope;
    mixed eg (m, 6, G), pg (n, 3, G) and pe (N, 3, 6); right sides e, p and g. coupled: ((k, 2),
    (k, 6, 6)) pairs of exposures and their mixed blocks; gauge: the directions that a free network
    leaves open, None where there are none.
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
    coupled: tuple = ()
    gauge: Gauge | None = None


def _by_component(values, index=None):
    """Components of values (n, ...) as rows (c, N), taken at index (N,)."""
    rows = values.reshape(len(values), -1).T
    return np.ascontiguousarray(rows) if index is None else np.take(rows, index, axis=1)


def _in_sensor(network, parameters, rows):
    """X/Z, Y/Z, 1/Z (N,) of the image points rows (a slice), interior orientation (3, N) and
    rotation (9, N).
    """
    e = network.exposure[rows]
    rotation = _by_component(parameters.rotation, e)
    offset = _by_component(parameters.points_mm, network.point[rows]) - _by_component(
        parameters.position_mm, e
    )
    x, y, z = (
        rotation[3 * i] * offset[0]
        + rotation[3 * i + 1] * offset[1]
        + rotation[3 * i + 2] * offset[2]
        for i in range(3)
    )
    with np.errstate(divide='ignore', invalid='ignore'):
        depth = np.where(z > 0, 1 / z, np.nan)
    return (
        x * depth,
        y * depth,
        depth,
        _by_component(parameters.interior, network.fluoroscope[e]),
        rotation,
    )


def projected(network, parameters):
    """Image points (N, 2) [px] of a network; NaN where a point is behind the source."""
    out = np.empty_like(network.uv)
    for start in range(0, len(out), CHUNK):
        rows = slice(start, start + CHUNK)
        x, y, _, (xp, yp, c), _ = _in_sensor(network, parameters, rows)
        out[rows, 0] = xp + c * x
        out[rows, 1] = yp + c * y
    return out


@dataclass(frozen=True)
class _Linearised:
    """Weighted derivatives of some image points, by component: root (k,) of the weights; u and v
    (10, k): by T in the sensor frame, w, interior orientation and residual; pu and pv (3, k): by
    the object point.
    """

    root: np.ndarray
    u: np.ndarray
    v: np.ndarray
    pu: np.ndarray
    pv: np.ndarray

    def by_image_point(self):
        """Derivatives by exterior orientation, object point and interior orientation, and
        residuals (k, 2, ...).
        """
        a = np.stack([self.u.T, self.v.T], axis=1)
        a_p = np.stack([self.pu.T, self.pv.T], axis=1)
        return np.concatenate([-a_p, a[:, :, 3:6]], axis=2), a_p, a[:, :, 6:9], a[:, :, 9]


def _linearised(network, parameters, correction, noise, image_factor, rows):
    """_Linearised image points rows (a slice).

    With s the derivative of the image point by the point X in the sensor frame, those by P, T and
    w are s R, -s R and -s [X]x. T is turned into the sensor frame here: the same turn for a whole
    exposure is made after the sums.
    """
    x, y, depth, (xp, yp, c), rotation = _in_sensor(network, parameters, rows)
    observed = network.uv[rows] - correction[rows]
    ru = observed[:, 0] - xp - c * x
    rv = observed[:, 1] - yp - c * y
    variance = (noise.scale * network.sigma[rows]) ** 2
    weight = noise.weight((ru * ru + rv * rv) / variance)
    if network.datum == 'inner':
        weight = np.maximum(weight, MIN_WEIGHT)
    root = np.sqrt(image_factor * weight / variance)
    b = c * root
    a = b * depth
    bx = b * x
    by = b * y
    zero = np.zeros_like(b)
    ax = a * x
    ay = a * y
    bxy = bx * y
    u = np.stack([-a, zero, ax, -bxy, b + bx * x, -by, root, zero, root * x, root * ru])
    v = np.stack([zero, -a, ay, -b - by * y, bxy, bx, zero, root, root * y, root * rv])
    return _Linearised(
        root, u, v, a * rotation[0:3] - ax * rotation[6:9], a * rotation[3:6] - ay * rotation[6:9]
    )


def _add_by_point(lin, point, sums, pe):
    """Add to the sums (18, n) by object point, and fill in pe (k, 18), for some image points of
    the points (k,).

    The sums are the nine products with P and the residual - xx, xy, xz, yy, yz, zz, rx, ry, rz -
    and by component of P those with xp, yp and c. A product with T is one with P, its sign
    changed.
    """
    n = sums.shape[1]
    number = 0
    mixed = np.empty((18, len(point)))
    for i in range(3):
        for j in range(i, 3):
            product = lin.pu[i] * lin.pu[j] + lin.pv[i] * lin.pv[j]
            sums[number] += np.bincount(point, product, n)
            number += 1
            np.negative(product, out=mixed[6 * i + j])
            mixed[6 * j + i] = mixed[6 * i + j]
        for j in range(3):
            np.add(lin.pu[i] * lin.u[3 + j], lin.pv[i] * lin.v[3 + j], out=mixed[6 * i + 3 + j])
        sums[6 + i] += np.bincount(point, lin.pu[i] * lin.u[9] + lin.pv[i] * lin.v[9], n)
        sums[9 + 3 * i] += np.bincount(point, lin.pu[i] * lin.u[6], n)
        sums[10 + 3 * i] += np.bincount(point, lin.pv[i] * lin.v[7], n)
        sums[11 + 3 * i] += np.bincount(point, lin.pu[i] * lin.u[8] + lin.pv[i] * lin.v[8], n)
    pe[:] = mixed.T


def _chunks(network):
    """Ranges of exposures, of one fluoroscope each, with about CHUNK image points."""
    starts = np.searchsorted(network.exposure, np.arange(network.shape[1] + 1))
    first = 0
    while first < network.shape[1]:
        others = np.flatnonzero(network.fluoroscope[first:] != network.fluoroscope[first])
        end = first + (others[0] if len(others) else network.shape[1] - first)
        last = max(
            first + 1,
            min(end, int(np.searchsorted(starts, starts[first] + CHUNK, side='right')) - 1),
        )
        yield first, last, starts[first : last + 1]
        first = last


def normal_equations(network, parameters, correction, noise, image_factor=1.0):
    """Normal equations of the weighted linearised problem; image_factor multiplies the image
    weights.
    """
    n_image, m, n, n_fluoro = network.shape
    correction = np.broadcast_to(correction + network.added(parameters), network.uv.shape)
    by_exposure = np.zeros((m, 10, 10))
    by_point = np.zeros((n_fluoro, 18, n))
    pe = np.empty((n_image, 18))
    kept = []
    for first, last, starts in _chunks(network):
        rows = slice(starts[0], starts[-1])
        lin = _linearised(network, parameters, correction, noise, image_factor, rows)
        for e, start, end in zip(range(first, last), starts - starts[0], starts[1:] - starts[0]):
            u = lin.u[:, start:end]
            v = lin.v[:, start:end]
            by_exposure[e] = u @ u.T + v @ v.T
        _add_by_point(lin, network.point[rows], by_point[network.fluoroscope[first]], pe[rows])
        if any(a is not None for a in network.additional):
            kept.append(lin)
    turn = np.tile(np.eye(10), (m, 1, 1))
    turn[:, :3, :3] = parameters.rotation
    by_exposure = turn.transpose(0, 2, 1) @ by_exposure @ turn

    survey = 1 / network.survey_sd_mm**2 if network.datum == 'survey' else np.zeros(n)
    both = by_point[:, :9].sum(axis=0)
    pp = both[[0, 1, 2, 1, 3, 4, 2, 4, 5]].T.reshape(n, 3, 3) + survey[:, None, None] * np.eye(3)
    p = both[6:].T + survey[:, None] * (network.survey_mm - parameters.points_mm)
    ee = by_exposure[:, :6, :6]
    e = by_exposure[:, :6, 9]
    gg, eg, pg, g = _global_blocks(network, parameters, by_exposure, by_point)
    coupled = _add_relative(network, parameters, (ee, eg, gg, e, g))
    if kept:
        root = np.concatenate([lin.root for lin in kept])
        weighted = [
            np.concatenate(parts) for parts in zip(*(lin.by_image_point() for lin in kept))
        ]
        _add_additional(network, parameters, root, weighted, (gg, eg, pg, g))
    return NormalEquations(
        ee, pp, gg, eg, pg, pe.reshape(-1, 3, 6), e, p, g, coupled, gauge_of(network, parameters)
    )


def _global_blocks(network, parameters, by_exposure, by_point):
    """Blocks gg, eg, pg and right side g with the interior orientations filled in, from the sums
    by exposure (m, 10, 10) and by fluoroscope and point (F, 18, n).
    """
    _, m, n, n_fluoro = network.shape
    size = len(network.global_free)
    gg = np.zeros((size, size))
    g = np.zeros(size)
    eg = np.zeros((m, 6, size))
    pg = np.zeros((n, 3, size))
    for f in range(n_fluoro):
        cols = slice(3 * f, 3 * f + 3)
        mine = network.fluoroscope == f
        gg[cols, cols] = by_exposure[mine, 6:9, 6:9].sum(axis=0)
        g[cols] = by_exposure[mine, 6:9, 9].sum(axis=0)
        eg[mine, :, cols] = by_exposure[mine, :6, 6:9]
        pg[:, :, cols] = by_point[f, 9:].T.reshape(n, 3, 3)
    if network.interior_sd is not None:
        diagonal = np.arange(3 * n_fluoro)
        weight = network.interior_weight
        gg[diagonal, diagonal] += weight.ravel()
        g[diagonal] += (weight * (network.interior_mean - parameters.interior)).ravel()
    return gg, eg, pg, g


def _add_relative(network, parameters, blocks):
    """Add the relative orientation constraints to ee, eg, gg, e and g; returns pairs (k, 2) and
    mixed blocks (k, 6, 6).
    """
    ee, eg, gg, e, g = blocks
    pairs = [np.zeros((0, 2), dtype=int)]
    mixed = [np.zeros((0, 6, 6))]
    for constraint, pose, cols in zip(
        network.relative, parameters.relative, network.relative_columns
    ):
        off, d_a, d_b, d_pose = discrepancies_with_jacobian(constraint, pose, parameters)
        (a, b) = constraint.pairs.T
        w = constraint.weights[:, None]
        for rows, d in ((a, d_a), (b, d_b)):
            back = d.transpose(0, 2, 1)
            ee[rows] += back @ (w * d)
            eg[rows, :, cols] += back @ (w * d_pose)
            e[rows] -= (back @ (w * off[:, :, None]))[..., 0]
        gg[cols, cols] += np.einsum('kia,i,kib->ab', d_pose, w[:, 0], d_pose)
        g[cols] -= np.einsum('kia,i,ki->a', d_pose, w[:, 0], off)
        pairs.append(constraint.pairs)
        mixed.append(d_a.transpose(0, 2, 1) @ (w * d_b))
    return np.concatenate(pairs), np.concatenate(mixed)


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
        gg[3 * f : 3 * f + 3, cols] = mixed
        gg[cols, 3 * f : 3 * f + 3] = mixed.T
        gg[cols, cols] = additional.gram(root[rows] ** 2) + additional.prior
        g[cols] = (
            additional.transposed(w[:, 0] * r[rows]) - additional.prior @ parameters.additional[f]
        )


def eliminates_points(network):
    """Whether the object points are eliminated (else the exposures): what leaves the smaller
    system.
    """
    _, m, n, _ = network.shape
    return 6 * m < 3 * n


def bordered_blocks(network, equations):
    """The normal equations as a block-diagonal part and the rest.

    Returns bb (k, b, b), br (k, b, q), rr (q, q), right sides (k, b) and (q,). The rest ends with
    the global unknowns, of which only the free ones are kept. The directions that a free network
    leaves open are held in the rest.
    """
    _, m, n, _ = network.shape
    free = network.global_free
    if eliminates_points(network):
        br = np.zeros((n, 3, 6 * m + int(free.sum())))
        br[:, :, : 6 * m].reshape(n, 3, m, 6)[network.point, :, network.exposure, :] = equations.pe
        br[:, :, 6 * m :] = equations.pg[:, :, free]
        bb = equations.pp
        b = equations.p
        rest = equations.ee
        rest_g = equations.eg
        r = equations.e
    else:
        bb, br, b = _by_cell(network, equations)
        rest = equations.pp
        rest_g = equations.pg
        r = equations.p
    count, size = rest.shape[:2]
    rr = np.zeros((br.shape[2], br.shape[2]))
    diagonal = np.arange(count * size).reshape(count, size)
    rr[diagonal[:, :, None], diagonal[:, None, :]] = rest
    rr[: count * size, count * size :] = rest_g.reshape(count * size, -1)[:, free]
    rr[count * size :, : count * size] = rr[: count * size, count * size :].T
    rr[count * size :, count * size :] = equations.gg[np.ix_(free, free)]
    if eliminates_points(network) and len(network.relative):
        (one, other) = equations.coupled[0].T
        mixed = equations.coupled[1]
        rr[diagonal[one][:, :, None], diagonal[other][:, None, :]] = mixed
        rr[diagonal[other][:, :, None], diagonal[one][:, None, :]] = mixed.transpose(0, 2, 1)
    if equations.gauge is not None:
        gauge = equations.gauge
        part = slice(0, count * size)
        held = held_directions(
            (gauge.e if eliminates_points(network) else gauge.p).reshape(count * size, -1),
            np.diagonal(rr)[part],
        )
        rr[part, part] += held @ held.T
    return bb, br, rr, b, np.concatenate([r.ravel(), equations.g[free]])


def _by_cell(network, equations):
    """Bb (k, b, b), br (k, b, q) and right side (k, b) of the exposures, those that are coupled
    side by side.

    A place that no exposure takes has a one in the diagonal and zeros elsewhere.
    """
    _, m, n, _ = network.shape
    free = network.global_free
    cell, place, places = network.cells
    count = int(cell.max()) + 1
    br = np.zeros((count, places, 6, 3 * n + int(free.sum())))
    br[..., : 3 * n].reshape(count, places, 6, n, 3)[
        cell[network.exposure], place[network.exposure], :, network.point, :
    ] = equations.pe.transpose(0, 2, 1)
    br[cell, place, :, 3 * n :] = equations.eg[:, :, free]
    bb = np.zeros((count, places, 6, places, 6))
    b = np.zeros((count, places, 6))
    diagonal = np.einsum('kiaia->kia', bb)  # a view
    diagonal[...] = 1
    bb[cell, place, :, place, :] = equations.ee
    b[cell, place] = equations.e
    if len(network.relative):
        (one, other) = equations.coupled[0].T
        mixed = equations.coupled[1]
        bb[cell[one], place[one], :, place[other], :] = mixed
        bb[cell[one], place[other], :, place[one], :] = mixed.transpose(0, 2, 1)
    width = 6 * places
    return bb.reshape(count, width, width), br.reshape(count, width, -1), b.reshape(count, width)


def reduce_blocks(bb, br, rr, overwrite=False):
    """Inverse Cholesky factors (k, b, b) of bb, H = L^-1 br as (k b, q), and the Schur complement
    (q, q).

    Only the lower triangle of the Schur complement is set. Raises numpy.linalg.LinAlgError where
    bb is not positive definite.
    """
    inverse = np.linalg.inv(np.linalg.cholesky(bb))
    h = (inverse @ br).reshape(-1, br.shape[2])
    # In BLAS's order of storage h is its transpose: half the operations of a full product, and no
    # copy.
    schur = blas.dsyrk(-1.0, h.T, beta=1.0, c=rr.T, trans=0, lower=1, overwrite_c=overwrite)
    return inverse, h, schur


def damped_step(blocks, mu):
    """Solution of (H + mu diag H) x = b for the bordered blocks: x_b (k, b) and x_r (q,).

    Raises numpy.linalg.LinAlgError where the damped matrix is not positive definite.
    """
    bb, br, rr, b, r = blocks
    bb = bb + mu * bb * np.eye(bb.shape[1])
    rr = rr.copy()
    rr.ravel()[:: len(rr) + 1] *= 1 + mu
    inverse, h, schur = reduce_blocks(bb, br, rr, overwrite=True)
    half = (inverse @ b[..., None]).ravel()
    x_r = cho_solve(
        cho_factor(schur, lower=True, overwrite_a=True, check_finite=True), r - h.T @ half
    )
    x_b = inverse.transpose(0, 2, 1) @ (half - h @ x_r).reshape(b.shape)[..., None]
    return x_b[..., 0], x_r
