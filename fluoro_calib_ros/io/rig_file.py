# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Files in which a lab describes its rig and its studies, as TOML.

rig.toml contains settings that are the same for all commands, which makes flags unnecessary.

    fluoroscopes = ["a", "b"]
    image_size = [1024, 1024]     # width, height [px]
    phantom = "phantom.csv"
    units = "cm"                  # of files that do not state theirs, such as the phantom
    phantom_sd = 0.05             # sd of bead coordinates, if the file has none [mm]
    calibration = "result"        # result folder of calibrate
    angle_joint = "carm"          # joint of the C-arm; or {a = "frontal", b = "lateral"}
    angle_max_age = 0.5           # longest time from its last state to an exposure [s]

    [about]                       # shown in the report of a calibration, otherwise unused
    site = "gait laboratory"
    kV = 80

All keys are optional; paths are relative to the folder of the file.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from ..errors import DataError
from .documents import check_keys, read_toml

NAME = 'rig.toml'
MAX_ABOUT_TEXT = 1000  # maximum length of a key with its text, in characters


@dataclass(frozen=True)
class RigFile:
    """Content of a rig.toml; None for missing keys."""

    path: Path
    fluoroscopes: list[str] | None = None
    image_size: tuple[int, int] | None = None  #: width and height [px]
    #: phantom file, and result folder
    phantom: Path | None = None
    calibration: Path | None = None
    units: str | None = None  #: unit of files that do not state theirs
    phantom_sd: float | None = None  #: sd of bead coordinates [mm], if the file has none
    #: joint of the C-arm, or one for each fluoroscope, in the form of the option of this name
    angle_joint: str | None = None
    #: longest time from the last state of the joint to an exposure [s]
    angle_max_age: float | None = None
    #: information for the report about the rig, such as site, operator, kV and mA
    about: dict[str, str] | None = None


KEYS = tuple(field.name for field in fields(RigFile)[1:])


def read_rig_file(path: Path) -> RigFile:
    """Read a rig.toml. Raises DataError that names file and key."""
    document = read_toml(path)
    check_keys(path, document, KEYS)
    for key, (is_valid, expected) in _EXPECTED.items():
        if key in document and not is_valid(document[key]):
            raise DataError(f'{path}, key {key}: expected {expected}')
    convert: dict[str, Callable[[Any], Any]] = {
        'image_size': tuple,
        'phantom': lambda value: path.parent / _path(path, 'phantom', value),
        'calibration': lambda value: path.parent / _path(path, 'calibration', value),
        'phantom_sd': float,
        'angle_joint': lambda value: _joint(path, value, document.get('fluoroscopes')),
        'angle_max_age': float,
        'about': lambda value: _about(path, value),
    }
    values = {key: convert.get(key, lambda value: value)(document[key]) for key in document}
    return RigFile(path, **values)


def _are_names(value: Any) -> bool:
    valid = isinstance(value, list) and value and all(isinstance(v, str) and v for v in value)
    return bool(valid) and len(set(value)) == len(value)


def _is_size(value: Any) -> bool:
    valid = isinstance(value, list) and all(type(v) is int and v > 0 for v in value)
    return valid and len(value) == 2


def _is_number(value: Any) -> bool:
    return not isinstance(value, bool) and isinstance(value, int | float)


def _is_max_age(value: Any) -> bool:
    """Return whether a value is one of the option angle_max_age."""
    from ..exposures.angles import AngleOptions  # every command loads this module

    try:
        return _is_number(value) and bool(AngleOptions(angle_max_age=float(value)))
    except (ValueError, OverflowError):
        return False


# Test of the value of a key, and what is expected.
_EXPECTED: dict[str, tuple[Callable[[Any], bool], str]] = {
    'fluoroscopes': (_are_names, 'a list of different names, such as ["a", "b"]'),
    'image_size': (_is_size, 'width and height [px], such as [1024, 1024]'),
    'units': (lambda value: value in ('mm', 'cm', 'm'), '"mm", "cm" or "m"'),
    'phantom_sd': (
        lambda value: _is_number(value) and 0 < value <= 100,
        'a standard deviation [mm], such as 0.05',
    ),
    'angle_max_age': (_is_max_age, 'a time [s], such as 0.5'),
    'about': (lambda value: isinstance(value, dict), 'a table of texts and numbers'),
}


def _joint(path: Path, value: Any, names: list[str] | None) -> str:
    """Return the option angle_joint; names: fluoroscopes of the rig, None for any."""
    from ..exposures.angles import joints_by_fluoroscope  # every command loads this module

    where = f'{path}, key angle_joint'
    example = (
        'expected a joint, such as "carm", or one for each fluoroscope, such as {a = "frontal"}'
    )
    if isinstance(value, dict):
        words = [*value, *value.values()]
        if not words or not all(
            isinstance(w, str) and w and not set(w) & set(':,') for w in words
        ):
            raise DataError(f'{where}: {example}')
        value = ','.join(f'{name}:{joint}' for name, joint in value.items())
    if not isinstance(value, str) or not value.strip():
        raise DataError(f'{where}: {example}')
    try:
        joints = joints_by_fluoroscope(value)
    except ValueError:
        raise DataError(f'{where}: {example}') from None
    for name in () if isinstance(joints, str) else joints:
        if names is not None and name not in names:
            raise DataError(f'{where}: there is no fluoroscope {name!r}, only {", ".join(names)}')
    return value.strip()


def _about(path: Path, value: Mapping[str, Any]) -> dict[str, str]:
    """Return texts for the report, by key."""
    for key, text in value.items():
        if not isinstance(text, str | int | float) or len(f'{key}{text}') > MAX_ABOUT_TEXT:
            raise DataError(
                f'{path}, key about.{key}: expected a text or a number, of at most '
                f'{MAX_ABOUT_TEXT} characters with its name'
            )
    return {key: str(text) for key, text in value.items()}


def _path(path: Path, key: str, value: Any, example: str = 'phantom.csv') -> Path:
    if not isinstance(value, str) or not value or '\0' in value:
        raise DataError(f'{path}, key {key}: expected a path, such as "{example}"')
    return Path(value)


# study.toml: a calibration and the trials that use it, for `fluoro-calib process`.
#
#     trials = ["trials/*"]         # recordings: bags, files of image points, or radiographs
#     out = "results"               # folder of all results
#
#     [calibrate]                   # options of fluoro-calib calibrate
#     source = "calibration"
#     phantom = "phantom.csv"
#
#     [reconstruct]                 # options of fluoro-calib reconstruct
#
#     [bodies]                      # options of fluoro-calib bodies
#     bodies = "bodies.csv"
#     joints = "joints.toml"
#
#     [convert.c3d]                 # options of fluoro-calib convert, for the points of each trial
#     rate = 250
#
# `calibration = "DIR"`, a result folder of calibrate, may replace [calibrate]. A table [extract]
# is for trials that are radiographs. All paths are relative to the folder of the file.

STUDY = 'study.toml'
OUT = 'results'
OF_TRIALS = ('extract', 'reconstruct', 'bodies')  # commands, in order of execution
CONVERT = 'convert'  # a table of tables, one a format
CALIBRATE = 'calibrate'
SOURCE = 'source'
Options = Mapping[str, Any]


@dataclass(frozen=True)
class Trial:
    """A recording of a study."""

    name: str  #: path in the study, without the suffix of a file
    path: Path  #: relative to the folder of the study


@dataclass(frozen=True)
class StudyFile:
    """Content of a study.toml."""

    path: Path
    folder: Path  #: folder of the file, to which all paths are relative
    out: Path
    calibration: Path  #: result folder
    trials: tuple[Trial, ...]
    calibrate: Options | None  #: None if the calibration exists
    commands: Mapping[str, Options]  #: options by command, in the order of OF_TRIALS
    convert: Mapping[str, Options]  #: options by format


def read_study(path: Path) -> StudyFile:
    """Read a study.toml, given by path or folder. Raises DataError that names file and key."""
    path = path / STUDY if path.is_dir() else path
    document = read_toml(path)
    keys = ('trials', 'out', 'calibration', CALIBRATE, *OF_TRIALS, CONVERT)
    check_keys(path, document, keys)
    tables = {key: _table(path, key, document[key]) for key in keys[3:] if key in document}
    out = _path(path, 'out', document.get('out', OUT), OUT)
    if 'calibration' in document:
        calibration = _path(path, 'calibration', document['calibration'], OUT)
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
        raise DataError(f'{path}, key {key}: expected a table of options, such as [{key}]')
    return value


def _trials(path: Path, patterns: Any, out: Path) -> tuple[Trial, ...]:
    """Return the recordings that match any pattern, in order. Raises DataError."""
    valid = isinstance(patterns, list) and all(isinstance(p, str) and p for p in patterns)
    if not valid or not patterns:
        raise DataError(f'{path}, key trials: expected paths or patterns, such as ["trials/*"]')
    trials: dict[str, Trial] = {}
    for pattern in patterns:
        for trial in _matching(path, pattern, out):
            first = trials.setdefault(trial.name, trial)
            if first.path != trial.path:
                raise DataError(
                    f'{path}, key trials: {first.path} and {trial.path} would have the same '
                    'results; name one of them, or move it to a separate folder'
                )
    return tuple(trials.values())


def _matching(path: Path, pattern: str, out: Path) -> Sequence[Trial]:
    """Return the recordings that match a pattern, excluding results and hidden files."""
    folder = path.parent
    if Path(pattern).is_absolute():
        raise DataError(f'{path}, key trials: {pattern!r} is not relative to the study')
    try:
        paths = sorted(folder.glob(pattern))
    except (ValueError, OSError) as error:
        raise DataError(f'{path}, key trials: {pattern!r} is not a pattern ({error})') from None
    trials = []
    for trial_path in paths:
        relative = trial_path.relative_to(folder)
        parts = relative.parts
        if '..' in parts or any(part.startswith('.') for part in parts):
            continue
        if parts[: len(out.parts)] != out.parts:
            name = relative if trial_path.is_dir() else relative.with_suffix('')
            trials.append(Trial(name.as_posix(), relative))
    if not trials:
        raise DataError(f'{path}, key trials: nothing in the study matches {pattern!r}')
    return trials
