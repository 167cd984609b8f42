"""Tables of results as text: for a terminal and for GitHub."""

import math
import textwrap

import numpy as np

WIDTH = 100  # columns of a terminal
# widths of the quantity and of a fluoroscope
LABEL = 36
COLUMN = 20


def summary_table(job, latency_ms=None):
    """Text of the figures of a CalibrationResult, at most 100 columns wide: a column for each fluoroscope.

    latency_ms: dict of the correction's latency, p50, p99 and max [ms], and the number of frames,
    or None.
    """
    names = list(job.fluoroscopes)
    per_block = (WIDTH - LABEL) // COLUMN
    blocks = []
    for start in range(0, len(names), per_block):
        columns = [_column(job, name) for name in names[start : start + per_block]]
        blocks.append(
            '\n'.join(
                (
                    label.ljust(LABEL) + ''.join(column[label].rjust(COLUMN) for column in columns)
                ).rstrip()
                for label in columns[0]
            )
        )
    text = '\n\n'.join(blocks)
    text += f'\n\nAll fluoroscopes: {len(job.targets.target_id)} targets, {job.seconds:.1f} s'
    for sentence in job.left_out:
        text += '\n' + textwrap.fill(f'Not used: {sentence}', WIDTH, subsequent_indent='    ')
    if latency_ms is not None:
        text += (
            f'\nLatency of the correction: median {latency_ms["p50"]:.3g} ms, 99 % below '
            f'{latency_ms["p99"]:.3g} ms, largest {latency_ms["max"]:.3g} ms ({latency_ms["frames"]} frames)'
        )
    return text + '\n'


def _column(job, name):
    """Quantities and values of one fluoroscope, as text."""
    figures = job.fluoroscopes[name]
    calibration = job.calibrations[name]
    run = next((r for r in job.runs.values() if name in r.measured.fluoroscopes), None)
    model = calibration.model
    sd = model.evaluate(model.train_uv).sd if len(model.train_uv) else np.array([np.nan])
    column = {'Fluoroscope': name if len(name) < COLUMN else name[: COLUMN - 4] + '...'}
    for axis, coordinate in enumerate('uv'):
        before = figures.rmse_before[axis]
        after = figures.rmse_after[axis]
        column[f'RMSE {coordinate} before [px]'] = _number(before, 3)
        column[f'RMSE {coordinate} after [px]'] = _number(after, 3)
        column[f'improvement {coordinate} [%]'] = _number(
            100 * (1 - after / before) if before > 0 else np.nan, 1
        )
    column['correction model'] = figures.model_kind
    column['neighbours k'] = '-' if figures.model_kind == 'none' else str(figures.k)
    column['iterations'] = '-' if run is None else str(len(run.history))
    column['converged'] = (
        ('yes' if job.converged else 'NO') if run is None else ('yes' if run.converged else 'NO')
    )
    column['observations'] = str(figures.observations)
    column['inliers'] = (
        f'{figures.inliers} ({100 * figures.inliers / max(figures.observations, 1):.1f} %)'
    )
    column['exposures'] = str(len(figures.exposures))
    column['interior orientation'] = 'estimated' if calibration.interior_estimated else 'held'
    for quantity, value, sigma in zip(('xp', 'yp', 'c'), figures.interior, figures.interior_sd):
        column[f'{quantity} [px]'] = _number(value, 2)
        column[f'    {quantity} standard deviation [px]'] = _number(sigma, 2) if sigma > 0 else '-'
    column['median sd of the correction [px]'] = _number(float(np.median(sd)), 3)
    column['calibration [s]'] = _number(calibration.seconds, 1)
    return column


def _number(value, digits):
    return f'{value:.{digits}f}' if math.isfinite(value) else '-'


def markdown_table(header, rows):
    """GitHub table, aligned, of header (c,) and rows of c cells; columns of numbers are set to the
    right.

    Raises ValueError for a row that is not as long as the header.
    """
    header = [_cell(cell) for cell in header]
    rows = [[_cell(cell) for cell in row] for row in rows]
    for row in rows:
        if len(row) != len(header):
            raise ValueError(f'a row has {len(row)} cells, the header has {len(header)}')
    columns = list(zip(header, *rows))
    widths = [max(3, *map(len, column)) for column in columns]
    right = [len(column) > 1 and all(map(_is_number, column[1:])) for column in columns]
    rule = ['-' * (width - 1) + ':' if r else '-' * width for width, r in zip(widths, right)]
    return (
        '\n'.join(
            '| '
            + ' | '.join(
                cell.rjust(width) if r else cell.ljust(width)
                for cell, width, r in zip(row, widths, right)
            )
            + ' |'
            for row in [header, rule, *rows]
        )
        + '\n'
    )


def _cell(value):
    """Text of a cell: on one line, with the bars that would end it escaped."""
    return ' '.join(str(value).split()).replace('|', '\\|')


def _is_number(cell):
    """Whether a cell holds a number, with or without a percent sign, or a dash for none."""
    try:
        float(cell.rstrip(' %'))
        return True
    except ValueError:
        return cell in ('-', '')
