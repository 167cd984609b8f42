# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Figures of the report: cost, and residuals and coverage over the image and by exposure."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence

import numpy as np
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator
from numpy.typing import NDArray
from scipy.special import ndtri

from ..estimation.result import CalibrationResult
from ..estimation.rounds import SETTLED_PX, SelfCalibration
from ..exposures.collector import coverage_of
from ..io.access import check_safe_name, make_folder, write_bytes
from ..photogrammetry.noise import MIN_REDUNDANCY
from ..photogrammetry.precision import geometric_redundancy
from .figures import (
    AFTER,
    BEFORE,
    BLACK,
    BLUE,
    GREY,
    RED,
    STYLE,
    Scale,
    common_scale,
    distortion_figure,
    image_axes,
    new_figure,
    png_bytes,
)
from .residuals import Residuals, histogram_figure, position_figure
from .tables import model_text


def relative_costs(
    run: SelfCalibration,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return F (n+1,), G (n,) and recorded G (n,) of n rounds, in percent of their first values.

    F[i] is the weighted square sum of the residuals of adjustment i, where adjustment 0 has no
    correction; G[i] is the cross-validation of the model that is fitted to these residuals. G is
    recorded in units of the noise estimated by adjustment i. The noise decreases with the
    distortion, which alone makes the recorded G grow. The estimated variance follows F, so G times
    F has the same unit in all rounds.
    """
    before = run.before
    initial = float(np.sum(before.noise.weight(before.q)[:, None] * before.residuals**2))
    f = np.array([initial] + [r.quadratic for r in run.history])
    recorded = np.array([r.G for r in run.history])
    g = recorded * f[:-1]
    return 100 * f / f[0], 100 * g / g[0], 100 * recorded / recorded[0]


def cost_figure(run: SelfCalibration) -> Figure:
    """Return the costs of adjustment and regression, their mean, and the change in each round."""
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
    label = 'G as recorded (in units of the noise\nvariance, which decreases with F)'
    left.plot(range(len(recorded)), recorded, ':', color=RED, label=label)
    label = 'G: regression (weighted square sum of\nthe cross-validation, in one unit)'
    _curve(left, g.tolist(), RED, label)
    _curve(left, f.tolist(), BLUE, 'F: bundle adjustment\n(weighted square sum of residuals)')
    left.set(title='Relative cost', ylabel='cost [% of iteration 0]')
    label = 'mean of F and G (solid lines on the left),\nin percent, with equal weights'
    _curve(middle, ((f[:-1] + g) / 2).tolist(), BLACK, label)
    middle.set(title='Weighted average of both costs', ylabel='cost [% of iteration 0]')
    label = 'change of the correction in the\nnext iteration'
    _curve(right, [r.change for r in run.history], BLACK, label, 1)
    right.axhline(SETTLED_PX, color=GREY, linestyle='--', label=f'tolerance: {SETTLED_PX:g} px')
    right.set(title='Convergence of the correction', ylabel='RMS change of the correction [px]')
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


def _curve(axes: Axes, values: Sequence[float], colour: str, label: str, first: int = 0) -> None:
    """Draw a value for each iteration, starting with number `first`."""
    iterations = range(first, first + len(values))
    axes.plot(iterations, values, '-', color=colour, label=label, marker='o', markersize=4)


def _names_text(names: Sequence[str]) -> str:
    if len(names) == 1:
        return f'Fluoroscope {names[0]}'
    return f'Fluoroscopes {" and ".join(names)}, adjusted together'


ARROW_SHARE = 0.03  # arrow of the 99 % quantile of residuals, over the image size


def residual_map(residuals: Residuals, name: str, image_size: tuple[int, int]) -> Figure:
    """Return the residuals after the calibration as arrows over the image; grey: not covered."""
    width, height = image_size
    figure = new_figure(7.5, 7.5 * height / width + 0.6, f'{name}: residuals and coverage')
    axes = figure.subplots()
    covered = coverage_of(residuals.uv, image_size).covered
    axes.imshow(
        np.where(covered, np.nan, 1.0),
        extent=(-0.5, width - 0.5, height - 0.5, -0.5),
        cmap='Greys',
        vmin=0,
        vmax=3,
        interpolation='nearest',
    )
    after = residuals.after[residuals.inlier]
    length = np.hypot(*after.T)
    typical = float(np.quantile(length, 0.99)) if len(length) else 1.0
    factor = ARROW_SHARE * max(image_size) / max(typical, 1e-9)
    factor = float(f'{factor:.1g}')
    u, v = residuals.uv[residuals.inlier].T
    du, dv = after.T * factor
    axes.quiver(u, v, du, dv, angles='xy', scale_units='xy', scale=1, color=AFTER, width=0.0015)
    outlier_uv = residuals.uv[~residuals.inlier]
    axes.plot(*outlier_uv.T, 'x', color=BEFORE, markersize=4, label=f'{len(outlier_uv)} outliers')
    axes.set(**image_axes(image_size))
    axes.grid(False)
    axes.set_title(f'arrows magnified {factor:g} times; grey: no bead was seen here')
    if len(outlier_uv):
        axes.legend(loc='upper right')
    return figure


def exposure_bars(residuals: Residuals, name: str) -> Figure:
    """Return the RMS of the residuals and the number of beads by exposure."""
    numbers, counts, _, after = zip(*residuals.of_exposures())
    figure = new_figure(7.5, 4.6, f'{name}: by exposure')
    upper, lower = figure.subplots(2, 1, sharex=True)
    positions = np.arange(len(numbers))
    upper.bar(positions, after, color=AFTER)
    upper.axhline(np.median(after), color=BLACK, linewidth=1)
    upper.set(ylabel='RMS [px]', title='line: median')
    lower.bar(positions, counts, color=GREY)
    lower.set(ylabel='beads', xlabel='exposure')
    step = max(1, len(numbers) // 15)
    lower.set_xticks(positions[::step], [str(number) for number in numbers[::step]])
    return figure


def distribution(residuals: Residuals, name: str) -> Figure:
    """Return the histogram of the inlier residuals [px], and their quantiles against a normal."""
    values = residuals.after[residuals.inlier].ravel()
    figure = new_figure(7.5, 3.8, f'{name}: residuals in px')
    left, right = figure.subplots(1, 2)
    sd = 1.4826 * float(np.median(np.abs(values)))
    limit = 5 * max(sd, 1e-9)
    left.hist(np.clip(values, -limit, limit), 41, color=AFTER, alpha=0.6, density=True)
    x = np.linspace(-limit, limit, 200)
    normal = np.exp(-((x / max(sd, 1e-9)) ** 2) / 2) / (np.sqrt(2 * np.pi) * max(sd, 1e-9))
    left.plot(x, normal, color=BLACK, linewidth=1)
    left.set(xlabel='residual [px]', title=f'robust sd {sd:.3f} px')
    quantile = ndtri((np.arange(len(values)) + 0.5) / len(values))
    right.plot(quantile, np.sort(values), '.', color=AFTER, markersize=3)
    right.plot(quantile[[0, -1]], sd * quantile[[0, -1]], color=BLACK, linewidth=1)
    right.set(xlabel='standard normal', ylabel='residual [px]', title='quantiles')
    return figure


def bead_shifts(shift_mm: NDArray[np.float64], sd_mm: NDArray[np.float64]) -> Figure:
    """Return the shifts of the beads from the survey (n, 3) [mm], also relative to its sd."""
    figure = new_figure(7.5, 3.6, 'Beads: adjusted minus survey')
    left, right = figure.subplots(1, 2)
    left.hist(shift_mm, 30, histtype='step', label=['x', 'y', 'z'], linewidth=1.5)
    left.set(xlabel='shift [mm]')
    left.legend()
    ratio = np.sqrt(np.mean(shift_mm**2, axis=1)) / sd_mm
    right.hist(ratio, 30, color=GREY)
    right.set(xlabel='RMS of x, y, z over sd of the survey')
    return figure


# Figures of a self-calibration as PNG files: Figures 1 to 10 of Chow et al., and the distortion
# field.


def write_figures(result: CalibrationResult, directory: str | os.PathLike[str]) -> list[str]:
    """Write the figures of a calibration into a folder, which is created if necessary.

    For every run there is cost_<label>.png, for every fluoroscope residuals_histogram_<name>.png,
    residuals_position_<name>.png and distortion_<name>.png. Without a correction model there is
    neither a cost nor a distortion figure, and a result without runs has no figures. Each file
    appears only once it is complete. This function sets matplotlib's style while drawing, so it
    must not run in two threads at once.

    Returns the paths. Raises DataError if a file cannot be written.
    """
    make_folder(directory)
    drawn = {}
    with style.context(['default', STYLE]):  # independent of matplotlibrc
        scale = common_scale(
            (run.models[name], image_size)
            for run in result.runs.values()
            for name, image_size in zip(run.measured.fluoroscopes, run.measured.image_size)
            if name in run.models and run.models[name].corrects
        )
        for label, run in result.runs.items():
            for name, figure in _figures_of_run(label, run, scale):
                drawn[name] = png_bytes(figure)
    paths = []
    for name, content in drawn.items():
        path = os.path.join(directory, name)
        write_bytes(path, content)
        paths.append(path)
    return paths


def _figures_of_run(
    label: str, run: SelfCalibration, scale: Scale
) -> Iterator[tuple[str, Figure]]:
    """Yield file names and figures of one run; scale: common scale of the distortions."""
    network = run.measured.network
    if any(model.corrects for model in run.models.values()):
        yield f'cost_{label}.png', cost_figure(run)
    redundancy = np.maximum(
        geometric_redundancy(network, run.after.parameters, run.after.noise), MIN_REDUNDANCY
    )
    for number, name in enumerate(run.measured.fluoroscopes):
        check_safe_name(name, 'report')
        rows = np.flatnonzero(network.fluoroscope[network.exposure] == number)
        image_size = run.measured.image_size[number]
        histogram = histogram_figure(run, name, rows, redundancy[rows])
        yield f'residuals_histogram_{name}.png', histogram
        title = f'Fluoroscope {name}: residuals over the image ({model_text(run.models[name])})'
        before, after = (
            (adjustment.residuals[rows], adjustment.inliers[rows])
            for adjustment in (run.before, run.after)
        )
        position = position_figure(title, network.uv[rows], before, after, image_size)
        yield f'residuals_position_{name}.png', position
        model = run.models[name]
        if model.corrects:
            interior_estimated = bool(network.interior_free[number])
            distortion = distortion_figure(model, name, image_size, interior_estimated, scale)
            yield f'distortion_{name}.png', distortion
