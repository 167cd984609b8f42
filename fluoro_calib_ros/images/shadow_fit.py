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
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from .background import START_SPREAD, TERMS, Background, HiddenLight
from .clipping import UNCLIPPED
from .light import MIN_PIXELS, Noise, correlation_of, less_common, line_of_variance
from .profile import Profile
from .texture import DTYPE, Texture, window_offsets

MAX_SIGMA_PX = 0.3  # largest standard deviation of the centre of a visible shadow
MARGIN_PX = 2.0  # width of the background around the shadow
OWN = TERMS + 3  # unknowns of an isolated bead: its background, centre and depth
# Prior standard deviations of a step of a neighbour: place and depth. With a smaller one for the
# place, two beads that nearly coincide stay at their initial values.
NEIGHBOUR_SD_PX = 1.0
NEIGHBOUR_SD = 0.2
DEPTH_SD = 1.0  # prior standard deviation of the depth of a shadow, which is 1 for the profile
DEPTHS = (0.05, 3.0)  # bounds of the depth; a shadow removes light
HIDDEN = 0.5  # share of clipped pixels beyond which they hide the light of a window
MIN_PASSED = 0.02  # least share of the light behind a bead: derivatives are divided by it
MIN_INSIDE = 0.6  # least share of a window inside the field
# Share of the blur that draws shadows towards less light, and its standard deviation. That of the
# detector does. That of the focal spot does if the light changes at the depth of the bead, but
# not if it changes in the beam. The share is between a half and one.
DRAWN = 0.75
DRAWN_SD = 0.5 / np.sqrt(12)
OVERLAP = 0.85  # fraction of the sum of both reaches; shadows that are nearer overlap
DISTURBED = 1.6  # relative lack of fit from which pixels with large residuals are down-weighted
AT_ONCE = 2**18  # derivatives computed together, 1 MB: they fit into a cache
CORRELATED = 180  # windows from which the correlation of the noise is estimated
INFLUENCES = 20  # beads for which the influence of their pixels is computed
UNDISTURBED = 4.0  # largest lack of fit, over the median, of a window without other objects
# Information of a pixel, over that of one that is not clipped, from which its residual counts in
# statistics of residuals.
KNOWN = 0.5
MIN_KEPT = 0.1  # least share of the noise of a pixel that counts as left in its residual
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
    spread_step: int = 1  #: from which the spread of light that clipped pixels hide is estimated

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
        n = len(self.uv)
        self.background = Background(n, self.offset, window_px)
        self.sigma = np.full(n, np.inf)  # of centres, for independent noise of the pixels [px]
        self.noise_sigma = np.zeros(n)  # the part of it due to the noise
        self.correlation = noise.correlation
        self.inflation: float | None = None  # correlation: factor on the variances of that part
        self.influence: np.ndarray | None = None  # of the pixels (k, m) of some windows on centres
        self.misfit = np.full(n, np.inf)
        self.distance = np.full(n, np.inf)  # distance of the nearest bead
        self.clipping = UNCLIPPED
        self.hidden: HiddenLight | None = None
        self.crossing: np.ndarray | None = None
        self.texture = Texture.none(n, self.offset, (profile.sharpening, profile.mask_px))
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
        light = np.partition(bright, place, axis=1)[:, place]
        self.background.start(light, around, self.profile.scatter)
        if self.clipping:
            clipped = valid & ~self.clipping.leaves(grey)
            if (clipped.sum(axis=1) > HIDDEN * valid.sum(axis=1)).any():
                self.hidden = HiddenLight(len(valid))
                self.background.spread[:] = START_SPREAD

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

    def _crossing_in(self, rows: NDArray[np.int64]) -> np.ndarray:
        """Return how shadows that touch differ, in windows, from the product of both shadows."""
        return DTYPE(0) if self.crossing is None else self.crossing[rows]

    def _jacobian(
        self, rows: NDArray[np.int64], passed: NDArray[np.floating], beads: int
    ) -> NDArray[np.float32]:
        """Return derivatives (g, TERMS + 3 beads, m) of which only the background's are set.

        passed: (g, m) direct light behind beads.
        """
        shape = (len(rows), TERMS + 3 * beads, len(self.offset))
        jacobian = np.empty(shape, dtype=DTYPE)
        relative = self.background.derivatives(rows, passed)
        np.multiply(relative[:, None], self.background.basis.T, out=jacobian[:, :TERMS])
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
            self.background.changed(rows, step[:, :TERMS]),
        )

    def _equations(self, group: Group, final: bool, usual: float | None) -> NormalEquations:
        """Return normal equations of beads and note their lack of fit; usual: the typical one."""
        rows, near = group
        light, jacobian = self._model(rows, near)
        residual, weight, information = self._observed(rows, light)
        squared = residual * residual * weight
        total = squared.sum(axis=1)
        disturbed = self._disturbed(rows, near, final) & (self.texture.strength[rows] == 0)
        if disturbed.any():
            half = ROBUST**2 * (self.typical() if usual is None else usual)
            weight = weight / (1 + disturbed[:, None] * squared / half)
        weighted = jacobian * weight.astype(DTYPE)[:, None]
        prior = self._prior(rows, near)
        normal = (weighted @ np.swapaxes(jacobian, 1, 2)).astype(float)
        diagonal = np.arange(normal.shape[1])
        normal[:, diagonal, diagonal] += prior + 1e-9 * normal[:, diagonal, diagonal] + 1e-12
        right = (weighted @ residual.astype(DTYPE)[..., None])[..., 0].astype(float)
        right[:, 1:TERMS] -= prior[:, 1:TERMS] * self.background.in_steps(rows)
        expected = self.expected_depth[rows]
        right[:, TERMS + 2] -= prior[:, TERMS + 2] * (self.depth[rows] - expected)
        plain = normal.copy() if self.texture.strength[rows].any() else normal
        for cosines, textured in self.texture.in_windows(rows):
            taken = cosines.eliminated(
                self.texture.strength[rows[textured]],
                relative=self.background.relative(rows[textured], light[textured]),
                jacobian=jacobian[textured],
                weight=weight[textured],
                residual=residual[textured],
            )
            normal[textured] -= taken[0]
            right[textured] -= taken[1]
            total[textured] -= taken[2]
        self.misfit[rows] = total / np.maximum(information.sum(axis=1) - OWN, 1)
        valid = information > KNOWN
        standardised = np.sqrt(squared) * np.sign(residual) * valid
        if self.hidden:
            self.hidden.note(rows, normal, right, self.background)
        return NormalEquations(
            normal, plain, right, weighted=weighted, residual=standardised, valid=valid
        )

    def _renew_prior(self, step: int) -> bool:
        """Renew the prior of light that clipped pixels hide, if any; return whether it changed."""
        if self.hidden and step >= self.settings.spread_step:
            self.background.spread = self.hidden.spread(self.usable, self.typical())
        return self.hidden is not None

    def _add_texture(self) -> None:
        """Add a background beyond the polynomial to beads whose pixels show one."""
        (rows, relative, residual, root, valid), jacobians = self._standardised()
        plain = np.flatnonzero(self.misfit[rows] <= self.typical())
        plain = plain[:: len(plain) // CORRELATED + 1]
        usual = self.misfit[rows] <= DISTURBED * self.typical()
        residual = less_common(self.uv[rows], self.radius[rows], residual, valid, usual)
        self.correlation = _correlation(self, residual[plain], valid[plain])
        rest = residual / np.maximum(root, DTYPE(1e-12))
        ends = np.cumsum([len(jacobian) for jacobian in jacobians])[:-1]
        arrays = relative, root**2, rest
        parts = list(zip(jacobians, *(np.split(array, ends) for array in arrays)))
        # The waves are longer than the correlation length of the noise.
        excess = float(self.correlation.sum())
        self.texture = self.texture.estimated(rows, parts, self.background.steepest(rows), excess)

    def _standardised(self) -> tuple[tuple[np.ndarray, ...], list[np.ndarray]]:
        """Return standardised residuals of all windows, and the derivatives of each part of them.

        The first are the beads (n,), light as a fraction of that without beads (n, m), residuals
        (n, m), roots of weights (n, m), 0 for invalid pixels, and whether pixels are known (n, m).
        """
        groups = [part for group in self.groups for part in _parts(*group, len(self.offset))]
        lights, jacobians = zip(*(self._model(*part) for part in groups))
        light = np.concatenate(lights)
        rows = np.concatenate([rows for rows, _ in groups])
        residual, weight, information = self._observed(rows, light)
        root = np.sqrt(weight, dtype=DTYPE)
        relative = self.background.relative(rows, light)
        return (rows, relative, residual * root, root, information > KNOWN), list(jacobians)

    def _observed(
        self, rows: NDArray[np.int64], light: NDArray[np.floating]
    ) -> tuple[NDArray[np.floating], NDArray[np.floating], NDArray[np.floating]]:
        """Return residuals (g, m), their weights (g, m), and the information (g, m) of pixels.

        light: (g, m) expected values. The information is 1, less if a pixel is clipped, 0 if it is
        invalid.
        """
        variance = self.noise.variance(light)
        valid = self.valid[rows]
        if not self.clipping:
            return self.grey[rows] - light, valid / variance, valid
        residual, information = self.clipping.observed(self.grey[rows], light, variance)
        information *= valid
        return residual, information / variance, information

    def _prior(self, rows: NDArray[np.int64], near: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the prior weights (g, OWN + 3 k) of the unknowns."""
        prior = np.zeros((len(rows), OWN + 3 * near.shape[1]))
        prior[:, :TERMS] = self.background.prior(rows)
        prior[:, TERMS + 2] = self._depth_sd(rows, near) ** -2.0
        # An absent neighbour has no derivatives; any prior keeps its step zero.
        prior[:, OWN::3] = prior[:, OWN + 1 :: 3] = NEIGHBOUR_SD_PX**-2
        prior[:, OWN + 2 :: 3] = NEIGHBOUR_SD**-2
        return prior

    def typical(self) -> float:
        """Return the median lack of fit of the usable beads."""
        values = self.misfit[self.usable & np.isfinite(self.misfit)]
        return _median(values) if len(values) else 1.0

    def _note_precision(
        self, rows: NDArray[np.int64], equations: NormalEquations, part: NDArray[np.int64]
    ) -> np.ndarray:
        """Note standard deviations of some centres; return their covariances (p, u, u).

        part: (p,) which of the beads in rows (g,) they are.
        """
        inverse = np.linalg.inv(equations.matrix[part])
        self.sigma[rows[part]] = self.noise_sigma[rows[part]] = _sd_of_centre(inverse)
        textured = part[self.texture.strength[rows[part]] > 0]
        plain = np.linalg.inv(equations.plain[textured])
        self.noise_sigma[rows[textured]] = _sd_of_centre(plain)
        if self.inflation is None and self.influence is None and len(part):
            some = part[:INFLUENCES]
            influence = np.linalg.solve(equations.plain[some], equations.weighted[some])
            self.influence = influence[:, TERMS : TERMS + 2].reshape(-1, influence.shape[2])
        return inverse

    def _beads(
        self, measured: NDArray[np.bool_], typical: float, noise: NDArray[np.float64] | None = None
    ) -> Beads:
        """Return the measured beads, given the typical lack of fit.

        noise: (n,) part of the lack of fit that is noise; None for all of it.
        """
        pixels = self.valid.sum(axis=1)
        # The noise of one window is known to about 10 %; pooling with all windows helps.
        usual = typical
        if noise is None:
            noise = self.misfit
        elif measured.any():
            usual = float(np.median(noise[measured]))
        freedom = self.settings.pooled
        pooled = (noise * pixels + usual * freedom) / (pixels + freedom)
        if self.influence is not None:
            # Correlated noise of neighbouring pixels adds up.
            self.inflation = _inflation(_images(self.offset, self.influence), self.correlation)
        by_correlation = ((self.inflation or 1.0) - 1) * self.noise_sigma**2
        factor = np.sqrt(np.maximum(pooled, usual))
        # Where shadows touch, the model errs by more than the noise of the pixels suggests.
        factor[self.distance < 2 * self.profile.radius_px] *= self.settings.crossed
        sigma = np.sqrt(self.sigma**2 + by_correlation) * factor
        shift, sd = _shifts(self)
        return Beads(
            self.uv + shift,
            np.hypot(sigma, sd),
            depth=self.depth.copy(),
            light=self.background.light,
            misfit=self.misfit / max(typical, 1e-12),
            overlapped=self.distance < 2 * self.profile.reach_px * OVERLAP,
            measured=measured,
        )


def noise_of_windows(fit: ShadowFit) -> Noise:
    """Return the noise of pixels in usual windows, or that of the image if these are few."""
    level, deviation = _deviations(fit)
    if len(level) < MIN_PIXELS:
        return fit.noise
    # In shadows, deficiencies of the profile look like noise that falls with the light.
    constant, gain = line_of_variance(level, deviation, rises=fit.noise.gain > 0)
    return replace(fit.noise, constant=constant, gain=gain)


def _deviations(fit: ShadowFit) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return expected light (k,) and absolute residuals (k,) of pixels in usual windows.

    The unknowns of a window absorb a part of the noise, the leverage of each pixel; residuals
    are those without this loss.
    """
    out = [np.zeros((2, 0))]
    for rows, near in fit.groups:
        equations = fit._equations((rows, near), True, None)
        light, jacobian = fit._model(rows, near)
        residual, _, information = fit._observed(rows, light)
        influence = np.linalg.solve(equations.matrix, equations.weighted)
        kept = np.clip(1 - (jacobian * influence).sum(axis=1), MIN_KEPT, 1)
        known = (information > KNOWN) & fit.clipping.leaves(light)
        usual = fit.usable[rows] & (fit.misfit[rows] <= DISTURBED * fit.typical())
        known &= (usual & (fit.texture.strength[rows] == 0))[:, None]
        out.append(np.stack([light, np.abs(residual) / np.sqrt(kept)])[:, known])
    light, residual = np.concatenate(out, axis=1)
    return light, residual


def _shifts(fit: ShadowFit) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return shifts (n, 2) back from less light, where blur and mask have drawn shadows [px].

    The second value is the standard deviation of a coordinate (n,).
    """
    # The noise of holes in a sheet does not increase with the inverted light: they are not shadows
    # that attenuate it.
    blurred, masked = fit.profile.drawn_px2 if fit.noise.gain > 0 else (0.0, 0.0)
    slope = fit.background.slope(fit.uv - fit.middle)
    drawn = blurred * slope
    shift = DRAWN * drawn
    if masked:  # it amplifies edges, so that the background beyond the polynomial counts, too
        shift += masked * (slope + _textured_slope(fit))
    return shift, DRAWN_SD * np.sqrt(0.5 * (drawn * drawn).sum(axis=1))


def _textured_slope(fit: ShadowFit) -> NDArray[np.float64]:
    """Return relative slopes (n, 2) of the backgrounds beyond the polynomials [1/px].

    They are those of the planes that fit them best where the place of a shadow is determined.
    """
    slope = np.zeros_like(fit.uv)
    distance = np.linalg.norm(fit.offset, axis=1)
    border = fit.profile.shadow(distance)[1] ** 2
    plane = border[:, None] * fit.offset / (0.5 * border @ distance**2)
    for group in fit.groups:
        textured = fit.texture.strength[group[0]] > 0
        rows, near = group[0][textured], group[1][textured]
        light, _ = fit._model(rows, near)
        residual, weight, _ = fit._observed(rows, light)
        relative = fit.background.relative(rows, light)
        for cosines, own in fit.texture.in_windows(rows):
            expected = cosines.expected(
                fit.texture.strength[rows[own]],
                relative[own],
                weight=weight[own],
                residual=residual[own],
            )
            slope[rows[own]] += expected @ plane / fit.background.light[rows[own], None]
    return slope


def _correlation(fit: ShadowFit, residual: np.ndarray, valid: np.ndarray) -> NDArray[np.float64]:
    """Return the correlation of the noise from standardised residuals (g, m) of windows.

    The residuals contain errors of the model. The other estimate, from the background of the
    image, contains the shadows of dense beads. The smaller one has less of either.
    """
    if valid.sum() < MIN_PIXELS:
        return fit.noise.correlation
    of_windows = correlation_of(_images(fit.offset, residual), _images(fit.offset, valid))
    return min(of_windows, fit.noise.correlation, key=np.sum)


def _images(offset: NDArray[np.int64], windows: np.ndarray) -> NDArray[np.float64]:
    """Return square images (g, w, w) of round windows (g, m); offset: (m, 2) their pixels."""
    half = int(np.abs(offset).max())
    images = np.zeros((len(windows), 2 * half + 1, 2 * half + 1))
    images[:, offset[:, 1] + half, offset[:, 0] + half] = windows
    return images


def _within(values: NDArray[np.float64], low: float, high: float) -> NDArray[np.float64]:
    """Return values between bounds: like np.clip, in a third of its time for a few values."""
    return np.minimum(np.maximum(values, low), high)


def _median(values: NDArray[np.float64]) -> float:
    """Return the median: like np.median, in a third of its time for a few values."""
    ordered = np.sort(values)
    half = len(ordered) // 2
    return float(ordered[half] if len(ordered) % 2 else ordered[half - 1 : half + 1].mean())


def _inflation(influence: NDArray[np.float64], correlation: NDArray[np.float64]) -> float:
    """Return the factor on variances for correlated noise; influence: (g, w, w) of pixels."""
    # Use one tall image: filtering reaches into the rows of zeros between the windows.
    tall = np.pad(influence, ((0, 0), (0, len(correlation) // 2), (0, 0)))
    tall = tall.reshape(-1, influence.shape[2])
    spread = cv2.filter2D(tall, cv2.CV_64F, correlation, borderType=cv2.BORDER_CONSTANT)
    independent = float(np.sum(tall * tall))
    return max(float(np.sum(tall * spread)) / max(independent, 1e-300), 1.0)


def _sd_of_centre(covariance: np.ndarray) -> NDArray[np.float64]:
    """Return standard deviations (g,) of a coordinate of centres from covariances (g, u, u).

    They are infinite where rounding errors leave no variance.
    """
    variance = 0.5 * (covariance[:, TERMS, TERMS] + covariance[:, TERMS + 1, TERMS + 1])
    return np.sqrt(np.where(variance > 0, variance, np.inf))
