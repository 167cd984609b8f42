# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What changed between two calibrations: text for a terminal, and a figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import style
from matplotlib.figure import Figure

from ..checks.comparison import Comparison
from .figures import BLACK, STYLE, new_figure, png_bytes

ARROWS = 16  # along the longer side of the image


def comparison_document(comparison: Comparison, mm_per_px: float | None) -> dict[str, Any]:
    """Return a Comparison as a dict; mm_per_px is the scale at the phantom."""
    largest, place = comparison.largest
    scale = float('nan') if mm_per_px is None else mm_per_px
    return {
        'interior_px': comparison.interior,
        'interior_sd_px': comparison.interior_sd,
        'interior_changed': comparison.interior_changed,
        'rms_px': comparison.rms_px,
        'rms_mm': comparison.rms_px * scale,
        'largest_px': largest,
        'largest_mm': largest * scale,
        'largest_at': list(place),
        'share_significant': float(comparison.significant.mean()),
        'field_changed': comparison.field_changed,
    }


def comparison_text(comparison: Comparison, mm_per_px: float | None) -> str:
    """Return what changed in a few lines."""
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
    """Return the differences of the fields of all fluoroscopes as a PNG file."""
    with style.context(['default', STYLE]):
        return png_bytes(_figure(list(comparisons.values())))


def _figure(comparisons: Sequence[Comparison]) -> Figure:
    """Arrows over the size of the difference; dots where it is significant."""
    figure = new_figure(7.5 * len(comparisons), 7, 'Difference of the corrections, without gauge')
    panels = figure.subplots(1, len(comparisons), squeeze=False)[0]
    for axes, comparison in zip(panels, comparisons):
        width, height = comparison.image_size
        step = max(width, height) / ARROWS
        mesh = axes.scatter(
            *comparison.uv.T, c=comparison.size, cmap='YlOrRd', s=40, marker='s', vmin=0
        )
        figure.colorbar(mesh, ax=axes, label='difference [px]')
        marked = comparison.uv[comparison.significant]
        axes.plot(*marked.T, '.', color=BLACK, markersize=2)
        keys = np.floor(comparison.uv / step).astype(int)
        _, first = np.unique(keys, axis=0, return_index=True)
        # A difference far below its standard deviation is shown as small as it is.
        longest = max(float(comparison.size.max()), float(np.median(comparison.sd)))
        factor = 0.8 * step / longest
        factor = float(f'{factor:.1g}')
        axes.quiver(
            *comparison.uv[first].T,
            *(factor * comparison.duv[first].T),
            angles='xy',
            scale_units='xy',
            scale=1,
            width=0.003,
        )
        axes.set_xlim(-0.5, width - 0.5)
        axes.set_ylim(height - 0.5, -0.5)
        axes.set(aspect='equal', xlabel='column u [px]', ylabel='row v [px]')
        axes.set_title(
            f'{comparison.fluoroscope}: arrows magnified {factor:g} times,\ndots: significant'
        )
    return figure
