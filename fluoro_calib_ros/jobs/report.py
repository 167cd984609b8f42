# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The report job: read a result folder and write DIR/report.html."""

from __future__ import annotations

import os
from collections.abc import Mapping
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import UndefinedError

from ..errors import DataError
from ..files.atomic import write_text
from ..files.calibration import load_calibrations
from ..files.calibration_request import OPTIONS, read_request
from ..files.json_file import read_json
from ..files.names import read_names
from ..files.result_check import edited, exchanged
from ..files.validation import NAME as VALIDATION
from ..report.html import ReportInput, report_html
from .result_folder import REPORT, RESULT, belongs_to, saved_orientation, saved_rig_note


def write_report(directory: str | os.PathLike[str]) -> str:
    """Write DIR/report.html from the result folder of a calibration, and return its path.

    Raises DataError for a folder that is not the result of a calibration, and where the file
    cannot be written.
    """
    path = Path(directory) / REPORT
    given = read_report_input(directory)
    try:
        with np.errstate(all='ignore'):  # giant numbers of a damaged result
            text = report_html(given)
    except DataError:
        raise
    except (
        ArithmeticError,
        AttributeError,
        IndexError,
        KeyError,
        TypeError,
        UndefinedError,
        ValueError,
    ) as error:
        raise DataError(
            f'{Path(directory) / RESULT}: this is not the result of a calibration ({error})'
        ) from None
    write_text(path, text)
    return str(path)


def read_report_input(directory: str | os.PathLike[str]) -> ReportInput:
    """Read what the report of a result folder needs. Raises DataError."""
    directory = Path(directory)
    calibrations = load_calibrations(directory)
    result = read_json(directory / RESULT)
    if not isinstance(result.get('fluoroscopes'), Mapping) or 'targets' not in result:
        raise DataError(f'{directory / RESULT}: this is not the result of a calibration')
    present = {name: c for name, c in calibrations.items() if name in result['fluoroscopes']}
    if not present:
        raise DataError(f'{directory / RESULT}: there are no figures of {", ".join(calibrations)}')
    mixed = exchanged(directory, result, present)
    if mixed:
        raise DataError(mixed)
    request = read_request(directory, present)
    orientation = saved_orientation(directory)
    if orientation is not None and not belongs_to(orientation, calibrations):
        orientation = None
    when = datetime.fromtimestamp((directory / RESULT).stat().st_mtime, timezone.utc)
    return ReportInput(
        directory.resolve().name,
        result,
        present,
        request.frames,
        request.phantom,
        read_json(directory / OPTIONS),
        _validation(directory, {n: c.calibration_id for n, c in present.items()}),
        orientation,
        read_names(directory),
        when.strftime('%Y-%m-%d %H:%M UTC'),
        saved_rig_note(directory),
        edited(directory, result),
    )


def _validation(directory: Path, ids: Mapping[str, str]) -> dict[str, Any] | None:
    """Return the verdict in a folder, None where there is none on these calibrations."""
    path = directory / VALIDATION
    if not path.exists():
        return None
    document = read_json(path)
    return document if document.get('calibration_id') == ids else None
