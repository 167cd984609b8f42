"""The verdict on a calibration as text for a terminal."""

import math
import textwrap

WIDTH = 100  # columns of a terminal
WORDS = {True: 'passed', False: 'FAILED', None: 'not made'}


def verdict_text(validation):
    """Text of a Validation, at most 100 columns wide: a row for each check, the verdict, and what
    to do.
    """
    rows = [('check', 'fluoroscope', 'value', 'limit', 'unit', '')]
    rows += [
        (
            c.name,
            _short(c.fluoroscope or 'all'),
            _number(c.value),
            _number(c.limit),
            c.unit,
            WORDS[c.passed],
        )
        for c in validation.checks
    ]
    widths = [max(len(row[i]) for row in rows) for i in range(5)]
    lines = [
        '  '.join(
            [
                row[0].ljust(widths[0]),
                row[1].ljust(widths[1]),
                row[2].rjust(widths[2]),
                row[3].rjust(widths[3]),
                row[4].ljust(widths[4]),
                row[5],
            ]
        ).rstrip()
        for row in rows
    ]
    lines += ['', f'Verdict: {validation.verdict} ({validation.seconds:.1f} s)']
    for sentence in validation.findings:
        lines += textwrap.wrap(f'- {sentence}', WIDTH, subsequent_indent='  ')
    return '\n'.join(lines) + '\n'


def _number(value):
    return f'{value:.3f}' if math.isfinite(value) else '-'


def _short(name):
    return name if len(name) <= 20 else name[:17] + '...'
