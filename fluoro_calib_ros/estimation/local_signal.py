# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Places where the signal of a distortion has a larger variance than elsewhere.

A dent of the input screen or the seam of two fibre plates is no stationary field: one covariance
function for the whole image follows it too little there, and follows noise elsewhere. Places are
square windows, or bands along straight lines, with Gaussian bumps whose heights have their own
variance. The bumps are written as sums of the sines of the series, so that a place changes only
the prior of their coefficients.

A window is added where it raises the marginal likelihood clearly. Windows next to it are then
added where they raise the likelihood at all, because an edge continues. A low edge, which no
single window shows, is found by the band along it. The gain of one more component of a covariance
is known exactly without a new solution (Tipping and Faul, "Fast marginal likelihood maximisation
for sparse Bayesian models", 2003; here for the bumps of a place together). Variances are updated
as in MacKay, "Bayesian interpolation", Neural Computation 4, 1992.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from ..correction.series import Functions
from .signal import MIN_DETERMINED, correlation_of

NODES = 32  # bumps along the longer side of the image
WIDTH = 0.75 / NODES  # standard deviation of a bump, relative to the longer side of the image
WINDOWS = 8  # windows along the longer side of the image; they overlap by half
# Bands: BAND is half their width and the distance to the next one [bumps]; LIKELY_BANDS is the
# number of bands whose gain is computed. A band has at least as many bumps as a side. There are
# NODES directions: from one to the next, the end of a line moves by half the width of a band.
BAND = 1.5
LIKELY_BANDS = 8
# Least gain of the logarithm of the likelihood for which a place is added: anywhere, where chance
# exceeds it in one of twenty images, and next to places that are there already.
MIN_GAIN = 6.0
MIN_GAIN_BESIDE = 1.5
VARIANCES = np.geomspace(1e-3, 30.0, 40)  # variances of the heights to try [px^2]
MIN_VARIANCE = 2e-4  # windows with a smaller variance are removed [px^2]


@dataclass(frozen=True)
class LocalSignal:
    """Bumps of the windows and bands where the signal has a larger variance."""

    nodes: NDArray[np.float64]  #: (n, 2) centres of the bumps [px]
    window: NDArray[np.int64]  #: (n,) window or band of each bump
    #: (w,) variance of the bump heights of each window or band [px^2], the same for u and v
    variances: NDArray[np.float64]

    @property
    def of_bumps(self) -> NDArray[np.float64]:
        """Variances (n,) of the heights of the bumps [px^2]."""
        return self.variances[self.window]

    def variance_beyond(
        self, functions: Functions, uv: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return variances (n,) [px^2] at pixels uv (n, 2) of what the sines of a series omit."""
        width = WIDTH * max(functions.image_size)
        squares = np.sum((uv[:, None] - self.nodes[None]) ** 2, axis=2)
        variance = np.exp(-squares / width**2) @ self.of_bumps
        return variance * np.exp(-((functions.highest * width) ** 2))

    def change(self, other: LocalSignal | None) -> float:
        """Return the mean change of the log variances; infinite if the windows differ."""
        if other is None or len(other.variances) != len(self.variances):
            return np.inf
        return float(np.mean(np.abs(np.log(self.variances / other.variances))))

    def renewed(
        self, mean: NDArray[np.float64], variance: NDArray[np.float64]
    ) -> LocalSignal | None:
        """Return the windows with more likely variances; omit those that have vanished.

        mean, variance (2, n): of the heights [px], [px^2]. None: all windows have vanished.
        """
        count = len(self.variances)
        squares = np.bincount(self.window, np.sum(mean**2, axis=0), count)
        determined = np.sum(1 - variance / self.of_bumps, axis=0)
        determined = np.bincount(self.window, determined, count)
        variances = squares / np.maximum(determined, MIN_DETERMINED)
        has_variance = variances > MIN_VARIANCE
        if not has_variance.any():
            return None
        retained = has_variance[self.window]
        number = np.cumsum(has_variance) - 1
        return LocalSignal(
            self.nodes[retained], number[self.window[retained]], variances[has_variance]
        )


@dataclass(frozen=True)
class SineEstimates:
    """Information of the image points on the coefficients of the sines of u and of v.

    K is the prior covariance matrix of the coefficients of one coordinate.
    """

    pull: NDArray[np.float64]  #: (s, 2) K^-1 times the estimates
    #: (k, s, s) K^-1 - K^-1 C K^-1 with the covariance C of the estimates: for u and v, or one for
    #: both
    evidence: NDArray[np.float64]

    @classmethod
    def of(
        cls,
        precision: NDArray[np.float64],
        mean: NDArray[np.float64],
        covariances: NDArray[np.float64],
    ) -> SineEstimates:
        """Return them from K^-1 (s, s), estimates (s, 2) and covariances (k, s, s)."""
        diagonal = np.diagonal(precision)
        if np.count_nonzero(precision) == len(diagonal):  # the same, without products with zero
            evidence = precision - covariances * diagonal[:, None] * diagonal
        else:
            evidence = precision - precision @ covariances @ precision
        return cls(precision @ mean, evidence)


def bumps(functions: Functions, nodes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return coefficients (s, n) of the sines for bumps of height one about nodes (n, 2) [px].

    A sine is an eigenfunction of the convolution with a Gaussian.
    """
    width = WIDTH * max(functions.image_size)
    damped = 2 * np.pi * width**2 * np.exp(-((functions.frequency * width) ** 2) / 2)
    return functions(nodes)[:, functions.trend :].T * damped[:, None]


def correlation_beyond(functions: Functions, distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the correlation (n,), at distances (n,) [px], of what the sines omit of the bumps."""
    width = WIDTH * max(functions.image_size)
    return correlation_of(lambda f: np.exp(-((f * width) ** 2)), functions.highest, distance)


def with_likely_places(
    functions: Functions, estimates: SineEstimates, local: LocalSignal | None
) -> LocalSignal | None:
    """Add the windows and bands that raise the marginal likelihood.

    estimates: with the present places, local. Returns local if there are no more places.
    """
    shown_bumps = _ShownBumps.of(functions, estimates)
    taken = np.zeros(len(shown_bumps.nodes), dtype=bool)
    if local is not None:
        taken = (np.abs(shown_bumps.nodes[:, None] - local.nodes[None]).max(axis=2) < 1).any(
            axis=1
        )
    windows = shown_bumps.windows()
    band = shown_bumps.most_likely_band(taken)
    if band is not None and band.gain > max(MIN_GAIN, *(place.gain for place in windows)):
        # The gains of the windows change with this band in the prior, and are computed next time.
        return _joined(local, shown_bumps.nodes[band.rows], band.variance)
    out = local
    reach = 1.01 * max(functions.image_size) / NODES
    for place in sorted(windows, key=lambda window: -window.gain):
        if place.gain < MIN_GAIN_BESIDE:
            break
        nodes = shown_bumps.nodes[place.rows]
        if taken[place.rows].any():
            continue
        if place.gain < MIN_GAIN and not _is_beside(nodes, shown_bumps.nodes[taken], reach):
            continue
        taken[place.rows] = True
        out = _joined(out, nodes, place.variance)
    return out


def largest_gain(functions: Functions, estimates: SineEstimates) -> float:
    """Return the largest gain of the logarithm of the likelihood by one more window or band."""
    shown_bumps = _ShownBumps.of(functions, estimates)
    places = shown_bumps.windows()
    band = shown_bumps.most_likely_band(np.zeros(len(shown_bumps.nodes), dtype=bool))
    return max(place.gain for place in (*places, *([] if band is None else [band])))


@dataclass(frozen=True)
class _Place:
    """Bumps with a common variance.

    rows (b,): of the bumps; gain: of the log likelihood; variance: most likely [px^2].
    """

    rows: NDArray[np.int64]
    gain: float
    variance: float


@dataclass(frozen=True)
class _ShownBumps:
    """Information of the image points on all bumps that an image may have."""

    image_size: tuple[int, int]
    nodes: NDArray[np.float64]  #: (n, 2) [px]
    pulls: NDArray[np.float64]  #: (n, 2) q of Tipping and Faul 2003
    base: NDArray[np.float64]  #: (n, s) coefficients of the sines for each bump
    #: (k, n, s) these coefficients times the evidence, for u and v or one for both
    evidence: NDArray[np.float64]

    @classmethod
    def of(cls, functions: Functions, estimates: SineEstimates) -> _ShownBumps:
        """Return the information on the bumps from that on the sines."""
        nodes = _all_nodes(functions.image_size)
        base = bumps(functions, nodes).T
        pulls = base @ estimates.pull
        return cls(functions.image_size, nodes, pulls, base, base @ estimates.evidence)

    def windows(self) -> list[_Place]:
        """Return all windows."""
        return self._places(_windows(self.image_size))

    def most_likely_band(self, used: NDArray[np.bool_]) -> _Place | None:
        """Return the band with the largest gain, without the used bumps (n,).

        Only the bands whose single bumps are least likely to be zero are examined.
        """
        level = np.sum(self.base * self.evidence, axis=2).T
        squares = self.pulls**2
        # A bump has level zero if no image point shows it.
        ratio = np.divide(squares, level, out=np.zeros_like(squares), where=level > 0)
        excess = np.sum(ratio - 1, axis=1)
        bands = _bands(self.image_size)
        number = bands @ ~used
        score = (bands @ np.where(used, 0.0, excess)) / np.sqrt(np.maximum(number, 1))
        score[number < NODES] = -np.inf
        best = np.argsort(score)[-LIKELY_BANDS:]
        likely = bands[best[score[best] > -np.inf]]
        candidates = self._places([np.flatnonzero((band > 0) & ~used) for band in likely])
        return max(candidates, key=lambda band: band.gain, default=None)

    def _places(self, rows: Iterable[NDArray[np.int64]]) -> list[_Place]:
        """Return the places with these bumps (b,), computing those of the same number at once."""
        out = []
        for _, same in groupby(sorted(rows, key=len), len):
            chosen = np.stack(list(same))
            products = self.base[chosen] @ np.swapaxes(self.evidence[:, chosen], 2, 3)
            gain, variance = _largest_gains(self.pulls[chosen], products)
            out += [_Place(*place) for place in zip(chosen, gain.tolist(), variance.tolist())]
        return out


def _all_nodes(image_size: tuple[int, int]) -> NDArray[np.float64]:
    """Return the centres (n, 2) [px] of the bumps that an image may have."""
    spacing = max(image_size) / NODES
    u, v = ((np.arange(max(1, round(size / spacing))) + 0.5) * spacing for size in image_size)
    return np.stack(np.meshgrid(u, v, indexing='ij'), axis=-1).reshape(-1, 2)


@lru_cache(maxsize=4)
def _windows(image_size: tuple[int, int]) -> tuple[NDArray[np.int64], ...]:
    """Return the rows of the nodes of each window."""
    nodes = _all_nodes(image_size)
    size = max(image_size) / WINDOWS
    count = [max(1, int(np.ceil(2 * side / size)) - 1) for side in image_size]
    corners = np.array(list(np.ndindex(*count))) * size / 2
    inside = ((nodes >= corners[:, None]) & (nodes < corners[:, None] + size)).all(axis=2)
    return tuple(np.flatnonzero(mask) for mask in np.asarray(inside) if np.any(mask))


@lru_cache(maxsize=4)
def _bands(image_size: tuple[int, int]) -> NDArray[np.float64]:
    """Return ones (b, n) for the bumps within BAND of each of many lines across the image."""
    nodes = _all_nodes(image_size)
    half = BAND * max(image_size) / NODES
    out = []
    for angle in np.arange(NODES) * np.pi / NODES:
        distance = nodes @ [np.cos(angle), np.sin(angle)]
        lines = np.arange(distance.min(), distance.max() + half, half)
        out.append(np.abs(distance - lines[:, None]) <= half)
    return np.concatenate(out).astype(float)


def _largest_gains(
    pulls: NDArray[np.float64], products: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the largest gains (w,) of the log likelihood by one more place, and its variances.

    pulls (w, b, 2) and products (k, w, b, b), for u and v or one for both: q and s of Tipping and
    Faul 2003 for the b bumps of each place.
    """
    level, vectors = np.linalg.eigh(products)
    turned = np.swapaxes(vectors, 2, 3) @ np.moveaxis(pulls, 2, 0)[..., None]
    level = np.maximum(level, 0)
    gains = np.empty((len(VARIANCES), len(pulls)))
    for number, variance in enumerate(VARIANCES):
        grown = variance * level
        explained = variance * turned[..., 0] ** 2 / (1 + grown)
        gains[number] = np.sum(explained - np.log1p(grown), axis=(0, 2)) / 2
    best = np.argmax(gains, axis=0)
    return gains[best, np.arange(len(best))], VARIANCES[best]


def _is_beside(nodes: NDArray[np.float64], others: NDArray[np.float64], reach: float) -> bool:
    """Whether some of the nodes (b, 2) are within reach [px] of others (n, 2)."""
    distance = np.abs(nodes[:, None] - others[None]).max(axis=2)
    return bool(np.min(distance, initial=np.inf) < reach)


def _joined(local: LocalSignal | None, nodes: NDArray[np.float64], variance: float) -> LocalSignal:
    """Return the places with one more, of nodes (b, 2)."""
    if local is None:
        return LocalSignal(nodes, np.zeros(len(nodes), dtype=int), np.array([variance]))
    window = np.full(len(nodes), len(local.variances))
    return replace(
        local,
        nodes=np.concatenate([local.nodes, nodes]),
        window=np.concatenate([local.window, window]),
        variances=np.append(local.variances, variance),
    )
