# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The result folder of a calibration; its layout is described in docs/files.md."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from ..bodies.shapes import LearnedShapes
from ..checks.check import Check
from ..checks.inputs import shared_exposures
from ..checks.residual_tests import doubtful_observations
from ..correction.fluoroscope_calibration import Calibrations
from ..errors import DataError
from ..estimation.result import CalibrationResult
from ..exposures.frame import Frames
from ..exposures.names import Names
from ..findings import Finding, Kind, Place, Severity
from ..io import csv_table as names
from ..io.access import PathLike, read_bytes, write_bytes
from ..io.calibration import (
    KNOWN_ORIENTATION,
    OBSERVATIONS,
    OPTIONS,
    PHANTOM,
    SUFFIX,
    VALIDATION_NAME,
    load_calibrations,
    load_orientation,
    orientation_path,
    read_result,
    save_calibration,
    save_orientation,
)
from ..io.calibration import ORIENTATION_NAME as ORIENTATION
from ..io.calibration import RESULT_NAME as RESULT
from ..io.calibration_request import RADIOGRAPHS, read_calibrated_frames, write_request
from ..io.decisions import DOUBTFUL, doubtful_table
from ..io.documents import write_json
from ..io.folder import PREVIOUS, FolderKind, check_output_folder, replaced_folder
from ..io.result_document import NAMES as TABLES
from ..io.result_document import SUFFIX as COVARIANCE
from ..io.result_document import result_document, result_tables, write_covariance, write_validation
from ..io.versions import version_folder, write_learned_shapes
from ..photogrammetry.rig_orientation import RigOrientation
from .calibration import CalibrationOutcome
from .healing import HealingOutcome, save_healing

REPORT = 'report.html'
REPORT_PDF = 'report.pdf'
# Calibrations are not listed as parts, so those of other fluoroscopes stay in the folder.
RESULT_FOLDER = FolderKind(
    'a result folder',
    parts=(
        *(RESULT, OBSERVATIONS, PHANTOM, OPTIONS, KNOWN_ORIENTATION),
        *(ORIENTATION, ORIENTATION + PREVIOUS),
        *(names.NAMES_FILE, VALIDATION_NAME, *TABLES, DOUBTFUL, f'*{COVARIANCE}'),
        *('figures', RADIOGRAPHS, REPORT, REPORT_PDF),
    ),
    marks=(RESULT, ORIENTATION, f'*{SUFFIX}'),
)


def save_outcome(
    directory: PathLike,
    outcome: CalibrationOutcome,
    present: RigOrientation | None = None,
    write_more: Callable[[Path], object] | None = None,
) -> RigOrientation | None:
    """Write the outcome of a calibration job as a result folder, which replaces an earlier one.

    Writes the calibrations, result.json and its tables, the sources (observations, phantom,
    options), the orientation of the rig and the validation, if there is one. The folder is
    replaced as a whole, and the earlier one is kept as DIRECTORY.previous.

    Parameters
    ----------
    directory : path-like
    outcome : CalibrationOutcome
    present : RigOrientation, optional
        Orientation in use; by default the one in the folder.
    write_more : callable, optional
        Called with the new folder, to write further files, such as figures.

    Returns
    -------
    RigOrientation or None
        The orientation to use with the new calibrations, see `kept_orientation`.

    Raises
    ------
    DataError
        If the folder cannot be written, or is not a result folder; it is then unchanged.
    """
    orientation = kept_orientation(
        present or saved_orientation(directory), outcome.orientation, outcome.calibrations
    )
    with replaced_folder(directory, RESULT_FOLDER) as folder:
        checks = outcome.validation.checks if outcome.validation else ()
        _write_result(folder, outcome.result, outcome.request.names, checks)
        write_request(folder, outcome.request)
        if orientation is not None:
            save_orientation(folder, orientation)
        if outcome.validation is not None:
            write_validation(folder, outcome.validation)
        if write_more is not None:
            write_more(folder)
    return orientation


def save_result(
    directory: PathLike,
    result: CalibrationResult,
    covariance: bool = False,
) -> None:
    """Write calibrations and result.json of a calibration or adjustment as a result folder.

    covariance: whether to also write the covariance matrix of all unknowns. An earlier folder is
    replaced as a whole and kept as DIRECTORY.previous. Raises DataError.
    """
    with replaced_folder(directory, RESULT_FOLDER) as folder:
        _write_result(folder, result)
        if covariance:
            write_covariances(folder, result)


def write_covariances(folder: Path, result: CalibrationResult) -> None:
    """Write the covariance matrix of all unknowns of each adjustment of a result into a folder.

    Raises DataError.
    """
    for label, solved in result.solved.items():
        write_covariance(folder / f'{label}{COVARIANCE}', solved.joint_precision())


def save_calibrations(
    directory: PathLike, calibrations: Calibrations, orientation: RigOrientation | None
) -> None:
    """Write calibrations and the orientation of the rig as a result folder.

    If the folder already contains these calibrations, only the orientation is written. Otherwise
    the folder is replaced as a whole and kept as DIRECTORY.previous. Raises DataError.
    """
    check_output_folder(directory, RESULT_FOLDER)
    if _saved_ids(directory, calibrations) == [c.calibration_id for c in calibrations.values()]:
        if orientation is not None:
            save_orientation(directory, orientation)
        return
    with replaced_folder(directory, RESULT_FOLDER) as folder:
        for calibration in calibrations.values():
            save_calibration(folder, calibration)
        if orientation is not None:
            save_orientation(folder, orientation)


def replace_orientation(directory: PathLike, orientation: RigOrientation) -> str:
    """Write an orientation into a result folder; keep another one as the previous file.

    Returns the path. Raises DataError.
    """
    saved = saved_orientation(directory)
    if saved is not None and saved.orientation_id != orientation.orientation_id:
        path = orientation_path(directory)
        write_bytes(path + PREVIOUS, read_bytes(path))
    return save_orientation(directory, orientation)


def save_healed_version(
    directory: Path,
    outcome: HealingOutcome,
    calibrations: Calibrations,
    parent: RigOrientation,
    learned: LearnedShapes,
) -> None:
    """Save a healed rig as a version next to its parent, and as the rig to be used.

    The parent is written first and the rig to be used last, so that a failure in between leaves
    the parent in use. calibrations, parent: the rig before healing. learned: the shapes by which
    it was healed. Raises DataError.
    """
    healed_id = outcome.orientation.orientation_id
    save_calibrations(version_folder(directory, parent.orientation_id), calibrations, parent)
    save_healing(version_folder(directory, healed_id), outcome, parent, learned)
    write_learned_shapes(directory, learned.with_healed(healed_id))
    save_calibrations(directory, {**calibrations, **outcome.calibrations}, outcome.orientation)


def _write_result(
    folder: Path,
    result: CalibrationResult,
    known: Names | None = None,
    checks: Sequence[Check] = (),
) -> None:
    for calibration in result.calibrations.values():
        save_calibration(folder, calibration)
    write_json(folder / RESULT, result_document(result))
    for name, table in result_tables(result).items():
        table.write(folder / name)
    doubtful = doubtful_observations(result, checks)
    if doubtful:
        doubtful_table(doubtful, known).write(folder / DOUBTFUL)


def _saved_ids(directory: PathLike, calibrations: Calibrations) -> list[str]:
    """Return the ids of the saved calibrations of these fluoroscopes, none if unreadable."""
    try:
        saved = load_calibrations(directory)
    except DataError:
        return []
    return [saved[name].calibration_id for name in calibrations if name in saved]


def reused_exposures(
    directory: PathLike, calibrations: Calibrations, frames: Frames
) -> Finding | None:
    """Return a warning if frames are among those that the calibrations of a folder were made from.

    None, too, if the folder does not contain the latter.
    """
    try:
        earlier = read_calibrated_frames(Path(directory), calibrations)
    except DataError:
        return None
    used = {name: shared_exposures(earlier.get(name, ()), own) for name, own in frames.items()}
    count = max(map(len, used.values()), default=0)
    if not count:
        return None
    return Finding(
        Kind.REUSED_EXPOSURES,
        f'{count} of {max(map(len, frames.values()))} exposures were used for the calibration',
        Place(tuple(name for name, pairs in used.items() if pairs), name=''),
        'they do not show how accurate it is with others: record exposures that it has not used',
        Severity.WARNING,
        numbers={'exposures': count},
    )


def saved_orientation(directory: PathLike) -> RigOrientation | None:
    """Return the orientation in a folder, None if there is no valid one."""
    try:
        return load_orientation(orientation_path(directory))
    except DataError:
        return None


def saved_rig_note(directory: PathLike) -> Finding | None:
    """Return the finding in result.json on the orientation of the rig from the exposures.

    None if there is no finding, or if the orientation in the folder was captured, to which the
    exposures do not contribute. Raises DataError for a file that cannot be read.
    """
    note = read_result(directory).get('rig_note', '')
    orientation = saved_orientation(directory)
    captured = orientation is not None and orientation.source == 'capture'
    if not note or not isinstance(note, str) or captured:
        return None
    return Finding(Kind.RIG_NOTE, note, severity=Severity.WARNING)


def belongs_to(orientation: RigOrientation, calibrations: Calibrations) -> bool:
    """Return whether an orientation was determined with these calibrations."""
    return orientation.calibration_ids == tuple(
        calibrations[name].calibration_id if name in calibrations else ''
        for name in orientation.fluoroscopes
    )


def kept_orientation(
    present: RigOrientation | None, new: RigOrientation | None, calibrations: Calibrations
) -> RigOrientation | None:
    """Choose between the current orientation of a rig and that of new calibrations.

    The current one is kept if it belongs to the calibrations, and if there is no new one or it was
    captured in the laboratory frame, which the exposures of a calibration do not determine.
    """
    is_valid = present is not None and belongs_to(present, calibrations)
    if present is not None and is_valid and (new is None or present.source == 'capture'):
        return present
    return new
