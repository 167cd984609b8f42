# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Normal equations of a bundle adjustment.

Triggs, McLauchlan, Hartley and Fitzgibbon, "Bundle Adjustment - A Modern Synthesis", 2000, section
6. They are built in blocks by exposure, object point and global unknowns, from chunks of image
points that stay in the cache; `elimination` solves them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .network import Gauge, Network, open_gauge
from .noise import Noise
from .unknowns import (
    POSE_SIZE,
    Parameters,
    UnknownVector,
    discrepancies_with_jacobian,
)

# Image points that are linearised at once, so that their arrays stay in the cache.
CHUNK = 8_000
# Least weight of a gross error. It keeps the variance finite. In a free network, where no survey
# determines a point with a single remaining ray, it affects nothing else: only that point, not the
# whole network, is found to be undetermined.
MIN_WEIGHT = 1e-8


@dataclass(frozen=True)
class NormalEquations:
    """Blocks of the normal matrix, and its right side.

    e stands for exposures, p for object points and g for the global unknowns (see unknowns).
    """

    ee: NDArray[np.float64]  #: (m, 6, 6) diagonal blocks: exposures
    pp: NDArray[np.float64]  #: (n, 3, 3) object points
    gg: NDArray[np.float64]  #: (G, G) global unknowns
    eg: NDArray[np.float64]  #: (m, 6, G) mixed blocks with the global unknowns
    pg: NDArray[np.float64]  #: (n, 3, G)
    #: (N, 3, 6) mixed block of object point and exposure of each image point
    pe: NDArray[np.float64]
    right: UnknownVector
    coupled_pairs: NDArray[np.int64]  #: (k, 2) exposures coupled by a relative orientation
    coupled: NDArray[np.float64]  #: (k, 6, 6) their mixed blocks
    gauge: Gauge | None = None  #: directions that a free network leaves open


def _by_component(
    values: NDArray[np.float64], index: NDArray[np.int64] | None = None
) -> NDArray[np.float64]:
    """Return components of values (n, ...) as rows (c, n), or (c, N) at index (N,)."""
    rows = values.reshape(len(values), -1).T
    return np.ascontiguousarray(rows) if index is None else np.take(rows, index, axis=1)


@dataclass(frozen=True)
class _SensorPoints:
    """Object points of k image points in the sensor frame, by component.

    x and y (k,) are X/Z and Y/Z; inverse_depth (k,) is 1/Z [1/mm], NaN for a point that is not in
    front of the source; interior (3, k) and rotation (9, k) belong to the image points.
    """

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    inverse_depth: NDArray[np.float64]
    interior: NDArray[np.float64]
    rotation: NDArray[np.float64]


def _to_sensor(network: Network, parameters: Parameters, rows: slice) -> _SensorPoints:
    """Return the object points of the image points `rows` in the sensor frame."""
    exposure = network.exposure[rows]
    rotation = _by_component(parameters.rotation, exposure)
    offset = _by_component(parameters.points_mm, network.point[rows]) - _by_component(
        parameters.position_mm, exposure
    )
    x, y, z = (
        rotation[3 * i] * offset[0]
        + rotation[3 * i + 1] * offset[1]
        + rotation[3 * i + 2] * offset[2]
        for i in range(3)
    )
    with np.errstate(divide='ignore', invalid='ignore'):
        inverse_depth = np.where(z > 0, 1 / z, np.nan)
    interior = _by_component(parameters.interior, network.fluoroscope[exposure])
    return _SensorPoints(x * inverse_depth, y * inverse_depth, inverse_depth, interior, rotation)


def project_network(network: Network, parameters: Parameters) -> NDArray[np.float64]:
    """Return image points (N, 2) [px] of a network; NaN if a point is behind the source."""
    out = np.empty_like(network.uv)
    for start in range(0, len(out), CHUNK):
        rows = slice(start, start + CHUNK)
        sensor = _to_sensor(network, parameters, rows)
        xp, yp, c = sensor.interior
        out[rows, 0] = xp + c * sensor.x
        out[rows, 1] = yp + c * sensor.y
    return out


@dataclass(frozen=True)
class _Linearised:
    """Weighted derivatives of k image points, by component."""

    root: NDArray[np.float64]  #: (k,) square roots of the weights
    #: (10, k) derivatives of u and v by T in the sensor frame (3), w (3) and the interior
    #: orientation (3), and the residual
    u: NDArray[np.float64]
    v: NDArray[np.float64]
    #: (3, k) derivatives of u and v by the object point
    pu: NDArray[np.float64]
    pv: NDArray[np.float64]

    def by_image_point(
        self,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return arrays (k, 2, ...) by image point.

        Derivatives by exterior orientation, object point, interior orientation; and residuals.
        """
        a = np.stack([self.u.T, self.v.T], axis=1)
        a_p = np.stack([self.pu.T, self.pv.T], axis=1)
        return np.concatenate([-a_p, a[:, :, 3:6]], axis=2), a_p, a[:, :, 6:9], a[:, :, 9]


@dataclass(frozen=True)
class _Linearisation:
    """The weighted problem; correction (N, 2) [px]: by models and additional parameters."""

    network: Network
    parameters: Parameters
    correction: NDArray[np.float64]
    noise: Noise
    image_factor: float

    def at(self, rows: slice) -> _Linearised:
        """Return the derivatives of the image points `rows`.

        Let s be the derivative of the image point by the point X in the sensor frame. The
        derivatives by P, T and w are s R, -s R and -s [X]x. T is rotated into the sensor frame
        here; rotating it back is the same for a whole exposure, and is done after summation.
        """
        network = self.network
        sensor = _to_sensor(network, self.parameters, rows)
        x = sensor.x
        y = sensor.y
        rotation = sensor.rotation
        xp, yp, c = sensor.interior
        observed = network.uv[rows] - self.correction[rows]
        ru = observed[:, 0] - xp - c * x
        rv = observed[:, 1] - yp - c * y
        variance = (self.noise.scale * network.sigma[rows]) ** 2
        weight = self.noise.weight((ru * ru + rv * rv) / variance)
        if network.datum == 'inner':
            weight = np.maximum(weight, MIN_WEIGHT)
        root = np.sqrt(self.image_factor * weight / variance)
        b = c * root
        a = b * sensor.inverse_depth
        bx = b * x
        by = b * y
        zero = np.zeros_like(b)
        ax = a * x
        ay = a * y
        bxy = bx * y
        u = np.stack([-a, zero, ax, -bxy, b + bx * x, -by, root, zero, root * x, root * ru])
        v = np.stack([zero, -a, ay, -b - by * y, bxy, bx, zero, root, root * y, root * rv])
        return _Linearised(
            root,
            u,
            v,
            a * rotation[0:3] - ax * rotation[6:9],
            a * rotation[3:6] - ay * rotation[6:9],
        )


def _add_by_point(
    lin: _Linearised, point: NDArray[np.int64], sums: NDArray[np.float64], pe: NDArray[np.float64]
) -> None:
    """Add products of k image points to the sums by object point, and fill in pe (k, 18).

    point (k,): their object points. sums (18, n): the products with P and the residual - xx, xy,
    xz, yy, yz, zz, rx, ry, rz - and, by component of P, those with xp, yp and c. A product with T
    is the negative product with P.
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


def _chunks(network: Network) -> Iterator[tuple[int, int, NDArray[np.int64]]]:
    """Yield ranges of exposures of one fluoroscope with about CHUNK image points.

    Each has the first exposure, the exposure after the last, and the rows (k + 1,) at which the
    image points of the k exposures start and end.
    """
    m = network.n_exposures
    starts = np.searchsorted(network.exposure, np.arange(m + 1))
    first = 0
    while first < m:
        boundaries = np.flatnonzero(network.fluoroscope[first:] != network.fluoroscope[first])
        end = first + (boundaries[0] if len(boundaries) else m - first)
        chunk_end = int(np.searchsorted(starts, starts[first] + CHUNK, side='right')) - 1
        stop = max(first + 1, min(end, chunk_end))
        yield first, stop, starts[first : stop + 1]
        first = stop


@dataclass(frozen=True)
class _ImageSums:
    """Products of the linearised image points.

    by_exposure (m, 10, 10) with the rows of _Linearised.u; by_point (F, 18, n) of _add_by_point;
    pe (N, 3, 6); linearised: the chunks, if additional parameters need them.
    """

    by_exposure: NDArray[np.float64]
    by_point: NDArray[np.float64]
    pe: NDArray[np.float64]
    linearised: list[_Linearised]


def _image_sums(problem: _Linearisation) -> _ImageSums:
    """Sum the products of the image points by exposure and by object point."""
    network = problem.network
    by_exposure = np.zeros((network.n_exposures, 10, 10))
    by_point = np.zeros((network.n_fluoroscopes, 18, network.n_points))
    pe = np.empty((network.n_image_points, 18))
    has_additional = any(a is not None for a in network.additional)
    linearised = []
    for first, stop, starts in _chunks(network):
        rows = slice(starts[0], starts[-1])
        lin = problem.at(rows)
        local = starts - starts[0]
        for e, start, end in zip(range(first, stop), local, local[1:]):
            u = lin.u[:, start:end]
            v = lin.v[:, start:end]
            by_exposure[e] = u @ u.T + v @ v.T
        _add_by_point(lin, network.point[rows], by_point[network.fluoroscope[first]], pe[rows])
        if has_additional:
            linearised.append(lin)
    turn = np.tile(np.eye(10), (network.n_exposures, 1, 1))
    turn[:, :3, :3] = problem.parameters.rotation
    by_exposure = turn.transpose(0, 2, 1) @ by_exposure @ turn
    return _ImageSums(by_exposure, by_point, pe.reshape(-1, 3, 6), linearised)


def normal_equations(
    network: Network,
    parameters: Parameters,
    correction: NDArray[np.float64] | float,
    noise: Noise,
    image_factor: float = 1.0,
) -> NormalEquations:
    """Return the normal equations of the weighted linearised problem.

    Parameters
    ----------
    network : Network
    parameters : Parameters
        Values at which the problem is linearised.
    correction : (N, 2) ndarray or float
        Correction of the image points [px], excluding the additional parameters.
    noise : Noise
        Noise model; its weights are those at the residuals.
    image_factor : float
        Factor of all image weights, see Noise.information_factor.
    """
    correction = correction + network.additional_correction(parameters)
    correction = np.broadcast_to(correction, network.uv.shape)
    sums = _image_sums(_Linearisation(network, parameters, correction, noise, image_factor))
    pp, p = _point_blocks(network, parameters, sums)
    ee = sums.by_exposure[:, :6, :6]
    e = sums.by_exposure[:, :6, 9]
    blocks = _GlobalBlocks.zeros(network)
    blocks.add_interiors(parameters, sums)
    coupled_pairs, coupled = _add_relative(parameters, ee, e, blocks)
    if network.exterior is not None:
        diagonal = np.arange(POSE_SIZE)
        ee[:, diagonal, diagonal] += network.exterior.weights
        e += _exterior_pull(network, parameters)
    if sums.linearised:
        _add_additional(parameters, sums.linearised, blocks)
    return NormalEquations(
        ee=ee,
        pp=pp,
        gg=blocks.gg,
        eg=blocks.eg,
        pg=blocks.pg,
        pe=sums.pe,
        right=UnknownVector(e, p, blocks.g),
        coupled_pairs=coupled_pairs,
        coupled=coupled,
        gauge=open_gauge(network, parameters),
    )


def right_sides(
    network: Network, parameters: Parameters, correction: NDArray[np.float64] | float, noise: Noise
) -> UnknownVector:
    """Return the right sides of `normal_equations`, for a network without relative orientations.

    With additional parameters, this takes a small part of the time.
    """
    correction = correction + network.additional_correction(parameters)
    correction = np.broadcast_to(correction, network.uv.shape)
    problem = _Linearisation(network, parameters, correction, noise, 1.0)
    by_exposure = np.zeros((network.n_exposures, 9))
    points = np.zeros((3, network.n_points))
    weighted = np.empty_like(network.uv)  # residuals times weights
    for first, stop, starts in _chunks(network):
        rows = slice(starts[0], starts[-1])
        lin = problem.at(rows)
        local = starts - starts[0]
        for e, start, end in zip(range(first, stop), local, local[1:]):
            part = slice(start, end)
            by_exposure[e] = lin.u[:9, part] @ lin.u[9, part] + lin.v[:9, part] @ lin.v[9, part]
        for i in range(3):
            products = lin.pu[i] * lin.u[9] + lin.pv[i] * lin.v[9]
            points[i] += np.bincount(network.point[rows], products, network.n_points)
        weighted[rows] = (lin.root * np.stack([lin.u[9], lin.v[9]])).T
    exteriors = by_exposure[:, :6]
    exteriors[:, :3] = (exteriors[:, None, :3] @ parameters.rotation)[:, 0]
    if network.exterior is not None:
        exteriors += _exterior_pull(network, parameters)
    layout = network.layout
    global_right = np.zeros(layout.n_globals)
    for f, columns in enumerate(layout.interiors):
        global_right[columns] = by_exposure[network.fluoroscope == f, 6:].sum(axis=0)
    if network.interior_sd is not None:
        global_right[layout.all_interiors] += _interior_pull(network, parameters)
    for f, (additional, columns) in enumerate(zip(network.additional, layout.additional)):
        if additional is not None:
            pull = additional.pull(parameters.additional_of(f))
            global_right[columns] = additional.right_side(weighted[network.rows(f)]) - pull
    return UnknownVector(exteriors, points.T + _survey_pull(network, parameters), global_right)


def _survey_weight(network: Network) -> NDArray[np.float64]:
    """Return the weights (n, 1) of the surveyed coordinates; zeros in a free network."""
    if network.datum != 'survey':
        return np.zeros((network.n_points, 1))
    return 1 / network.survey_sd_mm[:, None] ** 2


def _survey_pull(network: Network, parameters: Parameters) -> NDArray[np.float64]:
    """Return the contribution (n, 3) of the survey to the right side."""
    return _survey_weight(network) * (network.survey_mm - parameters.points_mm)


def _exterior_pull(network: Network, parameters: Parameters) -> NDArray[np.float64]:
    """Return the contribution (m, 6) of known exterior orientations to the right side."""
    assert network.exterior is not None
    discrepancies = network.exterior.discrepancies(parameters.rotation, parameters.position_mm)
    return -network.exterior.weights * discrepancies


def _interior_pull(network: Network, parameters: Parameters) -> NDArray[np.float64]:
    """Return the contribution (3 F,) of the prior of interior orientations to the right side."""
    assert network.interior_mean is not None
    return (network.interior_weight * (network.interior_mean - parameters.interior)).ravel()


def _point_blocks(
    network: Network, parameters: Parameters, sums: _ImageSums
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return blocks pp (n, 3, 3) and right side p (n, 3), including the survey."""
    products = sums.by_point[:, :9].sum(axis=0)
    symmetric = products[[0, 1, 2, 1, 3, 4, 2, 4, 5]].T.reshape(-1, 3, 3)
    pp = symmetric + _survey_weight(network)[:, :, None] * np.eye(3)
    return pp, products[6:].T + _survey_pull(network, parameters)


@dataclass(frozen=True)
class _GlobalBlocks:
    """Blocks with the global unknowns, as in NormalEquations, while they are filled in."""

    network: Network
    gg: NDArray[np.float64]
    eg: NDArray[np.float64]
    pg: NDArray[np.float64]
    g: NDArray[np.float64]

    @classmethod
    def zeros(cls, network: Network) -> _GlobalBlocks:
        """Return blocks of zeros."""
        size = network.layout.n_globals
        return cls(
            network,
            np.zeros((size, size)),
            np.zeros((network.n_exposures, POSE_SIZE, size)),
            np.zeros((network.n_points, 3, size)),
            np.zeros(size),
        )

    def add_interiors(self, parameters: Parameters, sums: _ImageSums) -> None:
        """Fill in the interior orientations and their prior."""
        network = self.network
        for f, columns in enumerate(network.layout.interiors):
            rows = network.fluoroscope == f
            self.gg[columns, columns] = sums.by_exposure[rows, 6:9, 6:9].sum(axis=0)
            self.g[columns] = sums.by_exposure[rows, 6:9, 9].sum(axis=0)
            self.eg[rows, :, columns] = sums.by_exposure[rows, :6, 6:9]
            by_point = sums.by_point[f, 9:]
            self.pg[:, :, columns] = by_point.T.reshape(network.n_points, 3, 3)
        if network.interior_sd is not None:
            columns = network.layout.all_interiors
            diagonal = np.einsum('ii->i', self.gg[columns, columns])  # a view
            diagonal += network.interior_weight.ravel()
            self.g[columns] += _interior_pull(network, parameters)


def _add_relative(
    parameters: Parameters, ee: NDArray[np.float64], e: NDArray[np.float64], blocks: _GlobalBlocks
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Add the relative orientation constraints to ee, e and the global blocks.

    Returns the coupled pairs (k, 2) of exposures and their mixed blocks (k, 6, 6).
    """
    network = blocks.network
    pairs = [np.zeros((0, 2), dtype=int)]
    coupled = [np.zeros((0, POSE_SIZE, POSE_SIZE))]
    for constraint, pose, columns in zip(
        network.relative, parameters.relative, network.layout.relative
    ):
        offset, d_a, d_b, d_pose = discrepancies_with_jacobian(constraint, pose, parameters)
        a, b = constraint.pairs.T
        w = constraint.weights[:, None]
        for rows, derivative in ((a, d_a), (b, d_b)):
            transposed = derivative.transpose(0, 2, 1)
            ee[rows] += transposed @ (w * derivative)
            blocks.eg[rows, :, columns] += transposed @ (w * d_pose)
            e[rows] -= (transposed @ (w * offset[:, :, None]))[..., 0]
        blocks.gg[columns, columns] += np.einsum('kia,i,kib->ab', d_pose, w[:, 0], d_pose)
        blocks.g[columns] -= np.einsum('kia,i,ki->a', d_pose, w[:, 0], offset)
        pairs.append(constraint.pairs)
        coupled.append(d_a.transpose(0, 2, 1) @ (w * d_b))
    return np.concatenate(pairs), np.concatenate(coupled)


def _add_additional(
    parameters: Parameters, linearised: list[_Linearised], blocks: _GlobalBlocks
) -> None:
    """Fill in the rows and columns of the additional parameters."""
    network = blocks.network
    root = np.concatenate([lin.root for lin in linearised])
    parts = [lin.by_image_point() for lin in linearised]
    a_e, a_p, a_i, r = (np.concatenate(arrays) for arrays in zip(*parts))
    layout = network.layout
    for f, (additional, columns) in enumerate(zip(network.additional, layout.additional)):
        if additional is None:
            continue
        rows = network.rows(f)
        w = root[rows, None, None]
        exposure = network.exposure[rows]
        blocks.eg[:, :, columns] = additional.grouped_products(
            exposure, network.n_exposures, w * a_e[rows]
        )
        blocks.pg[:, :, columns] = additional.grouped_products(
            network.point[rows], network.n_points, w * a_p[rows]
        )
        mixed = additional.grouped_products(np.zeros_like(exposure), 1, w * a_i[rows])[0]
        interior = layout.interiors[f]
        blocks.gg[interior, columns] = mixed
        blocks.gg[columns, interior] = mixed.T
        blocks.gg[columns, columns] = (
            additional.normal_matrix(root[rows] ** 2) + additional.precision
        )
        pull = additional.pull(parameters.additional_of(f))
        blocks.g[columns] = additional.right_side(w[:, 0] * r[rows]) - pull
