"""Wall times, and tables of them."""

import textwrap
import time

import numpy as np


def timed(function, repeats=1):
    """Result of the last of repeated calls, and the median of their wall times [s]."""
    times = []
    result = None
    for _ in range(repeats):
        began = time.perf_counter()
        result = function()
        times.append(time.perf_counter() - began)
    return result, float(np.median(times))


def table(header, rows):
    """A Markdown table; cells of the first column stand left, others right."""
    lines = [header, ['---'] + ['---:'] * (len(header) - 1), *rows]
    return '\n'.join('| ' + ' | '.join(line) + ' |' for line in lines)


def section(title, text, header, rows):
    """A section of the report: title, a paragraph and a table."""
    filled = textwrap.fill(text, 118, break_on_hyphens=False)
    return f'## {title}\n\n{filled}\n\n{table(header, rows)}'
