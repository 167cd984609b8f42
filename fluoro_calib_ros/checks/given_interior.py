# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Whether a given interior orientation is why a calibration fails.

An interior orientation that is given with a small standard deviation holds the adjustment where
the exposures contradict it: their lack of fit looks like a trend of the residuals, or like a
distortion that differs between exposures. Where checks fail, the fluoroscope is calibrated again
without what was given. If the residuals are then clearly smaller, and the interior orientation is
clearly another one, that is the cause, and a check of its own says so.

The interior orientation of an image with distortion depends on what is called distortion, so that
a given one which the exposures move away from, with good residuals, is no fault.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..correction.fluoroscope_calibration import FluoroscopeCalibration
from ..errors import DataError
from ..estimation.initial_network import nominal_interior
from ..findings import Kind, Place
from .calibration_evidence import Evidence
from .check import Check

REPAIR_FIRST = 'check this again when the given interior orientation fits the exposures'
MAX_SD = 4.0  # by which what the exposures show may deviate from what was given
# RMSE with what was given over that without, from which it is the cause; without a correction
# model, the distortion is a better one.
MIN_GAIN = 1.05
MIN_GAIN_UNCORRECTED = 2.0
LABELS = ('xp', 'yp', 'c')


def with_given_interior(evidence: Evidence, checks: Sequence[Check]) -> list[Check]:
    """Return the checks, with one more for every given interior orientation that is contradicted.

    The estimated noise can take the misfit up, so that no other check fails. The advice of those
    that fail is then to repair that first.
    """
    request = evidence.request
    distance = request.principal_distance
    if request.options.interior_sd is None or distance is None:
        return list(checks)
    found: list[Check] = []
    for names in request.groups:
        names = tuple(name for name in names if name not in request.known_orientations)
        if names:
            found += _contradictions(evidence, names, distance)
    if not found:
        return list(checks)
    wrong = {'', *(check.place.fluoroscope for check in found)}
    others = [
        replace(check, advice=REPAIR_FIRST)
        if check.passed is False and check.place.fluoroscope in wrong
        else check
        for check in checks
    ]
    return [*found, *others]


def _contradictions(evidence: Evidence, names: Sequence[str], distance: float) -> list[Check]:
    """Return a failed check for every fluoroscope whose exposures contradict what was given."""
    evidence.report_step(f'{"+".join(names)}: interior orientation without what was given')
    try:
        free = evidence.calibrate_free(names)
    except DataError:
        return []
    checks = [_check(evidence, name, free[name], distance) for name in names]
    return [check for check in checks if check is not None]


def _check(
    evidence: Evidence, name: str, free: FluoroscopeCalibration, distance: float
) -> Check | None:
    present = evidence.calibrations[name]
    gain = _rmse(present) / _rmse(free)
    given = nominal_interior(present.image_size, distance)
    given_sd = np.asarray(evidence.request.options.interior_sd)
    sd = np.sqrt(np.diag(free.interior_covariance))
    off = np.abs(free.interior - given) / np.hypot(given_sd, sd)
    least = MIN_GAIN if present.model.corrects else MIN_GAIN_UNCORRECTED
    if not gain > least or not off.max() > MAX_SD:
        return None
    wrong = [i for i in np.argsort(-off) if off[i] > MAX_SD]
    stated = ', '.join(f'{LABELS[i]} = {given[i]:.1f} (sd {given_sd[i]:g})' for i in wrong)
    shown = ', '.join(f'{LABELS[i]} = {free.interior[i]:.1f} (sd {sd[i]:.1f})' for i in wrong)
    return Check(
        Kind.GIVEN_INTERIOR,
        f'the given interior orientation, {stated} px, contradicts the '
        f'exposures, which show {shown} px: the residuals are {_rmse(present):.2f} px with what '
        f'was given and {_rmse(free):.2f} px without',
        Place((name,)),
        'give the right value, a larger --interior-sd, or none',
        numbers={
            **{f'{label}_px': float(x) for label, x in zip(LABELS, free.interior)},
            **{f'sd_{label}_px': float(x) for label, x in zip(LABELS, sd)},
        },
        value=off.max(),
        limit=MAX_SD,
        unit='sd',
    )


def _rmse(calibration: FluoroscopeCalibration) -> float:
    """RMSE of the inlier residuals of a coordinate after the correction [px]."""
    return float(np.sqrt(np.mean(np.square(calibration.rmse_after))))
