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
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..calibration.result import FluoroscopeCalibration
from ..errors import DataError
from .access import PathLike
from .json_file import read_json, to_json_values

NAME = 'result.json'
DIGEST = 'digest'


def with_digest(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return a document with the digest of its content as the last member."""
    return {**document, DIGEST: _digest(document)}


def disagreements(
    directory: PathLike, calibrations: Mapping[str, FluoroscopeCalibration]
) -> list[str]:
    """Return a sentence for everything in result.json that contradicts the calibrations beside it.

    There are none without result.json. A file that cannot be read is one.
    """
    try:
        document = read_result(directory)
    except DataError as error:
        return [str(error)]
    found = (exchanged(directory, document, calibrations), edited(directory, document))
    return [sentence for sentence in found if sentence]


def read_result(directory: PathLike) -> dict[str, Any]:
    """Read result.json of a folder, {} where there is none. Raises DataError."""
    path = Path(directory) / NAME
    return read_json(path) if path.exists() else {}


def exchanged(
    directory: PathLike,
    document: Mapping[str, Any],
    calibrations: Mapping[str, FluoroscopeCalibration],
) -> str:
    """Return a sentence where calibrations of a folder are not those of its result.json, else ''.

    document is the content of result.json. Fluoroscopes that it does not have are not compared.
    """
    entries = document.get('fluoroscopes')
    if not isinstance(entries, Mapping):
        return ''
    wrong = []
    for name, calibration in calibrations.items():
        entry = entries.get(name)
        stated = entry.get('calibration_id') if isinstance(entry, Mapping) else None
        if stated is not None and stated != calibration.calibration_id:
            wrong.append(name)
    if not wrong:
        return ''
    one = len(wrong) == 1
    return (
        f'{directory}: the calibration file{"s" * (not one)} of {", ".join(wrong)} and {NAME} are '
        f'of different calibrations: one of them was exchanged; restore the files of one '
        'calibration, or calibrate again'
    )


def edited(directory: PathLike, document: Mapping[str, Any]) -> str:
    """Return a sentence where result.json was changed after it was written, '' else."""
    if DIGEST not in document:
        return ''
    content = {key: value for key, value in document.items() if key != DIGEST}
    if document[DIGEST] == _digest(content):
        return ''
    return (
        f'{Path(directory) / NAME}: the file was changed after it was written, its figures need '
        'not be those of the calibration: restore it, or calibrate again'
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
