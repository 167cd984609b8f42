# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Shadow of a sphere in an image: attenuated light, blurred, as a function of the distance.

A ray at a distance d from the centre of a sphere of radius r is attenuated by exp(-2 m sqrt(r^2
- d^2)) (Beer and Lambert). Focal spot, detector and pixel blur it, about as a Gaussian; scattered
light adds a part that no bead takes away.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares

STEP = 0.2  # of the grid on which a profile is computed [px]
TABLE_STEP = 0.05  # of the table of a profile [px]
REACH_SIGMAS = 3.2
# Bounds of radius, blur [px], attenuation along the radius, and scattered light.
LOW = (0.5, 0.35, 0.05, 0.0)
HIGH = (40.0, 6.0, 6.0, 0.6)


@dataclass(frozen=True)
class Profile:
    """Shadow of a bead."""

    radius_px: float
    blur_px: float  #: standard deviation
    attenuation: float  #: along the radius: coefficient times radius
    scatter: float = 0.0  #: share of the light that is not attenuated
    _table: np.ndarray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, '_table', _tabulated(self))

    @property
    def reach_px(self) -> float:
        """Distance from the centre at which the shadow has ended [px]."""
        return self.radius_px + REACH_SIGMAS * self.blur_px

    def absorbed(self, squared: np.ndarray) -> np.ndarray:
        """Absorbed share of the light without blur at squared distances [px^2]."""
        chord = 2 * np.sqrt(np.maximum(self.radius_px**2 - squared, 0)) / self.radius_px
        return 1 - np.exp(-self.attenuation * chord)

    def shadow(self, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Absorbed share of the light at distances [px], and its derivative [1/px]."""
        value, slope = self._table.astype(distance.dtype)
        position = np.minimum(
            distance * distance.dtype.type(1 / TABLE_STEP), distance.dtype.type(len(value) - 2)
        )
        index = position.astype(np.intp)
        part = position - index.astype(distance.dtype)
        return (
            value.take(index) + part * np.diff(value).take(index),
            slope.take(index) + part * np.diff(slope).take(index),
        )


def _tabulated(profile: Profile) -> np.ndarray:
    """Absorbed shares and their derivatives (2, n) at multiples of TABLE_STEP from the centre."""
    step = min(STEP, profile.radius_px / 4)
    axis = np.arange(int(np.ceil((profile.reach_px + 3) / step)) + 4) * step
    squared = axis[:, None] ** 2 + axis**2
    quarter = profile.absorbed(squared)
    # The blur of a square pixel has a variance of 1/12. Only the row through the centre is needed:
    # all columns are weighted to one row, which is blurred along itself.
    sigma = np.sqrt(profile.blur_px**2 + 1 / 12)
    kernel = np.exp(-0.5 * (axis / sigma) ** 2)
    row = quarter @ np.append(kernel[0], 2 * kernel[1:])
    both_sides = np.concatenate([kernel[:0:-1], kernel])
    blurred = np.convolve(np.concatenate([row[:0:-1], row]), both_sides / both_sides.sum() ** 2)
    blurred = blurred[2 * len(axis) - 2 : 3 * len(axis) - 2]
    spline = CubicSpline(axis, blurred, bc_type=((1, 0.0), (1, 0.0)))
    wanted = np.arange(0, profile.reach_px + 2, TABLE_STEP)
    return np.stack([spline(wanted), spline(wanted, 1)])


def fit_profile(
    distance: np.ndarray, absorbed: np.ndarray, weight: np.ndarray, start: Profile
) -> Profile:
    """Fit a profile to absorbed shares (n,) of the light at distances (n,) [px] from beads."""
    edges = np.arange(0, start.reach_px + 1, 0.25)
    cell = np.digitize(distance, edges)
    total = np.bincount(cell, weights=weight, minlength=len(edges) + 1)[1:-1]
    sums = np.bincount(cell, weights=weight * absorbed, minlength=len(edges) + 1)[1:-1]
    moments = np.bincount(cell, weights=weight * distance, minlength=len(edges) + 1)[1:-1]
    used = total > 0
    mean = sums[used] / total[used]
    place = moments[used] / total[used]
    root = np.sqrt(total[used])

    def residual(unknowns: np.ndarray) -> np.ndarray:
        value, _ = Profile(*unknowns[:3]).shadow(place)
        return root * ((1 - unknowns[3]) * value - mean)

    first = np.array([start.radius_px, start.blur_px, start.attenuation, start.scatter])
    first = np.clip(first, np.asarray(LOW) * 1.01 + 1e-3, np.asarray(HIGH) * 0.99)
    found = least_squares(residual, first, bounds=(LOW, HIGH), x_scale=first, max_nfev=12)
    return Profile(*map(float, found.x))
