# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The figure of the cost of a self-calibration."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from ..estimation.rounds import SETTLED_PX, SelfCalibration
from .style import BLACK, BLUE, GREY, RED, new_figure

MARKER: dict[str, Any] = {'marker': 'o', 'markersize': 4}


def relative_costs(run: SelfCalibration) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """F (n+1,), G (n,) and recorded G (n,) of the n rounds, in percent of their first values.

    F[i] is the weighted square sum of the residuals of adjustment i, 0 being the one without
    correction; G[i] the cross-validation of the model that is fitted to them. G is recorded in
    units of the noise as adjustment i estimates it. The noise decreases with the distortion, which
    alone makes recorded G grow. The estimated variance follows F, so G times F is in the same unit
    in all rounds.
    """
    before = run.before
    first = float(np.sum(before.noise.weight(before.q)[:, None] * before.residuals**2))
    f = np.array([first] + [r.quadratic for r in run.history])
    recorded = np.array([r.G for r in run.history])
    g = recorded * f[:-1]
    return 100 * f / f[0], 100 * g / g[0], 100 * recorded / recorded[0]


def cost_figure(run: SelfCalibration) -> Figure:
    """Costs of adjustment and regression, their mean, and what a round still changes."""
    kinds = ', '.join(sorted({model.kind for model in run.models.values()}))
    end = 'converged' if run.converged else 'NOT converged'
    figure = new_figure(
        15,
        6,
        f'{_names_text(run.measured.fluoroscopes)}: self-calibration with {kinds}, {end} after '
        f'{len(run.history)} iterations',
    )
    left, middle, right = figure.subplots(1, 3)
    f, g, recorded = relative_costs(run)
    _plot_costs(left, f, g, recorded)
    _plot_mean(middle, (f[:-1] + g) / 2)
    _plot_change(right, [r.change for r in run.history])
    n = len(g)
    for axes in (left, middle, right):
        axes.set(
            yscale='log', xlabel='iteration (0: without correction)', xlim=(-0.03 * n, 1.03 * n)
        )
        if axes is not right:  # a small gain must not look like a large one
            low, high = axes.get_ylim()
            axes.set_ylim(min(low, 9), max(high, 120))
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter('{x:g}')
        axes.yaxis.set_minor_formatter('')
        axes.xaxis.get_major_locator().set_params(integer=True)
        axes.legend(loc='upper center', bbox_to_anchor=(0.5, -0.13))
    return figure


def _plot_costs(axes: Axes, f: np.ndarray, g: np.ndarray, recorded: np.ndarray) -> None:
    axes.plot(
        range(len(recorded)),
        recorded,
        ':',
        color=RED,
        label='G as recorded (in units of the noise\nvariance, which decreases with F)',
    )
    axes.plot(
        range(len(g)),
        g,
        '-',
        color=RED,
        label='G: regression (weighted square sum of\nthe cross-validation, in one unit)',
        **MARKER,
    )
    axes.plot(
        range(len(f)),
        f,
        '-',
        color=BLUE,
        label='F: bundle adjustment\n(weighted square sum of residuals)',
        **MARKER,
    )
    axes.set(title='Relative cost', ylabel='cost [% of iteration 0]')


def _plot_mean(axes: Axes, mean: np.ndarray) -> None:
    axes.plot(
        range(len(mean)),
        mean,
        '-',
        color=BLACK,
        label='mean of F and G (solid lines on the left),\nin percent, with equal weights',
        **MARKER,
    )
    axes.set(title='Weighted average of both costs', ylabel='cost [% of iteration 0]')


def _plot_change(axes: Axes, change: Sequence[float]) -> None:
    axes.plot(
        range(1, len(change) + 1),
        change,
        '-',
        color=BLACK,
        label='change of the correction in the\nnext iteration',
        **MARKER,
    )
    axes.axhline(SETTLED_PX, color=GREY, linestyle='--', label=f'tolerance: {SETTLED_PX:g} px')
    axes.set(title='Convergence of the correction', ylabel='RMS change of the correction [px]')


def _names_text(names: Sequence[str]) -> str:
    if len(names) == 1:
        return f'Fluoroscope {names[0]}'
    return f'Fluoroscopes {" and ".join(names)}, adjusted together'
