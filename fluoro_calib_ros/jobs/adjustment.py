"""The adjustment job: adjust exposures with calibrations held, an out-of-sample test."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ..calibration.calibrate import CalibrationResult, adjust_with_calibrations
from ..calibration.result import FluoroscopeCalibration
from ..exposures.frame import Frame
from ..exposures.phantom import Phantom
from .sources import select_calibrations


def adjust(
    frames: Mapping[str, Sequence[Frame]],
    phantom: Phantom,
    calibrations: Mapping[str, FluoroscopeCalibration],
    loss: str = 'student_t',
) -> CalibrationResult:
    """Adjust exposures of the phantom with interior orientations and corrections held.

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
        For a missing calibration, and for frames that do not suffice or do not fit.
    """
    return adjust_with_calibrations(
        frames, phantom, select_calibrations(calibrations, frames), loss
    )
