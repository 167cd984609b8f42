"""The result folder of a calibration; its layout is described in docs/result_folder.md."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from ..calibration.calibrate import CalibrationResult
from ..calibration.result import FluoroscopeCalibration
from ..errors import DataError
from ..files.calibration import save_calibration
from ..files.calibration_request import write_request
from ..files.json_file import write_json
from ..files.result_document import result_document
from ..files.rig_orientation import load_orientation, orientation_path, save_orientation
from ..files.validation import write_validation
from ..photogrammetry.rig_orientation import RigOrientation
from .calibration import CalibrationOutcome

RESULT = 'result.json'


def save_outcome(
    directory: str | os.PathLike[str],
    outcome: CalibrationOutcome,
    present: RigOrientation | None = None,
) -> RigOrientation | None:
    """Write the outcome of a calibration job into a folder, which is made where it is missing.

    Writes the calibrations, result.json, the sources (observations, phantom, options), the
    orientation of the rig and, where there is one, the validation.

    Parameters
    ----------
    directory : path-like
    outcome : CalibrationOutcome
    present : RigOrientation, optional
        Orientation in use; by default that in the folder.

    Returns
    -------
    RigOrientation or None
        The orientation to use with the new calibrations, see `kept_orientation`.

    Raises
    ------
    DataError
        Where a file cannot be written.
    """
    directory = Path(directory)
    save_result(directory, outcome.result, outcome.doubts)
    write_request(directory, outcome.request)
    saved = saved_orientation(directory)
    orientation = kept_orientation(present or saved, outcome.orientation, outcome.calibrations)
    if orientation is not None and orientation is not saved:
        save_orientation(directory, orientation)
    if outcome.validation is not None:
        write_validation(directory, outcome.validation)
    return orientation


def save_result(
    directory: str | os.PathLike[str], result: CalibrationResult, doubts: Sequence[str] = ()
) -> None:
    """Write calibrations and result.json of a calibration or adjustment.

    doubts are the reasons why a forced calibration cannot be right. Raises DataError.
    """
    directory = Path(directory)
    for calibration in result.calibrations.values():
        save_calibration(directory, calibration)
    write_json(directory / RESULT, {**result_document(result), 'doubts': list(doubts)})


def saved_orientation(directory: str | os.PathLike[str]) -> RigOrientation | None:
    """Return the orientation in a folder, None where there is no valid one."""
    try:
        return load_orientation(orientation_path(directory))
    except DataError:
        return None


def belongs_to(
    orientation: RigOrientation, calibrations: Mapping[str, FluoroscopeCalibration]
) -> bool:
    """Return whether an orientation was determined with these calibrations."""
    return orientation.calibration_ids == tuple(
        calibrations[name].calibration_id if name in calibrations else ''
        for name in orientation.fluoroscopes
    )


def kept_orientation(
    present: RigOrientation | None,
    new: RigOrientation | None,
    calibrations: Mapping[str, FluoroscopeCalibration],
) -> RigOrientation | None:
    """Choose between the present orientation of a rig and that of new calibrations.

    The present one is kept if it belongs to the calibrations, and if there is no new one or it was
    captured in the frame of the lab, which the exposures of a calibration do not determine.
    """
    is_valid = present is not None and belongs_to(present, calibrations)
    if present is not None and is_valid and (new is None or present.source == 'capture'):
        return present
    return new
