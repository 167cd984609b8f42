# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Adjustment of a network with its precision, as every step of a calibration needs it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ..errors import DataError
from ..photogrammetry.adjustment import Adjustment, SolverOptions, adjust
from ..photogrammetry.network import Network
from ..photogrammetry.noise import Noise
from ..photogrammetry.noise_estimation import adjust_and_estimate_noise
from ..photogrammetry.precision import Precision, precision
from ..photogrammetry.unknowns import Parameters

START_GROSS = 0.01  # share of gross errors with which the estimation of the noise begins
ADVICE = 'add exposures with the phantom turned and moved'
SINGULAR = f'the exposures do not determine the unknowns: the normal matrix is singular; {ADVICE}'


def start_noise(loss: str) -> Noise:
    """Return the noise model with which an estimation begins.

    A Student-t noise comes with a share of gross errors.
    """
    return Noise(loss, gross=START_GROSS if loss == 'student_t' else 0.0)


def adjusted_with_precision(
    network: Network,
    start: Parameters,
    correction: np.ndarray,
    noise: Noise,
    tolerance: float = 1e-8,
    raise_if_cancelled: Callable[[], None] | None = None,
    noise_held: bool = False,
) -> tuple[Adjustment, Precision]:
    """Adjust a network and compute its precision.

    Parameters
    ----------
    network : Network
    start : Parameters
        Start values of the unknowns.
    correction : (N, 2) ndarray
        Corrections of the image points [px], held.
    noise : Noise
        Start values of the noise model, or the noise model where noise_held.
    tolerance : float
        Decrease of the cost at which the adjustment stops.
    raise_if_cancelled : callable, optional
        Called before every step; may raise to stop.
    noise_held : bool
        True where the noise model is not to be estimated.

    Returns
    -------
    Adjustment, Precision

    Raises
    ------
    DataError
        If the network does not determine the unknowns.
    """
    try:
        if noise_held:
            result = adjust(
                network,
                start,
                correction,
                noise,
                SolverOptions(tolerance),
                raise_if_cancelled,
            )
        else:
            result = adjust_and_estimate_noise(
                network, start, correction, noise, SolverOptions(tolerance), raise_if_cancelled
            )
        return result, precision(network, result, correction)
    except np.linalg.LinAlgError:
        raise DataError(SINGULAR) from None


def with_additional(adjustment: Adjustment, values: tuple[np.ndarray, ...]) -> Adjustment:
    """Return an adjustment whose parameters have additional parameters of these values."""
    return replace(adjustment, parameters=replace(adjustment.parameters, additional=values))
