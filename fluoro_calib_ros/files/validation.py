# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The verdict on a calibration as JSON: validation.json in its folder (docs/verdict.md)."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from ..errors import DataError
from ..validation.check import Validation
from .access import PathLike, os_error_reason
from .json_file import write_json

NAME = 'validation.json'


def validation_document(validation: Validation) -> dict[str, Any]:
    """Return a Validation as the dict of validation.json."""
    return {
        'verdict': validation.verdict,
        'findings': list(validation.findings),
        'checks': [dataclasses.asdict(check) for check in validation.checks],
        'calibration_id': dict(validation.calibration_id),
        'achieved_sd_px': dict(validation.achieved_sd_px),
        'notes': list(validation.notes),
        'seconds': validation.seconds,
    }


def write_validation(directory: PathLike, validation: Validation) -> None:
    """Write validation.json into a folder. Raises DataError."""
    write_json(Path(directory) / NAME, validation_document(validation))


def delete_validation(directory: PathLike) -> None:
    """Delete validation.json from a folder, if it exists. Raises DataError."""
    path = Path(directory) / NAME
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise DataError(f'{path}: cannot be deleted ({os_error_reason(error)})') from None
