# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Images that wait to be processed, exposure by exposure."""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Collection, Iterable, Mapping
from typing import Generic, TypeVar

T = TypeVar('T')

REMEMBERED = 1000  # numbers of exposures that were begun or shed


class ExposureQueue(Generic[T]):
    """Items of each fluoroscope that wait for its thread, at most `size` of them.

    Where more would wait, the oldest exposure that no thread has begun is shed with the items of
    all fluoroscopes: views of different exposures are of no use to a reconstruction.
    """

    def __init__(self, fluoroscopes: Iterable[str], size: int) -> None:
        self._size = size
        self._waiting: dict[str, OrderedDict[int, T]] = {n: OrderedDict() for n in fluoroscopes}
        self._begun: deque[int] = deque(maxlen=REMEMBERED)
        self._shed: deque[int] = deque(maxlen=REMEMBERED)
        self._changed = threading.Condition()
        self._closed = False

    def put(self, fluoroscope: str, number: int, item: T) -> list[str]:
        """Add an item; returns the fluoroscopes that have lost one."""
        with self._changed:
            waiting = self._waiting[fluoroscope]
            if number in self._shed:
                return [fluoroscope]
            lost = [fluoroscope] if number in waiting else []  # a number that is used again
            waiting[number] = item
            if len(waiting) > self._size:
                lost += self._shed_one(waiting)
            self._changed.notify_all()
            return lost

    def get(
        self, fluoroscopes: Collection[str], patience_s: float = 0.0
    ) -> tuple[int, dict[str, T]] | None:
        """Wait for the items of an exposure, the lowest number that waits; None once it is closed.

        Items of the other fluoroscopes are waited for while they may still come, at most so long.
        """
        views = {name: self._waiting[name] for name in fluoroscopes}
        with self._changed:
            self._changed.wait_for(lambda: self._closed or any(views.values()))
            self._changed.wait_for(lambda: self._closed or _is_complete(views), patience_s)
            if self._closed:
                return None
            number = _lowest(views)
            self._begun.append(number)
            return number, {n: items.pop(number) for n, items in views.items() if number in items}

    @property
    def closed(self) -> bool:
        """Whether the queue is closed."""
        return self._closed

    def waiting(self, fluoroscope: str) -> int:
        """Return how many items of a fluoroscope wait."""
        return len(self._waiting[fluoroscope])

    def close(self) -> None:
        """End all waits; what is waiting is lost."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def _shed_one(self, full: OrderedDict[int, T]) -> list[str]:
        """Remove an exposure; returns the fluoroscopes that have lost an item."""
        fresh = [number for number in full if number not in self._begun]
        if not fresh:
            full.popitem(last=False)
            return [name for name, items in self._waiting.items() if items is full]
        self._shed.append(fresh[0])
        lost = [name for name, items in self._waiting.items() if fresh[0] in items]
        for name in lost:
            del self._waiting[name][fresh[0]]
        return lost


def _lowest(views: Mapping[str, Mapping[int, object]]) -> int:
    """Return the lowest number that waits."""
    return min(number for items in views.values() for number in items)


def _is_complete(views: Mapping[str, Mapping[int, object]]) -> bool:
    """Return whether the lowest exposure that waits has all items that it will have."""
    number = _lowest(views)
    # A fluoroscope with a later exposure has lost this one, and one that is an exposure late is
    # not waited for.
    overdue = any(number in items and len(items) > 1 for items in views.values())
    return overdue or all(number in items or items for items in views.values())
