# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The look of all figures: colours, fonts and size.

Figures need no display and no pyplot. The colours are those of Okabe and Ito, which colour-blind
people can tell apart.
"""

from __future__ import annotations

import io
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

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


def new_figure(width: float, height: float, title: str, layout: Any = 'constrained') -> Figure:
    """An empty figure; width and height in inches."""
    figure = Figure(figsize=(width, height), dpi=DPI, layout=layout)
    figure.suptitle(title)
    return figure


def png_bytes(figure: Figure) -> bytes:
    """Bytes of a figure as PNG, the same for the same figure."""
    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer, metadata={'Software': None})
    return buffer.getvalue()
