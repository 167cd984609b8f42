# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""An alarm of the drift watch: drift_alarm.json beside the calibrations that it is about."""

from __future__ import annotations

import os
from pathlib import Path

from .access import PathLike
from .documents import read_json, write_json

DRIFT_ALARM = 'drift_alarm.json'


def write_drift_alarm(directory: PathLike, orientation_id: str, cause: str) -> None:
    """Write that the drift watch has given an alarm of an orientation. Raises DataError."""
    document = {'version': 1, 'orientation_id': orientation_id, 'cause': cause}
    write_json(Path(directory) / DRIFT_ALARM, document)


def has_drift_alarm(directory: PathLike, orientation_id: str) -> bool:
    """Return whether there was an alarm of an orientation. Raises DataError."""
    path = Path(directory) / DRIFT_ALARM
    return os.path.exists(path) and read_json(path).get('orientation_id') == orientation_id
