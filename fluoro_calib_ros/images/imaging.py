# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""How an image shows beads: its noise, the shadow of a typical bead, the sizes of all.

A phantom that does not tell its sizes may have several. A bead that stands alone has the size with
which its shadow fits best; where nearly all of a sample have the same size, all have.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .detection import vertex
from .light import Light, Noise
from .measurement import RADIUS_SD, estimate_profile, lack_of_fit
from .shadow_fit import DISTURBED, Profile

TYPICAL = 1 / 3  # of the beads of a phantom with several sizes
STEP = 1.25  # factor between sizes that are compared
SIZES = STEP ** np.arange(-4, 5)
STEPS = (STEP**0.5, STEP**0.25, STEP**0.125)  # between those that are compared then
FEW = 5  # beads alone, below which those that overlap tell their shadow as well
SAMPLE = 40  # beads that tell whether sizes differ
OTHERS = 0.2  # share of them with something else beside them
ROUNDS = 2  # the second one with a profile of beads of one size


@dataclass(frozen=True)
class Expected:
    """Where shadows of beads are expected."""

    row: NDArray[np.int64]  #: (n,), of the phantom
    uv: NDArray[np.float64]  #: (n, 2) [px]
    radius: NDArray[np.float64]  #: (n,), relative radii that beads of one size have here
    seen: NDArray[np.bool_]  #: (n,), something was found there
    alone: NDArray[np.bool_]  #: (n,), no other shadow is near


@dataclass(frozen=True)
class Imaging:
    """Noise and shadows of an image."""

    noise: Noise
    profile: Profile  #: of a typical bead
    #: (n,), of all beads of the phantom, 1 for a typical one, NaN where it is not known
    size: NDArray[np.float64]

    def completed(self, light: Light, shadows: Expected) -> Imaging:
        """Return it with the sizes of beads that were not known and stand alone here."""
        unknown = np.flatnonzero(shadows.alone & np.isnan(self.size[shadows.row]))
        if not len(unknown):
            return self
        size = self.size.copy()
        size[shadows.row[unknown]] = _Sizes(light, shadows, self).best(unknown)
        return replace(self, size=size)


def first_imaging(
    light: Light,
    noise: Noise,
    shadows: Expected,
    radius_px: float,
    size: NDArray[np.float64],
) -> Imaging:
    """Return what an image tells of its noise and shadows.

    radius_px: first value of the radius of a typical bead. size: (n,) relative sizes of all beads
    of the phantom, NaN where they are not told.
    """
    profile = _typical(light, shadows, size, radius_px)
    imaging = Imaging(noise, profile, size)
    if np.isfinite(size).all():
        return imaging
    alone = np.flatnonzero(shadows.seen & shadows.alone)
    sizes = _Sizes(light, shadows, imaging)
    if sizes.are_equal(alone[:: len(alone) // SAMPLE + 1]):
        return replace(imaging, size=np.ones_like(size))
    for _ in range(ROUNDS):
        found = _Sizes(light, shadows, imaging).best(alone)
        size = np.full_like(size, np.nan)
        size[shadows.row[alone]] = found / np.median(found)
        radius_px = imaging.profile.radius_px * float(np.median(found))
        imaging = Imaging(noise, _typical(light, shadows, size, radius_px), size)
    return imaging


def _typical(light: Light, shadows: Expected, size: np.ndarray, radius_px: float) -> Profile:
    """Return the profile of beads of about the typical size: a third, and all equals."""
    seen = np.flatnonzero(shadows.seen & shadows.alone)
    if len(seen) < FEW:
        seen = np.flatnonzero(shadows.seen)
    relative = np.nan_to_num(size[shadows.row[seen]], nan=1.0)
    off = np.abs(np.log(relative))
    near = off <= np.quantile(off, TYPICAL) + RADIUS_SD
    radius = (shadows.radius[seen] * relative)[near]
    return estimate_profile(light, shadows.uv[seen[near]], radius, radius_px)


class _Sizes:
    """Comparison of sizes of beads in an image."""

    def __init__(self, light: Light, shadows: Expected, imaging: Imaging) -> None:
        self.light = light
        self.shadows = shadows
        self.imaging = imaging

    def are_equal(self, rows: np.ndarray) -> bool:
        """Return whether nearly all of some beads that nothing is beside have the same size.

        Another size counts where the common one fits as badly as if something were beside a bead.
        """
        if not len(rows):
            return True
        same = np.ones(len(rows))
        smaller, common, larger = self.lacks(rows, [same / STEP, same, same * STEP])
        if np.mean(common > DISTURBED * np.minimum(smaller, larger)) <= OTHERS:
            return True
        size = self.best(rows)
        middle = np.median(size)
        own, common = self.lacks(rows, [size, middle * same])
        differs = np.abs(np.log(size / middle)) > 0.5 * np.log(STEP)
        differs &= common > DISTURBED * own
        return bool(np.mean(differs[own < DISTURBED * np.median(own)]) <= OTHERS)

    def best(self, rows: np.ndarray) -> NDArray[np.float64]:
        """Sizes (m,) of best fit of some beads."""
        same = np.ones(len(rows))
        lack = self.lacks(rows, [one * same for one in SIZES])
        size = SIZES[np.clip(np.argmin(lack, axis=0), 1, len(SIZES) - 2)]
        row = np.arange(len(rows))
        for step in STEPS:
            tried = np.stack([size / step, size, size * step])
            lack = self.lacks(rows, list(tried))
            least = np.argmin(lack, axis=0)
            size = tried[least, row]
        # Only where both neighbours fit worse, a parabola says more.
        return np.asarray(size * np.where(least == 1, STEPS[-1] ** vertex(*-lack), 1.0))

    def lacks(self, rows: np.ndarray, sizes: Sequence[np.ndarray]) -> np.ndarray:
        """Lack of fit (k, m) of some beads (m,) with some sizes (m,) each.

        The shadows around them are fitted as well.
        """
        shadows = self.shadows
        imaging = self.imaging
        reach = (1 + SIZES[-1]) * imaging.profile.reach_px
        near = cKDTree(shadows.uv).query_ball_point(shadows.uv[rows], reach)
        around = np.setdiff1d(np.concatenate(near).astype(int), rows)
        every = np.concatenate([rows, around])
        known = np.nan_to_num(imaging.size[shadows.row[around]], nan=1.0)
        return np.stack(
            [
                lack_of_fit(
                    self.light,
                    shadows.uv[every],
                    shadows.radius[every],
                    profile=imaging.profile,
                    noise=imaging.noise,
                    size=np.concatenate([size, known]),
                )[: len(rows)]
                for size in sizes
            ]
        )
