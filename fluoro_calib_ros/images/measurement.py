# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Measure centres of beads of a phantom by fitting blurred shadows of spheres to the grey values.

Hundreds of beads of different sizes are fitted at once, in single precision. Light that passes
through two beads is attenuated by both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .background import PLANE_TERMS, TERMS
from .detection import LARGER
from .light import Light, Noise, less_common, vertex
from .profile import LIMITS, MASKED, PLAIN, SHAPE, Absorbed, Profile, Shadows, fit_profile
from .shadow_fit import (
    DEPTH_SD,
    DISTURBED,
    MARGIN_PX,
    MIN_INSIDE,
    MIN_PASSED,
    UNDISTURBED,
    Beads,
    FineGrid,
    FitSettings,
    NormalEquations,
    ShadowFit,
)
from .texture import DTYPE

SETTINGS = FitSettings(
    steps=5,
    crossing_steps=(2, 3),
    crowds=((1, 2), (3, 6)),
    max_step_px=0.6,
    pooled=60.0,
    crossed=1.0,
)
STEPS = SETTINGS.steps
FIRST_STEPS = 3  # steps that only have to separate beads from other objects
PROFILE_STEPS = 3
PROFILE_BEADS = 100  # largest number of beads for the profile
# Rounds without a better fit, after which the best profile is chosen in windows of equal size: a
# hard edge with a wide blur looks like a sphere. If the radius grows by a half, fits get worse
# before they get better.
PATIENCE = 4
PROFILE_ROUNDS = 30  # largest number of rounds; 4 to 10 were needed
MOST = 2.0  # largest factor between the radius of a bead and that of its detection
START_BLUR_PX = 0.9
START_ATTENUATION = 1.5
START_SCATTER = 0.1
START_SHARPENING = 1.0
START_MASK_PX = 3.0
# Common share of the lack of fit from which an unsharp mask is searched for. It was .13 to .30 in
# images with a mask of factor 1.5 and 3 px, and at most .06 in others, but .12 in clipped light.
COMMON = 0.1
# Largest step of a coordinate of a bead that has converged: the next step is about ten times
# shorter, and the centres of the sharpest beads are known to 0.01 px.
SETTLED_PX = 0.003
MAX_SHIFT_PX = 4.0  # shift of a centre beyond which the fit has lost its bead
RADIUS_SD = 0.01  # relative standard deviation of a shadow's radius, from profile and distortion
# The same if nearly all of the surrounding light is clipped. Only the dark inside of a shadow is
# visible then, which hardly separates radius, attenuation and scattered light. In 12 images of a
# cube at 1.65 times the light at which a pixel saturates, estimated radii were 13 to 25 % too
# small.
CLIPPED_RADIUS_SD = 0.17
SEEN_LIGHT = 0.05  # share of unclipped light below which the light counts as clipped
SETTLED = 0.1 * RADIUS_SD  # relative change of the radius at which a profile has converged
HELD = 1e12  # prior weight that keeps a term at zero


def circles(radius: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return matrices (n, 2, 2) of circles of relative radii (n,)."""
    return radius[:, None, None] * np.eye(2)


def estimate_profile(
    light: Light,
    uv: NDArray[np.float64],
    shape: NDArray[np.float64],
    radius_px: float,
    size: NDArray[np.float64] | None = None,
    start: Profile | None = None,
    estimated: Sequence[str] = PLAIN,
) -> Profile:
    """Estimate the shadow of a typical bead from isolated beads.

    radius_px: initial value of its radius. start: initial profile. estimated: parameters that are
    estimated; if the scattered light is not, a start that fits better stays. The other arguments
    are those of `measure_beads`.
    """
    is_known = start is not None and 'scatter' not in estimated
    distance = cKDTree(uv).query(uv, k=[2])[0][:, 0] if len(uv) > 1 else np.full(1, np.inf)
    alone = np.argsort(-distance, kind='stable')[:PROFILE_BEADS]
    place = uv[alone]
    shapes = shape[alone], None if size is None else size[alone]
    start = start or Profile(radius_px * 0.95, START_BLUR_PX, START_ATTENUATION, START_SCATTER)
    profiles = [start]
    lacks: list[float] = []
    while len(lacks) < PROFILE_ROUNDS and len(lacks) - int(np.argmin(lacks or [0])) <= PATIENCE:
        before = profiles[-1]
        fit = _profile_fit(light, place, shapes, before)
        place = fit.uv
        lacks.append(fit.typical())
        profile = fit_profile(fit.absorbed(), before, estimated)
        if not radius_px / MOST < profile.radius_px < radius_px * MOST:
            break
        profiles.append(profile)
        if _settled(profile, before, estimated):
            if not is_known:
                return profile
            break
    reach_px = max(profile.reach_px for profile in profiles)
    # Skip the initial guess: it fits shadows as small as their blur about as well.
    estimates = [start, profiles[-1]] if is_known else profiles[1:] or profiles
    fits = [_profile_fit(light, uv[alone], shapes, profile, reach_px) for profile in estimates]
    return min(fits, key=ShadowFit.typical).profile


def _settled(profile: Profile, before: Profile, estimated: Sequence[str]) -> bool:
    """Return whether the estimated parameters of a profile changed less than the tolerances.

    Attenuation and scattered light need not settle together: shadows hardly separate them.
    """
    names = SHAPE[:2] if 'scatter' in estimated else estimated
    change = {name: abs(getattr(profile, name) / getattr(before, name) - 1) for name in names}
    return change['radius_px'] < SETTLED and max(change.values()) < RADIUS_SD


def _profile_fit(
    light: Light,
    uv: NDArray[np.float64],
    shapes: tuple[NDArray[np.float64], NDArray[np.float64] | None],
    profile: Profile,
    reach_px: float = 0.0,
) -> _BeadFit:
    """Fit shadows with a fixed profile, in windows that reach at least as far as reach_px.

    shapes: shapes and sizes of the beads, as in `measure_beads`.
    """
    noise = Noise(0.0, 1.0, np.ones((1, 1)))
    shape, size = shapes
    fit = _BeadFit(light, uv, shape, profile=profile, noise=noise, size=size, reach_px=reach_px)
    fit.background.plane_only = True
    fit.run(PROFILE_STEPS)
    return fit


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
    fit = _BeadFit(light, uv, shape, profile=profile, noise=noise, size=size)
    fit.run(steps)
    return fit.result()


class _BeadFit(ShadowFit):
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
        self.measured = np.zeros(len(uv), dtype=bool)
        self.disturbed = np.zeros(len(uv), dtype=bool)
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
        places = self.middle[:, None] + self.offset
        inside = ((places >= 0) & (places < (width, height))).all(axis=2)
        own = (self.offset * self.offset).sum(axis=1) <= window_px[:, None] ** 2
        column = np.clip(places[..., 0], 0, width - 1)
        row = np.clip(places[..., 1], 0, height - 1)
        valid = inside & light.field[row, column]
        grey = light.grey[row, column].astype(np.float32)
        self.low = light.low
        self.high = light.high
        bright = np.where(valid, grey, 0.0)
        self._set_windows(grey, valid & own, bright=bright, around=light.around(self.uv))
        self.usable = self.valid.sum(axis=1) >= MIN_INSIDE * own.sum(axis=1)
        # If part of the border is missing, a shadow that is not quite that of a sphere moves.
        from_edge = np.minimum(self.uv, (width - 1, height - 1) - self.uv).min(axis=1)
        self.usable &= from_edge >= self.profile.radius_px * self.radius

    def run(self, steps: int) -> None:
        """Take Gauss-Newton steps; the last step also yields standard deviations.

        Converged beads only take part in the last step and after changes to the model of their
        window.
        """
        active = np.ones(len(self.uv), dtype=bool)
        for step in range(steps):
            final = step == steps - 1
            active |= final
            if step in self.settings.crossing_steps:
                active |= self._cross()
            groups = [(rows[active[rows]], near[active[rows]]) for rows, near in self.groups]
            moved = [self._step(rows, near, final) for rows, near in groups]
            for (rows, _), (uv, depth, background) in zip(groups, moved):
                lost = np.linalg.norm(uv - self.start[rows], axis=1) > MAX_SHIFT_PX
                self.usable[rows[lost]] = False
                active[rows] = (np.abs(uv - self.uv[rows]) > SETTLED_PX).any(axis=1)
                kept = rows[~lost]
                self.uv[kept] = uv[~lost]
                self.depth[kept] = depth[~lost]
                self.background.terms[kept] = background[~lost]
            if step == steps // 2:
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
                self.crossing[chosen] = self._crossing(chosen, members)
                crossed[chosen] = True
        return crossed

    def _touching(self, rows: NDArray[np.int64], near: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return (g,) whether shadows of beads touch those of neighbours (g, k), -1 for none."""
        apart = np.linalg.norm(self.uv[rows, None] - self.uv[near], axis=2)
        radii = self.profile.radius_px * (self.radius[rows, None] + self.radius[near])
        reach = radii + 2 * self.profile.blur_px
        return np.asarray(((near >= 0) & (apart < reach)).any(axis=1))

    def _crossing(
        self, rows: NDArray[np.int64], members: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Return differences (g, m) in windows of beads (g,) with members (g, k), -1 for none."""
        grid = FineGrid(self.offset, self.profile)
        axis = grid.axis
        raw = np.ones((len(rows), len(axis), len(axis)), dtype=np.float32)
        blurred = np.ones((len(rows), len(self.offset)))
        for column in members.T:
            there = column >= 0
            bead = np.where(there, column, 0)
            centre = self.uv[bead] - self.middle[rows]
            depth = self.depth[bead] * there
            x = axis[None, None, :] - centre[:, 0, None, None]
            y = axis[None, :, None] - centre[:, 1, None, None]
            size = self.size[bead, None, None]
            squared = self._squared(bead, x, y) / size**2
            absorbed = self.profile.absorbed(squared, size)
            raw *= (1 - depth[:, None, None] * absorbed).astype(np.float32)
            x, y = np.moveaxis(self.offset - centre[:, None], 2, 0)
            away = np.sqrt(self._squared(bead, x, y))
            blurred *= 1 - depth[:, None] * self.shadows.shadow(away, self.kind[bead])[0]
        out = np.empty_like(blurred)
        for number, image in enumerate(raw):
            out[number] = grid.blurred(image)
        return out - blurred

    def _squared(
        self, beads: NDArray[np.int64], x: NDArray[np.float64], y: NDArray[np.float64]
    ) -> NDArray[np.float64]:
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
        passed = np.maximum(1 - depth * shadow, np.float32(MIN_PASSED))
        product = np.prod(passed, axis=1)
        direct = self.background.direct(rows)
        behind = direct * (product + self._crossing_in(rows))
        by_shadow = (-direct * product)[:, None] / passed
        by_distance = -by_shadow * depth * slope
        jacobian = self._jacobian(rows, behind, everyone.shape[1])
        np.multiply(by_distance, by_x, out=jacobian[:, TERMS::3])
        np.multiply(by_distance, by_y, out=jacobian[:, TERMS + 1 :: 3])
        np.multiply(by_shadow, shadow, out=jacobian[:, TERMS + 2 :: 3])
        return self._scattered(rows) + behind, jacobian

    def _disturbed(
        self, rows: NDArray[np.int64], near: NDArray[np.int64], final: bool
    ) -> NDArray[np.bool_]:
        return self.disturbed[rows]

    def _depth_sd(self, rows: NDArray[np.int64], near: NDArray[np.int64]) -> float:
        return DEPTH_SD

    def _prior(self, rows: NDArray[np.int64], near: NDArray[np.int64]) -> NDArray[np.float64]:
        prior = super()._prior(rows, near)
        if self.background.plane_only:
            prior[:, PLANE_TERMS:TERMS] = HELD
        return prior

    def _solve(
        self,
        rows: NDArray[np.int64],
        near: NDArray[np.int64],
        equations: NormalEquations,
        final: bool,
    ) -> np.ndarray:
        if final:
            self._note_precision(rows, equations)
            touching = np.flatnonzero(self._touching(rows, near))
            if len(touching):
                self._note_shifts(rows[touching], near[touching], equations, touching)
            self.measured[rows] = self.usable[rows] & np.isfinite(self.sigma[rows])
            self.residual[rows] = equations.residual
            self.counted[rows] = equations.valid
        return np.linalg.solve(equations.matrix, equations.right[..., None])[..., 0]

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
        plane = self.background.direct(every) + self._scattered(every)
        x, y = np.moveaxis(self.middle[:, None] + self.offset - self.uv[:, None], 2, 0)
        distance = np.sqrt(self._squared(every, x, y))
        known = self.valid & (self.grey > self.low) & (self.grey < self.high)
        light = np.empty_like(self.grey)
        for rows, near in self.groups:
            light[rows] = self._model(rows, near)[0]
        good = (
            known & (self.measured & (self.misfit < UNDISTURBED * np.median(self.misfit)))[:, None]
        )
        weight = plane**2 / np.maximum(light, 0.02 * plane) / np.maximum(np.median(plane), 1e-9)
        size = np.broadcast_to(rounded(self.size, 1 + RADIUS_SD)[:, None], good.shape)
        share = 1 - self.grey / plane
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
        if not (len(rows) and np.isfinite(self.high)):
            return np.zeros(len(rows), dtype=bool)
        reach = self.profile.reach_px * self.radius.max()
        away, _ = cKDTree(self.uv).query(self.middle[rows, None] + self.offset)
        light = self.valid[rows] & (away > reach)
        seen = light & (self.grey[rows] < self.high)
        return np.asarray(seen.sum(axis=1) < SEEN_LIGHT * light.sum(axis=1))


# Imaging of beads: noise, the shadow of a typical bead, the sizes of all beads.
#
# A phantom without specified sizes may have several. An isolated bead has the size with which its
# shadow fits best; if nearly all beads of a sample have the same size, all beads have.
#
# Behind two beads, scattered light is not absorbed twice: shadows that overlap tell it.

STEP = 1.25  # ratio of consecutive sizes in the first comparison
SIZES = STEP ** np.arange(-4, 5)
FINER_STEPS = (STEP**0.5, STEP**0.25, STEP**0.125)  # ratios of sizes in the refinements
FEW = 5  # isolated beads below which overlapping beads are used for the profile as well
SAMPLE = 40  # beads that decide whether sizes differ
OTHERS = 0.2  # largest share of beads in the sample with another object next to them
ROUNDS = 2  # the second round uses a profile of beads of one size
# Standard deviation of the share of scattered light from isolated shadows, which hardly separate
# it from attenuation: in renderings with a share of 0.1, it was 0.06 to 0.31.
SCATTER_SD = 0.1
SCATTER_ROUNDS = 3  # windows of overlapping shadows with a large lack of fit are used later
SCATTER_MARGIN = 0.1  # of windows, in which different profiles are compared
SCATTER_STEP = 0.01  # change of the light behind two beads below the noise of a pixel


@dataclass(frozen=True)
class Expected:
    """Expected shadows of beads."""

    row: NDArray[np.int64]  #: (n,), row of the bead in the phantom
    uv: NDArray[np.float64]  #: (n, 2) [px]
    #: (n, 2, 2), matrices from the circle of a typical bead to the borders of shadows of that size
    shape: NDArray[np.float64]
    seen: NDArray[np.bool_]  #: (n,), True if something was detected there
    alone: NDArray[np.bool_]  #: (n,), True if no other shadow is near

    @property
    def radius(self) -> NDArray[np.float64]:
        """Relative radii (n,) that the shadows have if all beads are of typical size."""
        return np.sqrt(np.abs(np.linalg.det(self.shape)))


@dataclass(frozen=True)
class Imaging:
    """Noise and shadows of an image."""

    noise: Noise
    profile: Profile  #: shadow of a typical bead
    #: (n,), relative size of each bead of the phantom; 1 is typical, NaN is unknown
    size: NDArray[np.float64]

    @property
    def sizes_are_alike(self) -> bool:
        """Whether no bead is much larger than a typical one."""
        return bool((self.size < LARGER[0]).all())

    def completed(self, light: Light, shadows: Expected) -> Imaging:
        """Return a copy that adds the unknown sizes of beads that are isolated in this image."""
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
    """Estimate the shadows and sizes of beads from an image.

    radius_px: initial value of the radius of a typical bead. size: (n,) relative sizes of all
    beads of the phantom, NaN if unspecified.
    """
    profile = _typical(light, shadows, size, radius_px)
    imaging = Imaging(noise, profile, size)
    if not np.isfinite(size).all():
        imaging = _with_sizes(light, shadows, imaging)
    imaging = _with_mask(light, shadows, imaging)
    return _with_scatter(light, shadows, imaging)


def _with_sizes(light: Light, shadows: Expected, imaging: Imaging) -> Imaging:
    """Return a copy with the sizes of isolated beads, or of all beads if they are equal."""
    alone = np.flatnonzero(shadows.seen & shadows.alone)
    sizes = _Sizes(light, shadows, imaging)
    if sizes.are_equal(_sampled(alone, SAMPLE)):
        return replace(imaging, size=np.ones_like(imaging.size))
    for _ in range(ROUNDS):
        sizes = sizes.with_sizes(alone, sizes.best(alone))
    return sizes.imaging


def _with_mask(light: Light, shadows: Expected, imaging: Imaging) -> Imaging:
    """Return a copy with the unsharp mask that the image has.

    It gives shadows bright borders, so that shadows that are close move apart. It is only looked
    for if some are close, and if the residuals of isolated shadows have a part in common.
    """
    size = imaging.size[shadows.row]
    start = replace(
        imaging.profile.with_scatter(START_SCATTER),
        sharpening=START_SHARPENING,
        mask_px=START_MASK_PX,
    )
    distance = _distance(shadows)
    close = distance < 2 * imaging.profile.reach_px
    alone = shadows.seen & np.isfinite(size) & (distance > 2 * start.reach_px)
    rows = _sampled(np.flatnonzero(alone), SAMPLE)
    if len(rows) < FEW or not close.any() or np.isfinite(light.high):
        return imaging

    sizes = _Sizes(light, shadows, imaging)
    fit = sizes.fitted(rows, size[rows], STEPS - 1, (start.reach_px,) * 2)
    if np.median(fit.common_share()[: len(rows)]) < COMMON:
        return imaging
    isolated = replace(shadows, alone=alone)
    profile = _typical(light, isolated, imaging.size, start.radius_px, start, MASKED)
    shapes = shadows.shape[rows], size[rows]
    plain, masked = (
        _profile_fit(light, shadows.uv[rows], shapes, one, profile.reach_px).typical()
        for one in (imaging.profile, profile)
    )
    return replace(imaging, profile=profile) if masked < (1 - COMMON) * plain else imaging


def _with_scatter(light: Light, shadows: Expected, imaging: Imaging) -> Imaging:
    """Return a copy with the share of scattered light from shadows that overlap.

    Without isolated shadows, or if the model does not fit them, the share stays as it is.
    """
    size = imaging.size[shadows.row]
    overlapping = _sampled(_overlapping(shadows, size, imaging.profile.radius_px), PROFILE_BEADS)
    alone = np.flatnonzero(shadows.seen & shadows.alone & np.isfinite(size))
    if not (len(overlapping) and len(alone)):
        return imaging
    rows = np.concatenate([overlapping, _sampled(alone, SAMPLE)])
    reach_px = (1 + SCATTER_MARGIN) * size[rows].max() * imaging.profile.reach_px

    def fitted(imaging: Imaging) -> tuple[_BeadFit, NDArray[np.float64]]:
        fit = _Sizes(light, shadows, imaging).fitted(rows, size[rows], STEPS - 1, (reach_px,) * 2)
        return fit, fit.misfit[: len(rows)]

    fit, lack = fitted(imaging)
    if np.median(lack[len(overlapping) :]) > DISTURBED:
        return imaging
    first = imaging.profile.scatter
    weight = SCATTER_SD**-2.0
    for _ in range(SCATTER_ROUNDS):
        right, information = _scatter_equation(fit, len(overlapping))
        before = imaging.profile
        step = (right + weight * (first - before.scatter)) / (information + weight)
        scatter = float(np.clip(before.scatter + step, *LIMITS['scatter']))
        known = before.with_scatter(scatter)
        if abs(known.scatter - before.scatter) < SCATTER_STEP:
            break
        profile = _typical(light, shadows, imaging.size, before.radius_px, known, SHAPE)
        changed = replace(imaging, profile=profile)
        fit, changed_lack = fitted(changed)
        if np.mean(np.log(changed_lack / lack)) > 0:
            break
        imaging, lack = changed, changed_lack
    return imaging


def _scatter_equation(fit: _BeadFit, count: int) -> tuple[float, float]:
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
        weight = fit._valid(rows, fit.grey[rows], light) / fit.noise.variance(light)
        both = np.concatenate([jacobian, by_scatter[:, None].astype(DTYPE)], axis=1)
        weighted = both * weight[:, None]
        normal = (weighted @ np.swapaxes(both, 1, 2)).astype(float)
        diagonal = np.arange(jacobian.shape[1])
        normal[:, diagonal, diagonal] += fit._prior(rows, near) + 1e-12
        residual = (fit.grey[rows] - light)[..., None]
        columns = np.concatenate([weighted @ residual, normal[:, :, -1:]], axis=2)
        eliminated = np.linalg.solve(normal[:, :-1, :-1], columns[:, :-1])
        equation += (columns[:, -1:] - normal[:, -1:, :-1] @ eliminated).sum(axis=(0, 1))
    # Both windows of a pair contain the overlap.
    right, information = 0.5 * equation / fit.typical()
    return float(right), float(information)


def _by_scatter(
    fit: _BeadFit,
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
    passed = (light - fit._scattered(rows)) / direct
    by_depth = (depth * jacobian[:, TERMS + 2 :: 3]).sum(axis=1) / direct
    return fit.background.around[rows, None] * (1 + 2 * fit._crossing_in(rows) - passed + by_depth)


def _overlapping(
    shadows: Expected, size: NDArray[np.float64], radius_px: float
) -> NDArray[np.int64]:
    """Return the expected shadows (m,) that overlap with the nearest one."""
    known = np.flatnonzero(np.isfinite(size))
    if len(known) < 2:
        return known[:0]
    radius = radius_px * shadows.radius[known] * size[known]
    distance, near = cKDTree(shadows.uv[known]).query(shadows.uv[known], k=2)
    nearest = np.where(near[:, 0] == np.arange(len(known)), near[:, 1], near[:, 0])
    return known[distance[:, 1] < radius + radius[nearest]]


def _distance(shadows: Expected) -> NDArray[np.float64]:
    """Return distances (n,) of shadows from the nearest other one [px]."""
    if len(shadows.uv) < 2:
        return np.full(len(shadows.uv), np.inf)
    return np.asarray(cKDTree(shadows.uv).query(shadows.uv, k=[2])[0][:, 0])


def _sampled(rows: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Return at most so many of some rows."""
    return rows[:: len(rows) // count + 1]


def _typical(
    light: Light,
    shadows: Expected,
    size: NDArray[np.float64],
    radius_px: float,
    start: Profile | None = None,
    estimated: Sequence[str] = PLAIN,
) -> Profile:
    """Estimate the profile of a bead of size 1 from isolated beads.

    start, estimated: those of `estimate_profile`.
    """
    seen = np.flatnonzero(shadows.seen & shadows.alone)
    if len(seen) < FEW:
        seen = np.flatnonzero(shadows.seen)
    relative = size[shadows.row[seen]]
    known = np.isfinite(relative)
    if known.any():
        seen = seen[known]
    relative = relative[known] if known.any() else np.ones(len(seen))
    alike = rounded(relative, FINER_STEPS[1])
    shape = shadows.shape[seen] * (relative / alike)[:, None, None]
    return estimate_profile(
        light,
        shadows.uv[seen],
        shape,
        radius_px,
        size=alike,
        start=start,
        estimated=estimated,
    )


def rounded(size: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    """Return relative sizes (n,) rounded to powers of a step, so that few values differ."""
    return np.asarray(step ** np.rint(np.log(size) / np.log(step)))


class _Sizes:
    """Comparison of bead sizes in an image."""

    def __init__(self, light: Light, shadows: Expected, imaging: Imaging) -> None:
        self.light = light
        self.shadows = shadows
        self.imaging = imaging

    def are_equal(self, rows: NDArray[np.int64]) -> bool:
        """Return whether nearly all beads without a disturbance nearby have the same size.

        A bead differs if the common size fits it as badly as if something disturbed it.
        """
        if not len(rows):
            return True
        same = np.ones(len(rows))
        smaller, common, larger = self.lacks(rows, [same / STEP, same, same * STEP])
        if np.mean(common > DISTURBED * np.minimum(smaller, larger)) <= OTHERS:
            return True
        # A mean profile of beads of several sizes fits few of them.
        sized = self.with_sizes(rows, self.best(rows))
        size = sized.imaging.size[self.shadows.row[rows]]
        own, common = sized.lacks(rows, [size, same])
        differs = np.abs(np.log(size)) > 0.5 * np.log(STEP)
        differs &= common > DISTURBED * own
        return bool(np.mean(differs[own < DISTURBED * np.median(own)]) <= OTHERS)

    def with_sizes(self, rows: NDArray[np.int64], sizes: NDArray[np.float64]) -> _Sizes:
        """Return a comparison whose profile is estimated from beads with sizes (m,) found."""
        middle = float(np.median(sizes))
        size = np.full_like(self.imaging.size, np.nan)
        size[self.shadows.row[rows]] = sizes / middle
        radius_px = self.imaging.profile.radius_px * middle
        profile = _typical(self.light, self.shadows, size, radius_px)
        return _Sizes(self.light, self.shadows, Imaging(self.imaging.noise, profile, size))

    def best(self, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the best-fitting sizes (m,) of beads."""
        same = np.ones(len(rows))
        lack = self.lacks(rows, [one * same for one in SIZES])
        size = SIZES[np.clip(np.argmin(lack, axis=0), 1, len(SIZES) - 2)]
        row = np.arange(len(rows))
        for step in FINER_STEPS:
            tried = np.stack([size / step, size, size * step])
            lack = self.lacks(rows, list(tried))
            least = np.argmin(lack, axis=0)
            size = tried[least, row]
        # A parabola only improves a size if both neighbouring sizes fit worse.
        return np.asarray(size * np.where(least == 1, FINER_STEPS[-1] ** vertex(*-lack), 1.0))

    def lacks(
        self, rows: NDArray[np.int64], sizes: Sequence[NDArray[np.float64]]
    ) -> NDArray[np.float64]:
        """Return the lack of fit (k, m) of beads (m,) for k sets of sizes (m,).

        The shadows around the beads are fitted as well.
        """
        # A small shadow has to explain the window of a typical bead.
        reach_px = self.imaging.profile.reach_px
        largest_px = max(1.0, float(np.max(sizes))) * reach_px
        fits = [self.fitted(rows, size, FIRST_STEPS, (reach_px, largest_px)) for size in sizes]
        return np.stack([fit.misfit[: len(rows)] for fit in fits])

    def fitted(
        self,
        rows: NDArray[np.int64],
        size: NDArray[np.float64],
        steps: int,
        reaches_px: tuple[float, float],
    ) -> _BeadFit:
        """Fit beads (m,) of sizes (m,) and, after them, the shadows around.

        reaches_px: smallest reach of the windows, and the largest, up to which shadows are around.
        """
        shadows = self.shadows
        imaging = self.imaging
        # The windows of the beads, and the largest shadow that may reach into them.
        reach = reaches_px[1] + np.nanmax(imaging.size, initial=1.0) * imaging.profile.reach_px
        near = cKDTree(shadows.uv).query_ball_point(shadows.uv[rows], reach)
        around = np.setdiff1d(np.concatenate(near).astype(int), rows)
        every = np.concatenate([rows, around])
        known = np.nan_to_num(imaging.size[shadows.row[around]], nan=1.0)
        fit = _BeadFit(
            self.light,
            shadows.uv[every],
            shadows.shape[every],
            profile=imaging.profile,
            noise=imaging.noise,
            size=np.concatenate([size, known]),
            reach_px=reaches_px[0],
        )
        fit.run(steps)
        return fit
