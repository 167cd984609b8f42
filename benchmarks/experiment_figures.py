# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Figures of the validation experiment: Figures 1-10 of Chow et al., and further ones."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter
from PIL import Image

from fluoro_calib_ros.io.access import write_bytes
from fluoro_calib_ros.report.figures import BLACK, BLUE, GREY, RED, STYLE, new_figure, png_bytes
from fluoro_calib_ros.simulation.rig import IMAGE_SIZE

from .experiment import BEFORE, GRID_PX, HELD, KNOWN, Residuals
from .experiment_plan import Outcomes, Plan

# Okabe-Ito palette: distinguishable with colour blindness; the markers differ, too.
LOOK = {
    'knn': ('#E69F00', 's'),
    'local_linear': ('#56B4E9', 'o'),
    'parametric': ('#009E73', '^'),
    'hybrid': ('#CC79A7', 'D'),
    'collocation': ('#0072B2', 'v'),
    'auto': ('#000000', 'o'),
    BEFORE: ('#D55E00', 'x'),
    HELD: ('#D55E00', 'P'),
    KNOWN: ('#777777', ''),
}
PANEL = {
    BEFORE: 'before',
    HELD: 'after\n(kNN, interior fixed)',
    'knn': 'after w/ IOP\n(kNN, interior estimated)',
}
STRIPES = 24
LIMIT = 10.0  # range shown, in standard deviations to either side
# F and G by round, in percent of the first round.
Costs = tuple[np.ndarray, ...]
COLOURS = 96  # palette size of a picture: no visible difference at a third of the file size


def title_of(variant: str) -> str:
    """Return the title of a panel: the paper's name of the variant, or the model."""
    return PANEL.get(variant, f'{variant}\n(interior estimated)')


def write_all(plan: Plan, outcomes: Outcomes, folder: str | os.PathLike[str]) -> dict[str, str]:
    """Write all pictures of the experiment.

    Return their paths by key: 'figure 1' to 'figure 10', 'curves', 'map'.
    """
    os.makedirs(folder, exist_ok=True)
    paths = {}
    with style.context(['default', STYLE, {'savefig.dpi': 'figure', 'figure.dpi': 100}]):
        for key, figure in _figures(plan, outcomes):
            figure.set_dpi(100)
            paths[key] = os.path.join(folder, f'validation_{key.replace(" ", "_")}.png')
            write_bytes(paths[key], _small(png_bytes(figure), 256 if key == 'map' else COLOURS))
    return paths


def _small(png: bytes, colours: int) -> bytes:
    """Reduce a PNG image to a palette of colours."""
    buffer = io.BytesIO()
    picture = Image.open(io.BytesIO(png)).convert('RGB')
    picture.quantize(colours, dither=Image.Dither.NONE).save(buffer, 'PNG', optimize=True)
    return buffer.getvalue()


def _figures(plan: Plan, outcomes: Outcomes) -> Iterator[tuple[str, Figure]]:
    """Yield keys and figures of the experiment."""
    shown = tuple(dict.fromkeys((HELD, 'knn', plan.default)))
    of = {
        s: {v: outcomes[c] for v, c in plan.paper_cases(s).items() if not outcomes[c].failed}
        for s in 'ab'
    }
    costs = {v: outcomes[c].costs for v, c in plan.cost_cases().items() if len(outcomes[c].costs)}
    if costs:
        yield 'figure 1', cost_figure(costs)
        yield 'figure 2', total_cost_figure(costs)
    for number, (system, name) in zip((3, 7), (('1', 'a'), ('2', 'b'))):
        residuals = {v: of[name][v].residuals[name] for v in (BEFORE, *shown) if v in of[name]}
        for axis in (0, 1):
            yield f'figure {number + axis}', histogram_figure(residuals, system, axis)
        for axis in (0, 1):
            yield f'figure {number + 2 + axis}', position_figure(residuals, system, axis)
    yield (
        'map',
        map_figure(
            {
                v: of['a'][v].error_map['a']
                for v in dict.fromkeys(('knn', 'local_linear', plan.default))
                if v in of['a']
            }
        ),
    )
    yield 'curves', curve_figure(plan, outcomes)


# ------------------------------------------------------------------------------------------
# Figures 1 and 2


def cost_figure(costs: Mapping[str, Costs]) -> Figure:
    """Plot F and G of every round in percent of the first, one panel per variant."""
    figure = new_figure(
        4.4 * len(costs), 4.6, 'Figure 1: relative cost at every iteration, fluoroscopic system 1'
    )
    panels = np.atleast_1d(figure.subplots(1, len(costs), sharey=True))
    for axes, (variant, (f, g)) in zip(panels, costs.items()):
        axes.plot(range(len(f)), f, '-o', color=BLUE, markersize=4, label='F, bundle adjustment')
        axes.plot(range(len(g)), g, '--s', color=RED, markersize=4, label='G, regression')
        axes.set(yscale='log', title=title_of(variant), xlabel='iteration (0: without correction)')
        _percent(axes, [c for pair in costs.values() for values in pair for c in values])
    panels[0].set_ylabel('cost [% of iteration 0]')
    figure.legend(*panels[0].get_legend_handles_labels(), loc='outside lower center', ncol=2)
    return figure


def total_cost_figure(costs: Mapping[str, Costs]) -> Figure:
    """Plot the mean of F and G of every round, one line per variant."""
    figure = new_figure(9, 4.4, 'Figure 2: weighted average of both costs, fluoroscopic system 1')
    axes = figure.subplots()
    for variant, (f, g) in costs.items():
        colour, marker = LOOK[variant]
        axes.plot(
            range(len(g)),
            (f[: len(g)] + g) / 2,
            '-',
            marker=marker,
            color=colour,
            markersize=5,
            label=title_of(variant).replace('\n', ' '),
        )
    axes.set(
        yscale='log',
        xlabel='iteration (0: without correction)',
        ylabel='(F + G) / 2 [% of iteration 0]',
    )
    _percent(axes, [c for f, g in costs.values() for c in (f[: len(g)] + g) / 2])
    figure.legend(loc='outside lower center', ncol=len(costs))
    return figure


def _percent(axes: Axes, values: Sequence[float]) -> None:
    """Show plain numbers on a logarithmic axis of percentages."""
    shown = [v for v in values if v > 0]
    axes.set_ylim(0.8 * min(shown), 1.25 * max(shown))
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_major_formatter('{x:g}')
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.xaxis.get_major_locator().set_params(integer=True)


# ------------------------------------------------------------------------------------------
# Figures 3 to 10


def histogram_figure(residuals: Mapping[str, Residuals], system: str, axis: int) -> Figure:
    """Plot histograms of normalised residuals of a coordinate, with the standard normal."""
    number = (3 if system == '1' else 7) + axis
    figure = new_figure(
        3.5 * len(residuals),
        4.4,
        f'Figure {number}: histogram of the {"xy"[axis]}-image residuals in '
        f'fluoroscopic system {system}',
    )
    edges = np.linspace(-LIMIT, LIMIT, 81)
    x = np.linspace(-LIMIT, LIMIT, 500)
    top = 0.4
    for axes, (variant, r) in zip(
        figure.subplots(1, len(residuals), sharey=True), residuals.items()
    ):
        v = (r.residual / r.sd[:, None])[:, axis]
        bars = axes.hist(
            v,
            edges,
            weights=np.full(len(v), 1 / (len(v) * (edges[1] - edges[0]))),
            color=LOOK[BEFORE][0] if variant == BEFORE else BLUE,
            alpha=0.65,
        )
        top = max(top, bars[0].max())
        axes.plot(
            x,
            np.exp(-x * x / 2) / np.sqrt(2 * np.pi),
            color=BLACK,
            linewidth=1.5,
            label='standard normal',
        )
        axes.set(title=title_of(variant), xlim=(-LIMIT, LIMIT), xticks=(-8, -4, 0, 4, 8))
        axes.text(
            0.03,
            0.97,
            f'within ±3: {100 * np.mean(np.abs(v) <= 3):.1f} %\nbeyond panel: '
            f'{100 * np.mean(np.abs(v) > LIMIT):.1f} %',
            transform=axes.transAxes,
            va='top',
            fontsize=9,
        )
    figure.axes[0].set(ylabel='probability density [-]', ylim=(0, 1.2 * top))  # room for the text
    figure.axes[0].legend(loc='upper right', fontsize=9, bbox_to_anchor=(1.0, 0.86))
    figure.supxlabel(
        f'{"xy"[axis]} residual / its standard deviation from the simulated noise [-]', fontsize=11
    )
    return figure


def position_figure(residuals: Mapping[str, Residuals], system: str, axis: int) -> Figure:
    """Plot residuals of a coordinate against it; the first panel has its own scale."""
    number = (5 if system == '1' else 9) + axis
    figure = new_figure(
        3.6 * len(residuals),
        4.4,
        f'Figure {number}: {"xy"[axis]}-image residuals as a function of '
        f'their {("column", "row")[axis]} number, fluoroscopic system {system}',
    )
    panels = figure.subplots(1, len(residuals))
    after = [r.residual[r.inlier, axis] for v, r in residuals.items() if v != BEFORE]
    limit = 1.15 * max([np.quantile(np.abs(r), 0.999) for r in after])
    for axes, (variant, r) in zip(panels, residuals.items()):
        own = (
            1.15 * np.quantile(np.abs(r.residual[r.inlier, axis]), 0.999)
            if variant == BEFORE
            else limit
        )
        _scatter(axes, r, axis, own, LOOK[BEFORE][0] if variant == BEFORE else BLUE)
        axes.set(
            title=title_of(variant),
            xlabel=f'{("column u", "row v")[axis]} [px]',
            xlim=(-0.5, IMAGE_SIZE[axis] - 0.5),
            ylim=(-own, own),
        )
        axes.set_xticks([0, 256, 512, 768, 1023])
    panels[0].set_ylabel(f'{"xy"[axis]} residual [px]')
    panels[-1].legend(loc='lower center', ncol=3, fontsize=8, handletextpad=0.2, columnspacing=0.8)
    return figure


def _scatter(axes: Axes, r: Residuals, axis: int, limit: float, colour: str) -> None:
    """Plot inliers as dots, outliers as crosses (at the edge if beyond), and medians by stripe."""
    position = r.uv[:, axis]
    residual = r.residual[:, axis]
    axes.plot(
        position[r.inlier],
        residual[r.inlier],
        '.',
        color=colour,
        markersize=2,
        alpha=0.5,
        label='inliers',
    )
    out = ~r.inlier
    axes.plot(
        position[out],
        np.clip(residual[out], -0.98 * limit, 0.98 * limit),
        'x',
        color=GREY,
        markersize=4,
        label='outliers',
    )
    stripe = np.linspace(-0.5, IMAGE_SIZE[axis] - 0.5, STRIPES + 1)
    of = np.digitize(position, stripe) - 1
    middle = [
        np.median(residual[r.inlier & (of == s)]) if np.sum(r.inlier & (of == s)) > 4 else np.nan
        for s in range(STRIPES)
    ]
    axes.plot(
        (stripe[:-1] + stripe[1:]) / 2, middle, '-', color=BLACK, linewidth=1.5, label='median'
    )


# ------------------------------------------------------------------------------------------
# beyond the paper


def map_figure(maps: Mapping[str, np.ndarray]) -> Figure:
    """Plot the error of the correction over the image, one panel per variant, common scale."""
    figure = new_figure(
        4.3 * len(maps) + 1,
        4.9,
        'Error of the corrected coordinates over the image, fluoroscopic system 1',
        'compressed',
    )
    panels = np.atleast_1d(figure.subplots(1, len(maps), sharey=True))
    sizes = {v: np.hypot(m[..., 0], m[..., 1]) for v, m in maps.items()}
    top = max(np.nanquantile(size, 0.9) for size in sizes.values())
    for axes, (variant, size) in zip(panels, sizes.items()):
        axes.set_facecolor('#BBBBBB')
        axes.grid(False)
        mesh = axes.imshow(
            np.ma.masked_invalid(size),
            cmap='cividis',
            vmin=0,
            vmax=top,
            interpolation='nearest',
            extent=(-0.5, size.shape[1] * GRID_PX - 0.5, size.shape[0] * GRID_PX - 0.5, -0.5),
        )
        axes.set(
            title=f'{variant}: RMSE {np.sqrt(np.nanmean(maps[variant] ** 2)):.3f} px',
            xlabel='column u [px]',
        )
    panels[0].set_ylabel('row v [px]')
    figure.colorbar(
        mesh,
        ax=list(panels),
        label='error of the corrected position [px]',
        extend='max',
        shrink=0.85,
    )
    return figure


def curve_figure(plan: Plan, outcomes: Outcomes) -> Figure:
    """Plot the accuracy of points, source and correction by the number of training exposures."""
    figure = new_figure(
        14,
        5.2,
        f'Accuracy of {plan.exposures - plan.trained} unused exposures by number of '
        'training exposures',
    )
    panels = figure.subplots(1, 3)
    for variant in (*plan.models, KNOWN):
        colour, marker = LOOK.get(variant, (BLACK, '*'))
        look = {
            'color': colour,
            'marker': marker,
            'markersize': 6,
            'label': variant,
            'linewidth': 1.4,
            'linestyle': '--' if variant == KNOWN else '-',
        }
        if (
            variant == plan.default
        ):  # may coincide with the line of the model that was selected: draw it wider and below
            look |= {'linewidth': 4, 'alpha': 0.4, 'markersize': 11, 'zorder': 1.5}
        for axes, values in zip(panels, curves(plan, outcomes, variant)):
            if np.isfinite(values).any():
                axes.plot(plan.curve, values, **look)
    for axes, title, unit in zip(
        panels,
        ('Object points', 'Source position', 'Correction over the image'),
        ('3-D RMSE [mm]', '3-D RMSE [mm]', 'RMSE of a coordinate [px]'),
    ):
        axes.set(title=title, xlabel='training exposures', ylabel=unit, xscale='log', yscale='log')
        axes.set_xticks(plan.curve, [str(c) for c in plan.curve])
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.xaxis.set_tick_params(which='minor', size=0)
        low, high = axes.get_ylim()
        axes.yaxis.set_major_locator(
            LogLocator(subs=(1, 1.5, 2, 3, 5, 7) if high > 4 * low else np.arange(1, 10, 0.5))
        )
        axes.yaxis.set_major_formatter('{x:g}')
        axes.yaxis.set_minor_formatter(NullFormatter())
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc='outside lower center', ncol=len(labels))
    return figure


def curves(plan: Plan, outcomes: Outcomes, variant: str) -> np.ndarray:
    """Return RMS over the rigs (3, counts): object points [mm], source [mm], correction [px]."""
    cases = plan.curve_cases()
    out = np.full((3, len(plan.curve)), np.nan)
    for i, count in enumerate(plan.curve):
        found = [outcomes[cases[variant, count, seed]] for seed in plan.curve_seeds]
        if any(o.failed for o in found):
            continue
        out[0, i] = np.sqrt(np.mean([o.points_mm() ** 2 for o in found]))
        out[1, i] = np.sqrt(np.mean([o.source_mm() ** 2 for o in found]))
        if variant != KNOWN:
            out[2, i] = np.sqrt(np.mean([o.image_px('a') ** 2 for o in found]))
    return out
