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
    """A value of a record.

    Attributes
    ----------
    name : str
    dtype : {'text', 'int', 'float', 'bool'}
    shape : tuple
        A letter stands for any length.
    unit, meaning : str
        For the documentation.
    minimum : float or None
    maximum : float or None
        Of the absolute value, where it is finite.
    longest : int or None
        Of the lengths that are letters.
    lengths : mapping of str to int
        The only length but 0 that a letter of the shape can stand for.
    allowed : {'', 'inf', 'nan'}
        Value that a float can have besides finite ones.
    since : int
        First version of the file that has the field.
    before : object
        Value of a record of an earlier version.
    message : tuple of str
        Fields of the message; several hold the parts along the axis of their number. Empty: one
        of the same name.
    identity : {'', 'correction', 'detail'}
        Whether the identifier of the record depends on it: as what determines a correction, or as
        what does not.
    """

    name: str
    dtype: str
    shape: tuple[int | str, ...] = ()
    unit: str = '-'
    meaning: str = ''
    minimum: float | None = None
    maximum: float | None = None
    longest: int | None = None
    lengths: Mapping[str, int] = field(default_factory=dict)
    allowed: str = ''
    since: int = 1
    before: Any = None
    message: tuple[str, ...] = ()
    identity: str = ''
