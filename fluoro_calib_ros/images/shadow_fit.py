# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Fit blurred shadows of spheres to the grey values of windows: what all such fits share.

A window around a bead has a polynomial of degree 2 as its background. Neighbours that reach into
it are fitted with it, so the standard deviation of a centre contains what the overlap leaves open.
All windows of an image take their Gauss-Newton steps at once.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from .light import MIN_PIXELS, Cosines, Noise, Spectra, correlation_of, less_common

MAX_SIGMA_PX = 0.3  # of a centre: a larger one is that of no shadow, or of one hardly seen
MARGIN_PX = 2.0  # of background around the shadow
DTYPE = np.float32  # of model and derivatives
TERMS = 6  # of the background: a polynomial of degree 2
OWN = TERMS + 3  # unknowns of a bead alone: its background, centre and depth
# Of a step of a neighbour. With less, two beads that nearly coincide stay where they begin.
NEIGHBOUR_SD_PX = 1.0
NEIGHBOUR_SD = 0.2  # of a step of a neighbour's depth
DEPTH_SD = 1.0  # of the depth of a shadow, 1 for the profile
DEPTHS = (0.05, 3.0)  # bounds; a shadow takes light away
MIN_PASSED = 0.02  # of the light, behind a bead: derivatives are divided by it
MIN_INSIDE = 0.6  # of a window that lies in the field
FINE = 3  # points across a pixel of the grid on which shadows that touch are blurred
OVERLAP = 0.85  # times both reaches; shadows that are nearer overlap
DISTURBED = 1.6  # lack of fit from which pixels with large residuals count less
AT_ONCE = 2**18  # derivatives that are computed together, 1 MB: they fit a cache
CORRELATED = 180  # windows that tell the correlation of the noise
INFLUENCES = 20  # beads of whose pixels the influence is computed
UNDISTURBED = 4.0  # times the median lack of fit, of a window without anything else
ROBUST = 2.5  # residual of half weight [standard deviations of the noise]

# Rows of beads (g,) and of their neighbours (g, k), -1 for none.
Group = tuple[NDArray[np.int64], NDArray[np.int64]]


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
    """What differs between fits of shadows."""

    steps: int  #: Gauss-Newton steps
    crossing_steps: tuple[int, ...]  #: before which shadows that touch are blurred together
    #: least and largest number of neighbours of the beads that are fitted together
    crowds: tuple[tuple[int, int], ...]
    max_step_px: float  #: largest step of a centre
    pooled: float  #: degrees of freedom of the noise of all beads, in that of one
    crossed: float  #: factor on the standard deviation where shadows cross

    @property
    def neighbours(self) -> int:
        """Neighbours that are fitted with a bead, at most."""
        return self.crowds[-1][1]


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations of some windows, for steps of u = 6 + 3 + 3 k unknowns."""

    matrix: NDArray[np.float64]  #: (g, u, u)
    plain: NDArray[np.float64]  #: (g, u, u), with a background that is no more than the polynomial
    right: NDArray[np.float64]  #: (g, u)
    weighted: NDArray[np.float32]  #: (g, u, m), derivatives of the pixels times their weights
    #: (g, m), of the pixels, over their standard deviations; 0 for invalid
    residual: NDArray[np.floating]
    valid: NDArray[np.bool_]  #: (g, m)


@lru_cache(maxsize=32)
def window_offsets(radius_px: float) -> NDArray[np.int64]:
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

    def __init__(self, offset: NDArray[np.int64], blur_px: float) -> None:
        half = int(np.abs(offset).max()) + int(np.ceil(3 * blur_px))
        self.axis = np.arange(-half * FINE, half * FINE + 1) / FINE
        self._sigma = float(FINE * np.sqrt(blur_px**2 + 1 / 12))
        self._column, self._row = (offset.T + half) * FINE

    def blurred(self, light: NDArray[np.floating]) -> NDArray[np.floating]:
        """Light (a, a), blurred, in the pixels (m,) of a window."""
        smooth = cv2.GaussianBlur(light, (0, 0), self._sigma, borderType=cv2.BORDER_REPLICATE)
        return smooth[self._row, self._column]


def _parts(rows: NDArray[np.int64], near: NDArray[np.int64], pixels: int) -> list[Group]:
    """Parts of a group, with windows of so many pixels, that are computed one after the other."""
    size = len(rows) * pixels * (OWN + 3 * near.shape[1])
    if size < AT_ONCE:
        return [(rows, near)]
    parts = np.array_split(np.arange(len(rows)), size // AT_ONCE + 1)
    return [(rows[some], near[some]) for some in parts]


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
        self.radius = np.ones(len(self.uv))  # of the shadows, 1 for a typical one
        self.middle = np.rint(self.uv).astype(int)
        self.offset = window_offsets(window_px)
        x, y = (self.offset.T / window_px).astype(DTYPE)
        self.basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
        n = len(self.uv)
        self.background = np.zeros((n, TERMS))
        self.sigma = np.full(n, np.inf)  # of centres, where the noise of pixels is independent
        self.noise_sigma = np.full(n, np.inf)  # the part of it that comes from the noise
        self.correlation = noise.correlation
        self.inflation: float | None = None  # factor on the variances of that part
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
        self.grey = grey.astype(DTYPE)
        self.valid = valid
        self.usable = valid.mean(axis=1) >= MIN_INSIDE
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
    def _disturbed(self, rows: np.ndarray, near: np.ndarray, final: bool) -> NDArray[np.bool_]:
        """Windows (g,) in which pixels with large residuals count less."""

    @abstractmethod
    def _depth_sd(self, rows: np.ndarray, near: np.ndarray) -> float | NDArray[np.float64]:
        """Standard deviation of what is expected of the depths."""

    @abstractmethod
    def _solve(
        self, rows: np.ndarray, near: np.ndarray, equations: NormalEquations, final: bool
    ) -> np.ndarray:
        """Steps (g, u); where they are final, standard deviations are noted as well."""

    # ---- parts of the model

    def _plane(self, rows: NDArray[np.int64]) -> NDArray[np.float32]:
        """Light (g, m) in windows without beads."""
        background = self.background[rows].astype(DTYPE)
        plane = background @ self.basis.T
        return np.maximum(plane, 1e-3 * np.abs(background[:, :1]) + 1e-6)

    def _crossing_in(self, rows: NDArray[np.int64]) -> np.ndarray:
        """What shadows that touch have together in windows, beyond the product of both."""
        return DTYPE(0) if self.crossing is None else self.crossing[rows]

    def _jacobian(self, relative: NDArray[np.floating], beads: int) -> NDArray[np.float32]:
        """Derivatives (g, TERMS + 3 beads, m); only those by the background are set."""
        shape = (len(relative), TERMS + 3 * beads, len(self.offset))
        jacobian = np.empty(shape, dtype=DTYPE)
        np.multiply(relative[:, None], self.basis.T, out=jacobian[:, :TERMS])
        return jacobian

    # ---- Gauss-Newton steps

    def _step(
        self, rows: NDArray[np.int64], near: NDArray[np.int64], final: bool
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return centres, depths and backgrounds of some beads after a step."""
        parts = _parts(rows, near, len(self.offset))
        usual = self.typical() if len(parts) > 1 else None
        step = np.concatenate(
            [self._solve(*part, self._equations(part, final, usual), final) for part in parts]
        )
        step = np.where(self.usable[rows][:, None], step, 0)
        longest = self.settings.max_step_px
        return (
            self.uv[rows] + _within(step[:, TERMS : TERMS + 2], -longest, longest),
            _within(self.depth[rows] + step[:, TERMS + 2], *DEPTHS),
            self.background[rows] + step[:, :TERMS],
        )

    def _equations(self, group: Group, final: bool, usual: float | None) -> NormalEquations:
        """Normal equations of some beads, and their lack of fit; usual: that of a typical bead."""
        rows, near = group
        light, jacobian = self._model(rows, near)
        grey = self.grey[rows]
        residual = grey - light
        valid = self._valid(rows, grey, light)
        weight = valid / self.noise.variance(light)
        squared = residual * residual * weight
        total = squared.sum(axis=1)
        disturbed = self._disturbed(rows, near, final) & (self.strength[rows] == 0)
        if disturbed.any():
            half = ROBUST**2 * (self.typical() if usual is None else usual)
            weight = weight / (1 + disturbed[:, None] * squared / half)
        weighted = jacobian * weight.astype(DTYPE)[:, None]
        prior = self._prior(rows, near)
        normal = (weighted @ np.swapaxes(jacobian, 1, 2)).astype(float)
        diagonal = np.arange(normal.shape[1])
        normal[:, diagonal, diagonal] += prior + 1e-9 * normal[:, diagonal, diagonal] + 1e-12
        right = (weighted @ residual.astype(DTYPE)[..., None])[..., 0].astype(float)
        expected = self.expected_depth[rows]
        right[:, TERMS + 2] -= prior[:, TERMS + 2] * (self.depth[rows] - expected)
        plain = normal
        textured = np.flatnonzero(self.strength[rows])
        if len(textured):
            plain = normal.copy()
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
        standardised = np.sqrt(squared) * np.sign(residual)
        return NormalEquations(
            normal, plain, right, weighted=weighted, residual=standardised, valid=valid
        )

    def _add_texture(self) -> None:
        """Give beads a background beyond the polynomial where pixels say so."""
        rows, residual, root, jacobians = self._standardised()
        plain = np.flatnonzero(self.misfit[rows] <= self.typical())
        plain = plain[:: len(plain) // CORRELATED + 1]
        valid = root > 0
        usual = self.misfit[rows] <= DISTURBED * self.typical()
        residual = less_common(self.uv[rows], self.radius[rows], residual, valid, usual)
        self.correlation = self._correlation(residual[plain], valid[plain])
        rest = residual / np.maximum(root, DTYPE(1e-12))
        ends = np.cumsum([len(jacobian) for jacobian in jacobians])[:-1]
        spectra = [
            self.cosines.spectra(one[:, 0], jacobian=one, weight=weight, residual=left)
            for one, weight, left in zip(jacobians, np.split(root**2, ends), np.split(rest, ends))
        ]
        # The waves are longer than the noise is correlated.
        excess = float(self.correlation.sum())
        self.strength[rows] = Spectra.joined(spectra).strengths(excess)

    def _standardised(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[np.ndarray]]:
        """Residuals of all windows over the noise.

        Returns the beads (n,), residuals (n, m), roots (n, m) of weights, 0 for invalid pixels,
        and the derivatives of some windows after the other.
        """
        groups = [part for group in self.groups for part in _parts(*group, len(self.offset))]
        lights, jacobians = zip(*(self._model(*part) for part in groups))
        light = np.concatenate(lights)
        rows = np.concatenate([rows for rows, _ in groups])
        grey = self.grey[rows]
        root = self._valid(rows, grey, light) / np.sqrt(self.noise.variance(light), dtype=DTYPE)
        return rows, (grey - light) * root, root, list(jacobians)

    def _correlation(self, residual: np.ndarray, valid: np.ndarray) -> NDArray[np.float64]:
        """Correlation of the noise from standardised residuals (g, m) of windows.

        These contain what the model lacks, and the background of the image, which tells it as
        well, the shadows of dense beads: the smaller one contains less of that.
        """
        if valid.sum() < MIN_PIXELS:
            return self.noise.correlation
        of_windows = correlation_of(self._images(residual), self._images(valid))
        return min(of_windows, self.noise.correlation, key=np.sum)

    @cached_property
    def cosines(self) -> Cosines:
        """Background of a window beyond the polynomial."""
        return Cosines(self.offset, DTYPE)

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

    def _prior(self, rows: NDArray[np.int64], near: NDArray[np.int64]) -> NDArray[np.float64]:
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

    def _note_precision(self, rows: NDArray[np.int64], equations: NormalEquations) -> np.ndarray:
        """Note standard deviations of centres; return the covariances (g, u, u)."""
        inverse = np.linalg.inv(equations.matrix)
        self.sigma[rows] = self.noise_sigma[rows] = _sd_of_centre(inverse)
        textured = np.flatnonzero(self.strength[rows])
        if len(textured):
            self.noise_sigma[rows[textured]] = _sd_of_centre(
                np.linalg.inv(equations.plain[textured])
            )
        if self.inflation is None:
            # The influence of pixels on a centre: noise of neighbouring pixels adds up.
            plain = equations.plain[:INFLUENCES]
            influence = np.linalg.solve(plain, equations.weighted[:INFLUENCES])
            both = influence[:, TERMS : TERMS + 2].reshape(-1, influence.shape[2])
            self.inflation = _inflation(self._images(both), self.correlation)
        return inverse

    def _images(self, windows: np.ndarray) -> NDArray[np.float64]:
        """Square images (g, w, w) of round windows (g, m)."""
        half = int(np.abs(self.offset).max())
        images = np.zeros((len(windows), 2 * half + 1, 2 * half + 1))
        images[:, self.offset[:, 1] + half, self.offset[:, 0] + half] = windows
        return images

    def _beads(
        self, measured: NDArray[np.bool_], typical: float, noise: NDArray[np.float64] | None = None
    ) -> Beads:
        """Return what was measured, given the usual lack of fit.

        noise: (n,) the part of the lack of fit that is noise; None for all of it.
        """
        pixels = self.valid.sum(axis=1)
        pooled_freedom = self.settings.pooled
        # The noise of one window is known to some 10 %; that of all windows helps.
        usual = typical
        if noise is None:
            noise = self.misfit
        elif measured.any():
            usual = float(np.median(noise[measured]))
        pooled = (noise * pixels + usual * pooled_freedom) / (pixels + pooled_freedom)
        by_correlation = ((self.inflation or 1.0) - 1) * self.noise_sigma**2
        factor = np.sqrt(np.maximum(pooled, usual))
        # Where shadows cross, their model is less right than its noise says.
        touching = self.distance < 2 * self.profile.radius_px
        factor = np.where(touching, self.settings.crossed * factor, factor)
        return Beads(
            self.uv.copy(),
            np.sqrt(self.sigma**2 + by_correlation) * factor,
            depth=self.depth.copy(),
            light=self.background[:, 0].copy(),
            misfit=self.misfit / max(typical, 1e-12),
            overlapped=self.distance < 2 * self.profile.reach_px * OVERLAP,
            measured=measured,
        )


def _within(values: NDArray[np.float64], low: float, high: float) -> NDArray[np.float64]:
    """Values between bounds: np.clip, in a third of its time for a few."""
    return np.minimum(np.maximum(values, low), high)


def _inflation(influence: NDArray[np.float64], correlation: NDArray[np.float64]) -> float:
    """Return the factor on variances for correlated noise; influence (g, w, w) of pixels."""
    # One tall image: what is filtered reaches into the rows of zeros between them.
    tall = np.pad(influence, ((0, 0), (0, len(correlation) // 2), (0, 0)))
    tall = tall.reshape(-1, influence.shape[2])
    spread = cv2.filter2D(tall, cv2.CV_64F, correlation, borderType=cv2.BORDER_CONSTANT)
    independent = float(np.sum(tall * tall))
    return max(float(np.sum(tall * spread)) / max(independent, 1e-300), 1.0)


def _sd_of_centre(covariance: np.ndarray) -> NDArray[np.float64]:
    """Standard deviations (g,) of a coordinate of centres, from covariances (g, u, u)."""
    variance = 0.5 * (covariance[:, TERMS, TERMS] + covariance[:, TERMS + 1, TERMS + 1])
    return np.sqrt(np.maximum(variance, 0))


# Shadow of a sphere in an image: attenuated light, blurred, as a function of the distance.
#
# A ray at a distance d from the centre of a sphere of radius r is attenuated by exp(-2 m sqrt(r^2
# - d^2)) (Beer and Lambert). Focal spot, detector and pixel blur it, about as a Gaussian;
# scattered light adds a part that no bead takes away.

STEP = 0.2  # of the grid on which a profile is computed [px]
TABLE_STEP = 0.05  # of the table of a profile [px]
KERNEL_SIGMAS = 5.5  # at which a Gaussian is 3e-7
REACH_SIGMAS = 3.2
# Bounds of radius, blur [px], attenuation along the radius, and scattered light.
LOW = (0.5, 0.35, 0.05, 0.0)
HIGH = (40.0, 6.0, 6.0, 0.6)
CHANGE = 1.5  # factor on the first three in one fit
RING_PX = 0.25  # width of the rings whose means a profile is fitted to


@dataclass(frozen=True)
class Profile:
    """Shadow of a bead."""

    radius_px: float
    blur_px: float  #: standard deviation
    attenuation: float  #: along the radius: coefficient times radius
    scatter: float = 0.0  #: share of the light that is not attenuated

    @property
    def reach_px(self) -> float:
        """Distance from the centre at which the shadow has ended [px]."""
        return self.radius_px + REACH_SIGMAS * self.blur_px

    @cached_property
    def border_px(self) -> float:
        """Distance from the centre at which the place of a shadow is measured, RMS [px].

        Light tells the place where it changes.
        """
        distance = np.arange(0.0, self.reach_px, TABLE_STEP)
        weight = self.shadow(distance)[1] ** 2 * distance
        return float(np.sqrt((weight * distance**2).sum() / weight.sum()))

    def sized(self, size: float) -> Profile:
        """Return the profile of a bead of another relative size, which absorbs more, or less."""
        attenuation = self.attenuation * size
        return Profile(self.radius_px * size, self.blur_px, attenuation, self.scatter)

    def absorbed(
        self, squared: NDArray[np.float64], size: NDArray[np.float64] | float = 1.0
    ) -> NDArray[np.float64]:
        """Absorbed share of the light without blur at squared distances [px^2].

        size: relative ones, of which squared distances are multiples of their squares.
        """
        return 1 - np.exp(-self.attenuation * size * self.chord(squared))

    def chord(self, squared: NDArray[np.float64]) -> NDArray[np.float64]:
        """Way through the bead in radii at squared distances [px^2] from its centre."""
        return 2 * np.sqrt(np.maximum(self.radius_px**2 - squared, 0)) / self.radius_px

    def shadow(
        self, distance: NDArray[np.floating]
    ) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Absorbed share of the light at distances [px], and its derivative [1/px]."""
        return self._tables.shadow(distance)

    @cached_property
    def _tables(self) -> Shadows:
        return Shadows([self])


class Shadows:
    """Tables of the shadows of beads of one or of several profiles."""

    def __init__(self, profiles: Sequence[Profile]) -> None:
        tables = [_tabulated(one) for one in profiles]
        ends = np.cumsum([table.shape[1] for table in tables])
        self._first = np.concatenate([[0], ends[:-1]])
        self._last = ends - 2
        self._table = np.concatenate(tables, axis=1)
        self._by_dtype: dict[np.dtype, tuple[np.ndarray, ...]] = {}

    def shadow(
        self, distance: NDArray[np.floating], profile: NDArray[np.int64] | int = 0
    ) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Absorbed share of the light at distances [px] (..., m), and its derivative [1/px].

        profile: (...,), which of the profiles.
        """
        value, slope, to_value, to_slope = self._tables(distance.dtype)
        first = np.asarray(self._first[profile])[..., None]
        last = np.asarray(self._last[profile])[..., None] - first
        position = distance * distance.dtype.type(1 / TABLE_STEP)
        np.minimum(position, last.astype(distance.dtype), out=position)
        index = position.astype(np.intp)
        position -= index.astype(distance.dtype)
        index += first
        absorbed = to_value.take(index)
        absorbed *= position
        absorbed += value.take(index)
        derivative = to_slope.take(index)
        derivative *= position
        derivative += slope.take(index)
        return absorbed, derivative

    def _tables(self, dtype: np.dtype) -> tuple[NDArray[np.floating], ...]:
        """Absorbed shares (n,), derivatives (n,), and the steps (n - 1,) to the next of each."""
        if dtype not in self._by_dtype:
            value, slope = self._table.astype(dtype)
            self._by_dtype[dtype] = (value, slope, np.diff(value), np.diff(slope))
        return self._by_dtype[dtype]


class _Blurred:
    """Shadow of a profile at multiples of TABLE_STEP from its centre."""

    def __init__(self, profile: Profile) -> None:
        self._parts = max(1, int(min(STEP, profile.radius_px / 4) / TABLE_STEP))
        step = self._parts * TABLE_STEP
        # The blur of a square pixel has a variance of 1/12. Only the row through the centre is
        # needed: all columns are weighted to one row, which is blurred along itself.
        self.sigma = float(np.sqrt(profile.blur_px**2 + 1 / 12))
        half = int(np.ceil(KERNEL_SIGMAS * self.sigma / step)) + 1
        count = max(int(np.ceil((profile.reach_px + 3) / step)) + 4, half + 1)
        self._axis = np.arange(count) * step
        self.squared = self._axis[:, None] ** 2 + self._axis**2
        kernel = np.exp(-0.5 * (self._axis / self.sigma) ** 2)
        both = np.append(kernel[0], 2 * kernel[1:])
        self._across = both / both.sum() ** 2
        # The blur is exact between the points of the row, too: a part of a step farther on.
        self._away = (
            np.arange(-half, half + 1) * step + np.arange(self._parts)[:, None] * TABLE_STEP
        )
        self._gauss = np.exp(-0.5 * (self._away / self.sigma) ** 2)
        self._size = int(np.ceil((profile.reach_px + 2) / TABLE_STEP))

    @property
    def distance(self) -> NDArray[np.float64]:
        """Distances (n,) from the centre [px]."""
        return np.asarray(np.arange(self._size) * TABLE_STEP)

    def row(self, quarter: NDArray[np.float64], order: int = 0) -> NDArray[np.float64]:
        """Blur a quarter of an image across its rows; order of the derivative, 0 or 2."""
        row = quarter @ (self._across * self._derivative(self._axis, order))
        return np.concatenate([row[:0:-1], row])

    def table(self, row: NDArray[np.float64], order: int = 0) -> NDArray[np.float64]:
        """Blur a row along itself (n,); order of the derivative along it, 0 to 2."""
        kernels = self._gauss * self._derivative(self._away, order)
        blurred = np.array([np.convolve(row, one, mode='same') for one in kernels])
        return np.asarray(blurred[:, len(row) // 2 :].T.reshape(-1)[: self._size])

    def _derivative(self, away: np.ndarray, order: int) -> NDArray[np.float64]:
        """Derivative of a Gaussian over the Gaussian itself."""
        reduced = away / self.sigma
        if order == 0:
            return np.ones_like(reduced)
        return -reduced / self.sigma if order == 1 else (reduced**2 - 1) / self.sigma**2


def _tabulated(profile: Profile) -> NDArray[np.float64]:
    """Absorbed shares and their derivatives (2, n) at multiples of TABLE_STEP from the centre."""
    blurred = _Blurred(profile)
    row = blurred.row(profile.absorbed(blurred.squared))
    return np.stack([blurred.table(row), blurred.table(row, 1)])


def shadow_derivatives(profile: Profile, distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Derivatives (n, 3) of absorbed shares at distances (n,) [px].

    With respect to radius [1/px], blur [1/px] and attenuation. A wider blur is the diffusion of a
    narrower one, dS/dsigma = sigma (S_xx + S_yy), and a larger bead is a scaled one.
    """
    blurred = _Blurred(profile)
    absorbed = profile.absorbed(blurred.squared)
    row = blurred.row(absorbed)
    laplacian = blurred.table(row, 2) + blurred.table(blurred.row(absorbed, 2))
    scaled = blurred.distance * blurred.table(row, 1) + blurred.sigma**2 * laplacian
    more = profile.chord(blurred.squared) * (1 - absorbed)
    by_attenuation = blurred.table(blurred.row(more))
    columns = -scaled / profile.radius_px, profile.blur_px * laplacian, by_attenuation
    return np.column_stack([np.interp(distance, blurred.distance, one) for one in columns])


@dataclass(frozen=True)
class Absorbed:
    """What beads absorb in pixels, n of them."""

    distance: NDArray[np.float64]  #: (n,), from the centres, over the relative radii [px]
    share: NDArray[np.floating]  #: (n,), of the light
    weight: NDArray[np.floating]  #: (n,)
    size: NDArray[np.float64]  #: (n,), relative sizes of the beads: few different ones

    def binned(self, profile: Profile) -> Iterator[_Binned]:
        """Yield means of rings of the beads of each size, as wide as the profile reaches."""
        for size in np.unique(self.size):
            own = self.size == size
            edges = np.arange(0, profile.sized(float(size)).reach_px + 1, RING_PX)
            cell = np.digitize(self.distance[own], edges)
            sums = [
                np.bincount(cell, weights=one, minlength=len(edges) + 1)[1:-1]
                for one in (
                    self.weight[own],
                    self.weight[own] * self.share[own],
                    self.weight[own] * self.distance[own],
                )
            ]
            total, share, distance = np.array(sums)[:, sums[0] > 0]
            yield _Binned(float(size), distance / total, share / total, np.sqrt(total))


@dataclass(frozen=True)
class _Binned:
    """Mean absorbed shares (n,) of beads of a size in rings at mean distances (n,) [px]."""

    size: float
    distance: NDArray[np.float64]
    share: NDArray[np.float64]
    root: NDArray[np.float64]  #: (n,), of weights

    def residual(self, unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Weighted residuals (n,) of a profile's radius, blur, attenuation and scatter."""
        value, _ = Profile(*unknowns[:3]).sized(self.size).shadow(self.distance)
        return self.root * ((1 - unknowns[3]) * value - self.share)

    def slopes(self, unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivatives (n, 4) of the residuals."""
        profile = Profile(*unknowns[:3]).sized(self.size)
        by_shape = (1 - unknowns[3]) * shadow_derivatives(profile, self.distance)
        by_scatter = -profile.shadow(self.distance)[0]
        columns = np.column_stack([by_shape * (self.size, 1.0, self.size), by_scatter])
        return self.root[:, None] * columns


def fit_profile(absorbed: Absorbed, start: Profile) -> Profile:
    """Fit the profile of a bead of size 1 to what beads absorb."""
    parts = list(absorbed.binned(start))
    first = np.array([start.radius_px, start.blur_px, start.attenuation, start.scatter])
    first = np.clip(first, np.asarray(LOW) * 1.01 + 1e-3, np.asarray(HIGH) * 0.99)
    # The backgrounds belong to the shadows before.
    change = np.append(np.full(3, CHANGE), np.inf)
    bounds = (np.maximum(LOW, first / change), np.minimum(HIGH, first * change))
    # A few steps: `absorbed` is renewed with each profile, and radius and attenuation of a small
    # shadow are hardly told apart.
    found = least_squares(
        lambda unknowns: np.concatenate([part.residual(unknowns) for part in parts]),
        first,
        jac=lambda unknowns: np.concatenate([part.slopes(unknowns) for part in parts]),
        bounds=bounds,
        x_scale=first,
        max_nfev=5,
    )
    return Profile(*map(float, found.x))
