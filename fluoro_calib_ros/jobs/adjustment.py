# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The adjustment job: adjust exposures with calibrations held, an out-of-sample test."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from ..calibration.calibrate import CalibrationResult, adjust_with_calibrations
from ..calibration.result import FluoroscopeCalibration
from ..errors import DataError
from ..exposures.frame import Frame
from ..exposures.phantom import Phantom
from ..exposures.strays import frames_without_strays
from ..validation.held_fit import corrected_already, misfits, uncorrected
from ..validation.inputs import require_phantom
from .sources import select_calibrations


def adjust(
    frames: Mapping[str, Sequence[Frame]],
    phantom: Phantom,
    calibrations: Mapping[str, FluoroscopeCalibration],
    loss: str = 'student_t',
) -> CalibrationResult:
    """Adjust exposures of the phantom with interior orientations and corrections held.

    A few image points that are off the image, or not of the phantom, are left out.

    Parameters
    ----------
    frames : mapping of str to sequence of Frame
        Exposures by fluoroscope.
    phantom : Phantom
    calibrations : mapping of str to FluoroscopeCalibration
        At least those of the fluoroscopes in frames.
    loss : {'student_t', 'huber', 'gaussian'}

    Returns
    -------
    CalibrationResult

    Raises
    ------
    DataError
        For a missing calibration, and for frames that do not suffice, cannot be of the phantom, or
        are corrected already.
    """
    used = select_calibrations(calibrations, frames)
    cleaned, strays = frames_without_strays(frames, phantom)
    require_phantom(cleaned, phantom)
    result = adjust_with_calibrations(cleaned, phantom, used, loss)
    if misfits(result, used):
        without = adjust_with_calibrations(cleaned, phantom, uncorrected(used), loss)
        corrected = corrected_already(result, without, used)
        if corrected:
            raise DataError(corrected)
    return replace(result, left_out=(*strays, *result.left_out))
