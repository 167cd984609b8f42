# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Measure centres of beads of a phantom by fitting blurred shadows of spheres to the grey values.

Hundreds of beads of different sizes are fitted at once, in single precision. Light that passes
through two beads is attenuated by both.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .background import TERMS
from .fine_grid import Absorbers, FineGrid
from .light import Light, Noise, less_common
from .profile import Absorbed, Profile, Shadows
from .shadow_fit import (
    DEPTH_SD,
    DISTURBED,
    MARGIN_PX,
    MIN_INSIDE,
    MIN_PASSED,
    UNDISTURBED,
    Beads,
    FitSettings,
    NormalEquations,
    ShadowFit,
)
from .texture import DTYPE

FIRST_STEPS = 3  # steps that only have to separate beads from other objects
SETTINGS = FitSettings(
    steps=5,
    crossing_steps=(2, 3),
    spread_step=FIRST_STEPS,  # before, the lack of fit is that of the initial values
    crowds=((1, 2), (3, 6)),
    max_step_px=0.6,
    pooled=60.0,
    crossed=1.0,
)
STEPS = SETTINGS.steps
# Further steps if clipped pixels hide light, whose spread is estimated before each step. In 20
# over-exposed renderings with bone or plates, ten gave the same normalised errors to 6 %.
HIDDEN_STEPS = 5
# Largest step of a coordinate of a bead that has converged: the next step is about ten times
# shorter, and the centres of the sharpest beads are known to 0.01 px.
SETTLED_PX = 0.003
MAX_SHIFT_PX = 4.0  # shift of a centre beyond which the fit has lost its bead
# Relative standard deviation of a shadow's radius, from profile and distortion. That of a profile
# of 100 beads is 0.007: in eight images, profiles of two sets of 50 beads differed by 0.014.
RADIUS_SD = 0.01
# The same if nearly all of the surrounding light is clipped. Only the dark inside of a shadow is
# visible then, which hardly separates radius, attenuation and scattered light. In 12 images of a
# cube at 1.65 times the light at which a pixel saturates, estimated radii were 13 to 25 % too
# small.
CLIPPED_RADIUS_SD = 0.17
SEEN_LIGHT = 0.05  # share of unclipped light below which the light counts as clipped


def rounded(size: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    """Return relative sizes (n,) rounded to powers of a step, so that few values differ."""
    return np.asarray(step ** np.rint(np.log(size) / np.log(step)))


def circles(radius: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return matrices (n, 2, 2) of circles of relative radii (n,)."""
    return radius[:, None, None] * np.eye(2)


def measure_beads(
    light: Light,
    uv: NDArray[np.float64],
    shape: NDArray[np.float64],
    profile: Profile,
    noise: Noise,
    steps: int = STEPS,
    size: NDArray[np.float64] | None = None,
) -> Beads:
    """Measure all beads near pixels uv (n, 2) at once by a number of Gauss-Newton steps.

    shape: (n, 2, 2) matrices from the circle of a typical bead to the borders of shadows. size:
    (n,) relative sizes of the beads, 1 for a typical bead. They exclude the effects that make
    shadows of equal beads differ. None for equal beads.
    """
    fit = BeadFit(light, uv, shape, profile=profile, noise=noise, size=size)
    fit.run(steps)
    return fit.result()


class BeadFit(ShadowFit):
    """Fit of beads of a phantom whose radii differ."""

    def __init__(
        self,
        light: Light,
        uv: NDArray[np.float64],
        shape: NDArray[np.float64],
        profile: Profile,
        noise: Noise,
        size: NDArray[np.float64] | None = None,
        reach_px: float = 0.0,
    ) -> None:
        self.stretch = np.sqrt(np.abs(np.linalg.det(shape)))
        # Distances in a metric are those from the centre of the shadow of a typical bead.
        inverse = np.linalg.inv(shape)
        self.metric = np.swapaxes(inverse, 1, 2) @ inverse
        self.size = np.ones(len(uv)) if size is None else size
        # Sizes share a table if they differ by less than the uncertainty of a radius.
        sizes, self.kind = np.unique(rounded(self.size, 1 + RADIUS_SD), return_inverse=True)
        self.shadows = Shadows([profile.sized(size) for size in sizes.tolist()])
        own_reach = np.maximum(profile.reach_px * self.size, reach_px) * self.stretch
        reach = float(own_reach.max(initial=profile.reach_px))
        window = reach + MARGIN_PX
        super().__init__(
            SETTINGS, profile, noise=noise, uv=uv, depth=np.ones(len(uv)), window_px=window
        )
        self.radius = self.stretch * self.size
        self.disturbed = np.zeros(len(uv), dtype=bool)
        self.settled = np.zeros(len(uv), dtype=bool)
        self.moved = np.zeros(len(uv))  # RMS shift of u and v by relative errors 1 of radii [px]
        self.residual = np.zeros((len(uv), len(self.offset)), dtype=np.float32)  # at the last step
        self.counted = np.zeros(self.residual.shape, dtype=bool)
        self._set_groups(self._near(window + reach))
        self._read(light, own_reach + MARGIN_PX)

    def _near(self, together: float) -> NDArray[np.int64]:
        """Return neighbours (n, k) of the beads, -1 for none; note distances of the nearest."""
        n = len(self.uv)
        count = min(self.settings.neighbours + 1, n)
        if count < 2:
            return np.zeros((n, 0), dtype=int)
        distance, near = cKDTree(self.uv).query(self.uv, k=count, distance_upper_bound=together)
        other = near != np.arange(n)[:, None]
        # A bead that coincides with another is not always its own nearest neighbour.
        order = np.argsort(~other | ~np.isfinite(distance), axis=1, kind='stable')
        near = np.take_along_axis(np.where(other & np.isfinite(distance), near, -1), order, axis=1)
        self.distance = np.where(other, distance, np.inf).min(axis=1)
        return near[:, : count - 1]

    def _read(self, light: Light, window_px: NDArray[np.float64]) -> None:
        """Read the windows (n, m) around the beads, each with its own radius (n,)."""
        height, width = light.grey.shape
        column, row = self.middle.T[..., None] + self.offset.T[:, None]
        own = (self.offset * self.offset).sum(axis=1) <= window_px[:, None] ** 2
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        pixel = np.where(inside, row * width + column, 0)
        valid = inside & light.field.take(pixel)
        grey = light.grey.take(pixel)
        self.clipping = light.clipping
        bright = np.where(valid, grey, 0.0)
        self._set_windows(grey, valid & own, bright=bright, around=light.around(self.uv))
        self.usable = self.valid.sum(axis=1) >= MIN_INSIDE * own.sum(axis=1)
        # If part of the border is missing, a shadow that is not quite that of a sphere moves.
        from_edge = np.minimum(self.uv, (width - 1, height - 1) - self.uv).min(axis=1)
        self.usable &= from_edge >= self.profile.radius_px * self.radius

    def run(self, steps: int) -> None:
        """Take Gauss-Newton steps.

        Converged beads only take part in the last step if they have neighbours, and after changes
        to the model of their window.
        """
        active = np.ones(len(self.uv), dtype=bool)
        hides = self.hidden is not None and steps >= STEPS
        if hides:  # a background beyond the polynomial is looked for when the spread is known
            steps += HIDDEN_STEPS
        for step in range(steps):
            final = step == steps - 1
            if step in self.settings.crossing_steps:
                active |= self._cross()
            active |= self._renew_prior(step)
            groups = []
            for rows, near in self.groups:
                chosen = active[rows] | (final and near.shape[1] > 0)
                groups.append((rows[chosen], near[chosen]))
            moved = [self._step(rows, near, final) for rows, near in groups]
            for (rows, near), (uv, depth, background) in zip(groups, moved):
                lost = np.linalg.norm(uv - self.start[rows], axis=1) > MAX_SHIFT_PX
                self.usable[rows[lost]] = False
                moves = (np.abs(uv - self.uv[rows]) > SETTLED_PX).any(axis=1)
                active[rows] = moves if near.shape[1] else ~self.settled[rows]
                kept = rows[~lost]
                self.uv[kept] = uv[~lost]
                self.depth[kept] = depth[~lost]
                self.background.terms[kept] = background[~lost]
            if step == (steps - FIRST_STEPS if hides else steps // 2):
                self.disturbed = self.misfit > DISTURBED * self.typical()
                if steps >= STEPS:
                    self._add_texture()
                active |= self.disturbed | (self.texture.strength > 0)

    def _cross(self) -> NDArray[np.bool_]:
        """Compute how shadows that touch differ from the product of both shadows.

        The two nearest neighbours are taken into account. Return the beads (n,) that are affected.
        """
        crossed = np.zeros(len(self.uv), dtype=bool)
        if self.crossing is None:
            self.crossing = np.zeros((len(self.uv), len(self.offset)), dtype=np.float32)
        for rows, near in self.groups:
            touching = self._touching(rows, near[:, :2])
            if touching.any():
                chosen = rows[touching]
                members = np.concatenate([chosen[:, None], near[touching, :2]], axis=1)
                self.crossing[chosen] = _crossing(self, chosen, members)
                crossed[chosen] = True
        return crossed

    def _touching(self, rows: NDArray[np.int64], near: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return (g,) whether shadows of beads touch those of neighbours (g, k), -1 for none."""
        apart = np.linalg.norm(self.uv[rows, None] - self.uv[near], axis=2)
        radii = self.profile.radius_px * (self.radius[rows, None] + self.radius[near])
        reach = radii + 2 * self.profile.blur_px
        return np.asarray(((near >= 0) & (apart < reach)).any(axis=1))

    def _squared(
        self, beads: NDArray[np.int64], x: NDArray[np.floating], y: NDArray[np.floating]
    ) -> NDArray[np.floating]:
        """Return squared distances of pixels (g, ...) from beads (g,) in their metrics [px^2]."""
        metric = self.metric[beads].reshape(-1, 4, *[1] * (np.ndim(x) - 1))
        return metric[:, 0] * x * x + 2 * metric[:, 1] * x * y + metric[:, 3] * y * y

    def _model(
        self, rows: NDArray[np.int64], near: NDArray[np.int64]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return light (g, m) and its derivatives (g, OWN + 3 k, m) in single precision."""
        everyone = np.concatenate([rows[:, None], near], axis=1)
        there = everyone >= 0
        centre = (self.middle[rows, None] - self.uv[everyone]).astype(np.float32)
        x = centre[..., :1] + self.offset[:, 0].astype(np.float32)
        y = centre[..., 1:] + self.offset[:, 1].astype(np.float32)
        metric = self.metric[everyone].astype(np.float32)
        by_x = metric[..., 0, :1] * x + metric[..., 0, 1:] * y
        by_y = metric[..., 1, :1] * x + metric[..., 1, 1:] * y
        distance = np.sqrt(x * by_x + y * by_y)
        shadow, slope = self.shadows.shadow(distance, self.kind[everyone])
        shadow *= there[..., None]
        slope *= there[..., None] / np.maximum(distance, 1e-6)
        depth = self.depth[everyone].astype(np.float32)[..., None]
        passed = 1 - depth * shadow
        # An unsharp mask may leave less than no light. A product is divided by each share.
        magnitude = np.abs(passed) if self.profile.sharpening else passed
        passed[magnitude < MIN_PASSED] = MIN_PASSED
        product = np.prod(passed, axis=1)
        direct = self.background.direct(rows)
        behind = direct * (product + self._crossing_in(rows))
        by_shadow = (-direct * product)[:, None] / passed
        by_distance = -by_shadow * depth * slope
        jacobian = self._jacobian(rows, behind, everyone.shape[1])
        np.multiply(by_distance, by_x, out=jacobian[:, TERMS::3])
        np.multiply(by_distance, by_y, out=jacobian[:, TERMS + 1 :: 3])
        np.multiply(by_shadow, shadow, out=jacobian[:, TERMS + 2 :: 3])
        return self.background.scattered(rows) + behind, jacobian

    def _disturbed(
        self, rows: NDArray[np.int64], near: NDArray[np.int64], final: bool
    ) -> NDArray[np.bool_]:
        return self.disturbed[rows]

    def _depth_sd(self, rows: NDArray[np.int64], near: NDArray[np.int64]) -> float:
        return DEPTH_SD

    def _solve(
        self,
        rows: NDArray[np.int64],
        near: NDArray[np.int64],
        equations: NormalEquations,
        final: bool,
    ) -> np.ndarray:
        step = np.linalg.solve(equations.matrix, equations.right[..., None])[..., 0]
        # The step reduces the squared residuals by its product with the right side.
        self.settled[rows] = (np.abs(step[:, TERMS : TERMS + 2]) <= SETTLED_PX).all(axis=1)
        self.settled[rows] &= (step * equations.right).sum(axis=1) <= self.misfit[rows]
        part = np.flatnonzero(final | (self.settled[rows] & (near.shape[1] == 0)))
        self._note_precision(rows, equations, part)
        self.residual[rows[part]] = equations.residual[part]
        self.counted[rows[part]] = equations.valid[part]
        if final:
            touching = np.flatnonzero(self._touching(rows, near))
            if len(touching):
                self._note_shifts(rows[touching], near[touching], equations, touching)
        return step

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Whether beads (n,) are usable and have a standard deviation."""
        return self.usable & np.isfinite(self.sigma)

    def _note_shifts(
        self,
        rows: NDArray[np.int64],
        near: NDArray[np.int64],
        equations: NormalEquations,
        part: NDArray[np.int64],
    ) -> None:
        """Note how far centres (g,) move per relative error 1 of the radii, given their equations.

        If other shadows hide part of its edge, a shadow moves with its own radius and with theirs.
        """
        _, jacobian = self._model(rows, near)
        beads = np.concatenate([rows[:, None], near], axis=1)
        centre = self.uv[beads] - self.middle[rows, None]
        x, y = np.moveaxis(self.offset - centre[:, :, None], 3, 0)
        growth = jacobian[:, TERMS::3] * x + jacobian[:, TERMS + 1 :: 3] * y
        right = equations.weighted[part] @ np.swapaxes(growth, 1, 2)
        moved = np.linalg.solve(equations.plain[part], right)[:, TERMS : TERMS + 2]
        self.moved[rows] = np.sqrt(0.5 * (moved**2).sum(axis=(1, 2)))

    def absorbed(self) -> Absorbed:
        """Return the light absorbed by beads, in the pixels of beads with a good fit."""
        every = np.arange(len(self.uv))
        plane = self.background.direct(every) + self.background.scattered(every)
        x, y = np.moveaxis(self.middle[:, None] + self.offset - self.uv[:, None], 2, 0)
        distance = np.sqrt(self._squared(every, x, y))
        light = np.empty_like(self.grey)
        for rows, near in self.groups:
            light[rows] = self._model(rows, near)[0]
        # Clipped pixels near the bound count as well: without them, only noise of one sign does.
        variance = self.noise.variance(light)
        residual, information = self.clipping.observed(self.grey, light, variance)
        known = self.valid & (information > 0)
        good = (
            known & (self.measured & (self.misfit < UNDISTURBED * np.median(self.misfit)))[:, None]
        )
        weight = plane**2 / np.maximum(light, 0.02 * plane) / np.maximum(np.median(plane), 1e-9)
        weight *= information
        size = np.broadcast_to(rounded(self.size, 1 + RADIUS_SD)[:, None], good.shape)
        share = 1 - (light + residual) / plane
        around = self.background.around[:, None] / plane
        return Absorbed(*(one[good] for one in (distance, share, weight, size, around)))

    def result(self) -> Beads:
        """Return the measured beads."""
        measured = self.measured & np.isfinite(self.uv).all(axis=1)
        typical = float(np.median(self.misfit[measured])) if measured.any() else 1.0
        beads = self._beads(measured, typical, self._noise())
        radius_sd = np.full(len(self.uv), RADIUS_SD)
        rows = np.flatnonzero(self.moved)
        radius_sd[rows[self._is_light_clipped(rows)]] = CLIPPED_RADIUS_SD
        return replace(beads, sigma=np.hypot(beads.sigma, radius_sd * self.moved))

    def _noise(self) -> NDArray[np.float64]:
        """Return the lack of fit (n,) beyond the residuals that usual beads have in common."""
        share = np.where(self.texture.strength > 0, 0.0, self.common_share())
        return (1 - share) * self.misfit

    def common_share(self) -> NDArray[np.float64]:
        """Return the share (n,) of the lack of fit that usual beads have in common.

        If shadows are not exactly those of spheres, residuals are alike in all windows. Such
        residuals are not noise and shift no centre relative to the others.
        """
        usual = self.measured & (self.texture.strength == 0)
        usual &= self.misfit <= DISTURBED * self.typical()
        rest = less_common(self.uv, self.radius, self.residual, self.counted, usual)
        whole = (self.residual**2 * self.counted).sum(axis=1)
        return np.maximum(1 - (rest**2).sum(axis=1) / np.maximum(whole, 1e-12), 0.0)

    def _is_light_clipped(self, rows: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return (g,) whether nearly all pixels outside the shadows of windows are clipped."""
        if not (len(rows) and np.isfinite(self.clipping.high)):
            return np.zeros(len(rows), dtype=bool)
        reach = self.profile.reach_px * self.radius.max()
        away, _ = cKDTree(self.uv).query(self.middle[rows, None] + self.offset)
        light = self.valid[rows] & (away > reach)
        seen = light & (self.grey[rows] < self.clipping.high)
        return np.asarray(seen.sum(axis=1) < SEEN_LIGHT * light.sum(axis=1))


def _crossing(
    fit: BeadFit, rows: NDArray[np.int64], members: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return differences (g, m) in windows of beads (g,) with members (g, k), -1 for none."""
    there = members >= 0
    bead = np.where(there, members, 0)
    centre = fit.uv[bead] - fit.middle[rows, None]
    depth = fit.depth[bead] * there

    def absorbed(
        column: int, x: NDArray[np.float32], y: NDArray[np.float32]
    ) -> NDArray[np.floating]:
        size = fit.size[bead[:, column], None, None]
        squared = fit._squared(bead[:, column], x, y) / size**2
        return fit.profile.absorbed(squared.astype(DTYPE), size.astype(DTYPE))

    beads = Absorbers(centre[None], np.ones(1), depth, _extent_px(fit, bead), absorbed)
    blurred = np.ones((len(rows), len(fit.offset)))
    for column in range(bead.shape[1]):
        one = bead[:, column]
        x, y = np.moveaxis(fit.offset - centre[:, column, None], 2, 0)
        away = np.sqrt(fit._squared(one, x, y))
        blurred *= 1 - depth[:, column, None] * fit.shadows.shadow(away, fit.kind[one])[0]
    return FineGrid(fit.offset, fit.profile).light_behind(beads) - blurred


def _extent_px(fit: BeadFit, beads: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return distances (...) from the centres beyond which beads (...) absorb no light [px]."""
    widest = np.linalg.inv(fit.metric[beads])[..., [0, 1], [0, 1]].max(axis=-1)
    return np.asarray(fit.profile.radius_px * fit.size[beads] * np.sqrt(widest))


def scatter_equation(fit: BeadFit, count: int) -> tuple[float, float]:
    """Return right-hand side and information of the share of scattered light.

    They come from those of the first windows in which shadows touch; other parameters of the
    windows are eliminated. The attenuation changes with the share such that isolated shadows
    stay the same.
    """
    equation = np.zeros(2)
    for rows, near in fit.groups:
        usable = (rows < count) & fit.usable[rows] & ~fit.disturbed[rows]
        chosen = np.flatnonzero(usable & fit._touching(rows, near))
        rows, near = rows[chosen], near[chosen]
        light, jacobian = fit._model(rows, near)
        by_scatter = _by_scatter(fit, rows, near, light, jacobian)
        residual, weight, _ = fit._observed(rows, light)
        both = np.concatenate([jacobian, by_scatter[:, None].astype(DTYPE)], axis=1)
        weighted = both * weight[:, None]
        normal = (weighted @ np.swapaxes(both, 1, 2)).astype(float)
        diagonal = np.arange(jacobian.shape[1])
        normal[:, diagonal, diagonal] += fit._prior(rows, near) + 1e-12
        columns = np.concatenate([weighted @ residual[..., None], normal[:, :, -1:]], axis=2)
        eliminated = np.linalg.solve(normal[:, :-1, :-1], columns[:, :-1])
        equation += (columns[:, -1:] - normal[:, -1:, :-1] @ eliminated).sum(axis=(0, 1))
    # Both windows of a pair contain the overlap.
    right, information = 0.5 * equation / fit.typical()
    return float(right), float(information)


def _by_scatter(
    fit: BeadFit,
    rows: NDArray[np.int64],
    near: NDArray[np.int64],
    light: NDArray[np.float32],
    jacobian: NDArray[np.float32],
) -> NDArray[np.floating]:
    """Return derivatives (g, m) of light by the share s of scattered light.

    Let the light without beads and the light behind one bead stay the same. If beads absorb shares
    x of the direct light, the derivative, over the light of the surroundings, is
    1 - prod(1 - x) (1 + sum(x / (1 - x))): for one bead it is 0, for two beads the product of
    both x.
    """
    depth = fit.depth[np.concatenate([rows[:, None], near], axis=1)][..., None]
    direct = fit.background.direct(rows)
    passed = (light - fit.background.scattered(rows)) / direct
    by_depth = (depth * jacobian[:, TERMS + 2 :: 3]).sum(axis=1) / direct
    return fit.background.around[rows, None] * (1 + 2 * fit._crossing_in(rows) - passed + by_depth)
