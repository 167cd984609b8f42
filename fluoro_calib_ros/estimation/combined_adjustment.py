# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Self-calibration with the distortion among the unknowns of the adjustment.

In the alternation of Chow et al. the orientations and object points take up part of the distortion
before the regressor sees it. Here all are adjusted together. What is still renewed between
adjustments is the noise model, and what the terms of the distortion assume: the prior of a signal,
or which terms there are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ..correction.base import CorrectionModel
from ..errors import DataError
from ..photogrammetry.adjustment import Adjustment, SolverOptions, adjust_with_matrix
from ..photogrammetry.elimination import factorize
from ..photogrammetry.network import Network, in_determined_datum
from ..photogrammetry.noise_estimation import estimate_noise
from ..photogrammetry.normal_equations import normal_equations
from ..photogrammetry.precision import Precision, covariance_blocks, precision
from .estimator import AdjustedTerms, require_training
from .initial_network import Measured, undetermined, with_additional
from .lack_of_fit import FittedPoints, sd_of_rejected, sd_with_lack_of_fit
from .rounds import History, Round, SelfCalibration

# Decrease of F by image point that the first adjustment may leave: its noise is still that of an
# adjustment without correction.
FIRST_TOLERANCE = 1e-3
# Information factor from which noise and prior are estimated with the matrix of the last steps.
NEARLY_ONE = 0.98


def calibrate_by_adjustment(
    measured: Measured,
    before: Adjustment,
    model_type: type[CorrectionModel],
    terms: AdjustedTerms,
    max_rounds: int,
    progress: Callable[[Round], None] | None = None,
) -> SelfCalibration:
    """Self-calibrate with the model among the unknowns.

    before: adjustment without correction. model_type: a model that is a series. terms: of that
    model, for the network of measured. progress: called with the Round after every adjustment.

    Raises DataError if there are too few inliers, or the exposures do not determine the unknowns.
    """
    history = History(measured, progress)

    def report(adjustment: Adjustment, change: float) -> None:
        _require_inliers(measured, adjustment)
        square = float(np.sum(adjustment.q[adjustment.inliers]))
        history.add(adjustment, square, dict.fromkeys(measured.fluoroscopes, 0), change)

    try:
        network, after, converged = adjust_with_terms(
            measured.network,
            before,
            terms=terms,
            max_rounds=max_rounds,
            report=report,
        )
        network, parameters = in_determined_datum(network, after.parameters, after.inliers)
        after = replace(after, parameters=parameters)
        precise = precision(network, after)
        fields = {
            name: terms.fit_angles(f, after, precise)
            for f, name in enumerate(measured.fluoroscopes)
        }
        between = {
            name: terms.variance_between_exposures(f, network, after, precise)
            for f, name in enumerate(measured.fluoroscopes)
        }
    except np.linalg.LinAlgError:
        raise undetermined(measured.network) from None
    measured = replace(measured, network=network)
    return SelfCalibration(
        measured=measured,
        before=before,
        after=after,
        precision=precise,
        correction=network.additional_correction(after.parameters),
        trained=after.inliers,
        models=_models(model_type, terms, measured, after, precise),
        history=tuple(history.rounds),
        converged=converged,
        between_exposures=between,
        angle_fields={name: found for name, found in fields.items() if found is not None},
    )


def _models(
    model_type: type[CorrectionModel],
    terms: AdjustedTerms,
    measured: Measured,
    after: Adjustment,
    precise: Precision,
) -> dict[str, CorrectionModel]:
    """Models by fluoroscope, from the terms that an adjustment has estimated.

    measured is the network with these terms as additional parameters.
    """
    network = measured.network
    values = after.residuals + network.additional_correction(after.parameters)
    models = {}

    def points(rows: np.ndarray) -> FittedPoints:
        return FittedPoints(
            network.uv[rows],
            after.residuals[rows],
            network.exposure[rows],
            precise.redundancy[rows].mean(axis=1),
        )

    for f, name in enumerate(measured.fluoroscopes):
        rows = network.rows(f)
        rejected = points(rows[~after.inliers[rows]])
        rows = rows[after.inliers[rows]]
        series = terms.fitted_series(f, after, precise)
        sd = np.hypot(
            sd_with_lack_of_fit(points(rows), series, terms.left_out(f)),
            sd_of_rejected(points(rows), rejected, series),
        )
        models[name] = model_type(0, network.uv[rows], values[rows], series=replace(series, sd=sd))
    return models


def _require_inliers(measured: Measured, adjustment: Adjustment) -> None:
    """Raise DataError where a fluoroscope has too few inliers for a correction model."""
    for f, name in enumerate(measured.fluoroscopes):
        try:
            require_training(int(adjustment.inliers[measured.network.rows(f)].sum()))
        except ValueError as error:
            raise DataError(f'fluoroscope {name}: {error}') from None


def adjust_with_terms(
    plain: Network,
    before: Adjustment,
    terms: AdjustedTerms,
    max_rounds: int,
    report: Callable[[Adjustment, float], None],
) -> tuple[Network, Adjustment, bool]:
    """Adjust a network together with terms of its distortion.

    plain: network without additional parameters. before: its adjustment without correction.
    report: called with every Adjustment and the RMS change of the correction [px].

    Returns the network with the terms as additional parameters, its adjustment, and whether it
    converged. Raises LinAlgError if the network does not determine the unknowns.
    """
    correction = np.zeros_like(plain.uv)
    zero = correction
    parameters = with_additional(before, terms.start()).parameters
    noise = before.noise
    converged = False
    for number in range(max_rounds):
        network = terms.with_additional(plain)
        final = converged or number == max_rounds - 1
        tolerance = terms.final_tolerance if final else terms.intermediate_tolerance
        if not number and not final:
            tolerance = max(tolerance, FIRST_TOLERANCE * network.n_image_points)
        result, matrix = adjust_with_matrix(
            network,
            parameters,
            correction=zero,
            noise=noise,
            options=SolverOptions(tolerance),
        )
        last = correction
        correction = network.additional_correction(result.parameters)
        report(result, float(np.sqrt(np.mean((correction - last) ** 2))))
        if final:
            break
        factor = noise.information_factor(result.q)
        if matrix is None or factor < NEARLY_ONE or terms.needs_solution:
            matrix = factorize(
                network, normal_equations(network, result.parameters, zero, noise, factor)
            )
        blocks = covariance_blocks(matrix)
        renewed = estimate_noise(network, result, blocks, matrix.information_factor)
        converged, coefficients = terms.renew(network, matrix, result)
        converged &= abs(renewed.scale - noise.scale) <= terms.noise_tolerance * noise.scale
        parameters = replace(result.parameters, additional=coefficients)
        noise = renewed
    return network, result, bool(converged and result.converged)
