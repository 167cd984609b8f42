# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Shadow of a sphere in an image: attenuated and blurred light as a function of the distance.

A ray at a distance d from the centre of a sphere of radius r is attenuated by exp(-2 m sqrt(r^2 -
d^2)) (Beer and Lambert). Focal spot, detector and pixel blur it approximately as a Gaussian;
scattered light adds a part that beads do not attenuate. An unsharp mask adds to the image a
multiple of its difference from a wider blur, which gives shadows a bright border.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

STEP = 0.2  # step of the grid on which a profile is computed [px]
TABLE_STEP = 0.05  # step of the table of a profile [px]
KERNEL_SIGMAS = 5.5  # half width of a Gaussian kernel, at which it is 3e-7
REACH_SIGMAS = 3.2  # standard deviations of the blur beyond the radius at which a shadow ends
MASK_SIGMAS = 2.2  # the same for the blur of an unsharp mask
# Bounds of the parameters of a profile.
LIMITS = {
    'radius_px': (0.5, 40.0),
    'blur_px': (0.35, 6.0),
    'attenuation': (0.05, 6.0),
    'scatter': (0.0, 0.6),
    'sharpening': (0.0, 5.0),
    'mask_px': (1.0, 8.0),
}
SHAPE = ('radius_px', 'blur_px', 'attenuation')  # parameters that are always estimated
PLAIN = (*SHAPE, 'scatter')
MASKED = (*SHAPE, 'sharpening', 'mask_px')
MAX_ABSORBED = float(-np.expm1(-2 * LIMITS['attenuation'][1]))  # share of the direct light
CHANGE = 1.5  # largest factor on parameters in one fit
FREE = ('scatter', 'sharpening')  # parameters that any fit may change by any factor
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
    sharpening: float = 0.0  #: factor of an unsharp mask
    mask_px: float = 0.0  #: standard deviation of its blur

    @property
    def reach_px(self) -> float:
        """Distance from the centre at which the shadow ends [px]."""
        reach = REACH_SIGMAS * self.blur_px
        if self.sharpening:
            reach = max(reach, MASK_SIGMAS * float(np.hypot(self.blur_px, self.mask_px)))
        return self.radius_px + reach

    @property
    def blurs(self) -> tuple[tuple[float, float], ...]:
        """Weights of Gaussians whose sum is the blur, and their standard deviations [px].

        They include the blur of a square pixel, which has a variance of 1/12.
        """
        variance = self.blur_px**2 + 1 / 12
        plain = float(np.sqrt(variance))
        if not self.sharpening:
            return ((1.0, plain),)
        wider = float(np.sqrt(variance + self.mask_px**2))
        return (1 + self.sharpening, plain), (-self.sharpening, wider)

    @cached_property
    def drawn_px2(self) -> tuple[float, float]:
        """How far blur and mask draw a shadow towards less light, per relative slope of the light.

        A Gaussian shifts what it blurs by its variance [px^2], see `Background.slope`. That of a
        mask shifts only its part of the shadow: the shift of the whole is the projection of that
        part's change on the derivative of the shadow.
        """
        tables = _tables_of_blurs(self)
        by_distance = np.sum(tables, axis=0)[1]
        variance = self.blurs[0][1] ** 2
        change = sum(
            ((sigma**2 - variance) * table[1] for (_, sigma), table in zip(self.blurs, tables)),
            start=np.zeros_like(by_distance),
        )
        weight = np.arange(len(by_distance)) * by_distance
        return variance, float(weight @ change / (weight @ by_distance))

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
        return replace(self, radius_px=self.radius_px * size, attenuation=attenuation)

    def with_scatter(self, scatter: float) -> Profile:
        """Return a profile with another share of scattered light and an equally dark middle."""
        absorbed = (1 - self.scatter) * -np.expm1(-2 * self.attenuation)
        direct = min(absorbed / (1 - scatter), MAX_ABSORBED)
        return replace(self, attenuation=float(-0.5 * np.log1p(-direct)), scatter=scatter)

    def in_light(self, factor: float) -> Profile:
        """Return the profile of an equally dark shadow if there is more light by a factor."""
        absorbed = (1 - self.scatter) * -np.expm1(-2 * self.attenuation) / factor
        direct = min(absorbed, MAX_ABSORBED)
        return replace(self, attenuation=float(-0.5 * np.log1p(-direct)), scatter=0.0)

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
        tables = [np.sum(_tables_of_blurs(one), axis=0) for one in profiles]
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

    def __init__(self, profile: Profile, sigma: float) -> None:
        self._parts = max(1, int(min(STEP, profile.radius_px / 4) / TABLE_STEP))
        step = self._parts * TABLE_STEP
        # Only the row through the centre is needed: all columns are weighted to one row, which is
        # blurred along itself.
        self.sigma = sigma
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


def _tables_of_blurs(profile: Profile) -> list[NDArray[np.float64]]:
    """Return shares and derivatives (2, n) at multiples of TABLE_STEP, for each Gaussian."""
    tables = []
    for weight, sigma in profile.blurs:
        blurred = _Blurred(profile, sigma)
        row = blurred.row(profile.absorbed(blurred.squared))
        tables.append(weight * np.stack([blurred.table(row), blurred.table(row, 1)]))
    return tables


def shadow_derivatives(
    profile: Profile, distance: NDArray[np.float64]
) -> dict[str, NDArray[np.float64]]:
    """Return derivatives (n,) of absorbed shares at distances (n,) [px] by all but the scatter.

    A wider blur is a diffused narrower blur, dS/dsigma = sigma (S_xx + S_yy), and a larger bead is
    a scaled bead.
    """
    out = {name: np.zeros(len(distance)) for name in MASKED}
    for number, (weight, sigma) in enumerate(profile.blurs):
        blurred = _Blurred(profile, sigma)
        absorbed = profile.absorbed(blurred.squared)
        row = blurred.row(absorbed)
        laplacian = blurred.table(row, 2) + blurred.table(blurred.row(absorbed, 2))
        scaled = blurred.distance * blurred.table(row, 1) + sigma**2 * laplacian
        more = profile.chord(blurred.squared) * (1 - absorbed)
        tables = {
            'radius_px': -weight * scaled / profile.radius_px,
            'blur_px': weight * profile.blur_px * laplacian,
            'attenuation': weight * blurred.table(blurred.row(more)),
            'sharpening': (1.0, -1.0)[number] * blurred.table(row),
            'mask_px': weight * number * profile.mask_px * laplacian,
        }
        for name, table in tables.items():
            out[name] += np.interp(distance, blurred.distance, table)
    return out


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

    def residual(self, profile: Profile) -> NDArray[np.float64]:
        """Return weighted residuals (n,) for the profile of a bead of size 1."""
        value, _ = profile.sized(self.size).shadow(self.distance)
        return self.root * ((1 - profile.scatter * self.around) * value - self.share)

    def slopes(self, profile: Profile, names: Sequence[str]) -> NDArray[np.float64]:
        """Return derivatives (n, k) of the residuals by parameters of the profile."""
        sized = profile.sized(self.size)
        direct = 1 - profile.scatter * self.around
        by = {name: direct * one for name, one in shadow_derivatives(sized, self.distance).items()}
        by['radius_px'] *= self.size
        by['attenuation'] *= self.size
        by['scatter'] = -self.around * sized.shadow(self.distance)[0]
        return self.root[:, None] * np.column_stack([by[name] for name in names])


def fit_profile(absorbed: Absorbed, start: Profile, estimated: Sequence[str] = PLAIN) -> Profile:
    """Fit the profile of a bead of size 1 to the light absorbed by beads.

    estimated: names of the parameters that are estimated; the others are those of the start.
    """
    parts = list(absorbed.binned(start))
    low, high = np.transpose([LIMITS[name] for name in estimated])
    first = np.array([getattr(start, name) for name in estimated])
    first = np.clip(first, low * 1.01 + 1e-3, high * 0.99)
    # The backgrounds were estimated with the previous profile.
    change = np.array([np.inf if name in FREE else CHANGE for name in estimated])
    bounds = np.maximum(low, first / change), np.minimum(high, first * change)

    def profile(values: NDArray[np.float64]) -> Profile:
        return replace(start, **dict(zip(estimated, values.tolist())))

    # Few evaluations: `absorbed` is updated with each profile, and the radius and attenuation of a
    # small shadow are hardly separable.
    found = least_squares(
        lambda x: np.concatenate([part.residual(profile(x)) for part in parts]),
        first,
        jac=lambda x: np.concatenate([part.slopes(profile(x), estimated) for part in parts]),
        bounds=bounds,
        x_scale=first,
        max_nfev=5,
    )
    return profile(found.x)
