# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""study.toml: a calibration and the trials that it serves, for `fluoro-calib process`.

    trials = ["trials/*"]         # recordings: bags, files of image points, or radiographs
    out = "results"               # folder of all results

    [calibrate]                   # options of fluoro-calib calibrate
    source = "calibration"
    phantom = "phantom.csv"

    [reconstruct]                 # options of fluoro-calib reconstruct

    [bodies]                      # options of fluoro-calib bodies
    bodies = "bodies.csv"
    joints = "joints.toml"

    [convert.c3d]                 # options of fluoro-calib convert, for the points of each trial
    rate = 250

`calibration = "DIR"`, a result folder of calibrate, may stand in place of [calibrate]; a table
[extract] is for trials that are radiographs. All paths are relative to the folder of the file.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import DataError
from .documents import read_toml

NAME = 'study.toml'
OUT = 'results'
OF_TRIALS = ('extract', 'reconstruct', 'bodies')  # commands, in their order
CONVERT = 'convert'  # a table of tables: one for each format
CALIBRATE = 'calibrate'
SOURCE = 'source'
MAX_TRIALS = 10_000  # of a study
Options = Mapping[str, Any]


@dataclass(frozen=True)
class Trial:
    """A recording of a study."""

    name: str  #: its path in the study, without the ending of a file
    path: Path  #: relative to the folder of the study


@dataclass(frozen=True)
class StudyFile:
    """Content of a study.toml."""

    path: Path
    folder: Path  #: of the file, to which all paths are relative
    out: Path
    calibration: Path  #: result folder
    trials: tuple[Trial, ...]
    calibrate: Options | None  #: None: the calibration exists
    commands: Mapping[str, Options]  #: options by command, in the order of OF_TRIALS
    convert: Mapping[str, Options]  #: options by format


def read_study(path: Path) -> StudyFile:
    """Read a study.toml, or that of a folder. Raises DataError that names file and key."""
    path = path / NAME if path.is_dir() else path
    document = read_toml(path)
    keys = ('trials', 'out', 'calibration', CALIBRATE, *OF_TRIALS, CONVERT)
    for key in document:
        if key not in keys:
            raise DataError(f'{path}, key {key}: unknown, there are {", ".join(keys)}')
    tables = {key: _table(path, key, document[key]) for key in keys[3:] if key in document}
    out = _relative_path(path, 'out', document.get('out', OUT))
    if 'calibration' in document:
        calibration = _relative_path(path, 'calibration', document['calibration'])
    else:
        calibration = out / 'calibration'
    if (CALIBRATE in tables) == ('calibration' in document):
        raise DataError(
            f'{path}: give either a table [{CALIBRATE}] or the key calibration, a result folder'
        )
    if CALIBRATE in tables and SOURCE not in tables[CALIBRATE]:
        raise DataError(f'{path}, table {CALIBRATE}: the key {SOURCE} is missing')
    commands = {name: tables[name] for name in OF_TRIALS if name in tables}
    convert = {
        kind: _table(path, f'{CONVERT}.{kind}', options)
        for kind, options in tables.get(CONVERT, {}).items()
    }
    if convert and 'reconstruct' not in commands:
        raise DataError(f'{path}, table {CONVERT}: there are no points without [reconstruct]')
    return StudyFile(
        path,
        path.parent,
        out,
        calibration,
        trials=_trials(path, document.get('trials'), out),
        calibrate=tables.get(CALIBRATE),
        commands=commands,
        convert=convert,
    )


def _table(path: Path, key: str, value: Any) -> Options:
    if not isinstance(value, dict):
        raise DataError(f'{path}, key {key}: a table of options, such as [{key}]')
    return value


def _relative_path(path: Path, key: str, value: Any) -> Path:
    if not isinstance(value, str) or not value or '\0' in value:
        raise DataError(f'{path}, key {key}: a path is a text, such as "{OUT}"')
    return Path(value)


def _trials(path: Path, patterns: Any, out: Path) -> tuple[Trial, ...]:
    """Return the recordings of all patterns, in order. Raises DataError."""
    valid = isinstance(patterns, list) and all(isinstance(p, str) and p for p in patterns)
    if not valid or not patterns:
        raise DataError(f'{path}, key trials: paths or patterns, such as ["trials/*"]')
    found: dict[str, Trial] = {}
    for pattern in patterns:
        for trial in _matching(path, pattern, out):
            other = found.setdefault(trial.name, trial)
            if other.path != trial.path:
                raise DataError(
                    f'{path}, key trials: {other.path} and {trial.path} would have the same '
                    f'results; name one of them, or move it to a folder of its own'
                )
    if len(found) > MAX_TRIALS:
        raise DataError(f'{path}, key trials: {len(found)} trials, more than {MAX_TRIALS}')
    return tuple(found.values())


def _matching(path: Path, pattern: str, out: Path) -> Sequence[Trial]:
    """Return the recordings of a pattern; results are none, and hidden files neither."""
    folder = path.parent
    if Path(pattern).is_absolute():
        raise DataError(f'{path}, key trials: {pattern!r} is not relative to the study')
    try:
        paths = sorted(folder.glob(pattern))
    except (ValueError, OSError) as error:
        raise DataError(f'{path}, key trials: {pattern!r} is no pattern ({error})') from None
    trials = []
    for one in paths:
        relative = one.relative_to(folder)
        parts = relative.parts
        if '..' in parts or any(part.startswith('.') for part in parts):
            continue
        if parts[: len(out.parts)] != out.parts:
            name = relative if one.is_dir() else relative.with_suffix('')
            trials.append(Trial(name.as_posix(), relative))
    if not trials:
        raise DataError(f'{path}, key trials: nothing in the study matches {pattern!r}')
    return trials
