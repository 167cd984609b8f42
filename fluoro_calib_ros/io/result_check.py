# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Whether result.json and the calibration files in its folder belong together.

result.json names the calibrations that it is about by their ids, which are digests of their
content, and has a digest of its own content. Those of earlier versions have neither, and agree
with everything.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..correction.fluoroscope_calibration import FluoroscopeCalibration
from ..errors import DataError
from ..exposures.frame import Frame
from ..findings import Finding, Kind, Place, Severity
from .access import PathLike
from .documents import read_json
from .text_files import to_json_values

Frames = Mapping[str, Sequence[Frame]]

RESULT_NAME = 'result.json'
DIGEST = 'digest'


def with_digest(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return a document with the digest of its content as the last member."""
    return {**document, DIGEST: _digest(document)}


def disagreements(
    directory: PathLike, calibrations: Mapping[str, FluoroscopeCalibration]
) -> list[Finding]:
    """Return a finding for everything in result.json that contradicts the calibrations beside it.

    There are none without result.json. A file that cannot be read is one.
    """
    try:
        document = read_result(directory)
    except DataError as error:
        return [error.finding]
    found = (exchanged(directory, document, calibrations), edited(directory, document))
    return [one for one in found if one is not None]


def read_result(directory: PathLike) -> dict[str, Any]:
    """Read result.json of a folder, {} where there is none. Raises DataError."""
    path = Path(directory) / RESULT_NAME
    return read_json(path) if path.exists() else {}


def used_exposures(document: Mapping[str, Any], frames: Frames) -> dict[str, set[int]]:
    """Return the numbers of the exposures that were used, by fluoroscope.

    document is the content of result.json. Where it does not tell, all frames were used.
    """
    entries = document.get('fluoroscopes')
    out = {name: {int(frame.number) for frame in of_one} for name, of_one in frames.items()}
    for name, numbers in out.items():
        entry = entries.get(name) if isinstance(entries, Mapping) else None
        rows = entry.get('exposures') if isinstance(entry, Mapping) else None
        if isinstance(rows, list):
            used = {row.get('exposure') for row in rows if isinstance(row, Mapping)}
            out[name] = numbers & used or numbers
    return out


def exchanged(
    directory: PathLike,
    document: Mapping[str, Any],
    calibrations: Mapping[str, FluoroscopeCalibration],
) -> Finding | None:
    """Return a finding where calibrations of a folder are not those of its result.json.

    document is the content of result.json. Fluoroscopes that it does not have are not compared.
    """
    entries = document.get('fluoroscopes')
    if not isinstance(entries, Mapping):
        return None
    wrong = []
    for name, calibration in calibrations.items():
        entry = entries.get(name)
        stated = entry.get('calibration_id') if isinstance(entry, Mapping) else None
        if stated is not None and stated != calibration.calibration_id:
            wrong.append(name)
    if not wrong:
        return None
    return Finding(
        Kind.EXCHANGED_CALIBRATION,
        f'the calibration file{"s" * (len(wrong) > 1)} of {", ".join(wrong)} and '
        f'{RESULT_NAME} are of different calibrations',
        Place(tuple(wrong), name=str(directory)),
        'one of them was exchanged; restore the files of one calibration, or calibrate again',
        Severity.WARNING,
    )


def edited(directory: PathLike, document: Mapping[str, Any]) -> Finding | None:
    """Return a finding where result.json was changed after it was written."""
    if DIGEST not in document:
        return None
    content = {key: value for key, value in document.items() if key != DIGEST}
    if document[DIGEST] == _digest(content):
        return None
    return Finding(
        Kind.EDITED_RESULT,
        'the file was changed after it was written, its figures need not be those of the '
        'calibration',
        Place(name=str(Path(directory) / RESULT_NAME)),
        'restore it, or calibrate again',
        Severity.WARNING,
    )


def _digest(content: Mapping[str, Any]) -> str:
    """SHA-256 (hex) of the values of a document, however they are laid out as text."""
    text = json.dumps(_plain(to_json_values(content)), sort_keys=True, separators=(',', ':'))
    return hashlib.sha256(text.encode()).hexdigest()


def _plain(value: Any) -> Any:
    """Return a value with floats for whole numbers, which some programs do not tell apart."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    return value
