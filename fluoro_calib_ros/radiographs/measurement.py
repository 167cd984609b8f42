# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Measure centres of beads: blurred shadows of spheres fitted to the grey values.

A window around a bead has a polynomial of degree 2 as its background. Neighbours that reach into
it are fitted with it, so the standard deviation of a centre contains what the overlap leaves open.
Light that passes two beads is attenuated by both.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import nnls
from scipy.spatial import cKDTree

from .profile import Profile, fit_profile

NEIGHBOURS = 6  # fitted with a bead, at most
WINDOW_MARGIN_PX = 2.0  # of background around the shadow
STEPS = 5
FIRST_STEPS = 4  # that only have to tell beads from other things
PROFILE_STEPS = 3
CROSSING_STEPS = (2, 3)  # before which shadows that touch are blurred together
CROSSED = 1.35  # factor on the standard deviation where shadows cross
FINE = 3  # points across a pixel of their grid
MAX_STEP_PX = 0.6
NEIGHBOUR_SD_PX = 0.3  # of a neighbour's place, which its own fit finds
NEIGHBOUR_SD = 0.2  # of a neighbour's depth
DEPTH_SD = 1.0  # of the depth of a shadow, 1 for the profile
DEPTHS = (0.05, 3.0)
MIN_PASSED = 0.02
NOISE_BLOCK = 16  # [px]
PROFILE_BEADS = 150
PROFILE_ROUNDS = 3
START_BLUR_PX = 0.9
START_ATTENUATION = 1.5
START_SCATTER = 0.1
MIN_PIXELS = 0.6  # of a window that lie in the image
POOLED = 60.0  # degrees of freedom of the noise of all beads, in that of one
MIN_VARIANCE = 1 / 12  # of rounding
MAX_SHIFT_PX = 4.0  # of a centre, beyond which the fit has lost its bead
MIN_CORRELATION = 0.08  # that is told from slow changes of the light
LAGS = 4  # pixels over which noise is correlated
HELD = 1e12  # weight of a term that stays zero
TERMS = 6  # of the background: a polynomial of degree 2
PARAMETERS = TERMS + 3  # of a bead alone, its centre and depth
# Misfit from which pixels with large residuals count less, and the residual of half the weight.
DISTURBED = 1.6
ROBUST = 2.5


@dataclass(frozen=True)
class Noise:
    """Variance of a grey value: constant + gain * grey value; and its correlation.

    Attributes
    ----------
    constant, gain : float
    correlation : (2 LAGS + 1, 2 LAGS + 1) ndarray
        Of the noise of pixels at lags (row, column), 1 in the middle.
    """

    constant: float
    gain: float
    correlation: np.ndarray

    def variance(self, light: np.ndarray) -> np.ndarray:
        """Variance of grey values of an expected light."""
        return np.maximum(self.constant + self.gain * np.maximum(light, 0), MIN_VARIANCE)


@dataclass(frozen=True)
class Beads:
    """Measured beads, in the order in which they were given.

    Attributes
    ----------
    uv : (n, 2) ndarray
        Centres [px].
    sigma : (n,) ndarray
        Standard deviation of a coordinate [px].
    depth : (n,) ndarray
        Of the shadow, 1 for the profile.
    misfit : (n,) ndarray
        Mean squared residual over the noise, 1 where the model is right.
    overlapped : (n,) ndarray of bool
        The shadow of another bead reaches into that of the bead.
    measured : (n,) ndarray of bool
        False where the window is cut off or the fit failed.
    """

    uv: np.ndarray
    sigma: np.ndarray
    depth: np.ndarray
    misfit: np.ndarray
    overlapped: np.ndarray
    measured: np.ndarray


def estimate_noise(light: np.ndarray, field: np.ndarray) -> Noise:
    """Estimate the noise of an image (h, w) from what a plane does not explain.

    The second differences of Immerkaer, "Fast noise variance estimation", CVIU 64, 1996, by
    blocks, robustly, against the mean grey value.
    """
    kernel = np.outer([1, -2, 1], [1, -2, 1]) / 6.0
    high = cv2.filter2D(light, cv2.CV_32F, kernel)
    height, width = (size // NOISE_BLOCK * NOISE_BLOCK for size in light.shape)

    def blocks(values: np.ndarray) -> np.ndarray:
        cut = values[:height, :width].reshape(
            height // NOISE_BLOCK, NOISE_BLOCK, width // NOISE_BLOCK, NOISE_BLOCK
        )
        return cut.swapaxes(1, 2).reshape(-1, NOISE_BLOCK**2)

    used = np.asarray(blocks(field).all(axis=1))
    if not used.any():
        used = np.ones(len(used), dtype=bool)
    mean = np.median(blocks(light)[used], axis=1)
    variance = (1.4826 * np.median(np.abs(blocks(high)[used]), axis=1)) ** 2
    variance = np.maximum(variance, MIN_VARIANCE)
    weight = 1 / variance
    gain = constant = 0.0
    for _ in range(3):
        rows = np.column_stack([np.ones_like(mean), mean]) * weight[:, None]
        (constant, gain), _ = nnls(rows, variance * weight)
        weight = 1 / np.maximum(constant + gain * mean, MIN_VARIANCE)
    return Noise(max(constant, MIN_VARIANCE), gain, _correlation(light, field))


def _correlation(light: np.ndarray, field: np.ndarray) -> np.ndarray:
    """Correlation of the noise, from the background less its blur, clipped at beads."""
    height, width = light.shape
    middle = np.s_[height // 4 : height - height // 4, width // 4 : width - width // 4]
    light = light[middle]
    field = field[middle]
    rest = light - cv2.GaussianBlur(light, (0, 0), 3 * LAGS)
    limit = 3 * 1.4826 * float(np.median(np.abs(rest[field]))) if field.any() else np.inf
    valid = (field & (np.abs(rest) < limit)).astype(np.float32)
    valid = cv2.erode(valid, np.ones((3, 3), np.uint8))
    rest = rest * valid
    out = np.zeros((2 * LAGS + 1, 2 * LAGS + 1))
    total = float(np.sum(rest * rest)) / max(float(valid.sum()), 1.0)
    height, width = rest.shape
    for row in range(LAGS + 1):
        for column in range(-LAGS, LAGS + 1):
            a = np.s_[: height - row, max(0, -column) : width - max(0, column)]
            b = np.s_[row:, max(0, column) : width + min(0, column)]
            pairs = max(float(np.sum(valid[a] * valid[b])), 1.0)
            value = float(np.sum(rest[a] * rest[b])) / pairs / max(total, 1e-12)
            out[LAGS + row, LAGS + column] = out[LAGS - row, LAGS - column] = value
    # What is left of slow changes of the light is no noise.
    edge = float(np.median(np.concatenate([out[0], out[-1], out[:, 0], out[:, -1]])))
    out = np.maximum(out - edge, 0) / max(1 - edge, 1e-6)
    out[out < MIN_CORRELATION] = 0
    out[LAGS, LAGS] = 1
    return out


def estimate_profile(
    light: np.ndarray,
    field: np.ndarray,
    uv: np.ndarray,
    relative_radius: np.ndarray,
    radius_px: float,
) -> Profile:
    """Estimate the shadow of a typical bead from those that stand alone.

    Parameters
    ----------
    light : (h, w) ndarray
        Grey values, beads dark.
    field : (h, w) ndarray of bool
    uv : (n, 2) ndarray
        Beads [px].
    relative_radius : (n,) ndarray
        1 for a typical bead.
    radius_px : float
        First value of its radius.
    """
    profile = Profile(radius_px * 0.95, START_BLUR_PX, START_ATTENUATION, START_SCATTER)
    noise = Noise(0.0, 1.0, np.ones((1, 1)))
    distance = cKDTree(uv).query(uv, k=[2])[0][:, 0] if len(uv) > 1 else np.full(1, np.inf)
    alone = np.argsort(-distance, kind='stable')[:PROFILE_BEADS]
    for _ in range(PROFILE_ROUNDS):
        fit = _Fit(light, field, uv[alone], relative_radius[alone], profile, noise)
        fit.plane_only = True
        fit.run(PROFILE_STEPS)
        place, absorbed, weight = fit.shadows()
        profile = fit_profile(place, absorbed, weight, profile)
    return profile


def measure_beads(
    light: np.ndarray,
    field: np.ndarray,
    uv: np.ndarray,
    relative_radius: np.ndarray,
    profile: Profile,
    noise: Noise,
    steps: int = STEPS,
) -> Beads:
    """Measure all beads near pixels uv (n, 2) at once, in so many Gauss-Newton steps.

    The other arguments are those of `estimate_profile` and what was estimated.
    """
    fit = _Fit(light, field, uv, relative_radius, profile, noise)
    fit.run(steps)
    return fit.result()


class _Fit:
    """Gauss-Newton fit of all windows at once, each with the neighbours of its bead."""

    def __init__(
        self,
        light: np.ndarray,
        field: np.ndarray,
        uv: np.ndarray,
        relative_radius: np.ndarray,
        profile: Profile,
        noise: Noise,
    ) -> None:
        self.profile = profile
        self.noise = noise
        self.uv = np.array(uv, dtype=float)
        self.start = self.uv.copy()
        self.depth = np.ones(len(uv))
        self.radius = np.asarray(relative_radius, dtype=float)
        self.sigma = np.full(len(uv), np.inf)
        self.misfit = np.full(len(uv), np.inf)
        self.measured = np.zeros(len(uv), dtype=bool)
        self.disturbed = np.zeros(len(uv), dtype=bool)
        self.inflation: float | None = None
        self.plane_only = False
        self.crossing: np.ndarray | None = None
        self.overlapped = np.zeros(len(uv), dtype=bool)
        largest = float(self.radius.max(initial=1.0))
        reach = profile.reach_px * largest
        window = reach + WINDOW_MARGIN_PX
        half = int(np.ceil(window))
        axis = np.arange(-half, half + 1)
        grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
        self.offset = grid[np.hypot(*grid.T) <= window]
        x, y = (self.offset / window).T.astype(np.float32)
        self.basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
        self.groups = self._groups(window + reach, 2 * profile.reach_px * 0.85)
        self._read(light, field)

    def _groups(self, together: float, overlap: float) -> list[tuple[np.ndarray, np.ndarray]]:
        """Rows of beads and of their neighbours, -1 for none: those alone, and the others."""
        n = len(self.uv)
        count = min(NEIGHBOURS + 1, n)
        if count < 2:
            self.distance = np.full(n, np.inf)
            return [(np.arange(n), np.zeros((n, 0), dtype=int))]
        distance, near = cKDTree(self.uv).query(self.uv, k=count, distance_upper_bound=together)
        other = near != np.arange(n)[:, None]
        # A bead at the very place of another is not always its own nearest.
        order = np.argsort(~other | ~np.isfinite(distance), axis=1, kind='stable')
        near = np.take_along_axis(np.where(other & np.isfinite(distance), near, -1), order, axis=1)
        near = near[:, : count - 1]
        distance = np.where(other, distance, np.inf)
        self.distance = distance.min(axis=1)
        self.overlapped = self.distance < overlap
        crowd = (near >= 0).sum(axis=1)
        groups = []
        for low, high in ((0, 0), (1, 2), (3, NEIGHBOURS)):
            rows = np.flatnonzero((crowd >= low) & (crowd <= high))
            if len(rows):
                groups.append((rows, near[rows, :high]))
        return groups

    def _read(self, light: np.ndarray, field: np.ndarray) -> None:
        """Read the windows (n, m) around the beads."""
        height, width = light.shape
        self.middle = np.rint(self.uv).astype(int)
        places = self.middle[:, None] + self.offset
        inside = ((places >= 0) & (places < (width, height))).all(axis=2)
        column = np.clip(places[..., 0], 0, width - 1)
        row = np.clip(places[..., 1], 0, height - 1)
        self.valid = inside & field[row, column]
        self.grey = light[row, column].astype(np.float32)
        self.usable = self.valid.mean(axis=1) >= MIN_PIXELS
        self.background = np.zeros((len(self.uv), TERMS))
        ordered = np.sort(np.where(self.valid, self.grey, 0.0), axis=1)
        self.background[:, 0] = ordered[:, int(0.75 * ordered.shape[1])]

    def _background(self, rows: np.ndarray) -> np.ndarray:
        """Light (g, m) in windows without beads."""
        background = self.background[rows].astype(np.float32)
        plane = background @ self.basis.T
        return np.maximum(plane, 1e-3 * np.abs(background[:, :1]) + 1e-6)

    def run(self, steps: int) -> None:
        """Take Gauss-Newton steps; the last one gives standard deviations as well."""
        for step in range(steps):
            if step in CROSSING_STEPS:
                self._cross()
            moved = [self._step(rows, near, final=step == steps - 1) for rows, near in self.groups]
            if step == steps // 2:
                self.disturbed = self.misfit > DISTURBED * self.typical()
            for (rows, _), (uv, depth, background) in zip(self.groups, moved):
                lost = np.linalg.norm(uv - self.start[rows], axis=1) > MAX_SHIFT_PX
                self.usable[rows[lost]] = False
                kept = rows[~lost]
                self.uv[kept] = uv[~lost]
                self.depth[kept] = depth[~lost]
                self.background[kept] = background[~lost]

    def _cross(self) -> None:
        """Note what shadows that touch have together, beyond the product of both.

        The blur of the light that passes two beads is not the product of their blurred shadows.
        The difference is computed on a finer grid, of the two nearest neighbours.
        """
        if self.crossing is None:
            self.crossing = np.zeros((len(self.uv), len(self.offset)), dtype=np.float32)
        reach = 2 * (self.profile.radius_px + self.profile.blur_px)
        for rows, near in self.groups:
            if not near.shape[1]:
                continue
            first = near[:, 0]
            touching = np.linalg.norm(self.uv[rows] - self.uv[first], axis=1) < reach
            touching &= first >= 0
            if touching.any():
                chosen = rows[touching]
                members = np.concatenate([chosen[:, None], near[touching, :2]], axis=1)
                self.crossing[chosen] = self._crossing(chosen, members)

    def _crossing(self, rows: np.ndarray, members: np.ndarray) -> np.ndarray:
        """Differences (g, m) for windows of beads (g,) and shadows of members (g, k) or -1."""
        half = int(np.abs(self.offset).max()) + int(np.ceil(3 * self.profile.blur_px))
        axis = np.arange(-half * FINE, half * FINE + 1) / FINE
        raw = np.ones((len(rows), len(axis), len(axis)), dtype=np.float32)
        blurred = np.ones((len(rows), len(self.offset)))
        for column in members.T:
            there = column >= 0
            bead = np.where(there, column, 0)
            centre = self.uv[bead] - self.middle[rows]
            scale = 1 / self.radius[bead]
            depth = self.depth[bead] * there
            squared = (axis[None, :, None] - centre[:, 1, None, None]) ** 2 + (
                axis[None, None, :] - centre[:, 0, None, None]
            ) ** 2
            absorbed = self.profile.absorbed(squared * scale[:, None, None] ** 2)
            raw *= (1 - depth[:, None, None] * absorbed).astype(np.float32)
            away = np.linalg.norm(self.offset - centre[:, None], axis=2) * scale[:, None]
            blurred *= 1 - depth[:, None] * self.profile.shadow(away)[0]
        sigma = float(FINE * np.sqrt(self.profile.blur_px**2 + 1 / 12))
        place = (self.offset + half) * FINE
        out = np.empty_like(blurred)
        for number, image in enumerate(raw):
            smooth = cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
            out[number] = smooth[place[:, 1], place[:, 0]]
        return out - blurred

    def _model(self, rows: np.ndarray, near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Light (g, m) and its derivatives (g, TERMS + 3 + 3 k, m), of single precision."""
        everyone = np.concatenate([rows[:, None], near], axis=1)
        there = everyone >= 0
        scale = (1 / self.radius[everyone]).astype(np.float32)[..., None]
        centre = (self.middle[rows, None] - self.uv[everyone]).astype(np.float32)
        x = centre[..., :1] + self.offset[:, 0].astype(np.float32)
        y = centre[..., 1:] + self.offset[:, 1].astype(np.float32)
        distance = np.sqrt(x * x + y * y)
        shadow, slope = self.profile.shadow(distance * scale)
        shadow *= there[..., None]
        slope *= there[..., None] * scale / np.maximum(distance, 1e-6)
        depth = self.depth[everyone].astype(np.float32)[..., None]
        passed = np.maximum(1 - depth * shadow, np.float32(MIN_PASSED))
        product = np.prod(passed, axis=1)
        transmitted = np.float32(1 - self.profile.scatter)
        plane = self._background(rows)
        crossing = self.crossing[rows] if self.crossing is not None else np.float32(0)
        relative = np.float32(self.profile.scatter) + transmitted * (product + crossing)
        by_shadow = (-transmitted * plane * product)[:, None] / passed
        by_distance = -by_shadow * depth * slope
        g, k, m = distance.shape
        jacobian = np.empty((g, TERMS + 3 * k, m), dtype=np.float32)
        np.multiply(relative[:, None], self.basis.T, out=jacobian[:, :TERMS])
        np.multiply(by_distance, x, out=jacobian[:, TERMS::3])
        np.multiply(by_distance, y, out=jacobian[:, TERMS + 1 :: 3])
        np.multiply(by_shadow, shadow, out=jacobian[:, TERMS + 2 :: 3])
        return plane * relative, jacobian

    def _step(
        self, rows: np.ndarray, near: np.ndarray, final: bool
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return centres, depths and backgrounds of some beads after a step."""
        light, jacobian = self._model(rows, near)
        residual = self.grey[rows] - light
        weight = self.valid[rows] / self.noise.variance(light)
        squared = residual * residual * weight
        freedom = np.maximum(self.valid[rows].sum(axis=1) - PARAMETERS, 1)
        self.misfit[rows] = squared.sum(axis=1) / freedom
        if self.disturbed[rows].any():
            robust = self.disturbed[rows, None] * squared / (ROBUST**2 * self.typical())
            weight = weight / (1 + robust)
        weighted = jacobian * weight.astype(np.float32)[:, None]
        prior = self._prior(len(rows), near.shape[1])
        normal = (weighted @ np.swapaxes(jacobian, 1, 2)).astype(float)
        diagonal = np.arange(normal.shape[1])
        normal[:, diagonal, diagonal] += prior + 1e-9 * normal[:, diagonal, diagonal] + 1e-12
        right = (weighted @ residual.astype(np.float32)[..., None])[..., 0].astype(float)
        right[:, TERMS + 2] -= prior[:, TERMS + 2] * (self.depth[rows] - 1)
        step = np.linalg.solve(normal, right[..., None])[..., 0]
        move = np.clip(step[:, TERMS : TERMS + 2], -MAX_STEP_PX, MAX_STEP_PX)
        usable = self.usable[rows]
        if final:
            self._precision(rows, normal, weighted)
        return (
            self.uv[rows] + np.where(usable[:, None], move, 0),
            np.clip(self.depth[rows] + np.where(usable, step[:, TERMS + 2], 0), *DEPTHS),
            self.background[rows] + np.where(usable[:, None], step[:, :TERMS], 0),
        )

    def _prior(self, count: int, neighbours: int) -> np.ndarray:
        """Weights (count, TERMS + 3 + 3 neighbours) of what is expected of the unknowns."""
        prior = np.zeros((count, PARAMETERS + 3 * neighbours))
        prior[:, TERMS + 2] = DEPTH_SD**-2
        if self.plane_only:
            prior[:, 3:TERMS] = HELD
        for number in range(neighbours):
            first = PARAMETERS + 3 * number
            # An absent neighbour has no derivatives; any prior keeps its step zero.
            prior[:, first : first + 2] = NEIGHBOUR_SD_PX**-2
            prior[:, first + 2] = NEIGHBOUR_SD**-2
        return prior

    def typical(self) -> float:
        """Median misfit of the beads whose fit goes on."""
        values = self.misfit[self.usable & np.isfinite(self.misfit)]
        return float(np.median(values)) if len(values) else 1.0

    def _precision(self, rows: np.ndarray, normal: np.ndarray, weighted: np.ndarray) -> None:
        """Note standard deviations of centres."""
        covariance = np.linalg.inv(normal)[:, TERMS : TERMS + 2, TERMS : TERMS + 2]
        variance = 0.5 * np.trace(covariance, axis1=1, axis2=2)
        self.sigma[rows] = np.sqrt(np.maximum(variance, 0))
        self.measured[rows] = self.usable[rows] & np.isfinite(variance)
        if len(weighted) and self.inflation is None:
            # The influence of each pixel on a centre: noise of neighbouring pixels adds up.
            influence = np.linalg.solve(normal[:20], weighted[:20])[:, TERMS]
            self.inflation = _inflation(influence, self.offset, self.noise)

    def shadows(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Distances [px] of pixels from beads, absorbed shares there, and weights (n,)."""
        plane = self._background(np.arange(len(self.uv)))
        away = self.middle[:, None] + self.offset - self.uv[:, None]
        distance = np.hypot(away[..., 0], away[..., 1]) / self.radius[:, None]
        good = self.valid & (self.measured & (self.misfit < 4 * np.median(self.misfit)))[:, None]
        weight = plane / np.maximum(np.median(plane), 1e-9)
        return distance[good], (1 - self.grey / plane)[good], weight[good]

    def result(self) -> Beads:
        """Return what was measured."""
        measured = self.measured & np.isfinite(self.uv).all(axis=1)
        typical = float(np.median(self.misfit[measured])) if measured.any() else 1.0
        pixels = self.valid.sum(axis=1)
        # The noise of one window is known to some 10 %; that of all windows helps.
        pooled = (self.misfit * pixels + typical * POOLED) / (pixels + POOLED)
        factor = np.sqrt(np.maximum(pooled, typical) * (self.inflation or 1.0))
        # Where shadows cross, their model is less right than its noise says.
        factor = np.where(self.distance < 2 * self.profile.radius_px, CROSSED * factor, factor)
        return Beads(
            self.uv.copy(),
            self.sigma * factor,
            self.depth.copy(),
            self.misfit / max(typical, 1e-12),
            self.overlapped,
            measured,
        )


def _inflation(influence: np.ndarray, offset: np.ndarray, noise: Noise) -> float:
    """Factor on the variance of a centre for correlated noise.

    influence (g, m) of the pixels of windows with offsets (m, 2).
    """
    half = int(np.abs(offset).max())
    image = np.zeros((len(influence), 2 * half + 1, 2 * half + 1))
    image[:, offset[:, 1] + half, offset[:, 0] + half] = influence
    lags = len(noise.correlation) // 2
    total = 0.0
    for row in range(-lags, lags + 1):
        for column in range(-lags, lags + 1):
            value = noise.correlation[row + lags, column + lags]
            if value:
                shifted = np.roll(image, (row, column), axis=(1, 2))
                total += value * float(np.sum(image * shifted))
    return max(total / max(float(np.sum(image * image)), 1e-300), 1.0)
