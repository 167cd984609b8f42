# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Wall times and their Markdown tables."""

import textwrap
import time
from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

import numpy as np

T = TypeVar('T')


def timed(function: Callable[[], T], repeats: int = 1) -> tuple[T, float]:
    """Return the result of the last of repeated calls, and the median of their wall times [s]."""
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        result = function()
        times.append(time.perf_counter() - began)
    return result, float(np.median(times))


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table, with the first column aligned left and the others aligned right."""
    lines = [header, ['---'] + ['---:'] * (len(header) - 1), *rows]
    return '\n'.join('| ' + ' | '.join(line) + ' |' for line in lines)


def section(title: str, text: str, header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a section of the report: title, a paragraph and a table."""
    paragraph = textwrap.fill(text, 118, break_on_hyphens=False)
    return f'## {title}\n\n{paragraph}\n\n{table(header, rows)}'
