# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Measure centres of moving markers: all windows of an image in one Gauss-Newton iteration.

The model of a window is that of `shadow_fit`. If a marker moves while the light is on, its shadow
is the mean of shadows along its path (Gauss-Legendre quadrature), and its centre is that in the
middle of the exposure.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from .background import TERMS
from .fine_grid import Absorbers, FineGrid
from .light import Noise
from .marker_echo import Echo
from .marker_intensity import LightWindows, Shadows
from .marker_motion import SHADOW_SD_PX, MarkerStates, MeasuredMarkers, Motion, assign
from .profile import Profile
from .shadow_fit import (
    DEPTH_SD,
    DISTURBED,
    MARGIN_PX,
    MAX_SIGMA_PX,
    MIN_PASSED,
    Beads,
    FitSettings,
    NormalEquations,
    ShadowFit,
    noise_of_windows,
)
from .texture import DTYPE

SETTINGS = FitSettings(
    steps=3,  # for markers whose shadows touch
    crossing_steps=(1,),
    crowds=((1, 3),),
    max_step_px=0.8,
    pooled=120.0,
    crossed=1.2,
)
STEPS_ALONE = 2  # steps of isolated markers, if clipped pixels do not hide the light
CONVERGED_PX = 0.1  # length of the last step from which another step follows
WAY_PX = 2.0  # length of the largest motion for each further quadrature point


@dataclass(frozen=True)
class MarkerGuess:
    """Initial values of markers: places, depths of shadows, motion."""

    uv: NDArray[np.float64]  #: (n, 2), centres [px]
    #: (n,), depths of the shadows, 1 for the profile
    depth: NDArray[np.float64]
    depth_sd: NDArray[np.float64]
    motion: NDArray[np.float64]  #: (n, 2), motion of their shadows while the light is on [px]
    #: (k, n, 2), centres in images before this one, latest first [px]
    before: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0, 2)))
    #: (k,), shares of these images in this one
    echo: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def standing(cls, uv: NDArray[np.float64]) -> MarkerGuess:
        """Return that of markers of unknown depth near uv (n, 2) that do not move."""
        n = len(uv)
        return cls(uv, np.ones(n), np.full(n, DEPTH_SD), np.zeros((n, 2)))


def fit_markers(
    windows: LightWindows,
    guess: MarkerGuess,
    profile: Profile,
    noise: Noise,
    inflation: dict[int, float],
) -> Beads:
    """Measure all markers near their initial values at once; see `fitted`."""
    return fitted(windows, guess, profile, noise, inflation).beads


def fitted(
    windows: LightWindows,
    guess: MarkerGuess,
    profile: Profile,
    noise: Noise,
    inflation: dict[int, float],
) -> _MarkerFit:
    """Return the fit of all markers near their initial values at once.

    inflation: factors on variances for correlated noise, by the number of pixels in a window. They
    are the same for all images, and new factors are added.
    """
    fit = _MarkerFit(windows, guess, profile, noise)
    pixels = len(fit.offset)
    fit.inflation = inflation.get(pixels)
    fit.run()
    fit.beads = fit.result()
    if fit.inflation is not None:
        inflation[pixels] = fit.inflation
    return fit


def noise_of_markers(
    windows: LightWindows, uv: NDArray[np.float64], profile: Profile, noise: Noise
) -> Noise:
    """Return the noise of pixels around markers near uv (n, 2), from the residuals of their fit.

    An image that was processed may have another noise in shadows than elsewhere in such light: an
    unsharp mask makes them darker, but not their noise. noise: that of the image; it stays if
    there are few pixels.
    """
    fit = _MarkerFit(windows, MarkerGuess.standing(uv), profile, noise)
    fit.run()
    return noise_of_windows(fit)


@lru_cache(maxsize=8)
def _gauss_points(count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return nodes and weights (count,) of the quadrature from -1 to 1."""
    node, weight = np.polynomial.legendre.leggauss(count)
    return node, weight


class _MarkerFit(ShadowFit):
    """Fit of markers of one size, which may move."""

    beads: Beads

    def __init__(
        self, windows: LightWindows, guess: MarkerGuess, profile: Profile, noise: Noise
    ) -> None:
        length = np.sqrt((guess.motion**2).sum(axis=1))
        longest = float(length.max(initial=0.0))
        node, weight = _gauss_points(1 + round(longest / WAY_PX))
        self.way = 0.5 * node[:, None, None] * guess.motion  # (q, n, 2)
        shares = np.append(1 - guess.echo.sum(), guess.echo)
        self.way_weight = 0.5 * np.outer(shares, weight).ravel()
        reach = profile.reach_px + 0.5 * np.ceil(longest)
        super().__init__(
            SETTINGS,
            profile,
            noise=noise,
            uv=guess.uv,
            depth=guess.depth,
            window_px=reach + MARGIN_PX,
        )
        self.guess = guess
        self.offset_u, self.offset_v = np.ascontiguousarray(self.offset.T, dtype=DTYPE)
        self.clipping = windows.clipping
        grey, valid = windows.read(self.middle, self.offset)
        self._set_windows(grey, valid, bright=grey)
        self._set_groups(self._near(2 * reach + MARGIN_PX))

    def _near(self, together: float) -> NDArray[np.int64]:
        """Return neighbours (n, k) of the markers, -1 for none; note distances of the nearest."""
        distance = cdist(self.uv, self.uv)
        np.fill_diagonal(distance, np.inf)
        self.distance = distance.min(axis=1, initial=np.inf)
        near = np.argsort(distance, axis=1, kind='stable')[:, : self.settings.neighbours]
        return np.where(np.take_along_axis(distance, near, axis=1) < together, near, -1)

    def run(self) -> None:
        """Take Gauss-Newton steps; the last step also yields standard deviations."""
        moved = np.zeros(len(self.uv))
        for step in range(self.settings.steps):
            if step in self.settings.crossing_steps:
                self._cross()
            self._renew_prior(step)
            for rows, near in self.groups:
                alone = not near.shape[1] and not self.hidden
                if alone and step >= STEPS_ALONE:
                    continue
                final = step == (STEPS_ALONE if alone else self.settings.steps) - 1
                moved[rows] = self._take_step(rows, near, final)
        for rows, near in self.groups:
            unconverged = moved[rows] > CONVERGED_PX
            if unconverged.any():
                self._take_step(rows[unconverged], near[unconverged], True)

    def _take_step(
        self, rows: NDArray[np.int64], near: NDArray[np.int64], final: bool
    ) -> NDArray[np.float64]:
        """Take a step of some markers; return how far (g,) their centres move [px]."""
        uv, depth, background = self._step(rows, near, final)
        moved = np.abs(uv - self.uv[rows]).max(axis=1)
        self.uv[rows] = uv
        self.depth[rows] = depth
        self.background.terms[rows] = background
        return np.asarray(moved)

    def _points(self, rows: NDArray[np.int64], middle: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return points (q, g, k, 2) of the paths of markers (g, k) in windows around a middle.

        Those in this image come first.
        """
        places = self.uv, *self.guess.before
        return np.concatenate([self.way[:, rows] + uv[rows] for uv in places]) - middle[:, None]

    def _shadow(
        self, rows: NDArray[np.int64], middle: NDArray[np.int64]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Return shadows (g, k, m) in windows around pixels middle (g, 2), and their derivatives.

        The derivatives are with respect to the centres. rows (g, k) are the markers.
        """
        # Points along the path are the first axis; few large arrays are faster than many small.
        centre = self._points(rows, middle).astype(DTYPE)
        x = self.offset_u - centre[..., 0, None]
        y = self.offset_v - centre[..., 1, None]
        distance = x * x
        distance += y * y
        np.sqrt(distance, out=distance)
        value, derivative = self.profile.shadow(distance)
        derivative /= np.maximum(distance, 1e-9, out=distance)
        x *= derivative
        y *= derivative
        if len(self.way_weight) == 1:
            return value[0], -x[0], -y[0]
        weight = self.way_weight.astype(DTYPE)
        point_count = len(weight)
        shape = value.shape[1:]
        moving = weight.copy()
        moving[len(self.way) :] = 0  # images before this one are over
        return (
            (weight @ value.reshape(point_count, -1)).reshape(shape),
            (-moving @ x.reshape(point_count, -1)).reshape(shape),
            (-moving @ y.reshape(point_count, -1)).reshape(shape),
        )

    def _model(
        self, rows: NDArray[np.int64], near: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """Return light (g, m) and its derivatives (g, OWN + 3 k, m)."""
        members = np.concatenate([rows[:, None], near], axis=1)
        shadow, by_u, by_v = self._shadow(members, self.middle[rows])
        direct = self.background.direct(rows)
        exists = members >= 0
        depth = np.where(exists, self.depth[members], 0.0)[..., None]
        passed = np.maximum(1 - depth * shadow, MIN_PASSED)
        product = np.prod(passed, axis=1)
        behind = direct * (product + self._crossing_in(rows))
        jacobian = self._jacobian(rows, behind, members.shape[1])
        by_shadow = -(direct * product)[:, None] / passed
        by_place = by_shadow * depth
        jacobian[:, TERMS::3] = by_place * by_u
        jacobian[:, TERMS + 1 :: 3] = by_place * by_v
        jacobian[:, TERMS + 2 :: 3] = by_shadow * shadow * exists[..., None]
        return self.background.scattered(rows) + behind, jacobian

    def _disturbed(
        self, rows: NDArray[np.int64], near: NDArray[np.int64], final: bool
    ) -> NDArray[np.bool_]:
        if final or near.shape[1]:
            return self.misfit[rows] > DISTURBED * self.typical()
        return np.zeros(len(rows), dtype=bool)

    def _depth_sd(
        self, rows: NDArray[np.int64], near: NDArray[np.int64]
    ) -> float | NDArray[np.float64]:
        # The depth of an isolated shadow is evidence for its marker, so it is hardly constrained.
        return self.guess.depth_sd[rows] if near.shape[1] else DEPTH_SD

    def _solve(
        self,
        rows: NDArray[np.int64],
        near: NDArray[np.int64],
        equations: NormalEquations,
        final: bool,
    ) -> np.ndarray:
        if not final:
            return np.linalg.solve(equations.matrix, equations.right[..., None])[..., 0]
        inverse = self._note_precision(rows, equations, np.arange(len(rows)))
        return (inverse @ equations.right[..., None])[..., 0]

    def _cross(self) -> None:
        """Compute how shadows that touch differ from the product of both shadows."""
        reach = 2 * (self.profile.radius_px + self.profile.blur_px)
        reach += float(np.abs(self.way).max(initial=0.0)) * 2
        touching = self.distance < reach
        if not touching.any():
            return
        self.crossing = np.zeros((len(self.uv), len(self.offset)), dtype=DTYPE)
        for rows, near in self.groups:
            chosen = rows[touching[rows]]
            if len(chosen):
                members = np.concatenate([chosen[:, None], near[touching[rows]]], axis=1)
                self.crossing[chosen] = self._crossing_of(chosen, members)

    def _crossing_of(
        self, rows: NDArray[np.int64], members: NDArray[np.int64]
    ) -> NDArray[np.floating]:
        """Return differences (g, m) in windows of markers (g,) with members (g, k)."""
        there = members >= 0
        marker = np.where(there, members, 0)
        depth = self.depth[marker] * there
        beads = Absorbers(
            self._points(marker, self.middle[rows]),
            self.way_weight,
            depth=depth,
            extent_px=np.full(marker.shape, self.profile.radius_px),
            absorbed=lambda _, x, y: self.profile.absorbed(x * x + y * y),
        )
        shadow, _, _ = self._shadow(marker, self.middle[rows])
        separate = np.prod(1 - depth[..., None] * shadow, axis=1)
        return FineGrid(self.offset, self.profile).light_behind(beads) - separate

    def echoes(
        self, before: NDArray[np.float64], measured: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return normal equations (k, k), (k,) of changes of the shares of earlier images.

        before (k, n, 2): centres of the markers in these images. measured (n,): markers to use, if
        they are isolated.
        """
        matrix = np.zeros((len(before),) * 2)
        right = np.zeros(len(before))
        shown = 0.5 * _gauss_points(len(self.way))[1]
        for rows, near in self.groups:
            if near.shape[1]:
                continue
            equations = self._equations((rows, near), True, None)
            light, jacobian = self._model(rows, near)
            residual, weight, _ = self._observed(rows, light)
            usual = measured[rows] & (self.misfit[rows] <= DISTURBED * self.typical())
            weight = weight * usual[:, None]
            points = np.stack([self.way[:, rows] + uv[rows] for uv in (self.uv, *before)])
            points = points[:, :, :, None] - self.middle[rows][:, None] - self.offset
            shadow = self.profile.shadow(np.linalg.norm(points, axis=-1).astype(DTYPE))[0]
            now, *earlier = np.tensordot(shadow, shown, (1, 0))
            passed = self.background.direct(rows) * self.depth[rows, None]
            by_share = np.stack([passed * (now - then) for then in earlier], axis=1)
            absorbed = np.linalg.solve(
                equations.matrix, equations.weighted @ np.swapaxes(by_share, 1, 2)
            )
            rest = by_share - np.swapaxes(absorbed, 1, 2) @ jacobian
            matrix += ((by_share * weight[:, None]) @ np.swapaxes(rest, 1, 2)).sum(axis=0)
            right += (rest @ (weight * residual)[..., None])[..., 0].sum(axis=0)
        variance = self.typical() * (self.inflation or 1.0)
        return matrix / variance, right / variance

    def result(self) -> Beads:
        """Return the measured markers."""
        displacement = np.abs(self.uv - self.start).max(axis=1, initial=0.0)
        measured = self.usable & np.isfinite(self.uv).all(axis=1) & np.isfinite(self.sigma)
        measured &= displacement < self.settings.steps * self.settings.max_step_px
        return self._beads(measured, self.typical())


# Measurement of markers: shadows are assigned to all markers together, fitted and checked.

MAX_MISFIT = 10.0  # largest lack of fit over that of a typical marker
DEPTH = (0.5, 1.8)  # limits of the depth of a shadow, relative to that of its marker


class MarkerMeasurement:
    """Measures markers in shadows that were found near them.

    profile: shadow of a typical marker. gate: largest distance of a marker from its prediction
    [standard deviations]. shutter: share of the time between two images during which the light is
    on.
    """

    def __init__(self, profile: Profile, noise: Noise, *, gate: float, shutter: float) -> None:
        self.profile = profile
        self._noise = noise
        self.factor = 1.0  #: of the noise that other views show to that of the residuals
        self._inflation: dict[int, float] = {}
        self._gate = gate
        self._shutter = shutter
        self._echo = Echo()

    @property
    def echo(self) -> NDArray[np.float64]:
        """Shares (k,) of the images before, latest first, in the next image."""
        return self._echo.shares

    def measure(
        self, windows: LightWindows, shadows: Shadows, states: MarkerStates, frames: int
    ) -> MeasuredMarkers:
        """Measure the markers of an image, `frames` after the last one, in its shadows."""
        start, assigned, free = self._assign(shadows, states)
        self._share_shadows(start, assigned, states.motion)
        tried = np.flatnonzero(assigned)
        guess = MarkerGuess(
            start[tried],
            states.depth[tried],
            states.depth_sd[tried],
            self._shutter * states.motion.velocity[tried],
            before=self._echo.before(tried, states.motion, frames)[: len(self.echo)],
            echo=self.echo,
        )
        fit = fitted(windows, guess, self.profile, self._noise, self._inflation)
        beads = fit.beads
        measured = np.zeros(len(start), dtype=bool)
        measured[tried[self._acceptable(beads, tried, states)]] = True
        earlier = self._echo.before(tried, states.motion, frames)
        self._echo.observe(*fit.echoes(earlier, measured[tried]), self.factor)
        uv = start.copy()
        uv[tried] = beads.uv
        self._echo.add(np.where(measured[:, None], uv, np.nan))
        sigma = np.full(len(start), SHADOW_SD_PX)
        sigma[tried] = self.factor * beads.sigma
        overlapped = np.zeros(len(start), dtype=bool)
        overlapped[tried] = beads.overlapped
        depth = states.depth.copy()
        depth[tried] = beads.depth
        return MeasuredMarkers(
            measured, uv, start, sigma=sigma, depth=depth, overlapped=overlapped, free=free
        )

    def _assign(
        self, shadows: Shadows, states: MarkerStates
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.float64]]:
        """Return shadows or predictions (n, 2), whether each is a shadow, free shadows (k, 2)."""
        motion = states.motion
        variance = states.shadow_variance
        row, column = assign(motion.uv, variance, shadows.uv, self._gate)
        start = motion.uv.copy()
        start[row] = shadows.uv[column]
        assigned = np.zeros(len(start), dtype=bool)
        assigned[row] = True
        return start, assigned, np.delete(shadows.uv, column, axis=0)

    def _share_shadows(
        self, start: NDArray[np.float64], assigned: NDArray[np.bool_], motion: Motion
    ) -> None:
        """Let markers without a shadow share that of a neighbouring marker.

        Both start from their predictions, shifted so that their mean is the place of the shadow.
        start (n, 2) and assigned (n,) are modified.
        """
        reach = 2 * self.profile.radius_px + self.profile.blur_px
        for row in np.flatnonzero(~assigned):
            if motion.variance[row] > reach**2:
                continue
            distance = np.linalg.norm(start - motion.uv[row], axis=1)
            distance[~assigned] = np.inf
            neighbour = int(np.argmin(distance))
            if distance[neighbour] < reach:
                midpoint = 0.5 * (motion.uv[row] + motion.uv[neighbour])
                shift = start[neighbour] - midpoint
                start[row] = motion.uv[row] + shift
                start[neighbour] = motion.uv[neighbour] + shift
                assigned[row] = True

    def _acceptable(
        self, beads: Beads, rows: NDArray[np.int64], states: MarkerStates
    ) -> NDArray[np.bool_]:
        """Return (k,) whether fitted shadows belong to the markers in rows (k,)."""
        relative = beads.depth / states.depth[rows]
        offset = beads.uv - states.motion.uv[rows]
        variance = states.motion.innovation_variance(np.zeros(1))[rows] + beads.sigma**2
        good = beads.measured & (beads.sigma < MAX_SIGMA_PX) & (beads.misfit < MAX_MISFIT)
        good &= (offset * offset).sum(axis=1) < (self._gate + 1) ** 2 * variance
        good &= (relative > DEPTH[0]) & (relative < DEPTH[1])
        return good
