# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Versions of a rig below the folder of its calibrations.

A version is a folder with calibrations and orientation, named by the orientation. Those that were
healed contain healing.json, which names their parent.
"""

from __future__ import annotations

from pathlib import Path

from ..errors import DataError
from ..photogrammetry.rig_orientation import RigOrientation
from .calibration import load_orientation, orientation_path
from .documents import read_json

VERSIONS = 'versions'  # folder below that of the calibrations
HEALING = 'healing.json'


def version_folder(directory: Path, orientation_id: str) -> Path:
    """Return the folder of a version of the rig."""
    return directory / VERSIONS / orientation_id


def parent_folder(directory: Path, orientation: RigOrientation | None) -> Path:
    """Return the folder with the parent of a healed rig. Raises DataError where there is none."""
    if orientation is None or orientation.source != 'healing':
        raise DataError('the rig in use was not healed, there is nothing to roll back')
    document = read_json(version_folder(directory, orientation.orientation_id) / HEALING)
    parent = document.get('parent_orientation_id')
    if not isinstance(parent, str) or not parent or Path(parent).name != parent:
        raise DataError(f'{orientation.orientation_id}: its {HEALING} names no parent')
    return version_folder(directory, parent)


def calibrated_orientation(directory: Path, orientation: RigOrientation) -> RigOrientation | None:
    """Return the orientation that a rig had before it was healed, None where that is not known.

    An orientation that was not healed is returned as it is.
    """
    known = orientation
    ids: set[str] = set()
    while known.source == 'healing':
        if known.orientation_id in ids:  # edited files may go round in circles
            return None
        ids.add(known.orientation_id)
        try:
            known = load_orientation(orientation_path(parent_folder(directory, known)))
        except DataError:
            return None
    return known
