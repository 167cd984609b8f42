# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The picture of a drawn phantom, to be held against the part in hand."""

from __future__ import annotations

import io

import matplotlib
import numpy as np
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from ..exposures.phantom import Drawing
from .style import BLACK, BLUE, RED, STYLE, new_figure, png_bytes

INCH = 0.33  # of a place, so that an id of four digits can be read
MAX_INCH = 60.0
ID_POINTS = 6
EDGE = 0.8  # of a pitch around the places


def phantom_figure(drawing: Drawing) -> Figure:
    """Draw every layer as it is seen along z, with ids; blocked places are crossed out."""
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
    for place, (x, y, _) in enumerate(drawing.places_mm[layer * count : (layer + 1) * count]):
        number = layer * count + place + 1
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
            fontsize=ID_POINTS,
            color=RED if is_blocked else BLACK,
        )


def picture_bytes(figure: Figure, suffix: str) -> bytes:
    """Bytes of a figure as .png, or as .svg; the same for the same figure."""
    if suffix == '.png':
        return png_bytes(figure)
    buffer = io.BytesIO()
    with matplotlib.rc_context({'svg.hashsalt': 'phantom', 'svg.fonttype': 'none'}):
        FigureCanvasSVG(figure).print_svg(buffer, metadata={'Date': None})
    return buffer.getvalue()
