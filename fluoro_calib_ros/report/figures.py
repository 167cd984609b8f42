"""The pictures of a self-calibration as PNG files (Figures 1-10 of Chow et al., and the distortion
field).

No display and no pyplot. The colours are those of Okabe and Ito, which colour-blind people can
tell apart.
"""

import io
import os

import numpy as np
from matplotlib import style
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import LogLocator

from ..calibration.rounds import SETTLED_PX
from ..files.access import check_safe_name, make_folder
from ..files.atomic import write_bytes
from ..photogrammetry.noise import MIN_REDUNDANCY
from ..photogrammetry.precision import geometric_redundancy

DPI = 120
STYLE = {
    'font.size': 11,
    'axes.titlesize': 12,
    'figure.titlesize': 14,
    'legend.fontsize': 10,
    'axes.grid': True,
    'grid.alpha': 0.3,
    'axes.axisbelow': True,
}
BLUE = '#0072B2'
RED = '#D55E00'
GREY = '#777777'
BLACK = '#000000'
BEFORE = RED
AFTER = BLUE
WIDEST_HISTOGRAM = 15.0  # standard deviations to either side
STRIPES = 16  # of the image, for the running median
# along the longer side of the image
FIELD_CELLS = 160
FIELD_ARROWS = 17
MARGIN = (
    0.09  # of the longer side, about the image for the arrows of its rim, and twice that below it
)


def write_figures(job, directory):
    """Write the figures of a CalibrationResult into a folder, which is made if need be; returns their
    paths.

    For every run cost_<label>.png, for every fluoroscope residuals_histogram_, residuals_position_
    and distortion_<fluoroscope>.png. Without a correction model there is neither a cost nor a
    distortion to show; a job without runs has no figures. Each file is whole or not there. Sets
    matplotlib's style while it draws: not for two threads at once. Raises DataError where a file
    cannot be written.
    """
    make_folder(directory)
    drawn = {}
    with style.context(['default', STYLE]):  # whatever matplotlibrc says
        for label, run in job.runs.items():
            drawn.update((name, png_bytes(figure)) for name, figure in _figures_of_run(label, run))
    paths = [os.path.join(directory, name) for name in drawn]
    for path, content in zip(paths, drawn.values()):
        write_bytes(path, content)
    return paths


def _figures_of_run(label, run):
    """File names and figures of a SelfCalibration."""
    network = run.measured.network
    if any(model.kind != 'none' for model in run.models.values()):
        yield f'cost_{label}.png', cost_figure(run)
    redundancy = np.maximum(
        geometric_redundancy(network, run.after.parameters, run.after.noise), MIN_REDUNDANCY
    )
    for f, name in enumerate(run.measured.fluoroscopes):
        check_safe_name(name, 'report')
        rows = np.flatnonzero(network.fluoroscope[network.exposure] == f)
        yield (
            f'residuals_histogram_{name}.png',
            histogram_figure(run, name, rows, redundancy[rows]),
        )
        yield (
            f'residuals_position_{name}.png',
            position_figure(run, name, rows, run.measured.image_size[f]),
        )
        if run.models[name].kind != 'none':
            yield (
                f'distortion_{name}.png',
                distortion_figure(
                    run.models[name],
                    name,
                    run.measured.image_size[f],
                    bool(network.interior_free[f]),
                ),
            )


def new_figure(width, height, title, layout='constrained'):
    """An empty figure, width and height in inches."""
    figure = Figure(figsize=(width, height), dpi=DPI, layout=layout)
    figure.suptitle(title)
    return figure


def _described(model):
    if model.kind == 'none':
        return 'no correction model'
    return f'{model.kind}, k = {model.k}' if model.k else model.kind


def png_bytes(figure):
    """Bytes of a figure as PNG, the same for the same figure."""
    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer, metadata={'Software': None})
    return buffer.getvalue()


# ----------------------------------------------------------------------------------------------------------
# cost


def relative_costs(run):
    """F (n+1,), G (n,) and recorded G (n,) of the n rounds of a SelfCalibration, in percent of
    their first.

    F[i] is the weighted square sum of the residuals of adjustment i, 0 being that without
    correction; G[i] the cross-validation of the model that is fitted to them. G is recorded in
    units of the noise as adjustment i estimates it. The noise shrinks as the distortion goes, and
    by that alone recorded G grows. The estimated variance follows F, so G times F is in the same
    unit in all rounds.
    """
    before = run.before
    first = float(np.sum(before.noise.weight(before.q)[:, None] * before.residuals**2))
    f = np.array([first] + [r.quadratic for r in run.history])
    recorded = np.array([r.G for r in run.history])
    g = recorded * f[:-1]
    return 100 * f / f[0], 100 * g / g[0], 100 * recorded / recorded[0]


def cost_figure(run):
    """Cost of the adjustment and of the regression, their mean, and what a round still changes."""
    names = run.measured.fluoroscopes
    kinds = ', '.join(sorted({model.kind for model in run.models.values()}))
    end = 'converged' if run.converged else 'NOT converged'
    figure = new_figure(
        15,
        6,
        f'{_title_of(names)}: self-calibration with {kinds}, {end} after '
        f'{len(run.history)} iterations',
    )
    left, middle, right = figure.subplots(1, 3)
    f, g, recorded = relative_costs(run)
    n = len(g)
    mark = {'marker': 'o', 'markersize': 4}
    left.plot(
        range(n),
        recorded,
        ':',
        color=RED,
        label='G as recorded (its unit, the noise\nvariance, shrinks with F)',
    )
    left.plot(
        range(n),
        g,
        '-',
        color=RED,
        label='G: regression (weighted square sum of\nthe cross-validation, all in one unit)',
        **mark,
    )
    left.plot(
        range(n + 1),
        f,
        '-',
        color=BLUE,
        label='F: bundle adjustment\n(weighted square sum of residuals)',
        **mark,
    )
    left.set(title='Relative cost', ylabel='cost [% of iteration 0]')
    middle.plot(
        range(n),
        (f[:-1] + g) / 2,
        '-',
        color=BLACK,
        label='mean of F and G (solid lines on the left),\nin percent, with equal weights',
        **mark,
    )
    middle.set(title='Weighted average of both costs', ylabel='cost [% of iteration 0]')
    right.plot(
        range(1, n + 1),
        [r.change for r in run.history],
        '-',
        color=BLACK,
        label='change of the correction that the\nnext iteration would make',
        **mark,
    )
    right.axhline(
        SETTLED_PX, color=GREY, linestyle='--', label=f'counts as settled: {SETTLED_PX:g} px'
    )
    right.set(title='What is still moving', ylabel='RMS change of the correction [px]')
    for axes in (left, middle, right):
        axes.set(
            yscale='log', xlabel='iteration (0: without correction)', xlim=(-0.03 * n, 1.03 * n)
        )
        if axes is not right:  # a small gain is not to look like a large one
            low, high = axes.get_ylim()
            axes.set_ylim(min(low, 9), max(high, 120))
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter('{x:g}')
        axes.yaxis.set_minor_formatter('')
        axes.xaxis.get_major_locator().set_params(integer=True)
        axes.legend(loc='upper center', bbox_to_anchor=(0.5, -0.13))
    return figure


def _title_of(names):
    return (
        f'Fluoroscope {names[0]}'
        if len(names) == 1
        else f'Fluoroscopes {" and ".join(names)}, adjusted together'
    )


# -----------------------------------------------------------------------------------------------------
# residuals


def normalised_residuals(run, rows, redundancy):
    """Inlier residuals in units of their standard deviation, before (n, 2) and after (m, 2).

    The standard deviation of a residual is s0 sigma sqrt(redundancy number): smaller than that of
    the image noise by what the unknowns absorb. s0 is that of the inliers after the calibration,
    for both, so that what is left of the distortion shows as width. Not divided by the root of
    diag C_r: it holds the robust weight of each point, which is made from that very residual, and
    every tail would vanish.
    """
    sd = run.measured.network.sigma[rows] * np.sqrt(redundancy)
    inside = run.after.inliers[rows]
    after = run.after.residuals[rows][inside] / sd[inside, None]
    # A residual of low redundancy tells little of the noise and counts accordingly.
    s0 = np.sqrt(np.average(np.mean(after**2, axis=1), weights=redundancy[inside]))
    outside = run.before.inliers[rows]
    return run.before.residuals[rows][outside] / sd[outside, None] / s0, after / s0


def histogram_figure(run, name, rows, redundancy):
    """Histograms of the normalised residuals of one fluoroscope, with the unit normal."""
    before, after = normalised_residuals(run, rows, redundancy)
    figure = new_figure(
        13,
        6.3,
        f'Fluoroscope {name}: normalised residuals before and after the calibration '
        f'({_described(run.models[name])})',
    )
    limit = float(np.clip(2.5 * before.std(), 5, WIDEST_HISTOGRAM))
    edges = np.linspace(-limit, limit, 2 * round(limit / 0.25) + 1)
    x = np.linspace(-limit, limit, 400)
    for axis, axes in enumerate(figure.subplots(1, 2, sharey=True)):
        for values, colour, alpha, when in (
            (before, BEFORE, 0.45, 'before'),
            (after, AFTER, 0.5, 'after'),
        ):
            v = values[:, axis]
            beyond = 100 - _within(v, limit)
            axes.hist(
                v,
                edges,
                weights=np.full(len(v), 1 / (len(v) * (edges[1] - edges[0]))),
                color=colour,
                alpha=alpha,
                histtype='stepfilled',
                edgecolor=colour,
                label=f'{when}: standard deviation {v.std():.1f}, {_within(v, 3):.1f} % within ±3'
                + (f', {beyond:.1f} % beyond the panel' if beyond >= 0.05 else ''),
            )
        axes.plot(
            x,
            np.exp(-x * x / 2) / np.sqrt(2 * np.pi),
            color=BLACK,
            linewidth=2,
            label='unit normal: 99.7 % within ±3',
        )
        axes.set(
            title=f'{"uv"[axis]} ({("column", "row")[axis]})',
            xlim=(-limit, limit),
            xlabel=f'{"uv"[axis]} residual / its standard deviation from image noise [-]',
        )
        axes.legend(loc='upper center', bbox_to_anchor=(0.5, -0.12))
    figure.axes[0].set_ylabel('probability density [-]')
    figure.supxlabel(
        f'Inliers only: {len(before)} of the {len(rows)} image points before, {len(after)} after.',
        fontsize=11,
    )
    return figure


def _within(values, limit):
    return 100 * np.mean(np.abs(values) <= limit)


def position_figure(run, name, rows, image_size):
    """Residuals of one fluoroscope over the image: before, after to the same scale, and after to
    its own.
    """
    figure = new_figure(
        15, 8.4, f'Fluoroscope {name}: residuals over the image ({_described(run.models[name])})'
    )
    uv = run.measured.network.uv[rows]
    grid = figure.subplots(2, 3)
    for axis in (0, 1):
        limits = [
            1.1 * np.quantile(np.abs(a.residuals[rows][a.inliers[rows], axis]), 0.999)
            for a in (run.before, run.after)
        ]
        for axes, adjustment, limit, colour, when in zip(
            grid[axis],
            (run.before, run.after, run.after),
            (max(limits), max(limits), limits[1]),
            (BEFORE, AFTER, AFTER),
            ('before', 'after, same scale', 'after, own scale'),
        ):
            inside = adjustment.inliers[rows]
            residual = adjustment.residuals[rows, axis]
            _residual_panel(axes, uv[:, axis], residual, inside, limit, image_size[axis], colour)
            rmse = np.sqrt(np.mean(residual[inside] ** 2))
            axes.set(
                title=f'{"uv"[axis]} {when}:\nRMSE {rmse:.3f} px, {np.sum(~inside)} of {len(rows)} outliers',
                xlabel=('column u [px]', 'row v [px]')[axis],
                ylabel=f'{"uv"[axis]} residual [px]',
            )
    figure.supxlabel(
        'Dots: inliers. Crosses: outliers, not in the RMSE, and those at the upper and lower rim lie '
        'beyond the panel. Line: running median of the inliers.',
        fontsize=11,
    )
    return figure


def _residual_panel(axes, position, residual, inside, limit, size, colour):
    """Residuals (n,) over a position (n,), outliers as crosses: those beyond the panel at its rim."""
    axes.plot(position[inside], residual[inside], '.', color=colour, markersize=3, alpha=0.6)
    out = ~inside
    axes.plot(
        position[out],
        np.clip(residual[out], -0.97 * limit, 0.97 * limit),
        'x',
        color=GREY,
        markersize=5,
    )
    stripe = np.linspace(-0.5, size - 0.5, STRIPES + 1)
    of = np.digitize(position, stripe) - 1
    middles = [
        np.median(residual[inside & (of == s)]) if np.any(inside & (of == s)) else np.nan
        for s in range(STRIPES)
    ]
    axes.plot((stripe[:-1] + stripe[1:]) / 2, middles, '-', color=BLACK, linewidth=2)
    axes.axhline(0, color=BLACK, linewidth=0.6)
    axes.set(xlim=(-0.5, size - 0.5), ylim=(-limit, limit))


# ----------------------------------------------------------------------------------------------------
# distortion


def distortion_figure(model, name, image_size, interior_estimated):
    """The learned distortion as arrows over its magnitude, and its standard deviation with the
    training points.
    """
    width, height = np.asarray(image_size) + np.array([2, 3]) * MARGIN * max(image_size)
    figure = new_figure(
        15,
        min(2 + 5.3 * height / width, 15),
        f'Fluoroscope {name}: learned distortion ({_described(model)})',
        'compressed',
    )
    left, right = figure.subplots(1, 2)
    centres, field = _field_on_grid(model, image_size, FIELD_CELLS)
    for axes, values, colours, bar in (
        (left, np.hypot(*field.duv.T), 'YlOrRd', 'magnitude [px]'),
        (right, field.sd, 'cividis', 'standard deviation [px]'),
    ):
        shown = np.ma.masked_array(values, field.outside).reshape(len(centres[1]), len(centres[0]))
        _image_frame(axes, image_size)
        mesh = axes.pcolormesh(*centres, shown, cmap=colours, vmin=0, shading='nearest')
        figure.colorbar(mesh, ax=axes, label=bar)
    factor = _draw_arrows(left, model, image_size)
    left.set_title(
        f'Displacement (du, dv) = observed - undistorted,\narrows {factor:g} times enlarged'
    )
    right.plot(*model.train_uv.T, '.', color='white', markersize=2, alpha=0.5)
    right.set_title(
        f'Standard deviation of du and of dv,\ndots: the {len(model.train_uv)} training points'
    )
    gauge = (
        'Shift, scale, rotation and tilt are in the interior and exterior orientation, not in this field.'
        if interior_estimated
        else 'The interior orientation was held: its errors (shift and scale) are part of this field.'
    )
    figure.supxlabel(f'{gauge} Hatched: outside the calibrated area.', fontsize=11)
    return figure


def _field_on_grid(model, image_size, cells):
    """Columns and rows of a regular grid over the image [px], and the Correction at its points."""
    step = max(image_size) / cells
    centres = [
        -0.5 + step / 2 + step * np.arange(max(1, round(size / step))) for size in image_size
    ]
    u, v = np.meshgrid(*centres)
    return centres, model.evaluate(np.column_stack([u.ravel(), v.ravel()]))


def _image_frame(axes, image_size):
    """The image as a hatched area with a frame, v pointing down."""
    width, height = image_size
    margin = MARGIN * max(image_size)
    image = {'xy': (-0.5, -0.5), 'width': width, 'height': height}
    axes.add_patch(
        Rectangle(**image, facecolor='white', edgecolor='#AAAAAA', hatch='///', zorder=0.5)
    )
    axes.add_patch(Rectangle(**image, fill=False, edgecolor=BLACK, linewidth=1.2, zorder=3))
    axes.set(
        xlim=(-margin, width + margin),
        ylim=(height + 2 * margin, -margin),
        aspect='equal',
        xlabel='column u [px]',
        ylabel='row v [px]',
    )
    axes.grid(False)


def _draw_arrows(axes, model, image_size):
    """Arrows of the field, with one for reference below the image; returns how much they are
    enlarged.
    """
    centres, field = _field_on_grid(model, image_size, FIELD_ARROWS)
    u, v = (grid.ravel()[~field.outside] for grid in np.meshgrid(*centres))
    duv = field.duv[~field.outside]
    largest = max(float(np.max(np.hypot(*duv.T), initial=0.0)), 1e-6)
    # Two cells long at most: arrows hardly overlap, and small ones can be seen.
    factor = _round_down(2 * max(image_size) / FIELD_ARROWS / largest)
    reference = _round_down(largest)
    below = image_size[1] + 0.13 * max(image_size)
    axes.quiver(
        np.append(u, 0),
        np.append(v, below),
        np.append(duv[:, 0], reference),
        np.append(duv[:, 1], 0),
        angles='xy',
        scale_units='xy',
        scale=1 / factor,
        width=0.0045,
        color=BLACK,
        edgecolor='white',
        linewidth=0.5,
        zorder=4,
    )
    axes.text(reference * factor + 0.02 * max(image_size), below, f'{reference:g} px', va='center')
    return factor


def _round_down(value):
    """The largest of 1, 1.5, 2, 3, 5, 7, 10, ... and their decimal parts that is not above value."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(
        power * max(digit for digit in (1, 1.5, 2, 3, 5, 7) if digit * power <= value * (1 + 1e-9))
    )
