# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Fit blurred shadows of spheres to the grey values of windows: what all such fits share.

A window around a bead has a polynomial of degree 2 as its background. Neighbours that reach into
it are fitted with it, so the standard deviation of a centre contains what the overlap leaves open.
All windows of an image take their Gauss-Newton steps at once.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares

from .light import Cosines, Noise

MAX_SIGMA_PX = 0.3  # of a centre: a larger one is that of no shadow, or of one hardly seen
MARGIN_PX = 2.0  # of background around the shadow
TERMS = 6  # of the background: a polynomial of degree 2
OWN = TERMS + 3  # unknowns of a bead alone: its background, centre and depth
NEIGHBOUR_SD_PX = 0.3  # of a step of a neighbour, which its own fit finds
NEIGHBOUR_SD = 0.2  # of a step of a neighbour's depth
DEPTH_SD = 1.0  # of the depth of a shadow, 1 for the profile
DEPTHS = (0.05, 3.0)  # bounds; a shadow takes light away
MIN_PASSED = 0.02  # of the light, behind a bead: derivatives are divided by it
MIN_PIXELS = 0.6  # of a window that lie in the field
FINE = 3  # points across a pixel of the grid on which shadows that touch are blurred
OVERLAP = 0.85  # times both reaches; shadows that are nearer overlap
DISTURBED = 1.6  # lack of fit from which pixels with large residuals count less
ROBUST = 2.5  # residual of half weight [standard deviations of the noise]

# Rows of beads (g,) and of their neighbours (g, k), -1 for none.
Group = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Beads:
    """Measured beads, in the order in which they were given."""

    uv: NDArray[np.float64]  #: (n, 2), centres [px]
    sigma: NDArray[np.float64]  #: (n,), standard deviation of a coordinate [px]
    depth: NDArray[np.float64]  #: (n,), of the shadow, 1 for the profile
    light: NDArray[np.float64]  #: (n,), grey values in the middle without the beads
    #: (n,), mean squared residual over the noise, 1 where the model is right
    misfit: NDArray[np.float64]
    #: (n,), the shadow of another bead reaches into that of the bead
    overlapped: NDArray[np.bool_]
    measured: NDArray[np.bool_]  #: (n,), False where the window is cut off or the fit failed


@dataclass(frozen=True)
class FitSettings:
    """What differs between fits of shadows.

    The last three fields keep the numbers of two fits that were once apart.
    """

    steps: int  #: Gauss-Newton steps
    crossing_steps: tuple[int, ...]  #: before which shadows that touch are blurred together
    #: least and largest number of neighbours of the beads that are fitted together
    crowds: tuple[tuple[int, int], ...]
    max_step_px: float  #: largest step of a centre
    pooled: float  #: degrees of freedom of the noise of all beads, in that of one
    crossed: float  #: factor on the standard deviation where shadows cross
    dtype: type[np.floating]  #: precision of model and derivatives
    #: whether the polynomial of the background is scaled by a whole number of pixels
    whole_scale: bool
    #: whether a residual of half weight is relative to the typical lack of fit
    robust_relative: bool
    moves_unusable: bool  #: whether beads move whose windows are cut off

    @property
    def neighbours(self) -> int:
        """Neighbours that are fitted with a bead, at most."""
        return self.crowds[-1][1]


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations of some windows, for steps of u = 6 + 3 + 3 k unknowns."""

    matrix: NDArray[np.float64]  #: (g, u, u)
    right: NDArray[np.float64]  #: (g, u)
    weighted: np.ndarray  #: (g, u, m), derivatives of the pixels times their weights


@lru_cache(maxsize=32)
def window_offsets(radius_px: float) -> np.ndarray:
    """Pixels (m, 2) of a round window, from its middle."""
    half = int(np.ceil(radius_px))
    axis = np.arange(-half, half + 1)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    offsets = grid[(grid * grid).sum(axis=1) <= radius_px**2]
    offsets.flags.writeable = False
    return offsets


class FineGrid:
    """Grid finer than the pixels, on which light that passes several beads is blurred.

    The blur of the light that passes two beads is not the product of their blurred shadows. axis
    (a,) are the coordinates of its points, from the middle of a window [px].
    """

    def __init__(self, offset: np.ndarray, blur_px: float) -> None:
        half = int(np.abs(offset).max()) + int(np.ceil(3 * blur_px))
        self.axis = np.arange(-half * FINE, half * FINE + 1) / FINE
        self._sigma = float(FINE * np.sqrt(blur_px**2 + 1 / 12))
        self._column, self._row = (offset.T + half) * FINE

    def blurred(self, light: np.ndarray) -> np.ndarray:
        """Light (a, a), blurred, in the pixels (m,) of a window."""
        smooth = cv2.GaussianBlur(light, (0, 0), self._sigma, borderType=cv2.BORDER_REPLICATE)
        return smooth[self._row, self._column]


class ShadowFit(ABC):
    """Gauss-Newton fit of windows, each with the neighbours of its bead.

    uv: (n, 2) centres to start from [px]. depth: (n,) of the shadows, also what is expected of
    them. window_px: radius of the windows.
    """

    def __init__(
        self,
        settings: FitSettings,
        profile: Profile,
        noise: Noise,
        uv: np.ndarray,
        depth: np.ndarray,
        window_px: float,
    ) -> None:
        self.settings = settings
        self.profile = profile
        self.noise = noise
        self.start = np.array(uv, dtype=float)
        self.uv = self.start.copy()
        self.expected_depth = np.array(depth, dtype=float)
        self.depth = self.expected_depth.copy()
        self.middle = np.rint(self.uv).astype(int)
        self.offset = window_offsets(window_px)
        scale = np.ceil(window_px) if settings.whole_scale else window_px
        x, y = (self.offset.T / scale).astype(settings.dtype)
        self.basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
        n = len(self.uv)
        self.background = np.zeros((n, TERMS))
        self.sigma = np.full(n, np.inf)
        self.misfit = np.full(n, np.inf)
        self.distance = np.full(n, np.inf)  # of the nearest bead
        self.low = -np.inf  # at which grey values are clipped
        self.high = np.inf
        self.crossing: np.ndarray | None = None
        self.strength = np.zeros(n)  # of the background beyond the polynomial
        self.groups: list[Group] = []

    def _set_windows(self, grey: np.ndarray, valid: np.ndarray, bright: np.ndarray) -> None:
        """Note the grey values (n, m) of the windows, and whether they are valid.

        bright has the grey values whose upper quartile is the first background.
        """
        self.grey = grey.astype(self.settings.dtype)
        self.valid = valid
        self.usable = valid.mean(axis=1) >= MIN_PIXELS
        place = int(0.75 * len(self.offset))
        self.background[:, 0] = np.partition(bright, place, axis=1)[:, place]

    def _set_groups(self, near: np.ndarray) -> None:
        """Group beads by the number of their neighbours near (n, k), -1 for none, nearest first.

        Those alone are the first group.
        """
        crowd = (near >= 0).sum(axis=1)
        for low, high in ((0, 0), *self.settings.crowds):
            rows = np.flatnonzero((crowd >= low) & (crowd <= high))
            if len(rows):
                self.groups.append((rows, near[rows, :high]))

    # ---- what a fit must say

    @abstractmethod
    def _model(self, rows: np.ndarray, near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Light (g, m) and its derivatives (g, OWN + 3 k, m): background, then u, v, depth."""

    @abstractmethod
    def _disturbed(self, rows: np.ndarray, near: np.ndarray, final: bool) -> np.ndarray:
        """Windows (g,) in which pixels with large residuals count less."""

    @abstractmethod
    def _depth_sd(self, rows: np.ndarray, near: np.ndarray) -> float | np.ndarray:
        """Standard deviation of what is expected of the depths."""

    @abstractmethod
    def _solve(
        self, rows: np.ndarray, near: np.ndarray, equations: NormalEquations, final: bool
    ) -> np.ndarray:
        """Steps (g, u); where they are final, standard deviations are noted as well."""

    # ---- parts of the model

    def _plane(self, rows: np.ndarray) -> np.ndarray:
        """Light (g, m) in windows without beads."""
        background = self.background[rows].astype(self.settings.dtype)
        plane = background @ self.basis.T
        return np.maximum(plane, 1e-3 * np.abs(background[:, :1]) + 1e-6)

    def _crossing_in(self, rows: np.ndarray) -> np.ndarray:
        """What shadows that touch have together in windows, beyond the product of both."""
        return self.settings.dtype(0) if self.crossing is None else self.crossing[rows]

    def _jacobian(self, relative: np.ndarray, beads: int) -> np.ndarray:
        """Derivatives (g, TERMS + 3 beads, m); only those by the background are set."""
        shape = (len(relative), TERMS + 3 * beads, len(self.offset))
        jacobian = np.empty(shape, dtype=self.settings.dtype)
        np.multiply(relative[:, None], self.basis.T, out=jacobian[:, :TERMS])
        return jacobian

    # ---- Gauss-Newton steps

    def _step(
        self, rows: np.ndarray, near: np.ndarray, final: bool
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return centres, depths and backgrounds of some beads after a step."""
        step = self._solve(rows, near, self._equations(rows, near, final), final)
        moving = self.usable[rows] | self.settings.moves_unusable
        step = np.where(moving[:, None], step, 0)
        longest = self.settings.max_step_px
        return (
            self.uv[rows] + np.clip(step[:, TERMS : TERMS + 2], -longest, longest),
            np.clip(self.depth[rows] + step[:, TERMS + 2], *DEPTHS),
            self.background[rows] + step[:, :TERMS],
        )

    def _equations(self, rows: np.ndarray, near: np.ndarray, final: bool) -> NormalEquations:
        """Return the normal equations of some beads, and note their lack of fit."""
        light, jacobian = self._model(rows, near)
        dtype = self.settings.dtype
        grey = self.grey[rows]
        residual = grey - light
        valid = self._valid(rows, grey, light)
        weight = valid / self.noise.variance(light)
        squared = residual * residual * weight
        total = squared.sum(axis=1)
        disturbed = self._disturbed(rows, near, final) & (self.strength[rows] == 0)
        if disturbed.any():
            usual = self.typical() if self.settings.robust_relative else 1.0
            weight = weight / (1 + disturbed[:, None] * squared / (ROBUST**2 * usual))
        weighted = jacobian * weight.astype(dtype)[:, None]
        prior = self._prior(rows, near)
        normal = (weighted @ np.swapaxes(jacobian, 1, 2)).astype(float)
        diagonal = np.arange(normal.shape[1])
        normal[:, diagonal, diagonal] += prior + 1e-9 * normal[:, diagonal, diagonal] + 1e-12
        right = (weighted @ residual.astype(dtype)[..., None])[..., 0].astype(float)
        expected = self.expected_depth[rows]
        right[:, TERMS + 2] -= prior[:, TERMS + 2] * (self.depth[rows] - expected)
        textured = np.flatnonzero(self.strength[rows])
        if len(textured):
            taken = self.cosines.eliminated(
                self.strength[rows[textured]],
                relative=jacobian[textured, 0],
                jacobian=jacobian[textured],
                weight=weight[textured],
                residual=residual[textured],
            )
            normal[textured] -= taken[0]
            right[textured] -= taken[1]
            total[textured] -= taken[2]
        self.misfit[rows] = total / np.maximum(valid.sum(axis=1) - OWN, 1)
        return NormalEquations(normal, right, weighted)

    def _add_texture(self, chosen: NDArray[np.bool_]) -> None:
        """Give some beads (n,) a background beyond the polynomial, as strong as pixels say."""
        for rows, near in self.groups:
            rows, near = rows[chosen[rows]], near[chosen[rows]]
            if not len(rows):
                continue
            light, jacobian = self._model(rows, near)
            grey = self.grey[rows]
            valid = self._valid(rows, grey, light)
            self.strength[rows] = self.cosines.strengths(
                jacobian[:, 0],
                jacobian=jacobian,
                weight=valid / (self.noise.variance(light) * self.typical()),
                residual=grey - light,
            )

    @cached_property
    def cosines(self) -> Cosines:
        """Background of a window beyond the polynomial."""
        return Cosines(self.offset, self.settings.dtype)

    def _valid(self, rows: np.ndarray, grey: np.ndarray, light: np.ndarray) -> NDArray[np.bool_]:
        """Return (g, m) the pixels that count: a clipped one that agrees with the light does not.

        grey, light: (g, m) values, and what is expected.
        """
        valid = self.valid[rows]
        if np.isfinite(self.high):
            valid &= (grey < self.high) | (light <= grey)
        if np.isfinite(self.low):
            valid &= (grey > self.low) | (light >= grey)
        return valid

    def _prior(self, rows: np.ndarray, near: np.ndarray) -> np.ndarray:
        """Weights (g, OWN + 3 k) of what is expected of the unknowns."""
        prior = np.zeros((len(rows), OWN + 3 * near.shape[1]))
        prior[:, TERMS + 2] = self._depth_sd(rows, near) ** -2.0
        # An absent neighbour has no derivatives; any prior keeps its step zero.
        prior[:, OWN::3] = prior[:, OWN + 1 :: 3] = NEIGHBOUR_SD_PX**-2
        prior[:, OWN + 2 :: 3] = NEIGHBOUR_SD**-2
        return prior

    def typical(self) -> float:
        """Median lack of fit of the beads whose fit goes on."""
        values = self.misfit[self.usable & np.isfinite(self.misfit)]
        if not len(values):
            return 1.0
        values.sort()
        half = len(values) // 2
        return float(values[half] if len(values) % 2 else values[half - 1 : half + 1].mean())

    def _beads(self, measured: np.ndarray, typical: float, inflation: float) -> Beads:
        """Return what was measured, given the usual lack of fit and the inflation of variances."""
        pixels = self.valid.sum(axis=1)
        pooled_freedom = self.settings.pooled
        # The noise of one window is known to some 10 %; that of all windows helps.
        pooled = (self.misfit * pixels + typical * pooled_freedom) / (pixels + pooled_freedom)
        factor = np.sqrt(np.maximum(pooled, typical) * np.where(self.strength > 0, 1.0, inflation))
        # Where shadows cross, their model is less right than its noise says.
        touching = self.distance < 2 * self.profile.radius_px
        factor = np.where(touching, self.settings.crossed * factor, factor)
        return Beads(
            self.uv.copy(),
            self.sigma * factor,
            depth=self.depth.copy(),
            light=self.background[:, 0].copy(),
            misfit=self.misfit / max(typical, 1e-12),
            overlapped=self.distance < 2 * self.profile.reach_px * OVERLAP,
            measured=measured,
        )


# Shadow of a sphere in an image: attenuated light, blurred, as a function of the distance.
#
# A ray at a distance d from the centre of a sphere of radius r is attenuated by exp(-2 m sqrt(r^2
# - d^2)) (Beer and Lambert). Focal spot, detector and pixel blur it, about as a Gaussian;
# scattered light adds a part that no bead takes away.

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
    _by_dtype: dict[np.dtype, tuple[np.ndarray, ...]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

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
        value, slope, to_value, to_slope = self._tables(distance.dtype)
        position = distance * distance.dtype.type(1 / TABLE_STEP)
        np.minimum(position, distance.dtype.type(len(value) - 2), out=position)
        index = position.astype(np.intp)
        position -= index.astype(distance.dtype)
        absorbed = to_value.take(index)
        absorbed *= position
        absorbed += value.take(index)
        derivative = to_slope.take(index)
        derivative *= position
        derivative += slope.take(index)
        return absorbed, derivative

    def _tables(self, dtype: np.dtype) -> tuple[np.ndarray, ...]:
        """Absorbed shares (n,), derivatives (n,), and the steps (n - 1,) to the next of each."""
        if dtype not in self._by_dtype:
            value, slope = self._table.astype(dtype)
            self._by_dtype[dtype] = (value, slope, np.diff(value), np.diff(slope))
        return self._by_dtype[dtype]


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
