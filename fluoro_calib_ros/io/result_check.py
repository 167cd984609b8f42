# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Whether the files in a result folder belong together.

result.json names the calibrations that it is about by their ids, which are digests of their
content, and has a digest of its own content. validation.json, the verdict, has digests of all
files that it is about, and one of these and itself: one over the folder. Those of earlier versions
have none, and agree with everything.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..correction.fluoroscope_calibration import FluoroscopeCalibration
from ..errors import DataError
from ..exposures.frame import Frame
from ..findings import Finding, Kind, Place, Severity
from .access import PathLike, read_bytes
from .calibration import SUFFIX
from .csv_table import NAMES_FILE
from .documents import read_json, to_json_values

Frames = Mapping[str, Sequence[Frame]]

RESULT_NAME = 'result.json'
VALIDATION_NAME = 'validation.json'  # the verdict
OBSERVATIONS = 'observations.csv'
PHANTOM = 'phantom.csv'
OPTIONS = 'options.json'
KNOWN_ORIENTATION = 'known_orientation.yaml'  # only where there are any
DIGEST = 'digest'
FILES = 'files'
# What a verdict is about, beside the calibrations.
_JUDGED = (RESULT_NAME, OBSERVATIONS, PHANTOM, OPTIONS, KNOWN_ORIENTATION, NAMES_FILE)


def with_digest(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return a document with the digest of its content as the last member."""
    return {**document, DIGEST: _digest(document)}


def disagreements(
    directory: PathLike, calibrations: Mapping[str, FluoroscopeCalibration]
) -> list[Finding]:
    """Return a finding for everything in result.json and the verdict that contradicts the files.

    There are none without result.json. A file that cannot be read is one.
    """
    try:
        document = read_result(directory)
        verdict = read_result(directory, VALIDATION_NAME)
    except DataError as error:
        return [error.finding]
    found = (
        exchanged(directory, document, calibrations),
        edited(directory, document),
        changed_since_verdict(directory, verdict),
    )
    return [one for one in found if one is not None]


def read_result(directory: PathLike, name: str = RESULT_NAME) -> dict[str, Any]:
    """Read a document of a folder, {} where there is none. Raises DataError."""
    path = Path(directory) / name
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


def with_digests(
    directory: PathLike, document: Mapping[str, Any], fluoroscopes: Iterable[str]
) -> dict[str, Any]:
    """Return a verdict with the digests of the files that it is about, and one of all.

    Raises DataError for a file that cannot be read.
    """
    names = (*_JUDGED, *(name + SUFFIX for name in fluoroscopes))
    files = {name: _digest_of_file(Path(directory) / name) for name in names}
    return with_digest({**document, FILES: files})


def changed_since_verdict(directory: PathLike, verdict: Mapping[str, Any]) -> Finding | None:
    """Return a finding where a verdict, or a file that it is about, was changed afterwards."""
    found = edited(directory, verdict, VALIDATION_NAME)
    files = verdict.get(FILES)
    if found is not None or not isinstance(files, Mapping):
        return found
    try:
        changed = [n for n in files if _digest_of_file(Path(directory) / n) != files[n]]
    except DataError as error:
        return error.finding
    return _edited(directory, changed[0], 'the verdict is not about it') if changed else None


def _digest_of_file(path: Path) -> str:
    """SHA-256 (hex) of a file, of the values of a JSON document; '' where there is none."""
    if not path.exists():
        return ''
    if path.suffix == '.json':
        return _digest(read_json(path))
    return hashlib.sha256(read_bytes(path)).hexdigest()


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


def edited(
    directory: PathLike, document: Mapping[str, Any], name: str = RESULT_NAME
) -> Finding | None:
    """Return a finding where a document with a digest was changed after it was written."""
    if DIGEST not in document:
        return None
    content = {key: value for key, value in document.items() if key != DIGEST}
    if document[DIGEST] == _digest(content):
        return None
    return _edited(directory, name, 'its figures need not be those of the calibration')


def _edited(directory: PathLike, name: str, consequence: str) -> Finding:
    return Finding(
        Kind.EDITED_RESULT,
        f'the file was changed after it was written, {consequence}',
        Place(name=str(Path(directory) / name)),
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
