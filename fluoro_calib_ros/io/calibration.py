# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Calibration files DIR/<fluoroscope>.calibration.npz and the consistency of a result folder.

The files in a result folder must belong together. result.json names its calibrations by their ids,
which are digests of their content, and contains a digest of its own content. validation.json, the
verdict, contains digests of all files that it is about, and a digest of its own content, hence of
the whole folder. Documents of earlier versions have no digests and are accepted.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..correction.calibration_record import FIELDS, VERSION, Field
from ..correction.fluoroscope_calibration import Calibrations, FluoroscopeCalibration
from ..errors import DataError, ErrorsAt
from ..exposures.frame import Frames
from ..findings import Finding, Kind, Place, Severity
from ..limits import MAX_COINCIDENT, read_limits
from ..photogrammetry.rig_orientation import RigOrientation
from .access import PathLike, check_safe_name, make_folder, os_errors, read_bytes
from .arrays import Layout, read_arrays, to_arrays, to_values, write_arrays
from .csv_table import NAMES_FILE
from .documents import read_json, to_json_values

SUFFIX = '.calibration.npz'

LAYOUT = Layout('a calibration', FIELDS, VERSION)


def calibration_path(directory: PathLike, fluoroscope: str) -> str:
    """Return the path of the calibration file of a fluoroscope. Raises DataError for its name."""
    check_safe_name(fluoroscope, directory)
    return os.path.join(directory, fluoroscope + SUFFIX)


def save_calibration(directory: PathLike, calibration: FluoroscopeCalibration) -> str:
    """Write a calibration into a folder, which is created if it does not exist.

    Returns the path. The same calibration gives the same bytes; its `seconds` are not saved.
    Raises DataError if the file cannot be written, or could not be read again; an earlier file is
    then unchanged.
    """
    path = calibration_path(directory, calibration.fluoroscope)
    arrays = validated_arrays(path, calibration.to_values())
    make_folder(directory)
    write_arrays(path, LAYOUT, arrays)
    return path


def validated_arrays(where: object, values: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return the values of a calibration as the arrays that its file contains.

    values: as returned by `FluoroscopeCalibration.to_values`. Raises DataError for a value that a
    calibration cannot have, such as NaN; the message begins with where.
    """
    arrays = to_arrays(where, LAYOUT, values)
    _check_content(where, arrays)
    return arrays


def load_calibration(path: PathLike) -> FluoroscopeCalibration:
    """Read a calibration: equal to the saved one to the last bit, except that its seconds are NaN.

    A file of an earlier version may contain the id that this version computed; the calibration
    gets the id of the current version. Raises DataError for a file that is not a calibration, is
    damaged, or has an unknown layout version.
    """
    return read_with_id(path)[0]


def read_with_id(path: PathLike) -> tuple[FluoroscopeCalibration, str]:
    """Read a calibration as `load_calibration` does; also return the id that its file contains."""
    arrays = read_arrays(path, LAYOUT)
    _check_content(path, arrays)
    values = to_values(arrays)
    identity = values['calibration_id']
    check_safe_name(values['fluoroscope'], path)
    try:
        calibration = FluoroscopeCalibration.from_values(values)
    except ValueError as error:
        raise DataError(f'{path}: {error}') from None
    if identity not in (calibration.calibration_id, calibration.earlier_id):
        raise DataError(
            f'{path}: the content does not belong to its calibration_id {identity}, '
            f'the file was changed'
        )
    return calibration, identity


def load_calibrations(directory: PathLike) -> dict[str, FluoroscopeCalibration]:
    """Read all calibrations in a folder, sorted by fluoroscope.

    Raises DataError if one cannot be read, or if the folder contains none.
    """
    if os.path.isfile(directory):
        raise DataError(f'{directory}: this is a file, not a folder with calibrations')
    if not os.path.exists(directory):
        raise DataError(f'{directory}: there is no such folder')
    with os_errors(directory, 'cannot be read'):
        names = sorted(n for n in os.listdir(directory) if n.endswith(SUFFIX) and n[0] != '.')
    if not names:
        raise DataError(f'{directory}: there is no calibration in this folder (no file *{SUFFIX})')
    calibrations = {}
    for name in names:
        path = os.path.join(directory, name)
        calibration = load_calibration(path)
        expected = calibration.fluoroscope + SUFFIX
        if name != expected:
            raise DataError(
                f'{path}: this is the calibration of fluoroscope {calibration.fluoroscope}, '
                f'its file is called {expected}'
            )
        calibrations[calibration.fluoroscope] = calibration
    return calibrations


def _check_content(where: object, arrays: Mapping[str, Any]) -> None:
    """Raise DataError for training arrays of different lengths, and for values out of range."""
    lengths = {name: len(arrays[name]) for name in ('train_uv', 'train_duv', 'train_exposure')}
    if len(set(lengths.values())) > 1:
        listed = ', '.join(f'{name} {length}' for name, length in lengths.items())
        raise DataError(f'{where}: the training arrays differ in length ({listed})')
    limits = read_limits()
    if lengths['train_uv'] > limits.max_training_points:
        raise DataError(
            f'{where}: {lengths["train_uv"]} training points; the limit is '
            f'{limits.max_training_points}'
        )
    # Points that coincide in single precision: a search tree cannot separate them.
    counts = np.unique(arrays['train_uv'].astype(np.float32), axis=0, return_counts=True)[1]
    if counts.max(initial=0) > MAX_COINCIDENT:
        raise DataError(
            f'{where}: more than {MAX_COINCIDENT} training points coincide in the image'
        )
    c = arrays['interior'][2]
    if c <= 0:
        raise DataError(f'{where}: the principal distance is {c:g} px')
    width, height = arrays['image_size'].tolist()
    if width * height > limits.max_pixels:
        raise DataError(
            f'{where}: the images have {width} x {height} px, those of more than '
            f'{limits.max_image_megapixels} megapixels are not read'
        )


# The file DIR/rig_orientation.npz, described in docs/files.md.

ORIENTATION_NAME = 'rig_orientation.npz'

ORIENTATION_FIELDS = (
    Field('fluoroscope', 'text', ('F',)),
    Field('calibration_id', 'text', ('F',)),
    Field('optical_frame_id', 'text', ('F',)),
    Field('interior', 'float', ('F', 3)),
    Field('rotation', 'float', ('F', 3, 3)),
    Field('position_mm', 'float', ('F', 3)),
    Field('covariance', 'float', ('N', 'N')),
    Field('frame_id', 'text'),
    Field('source', 'text'),
    Field('stamp_ns', 'int'),
    Field('exposures', 'int', minimum=0),
    Field('orientation_id', 'text'),
)
# Array of the file -> attribute of RigOrientation, if their names differ.
_ATTRIBUTES = {
    'fluoroscope': 'fluoroscopes',
    'calibration_id': 'calibration_ids',
    'optical_frame_id': 'optical_frame_ids',
}
ORIENTATION_LAYOUT = Layout('a rig orientation', ORIENTATION_FIELDS, version=1)


def orientation_path(directory: PathLike) -> str:
    """Return the path of the rig orientation in a folder."""
    return os.path.join(directory, ORIENTATION_NAME)


def save_orientation(directory: PathLike, orientation: RigOrientation) -> str:
    """Write an orientation into a folder, which is created if it does not exist.

    Returns the path. The same orientation gives the same bytes. Raises DataError if the file
    cannot be written; an earlier file is then unchanged.
    """
    path = orientation_path(directory)
    for name in orientation.fluoroscopes:
        check_safe_name(name, path)
    values = {
        f.name: getattr(orientation, _ATTRIBUTES.get(f.name, f.name)) for f in ORIENTATION_FIELDS
    }
    arrays = to_arrays(path, ORIENTATION_LAYOUT, values)
    make_folder(directory)
    write_arrays(path, ORIENTATION_LAYOUT, arrays)
    return path


def load_orientation(path: PathLike) -> RigOrientation:
    """Read an orientation, which is equal to the saved one to the last bit.

    If the calibrations next to it were written by an earlier version, the orientation refers to
    them by their current ids, and its own id changes accordingly. Raises DataError for a file that
    is not a rig orientation, is damaged or was changed, or has an unknown layout version, and with
    the reason where a folder has calibrations without an orientation.
    """
    _check_oriented(Path(path))
    values = to_values(read_arrays(path, ORIENTATION_LAYOUT))
    identity = values.pop('orientation_id')
    max_fluoroscopes = read_limits().max_fluoroscopes
    if len(values['fluoroscope']) > max_fluoroscopes:
        raise DataError(
            f'{path}: the orientation has {len(values["fluoroscope"])} fluoroscopes; the limit '
            f'is {max_fluoroscopes}'
        )
    for name in values['fluoroscope'].tolist():
        check_safe_name(name, path)
    with ErrorsAt(path):
        orientation = RigOrientation(
            **{_ATTRIBUTES.get(name, name): value for name, value in values.items()}
        )
    if orientation.orientation_id != identity:
        raise DataError(
            f'{path}: the content does not belong to its orientation_id {identity}, '
            f'the file was changed'
        )
    return replace(orientation, calibration_ids=_present_ids(path, orientation))


def _check_oriented(path: Path) -> None:
    """Raise DataError if a folder has calibrations, but no orientation was determined."""
    folder = path.parent
    if path.name != ORIENTATION_NAME or path.exists() or not any(folder.glob(f'*{SUFFIX}')):
        return
    note = ''
    with suppress(DataError):  # reported where the document is used
        note = read_result(folder).get('rig_note', '')
    raise DataError(
        note if note and isinstance(note, str) else 'no orientation of the rig was determined',
        at=folder,
        kind=Kind.RIG_NOT_ORIENTED,
        advice='calibrate all fluoroscopes from the same exposures, or orient the rig with '
        'fluoro-calib orient',
    )


def _present_ids(path: PathLike, orientation: RigOrientation) -> tuple[str, ...]:
    """Return the calibration ids of an orientation; replace those computed by earlier versions."""
    folder = os.path.dirname(os.path.abspath(path))
    present_ids = []
    for name, identity in zip(orientation.fluoroscopes, orientation.calibration_ids):
        present_id = identity
        calibration_file = calibration_path(folder, name)
        if os.path.isfile(calibration_file):
            with suppress(DataError):  # reported where the calibration is used
                calibration, stored_id = read_with_id(calibration_file)
                present_id = calibration.calibration_id if stored_id == identity else identity
        present_ids.append(present_id)
    return tuple(present_ids)


RESULT_NAME = 'result.json'
VALIDATION_NAME = 'validation.json'  # the verdict
OBSERVATIONS = 'observations.csv'
PHANTOM = 'phantom.csv'
OPTIONS = 'options.json'
KNOWN_ORIENTATION = 'known_orientation.yaml'  # only present if orientations were known
DIGEST = 'digest'
FILES = 'files'
# Files that a verdict is about, in addition to the calibrations.
_JUDGED = (RESULT_NAME, OBSERVATIONS, PHANTOM, OPTIONS, KNOWN_ORIENTATION, NAMES_FILE)


def with_digest(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return a document with the digest of its content as the last member."""
    return {**document, DIGEST: _digest(document)}


def disagreements(directory: PathLike, calibrations: Calibrations) -> list[Finding]:
    """Return a finding for each contradiction between result.json, the verdict and the files.

    A verdict that is fail is one, too. There are none without result.json. A file that cannot be
    read gives a finding.
    """
    try:
        document = read_result(directory)
        verdict = read_result(directory, VALIDATION_NAME)
    except DataError as error:
        return [error.finding]
    findings = (
        exchanged(directory, document, calibrations),
        edited(directory, document),
        changed_since_verdict(directory, verdict) or failed(directory, verdict),
    )
    return [finding for finding in findings if finding is not None]


def read_result(directory: PathLike, name: str = RESULT_NAME) -> dict[str, Any]:
    """Read a JSON document of a folder, {} if there is none. Raises DataError."""
    path = Path(directory) / name
    return read_json(path) if path.exists() else {}


def used_exposures(document: Mapping[str, Any], frames: Frames) -> dict[str, set[int]]:
    """Return the numbers of the exposures that were used, by fluoroscope.

    document is the content of result.json. If it does not list exposures of a fluoroscope, all its
    frames count as used.
    """
    entries = document.get('fluoroscopes')
    numbers_by_name = {
        name: {int(frame.number) for frame in view_frames} for name, view_frames in frames.items()
    }
    for name, numbers in numbers_by_name.items():
        entry = entries.get(name) if isinstance(entries, Mapping) else None
        rows = entry.get('exposures') if isinstance(entry, Mapping) else None
        if isinstance(rows, list):
            used_numbers = {row.get('exposure') for row in rows if isinstance(row, Mapping)}
            numbers_by_name[name] = numbers & used_numbers or numbers
    return numbers_by_name


def with_digests(
    directory: PathLike, document: Mapping[str, Any], fluoroscopes: Iterable[str]
) -> dict[str, Any]:
    """Return a verdict with the digests of the files that it is about, and its own digest.

    Raises DataError for a file that cannot be read.
    """
    names = (*_JUDGED, *(name + SUFFIX for name in fluoroscopes))
    files = {name: _digest_of_file(Path(directory) / name) for name in names}
    return with_digest({**document, FILES: files})


def changed_since_verdict(directory: PathLike, verdict: Mapping[str, Any]) -> Finding | None:
    """Return a finding if a verdict, or a file that it is about, was changed afterwards."""
    finding = edited(directory, verdict, VALIDATION_NAME)
    files = verdict.get(FILES)
    if finding is not None or not isinstance(files, Mapping):
        return finding
    try:
        changed = [n for n in files if _digest_of_file(Path(directory) / n) != files[n]]
    except DataError as error:
        return error.finding
    return _edited(directory, changed[0], 'the verdict does not apply to it') if changed else None


def failed(directory: PathLike, verdict: Mapping[str, Any]) -> Finding | None:
    """Return a finding if a verdict is fail."""
    if verdict.get('verdict') != 'fail':
        return None
    return Finding(
        Kind.FAILED_VERDICT,
        'the verdict on the calibration is fail: its results may be wrong',
        Place(name=str(directory)),
        f'fluoro-calib report {directory} shows the reasons',
        Severity.WARNING,
    )


@dataclass(frozen=True)
class Verdict:
    """Verdict on calibrations: pass, fail or cannot tell; '' if none was made."""

    verdict: str = ''
    findings: tuple[str, ...] = ()  #: reasons for a verdict other than pass
    calibration_id: Mapping[str, str] = field(default_factory=dict)  #: by fluoroscope


def stored_verdict(directory: PathLike) -> Verdict:
    """Return the verdict of a result folder; 'cannot tell' if its files were changed since.

    Raises DataError for a damaged file.
    """
    document = read_result(directory, VALIDATION_NAME)
    if not document:
        return Verdict()
    identity = document.get('calibration_id')
    calibration_ids = (
        {str(k): str(v) for k, v in identity.items()} if isinstance(identity, Mapping) else {}
    )
    changed = changed_since_verdict(directory, document)
    if changed is not None:
        return Verdict('cannot tell', (str(changed),), calibration_ids)
    findings = document.get('findings')
    reasons = tuple(map(str, findings)) if isinstance(findings, list) else ()
    return Verdict(str(document.get('verdict', 'cannot tell')), reasons, calibration_ids)


def rig_verdict(directory: PathLike) -> str:
    """Return the verdict on all calibrations of a folder, 'cannot tell' if it leaves one out."""
    stored = stored_verdict(directory)
    names = {path.name.removesuffix(SUFFIX) for path in Path(directory).glob(f'*{SUFFIX}')}
    if stored.verdict == 'pass' and not names <= set(stored.calibration_id):
        return 'cannot tell'
    return stored.verdict or 'cannot tell'


def _digest_of_file(path: Path) -> str:
    """Return SHA-256 (hex) of a file, or of the values of a JSON document; '' without a file."""
    if not path.exists():
        return ''
    if path.suffix == '.json':
        return _digest(read_json(path))
    return hashlib.sha256(read_bytes(path)).hexdigest()


def exchanged(
    directory: PathLike, document: Mapping[str, Any], calibrations: Calibrations
) -> Finding | None:
    """Return a finding if calibrations of a folder are not those named by its result.json.

    document is the content of result.json. Fluoroscopes that it does not list are not compared.
    """
    entries = document.get('fluoroscopes')
    if not isinstance(entries, Mapping):
        return None
    mismatched = []
    for name, calibration in calibrations.items():
        entry = entries.get(name)
        stated_id = entry.get('calibration_id') if isinstance(entry, Mapping) else None
        if stated_id is not None and stated_id != calibration.calibration_id:
            mismatched.append(name)
    if not mismatched:
        return None
    return Finding(
        Kind.EXCHANGED_CALIBRATION,
        f'the calibration file{"s" * (len(mismatched) > 1)} of {", ".join(mismatched)} and '
        f'{RESULT_NAME} belong to different calibrations',
        Place(tuple(mismatched), name=str(directory)),
        'one of them was replaced; restore the files of one calibration, or calibrate again',
        Severity.WARNING,
    )


def edited(
    directory: PathLike, document: Mapping[str, Any], name: str = RESULT_NAME
) -> Finding | None:
    """Return a finding if a document with a digest was changed after it was written."""
    if DIGEST not in document:
        return None
    content = {key: value for key, value in document.items() if key != DIGEST}
    if document[DIGEST] == _digest(content):
        return None
    return _edited(directory, name, 'its figures may not match the calibration')


def _edited(directory: PathLike, name: str, consequence: str) -> Finding:
    return Finding(
        Kind.EDITED_RESULT,
        f'the file was changed after it was written, {consequence}',
        Place(name=str(Path(directory) / name)),
        'restore it, or calibrate again',
        Severity.WARNING,
    )


def _digest(content: Mapping[str, Any]) -> str:
    """Return SHA-256 (hex) of the values of a document, independent of its layout as text."""
    text = json.dumps(_plain(to_json_values(content)), sort_keys=True, separators=(',', ':'))
    return hashlib.sha256(text.encode()).hexdigest()


def _plain(value: Any) -> Any:
    """Return a value with floats for integers: some programs do not distinguish them."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    return value
