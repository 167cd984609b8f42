# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The figures of a self-calibration as PNG files.

They are Figures 1 to 10 of Chow et al., and the distortion field.
"""

from __future__ import annotations

import os
from collections.abc import Iterator

import numpy as np
from matplotlib import style
from matplotlib.figure import Figure

from ..estimation.result import CalibrationResult
from ..estimation.rounds import SelfCalibration
from ..io.access import check_safe_name, make_folder
from ..io.atomic import write_bytes
from ..photogrammetry.noise import MIN_REDUNDANCY
from ..photogrammetry.precision import geometric_redundancy
from .cost_figure import cost_figure
from .distortion_figure import Scale, common_scale, distortion_figure
from .residual_figures import histogram_figure, position_figure
from .style import STYLE, png_bytes


def write_figures(result: CalibrationResult, directory: str | os.PathLike[str]) -> list[str]:
    """Write the figures of a calibration into a folder, which is made if necessary.

    For every run there is cost_<label>.png, for every fluoroscope residuals_histogram_<name>.png,
    residuals_position_<name>.png and distortion_<name>.png. Without a correction model there is
    neither a cost nor a distortion to show, and a result without runs has no figures. Each file
    appears only once it is complete. Sets matplotlib's style while it draws, so it must not run in
    two threads at once.

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
    """File names and figures of one run; scale: of the distortions."""
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
        yield f'residuals_position_{name}.png', position_figure(run, name, rows, image_size)
        model = run.models[name]
        if model.corrects:
            interior_estimated = bool(network.interior_free[number])
            distortion = distortion_figure(model, name, image_size, interior_estimated, scale)
            yield f'distortion_{name}.png', distortion
