# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a format of another program is to the rest of the package."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from .content import Content, FileSettings, Written

Reader = Callable[[Path, FileSettings], Content]
Writer = Callable[[Path, Content, FileSettings], Written]


@dataclass(frozen=True)
class Sample:
    """The name of a file and how it begins, by which formats recognise it.

    Attributes
    ----------
    path : Path
    head : bytes
        The first bytes.
    lines : list of str
        The first lines that are not blank, without surrounding blanks; empty for a file that is
        not text.
    """

    path: Path
    head: bytes
    lines: list[str]

    @property
    def suffix(self) -> str:
        """Suffix of the name in lower case, with the dot."""
        return self.path.suffix.lower()


@dataclass(frozen=True)
class Format:
    """A format.

    Attributes
    ----------
    kind : str
        Name on the command line.
    title : str
        Name in messages.
    parts : tuple of str
        What it can contain, names of `content.PARTS`.
    recognise : callable
        Returns whether a file, by its Sample, has the format.
    read : callable or None
        Reads a Content; None where the format is only written. Raises DataError.
    write : callable or None
        Writes a part of a Content; None where the format is only read. Raises DataError.
    looks_like : str
        How a file of the format begins, for messages.
    says_units : bool
        Whether the format says the unit of its lengths, or has none.
    """

    kind: str
    title: str
    parts: tuple[str, ...]
    recognise: Callable[[Sample], bool]
    read: Reader | None
    write: Writer | None
    looks_like: str
    says_units: bool = True
