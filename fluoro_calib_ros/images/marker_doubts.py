# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Doubtful ids of markers: which may be wrong, since when, and exchanged with which."""

from __future__ import annotations

from collections.abc import Set as AbstractSet

import numpy as np

from ..findings import Finding, Kind, Place, Severity

# Why an id may be wrong.
DOUBTS = {
    Kind.SHADOWS_MET: 'their shadows met and parted',
    Kind.MARKER_FOUND_AGAIN: 'found again after {images} images',
    Kind.OTHER_SHADOW: 'another shadow was as near to where it was expected',
    Kind.MARKER_MOVES_ALONE: 'it moves unlike the markers that it moved with',
}


class MarkerDoubts:
    """Which of count markers may have a wrong id, by row."""

    def __init__(self, count: int) -> None:
        self._since = np.zeros(count, dtype=int)
        self._partners: list[set[int]] = [set() for _ in range(count)]

    @property
    def doubtful(self) -> np.ndarray:
        """Return (n,) whether an id may be wrong."""
        return np.array([bool(partners) for partners in self._partners], dtype=bool)

    def since(self, row: int) -> int | None:
        """Return the image since which an id may be wrong, None for one that is sure."""
        return int(self._since[row]) if self._partners[row] else None

    def partners(self, row: int) -> AbstractSet[int]:
        """Return the rows that a marker may be exchanged with; its own for something else."""
        return self._partners[row]

    def add(self, row: int, frame: int) -> None:
        """Note that a marker may be something else since an image."""
        if not self._partners[row]:
            self._since[row] = frame
        self._partners[row].add(row)

    def add_pair(self, one: int, other: int, frame: int) -> None:
        """Note that two markers may have been exchanged since an image."""
        for row, partner in ((one, other), (other, one)):
            if not self._partners[row]:
                self._since[row] = frame
            self._partners[row].add(partner)

    def confirm(self, row: int) -> None:
        """Take back all doubts in a marker."""
        for other in self._partners[row] - {row}:
            self._partners[other].discard(row)
        self._partners[row].clear()

    def confirm_alone(self, row: int) -> None:
        """Take back the doubt that a marker is something else, if there is no other doubt."""
        if self._partners[row] == {row}:
            self._partners[row].clear()

    def part(self, one: int, other: int) -> None:
        """Take back the doubt that two markers were exchanged."""
        self._partners[one].discard(other)
        self._partners[other].discard(one)


def doubt_in(kind: Kind, frame: int, *target_id: int, **numbers: int) -> Finding:
    """Return the finding that ids may be wrong from a frame on."""
    place = Place((), (frame,), target_id, name='')
    cause = DOUBTS[kind].format(**numbers)
    return Finding(kind, cause, place, severity=Severity.WARNING, numbers=numbers)
