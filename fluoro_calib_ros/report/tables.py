# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Tables of results as text, for a terminal and for GitHub."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..checks.check import Validation
from ..correction.angle_field import AngleField
from ..correction.base import CorrectionModel
from ..correction.fluoroscope_calibration import FluoroscopeCalibration
from ..estimation.result import CalibrationResult, FluoroscopeResult
from ..findings import Severity, sentences, summed_up
from ..photogrammetry.rig_orientation import RigOrientation
from .rig_geometry import uncalibrated_share

# Widths of columns, in characters.
LABEL_WIDTH = 36
COLUMN_WIDTH = 20  # for the values of a fluoroscope


def summary_table(
    result: CalibrationResult,
    latency_ms: Mapping[str, float] | None = None,
    has_notes: bool = True,
) -> str:
    """Summarise a calibration in at most 100 columns of text, one table column a fluoroscope.

    latency_ms: latency of the correction, p50, p99 and max [ms], and the number of frames.
    has_notes: whether to list what was not used.
    """
    names = list(result.fluoroscopes)
    per_block = (TERMINAL_WIDTH - LABEL_WIDTH) // COLUMN_WIDTH
    blocks = []
    for start in range(0, len(names), per_block):
        columns = [_column(result, name) for name in names[start : start + per_block]]
        lines = []
        for label in columns[0]:
            if label in _angle_rows(None) and all(c[label] == '-' for c in columns):
                continue
            values = ''.join(column[label].rjust(COLUMN_WIDTH) for column in columns)
            lines.append((label.ljust(LABEL_WIDTH) + values).rstrip())
        blocks.append('\n'.join(lines))
    text = '\n\n'.join(blocks)
    targets = len(result.targets.target_id)
    text += f'\n\nAll fluoroscopes: {targets} targets, {result.seconds:.1f} s'
    notes = [f for f in result.findings if has_notes and f.severity is Severity.NOTE]
    for sentence in summed_up(notes):
        text += '\n' + textwrap.fill(
            f'Not used: {sentence}', TERMINAL_WIDTH, subsequent_indent='    '
        )
    if latency_ms is not None:
        text += (
            f'\nLatency of the correction: median {latency_ms["p50"]:.3g} ms, 99 % below '
            f'{latency_ms["p99"]:.3g} ms, largest {latency_ms["max"]:.3g} ms '
            f'({latency_ms["frames"]} frames)'
        )
    return text + '\n'


def _column(result: CalibrationResult, name: str) -> dict[str, str]:
    """Return quantities and values of one fluoroscope, as text."""
    figures = result.fluoroscopes[name]
    calibration = result.calibrations[name]
    run = next((r for r in result.runs.values() if name in r.measured.fluoroscopes), None)
    converged = result.converged if run is None else run.converged
    inlier_percent = 100 * figures.inliers / max(figures.observations, 1)
    model = calibration.model
    # An adjustment with given calibrations has no rounds.
    estimated = calibration.interior_estimated and bool(result.history)
    return {
        'Fluoroscope': name if len(name) < COLUMN_WIDTH else name[: COLUMN_WIDTH - 4] + '...',
        **_rmse_rows(figures),
        'correction model': figures.model_kind,
        'neighbours k': str(figures.k) if model.corrects and figures.k else '-',
        'iterations': '-' if run is None else str(len(run.history)),
        'converged': 'yes' if converged else 'NO',
        'observations': str(figures.observations),
        'inliers': f'{figures.inliers} ({inlier_percent:.1f} %)',
        'exposures': str(len(figures.exposures)),
        'interior orientation': 'estimated' if estimated else 'fixed',
        **_interior_rows(figures),
        'noise of an image coordinate [px]': _noise_text(calibration),
        'median sd of the correction [px]': number_text(_median_sd(calibration)),
        'image that is not calibrated [%]': number_text(100 * uncalibrated_share(calibration), 1),
        **_angle_rows(calibration.angle_field),
        'calibration [s]': number_text(calibration.seconds, 1),
    }


def _median_sd(calibration: FluoroscopeCalibration) -> float:
    """Return the median sd of a correction [px], over all angles of the exposures."""
    uv = calibration.model.train_uv
    if not len(uv):
        return float('nan')
    sd = calibration.model.evaluate(uv).sd
    field = calibration.angle_field
    if field is None:
        return float(np.median(sd))
    squares = [sd**2 + field.change(uv, angle)[1] for angle in field.angles.tolist()]
    return float(np.sqrt(np.maximum(np.median(squares), 0)))


def _noise_text(calibration: FluoroscopeCalibration) -> str:
    """Return the sd of an image coordinate [px], in the middle and at the border."""
    profile = calibration.noise_profile
    if profile is None:
        return number_text(calibration.image_sd)
    middle, border = (number_text(calibration.image_sd * f) for f in (profile.middle, profile.rim))
    return f'{middle}; border {border}'


def _angle_rows(field: AngleField | None) -> dict[str, str]:
    if field is None:
        return {'angles of the C-arm [deg]': '-', 'change with the angle, RMS [px]': '-'}
    return {
        'angles of the C-arm [deg]': ' to '.join(f'{np.degrees(a):.0f}' for a in field.range),
        'change with the angle, RMS [px]': number_text(field.size_px),
    }


def _rmse_rows(figures: FluoroscopeResult) -> dict[str, str]:
    rows = {}
    for coordinate, before, after in zip('uv', figures.rmse_before, figures.rmse_after):
        improvement = 100 * (1 - after / before) if before > 0 else np.nan
        rows[f'RMSE {coordinate} before [px]'] = number_text(before)
        rows[f'RMSE {coordinate} after [px]'] = number_text(after)
        rows[f'improvement {coordinate} [%]'] = number_text(improvement, 1)
    return rows


def _interior_rows(figures: FluoroscopeResult) -> dict[str, str]:
    rows = {}
    for quantity, value, sd in zip(('xp', 'yp', 'c'), figures.interior, figures.interior_sd):
        rows[f'{quantity} [px]'] = number_text(value, 2)
        rows[f'    {quantity} standard deviation [px]'] = number_text(sd, 2) if sd > 0 else '-'
    return rows


def markdown_table(header: Sequence[Any], rows: Sequence[Sequence[Any]]) -> str:
    """Format a table for GitHub; columns of numbers are aligned to the right.

    Raises ValueError for a row whose length differs from that of the header.
    """
    titles = [_cell(cell) for cell in header]
    cells = [[_cell(cell) for cell in row] for row in rows]
    for row in cells:
        if len(row) != len(titles):
            raise ValueError(f'a row has {len(row)} cells, the header has {len(titles)}')
    columns = zip(titles, *cells)
    is_right = [len(column) > 1 and all(map(_is_number, column[1:])) for column in columns]
    head, *body = _aligned([titles, *cells], is_right, 3)
    rule = ['-' * (len(cell) - r) + ':' * r for cell, r in zip(head, is_right)]
    return ''.join('| ' + ' | '.join(row) + ' |\n' for row in [head, rule, *body])


def _aligned(
    rows: Sequence[Sequence[str]], is_right: Sequence[bool], least: int = 0
) -> list[list[str]]:
    """Pad the cells of columns to a common width of at least `least` characters."""
    widths = [max(least, *map(len, column)) for column in zip(*rows)]
    return [
        [c.rjust(width) if r else c.ljust(width) for c, width, r in zip(row, widths, is_right)]
        for row in rows
    ]


def _cell(value: Any) -> str:
    """Return the text of a cell on one line, with escaped bars."""
    return ' '.join(str(value).split()).replace('|', '\\|')


def _is_number(cell: str) -> bool:
    """Return whether a cell is a number, with or without a percent sign, or a dash."""
    try:
        float(cell.rstrip(' %'))
    except ValueError:
        return cell in ('-', '')
    return True


TERMINAL_WIDTH = 100  # columns


def model_text(model: CorrectionModel) -> str:
    """Return a correction model in words."""
    if not model.corrects:
        return 'no correction model'
    return f'{model.kind}, k = {model.k}' if model.k else model.kind


def number_text(value: float, digits: int = 3) -> str:
    """Return a number with this many decimals, or a dash if it is not finite."""
    return f'{value:.{digits}f}' if math.isfinite(value) else '-'


def orientation_text(orientation: RigOrientation) -> str:
    """Return a RigOrientation as text: a title line, then one line a fluoroscope."""
    lines = [
        f'orientation of the rig {orientation.orientation_id} in frame {orientation.frame_id}, '
        f'from a {orientation.source} (exposures: {orientation.exposures})'
    ]
    for name, position, sd, sd_rad in zip(
        orientation.fluoroscopes, orientation.position_mm, orientation.sd_mm, orientation.sd_rad
    ):
        rotation_sd = np.rad2deg(np.sqrt(np.mean(sd_rad**2)))
        lines.append(
            f'{name}: source at {_numbers(position)} mm (sd {_numbers(sd)}), '
            f'rotation sd {rotation_sd:.4f} degrees'
        )
    return '\n'.join(lines)


def _numbers(values: NDArray[np.float64]) -> str:
    return ', '.join(f'{value:.2f}' for value in values)


# The verdict on a calibration as text for a terminal.

HEADER = ('check', 'fluoroscope', 'value', 'limit', 'unit', '')
PASSED_TEXT = {True: 'passed', False: 'FAILED', None: 'not made'}
MAX_NAME = 20  # maximum length of a name in characters


def verdict_text(validation: Validation) -> str:
    """Format a Validation in at most 100 columns: checks, verdict, and advice."""
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
    is_right = [title in ('value', 'limit') for title in HEADER]
    lines = ['  '.join(cells).rstrip() for cells in _aligned(rows, is_right)]
    lines += ['', f'Verdict: {validation.verdict} ({validation.seconds:.1f} s)']
    for name, sd in validation.achieved_sd_px.items():
        lines.append(f'Achieved, fluoroscope {_shortened(name)}: corrections to {sd:.3f} px (sd)')
    for sentence in sentences((*validation.findings, *validation.notes)):
        lines += textwrap.wrap(f'- {sentence}', TERMINAL_WIDTH, subsequent_indent='  ')
    return '\n'.join(lines) + '\n'


def verdict_line(validation: Validation) -> str:
    """Format the verdict in one line, with the achieved accuracy or the first advice."""
    text = f'Verdict: {validation.verdict}'
    if validation.verdict == 'pass':
        achieved = [
            f'{_shortened(name)} {sd:.3f} px' for name, sd in validation.achieved_sd_px.items()
        ]
        return f'{text}; corrections to (sd) {", ".join(achieved)}'
    findings = validation.findings
    addition = f' ({len(findings) - 1} more in the report)' if len(findings) > 1 else ''
    return f'{text}; {findings[0]}{addition}' if findings else text


def _shortened(name: str) -> str:
    return name if len(name) <= MAX_NAME else name[: MAX_NAME - 3] + '...'
