# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Estimation of the noise model around the adjustment, from the marginal likelihood of its scale.

Residuals are smaller than the noise, because the unknowns follow it. How much smaller depends on
the scale itself: the less the image points weigh, the more the survey holds the object points.
Adjustment and expected squared errors are therefore updated in turn until the scale settles: the
EM algorithm with the unknowns as missing data (Dempster, Laird and Rubin, JRSS B 39, 1977; for
variance components in photogrammetry Foerstner and Wrobel, "Photogrammetric Computer Vision",
Springer 2016, 4.2.4).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .adjustment import DEFAULT_OPTIONS, Adjustment, SolverOptions, adjust, residuals_and_q
from .elimination import CovarianceBlocks, factorize
from .network import Network
from .noise import DEFAULT_NOISE, Noise
from .normal_equations import normal_equations
from .precision import covariance_blocks, variance_of_projection
from .unknowns import Parameters

MAX_ROUNDS = 40
# Relative change of the scale at which the rounds end: a hundredth of its standard deviation.
SETTLED = 2e-3
# Tolerance of the adjustments before the last one.
LOOSE = 0.1
# No target is measured better than this. Where redundancy is scarce, the scale could vanish.
MIN_NOISE_PX = 0.01


def adjust_and_estimate_noise(
    network: Network,
    start: Parameters,
    correction: NDArray[np.float64] | None = None,
    noise: Noise = DEFAULT_NOISE,
    options: SolverOptions = DEFAULT_OPTIONS,
) -> Adjustment:
    """Adjust a network and estimate its noise model; see `adjust` for the arguments.

    noise: loss and start values of the noise model. options: of the last adjustment; those before
    it have a looser tolerance.

    `converged` of the result is False where adjustment or scale did not settle, `steps` are those
    of the last adjustment. Raises LinAlgError where the network does not determine the unknowns.
    """
    correction = np.zeros_like(network.uv) if correction is None else correction
    _, q = residuals_and_q(network, start, correction, noise)
    if np.isfinite(q).all():
        # Far from the solution, whole exposures may look like gross errors: these are told apart
        # only after the first adjustment.
        plain = replace(noise, gross=0.0).estimate_from(q * noise.scale**2)
        noise = replace(plain, gross=noise.gross)
    loose = replace(options, tolerance=LOOSE)
    parameters = start
    settled = False
    for _ in range(MAX_ROUNDS):
        result = adjust(
            network,
            parameters,
            correction=correction,
            noise=noise,
            options=loose,
        )
        parameters = result.parameters
        equations = normal_equations(network, parameters, correction, noise)
        blocks = covariance_blocks(factorize(network, equations, options.elimination))
        last_scale = noise.scale
        noise = estimate_noise(network, result, blocks)
        if abs(noise.scale - last_scale) <= SETTLED * last_scale:
            settled = True
            break
    result = adjust(
        network,
        parameters,
        correction=correction,
        noise=noise,
        options=options,
    )
    return replace(result, converged=result.converged and settled)


def estimate_noise(
    network: Network, adjustment: Adjustment, blocks: CovarianceBlocks, factor: float = 1.0
) -> Noise:
    """Noise model from the residuals of an adjustment and the covariances of its unknowns.

    factor: information factor near one that the covariances are without.
    """
    noise = adjustment.noise
    variance = (noise.scale * network.sigma) ** 2
    unresolved = variance_of_projection(network, adjustment.parameters, blocks)
    unresolved = unresolved / (factor * variance)
    new = noise.estimate_from(adjustment.q * noise.scale**2, unresolved)
    return replace(new, scale=max(new.scale, MIN_NOISE_PX / float(np.median(network.sigma))))
