# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Names of targets, exposures and fluoroscopes in files, and their ids in this package.

Messages and calculations use ids: integers, and words that are safe in file names and topics.
Files of a lab use names such as `bead01`, `trial 3.tif` and `cam 1`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from ..errors import DataError

MAX_ID = 2**32 - 1  # ids are uint32 in the messages
_NUMBERED = re.compile(r'(?P<before>.*?)(?P<number>\d+)(?P<after>\D*)')
_IS_ID = re.compile('0|[1-9][0-9]{0,9}')
_UNSAFE = re.compile(r'[^A-Za-z0-9_-]')
_MAX_NAME = 100  # maximum length of a fluoroscope id, in characters


@dataclass(frozen=True)
class Names:
    """Ids by name; a name that equals its id is not listed.

    Attributes
    ----------
    targets, exposures : mapping of str to int
    fluoroscopes : mapping of str to str
    """

    targets: Mapping[str, int] = field(default_factory=dict)
    exposures: Mapping[str, int] = field(default_factory=dict)
    fluoroscopes: Mapping[str, str] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.targets or self.exposures or self.fluoroscopes)

    def merged(self, other: Names) -> Names:
        """Return the names of both. Raises DataError for a name with two ids."""
        return Names(
            _merged('target', self.targets, other.targets),
            _merged('exposure', self.exposures, other.exposures),
            _merged('fluoroscope', self.fluoroscopes, other.fluoroscopes),
        )

    def target_names(self) -> dict[int, str]:
        """Return the names of targets by id."""
        return {number: name for name, number in self.targets.items()}

    def exposure_names(self) -> dict[int, str]:
        """Return the names of exposures by number."""
        return {number: name for name, number in self.exposures.items()}

    def fluoroscope_names(self) -> dict[str, str]:
        """Return the names of fluoroscopes by id."""
        return {identity: name for name, identity in self.fluoroscopes.items()}


def _merged(noun: str, one: Mapping[str, object], other: Mapping[str, object]) -> dict[str, Any]:
    for name, identity in other.items():
        if one.get(name, identity) != identity:
            raise DataError(f'{noun} {name!r} has the id {one[name]}, and the id {identity}')
    return {**one, **other}


def number_names(names: Iterable[str], known: Mapping[str, int] | None = None) -> dict[str, int]:
    """Return an id for every name of targets or exposures.

    A known name keeps its id. If all others contain a number and differ in nothing else, such as
    bead01, bead02 or 3.tif, 7.tif, the number becomes the id, so that independent files agree.
    Otherwise those that are free ids keep them, so that a file with ids agrees, and the others are
    counted in their order, from the first free number. Raises DataError if there is none.
    """
    known = known or {}
    new_names = [name for name in dict.fromkeys(names) if name not in known]
    used_numbers = set(known.values())
    ids = _common_numbers(new_names)
    if ids is None or used_numbers & set(ids):
        kept = [name for name in new_names if _IS_ID.fullmatch(name) and int(name) <= MAX_ID]
        kept = [name for name in kept if int(name) not in used_numbers]
        known = {**known, **{name: int(name) for name in kept}}
        new_names = [name for name in new_names if name not in known]
        first_number = max(known.values(), default=0) + 1
        ids = list(range(first_number, first_number + len(new_names)))
        if ids and ids[-1] > MAX_ID:
            raise DataError(f'there is no id up to {MAX_ID} for the name {new_names[-1]!r}')
    return {**known, **dict(zip(new_names, ids))}


def _common_numbers(names: Sequence[str]) -> list[int] | None:
    """Return the numbers in names that differ in nothing else, None for other names."""
    matches = [_NUMBERED.fullmatch(name) for name in names]
    numbered = [match for match in matches if match is not None]
    if len(numbered) < len(names):
        return None
    affixes = {(match['before'], match['after']) for match in numbered}
    numbers = [int(match['number']) for match in numbered]
    if len(affixes) > 1 or len(set(numbers)) < len(numbers) or max(numbers, default=0) > MAX_ID:
        return None
    return numbers


def safe_names(names: Iterable[str], known: Mapping[str, str] | None = None) -> dict[str, str]:
    """Return a unique id of letters, digits, _ and - for every name of a fluoroscope."""
    identities = dict(known or {})
    for name in dict.fromkeys(names):
        if name in identities:
            continue
        stem = _UNSAFE.sub('_', name.strip())[: _MAX_NAME - 4] or 'fluoroscope'
        used = set(identities.values())
        identity = stem
        number = 2
        while identity in used:
            identity = f'{stem}_{number}'
            number += 1
        identities[name] = identity
    return identities


def without_trivial(ids: Mapping[str, int]) -> dict[str, int]:
    """Return the ids of names that are not the id itself as text."""
    return {name: number for name, number in ids.items() if name != str(number)}
