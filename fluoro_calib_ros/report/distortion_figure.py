# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The figure of the estimated distortion of one fluoroscope."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from ..correction.base import Correction, CorrectionModel
from .style import BLACK, new_figure
from .tables import model_text

# Along the longer side of the image.
FIELD_CELLS = 160
FIELD_ARROWS = 17
SCALE_CELLS = 48
# Of the longer side, around the image for the arrows at its border, and twice that below it.
MARGIN = 0.09
MIN_ARROW_PX = 1e-6
ROUND_NUMBERS = (1, 1.5, 2, 3, 5, 7)


@dataclass(frozen=True)
class Scale:
    """Largest magnitude and largest standard deviation [px] of figures that are compared."""

    magnitude_px: float
    sd_px: float


def common_scale(fields: Iterable[tuple[CorrectionModel, tuple[int, int]]]) -> Scale:
    """Return the scale of the figures of several fluoroscopes: models with their image sizes."""
    magnitude = sd = MIN_ARROW_PX
    for model, image_size in fields:
        field = _field_on_grid(model, image_size, SCALE_CELLS)[1]
        inside = ~field.outside
        magnitude = max(magnitude, float(np.max(np.hypot(*field.duv[inside].T), initial=0.0)))
        sd = max(sd, float(np.nanmax(np.append(field.sd[inside], 0.0))))
    return Scale(magnitude, sd)


def distortion_figure(
    model: CorrectionModel,
    name: str,
    image_size: tuple[int, int],
    interior_estimated: bool,
    scale: Scale | None = None,
) -> Figure:
    """Learned distortion as arrows over its magnitude, and its standard deviation.

    Parameters
    ----------
    model : CorrectionModel
        Its training points are shown, too.
    name : str
        Fluoroscope.
    image_size : tuple of int
        Width and height [px].
    interior_estimated : bool
        Whether the interior orientation was estimated with the model.
    scale : Scale, optional
        That of the figures of all fluoroscopes; by default that of the model.
    """
    scale = scale or common_scale([(model, image_size)])
    width, height = np.asarray(image_size) + np.array([2, 3]) * MARGIN * max(image_size)
    figure = new_figure(
        15,
        min(2 + 5.3 * height / width, 15),
        f'Fluoroscope {name}: estimated distortion ({model_text(model)})',
        'compressed',
    )
    left, right = figure.subplots(1, 2)
    centres, field = _field_on_grid(model, image_size, FIELD_CELLS)
    for axes, values, colours, label, largest in (
        (left, np.hypot(*field.duv.T), 'YlOrRd', 'magnitude [px]', scale.magnitude_px),
        (right, field.sd, 'cividis', 'standard deviation [px]', scale.sd_px),
    ):
        shown = np.ma.masked_array(values, field.outside).reshape(len(centres[1]), len(centres[0]))
        _draw_image_frame(axes, image_size)
        mesh = axes.pcolormesh(
            *centres, shown, cmap=colours, vmin=0, vmax=largest, shading='nearest'
        )
        figure.colorbar(mesh, ax=axes, label=label)
    factor = _draw_arrows(left, model, image_size, scale.magnitude_px)
    left.set_title(
        f'Displacement (du, dv) = observed - undistorted,\narrows magnified {factor:g} times'
    )
    right.plot(*model.train_uv.T, '.', color='white', markersize=2, alpha=0.5)
    right.set_title(
        f'Standard deviation of du and of dv,\ndots: the {len(model.train_uv)} training points'
    )
    gauge = (
        'Shift, scale, rotation and tilt belong to the interior and exterior orientation, not to '
        'this field.'
        if interior_estimated
        else 'The interior orientation was fixed: its errors (shift and scale) are part of this '
        'field.'
    )
    figure.supxlabel(f'{gauge} Hatched: outside the calibrated area.', fontsize=11)
    return figure


def _field_on_grid(
    model: CorrectionModel, image_size: Sequence[int], cells: int
) -> tuple[list[np.ndarray], Correction]:
    """Columns and rows of a regular grid over the image [px], and the Correction at its points."""
    step = max(image_size) / cells
    centres = [
        -0.5 + step / 2 + step * np.arange(max(1, round(size / step))) for size in image_size
    ]
    u, v = np.meshgrid(*centres)
    return centres, model.evaluate(np.column_stack([u.ravel(), v.ravel()]))


def _draw_image_frame(axes: Axes, image_size: Sequence[int]) -> None:
    """Draw the image as a hatched area with a frame, v pointing down."""
    width, height = image_size
    margin = MARGIN * max(image_size)
    image: dict[str, Any] = {'xy': (-0.5, -0.5), 'width': width, 'height': height}
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


def _draw_arrows(
    axes: Axes, model: CorrectionModel, image_size: Sequence[int], largest: float
) -> float:
    """Draw arrows of the field and a reference arrow below the image; return their enlargement.

    largest: length of the longest arrow [px]. Arrows begin in the calibrated area only.
    """
    centres, field = _field_on_grid(model, image_size, FIELD_ARROWS)
    u, v = (grid.ravel()[~field.outside] for grid in np.meshgrid(*centres))
    duv = field.duv[~field.outside]
    # At most two cells long: arrows hardly overlap, and small ones can be seen.
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


def _round_down(value: float) -> float:
    """The largest of 1, 1.5, 2, 3, 5, 7, 10, ... and their decimal fractions up to a value."""
    power = 10.0 ** np.floor(np.log10(value))
    digits = [digit for digit in ROUND_NUMBERS if digit * power <= value * (1 + 1e-9)]
    return float(power * max(digits))
