"""Adjustment of a network with its distortion among the unknowns, in turn with what it takes for
known.

In the alternation of Chow et al. the orientations and object points take up part of the distortion
before the regressor sees it. Here all are adjusted together; what is left to turns is the noise
model and what a model of the distortion decides beside its coefficients: the prior of a signal, or
which terms there are.
"""

from dataclasses import replace

import numpy as np

from ..photogrammetry.adjustment import SolverOptions, adjust
from ..photogrammetry.elimination import factorize
from ..photogrammetry.noise_estimation import SETTLED, estimate_noise
from ..photogrammetry.normal_equations import normal_equations
from ..photogrammetry.precision import covariance_blocks

TOLERANCE = 1e-5  # decrease of F that the last adjustment may leave


def adjust_in_turns(measured, before, model, max_rounds, report, raise_if_cancelled=None):
    """Adjust a network together with a model of its distortion; returns the network, Adjustment
    and convergence.

    before: Adjustment without correction; model: a Collocation or Terms, with with_additional
    (plain network -> with additional parameters), zeros (coefficients of no correction),
    on_the_way (decrease of F that an adjustment before the last may leave) and renew (network,
    Solved normal matrix, Adjustment -> whether nothing changed, coefficients to go on with);
    report(Adjustment, change) after every adjustment, change the RMS change of the correction
    [px]. Raises numpy.linalg.LinAlgError where the network does not determine the unknowns.
    """
    correction = np.zeros_like(measured.network.uv)
    zero = correction
    parameters = replace(before.parameters, additional=model.zeros())
    noise = before.noise
    converged = False
    for turn in range(max_rounds):
        network = model.with_additional(measured.network)
        final = converged or turn == max_rounds - 1
        result = adjust(
            network,
            parameters,
            zero,
            noise,
            SolverOptions(TOLERANCE if final else model.on_the_way),
            raise_if_cancelled,
        )
        last = correction
        correction = network.additional_correction(result.parameters)
        report(result, float(np.sqrt(np.mean((correction - last) ** 2))))
        if final:
            break
        matrix = factorize(
            network,
            normal_equations(
                network, result.parameters, zero, noise, noise.information_factor(result.q)
            ),
        )
        now = estimate_noise(network, result, covariance_blocks(matrix))
        converged, coefficients = model.renew(network, matrix, result)
        converged &= abs(now.scale - noise.scale) <= SETTLED * noise.scale
        parameters = replace(result.parameters, additional=coefficients)
        noise = now
    return network, result, bool(converged and result.converged)
