# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Precision of an adjustment: covariances of unknowns and residuals, and redundancy numbers.

C_r = C_l - A C_x A^T (Foerstner and Wrobel, "Photogrammetric Computer Vision", Springer 2016,
4.2), where C_l is the covariance of the image points divided by their robust weights.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .adjustment import Adjustment
from .collinearity import AdditionalParameters, project_with_jacobian
from .elimination import CovarianceBlocks, FactorizedNormalMatrix, factorize
from .network import Gauge, Network, STransformation
from .noise import Noise
from .normal_equations import CHUNK, MIN_WEIGHT, NormalEquations, normal_equations, right_sides
from .unknowns import POSE_SIZE, Parameters, UnknownVector, discrepancies_with_jacobian

# Largest number of object points whose joint covariance is stored. The more there are, the less it
# matters: their common part is the datum.
MAX_JOINT_POINTS = 150


@dataclass(frozen=True)
class Precision:
    """Covariances and redundancy numbers of an adjustment.

    The redundancy numbers sum to the number of observations less the number of unknowns, unless a
    prior adds to them.
    """

    #: (F, 3, 3) of the interior orientations [px^2]; zeros if fixed
    interior: NDArray[np.float64]
    exterior: NDArray[np.float64]  #: (m, 6, 6) of T [mm] and w [rad] of the exposures
    points: NDArray[np.float64]  #: (n, 3, 3) of the object points [mm^2]
    residual: NDArray[np.float64]  #: (N, 2, 2) of the residuals [px^2]
    redundancy: NDArray[np.float64]  #: (N, 2) redundancy numbers of the image coordinates
    #: (n, 3) redundancy numbers of the surveyed coordinates
    survey_redundancy: NDArray[np.float64]
    #: (p, p) of the additional parameters of each fluoroscope
    additional: tuple[NDArray[np.float64] | None, ...]
    #: (6, 6) of translation [mm] and rotation [rad] of each constrained relative orientation
    relative: tuple[NDArray[np.float64], ...]
    #: (k, 6) redundancy numbers of the pairs of each relative orientation constraint
    relative_redundancy: tuple[NDArray[np.float64], ...]
    all_global: NDArray[np.float64]  #: (G, G) of all global unknowns
    exterior_global: NDArray[np.float64]  #: (m, 6, G) of the exposures with the global unknowns
    #: (3n, 3n) of all object points [mm^2]; None if there are too many
    joint_points: NDArray[np.float64] | None = None


def covariance_blocks(matrix: FactorizedNormalMatrix) -> CovarianceBlocks:
    """Return blocks of the inverse of a normal matrix; for a free network, in its datum."""
    blocks = matrix.elimination.covariance_blocks(matrix.factor.covariance())
    return blocks if matrix.gauge is None else _in_datum(matrix, matrix.gauge, blocks)


def _in_datum(
    matrix: FactorizedNormalMatrix, gauge: Gauge, blocks: CovarianceBlocks
) -> CovarianceBlocks:
    """Transform covariances with other directions fixed into the datum of a free network."""
    s = STransformation(gauge, covariance_times_points(matrix, gauge.constraint))

    def exteriors(index: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return s.exteriors[0][index], s.exteriors[1][index]

    def points(index: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return s.points[0][index], s.points[1][index]

    free = matrix.network.layout.free
    return CovarianceBlocks(
        ee=s.transform(blocks.ee, s.exteriors, s.exteriors),
        pp=s.transform(blocks.pp, s.points, s.points),
        gg=s.transform(blocks.gg, s.globals, s.globals) * np.outer(free, free),
        eg=s.transform(blocks.eg, s.exteriors, s.globals) * free,
        pg=s.transform(blocks.pg, s.points, s.globals) * free,
        pe=lambda e, p: s.transform(blocks.pe(e, p), points(p), exteriors(e)),
        between=lambda e, f: s.transform(blocks.between(e, f), exteriors(e), exteriors(f)),
        points_between=lambda p, q: s.transform(blocks.points_between(p, q), points(p), points(q)),
    )


def covariance_times_points(
    matrix: FactorizedNormalMatrix, values: NDArray[np.float64]
) -> UnknownVector:
    """Multiply the inverse normal matrix by columns of values (n, 3, d) of the points.

    For a free network, the inverse is the one with other directions fixed than in its datum.
    """
    layout = matrix.network.layout
    columns = values.shape[2]
    exteriors = np.zeros((layout.n_exposures, POSE_SIZE, columns))
    return matrix.solve(UnknownVector(exteriors, values, np.zeros((layout.n_globals, columns))))


def information_of_additional(matrix: FactorizedNormalMatrix, f: int) -> NDArray[np.float64]:
    """Return information (p, p) of the additional parameters of fluoroscope f, with the prior.

    All other unknowns are eliminated. The last rows of a Cholesky factor are the factor of the
    Schur complement.
    """
    layout = matrix.network.layout
    additional = layout.all_additional
    size = additional.stop - additional.start  # all of them are free
    last = slice(len(matrix.factor.schur) - size, None)
    factor = np.tril(matrix.factor.schur[last, last])
    information = factor @ factor.T
    columns = layout.additional[f]
    selected = np.arange(columns.start, columns.stop) - additional.start
    eliminated = np.setdiff1d(np.arange(size), selected)
    out = information[np.ix_(selected, selected)]
    if len(eliminated):
        mixed = information[np.ix_(eliminated, selected)]
        out = out - mixed.T @ np.linalg.solve(information[np.ix_(eliminated, eliminated)], mixed)
    return out


def solved_additional(
    matrix: FactorizedNormalMatrix, network: Network, adjustment: Adjustment
) -> tuple[NDArray[np.float64], ...]:
    """Return coefficients (p,) of the additional parameters at the solution, by fluoroscope.

    An adjustment ends when F hardly decreases any more. A coefficient with a small prior variance
    may then still be off by many times the pull of the observations, and its prior times its value
    says little about that pull. One step with the normal matrix leads to the solution.

    network: has additional parameters, and only these correct its image points; matrix: its normal
    matrix near the solution.
    """
    parameters = adjustment.parameters
    if network.relative:
        right = normal_equations(network, parameters, 0.0, adjustment.noise).right
    else:
        right = right_sides(network, parameters, 0.0, adjustment.noise)
    step = matrix.solve(right).globals
    return tuple(
        coefficients + step[columns]
        for coefficients, columns in zip(parameters.additional, network.layout.additional)
        if coefficients is not None
    )


def covariance_of_projection(
    network: Network, parameters: Parameters, blocks: CovarianceBlocks
) -> NDArray[np.float64]:
    """Return A C_x A^T (N, 2, 2) [px^2] of the image points, including additional parameters."""
    out = np.empty((network.n_image_points, 2, 2))
    for f, local, a in _design(network, parameters):
        part = network.rows(f)[local]
        covariance = _covariance_of_orientation(network, blocks, f, part)
        out[part] = a @ covariance @ a.transpose(0, 2, 1)
        additional = network.additional[f] if network.additional else None
        if additional is not None:
            columns = network.layout.additional[f]
            mixed = a @ _mixed_covariance(network, additional, blocks, f, local)
            out[part] += additional.correction_covariance(blocks.gg[columns, columns], local)
            out[part] += mixed + mixed.transpose(0, 2, 1)
    return out


def _design(
    network: Network, parameters: Parameters
) -> Iterator[tuple[int, slice, NDArray[np.float64]]]:
    """Yield derivatives (k, 2, 12) by exterior orientation, object point, interior orientation.

    Yields fluoroscope f, a range of its image points, and their derivatives.
    """
    per_image_point = network.per_image_point(parameters)
    for f in range(network.n_fluoroscopes):
        rows = network.rows(f)
        for start in range(0, len(rows), CHUNK):
            local = slice(start, start + CHUNK)
            part = rows[local]
            _, d_e, d_p, d_i = project_with_jacobian(*(a[part] for a in per_image_point))
            yield f, local, np.concatenate([d_e, d_p, d_i], axis=2)


def _covariance_of_orientation(
    network: Network, blocks: CovarianceBlocks, f: int, rows: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return covariances (k, 12, 12) of exterior orientation, object point, interior orientation.

    rows (k,): of image points of fluoroscope f.
    """
    e = network.exposure[rows]
    p = network.point[rows]
    columns = network.layout.interiors[f]
    c = np.empty((len(e), 12, 12))
    c[:, :6, :6] = blocks.ee[e]
    c[:, 6:9, 6:9] = blocks.pp[p]
    c[:, 9:, 9:] = blocks.gg[columns, columns]
    c[:, 6:9, :6] = blocks.pe(e, p)
    c[:, :6, 9:] = blocks.eg[:, :, columns][e]
    c[:, 6:9, 9:] = blocks.pg[:, :, columns][p]
    c[:, :6, 6:9] = c[:, 6:9, :6].transpose(0, 2, 1)
    c[:, 9:, :9] = c[:, :9, 9:].transpose(0, 2, 1)
    return c


def _mixed_covariance(
    network: Network,
    additional: AdditionalParameters,
    blocks: CovarianceBlocks,
    f: int,
    local: slice,
) -> NDArray[np.float64]:
    """Return covariances (k, 12, 2) of orientations with corrections by additional parameters.

    local: rows among the image points of fluoroscope f, whose parameters are `additional`.
    """
    part = network.rows(f)[local]
    e = network.exposure[part]
    p = network.point[part]
    columns = network.layout.additional[f]
    interior_covariance = blocks.gg[None, network.layout.interiors[f], columns]
    return np.concatenate(
        [
            additional.cross_covariance(blocks.eg[:, :, columns], e, local),
            additional.cross_covariance(blocks.pg[:, :, columns], p, local),
            additional.cross_covariance(interior_covariance, np.zeros_like(e), local),
        ],
        axis=1,
    )


def precision(
    network: Network,
    adjustment: Adjustment,
    correction: NDArray[np.float64] | float = 0.0,
) -> Precision:
    """Return covariances and redundancy numbers of an adjustment.

    Covariances of the unknowns are based on the noise distribution (Fisher information). Those of
    the residuals and the redundancy numbers belong to the weighted least-squares problem at the
    solution.

    correction: (N, 2) correction of the image points [px] in the adjustment. Raises
    numpy.linalg.LinAlgError if the network does not determine the unknowns.
    """

    def blocks_at(image_factor: float) -> CovarianceBlocks:
        equations = normal_equations(
            network, adjustment.parameters, correction, adjustment.noise, image_factor
        )
        return covariance_blocks(factorize(network, equations))

    weighted = blocks_at(1.0)
    projected = covariance_of_projection(network, adjustment.parameters, weighted)
    residual = residual_covariance(network, adjustment, projected)
    variance = _weighted_variance(network, adjustment)
    redundancy = 1 - np.diagonal(projected, axis1=1, axis2=2) / variance[:, None]
    survey = np.zeros_like(network.survey_mm)
    if network.datum == 'survey':
        point_variance = np.diagonal(weighted.pp, axis1=1, axis2=2)
        survey = 1 - point_variance / network.survey_sd_mm[:, None] ** 2
    factor = adjustment.noise.information_factor(adjustment.q)
    fisher = weighted if factor == 1.0 else blocks_at(factor)
    layout = network.layout
    return Precision(
        **_covariances(network, fisher),
        residual=residual,
        redundancy=redundancy,
        survey_redundancy=survey,
        additional=tuple(
            None if a is None else fisher.gg[columns, columns]
            for a, columns in zip(network.additional, layout.additional)
        ),
        relative=tuple(fisher.gg[columns, columns] for columns in layout.relative),
        relative_redundancy=_relative_redundancy(network, adjustment.parameters, weighted),
    )


def _covariances(network: Network, blocks: CovarianceBlocks) -> dict[str, Any]:
    """Return the covariances of the unknowns, which are fields of a `Precision`."""
    few_points = network.n_points <= MAX_JOINT_POINTS
    return {
        'interior': np.stack(
            [blocks.gg[columns, columns] for columns in network.layout.interiors]
        ),
        'exterior': blocks.ee,
        'points': blocks.pp,
        'all_global': blocks.gg,
        'exterior_global': blocks.eg,
        'joint_points': covariance_of_points(blocks) if few_points else None,
    }


def joint_covariance(blocks: CovarianceBlocks) -> NDArray[np.float64]:
    """Return the covariance of exposures, object points and global unknowns from its blocks."""
    size = len(blocks.gg)
    exteriors_globals = blocks.eg.reshape(-1, size)
    points_globals = blocks.pg.reshape(-1, size)
    mixed = _assembled(lambda p, e: blocks.pe(e, p), len(blocks.pp), len(blocks.ee))
    return np.block(
        [
            [covariance_of_exteriors(blocks), mixed.T, exteriors_globals],
            [mixed, covariance_of_points(blocks), points_globals],
            [exteriors_globals.T, points_globals.T, blocks.gg],
        ]
    )


def covariance_of_points(blocks: CovarianceBlocks) -> NDArray[np.float64]:
    """Return the joint covariance (3n, 3n) of the object points."""
    return _assembled(blocks.points_between, len(blocks.pp), len(blocks.pp))


def covariance_of_exteriors(blocks: CovarianceBlocks) -> NDArray[np.float64]:
    """Return the joint covariance (6m, 6m) of the exterior orientations."""
    return _assembled(blocks.between, len(blocks.ee), len(blocks.ee))


def _assembled(
    of_pairs: Callable[[NDArray[np.int64], NDArray[np.int64]], NDArray[np.float64]],
    rows: int,
    columns: int,
) -> NDArray[np.float64]:
    """Return the matrix whose blocks of_pairs(i, j) have so many rows and columns of blocks."""
    i, j = (a.ravel() for a in np.indices((rows, columns)))
    pair_blocks = of_pairs(i, j)
    height, width = pair_blocks.shape[1:]
    pair_blocks = pair_blocks.reshape(rows, columns, height, width).transpose(0, 2, 1, 3)
    return pair_blocks.reshape(rows * height, columns * width)


def _relative_redundancy(
    network: Network, parameters: Parameters, blocks: CovarianceBlocks
) -> tuple[NDArray[np.float64], ...]:
    """Return redundancy numbers (k, 6) of the pairs of every relative orientation constraint."""
    out = []
    for constraint, pose, columns in zip(
        network.relative, parameters.relative, network.layout.relative
    ):
        a, b = constraint.pairs.T
        _, d_a, d_b, d_pose = discrepancies_with_jacobian(constraint, pose, parameters)
        design = np.concatenate([d_a, d_b, d_pose], axis=2)
        c = np.empty((len(a), 18, 18))
        c[:, :6, :6] = blocks.ee[a]
        c[:, 6:12, 6:12] = blocks.ee[b]
        c[:, 12:, 12:] = blocks.gg[columns, columns]
        c[:, :6, 6:12] = blocks.between(a, b)
        c[:, :6, 12:] = blocks.eg[a][:, :, columns]
        c[:, 6:12, 12:] = blocks.eg[b][:, :, columns]
        c[:, 6:12, :6] = c[:, :6, 6:12].transpose(0, 2, 1)
        c[:, 12:, :12] = c[:, :12, 12:].transpose(0, 2, 1)
        out.append(1 - np.einsum('kia,kab,kib->ki', design, c, design) * constraint.weights)
    return tuple(out)


def _weighted_variance(network: Network, adjustment: Adjustment) -> NDArray[np.float64]:
    """Return variances (N,) [px^2] of image points in the weighted least-squares problem."""
    weight = np.maximum(adjustment.noise.weight(adjustment.q), MIN_WEIGHT)
    return (adjustment.noise.scale * network.sigma) ** 2 / weight


def residual_covariance(
    network: Network, adjustment: Adjustment, projected: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return covariances C_r (N, 2, 2) [px^2] of the residuals.

    projected: A C_x A^T from covariance_of_projection.
    """
    return _weighted_variance(network, adjustment)[:, None, None] * np.eye(2) - projected


def geometric_redundancy(
    network: Network, parameters: Parameters, noise: Noise
) -> NDArray[np.float64]:
    """Return redundancy numbers (N,) of the image points at equal weights, mean of u and v.

    They depend on the geometry only. Those of the weighted problem follow the residuals, and so
    cannot be used to estimate the noise from the residuals. Raises numpy.linalg.LinAlgError if the
    network does not determine the unknowns.
    """
    gaussian = Noise('gaussian', noise.scale)
    equations = normal_equations(network, parameters, 0.0, gaussian)
    blocks = covariance_blocks(factorize(network, equations))
    variance = (noise.scale * network.sigma) ** 2
    projected = covariance_of_projection(network, parameters, blocks)
    return 1 - np.trace(projected, axis1=1, axis2=2) / (2 * variance)


# Precision of an adjustment with fixed interior orientations that are not known exactly.
#
# Fixed parameters with covariance S move the other unknowns by J = -N^-1 B, where N is the normal
# matrix of the unknowns and B its mixed blocks with the fixed parameters. The covariance of the
# unknowns is N^-1 + J S J^T ("consider parameters": Tapley, Schutz and Born, "Statistical Orbit
# Determination", 2004, 6.2). It is a block of the inverse of the normal matrix with
# D = S^-1 + B^T N^-1 B for the fixed parameters, in which the observations do not improve these.

MIN_SD_PX = 1e-6  # least standard deviation of a fixed interior orientation


def precision_with_fixed_interiors(
    network: Network,
    adjustment: Adjustment,
    correction: NDArray[np.float64],
    precise: Precision,
    covariances: NDArray[np.float64],
) -> Precision:
    """Return the precision of an adjustment with the uncertainty of its fixed interiors.

    Parameters
    ----------
    network : Network
        Network with fixed interior orientations.
    adjustment : Adjustment
    correction : (N, 2) ndarray
        Correction of the image points [px] in the adjustment.
    precise : Precision
        Precision of the adjustment as if the interior orientations were known.
    covariances : (F, 3, 3) ndarray
        Covariances of the interior orientations [px^2].

    Returns
    -------
    Precision
        Residuals and redundancy numbers are those of `precise`: the interiors are fixed.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the network does not determine the unknowns.
    """
    free, equations = equations_with_fixed_interiors(network, adjustment, correction, covariances)
    blocks = covariance_blocks(factorize(free, equations))
    return replace(precise, **_covariances(free, blocks))


def equations_with_fixed_interiors(
    network: Network,
    adjustment: Adjustment,
    correction: np.ndarray,
    covariances: NDArray[np.float64],
) -> tuple[Network, NormalEquations]:
    """Return network and normal equations whose inverse has the uncertainty of fixed interiors.

    See `precision_with_fixed_interiors` for the arguments.
    """
    free = replace(network, interior_free=np.ones(network.n_fluoroscopes, dtype=bool))
    factor = adjustment.noise.information_factor(adjustment.q)
    equations = normal_equations(free, adjustment.parameters, correction, adjustment.noise, factor)
    prior = np.zeros_like(equations.gg)
    for columns, covariance in zip(free.layout.interiors, covariances):
        prior[columns, columns] = np.linalg.inv(covariance + MIN_SD_PX**2 * np.eye(3))
    with_prior = replace(equations, gg=equations.gg + prior)
    schur = np.tril(factorize(free, with_prior).factor.schur)
    # The last rows of a Cholesky factor are the factor of their Schur complement.
    size = len(prior)
    last = schur[-size:, -size:]
    absorbed = with_prior.gg - last @ last.T
    return free, replace(equations, gg=prior + absorbed)
