"""Adjustment and noise model in turn: the scale of the noise is that of its marginal likelihood.

The residuals of an adjustment are smaller than the noise, as the unknowns follow it; and how far
they follow depends on the scale, for the survey holds the object points the more the less the
image points weigh. So adjustment and expected squared errors are renewed in turn until the scale
no longer changes: the EM algorithm with the unknowns as missing data (Dempster, Laird and Rubin,
JRSS B 39, 1977; for variance components in photogrammetry Foerstner and Wrobel, "Photogrammetric
Computer Vision", Springer 2016, 4.2.4).
"""

from dataclasses import replace

import numpy as np

from .adjustment import adjust, residuals_and_q
from .normal_equations import normal_equations
from .precision import covariance_blocks, covariance_of_projection, solved

ROUNDS = 40
# relative change of the scale at which the turns end: a hundredth of its standard deviation
SETTLED = 2e-3
LOOSE = 0.1  # decrease of F that an adjustment may leave while the scale is still on its way
MIN_NOISE_PX = 0.01  # no target is measured better than this


def adjust_and_estimate_noise(
    network, start, correction, noise, tolerance=1e-8, raise_if_cancelled=None
):
    """Adjust a network and estimate its noise model.

    start: Parameters; correction (N, 2) [px]; noise: loss and start values. Returns Adjustment,
    converged False where scale and adjustment did not settle. Raises numpy.linalg.LinAlgError
    where the network does not determine the unknowns.
    """
    _, q = residuals_and_q(network, start, correction, noise)
    if np.isfinite(q).all():
        # From afar whole exposures may look like gross errors: these are told from the rest after
        # the first adjustment.
        noise = replace(replace(noise, gross=0.0).estimated(q * noise.scale**2), gross=noise.gross)
    parameters = start
    settled = False
    for _ in range(ROUNDS):
        result = adjust(
            network,
            parameters,
            correction,
            noise,
            tolerance=LOOSE,
            raise_if_cancelled=raise_if_cancelled,
            noise_held=True,
        )
        blocks = covariance_blocks(
            network,
            solved(network, normal_equations(network, result.parameters, correction, noise)),
        )
        noise, last = renewed_noise(network, result, blocks), noise
        parameters = result.parameters
        if abs(noise.scale - last.scale) <= SETTLED * last.scale:
            settled = True
            break
    result = adjust(
        network,
        parameters,
        correction,
        noise,
        tolerance=tolerance,
        raise_if_cancelled=raise_if_cancelled,
        noise_held=True,
    )
    return replace(result, converged=result.converged and settled)


def renewed_noise(network, adjustment, blocks):
    """The noise model that the residuals of an Adjustment and the CovarianceBlocks of its unknowns
    show.
    """
    noise = adjustment.noise
    left_open = np.trace(
        covariance_of_projection(network, adjustment.parameters, blocks), axis1=1, axis2=2
    )
    new = noise.estimated(
        adjustment.q * noise.scale**2, left_open / (noise.scale * network.sigma) ** 2
    )
    return replace(new, scale=max(new.scale, MIN_NOISE_PX / float(np.median(network.sigma))))


__all__ = ['adjust_and_estimate_noise', 'renewed_noise']
