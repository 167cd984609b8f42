# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Fields of records: what files, messages, identifiers and documentation have in common.

A value is declared once, by a `Field`. The arrays of a file and their limits, what earlier
versions did not have, the fields of a message and the table in the documentation follow from it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Field:
    """A value of a record."""

    name: str
    dtype: str  #: {'text', 'int', 'float', 'bool'}
    shape: tuple[int | str, ...] = ()  #: a letter stands for any length
    #: for the documentation
    unit: str = '-'
    meaning: str = ''
    minimum: float | None = None
    maximum: float | None = None  #: of the absolute value, where it is finite
    longest: int | None = None  #: of the lengths that are letters
    #: the only length but 0 that a letter of the shape can stand for
    lengths: Mapping[str, int] = field(default_factory=dict)
    allowed: str = ''  #: value that a float can have besides finite ones: {'', 'inf', 'nan'}
    since: int = 1  #: first version of the file that has the field
    before: Any = None  #: value of a record of an earlier version
    #: fields of the message; several hold the parts along the axis of their number; empty: one of
    #: the same name
    message: tuple[str, ...] = ()
    #: whether the identifier of the record depends on it: as what determines a correction, or as
    #: what does not: {'', 'correction', 'detail'}
    identity: str = ''
