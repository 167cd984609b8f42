# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Style of all figures; figures of a drawn phantom, of a distortion, and of a comparison.

The style consists of colours, fonts and sizes. Figures need no display and no pyplot. The colours
are those of Okabe and Ito, which colour-blind people can distinguish.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib import style
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.collections import Collection, QuadMesh
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from ..checks.comparison import Comparison, cell_centres
from ..correction.base import Correction, CorrectionModel
from ..exposures.phantom import Drawing
from .tables import model_text

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


def new_figure(width: float, height: float, title: str, layout: Any = 'constrained') -> Figure:
    """Return an empty figure; width and height in inches."""
    figure = Figure(figsize=(width, height), dpi=120, layout=layout)
    figure.suptitle(title)
    return figure


def png_bytes(figure: Figure) -> bytes:
    """Return a figure as PNG; the same figure gives the same bytes."""
    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer, metadata={'Software': None})
    return buffer.getvalue()


# Largest number of marks of an artist that are drawn as vectors in an SVG: each takes some 100
# bytes, a raster image instead some 30 kB.
MAX_VECTORS = 300


def svg_bytes(figure: Figure, text: str = 'path') -> bytes:
    """Return a figure as SVG with reproducible bytes; artists with many marks are rasterised.

    text: 'path', or 'none' for characters, which a reader can search.
    """
    for axes in figure.axes:
        for artist in axes.get_children():
            if _marks(artist) > MAX_VECTORS:
                artist.set_rasterized(True)
    buffer = io.BytesIO()
    with matplotlib.rc_context({'svg.hashsalt': 'fluoro_calib_ros', 'svg.fonttype': text}):
        FigureCanvasSVG(figure).print_svg(buffer, metadata={'Date': None})
    return buffer.getvalue()


def _marks(artist: Artist) -> int:
    """Return the number of marks of an artist."""
    if isinstance(artist, Line2D):
        return len(np.atleast_1d(artist.get_xdata()))
    if isinstance(artist, QuadMesh):  # without creating its paths
        return int(np.size(artist.get_array()))
    if isinstance(artist, Collection):
        return max(len(artist.get_offsets()), len(artist.get_paths()))
    return 1


INCH = 0.33  # size of a place; an id of four digits stays legible
MAX_INCH = 60.0  # maximum length of the longer side
EDGE = 0.8  # margin around the places, as a fraction of the pitch


def phantom_figure(drawing: Drawing) -> Figure:
    """Draw every layer as seen along z, with ids; blocked places are crossed out."""
    places = drawing.places_mm
    phantom = drawing.phantom()
    pitch = drawing.pitch_mm[0]
    low = places.min(axis=0)[:2] - EDGE * pitch
    high = places.max(axis=0)[:2] + EDGE * pitch
    width, height = np.minimum(INCH * (high - low) / pitch, MAX_INCH)
    with matplotlib.rc_context(STYLE):
        figure = new_figure(
            max(6.0, width + 1),
            max(5.0, drawing.layers * (height + 1.2)),
            f'{len(phantom.target_id)} beads or holes, {len(drawing.blocked_id)} blocked, '
            f'pitch {pitch:g} mm',
        )
        radius = (drawing.diameter_mm or 0.3 * pitch) / 2
        for layer, axes in enumerate(
            np.ravel(figure.subplots(drawing.layers, 1, squeeze=False)).tolist()
        ):
            z = layer * drawing.pitch_mm[2]
            axes.set(
                xlim=(low[0], high[0]),
                ylim=(high[1], low[1]),
                aspect='equal',
                xlabel='x [mm]',
                ylabel='y [mm]',
                title=f'z = {z:g} mm, seen along z' if drawing.layers > 1 else '',
            )
            _draw_layer(axes, drawing, layer, radius)
    return figure


def _draw_layer(axes: matplotlib.axes.Axes, drawing: Drawing, layer: int, radius: float) -> None:
    count = drawing.rows * drawing.columns
    blocked = set(drawing.blocked_id.tolist())
    for index, (x, y, _) in enumerate(drawing.places_mm[layer * count : (layer + 1) * count]):
        number = layer * count + index + 1
        is_blocked = number in blocked
        if is_blocked:
            axes.plot([x], [y], marker='x', color=RED, markersize=12, markeredgewidth=2)
        else:
            axes.add_patch(matplotlib.patches.Circle((x, y), radius, color=BLUE, alpha=0.25))
        axes.annotate(
            str(number),
            (x, y),
            xytext=(0, -9 if is_blocked else 0),
            textcoords='offset points',
            ha='center',
            va='center',
            fontsize=6,
            color=RED if is_blocked else BLACK,
        )


def picture_bytes(figure: Figure, suffix: str) -> bytes:
    """Return a figure as .png or .svg; the same figure gives the same bytes."""
    return png_bytes(figure) if suffix == '.png' else svg_bytes(figure, 'none')


# Number of cells along the longer side of the image.
FIELD_CELLS = 160
FIELD_ARROWS = 17  # arrows along the longer side of the image
SCALE_CELLS = 48  # cells along it to find the largest correction
# Margin for arrows at the border, as a fraction of the longer side; twice as wide at the bottom.
MARGIN = 0.09
MIN_ARROW_PX = 1e-6  # lower limit of the scale, for a field without correction
ROUND_NUMBERS = (1, 1.5, 2, 3, 5, 7)


@dataclass(frozen=True)
class Scale:
    """Largest magnitude and largest standard deviation [px] of figures to be compared."""

    magnitude_px: float
    sd_px: float


def common_scale(fields: Iterable[tuple[CorrectionModel, tuple[int, int]]]) -> Scale:
    """Return the common scale of several fluoroscopes; fields: models with their image sizes."""
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
    """Return the estimated distortion as arrows over its magnitude, and its standard deviation.

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
        Common scale of all fluoroscopes; by default that of the model.
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
        masked = np.ma.masked_array(values, field.outside).reshape(
            len(centres[1]), len(centres[0])
        )
        _draw_image_frame(axes, image_size)
        mesh = axes.pcolormesh(
            *centres, masked, cmap=colours, vmin=0, vmax=largest, shading='nearest'
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
) -> tuple[list[NDArray[np.float64]], Correction]:
    """Return columns and rows of a regular grid over the image [px], and the Correction there."""
    axes, centres = cell_centres(image_size, cells)
    return axes, model.evaluate(centres)


def _draw_image_frame(axes: Axes, image_size: Sequence[int]) -> None:
    """Draw the image as a hatched area with a frame, v downwards."""
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


def image_axes(image_size: Sequence[int]) -> dict[str, Any]:
    """Return limits and labels of axes that show an image, v downwards."""
    width, height = image_size
    limits = {'xlim': (-0.5, width - 0.5), 'ylim': (height - 0.5, -0.5)}
    return {**limits, 'xlabel': 'column u [px]', 'ylabel': 'row v [px]'}


def _draw_arrows(
    axes: Axes, model: CorrectionModel, image_size: Sequence[int], largest: float
) -> float:
    """Draw arrows of the field and a reference arrow below the image; return their magnification.

    largest: length of the longest arrow [px]. Arrows start only in the calibrated area.
    """
    centres, field = _field_on_grid(model, image_size, FIELD_ARROWS)
    u, v = (grid.ravel()[~field.outside] for grid in np.meshgrid(*centres))
    duv = field.duv[~field.outside]
    # At most two cells long, so that arrows hardly overlap, but small ones are visible.
    factor = _round_down(2 * max(image_size) / FIELD_ARROWS / largest)
    reference = _round_down(largest)
    reference_v = image_size[1] + 0.13 * max(image_size)
    axes.quiver(
        np.append(u, 0),
        np.append(v, reference_v),
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
    axes.text(
        reference * factor + 0.02 * max(image_size), reference_v, f'{reference:g} px', va='center'
    )
    return factor


def _round_down(value: float) -> float:
    """Return the largest of 1, 1.5, 2, 3, 5, 7 times a power of ten that is at most a value."""
    power = 10.0 ** np.floor(np.log10(value))
    digits = [digit for digit in ROUND_NUMBERS if digit * power <= value * (1 + 1e-9)]
    return float(power * max(digits))


# Differences between two calibrations.

ARROWS = 16  # number of arrows along the longer side of the image


def comparison_document(comparison: Comparison, mm_per_px: float | None) -> dict[str, Any]:
    """Return a Comparison as a dict; mm_per_px is the scale at the phantom."""
    largest, location = comparison.largest
    scale = float('nan') if mm_per_px is None else mm_per_px
    return {
        'interior_px': comparison.interior,
        'interior_sd_px': comparison.interior_sd,
        'interior_changed': comparison.interior_changed,
        'rms_px': comparison.rms_px,
        'rms_mm': comparison.rms_px * scale,
        'largest_px': largest,
        'largest_mm': largest * scale,
        'largest_at': list(location),
        'share_significant': float(comparison.significant.mean()),
        'field_changed': comparison.field_changed,
    }


def comparison_text(comparison: Comparison, mm_per_px: float | None) -> str:
    """Return the differences as text of a few lines."""
    largest, (u, v) = comparison.largest

    def with_mm(pixels: float) -> str:
        mm = '' if mm_per_px is None else f' ({pixels * mm_per_px:.3f} mm at the phantom)'
        return f'{pixels:.3f} px{mm}'

    verdicts = {True: 'significant', False: 'not significant'}
    parts = [
        f'{label} {value:+.2f} (sd {sd:.2f})'
        for label, value, sd in zip(('xp', 'yp', 'c'), comparison.interior, comparison.interior_sd)
    ]
    share = 100 * comparison.significant.mean()
    return '\n'.join(
        [
            f'fluoroscope {comparison.fluoroscope}',
            f'  distortion: RMS {with_mm(comparison.rms_px)}, largest {with_mm(largest)} at '
            f'column {u:.0f}, row {v:.0f}',
            f'  significant in {share:.0f} % of the image: {verdicts[comparison.field_changed]}',
            f'  interior orientation, both in one gauge [px]: {", ".join(parts)}: '
            f'{verdicts[comparison.interior_changed]}',
        ]
    )


def comparison_png(comparisons: Mapping[str, Comparison]) -> bytes:
    """Return the differences of the corrections of all fluoroscopes as a PNG file."""
    with style.context(['default', STYLE]):
        return png_bytes(_figure(list(comparisons.values())))


def _figure(comparisons: Sequence[Comparison]) -> Figure:
    """Return arrows over the size of the difference, with dots where it is significant."""
    figure = new_figure(7.5 * len(comparisons), 7, 'Difference of the corrections, without gauge')
    panels = figure.subplots(1, len(comparisons), squeeze=False)[0]
    for axes, comparison in zip(panels, comparisons):
        step = max(comparison.image_size) / ARROWS
        mesh = axes.scatter(
            *comparison.uv.T, c=comparison.size, cmap='YlOrRd', s=40, marker='s', vmin=0
        )
        figure.colorbar(mesh, ax=axes, label='difference [px]')
        significant_uv = comparison.uv[comparison.significant]
        axes.plot(*significant_uv.T, '.', color=BLACK, markersize=2)
        keys = np.floor(comparison.uv / step).astype(int)
        _, first_of_cell = np.unique(keys, axis=0, return_index=True)
        # A difference far below its standard deviation must not be magnified to look large.
        longest = max(float(comparison.size.max()), float(np.median(comparison.sd)))
        factor = 0.8 * step / longest
        factor = float(f'{factor:.1g}')
        axes.quiver(
            *comparison.uv[first_of_cell].T,
            *(factor * comparison.duv[first_of_cell].T),
            angles='xy',
            scale_units='xy',
            scale=1,
            width=0.003,
        )
        axes.set(**image_axes(comparison.image_size), aspect='equal')
        axes.set_title(
            f'{comparison.fluoroscope}: arrows magnified {factor:g} times,\ndots: significant'
        )
    return figure
