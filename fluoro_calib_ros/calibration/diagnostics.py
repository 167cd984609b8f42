# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Diagnostics of a self-calibration: undetermined unknowns, correlations and outliers."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..errors import DataError
from ..photogrammetry.adjustment import Adjustment
from ..photogrammetry.diagnosis import (
    describe_directions,
    high_correlations,
    undetermined_directions,
    undetermined_interiors,
)
from ..photogrammetry.outliers import find_outliers
from ..photogrammetry.precision import Precision
from .initial_network import Measured
from .rounds import SelfCalibration

MIN_FITTING = 0.5  # share of the image points of an exposure that is used


def undetermined_unknowns(measured: Measured) -> str:
    """Return a sentence on the unknowns that a network leaves undetermined at its start values.

    It is empty where there are none.
    """
    found = undetermined_directions(
        measured.network, measured.start, measured.fluoroscopes, _exposure_numbers(measured)
    )
    if not found:
        return ''
    return (
        f'the exposures do not determine the unknowns: {describe_directions(found)}; '
        'add exposures with the phantom turned and moved, with more targets'
    )


def raise_if_undetermined(measured: Measured, adjustment: Adjustment, precise: Precision) -> None:
    """Raise DataError, one sentence a fluoroscope, for undetermined interior orientations."""
    scale = adjustment.noise.scale
    found = undetermined_interiors(
        measured.network, adjustment.parameters, precise, measured.fluoroscopes, scale
    )
    if found:
        raise DataError('. '.join(found))


def correlations_of(run: SelfCalibration) -> tuple[tuple[str, str, float], ...]:
    """High correlations between unknowns of a self-calibration: ((name, name, value), ...)."""
    return high_correlations(
        run.measured.network,
        run.after.parameters,
        run.precision,
        run.measured.fluoroscopes,
        _exposure_numbers(run.measured),
    )


def outliers_of(run: SelfCalibration) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Outliers of a self-calibration: image points and targets, with their test statistics."""
    measured = run.measured
    found = find_outliers(measured.network, run.after, run.precision)
    exposures = measured.network.exposure[found.image_point]
    points = [
        {
            'fluoroscope': measured.frames[j].fluoroscope,
            'exposure': measured.frames[j].number,
            'target_id': int(measured.target_id[measured.network.point[row]]),
            'value': float(value),
            'critical': found.critical_image,
        }
        for row, j, value in zip(found.image_point, exposures, found.value)
    ]
    targets = [
        {
            'target_id': int(measured.target_id[row]),
            'offset_mm': offset,
            'value': float(value),
            'critical': found.critical_target,
        }
        for row, offset, value in zip(found.target, found.offset_mm, found.target_value)
    ]
    return points, targets


def misfitting_exposures(run: SelfCalibration) -> dict[tuple[str, int], str]:
    """Return a sentence for every exposure of which less than half fits, by name and number.

    Where most exposures of a fluoroscope are like that, none of them stands out, and the whole
    calibration is to be judged instead.
    """
    network = run.measured.network
    count = np.bincount(network.exposure, minlength=network.n_exposures)
    # By the core of the noise: the false matches of such an exposure make its tails heavy, and so
    # the limit of gross errors wide.
    fits = run.after.noise.inliers(run.after.q)
    fitting = np.bincount(network.exposure, fits, network.n_exposures)
    share = fitting / count
    out = {}
    for row, frame in enumerate(run.measured.frames):
        own = network.fluoroscope == network.fluoroscope[row]
        if share[row] < MIN_FITTING and np.median(share[own]) >= MIN_FITTING:
            out[frame.fluoroscope, frame.number] = (
                f'fluoroscope {frame.fluoroscope}, exposure {frame.number}: only '
                f'{100 * share[row]:.0f} % of the image points fit, the others are false matches'
            )
    return out


def _exposure_numbers(measured: Measured) -> list[int]:
    return [frame.number for frame in measured.frames]
