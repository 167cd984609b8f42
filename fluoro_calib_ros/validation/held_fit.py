# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Doubts whether exposures fit calibrations that are held.

A held calibration leaves the noise that it was determined with. Where exposures leave much more,
it is not theirs: the image has changed, the fluoroscopes are interchanged, or the image points are
corrected already.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..calibration.calibrate import CalibrationResult
from ..calibration.result import FluoroscopeCalibration
from ..distortion.none import no_correction

MAX_NOISE = 2.0  # RMSE over the noise of an image coordinate of the calibration
CORRECTED = 0.6  # RMSE without the correction over that with it, of points that are corrected


def uncorrected(
    calibrations: Mapping[str, FluoroscopeCalibration],
) -> dict[str, FluoroscopeCalibration]:
    """Return calibrations without their corrections, to try image points that are corrected."""
    return {
        name: replace(
            calibration,
            model=no_correction(),
            train_exposure=np.zeros(0, dtype=np.int64),
            angle_field=None,
        )
        for name, calibration in calibrations.items()
    }


def misfits(
    result: CalibrationResult, calibrations: Mapping[str, FluoroscopeCalibration]
) -> dict[str, float]:
    """Return the RMSE over the noise of each fluoroscope whose exposures a calibration misfits."""
    ratios = {
        name: _rmse(figures.rmse_after) / calibrations[name].image_sd
        for name, figures in result.fluoroscopes.items()
    }
    return {name: ratio for name, ratio in ratios.items() if ratio > MAX_NOISE}


def corrected_already(
    result: CalibrationResult,
    without: CalibrationResult,
    calibrations: Mapping[str, FluoroscopeCalibration],
) -> str:
    """Return a sentence on the fluoroscopes whose image points are corrected already, else ''.

    without: the adjustment with the `uncorrected` calibrations, which fits their exposures.
    """
    fit = misfits(without, calibrations)
    names = [name for name in misfits(result, calibrations) if name not in fit]
    if not names:
        return ''
    one, other = (
        max(_rmse(found.fluoroscopes[name].rmse_after) for name in names)
        for found in (result, without)
    )
    return (
        f'fluoroscope{"s" * (len(names) > 1)} {", ".join(names)}: the image points are corrected '
        f'already, their RMSE is {one:.2f} px with the correction and {other:.2f} px without: '
        'give the observed ones'
    )


def _rmse(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def held_doubts(
    result: CalibrationResult, calibrations: Mapping[str, FluoroscopeCalibration]
) -> list[str]:
    """Return a sentence for every fluoroscope whose exposures its calibration does not fit."""
    out = []
    for name, figures in result.fluoroscopes.items():
        after = _rmse(figures.rmse_after)
        noise = calibrations[name].image_sd
        if after <= MAX_NOISE * noise:
            continue
        before = _rmse(figures.rmse_before)
        cause = 'the image has changed, or the calibration is that of another fluoroscope'
        if before < CORRECTED * after:
            cause = 'the image points seem to be corrected already'
        out.append(
            f'fluoroscope {name}: RMSE {after:.2f} px with the calibration held, '
            f'{after / noise:.1f} times the noise with which it was determined: {cause}'
        )
    return out
