# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Precision of an adjustment that holds interior orientations which are not known exactly.

What is held has the covariance S, and moves the other unknowns by J = -N^-1 B, where N is their
normal matrix and B its mixed blocks with what is held. Their covariance is N^-1 + J S J^T, with
"consider parameters" (Tapley, Schutz and Born, "Statistical Orbit Determination", 2004, 6.2). It
is a block of the inverse of the normal matrix with D = S^-1 + B^T N^-1 B for what is held, in
which the observations do not improve it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .adjustment import Adjustment
from .elimination import factorize
from .network import Network
from .normal_equations import NormalEquations, normal_equations
from .precision import MAX_JOINT_POINTS, Precision, covariance_blocks, joint_covariance

MIN_SD_PX = 1e-6  # of an interior orientation that is held


def precision_with_held_interiors(
    network: Network,
    adjustment: Adjustment,
    correction: np.ndarray,
    precise: Precision,
    covariances: np.ndarray,
) -> Precision:
    """Return the precision of an adjustment with the uncertainty of its held interiors.

    Parameters
    ----------
    network : Network
        With interior orientations that are held.
    adjustment : Adjustment
    correction : (N, 2) ndarray
        Correction of the image points [px] in the adjustment.
    precise : Precision
        Of the adjustment as if the interior orientations were known.
    covariances : (F, 3, 3) ndarray
        Of the interior orientations [px^2].

    Returns
    -------
    Precision
        Residuals and redundancy numbers are those of `precise`: the interiors are held.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where the network does not determine the unknowns.
    """
    free, equations = equations_with_held_interiors(network, adjustment, correction, covariances)
    blocks = covariance_blocks(factorize(free, equations))
    return replace(
        precise,
        interior=np.stack([blocks.gg[own, own] for own in free.layout.interiors]),
        exterior=blocks.ee,
        points=blocks.pp,
        all_global=blocks.gg,
        exterior_global=blocks.eg,
        joint_points=(
            joint_covariance(blocks).points if network.n_points <= MAX_JOINT_POINTS else None
        ),
    )


def equations_with_held_interiors(
    network: Network, adjustment: Adjustment, correction: np.ndarray, covariances: np.ndarray
) -> tuple[Network, NormalEquations]:
    """Network and normal equations whose inverse holds the uncertainty of held interiors.

    See `precision_with_held_interiors` for the arguments.
    """
    free = replace(network, interior_free=np.ones(network.n_fluoroscopes, dtype=bool))
    factor = adjustment.noise.information_factor(adjustment.q)
    equations = normal_equations(free, adjustment.parameters, correction, adjustment.noise, factor)
    prior = np.zeros_like(equations.gg)
    for own, covariance in zip(free.layout.interiors, covariances):
        prior[own, own] = np.linalg.inv(covariance + MIN_SD_PX**2 * np.eye(3))
    with_prior = replace(equations, gg=equations.gg + prior)
    schur = np.tril(factorize(free, with_prior).factor.schur)
    # The last rows of a Cholesky factor are the factor of their Schur complement.
    size = len(prior)
    last = schur[-size:, -size:]
    absorbed = with_prior.gg - last @ last.T
    return free, replace(equations, gg=prior + absorbed)
