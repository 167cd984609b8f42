# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Residuals of a calibration, recomputed from its result folder, and their figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ..correction.fluoroscope_calibration import FluoroscopeCalibration
from ..estimation.rounds import SelfCalibration
from ..exposures.frame import Frame
from ..photogrammetry.collinearity import project
from .figures import AFTER, BEFORE, BLACK, GREY, new_figure
from .tables import model_text

Pose = tuple[NDArray[np.float64], NDArray[np.float64]]


@dataclass(frozen=True)
class Residuals:
    """Image residuals of one fluoroscope."""

    exposure: NDArray[np.int64]  #: (n,)
    target_id: NDArray[np.int64]  #: (n,)
    uv: NDArray[np.float64]  #: (n, 2), observed pixels
    #: (n, 2), residuals of the observed and of the corrected pixels, minus computed [px]
    before: NDArray[np.float64]
    after: NDArray[np.float64]
    inlier: NDArray[np.bool_]  #: (n,), False for image points that failed their outlier test
    #: (n,), angle of the C-arm [rad], NaN if unknown; None if always unknown
    angle: NDArray[np.float64] | None = None

    def of_exposures(self) -> list[tuple[int, int, float, float]]:
        """Return number, inliers, and RMS before and after [px] for each exposure."""
        statistics = []
        for number in np.unique(self.exposure):
            rows = (self.exposure == number) & self.inlier
            statistics.append(
                (int(number), int(rows.sum()), _rms(self.before[rows]), _rms(self.after[rows]))
            )
        return statistics


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float('nan')


def residuals_of(
    calibration: FluoroscopeCalibration,
    frames: Sequence[Frame],
    poses: Mapping[int, Pose],
    points_mm: Mapping[int, NDArray[np.float64]],
    outliers: set[tuple[int, int]],
) -> Residuals:
    """Return the residuals of the frames of a fluoroscope.

    poses: exterior orientation by exposure; frames of other exposures were not used. points_mm:
    adjusted object points (3,) by target.
    """
    exposure = [np.zeros(0, dtype=int)]
    target_id = [np.zeros(0, dtype=int)]
    uv = [np.zeros((0, 2))]
    angle = [np.zeros(0)]
    computed = [np.zeros((0, 2))]
    for frame in frames:
        if frame.number not in poses:
            continue
        rows = [i for i, target in enumerate(frame.target_id.tolist()) if target in points_mm]
        ids = frame.target_id[rows]
        rotation, position = poses[frame.number]
        points = np.array([points_mm[i] for i in ids.tolist()]).reshape(-1, 3)
        count = len(ids)
        exposure.append(np.full(count, frame.number))
        target_id.append(ids)
        uv.append(frame.uv[rows])
        angle.append(np.full(count, np.nan if frame.angle is None else frame.angle))
        computed.append(
            project(
                np.broadcast_to(rotation, (count, 3, 3)),
                np.broadcast_to(position, (count, 3)),
                points,
                calibration.interior,
            )
        )
    numbers, ids = np.concatenate(exposure), np.concatenate(target_id)
    observed, expected = np.concatenate(uv), np.concatenate(computed)
    angles = np.concatenate(angle)
    corrected = calibration.correct(observed, exact=True, angle=angles).uv
    inlier = np.array([pair not in outliers for pair in zip(numbers.tolist(), ids.tolist())])
    return Residuals(
        numbers,
        ids,
        uv=observed,
        before=observed - expected,
        after=corrected - expected,
        inlier=inlier.astype(bool),
        angle=angles,
    )


MIN_HISTOGRAM_SD = 5.0  # range of the histogram, in standard deviations to either side
MAX_HISTOGRAM_SD = 15.0
BIN_SD = 0.25  # width of a bin, in standard deviations
STRIPES = 16  # number of stripes across the image, for the running median
COORDINATES = ('u', 'v')


def normalised_residuals(
    run: SelfCalibration, rows: NDArray[np.int64], redundancy: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return inlier residuals in units of their standard deviation, before (n, 2), after (m, 2).

    rows (k,): indices of image points; redundancy (k,): their redundancy numbers. The standard
    deviation of a residual is s0 sigma sqrt(redundancy number): it is smaller than that of the
    image noise, as the unknowns absorb part of the error. s0 is estimated from the inliers after
    the calibration and used for both, so that remaining distortion shows as width. The root of
    diag C_r is not suitable: it contains the robust weight of each point, which depends on that
    very residual, and every tail would vanish.
    """
    sd = run.measured.network.sigma[rows] * np.sqrt(redundancy)
    inliers = run.after.inliers[rows]
    after = run.after.residuals[rows][inliers] / sd[inliers, None]
    # A residual with low redundancy says little about the noise, so it has a small weight.
    s0 = np.sqrt(np.average(np.mean(after**2, axis=1), weights=redundancy[inliers]))
    inliers_before = run.before.inliers[rows]
    before = run.before.residuals[rows][inliers_before] / sd[inliers_before, None]
    return before / s0, after / s0


def histogram_figure(
    run: SelfCalibration, name: str, rows: NDArray[np.int64], redundancy: np.ndarray
) -> Figure:
    """Return histograms of the normalised residuals of a fluoroscope, with the standard normal.

    rows (k,): its image points; redundancy (k,): their redundancy numbers.
    """
    before, after = normalised_residuals(run, rows, redundancy)
    figure = new_figure(
        13,
        6.3,
        f'Fluoroscope {name}: normalised residuals before and after the calibration '
        f'({model_text(run.models[name])})',
    )
    limit = float(np.clip(2.5 * before.std(), MIN_HISTOGRAM_SD, MAX_HISTOGRAM_SD))
    for axis, axes in enumerate(figure.subplots(1, 2, sharey=True)):
        _plot_histogram(axes, before[:, axis], limit, 'before')
        _plot_histogram(axes, after[:, axis], limit, 'after')
        x = np.linspace(-limit, limit, 400)
        axes.plot(
            x,
            np.exp(-x * x / 2) / np.sqrt(2 * np.pi),
            color=BLACK,
            linewidth=2,
            label='standard normal: 99.7 % within ±3',
        )
        coordinate = COORDINATES[axis]
        axes.set(
            title=f'{coordinate} ({("column", "row")[axis]})',
            xlim=(-limit, limit),
            xlabel=f'{coordinate} residual / its standard deviation from image noise [-]',
        )
        axes.legend(loc='upper center', bbox_to_anchor=(0.5, -0.12))
    figure.axes[0].set_ylabel('probability density [-]')
    figure.supxlabel(
        f'Inliers only: {len(before)} of the {len(rows)} image points before, {len(after)} after.',
        fontsize=11,
    )
    return figure


def _plot_histogram(axes: Axes, values: NDArray[np.float64], limit: float, when: str) -> None:
    """Draw a histogram of values (n,) from -limit to limit; when: 'before' or 'after'."""
    colour, alpha = (BEFORE, 0.45) if when == 'before' else (AFTER, 0.5)
    edges = np.linspace(-limit, limit, 2 * round(limit / BIN_SD) + 1)
    beyond = 100 - _percent_within(values, limit)
    label = f'{when}: standard deviation {values.std():.1f}, {_percent_within(values, 3):.1f} % '
    label += 'within ±3'
    if beyond >= 0.05:
        label += f', {beyond:.1f} % beyond the panel'
    axes.hist(
        values,
        edges.tolist(),
        weights=np.full(len(values), 1 / (len(values) * (edges[1] - edges[0]))),
        color=colour,
        alpha=alpha,
        histtype='stepfilled',
        edgecolor=colour,
        label=label,
    )


def _percent_within(values: NDArray[np.float64], limit: float) -> float:
    return 100 * np.mean(np.abs(values) <= limit)


Residual = tuple[NDArray[np.float64], NDArray[np.bool_]]  # (n, 2) [px], and inlier mask (n,)


def position_figure(
    title: str,
    uv: NDArray[np.float64],
    before: Residual,
    after: Residual,
    image_size: tuple[int, int],
) -> Figure:
    """Return the residuals of a fluoroscope over the image, before and after the calibration.

    Those after it are shown at the scale of those before, and at their own. uv (n, 2): pixels.
    """
    figure = new_figure(15, 8.4, title)
    grid = figure.subplots(2, 3)
    for axis, coordinate in enumerate(COORDINATES):
        limit_after = _residual_limit(after, axis)
        limit = max(_residual_limit(before, axis), limit_after)
        for axes, (residuals, inliers), panel_limit, colour, stage in zip(
            grid[axis],
            (before, after, after),
            (limit, limit, limit_after),
            (BEFORE, AFTER, AFTER),
            ('before', 'after, same scale', 'after, own scale'),
        ):
            residual = residuals[:, axis]
            _plot_residuals(
                axes,
                uv[:, axis],
                residual=residual,
                inliers=inliers,
                limit=panel_limit,
                colour=colour,
            )
            _plot_running_median(axes, uv[inliers, axis], residual[inliers], image_size[axis])
            axes.set(xlim=(-0.5, image_size[axis] - 0.5), ylim=(-panel_limit, panel_limit))
            rmse = np.sqrt(np.mean(residual[inliers] ** 2))
            outliers = f'{np.sum(~inliers)} of {len(uv)} outliers'
            axes.set(
                title=f'{coordinate} {stage}:\nRMSE {rmse:.3f} px, {outliers}',
                xlabel=('column u [px]', 'row v [px]')[axis],
                ylabel=f'{coordinate} residual [px]',
            )
    figure.supxlabel(
        'Dots: inliers. Crosses: outliers, not in the RMSE; those at the upper and lower edge '
        'are beyond the panel. Line: running median of the inliers.',
        fontsize=11,
    )
    return figure


def _residual_limit(residuals: Residual, axis: int) -> float:
    """Return the limit of a panel that contains nearly all inlier residuals [px]."""
    values, inliers = residuals
    return float(1.1 * np.quantile(np.abs(values[inliers, axis]), 0.999)) or 1.0


def _plot_residuals(
    axes: Axes,
    position: NDArray[np.float64],
    residual: NDArray[np.float64],
    inliers: NDArray[np.bool_],
    limit: float,
    colour: str,
) -> None:
    """Draw residuals (n,) over positions (n,): dots for inliers, crosses for outliers.

    Outliers beyond the limit are drawn at the border of the panel.
    """
    axes.plot(position[inliers], residual[inliers], '.', color=colour, markersize=3, alpha=0.6)
    outliers = np.clip(residual[~inliers], -0.97 * limit, 0.97 * limit)
    axes.plot(position[~inliers], outliers, 'x', color=GREY, markersize=5)


def _plot_running_median(
    axes: Axes, position: NDArray[np.float64], residual: NDArray[np.float64], size: int
) -> None:
    """Draw the running median of residuals (n,) over positions (n,) in an image of this size."""
    edges = np.linspace(-0.5, size - 0.5, STRIPES + 1)
    stripe = np.digitize(position, edges) - 1
    medians = [
        np.median(residual[stripe == s]) if np.any(stripe == s) else np.nan for s in range(STRIPES)
    ]
    axes.plot((edges[:-1] + edges[1:]) / 2, medians, '-', color=BLACK, linewidth=2)
    axes.axhline(0, color=BLACK, linewidth=0.6)
