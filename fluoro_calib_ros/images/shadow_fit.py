# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Fit blurred shadows of spheres to the grey values of windows: common part of all such fits.

The light of a window without beads is direct light, whose logarithm is a polynomial of degree 2,
and scattered light, which is constant and not attenuated by beads. Neighbours that reach into the
window are fitted as well, so the standard deviation of a centre includes the uncertainty due to
overlap. All windows of an image take their Gauss-Newton steps at once.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from .light import (
    MIN_PIXELS,
    Cosines,
    Noise,
    Spectra,
    Strengths,
    correlation_of,
    less_common,
)

MAX_SIGMA_PX = 0.3  # largest standard deviation of the centre of a visible shadow
MARGIN_PX = 2.0  # width of the background around the shadow
DTYPE = np.float32  # type of model and derivatives
TERMS = 6  # terms of the background, a polynomial of degree 2
PLANE_TERMS = 3  # those of degree 1
OWN = TERMS + 3  # unknowns of an isolated bead: its background, centre and depth
# Prior standard deviations of a step of a neighbour: place and depth. With a smaller one for the
# place, two beads that nearly coincide stay at their initial values.
NEIGHBOUR_SD_PX = 1.0
NEIGHBOUR_SD = 0.2
DEPTH_SD = 1.0  # prior standard deviation of the depth of a shadow, which is 1 for the profile
DEPTHS = (0.05, 3.0)  # bounds of the depth; a shadow removes light
MIN_PASSED = 0.02  # least share of the light behind a bead: derivatives are divided by it
MIN_INSIDE = 0.6  # least share of a window inside the field
MIN_DIRECT = 0.1  # least share of direct light in the light around a bead
DARK = 1e-3  # grey value below which light cannot be told from none
# Share of the blur that draws shadows towards less light, and its standard deviation. That of the
# detector does. That of the focal spot does if the light changes at the depth of the bead, but
# not if it changes in the beam. The share is between a half and one.
DRAWN = 0.75
DRAWN_SD = 0.5 / np.sqrt(12)
LARGE = 0.1  # relative change of direct light that differs from that of its logarithm
MAX_FACTOR = 20.0  # largest factor on the direct light in a step
# Directions across edges that are tried, 7.5 degrees apart: at the border of a window, an edge is
# then off by less than its blur. NO_EDGE: the background has no straight edge.
DIRECTIONS = 24
NO_EDGE = -1
FINE = 3  # points per pixel of the grid on which shadows that touch are blurred
OVERLAP = 0.85  # fraction of the sum of both reaches; shadows that are nearer overlap
DISTURBED = 1.6  # relative lack of fit from which pixels with large residuals are down-weighted
AT_ONCE = 2**18  # derivatives computed together, 1 MB: they fit into a cache
CORRELATED = 180  # windows from which the correlation of the noise is estimated
INFLUENCES = 20  # beads for which the influence of their pixels is computed
UNDISTURBED = 4.0  # largest lack of fit, over the median, of a window without other objects
ROBUST = 2.5  # residual at which the weight is halved [standard deviations of the noise]

# Rows of beads (g,) and of their neighbours (g, k), -1 for none.
Group = tuple[NDArray[np.int64], NDArray[np.int64]]


@dataclass(frozen=True)
class Beads:
    """Measured beads, in the order in which they were given."""

    uv: NDArray[np.float64]  #: (n, 2), centres [px]
    sigma: NDArray[np.float64]  #: (n,), standard deviation of a coordinate [px]
    depth: NDArray[np.float64]  #: (n,), depth of the shadow, 1 for the profile
    light: NDArray[np.float64]  #: (n,), grey values at the centres without the beads
    #: (n,), mean squared residual over the noise, relative to that of a typical bead
    misfit: NDArray[np.float64]
    #: (n,), True if the shadow of another bead reaches into that of the bead
    overlapped: NDArray[np.bool_]
    measured: NDArray[np.bool_]  #: (n,), False if the window is cut off or the fit failed


@dataclass(frozen=True)
class FitSettings:
    """Settings that differ between fits of shadows."""

    steps: int  #: Gauss-Newton steps
    crossing_steps: tuple[int, ...]  #: steps before which shadows that touch are blurred together
    #: least and largest number of neighbours in each group of beads that is fitted together
    crowds: tuple[tuple[int, int], ...]
    max_step_px: float  #: largest step of a centre
    pooled: float  #: degrees of freedom with which the noise of all beads enters that of each bead
    crossed: float  #: factor on the standard deviation where shadows cross

    @property
    def neighbours(self) -> int:
        """Largest number of neighbours that are fitted with a bead."""
        return self.crowds[-1][1]


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations of some windows, for steps of u = 6 + 3 + 3 k unknowns."""

    matrix: NDArray[np.float64]  #: (g, u, u)
    plain: NDArray[np.float64]  #: (g, u, u), matrix if the background is only the polynomial
    right: NDArray[np.float64]  #: (g, u)
    weighted: NDArray[np.float32]  #: (g, u, m), derivatives of the pixels times their weights
    #: (g, m), residuals of the pixels over their standard deviations; 0 for invalid pixels
    residual: NDArray[np.floating]
    valid: NDArray[np.bool_]  #: (g, m)


@lru_cache(maxsize=32)
def window_offsets(radius_px: float) -> NDArray[np.int64]:
    """Return the pixels (m, 2) of a round window, relative to its middle."""
    half = int(np.ceil(radius_px))
    axis = np.arange(-half, half + 1)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    offsets = grid[(grid * grid).sum(axis=1) <= radius_px**2]
    offsets.flags.writeable = False
    return offsets


@lru_cache(maxsize=2 * DIRECTIONS)
def _cosines_in(squared_px: int, across: float | None) -> Cosines:
    """Return the waves in a round window; squared_px: square of its radius."""
    return Cosines(window_offsets(float(np.sqrt(squared_px + 0.5))), DTYPE, across)


class FineGrid:
    """Grid finer than the pixels, on which light that passes through several beads is blurred.

    The blurred light behind two beads is not the product of their blurred shadows. axis: (a,)
    coordinates of the points, relative to the middle of a window [px].
    """

    def __init__(self, offset: NDArray[np.int64], blur_px: float) -> None:
        half = int(np.abs(offset).max()) + int(np.ceil(3 * blur_px))
        self.axis = np.arange(-half * FINE, half * FINE + 1) / FINE
        self._sigma = float(FINE * np.sqrt(blur_px**2 + 1 / 12))
        self._column, self._row = (offset.T + half) * FINE

    def blurred(self, light: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return blurred light (a, a) at the pixels (m,) of a window."""
        smooth = cv2.GaussianBlur(light, (0, 0), self._sigma, borderType=cv2.BORDER_REPLICATE)
        return smooth[self._row, self._column]


def _parts(rows: NDArray[np.int64], near: NDArray[np.int64], pixels: int) -> list[Group]:
    """Split a group with windows of so many pixels into parts that are computed in turn."""
    size = len(rows) * pixels * (OWN + 3 * near.shape[1])
    if size < AT_ONCE:
        return [(rows, near)]
    parts = np.array_split(np.arange(len(rows)), size // AT_ONCE + 1)
    return [(rows[some], near[some]) for some in parts]


class ShadowFit(ABC):
    """Gauss-Newton fit of windows, each with the neighbours of its bead.

    uv: (n, 2) initial centres [px]. depth: (n,) initial and expected depths of the shadows.
    window_px: radius of the windows.
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
        self.radius = np.ones(len(self.uv))  # relative radii of shadows, 1 for a typical shadow
        self.middle = np.rint(self.uv).astype(int)
        self.offset = window_offsets(window_px)
        x, y = (self.offset.T / window_px).astype(DTYPE)
        self.basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
        n = len(self.uv)
        self.window_px = window_px
        #: coefficients of the logarithm of the direct light
        self.background = np.zeros((n, TERMS))
        self.around = np.zeros(n)  # light of the surroundings
        self.sigma = np.full(n, np.inf)  # of centres, for independent noise of the pixels [px]
        self.noise_sigma = np.full(n, np.inf)  # the part of it due to the noise
        self.correlation = noise.correlation
        self.inflation: float | None = None  # correlation: factor on the variances of that part
        self.misfit = np.full(n, np.inf)
        self.distance = np.full(n, np.inf)  # distance of the nearest bead
        self.low = -np.inf  # grey values at which the image is clipped
        self.high = np.inf
        self.crossing: np.ndarray | None = None
        self.plane_only = False  # whether the background is a polynomial of degree 1
        self.strength = np.zeros(n)  # strength of the background beyond the polynomial
        self.across = np.full(n, NO_EDGE)  # direction across a straight edge in that background
        self.groups: list[Group] = []

    def _set_windows(
        self,
        grey: np.ndarray,
        valid: np.ndarray,
        bright: np.ndarray,
        around: np.ndarray | None = None,
    ) -> None:
        """Note the grey values (n, m) of the windows, and whether they are valid.

        bright: grey values whose upper quartile is the initial light without beads. around: (n,)
        light of the surroundings, None if it is the same.
        """
        self.grey = grey.astype(DTYPE)
        self.valid = valid
        self.usable = valid.mean(axis=1) >= MIN_INSIDE
        place = int(0.75 * len(self.offset))
        light = np.maximum(np.partition(bright, place, axis=1)[:, place], DARK)
        self.around = light if around is None else np.maximum(around, DARK)
        scatter = self.profile.scatter
        if scatter:
            self.around = np.minimum(self.around, (1 - MIN_DIRECT) / scatter * light)
        self.background[:, 0] = np.log(light - scatter * self.around)

    def _set_groups(self, near: np.ndarray) -> None:
        """Group beads by the number of their neighbours near (n, k), -1 for none, nearest first.

        Isolated beads are the first group.
        """
        crowd = (near >= 0).sum(axis=1)
        for low, high in ((0, 0), *self.settings.crowds):
            rows = np.flatnonzero((crowd >= low) & (crowd <= high))
            if len(rows):
                self.groups.append((rows, near[rows, :high]))

    # ---- methods that a fit must implement

    @abstractmethod
    def _model(self, rows: np.ndarray, near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return light (g, m), derivatives (g, OWN + 3 k, m): background, then u, v, depth."""

    @abstractmethod
    def _disturbed(self, rows: np.ndarray, near: np.ndarray, final: bool) -> NDArray[np.bool_]:
        """Return the windows (g,) in which pixels with large residuals are down-weighted."""

    @abstractmethod
    def _depth_sd(self, rows: np.ndarray, near: np.ndarray) -> float | NDArray[np.float64]:
        """Return the prior standard deviation of the depths."""

    @abstractmethod
    def _solve(
        self, rows: np.ndarray, near: np.ndarray, equations: NormalEquations, final: bool
    ) -> np.ndarray:
        """Return steps (g, u); if the step is final, note standard deviations as well."""

    # ---- parts of the model

    def _direct(self, rows: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return the direct light (g, m) in windows without beads."""
        return np.exp(self.background[rows].astype(DTYPE) @ self.basis.T)

    def _scattered(self, rows: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return the scattered light (g, 1) in windows."""
        return DTYPE(self.profile.scatter) * self.around[rows, None].astype(DTYPE)

    def _crossing_in(self, rows: NDArray[np.int64]) -> np.ndarray:
        """Return how shadows that touch differ, in windows, from the product of both shadows."""
        return DTYPE(0) if self.crossing is None else self.crossing[rows]

    def _jacobian(
        self, rows: NDArray[np.int64], passed: NDArray[np.floating], beads: int
    ) -> NDArray[np.float32]:
        """Return derivatives (g, TERMS + 3 beads, m) of which only the background's are set.

        passed: (g, m) direct light behind beads. The unit of a change of the background is the
        direct light in the middle of the window.
        """
        shape = (len(rows), TERMS + 3 * beads, len(self.offset))
        jacobian = np.empty(shape, dtype=DTYPE)
        relative = passed * np.exp(-self.background[rows, :1]).astype(DTYPE)
        np.multiply(relative[:, None], self.basis.T, out=jacobian[:, :TERMS])
        return jacobian

    # ---- Gauss-Newton steps

    def _step(
        self, rows: NDArray[np.int64], near: NDArray[np.int64], final: bool
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return centres, depths and backgrounds of beads after a step."""
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
            self.background[rows] + self._change(rows, step[:, :TERMS]),
        )

    def _change(self, rows: NDArray[np.int64], step: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the changes (g, TERMS) of backgrounds by a step of the direct light."""
        change = step * np.exp(-self.background[rows, :1])
        large = np.flatnonzero(np.abs(change).max(axis=1, initial=0.0) > LARGE)
        if len(large):
            # A change of the light by a large factor is not the same change of its logarithm.
            factor = np.maximum(1 + change[large].astype(DTYPE) @ self.basis.T, 1 / MAX_FACTOR)
            terms = len(self._of_terms)
            change[large, :terms] = np.log(np.minimum(factor, MAX_FACTOR)) @ self._of_terms.T
        return change

    @cached_property
    def _of_terms(self) -> NDArray[np.float32]:
        """Matrix (t, m) that fits the terms that are estimated to the pixels of a window."""
        basis = self.basis[:, :PLANE_TERMS] if self.plane_only else self.basis
        return np.linalg.pinv(basis)

    def _equations(self, group: Group, final: bool, usual: float | None) -> NormalEquations:
        """Return normal equations of beads and note their lack of fit; usual: the typical one."""
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
        plain = normal.copy() if self.strength[rows].any() else normal
        for across, textured in self._textured(rows):
            taken = self._cosines(across).eliminated(
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
        """Add a background beyond the polynomial to beads whose pixels show one."""
        rows, residual, root, jacobians = self._standardised()
        plain = np.flatnonzero(self.misfit[rows] <= self.typical())
        plain = plain[:: len(plain) // CORRELATED + 1]
        valid = root > 0
        usual = self.misfit[rows] <= DISTURBED * self.typical()
        residual = less_common(self.uv[rows], self.radius[rows], residual, valid, usual)
        self.correlation = self._correlation(residual[plain], valid[plain])
        rest = residual / np.maximum(root, DTYPE(1e-12))
        ends = np.cumsum([len(jacobian) for jacobian in jacobians])[:-1]
        parts = list(zip(jacobians, np.split(root**2, ends), np.split(rest, ends)))
        spectra = [
            self._cosines(NO_EDGE).spectra(one[:, 0], jacobian=one, weight=weight, residual=left)
            for one, weight, left in parts
        ]
        # The waves are longer than the correlation length of the noise.
        excess = float(self.correlation.sum())
        strengths = Spectra.joined(spectra).strengths(excess)
        self.strength[rows] = strengths.variance
        if strengths.variance.any():
            self._add_edges(rows, parts, strengths, excess)

    def _add_edges(
        self,
        rows: NDArray[np.int64],
        parts: Sequence[tuple[np.ndarray, ...]],
        strengths: Strengths,
        excess: float,
    ) -> None:
        """Note straight edges where they explain a background better than waves without direction.

        parts: derivatives (k, u, m), weights and residuals (k, m) of the windows in rows, in turn.
        """
        ends = np.cumsum([len(weight) for _, weight, _ in parts])[:-1]
        some = [np.flatnonzero(variance) for variance in np.split(strengths.variance, ends)]
        jacobian = _padded([one[chosen] for (one, _, _), chosen in zip(parts, some)])
        weight = np.concatenate([one[chosen] for (_, one, _), chosen in zip(parts, some)])
        residual = np.concatenate([one[chosen] for (_, _, one), chosen in zip(parts, some)])
        textured = np.flatnonzero(strengths.variance)
        across = self._steepest()[rows[textured]]
        order = np.argsort(across, kind='stable')
        spectra = []
        for direction in np.unique(across).tolist():
            own = order[across[order] == direction]
            cosines = self._cosines(direction)
            spectra.append(
                cosines.spectra(
                    jacobian[own, 0], jacobian[own], weight=weight[own], residual=residual[own]
                )
            )
        edges = Spectra.joined(spectra).strengths_at(excess, strengths.scale)
        better = edges.evidence > strengths.evidence[textured[order]]
        windows = rows[textured[order]][better]
        self.strength[windows] = edges.variance[better]
        self.across[windows] = across[order][better]

    def _steepest(self) -> NDArray[np.int64]:
        """Return directions (n,) in which the light changes most, in steps of a half turn.

        They are the principal axes of the gradient's second moments in a window (Foerstner and
        Guelch, Intercommission Conference on Fast Processing of Photogrammetric Data, 1987).
        """
        _, by_x, by_y, by_xx, by_xy, by_yy = self.background.T
        u = np.stack([by_x, by_xx, 0.5 * by_xy])
        v = np.stack([by_y, 0.5 * by_xy, by_yy])
        # The gradient is (u0 + 2 u1 x + 2 u2 y, ...); x^2 and y^2 have a mean of 1/4 in a circle.
        angle = 0.5 * np.arctan2(2 * (u * v).sum(axis=0), (u * u - v * v).sum(axis=0))
        return np.rint(angle * (DIRECTIONS / np.pi)).astype(int) % DIRECTIONS

    def _textured(self, rows: NDArray[np.int64]) -> Iterator[tuple[int, NDArray[np.int64]]]:
        """Yield directions across edges and the windows in rows (g,) with such a background."""
        textured = np.flatnonzero(self.strength[rows])
        across = self.across[rows[textured]]
        for direction in np.unique(across).tolist():
            yield direction, textured[across == direction]

    def _cosines(self, across: int) -> Cosines:
        """Return the waves of the background beyond the polynomial."""
        angle = None if across == NO_EDGE else across * np.pi / DIRECTIONS
        return _cosines_in(int((self.offset**2).sum(axis=1).max()), angle)

    def _standardised(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[np.ndarray]]:
        """Return standardised residuals of all windows.

        Return the beads (n,), residuals (n, m), roots (n, m) of weights, 0 for invalid pixels, and
        the derivatives for each part of the windows in order.
        """
        groups = [part for group in self.groups for part in _parts(*group, len(self.offset))]
        lights, jacobians = zip(*(self._model(*part) for part in groups))
        light = np.concatenate(lights)
        rows = np.concatenate([rows for rows, _ in groups])
        grey = self.grey[rows]
        root = self._valid(rows, grey, light) / np.sqrt(self.noise.variance(light), dtype=DTYPE)
        return rows, (grey - light) * root, root, list(jacobians)

    def _correlation(self, residual: np.ndarray, valid: np.ndarray) -> NDArray[np.float64]:
        """Return the correlation of the noise from standardised residuals (g, m) of windows.

        The residuals contain errors of the model. The other estimate, from the background of the
        image, contains the shadows of dense beads. The smaller one has less of either.
        """
        if valid.sum() < MIN_PIXELS:
            return self.noise.correlation
        of_windows = correlation_of(self._images(residual), self._images(valid))
        return min(of_windows, self.noise.correlation, key=np.sum)

    def _valid(self, rows: np.ndarray, grey: np.ndarray, light: np.ndarray) -> NDArray[np.bool_]:
        """Return the valid pixels (g, m): a clipped pixel that agrees with the model is not valid.

        grey, light: (g, m) observed and expected values.
        """
        valid = self.valid[rows]
        if np.isfinite(self.high):
            valid &= (grey < self.high) | (light <= grey)
        if np.isfinite(self.low):
            valid &= (grey > self.low) | (light >= grey)
        return valid

    def _prior(self, rows: NDArray[np.int64], near: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the prior weights (g, OWN + 3 k) of the unknowns."""
        prior = np.zeros((len(rows), OWN + 3 * near.shape[1]))
        prior[:, TERMS + 2] = self._depth_sd(rows, near) ** -2.0
        # An absent neighbour has no derivatives; any prior keeps its step zero.
        prior[:, OWN::3] = prior[:, OWN + 1 :: 3] = NEIGHBOUR_SD_PX**-2
        prior[:, OWN + 2 :: 3] = NEIGHBOUR_SD**-2
        return prior

    def typical(self) -> float:
        """Return the median lack of fit of the usable beads."""
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
            # Influence of pixels on a centre: correlated noise of neighbouring pixels adds up.
            plain = equations.plain[:INFLUENCES]
            influence = np.linalg.solve(plain, equations.weighted[:INFLUENCES])
            both = influence[:, TERMS : TERMS + 2].reshape(-1, influence.shape[2])
            self.inflation = _inflation(self._images(both), self.correlation)
        return inverse

    def _images(self, windows: np.ndarray) -> NDArray[np.float64]:
        """Return square images (g, w, w) of round windows (g, m)."""
        half = int(np.abs(self.offset).max())
        images = np.zeros((len(windows), 2 * half + 1, 2 * half + 1))
        images[:, self.offset[:, 1] + half, self.offset[:, 0] + half] = windows
        return images

    def _beads(
        self, measured: NDArray[np.bool_], typical: float, noise: NDArray[np.float64] | None = None
    ) -> Beads:
        """Return the measured beads, given the typical lack of fit.

        noise: (n,) part of the lack of fit that is noise; None for all of it.
        """
        pixels = self.valid.sum(axis=1)
        pooled_freedom = self.settings.pooled
        # The noise of one window is known to about 10 %; pooling with all windows helps.
        usual = typical
        if noise is None:
            noise = self.misfit
        elif measured.any():
            usual = float(np.median(noise[measured]))
        pooled = (noise * pixels + usual * pooled_freedom) / (pixels + pooled_freedom)
        by_correlation = ((self.inflation or 1.0) - 1) * self.noise_sigma**2
        factor = np.sqrt(np.maximum(pooled, usual))
        # Where shadows touch, the model errs by more than the noise of the pixels suggests.
        touching = self.distance < 2 * self.profile.radius_px
        factor = np.where(touching, self.settings.crossed * factor, factor)
        sigma = np.sqrt(self.sigma**2 + by_correlation) * factor
        drawn = self._drawn()
        return Beads(
            self.uv + DRAWN * drawn,
            np.hypot(sigma, DRAWN_SD * np.sqrt(0.5 * (drawn * drawn).sum(axis=1))),
            depth=self.depth.copy(),
            light=np.exp(self.background[:, 0]) + self.profile.scatter * self.around,
            misfit=self.misfit / max(typical, 1e-12),
            overlapped=self.distance < 2 * self.profile.reach_px * OVERLAP,
            measured=measured,
        )

    def _drawn(self) -> NDArray[np.float64]:
        """Return how far (n, 2) blur draws shadows towards less light [px], as a shift back.

        If direct light is proportional to exp(g x), a shadow that a Gaussian of variance s^2 blurs
        with it appears at x - g s^2 (complete the square in the convolution).
        """
        x, y = ((self.uv - self.middle) / self.window_px).T
        _, by_x, by_y, by_xx, by_xy, by_yy = self.background.T
        gradient = [by_x + 2 * by_xx * x + by_xy * y, by_y + by_xy * x + 2 * by_yy * y]
        return np.column_stack(gradient) * (self.profile.variance_px2 / self.window_px)


def _padded(parts: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
    """Return derivatives (n, u, m) of all parts (k, u, m), zero for unknowns of larger parts."""
    count = sum(len(part) for part in parts)
    unknowns = max(part.shape[1] for part in parts)
    out = np.zeros((count, unknowns, parts[0].shape[2]), dtype=DTYPE)
    begin = 0
    for part in parts:
        out[begin : begin + len(part), : part.shape[1]] = part
        begin += len(part)
    return out


def _within(values: NDArray[np.float64], low: float, high: float) -> NDArray[np.float64]:
    """Return values between bounds: like np.clip, in a third of its time for a few values."""
    return np.minimum(np.maximum(values, low), high)


def _inflation(influence: NDArray[np.float64], correlation: NDArray[np.float64]) -> float:
    """Return the factor on variances for correlated noise; influence: (g, w, w) of pixels."""
    # Use one tall image: filtering reaches into the rows of zeros between the windows.
    tall = np.pad(influence, ((0, 0), (0, len(correlation) // 2), (0, 0)))
    tall = tall.reshape(-1, influence.shape[2])
    spread = cv2.filter2D(tall, cv2.CV_64F, correlation, borderType=cv2.BORDER_CONSTANT)
    independent = float(np.sum(tall * tall))
    return max(float(np.sum(tall * spread)) / max(independent, 1e-300), 1.0)


def _sd_of_centre(covariance: np.ndarray) -> NDArray[np.float64]:
    """Return standard deviations (g,) of a coordinate of centres from covariances (g, u, u)."""
    variance = 0.5 * (covariance[:, TERMS, TERMS] + covariance[:, TERMS + 1, TERMS + 1])
    return np.sqrt(np.maximum(variance, 0))


# Shadow of a sphere in an image: attenuated and blurred light as a function of the distance.
#
# A ray at a distance d from the centre of a sphere of radius r is attenuated by exp(-2 m sqrt(r^2
# - d^2)) (Beer and Lambert). Focal spot, detector and pixel blur it approximately as a Gaussian;
# scattered light adds a part that beads do not attenuate.

STEP = 0.2  # step of the grid on which a profile is computed [px]
TABLE_STEP = 0.05  # step of the table of a profile [px]
KERNEL_SIGMAS = 5.5  # half width of a Gaussian kernel, at which it is 3e-7
REACH_SIGMAS = 3.2  # standard deviations of the blur beyond the radius at which a shadow ends
# Bounds of radius [px], blur [px], attenuation along the radius, and scattered light.
LOW = (0.5, 0.35, 0.05, 0.0)
HIGH = (40.0, 6.0, 6.0, 0.6)
MAX_ABSORBED = float(-np.expm1(-2 * HIGH[2]))  # share of the direct light
CHANGE = 1.5  # largest factor on the first three in one fit
RING_PX = 0.25  # width of the rings to whose means a profile is fitted
AROUND_STEP = 1.5  # ratio of shares of the surrounding light in rings that are kept apart
AROUND_STEPS = 4  # largest number of such steps


@dataclass(frozen=True)
class Profile:
    """Shadow of a bead."""

    radius_px: float
    blur_px: float  #: standard deviation of the blur
    attenuation: float  #: attenuation coefficient times radius
    scatter: float = 0.0  #: share of the light that is not attenuated

    @property
    def reach_px(self) -> float:
        """Distance from the centre at which the shadow ends [px]."""
        return self.radius_px + REACH_SIGMAS * self.blur_px

    @property
    def variance_px2(self) -> float:
        """Variance of the blur, including that of a square pixel, 1/12 [px^2]."""
        return self.blur_px**2 + 1 / 12

    @cached_property
    def border_px(self) -> float:
        """RMS distance from the centre of the pixels that determine the place of a shadow [px].

        The pixels where the light changes determine the place.
        """
        distance = np.arange(0.0, self.reach_px, TABLE_STEP)
        weight = self.shadow(distance)[1] ** 2 * distance
        return float(np.sqrt((weight * distance**2).sum() / weight.sum()))

    def sized(self, size: float) -> Profile:
        """Return the profile of a bead of another size, with attenuation in proportion."""
        attenuation = self.attenuation * size
        return Profile(self.radius_px * size, self.blur_px, attenuation, self.scatter)

    def with_scatter(self, scatter: float) -> Profile:
        """Return a profile with another share of scattered light and an equally dark middle."""
        absorbed = (1 - self.scatter) * -np.expm1(-2 * self.attenuation)
        direct = min(absorbed / (1 - scatter), MAX_ABSORBED)
        return replace(self, attenuation=float(-0.5 * np.log1p(-direct)), scatter=scatter)

    def absorbed(
        self, squared: NDArray[np.float64], size: NDArray[np.float64] | float = 1.0
    ) -> NDArray[np.float64]:
        """Return the absorbed share of the light without blur at squared distances [px^2].

        size: relative sizes; the squared distances are divided by their squares.
        """
        return 1 - np.exp(-self.attenuation * size * self.chord(squared))

    def chord(self, squared: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the path through the bead [radii] at squared distances from its centre [px^2]."""
        return 2 * np.sqrt(np.maximum(self.radius_px**2 - squared, 0)) / self.radius_px

    def shadow(
        self, distance: NDArray[np.floating]
    ) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Return the absorbed share of the light at distances [px] and its derivative [1/px]."""
        return self._tables.shadow(distance)

    @cached_property
    def _tables(self) -> Shadows:
        return Shadows([self])


class Shadows:
    """Tables of the shadows of beads of one or several profiles."""

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
        """Return the absorbed share of light at distances [px] (..., m) and its derivative [1/px].

        profile: (...,) index of the profile.
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
        """Return absorbed shares (n,), derivatives (n,), and the differences (n - 1,) of each."""
        if dtype not in self._by_dtype:
            value, slope = self._table.astype(dtype)
            self._by_dtype[dtype] = (value, slope, np.diff(value), np.diff(slope))
        return self._by_dtype[dtype]


class _Blurred:
    """Shadow of a profile at multiples of TABLE_STEP from its centre."""

    def __init__(self, profile: Profile) -> None:
        self._parts = max(1, int(min(STEP, profile.radius_px / 4) / TABLE_STEP))
        step = self._parts * TABLE_STEP
        # Only the row through the centre is needed: all columns are weighted to one row, which is
        # blurred along itself.
        self.sigma = float(np.sqrt(profile.variance_px2))
        half = int(np.ceil(KERNEL_SIGMAS * self.sigma / step)) + 1
        count = max(int(np.ceil((profile.reach_px + 3) / step)) + 4, half + 1)
        self._axis = np.arange(count) * step
        self.squared = self._axis[:, None] ** 2 + self._axis**2
        kernel = np.exp(-0.5 * (self._axis / self.sigma) ** 2)
        both = np.append(kernel[0], 2 * kernel[1:])
        self._across = both / both.sum() ** 2
        # The blur is exact between the points of the row, too, at multiples of TABLE_STEP.
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
        """Blur a quarter of an image across its rows; order: that of the derivative, 0 or 2."""
        row = quarter @ (self._across * self._derivative(self._axis, order))
        return np.concatenate([row[:0:-1], row])

    def table(self, row: NDArray[np.float64], order: int = 0) -> NDArray[np.float64]:
        """Blur a row along itself (n,); order: that of the derivative along it, 0 to 2."""
        kernels = self._gauss * self._derivative(self._away, order)
        blurred = np.array([np.convolve(row, one, mode='same') for one in kernels])
        return np.asarray(blurred[:, len(row) // 2 :].T.reshape(-1)[: self._size])

    def _derivative(self, offset: np.ndarray, order: int) -> NDArray[np.float64]:
        """Return the derivative of a Gaussian divided by the Gaussian itself."""
        reduced = offset / self.sigma
        if order == 0:
            return np.ones_like(reduced)
        return -reduced / self.sigma if order == 1 else (reduced**2 - 1) / self.sigma**2


def _tabulated(profile: Profile) -> NDArray[np.float64]:
    """Return absorbed shares and derivatives (2, n) at multiples of TABLE_STEP from the centre."""
    blurred = _Blurred(profile)
    row = blurred.row(profile.absorbed(blurred.squared))
    return np.stack([blurred.table(row), blurred.table(row, 1)])


def shadow_derivatives(profile: Profile, distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return derivatives (n, 3) of absorbed shares at distances (n,) [px].

    They are with respect to radius [1/px], blur [1/px] and attenuation. A wider blur is a diffused
    narrower blur, dS/dsigma = sigma (S_xx + S_yy), and a larger bead is a scaled bead.
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
    """Light that beads absorb in n pixels."""

    distance: NDArray[np.float64]  #: (n,), distance from the centre, over the relative radius [px]
    share: NDArray[np.floating]  #: (n,), absorbed share of the light
    weight: NDArray[np.floating]  #: (n,)
    size: NDArray[np.float64]  #: (n,), relative sizes of the beads, with few different values
    around: NDArray[np.floating]  #: (n,), light of the surroundings over that without beads

    def binned(self, profile: Profile) -> Iterator[_Binned]:
        """Yield means over rings for the beads of each size, up to the reach of the profile.

        Pixels of a ring are separated by the light of their surroundings.
        """
        step = np.rint(np.log(self.around) / np.log(AROUND_STEP)).astype(int)
        step = np.clip(step, -AROUND_STEPS, AROUND_STEPS) + AROUND_STEPS
        for size in np.unique(self.size):
            own = self.size == size
            edges = np.arange(0, profile.sized(float(size)).reach_px + 1, RING_PX)
            shape = len(edges) + 1, 2 * AROUND_STEPS + 1
            cell = np.digitize(self.distance[own], edges) * shape[1] + step[own]
            values = (np.ones(1), self.share[own], self.distance[own], self.around[own])
            sums = [
                np.bincount(cell, weights=self.weight[own] * one, minlength=shape[0] * shape[1])
                for one in values
            ]
            rings = np.reshape(sums, (len(values), *shape))[:, 1:-1]
            total, *means = rings[:, rings[0] > 0]
            yield _Binned(float(size), np.sqrt(total), *(mean / total for mean in means))


@dataclass(frozen=True)
class _Binned:
    """Mean absorbed shares (n,) of beads of a size in rings at mean distances (n,) [px]."""

    size: float
    root: NDArray[np.float64]  #: (n,), square roots of the weights
    share: NDArray[np.float64]
    distance: NDArray[np.float64]
    around: NDArray[np.float64]  #: (n,), light of the surroundings over that without beads

    def residual(self, unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return weighted residuals (n,) for radius, blur, attenuation and scatter."""
        value, _ = Profile(*unknowns[:3]).sized(self.size).shadow(self.distance)
        return self.root * ((1 - unknowns[3] * self.around) * value - self.share)

    def slopes(self, unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return derivatives (n, 4) of the residuals."""
        profile = Profile(*unknowns[:3]).sized(self.size)
        direct = 1 - unknowns[3] * self.around
        by_shape = direct[:, None] * shadow_derivatives(profile, self.distance)
        by_scatter = -self.around * profile.shadow(self.distance)[0]
        columns = np.column_stack([by_shape * (self.size, 1.0, self.size), by_scatter])
        return self.root[:, None] * columns


def fit_profile(absorbed: Absorbed, start: Profile, is_scatter_known: bool = False) -> Profile:
    """Fit the profile of a bead of size 1 to the light absorbed by beads.

    is_scatter_known: keep the share of scattered light of the start.
    """
    parts = list(absorbed.binned(start))
    known = [start.scatter] if is_scatter_known else []
    count = 4 - len(known)
    first = np.array([start.radius_px, start.blur_px, start.attenuation, start.scatter])
    first = np.clip(first, np.asarray(LOW) * 1.01 + 1e-3, np.asarray(HIGH) * 0.99)[:count]
    # The backgrounds were estimated with the previous profile.
    change = np.append(np.full(3, CHANGE), np.inf)[:count]
    bounds = (np.maximum(LOW[:count], first / change), np.minimum(HIGH[:count], first * change))
    # Few evaluations: `absorbed` is updated with each profile, and the radius and attenuation of a
    # small shadow are hardly separable.
    found = least_squares(
        lambda x: np.concatenate([part.residual(np.append(x, known)) for part in parts]),
        first,
        jac=lambda x: np.concatenate([part.slopes(np.append(x, known)) for part in parts])[
            :, :count
        ],
        bounds=bounds,
        x_scale=first,
        max_nfev=5,
    )
    return Profile(*map(float, found.x), *known)
