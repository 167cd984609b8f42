# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Measure centres of moving markers: all windows of an image in one Gauss-Newton iteration.

The model of a window is that of `measurement`: the blurred shadow of a sphere on a background of
degree 2, neighbours fitted with it. A marker that moves while the light is on has a shadow that is
the mean of shadows along its way (Gauss-Legendre quadrature), and its centre is that of the middle
of the exposure.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.distance import cdist

from .marker_light import LightWindows
from .measurement import Beads, Noise
from .profile import Profile

STEPS = 4  # of markers whose shadows touch
STEPS_ALONE = 3
NEIGHBOURS = 3
MARGIN_PX = 2.0  # of background around the shadow
TERMS = 6  # of the background: a polynomial of degree 2
OWN = TERMS + 3  # unknowns of a marker alone: its background, centre and depth
NEIGHBOUR_SD_PX = 0.3  # of a step of a neighbour, which its own fit finds
ALONE_SD = 1.0  # of the depth of a marker alone
NEIGHBOUR_SD = 0.2  # of a step of a neighbour's depth
MAX_STEP_PX = 0.8
DEPTHS = (0.05, 3.0)
MIN_PASSED = 0.02
MIN_PIXELS = 0.6  # of a window that lie in the field
POOLED = 120.0  # degrees of freedom of the noise of all markers, in that of one
CROSSED = 1.2  # factor on the standard deviation where shadows cross
FINE = 3  # points across a pixel of the grid on which shadows that touch are blurred
CROSSING_STEP = 2  # before which they are
# Largest motion [px] for a number of points along the way.
QUADRATURE = ((0.7, 1), (3.0, 2), (6.0, 3), (10.0, 5), (np.inf, 7))
DISTURBED = 1.6  # misfit from which pixels with large residuals count less
ROBUST = 2.5


@dataclass(frozen=True)
class MarkerGuess:
    """Where markers may be, and what they look like.

    Attributes
    ----------
    uv : (n, 2) ndarray
        Centres [px].
    depth, depth_sd : (n,) ndarray
        Of their shadows, 1 for the profile.
    motion : (n, 2) ndarray
        Way of their shadows while the light is on [px].
    """

    uv: np.ndarray
    depth: np.ndarray
    depth_sd: np.ndarray
    motion: np.ndarray


def fit_markers(
    windows: LightWindows, guess: MarkerGuess, profile: Profile, noise: Noise
) -> Beads:
    """Measure all markers near a guess at once."""
    fit = _Fit(windows, guess, profile, noise)
    fit.run()
    return fit.result()


class _Fit:
    """Gauss-Newton fit of windows, each with the neighbours of its marker."""

    def __init__(
        self, windows: LightWindows, guess: MarkerGuess, profile: Profile, noise: Noise
    ) -> None:
        self.profile = profile
        self.noise = noise
        self.guess = guess
        self.uv = np.array(guess.uv, dtype=float)
        self.depth = np.array(guess.depth, dtype=float)
        n = len(self.uv)
        length = np.sqrt((guess.motion**2).sum(axis=1))
        longest = float(length.max(initial=0.0))
        points = next(count for limit, count in QUADRATURE if longest <= limit)
        node, weight = np.polynomial.legendre.leggauss(points)
        self.way = 0.5 * node[:, None, None] * guess.motion  # (q, n, 2)
        self.way_weight = 0.5 * weight
        reach = profile.reach_px + 0.5 * np.ceil(longest)
        half = int(np.ceil(reach + MARGIN_PX))
        axis = np.arange(-half, half + 1)
        grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
        self.offset = grid[(grid * grid).sum(axis=1) <= (reach + MARGIN_PX) ** 2]
        self.offset_u = np.ascontiguousarray(self.offset[:, 0], dtype=float)
        self.offset_v = np.ascontiguousarray(self.offset[:, 1], dtype=float)
        x, y = self.offset.T / half
        self.basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
        self.middle = np.rint(self.uv).astype(int)
        grey, self.valid = windows.read(self.middle, self.offset)
        self.grey = grey.astype(float)
        self.usable = self.valid.mean(axis=1) >= MIN_PIXELS
        self.background = np.zeros((n, TERMS))
        place = int(0.75 * len(self.offset))
        self.background[:, 0] = np.partition(self.grey, place, axis=1)[:, place]
        self.sigma = np.full(n, np.inf)
        self.misfit = np.full(n, np.inf)
        self.inflation = 1.0
        self.crossing = np.zeros((n, 1))
        self.groups = self._groups(2 * reach + MARGIN_PX)

    def _groups(self, together: float) -> list[tuple[np.ndarray, np.ndarray]]:
        """Rows of markers and of their neighbours, -1 for none: those alone, and the others."""
        distance = cdist(self.uv, self.uv)
        np.fill_diagonal(distance, np.inf)
        self.distance = distance.min(axis=1, initial=np.inf)
        close = distance < together
        crowd = np.minimum(close.sum(axis=1), NEIGHBOURS)
        alone = np.flatnonzero(crowd == 0)
        groups = [(alone, np.zeros((len(alone), 0), dtype=int))] if len(alone) else []
        for low, high in ((1, 1), (2, NEIGHBOURS)):
            rows = np.flatnonzero((crowd >= low) & (crowd <= high))
            if len(rows):
                near = np.argsort(distance[rows], axis=1, kind='stable')[:, :high]
                there = np.take_along_axis(close[rows], near, axis=1)
                groups.append((rows, np.where(there, near, -1)))
        self.crowded = np.flatnonzero(crowd)
        self.neighbours = [np.flatnonzero(row) for row in close]
        return groups

    def run(self) -> None:
        """Take Gauss-Newton steps; the last one gives standard deviations as well."""
        for step in range(STEPS):
            if step == CROSSING_STEP and len(self.crowded):
                self._cross()
            for rows, near in self.groups:
                alone = not near.shape[1]
                if alone and step >= STEPS_ALONE:
                    continue
                final = step == (STEPS_ALONE if alone else STEPS) - 1
                uv, depth, background = self._step(rows, near, final)
                self.uv[rows] = uv
                self.depth[rows] = depth
                self.background[rows] = background

    def _shadow(
        self, rows: np.ndarray, middle: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Shadows (g, k, m) in windows around pixels middle (g, 2), and derivatives by the centre.

        rows (g, k) are the markers.
        """
        # Points along the way are the first axis; few large arrays are faster than many small.
        centre = self.way[:, rows] + (self.uv[rows] - middle[:, None])
        x = self.offset_u - centre[..., 0, None]
        y = self.offset_v - centre[..., 1, None]
        distance = np.sqrt(x * x + y * y)
        value, derivative = self.profile.shadow(distance)
        derivative /= np.maximum(distance, 1e-9)
        x *= derivative
        y *= derivative
        if len(self.way) == 1:
            return value[0], -x[0], -y[0]
        weight = self.way_weight[:, None, None, None]
        return (
            (weight * value).sum(axis=0),
            -(weight * x).sum(axis=0),
            -(weight * y).sum(axis=0),
        )

    def _model(self, rows: np.ndarray, near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Light (g, m) and its derivatives (g, TERMS + 3 + 3 k, m)."""
        everyone = np.concatenate([rows[:, None], near], axis=1)
        shadow, by_u, by_v = self._shadow(everyone, self.middle[rows])
        scatter = self.profile.scatter
        plane = self.background[rows] @ self.basis.T
        plane = np.maximum(plane, 1e-3 * np.abs(self.background[rows, :1]) + 1e-6)
        g, k, m = shadow.shape
        jacobian = np.empty((g, TERMS + 3 * k, m))
        if k == 1:
            depth = self.depth[rows, None]
            relative = 1 - (1 - scatter) * np.minimum(depth * shadow[:, 0], 1 - MIN_PASSED)
            by_shadow = (scatter - 1) * plane
            by_place = by_shadow * depth
            np.multiply(by_place, by_u[:, 0], out=jacobian[:, TERMS])
            np.multiply(by_place, by_v[:, 0], out=jacobian[:, TERMS + 1])
            np.multiply(by_shadow, shadow[:, 0], out=jacobian[:, TERMS + 2])
        else:
            there = everyone >= 0
            depth = np.where(there, self.depth[everyone], 0.0)[..., None]
            passed = np.maximum(1 - depth * shadow, MIN_PASSED)
            product = np.prod(passed, axis=1)
            relative = scatter + (1 - scatter) * (product + self.crossing[rows])
            by_shadow = -(1 - scatter) * (plane * product)[:, None] / passed
            by_place = by_shadow * depth
            jacobian[:, TERMS::3] = by_place * by_u
            jacobian[:, TERMS + 1 :: 3] = by_place * by_v
            jacobian[:, TERMS + 2 :: 3] = by_shadow * shadow * there[..., None]
        np.multiply(relative[:, None], self.basis.T, out=jacobian[:, :TERMS])
        return plane * relative, jacobian

    def _step(
        self, rows: np.ndarray, near: np.ndarray, final: bool
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return centres, depths and backgrounds of some markers after a step."""
        light, jacobian = self._model(rows, near)
        residual = self.grey[rows] - light
        valid = self.valid[rows]
        weight = valid / self.noise.variance(light)
        squared = residual * residual * weight
        self.misfit[rows] = squared.sum(axis=1) / np.maximum(valid.sum(axis=1) - OWN, 1)
        if final or near.shape[1]:
            disturbed = self.misfit[rows] > DISTURBED * self.typical()
            if disturbed.any():
                weight = weight / (1 + disturbed[:, None] * squared / ROBUST**2)
        weighted = jacobian * weight[:, None]
        prior = np.zeros(jacobian.shape[:2])
        # The depth of a marker alone tells whether it is one, so it is hardly constrained.
        prior[:, TERMS + 2] = (self.guess.depth_sd[rows] if near.shape[1] else ALONE_SD) ** -2.0
        for number in range(near.shape[1]):
            first = OWN + 3 * number
            # An absent neighbour has no derivatives; any prior keeps its step zero.
            prior[:, first : first + 2] = NEIGHBOUR_SD_PX**-2
            prior[:, first + 2] = NEIGHBOUR_SD**-2
        normal = weighted @ jacobian.swapaxes(1, 2)
        diagonal = np.arange(normal.shape[1])
        normal[:, diagonal, diagonal] += prior + 1e-9 * normal[:, diagonal, diagonal] + 1e-12
        right = (weighted @ residual[..., None])[..., 0]
        right[:, TERMS + 2] -= prior[:, TERMS + 2] * (self.depth[rows] - self.guess.depth[rows])
        if final:
            inverse = np.linalg.inv(normal)
            step = (inverse @ right[..., None])[..., 0]
            variance = 0.5 * (inverse[:, TERMS, TERMS] + inverse[:, TERMS + 1, TERMS + 1])
            self.sigma[rows] = np.sqrt(np.maximum(variance, 0))
            if not near.shape[1]:
                self._inflate(inverse[:, TERMS, None] @ weighted)
        else:
            step = np.linalg.solve(normal, right[..., None])[..., 0]
        move = np.clip(step[:, TERMS : TERMS + 2], -MAX_STEP_PX, MAX_STEP_PX)
        return (
            self.uv[rows] + move,
            np.clip(self.depth[rows] + step[:, TERMS + 2], *DEPTHS),
            self.background[rows] + step[:, :TERMS],
        )

    def _inflate(self, influence: np.ndarray) -> None:
        """Note the factor on variances by the correlation of noise.

        influence (g, 1, m) of the pixels on a centre.
        """
        correlation = self.noise.correlation
        if np.count_nonzero(correlation) < 2:
            return
        half = int(np.abs(self.offset).max())
        image = np.zeros((2 * half + 1, 2 * half + 1))
        image[self.offset[:, 1] + half, self.offset[:, 0] + half] = influence[len(influence) // 2]
        spread = cv2.filter2D(image, cv2.CV_64F, correlation, borderType=cv2.BORDER_CONSTANT)
        self.inflation = max(float((image * spread).sum() / (image * image).sum()), 1.0)

    def _cross(self) -> None:
        """Note what shadows that touch have together, beyond the product of both.

        The blur of the light that passes two markers is not the product of their blurred shadows.
        """
        reach = 2 * (self.profile.radius_px + self.profile.blur_px)
        reach += float(np.abs(self.way).max(initial=0.0)) * 2
        rows = self.crowded[self.distance[self.crowded] < reach]
        if not len(rows):
            return
        self.crossing = np.zeros((len(self.uv), len(self.offset)))
        half = int(np.abs(self.offset).max()) + int(np.ceil(3 * self.profile.blur_px))
        axis = np.arange(-half * FINE, half * FINE + 1) / FINE
        sigma = float(FINE * np.sqrt(self.profile.blur_px**2 + 1 / 12))
        row = (self.offset[:, 1] + half) * FINE
        column = (self.offset[:, 0] + half) * FINE
        for one in rows:
            members = np.concatenate([[one], self.neighbours[one][:NEIGHBOURS]])
            together = np.zeros((len(axis), len(axis)))
            for weight, way in zip(self.way_weight, self.way):
                passed = np.ones_like(together)
                for member in members:
                    u, v = self.uv[member] + way[member] - self.middle[one]
                    squared = (axis[:, None] - v) ** 2 + (axis - u) ** 2
                    passed *= 1 - self.depth[member] * self.profile.absorbed(squared)
                together += weight * passed
            smooth = cv2.GaussianBlur(together, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
            shadow, _, _ = self._shadow(members[None], self.middle[one][None])
            apart = np.prod(1 - self.depth[members][:, None] * shadow[0], axis=0)
            self.crossing[one] = smooth[row, column] - apart

    def typical(self) -> float:
        """Median misfit of the markers in the field."""
        values = self.misfit[self.usable & np.isfinite(self.misfit)]
        return float(np.median(values)) if len(values) else 1.0

    def result(self) -> Beads:
        """Return what was measured."""
        away = np.abs(self.uv - self.guess.uv).max(axis=1, initial=0.0)
        measured = self.usable & np.isfinite(self.uv).all(axis=1) & np.isfinite(self.sigma)
        measured &= away < STEPS * MAX_STEP_PX
        typical = self.typical()
        pixels = self.valid.sum(axis=1)
        # The noise of one window is known to some 10 %; that of all windows helps.
        pooled = (self.misfit * pixels + typical * POOLED) / (pixels + POOLED)
        factor = np.sqrt(np.maximum(pooled, typical) * self.inflation)
        touching = self.distance < 2 * self.profile.radius_px
        factor = np.where(touching, CROSSED * factor, factor)
        overlapped = self.distance < 2 * 0.85 * self.profile.reach_px
        return Beads(
            self.uv, self.sigma * factor, self.depth, self.misfit / typical, overlapped, measured
        )
