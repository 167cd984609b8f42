# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Files of a rig next to its calibrations: versions, drift alarm, learned shapes.

A version is a folder with calibrations and orientation, named after the orientation id. A healed
version contains healing.json, which names its parent.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from ..bodies.body import Body, check_bodies
from ..bodies.shapes import LearnedShapes
from ..errors import DataError, ErrorsAt
from ..photogrammetry.rig_orientation import RigOrientation
from .access import PathLike
from .calibration import edited, load_orientation, orientation_path, with_digest
from .documents import read_json, write_json

VERSIONS = 'versions'  # folder in the folder of the calibrations
HEALING = 'healing.json'


def version_folder(directory: Path, orientation_id: str) -> Path:
    """Return the folder of a version of the rig."""
    return directory / VERSIONS / orientation_id


def parent_folder(directory: Path, orientation: RigOrientation | None) -> Path:
    """Return the folder with the parent of a healed rig. Raises DataError if there is none."""
    if orientation is None or orientation.source != 'healing':
        raise DataError('the rig in use was not healed, there is nothing to roll back')
    document = read_json(version_folder(directory, orientation.orientation_id) / HEALING)
    parent = document.get('parent_orientation_id')
    if not isinstance(parent, str) or not parent or Path(parent).name != parent:
        raise DataError(f'{orientation.orientation_id}: its {HEALING} names no parent')
    return version_folder(directory, parent)


def calibrated_orientation(directory: Path, orientation: RigOrientation) -> RigOrientation | None:
    """Return the orientation that a rig had before it was healed, None if unknown.

    An orientation that was not healed is returned unchanged.
    """
    ancestor = orientation
    ids: set[str] = set()
    while ancestor.source == 'healing':
        if ancestor.orientation_id in ids:  # edited files may form a cycle
            return None
        ids.add(ancestor.orientation_id)
        try:
            ancestor = load_orientation(orientation_path(parent_folder(directory, ancestor)))
        except DataError:
            return None
    return ancestor


# Alarm of the drift watch: drift_alarm.json next to the calibrations concerned.

DRIFT_ALARM = 'drift_alarm.json'


def write_drift_alarm(directory: PathLike, orientation_id: str, cause: str) -> None:
    """Record that the drift watch has raised an alarm on an orientation. Raises DataError."""
    document = {'version': 1, 'orientation_id': orientation_id, 'cause': cause}
    write_json(Path(directory) / DRIFT_ALARM, document)


def has_drift_alarm(directory: PathLike, orientation_id: str) -> bool:
    """Return whether an alarm was raised on an orientation. Raises DataError."""
    path = Path(directory) / DRIFT_ALARM
    return os.path.exists(path) and read_json(path).get('orientation_id') == orientation_id


# Shapes of bodies learned by a healthy rig: learned_shapes.json next to its calibrations.

LEARNED_SHAPES = 'learned_shapes.json'
VERSION = 1  # version of learned_shapes.json


def write_learned_shapes(directory: PathLike, learned: LearnedShapes) -> None:
    """Write learned shapes into a folder; reading restores the same values. Raises DataError."""
    bodies = [
        {
            'body': body.name,
            'marker': body.target_id,
            'xyz_mm': body.xyz_mm,
            'sd_mm': body.sd_mm,
            'covariance_mm2': body.covariance_mm2,
        }
        for body in learned.bodies
    ]
    document = {
        'version': VERSION,
        'orientation_ids': learned.orientation_ids,
        'calibration_ids': learned.calibration_ids,
        'begin_ns': learned.begin_ns,
        'end_ns': learned.end_ns,
        'exposures': learned.exposures,
        'bodies': bodies,
    }
    write_json(Path(directory) / LEARNED_SHAPES, with_digest(document))


def read_learned_shapes(directory: PathLike) -> LearnedShapes:
    """Read the learned shapes of a folder. Raises DataError, also for an edited file."""
    path = Path(directory) / LEARNED_SHAPES
    document = read_json(path)
    if document.get('version') != VERSION:
        raise DataError(
            f'{path}: version {document.get("version")} of learned shapes is not known, only '
            f'{VERSION}'
        )
    finding = edited(directory, document, LEARNED_SHAPES)
    if finding is not None:
        raise DataError(finding)
    with ErrorsAt(path):
        try:
            learned = LearnedShapes(
                bodies=tuple(_body(entry) for entry in document['bodies']),
                orientation_ids=tuple(document['orientation_ids']),
                calibration_ids=dict(document['calibration_ids']),
                begin_ns=int(document['begin_ns']),
                end_ns=int(document['end_ns']),
                exposures=int(document['exposures']),
            )
        except DataError:
            raise
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(f'this is not a file of learned shapes ({error})') from None
        check_bodies(learned.bodies)
    return learned


def _body(document: Any) -> Body:
    """Return a body. Raises DataError, KeyError, TypeError and ValueError."""
    markers = np.array(document['marker'], dtype=np.int64)
    size = 3 * len(markers)
    covariance = np.array(document['covariance_mm2'], dtype=float)
    if covariance.shape != (size, size) or not np.isfinite(covariance).all():
        raise DataError(f'the covariance of {document["body"]} is not {size} x {size} numbers')
    return Body(
        str(document['body']),
        markers,
        np.array(document['xyz_mm'], dtype=float),
        np.array(document['sd_mm'], dtype=float),
        covariance_mm2=covariance,
    )
