# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""rig.toml: what does not change from command to command, so that flags are unnecessary.

    fluoroscopes = ["a", "b"]
    image_size = [1024, 1024]     # width, height [px]
    phantom = "phantom.csv"
    units = "cm"                  # of files that do not say theirs, such as the phantom
    phantom_sd = 0.05             # of the coordinates of beads, where the file has none [mm]
    calibration = "result"        # result folder of calibrate
    angle_joint = "carm"          # joint of the C-arm; or {a = "frontal", b = "lateral"}
    angle_max_age = 0.5           # longest time from its last state to an exposure [s]

    [about]                       # shown in the report of a calibration, used by nothing
    site = "gait laboratory"
    kV = 80

All keys are optional; paths are relative to the folder of the file.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from ..errors import DataError
from .documents import read_toml

NAME = 'rig.toml'
MAX_ABOUT = 100  # entries
MAX_ABOUT_TEXT = 1000  # characters of an entry


@dataclass(frozen=True)
class RigFile:
    """Content of a rig.toml; None for what it does not say."""

    path: Path
    fluoroscopes: list[str] | None = None
    image_size: tuple[int, int] | None = None  #: width and height [px]
    #: file with the phantom, and result folder
    phantom: Path | None = None
    calibration: Path | None = None
    units: str | None = None  #: of files that do not say theirs
    phantom_sd: float | None = None  #: of the coordinates of beads, where the file has none [mm]
    #: joint of the C-arm, or one for each fluoroscope, as the option of this name
    angle_joint: str | None = None
    #: longest time from the last state of the joint to an exposure [s]
    angle_max_age: float | None = None
    #: what the report says of the rig, such as site, operator, kV and mA
    about: dict[str, str] | None = None


KEYS = tuple(field.name for field in fields(RigFile)[1:])


def read_rig_file(path: Path) -> RigFile:
    """Read a rig.toml. Raises DataError that names file and key."""
    document = read_toml(path)
    for key in document:
        if key not in KEYS:
            raise DataError(f'{path}, key {key}: unknown, there are {", ".join(KEYS)}')
    names = _names(path, document.get('fluoroscopes'))
    return RigFile(
        path,
        names,
        image_size=_size(path, document.get('image_size')),
        phantom=_path(path, 'phantom', document.get('phantom')),
        calibration=_path(path, 'calibration', document.get('calibration')),
        units=_units(path, document.get('units')),
        phantom_sd=_phantom_sd(path, document.get('phantom_sd')),
        angle_joint=_joint(path, document.get('angle_joint'), names),
        angle_max_age=_max_age(path, document.get('angle_max_age')),
        about=_about(path, document.get('about')),
    )


def _names(path: Path, value: Any) -> list[str] | None:
    if value is None:
        return None
    valid = isinstance(value, list) and value and all(isinstance(v, str) and v for v in value)
    if not valid or len(set(value)) < len(value):
        raise DataError(f'{path}, key fluoroscopes: a list of different names, such as ["a", "b"]')
    return list(value)


def _size(path: Path, value: Any) -> tuple[int, int] | None:
    if value is None:
        return None
    whole = isinstance(value, list) and all(type(v) is int and v > 0 for v in value)
    if not whole or len(value) != 2:
        raise DataError(f'{path}, key image_size: width and height [px], such as [1024, 1024]')
    return value[0], value[1]


def _units(path: Path, value: Any) -> str | None:
    if value is not None and value not in ('mm', 'cm', 'm'):
        raise DataError(f'{path}, key units: "mm", "cm" or "m"')
    return value


def _phantom_sd(path: Path, value: Any) -> float | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value <= 100:
        raise DataError(f'{path}, key phantom_sd: a standard deviation [mm], such as 0.05')
    return float(value)


def _joint(path: Path, value: Any, names: list[str] | None) -> str | None:
    """Return the option angle_joint; names: the fluoroscopes of the rig, None for any."""
    from ..exposures.angles import joints_by_fluoroscope  # every command reads this module

    if value is None:
        return None
    where = f'{path}, key angle_joint'
    example = 'a joint, such as "carm", or one for each fluoroscope, such as {a = "frontal"}'
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


def _max_age(path: Path, value: Any) -> float | None:
    """Return the option angle_max_age [s]."""
    from ..exposures.angles import AngleOptions  # every command reads this module

    if value is None:
        return None
    try:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ValueError
        return AngleOptions(angle_max_age=float(value)).angle_max_age
    except (ValueError, OverflowError):
        raise DataError(f'{path}, key angle_max_age: a time [s], such as 0.5') from None


def _about(path: Path, value: Any) -> dict[str, str] | None:
    """Return texts that the report shows, by name."""
    if value is None:
        return None
    if not isinstance(value, dict) or len(value) > MAX_ABOUT:
        raise DataError(f'{path}, key about: a table of at most {MAX_ABOUT} texts and numbers')
    for key, text in value.items():
        if not isinstance(text, str | int | float) or len(f'{key}{text}') > MAX_ABOUT_TEXT:
            raise DataError(
                f'{path}, key about.{key}: a text or a number, of at most {MAX_ABOUT_TEXT} '
                'characters with its name'
            )
    return {key: str(text) for key, text in value.items()}


def _path(path: Path, key: str, value: Any) -> Path | None:
    if value is None:
        return None
    if not isinstance(value, str) or not value or '\0' in value:
        raise DataError(f'{path}, key {key}: a path is a text, such as "phantom.csv"')
    return path.parent / value
