# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The verdict on a calibration as text for a terminal."""

from __future__ import annotations

import textwrap

from ..checks.check import Validation
from ..findings import sentences
from .tables import TERMINAL_WIDTH, number_text

HEADER = ('check', 'fluoroscope', 'value', 'limit', 'unit', '')
PASSED_TEXT = {True: 'passed', False: 'FAILED', None: 'not made'}
MAX_NAME = 20  # characters


def verdict_text(validation: Validation) -> str:
    """Format a Validation in at most 100 columns: the checks, the verdict, and what to do."""
    rows = [HEADER]
    for check in validation.checks:
        rows.append(
            (
                check.name,
                _shortened(check.place.fluoroscope or 'all'),
                number_text(check.value),
                number_text(check.limit),
                check.unit,
                PASSED_TEXT[check.passed],
            )
        )
    widths = [max(map(len, column)) for column in zip(*rows)]
    lines = []
    for name, fluoroscope, value, limit, unit, passed in rows:
        cells = [
            name.ljust(widths[0]),
            fluoroscope.ljust(widths[1]),
            value.rjust(widths[2]),
            limit.rjust(widths[3]),
            unit.ljust(widths[4]),
            passed,
        ]
        lines.append('  '.join(cells).rstrip())
    lines += ['', f'Verdict: {validation.verdict} ({validation.seconds:.1f} s)']
    for name, sd in validation.achieved_sd_px.items():
        lines.append(f'Achieved, fluoroscope {_shortened(name)}: corrections to {sd:.3f} px (sd)')
    for sentence in sentences((*validation.findings, *validation.notes)):
        lines += textwrap.wrap(f'- {sentence}', TERMINAL_WIDTH, subsequent_indent='  ')
    return '\n'.join(lines) + '\n'


def verdict_line(validation: Validation) -> str:
    """Format the verdict in one line, with the accuracy achieved or the first thing to do."""
    text = f'Verdict: {validation.verdict}'
    if validation.verdict == 'pass':
        achieved = [
            f'{_shortened(name)} {sd:.3f} px' for name, sd in validation.achieved_sd_px.items()
        ]
        return f'{text}; corrections to (sd) {", ".join(achieved)}'
    findings = validation.findings
    more = f' ({len(findings) - 1} more in the report)' if len(findings) > 1 else ''
    return f'{text}; {findings[0]}{more}' if findings else text


def _shortened(name: str) -> str:
    return name if len(name) <= MAX_NAME else name[: MAX_NAME - 3] + '...'
