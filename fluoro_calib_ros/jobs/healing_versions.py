# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Healing beside a live stream, and the versions of a rig that it makes in a folder.

A version is a folder with calibrations and orientation, named by the orientation. Those that were
healed contain healing.json, which names their parent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from ..bodies.body import Body
from ..correction.fluoroscope_calibration import Calibrations
from ..errors import DataError
from ..exposures.frame import Frames
from ..io.documents import read_json
from ..photogrammetry.rig_orientation import RigOrientation
from ..processes import OF_JOB, WorkerProcess
from .healing import HEALING, HealingOptions, HealingOutcome, heal_rig, save_healing
from .result_folder import save_calibrations

VERSIONS = 'versions'  # folder below that of the calibrations


def heal_in_worker_process(
    frames: Frames,
    calibrations: Calibrations,
    orientation: RigOrientation,
    bodies: Sequence[Body],
    options: HealingOptions,
    progress: Callable[[int, int], None],
    raise_if_cancelled: Callable[[], None],
) -> HealingOutcome:
    """Run `heal_rig` in another process, so that it does not delay its caller.

    Parameters and errors are those of `heal_rig`. raise_if_cancelled is called repeatedly and may
    raise to terminate the process. Raises RuntimeError for any other failure of the process.
    """
    process = WorkerProcess(_healing, 'the worker process', OF_JOB)
    try:
        return process(
            frames,
            calibrations,
            orientation,
            bodies,
            options,
            progress=progress,
            raise_if_cancelled=raise_if_cancelled,
        )
    finally:
        process.close()


def _healing() -> Callable[..., HealingOutcome]:
    return heal_rig


def version_folder(directory: Path, orientation_id: str) -> Path:
    """Return the folder of a version of the rig."""
    return directory / VERSIONS / orientation_id


def save_healed_version(
    directory: Path, outcome: HealingOutcome, calibrations: Calibrations, parent: RigOrientation
) -> None:
    """Save a healed rig as a version beside its parent, and as the rig to be used.

    The parent comes first and the rig to be used last, so that a failure in between leaves the
    parent in use. calibrations, parent: the rig as it was before. Raises DataError.
    """
    save_calibrations(version_folder(directory, parent.orientation_id), calibrations, parent)
    save_healing(version_folder(directory, outcome.orientation.orientation_id), outcome, parent)
    save_calibrations(directory, {**calibrations, **outcome.calibrations}, outcome.orientation)


def parent_folder(directory: Path, orientation: RigOrientation | None) -> Path:
    """Return the folder with the parent of a healed rig. Raises DataError where there is none."""
    if orientation is None or orientation.source != 'healing':
        raise DataError('the rig in use was not healed, there is nothing to roll back')
    document = read_json(version_folder(directory, orientation.orientation_id) / HEALING)
    parent = document.get('parent_orientation_id')
    if not isinstance(parent, str) or not parent or Path(parent).name != parent:
        raise DataError(f'{orientation.orientation_id}: its {HEALING} names no parent')
    return version_folder(directory, parent)
