# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Contrasts of beads in light of different intensity.

Beads absorb the same share of the direct light, and no scattered light; a hole of a sheet adds a
share of the light behind the sheet. A contrast is therefore linear in the light around the bead.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .clipping import UNCLIPPED, Clipping
from .light import Light
from .shadow_fit import UNDISTURBED, Beads
from .view import TAIL

MIN_BEADS = 20  # least number of beads from which the line is estimated
STEPS = 8
MIN_DEPTH = 0.1
# Least change of the grey value of no light, and its largest distance below 0, over the usual
# light: smaller changes and longer distances change slopes of the light within shadows by about
# 10 % at most.
MIN_CHANGE = 0.1
MAX_DISTANCE = 2.0
SURE_SDS = 3.0


@dataclass(frozen=True)
class _Contrasts:
    """Line through the contrasts of beads, over the light around them: slope * light + offset."""

    slope: float
    offset: float  #: over the median light
    light: float  #: median light
    sd: float  #: standard deviation of slope and offset

    @classmethod
    def of(cls, beads: Beads, good: NDArray[np.bool_]) -> _Contrasts | None:
        """Fit the line to good beads (n,); return None if they are too few.

        The fit is one of iteratively reweighted least squares with Cauchy weights. Contrasts that
        vary as slowly as the light, such as those of beads that lie deeper in the phantom, do not
        average out: their variance is the product of the residuals of neighbours, to which its own
        standard deviation is added.
        """
        if np.count_nonzero(good) < MIN_BEADS:
            return None
        median = float(np.median(beads.light[good]))
        light = beads.light[good] / median
        rows = np.column_stack([light, np.ones_like(light)])
        contrast = beads.depth[good] * light
        line = np.array([float(np.median(beads.depth[good])), 0.0])
        for _ in range(STEPS):
            residual = contrast - rows @ line
            scale = max(1.4826 * float(np.median(np.abs(residual))), 1e-3)
            weight = 1 / np.sqrt(1 + (residual / scale) ** 2)
            line = np.linalg.lstsq(rows * weight[:, None], contrast * weight, rcond=None)[0]
        residual = np.clip(contrast - rows @ line, -TAIL * scale, TAIL * scale)
        _, nearest = cKDTree(beads.uv[good]).query(beads.uv[good], k=[2])
        slow = max(float(np.mean(residual * residual[nearest[:, 0]])), 0.0)
        variance = slow + scale**2 / np.sqrt(len(light))
        spread = max(float(np.std(light)), np.finfo(float).tiny)
        return cls(float(line[0]), float(line[1]), median, float(np.sqrt(variance)) / spread)


def black_level(beads: Beads, black: float, clipping: Clipping = UNCLIPPED) -> float:
    """Return the grey value at which beads would have no contrast.

    Beads absorb a share of the light, so that their contrast is proportional to it. If the grey
    values were windowed for display, it is proportional to their difference from another one; in
    a logarithmic image, it is the same everywhere. black: the grey value above which the light is
    measured; it stays, if it is likely.

    If clipped pixels hide the light around a bead, an error of the light is one of the contrast,
    as if the dark inside of the shadow had no light. Such beads do not show a larger grey value.
    """
    good = beads.measured & (beads.light > 0) & (beads.misfit < UNDISTURBED)
    level = _black_level(beads, black, good)
    if level <= black:
        return level
    return _black_level(beads, black, good & clipping.leaves(beads.light))


def _black_level(beads: Beads, black: float, good: NDArray[np.bool_]) -> float:
    """Return the grey value at which good beads (n,) would have no contrast."""
    line = _Contrasts.of(beads, good)
    if line is None or line.slope < -SURE_SDS * line.sd or abs(line.offset) < SURE_SDS * line.sd:
        return black
    change = -line.offset / max(line.slope, abs(line.offset) / MAX_DISTANCE) * line.light
    grey = line.light + black
    level = max(black + change, -MAX_DISTANCE * grey)
    return level if abs(level - black) > MIN_CHANGE * line.light else black


def black_of_holes(light: Light) -> float:
    """Return the grey value of no light for holes of a sheet, in its inverted light.

    If holes are clipped, their light is below the bound by an unknown amount. A profile that
    absorbs all light at the bound would level out there, where the light still falls. It does not
    if no light is as far below as it may be.
    """
    if not np.isfinite(light.clipping.low):
        return 0.0
    usual = np.median(light.grey[light.field & light.clipping.leaves(light.grey)])
    return -MAX_DISTANCE * float(usual)


def usual_depth(beads: Beads) -> NDArray[np.float64]:
    """Return the usual depths (n,) of shadows in the light of the beads."""
    good = beads.measured & (beads.light > 0)
    usual = np.ones(len(beads.uv))
    line = _Contrasts.of(beads, good)
    if line is not None:
        offset = line.offset / (beads.light[good] / line.light)
        usual[good] = np.maximum(line.slope + offset, MIN_DEPTH)
    return usual
