# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The folder with a healed rig: calibrations, orientation, and what was changed and why."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from ..bodies.rig_adjustment import RigErrors
from ..findings import Finding
from ..io.access import PathLike
from ..io.calibration import SUFFIX, save_calibration
from ..io.folder import FolderKind, check_output_folder, replaced_folder
from ..io.rig_orientation import NAME as ORIENTATION
from ..io.rig_orientation import save_orientation
from ..io.text_files import write_json
from ..photogrammetry.rig_orientation import RigOrientation
from .healing import HealingOutcome

HEALING = 'healing.json'
VERSION = 1


def _is_own(name: str) -> bool:
    hidden = name.startswith('.') and name.endswith('.tmp')
    return name in (HEALING, ORIENTATION) or name.endswith(SUFFIX) or hidden


def _marks(name: str) -> bool:
    return name == HEALING


HEALING_FOLDER = FolderKind('a folder of a healed rig', _is_own, _marks)


def check_healing_folder(directory: PathLike, inputs: Iterable[PathLike]) -> None:
    """Raise DataError unless a healed rig may be written to a folder."""
    check_output_folder(directory, HEALING_FOLDER, inputs)


def save_healing(directory: PathLike, outcome: HealingOutcome, parent: RigOrientation) -> None:
    """Write a healed rig, all or nothing. parent: its orientation before. Raises DataError."""
    with replaced_folder(directory, HEALING_FOLDER) as folder:
        for calibration in outcome.calibrations.values():
            save_calibration(folder, calibration)
        save_orientation(folder, outcome.orientation)
        write_json(folder / HEALING, healing_document(outcome, parent))


def healing_document(outcome: HealingOutcome, parent: RigOrientation) -> dict[str, Any]:
    """Return what healing.json contains; docs/bodies.md describes it."""
    return {
        'version': VERSION,
        'orientation_id': outcome.orientation.orientation_id,
        'parent_orientation_id': parent.orientation_id,
        'calibration_ids': dict(
            zip(outcome.orientation.fluoroscopes, outcome.orientation.calibration_ids)
        ),
        'parent_calibration_ids': dict(zip(parent.fluoroscopes, parent.calibration_ids)),
        'verdict': outcome.verdict,
        'exposures': outcome.exposures,
        'noise_factor': outcome.diagnosis.noise,
        'nothing_else_probability': outcome.diagnosis.rest,
        'findings': [_finding(one) for one in outcome.findings],
        'checks': [
            {**_finding(check), 'value': check.value, 'limit': check.limit, 'passed': check.passed}
            for check in outcome.checks
        ],
        'changes': _changes(outcome),
        'errors_before': _errors(outcome.before),
        'errors_after': _errors(outcome.after),
    }


def _finding(finding: Finding) -> dict[str, Any]:
    return {
        'kind': finding.kind.value,
        'fluoroscopes': list(finding.place.fluoroscopes),
        'target_id': list(finding.place.target_id),
        'sentence': str(finding),
        'numbers': dict(finding.numbers),
    }


def _errors(errors: RigErrors) -> dict[str, float]:
    return {'scale_ppm': 1e6 * errors.scale, 'place_mm': errors.place_mm}


def _changes(outcome: HealingOutcome) -> dict[str, Any]:
    """Return the changes of the fluoroscopes that have changed, with their sd."""
    healed = outcome.healed
    if healed is None:
        return {}
    out = {}
    for f, name in enumerate(outcome.orientation.fluoroscopes):
        if not healed.changes[f].any() and f not in healed.drift:
            continue
        value = healed.changes[f]
        sd = healed.sd[f]
        out[name] = {
            'position_mm': value[:3],
            'position_sd_mm': sd[:3],
            'rotation_deg': np.degrees(value[3:6]),
            'rotation_sd_deg': np.degrees(sd[3:6]),
            'principal_point_px': value[6:8],
            'principal_point_sd_px': sd[6:8],
            'principal_distance_px': value[8],
            'principal_distance_sd_px': sd[8],
            'distortion': f in healed.drift,
        }
    return out
