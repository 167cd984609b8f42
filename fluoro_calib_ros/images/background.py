# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Light of windows without beads: direct light, and scattered light that is not attenuated.

Plates and bones attenuate direct light exponentially, so its logarithm is a polynomial. Scattered
light comes from wide surroundings and is constant in a window.

Where nearly all of the light around a bead is clipped, only the inside of its shadow is left, in
which a slope of the light looks much like a shift of the shadow. Slopes and curvatures then have a
prior, which is estimated from all windows of the image. They are as large as each other: in light
whose power decreases with the cube of the frequency, like that of the cosines, their standard
deviations in a round window differ by less than 15 %.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .texture import DTYPE

TERMS = 6  # terms of the background, a polynomial of degree 2
PLANE_TERMS = 3  # those of degree 1
MIN_DIRECT = 0.1  # least share of direct light in the light around a bead
DARK = 1e-3  # grey value below which light cannot be distinguished from none
LARGE = 0.1  # relative change of direct light that differs from that of its logarithm
HELD = 1e12  # prior weight that keeps a term at zero
MAX_FACTOR = 20.0  # largest factor on the direct light in a step
# Iterations after which the spread of terms has converged if half of the windows determine them to
# it; if none does, the spread is still up to 1.5 times too large.
EM_STEPS = 50
# Degrees of freedom of Student's distribution of the terms: edges of bones and plates cross few
# windows. In 20 renderings of either that were over-exposed, results with 2 were the same; with a
# normal distribution, 3 % fewer beads before bone had standard deviations below MAX_SIGMA_PX.
FREEDOM = 4.0
START_SPREAD = 0.3  # initial standard deviation of the terms; EM reaches smaller ones from it
MIN_SPREAD = 1e-3  # least one


class Background:
    """Light without beads in windows (n,) of pixels offset (m, 2), of radius window_px."""

    def __init__(self, count: int, offset: NDArray[np.int64], window_px: float) -> None:
        self.window_px = window_px
        x, y = (offset.T / window_px).astype(DTYPE)
        self.basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
        self.terms = np.zeros((count, TERMS))  # those of the logarithm of the direct light
        #: (n,), light of the surroundings
        self.around: NDArray[np.floating] = np.zeros(count)
        self.scatter = 0.0  # share of scattered light, relative to that of the surroundings
        self.plane_only = False  # whether the polynomial is of degree 1
        # Prior standard deviations (n, 1) of the terms but the constant one.
        self.spread = np.full((count, 1), np.inf)

    def start(
        self, light: NDArray[np.floating], around: NDArray[np.floating] | None, scatter: float
    ) -> None:
        """Set constant light (n,); around: that of the surroundings (n,), None if it is the same.

        scatter: share of scattered light.
        """
        self.scatter = scatter
        light = np.maximum(light, DARK)
        self.around = light if around is None else np.maximum(around, DARK)
        if scatter:
            self.around = np.minimum(self.around, (1 - MIN_DIRECT) / scatter * light)
        self.terms[:, 0] = np.log(light - scatter * self.around)

    def direct(self, rows: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return the direct light (g, m) in windows."""
        return np.asarray(np.exp(self.terms[rows].astype(DTYPE) @ self.basis.T))

    def scattered(self, rows: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return the scattered light (g, 1) in windows."""
        return DTYPE(self.scatter) * self.around[rows, None].astype(DTYPE)

    @property
    def light(self) -> NDArray[np.float64]:
        """Light (n,) in the middle of windows."""
        return np.asarray(np.exp(self.terms[:, 0]) + self.scatter * self.around)

    def derivatives(
        self, rows: NDArray[np.int64], passed: NDArray[np.floating]
    ) -> NDArray[np.float32]:
        """Return derivatives (g, m) of the light by the constant term; times basis by all terms.

        passed: (g, m) direct light behind beads. The unit of a term is the direct light in the
        middle of the window.
        """
        return np.asarray(passed * np.exp(-self.terms[rows, :1]).astype(DTYPE))

    def unit(self, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the unit (g, 1) of steps of the terms."""
        return np.asarray(np.exp(self.terms[rows, :1]))

    def in_steps(self, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the terms (g, TERMS - 1) but the constant one in the unit of their steps."""
        return self.terms[rows, 1:] * self.unit(rows)

    def prior(self, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the prior weights (g, TERMS) of steps of the terms; their mean is zero."""
        prior = np.zeros((len(rows), TERMS))
        prior[:, 1:] = (self.spread[rows] * self.unit(rows)) ** -2
        if self.plane_only:
            prior[:, PLANE_TERMS:] = HELD
        return prior

    def relative(
        self, rows: NDArray[np.int64], light: NDArray[np.floating]
    ) -> NDArray[np.floating]:
        """Return light (g, m) as a fraction of that without beads."""
        return light / (self.direct(rows) + self.scattered(rows))

    def changed(self, rows: NDArray[np.int64], step: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return terms (g, TERMS) after a step of the direct light."""
        change = step * np.exp(-self.terms[rows, :1])
        large = np.flatnonzero(np.abs(change).max(axis=1, initial=0.0) > LARGE)
        if len(large):
            # A change of the light by a large factor is not the same change of its logarithm.
            factor = np.maximum(1 + change[large].astype(DTYPE) @ self.basis.T, 1 / MAX_FACTOR)
            terms = len(self._of_terms)
            change[large, :terms] = np.log(np.minimum(factor, MAX_FACTOR)) @ self._of_terms.T
        return self.terms[rows] + change

    @cached_property
    def _of_terms(self) -> NDArray[np.float32]:
        """Matrix (t, m) that fits the terms that are estimated to the pixels of a window."""
        return np.linalg.pinv(self.basis[:, :PLANE_TERMS] if self.plane_only else self.basis)

    def steepest(self, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return directions (g,) in which the light of windows changes most [rad].

        They are the principal axes of the gradient's second moments in a window (Foerstner and
        Guelch, Intercommission Conference on Fast Processing of Photogrammetric Data, 1987).
        """
        _, by_x, by_y, by_xx, by_xy, by_yy = self.terms[rows].T
        u = np.stack([by_x, by_xx, 0.5 * by_xy])
        v = np.stack([by_y, 0.5 * by_xy, by_yy])
        # The gradient is (u0 + 2 u1 x + 2 u2 y, ...); x^2 and y^2 have a mean of 1/4 in a circle.
        return np.asarray(0.5 * np.arctan2(2 * (u * v).sum(axis=0), (u * u - v * v).sum(axis=0)))

    def slope(self, place: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the relative slopes (n, 2) of the direct light at centres [1/px].

        place: (n, 2), centres relative to the middle of their windows [px]. If direct light is
        proportional to exp(g x), a shadow that a Gaussian of variance s^2 blurs with it appears at
        x - g s^2 (complete the square in the convolution).
        """
        x, y = place.T / self.window_px
        _, by_x, by_y, by_xx, by_xy, by_yy = self.terms.T
        gradient = by_x + 2 * by_xx * x + by_xy * y, by_y + by_xy * x + 2 * by_yy * y
        return np.column_stack(gradient) / self.window_px


class HiddenLight:
    """Spread of the terms of backgrounds (n, TERMS), but for the constant one, in an image.

    It is estimated from the normal equations of all windows by expectation-maximisation (Dempster,
    Laird and Rubin, J. R. Stat. Soc. B 39, 1977). The terms have Student's distribution, a normal
    one of which each window has its own width (Lange, Little and Taylor, J. Am. Stat. Assoc. 84,
    1989).
    """

    def __init__(self, count: int) -> None:
        self._normal = np.zeros((count, TERMS - 1, TERMS - 1))
        self._right = np.zeros((count, TERMS - 1))

    def note(
        self,
        rows: NDArray[np.int64],
        normal: NDArray[np.float64],
        right: NDArray[np.float64],
        background: Background,
    ) -> None:
        """Note what normal equations (g, u, u), (g, u) of windows tell about their terms."""
        terms = np.arange(1, TERMS)
        others = np.delete(np.arange(normal.shape[1]), terms)
        cross = normal[:, others[:, None], terms]
        columns = np.concatenate([cross, right[:, others, None]], axis=2)
        eliminated = np.linalg.solve(normal[:, others[:, None], others], columns)
        eliminated = np.swapaxes(cross, 1, 2) @ eliminated
        prior = background.prior(rows)[:, 1:]
        own = normal[:, terms[:, None], terms] - eliminated[:, :, :-1]
        own[:, terms - 1, terms - 1] -= prior
        unit = background.unit(rows)
        step = right[:, terms] - eliminated[:, :, -1] + prior * background.in_steps(rows)
        self._normal[rows] = own * unit[:, None] ** 2
        self._right[rows] = (step * unit) + (
            self._normal[rows] @ background.terms[rows, 1:, None]
        )[..., 0]

    def spread(self, usable: NDArray[np.bool_], lack: float) -> NDArray[np.float64]:
        """Return standard deviations (n, 1) of the terms of windows (n,).

        lack: typical lack of fit, the factor on the variance of the noise.
        """
        noted = usable & (np.trace(self._normal, axis1=1, axis2=2) > 0)
        normal = self._normal[noted] / lack
        right = self._right[noted] / lack
        terms = TERMS - 1
        variance = START_SPREAD**2
        wider = np.ones(len(normal))
        for _ in range(EM_STEPS if noted.any() else 0):
            covariance = np.linalg.inv(normal + np.eye(terms) / (variance * wider)[:, None, None])
            mean = (covariance @ right[..., None])[..., 0]
            square = (mean**2).sum(axis=1) + np.trace(covariance, axis1=1, axis2=2)
            wider = (FREEDOM + square / variance) / (FREEDOM + terms)
            variance = max(float((square / wider).mean() / terms), MIN_SPREAD**2)
        # The normal equations of windows have the noise without that factor.
        spread = np.full((len(usable), 1), np.sqrt(variance / lack))
        spread[noted, 0] *= np.sqrt(wider)
        return spread
