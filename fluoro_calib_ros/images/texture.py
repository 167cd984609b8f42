# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Backgrounds of windows beyond a polynomial: cosines, and straight edges.

Bones, plates and collimators are behind beads. What a polynomial does not fit of them is a sum of
cosines with normally distributed coefficients, which is eliminated from the normal equations of a
window. Its strength is estimated for each window by its likelihood.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.special import expit, logit, logsumexp, softmax

from ..rows import joined_rows
from .light import POLYNOMIAL

DTYPE = np.float32  # type of models and derivatives
HIGHEST = 9  # highest number of half waves across a window
# Principal components of the background beyond a polynomial that are used to estimate its
# strength: they contain 0.9 of its variance.
TELLING = 26
EXPONENT = 3.0
# Variance of the waves across a straight edge, relative to that of other waves of their length. In
# eight renderings with plates, errors were the same to 2 % with 10 to 300; the larger, the smaller
# were their standard deviations.
EDGE = 10.0
# Ratios of the variance of the background to that of the noise that are compared, and those at
# which the likelihood is computed. It is interpolated between them: it is wider than their steps,
# for 20 cosines determine the strength to a factor of 1.4.
STEP = 4.0
COMPUTED = np.arange(-2.0, 7.0)  # powers of STEP
COMPARED = np.arange(-2, 6.1, 0.25)
RATIOS = STEP**COMPARED
BETWEEN = make_interp_spline(COMPUTED, np.eye(len(COMPUTED)))(COMPARED)
ROUNDS = 3  # iterations over the strengths and the factor on the noise
EM_STEPS = 30  # iterations after which the share of windows has converged to 0.01
# Directions across edges, 7.5 degrees apart: at the border of a window, an edge is then off by
# less than its blur. The light changes most in that of an edge: if the likeliest of all directions
# was taken, errors in renderings with plates were 6 to 11 % larger. NO_EDGE: there is no edge.
DIRECTIONS = 24
NO_EDGE = -1
Mask = tuple[float, float]  # factor of an unsharp mask, and standard deviation of its blur [px]
NO_MASK = 0.0, 0.0


# Derivatives (g, u, m) of the light in windows; its share that passes the beads, its weights and
# residuals (g, m).
Part = tuple[
    NDArray[np.floating], NDArray[np.floating], NDArray[np.floating], NDArray[np.floating]
]


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
def _cosines_in(squared_px: int, across: int, mask: Mask) -> Cosines:
    """Return the waves in a round window; squared_px: square of its radius."""
    angle = None if across == NO_EDGE else across * np.pi / DIRECTIONS
    return Cosines(window_offsets(float(np.sqrt(squared_px + 0.5))), DTYPE, angle, mask)


class Cosines:
    """Cosines on the pixels of a window, and their variances.

    offset: (m, 2) pixels relative to the middle of the window. across: direction across a straight
    edge [rad], in which the background changes more; None for a background without an edge. mask:
    unsharp mask of the image, which amplifies short waves.
    """

    def __init__(
        self,
        offset: NDArray[np.int64],
        dtype: type[np.floating],
        across: float | None = None,
        mask: Mask = NO_MASK,
    ) -> None:
        half = float(np.abs(offset).max()) + 0.5
        angle = across or 0.0
        turned = offset @ [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        x, y = (turned.T + half) * (np.pi / (2 * half))
        along_x, along_y = (np.cos(np.outer(np.arange(2 * HIGHEST + 1), one)) for one in (x, y))
        number = np.array(
            [
                (i, j)
                for i, j in product(range(HIGHEST + 1), repeat=2)
                if 0 < i * i + j * j <= HIGHEST**2
            ]
        )
        if across is not None:
            number = np.concatenate(
                [number, [(i, 0) for i in range(HIGHEST + 1, 2 * HIGHEST + 1)]]
            )
        self.waves = (along_x[number[:, 0]] * along_y[number[:, 1]]).astype(dtype)
        squared = np.sum(number**2, axis=1)
        factor, mask_px = mask
        wider = np.exp(-0.5 * squared * (np.pi * mask_px / (2 * half)) ** 2)
        power = squared ** (-EXPONENT / 2) * (1 + factor * (1 - wider)) ** 2
        if across is not None:
            power[number[:, 1] == 0] *= EDGE
        # Scaled so that a background of unit strength has unit variance at a pixel.
        self.variance = power / (power @ np.mean(self.waves**2, axis=1))
        polynomial, _ = np.linalg.qr(np.stack([x**i * y**j for i, j in POLYNOMIAL], axis=1))
        remaining_waves = np.sqrt(self.variance)[:, None] * self.waves
        remaining_waves -= (remaining_waves @ polynomial) @ polynomial.T
        _, vectors = np.linalg.eigh(remaining_waves @ remaining_waves.T)
        self.telling = (vectors[:, -TELLING:].T @ remaining_waves).astype(dtype)

    def spectra(
        self,
        relative: NDArray[np.floating],
        jacobian: NDArray[np.floating],
        weight: NDArray[np.floating],
        residual: NDArray[np.floating],
    ) -> Spectra:
        """Project the residuals of windows on the components that determine the strength.

        relative: (g, m) light behind the beads, as a fraction of that without them. jacobian: (g,
        u, m) derivatives of the light with respect to the unknowns that are estimated with it.
        weight, residual: (g, m).
        """
        unknowns = jacobian.shape[1]
        root = np.sqrt(weight)
        shape = (len(jacobian), unknowns + len(self.telling) + 1, jacobian.shape[2])
        stacked = np.empty(shape)
        np.multiply(jacobian, root[:, None], out=stacked[:, :unknowns])
        np.multiply((relative * root)[:, None], self.telling, out=stacked[:, unknowns:-1])
        np.multiply(residual, root, out=stacked[:, -1])
        products = stacked @ np.swapaxes(stacked, 1, 2)
        normal = products[:, :unknowns, :unknowns]
        diagonal = np.arange(unknowns)
        normal[:, diagonal, diagonal] *= 1 + 1e-9
        normal[:, diagonal, diagonal] += 1e-12
        cross = products[:, :unknowns, unknowns:]
        explained = np.swapaxes(cross, 1, 2) @ (np.linalg.inv(normal) @ cross)
        reduced = products[:, unknowns:, unknowns:] - explained
        seen = np.count_nonzero(weight, axis=1)
        noise = np.maximum(seen, 1) / np.maximum(np.sum(weight, axis=1), 1e-12)
        reduced[:, :-1] *= np.sqrt(noise)[:, None, None]
        reduced[:, :, :-1] *= np.sqrt(noise)[:, None, None]
        freedom = np.maximum(seen - unknowns, 1)
        return Spectra(reduced, freedom, noise)

    def eliminated(
        self,
        strength: NDArray[np.float64],
        relative: NDArray[np.float32],
        jacobian: NDArray[np.float32],
        weight: NDArray[np.floating],
        residual: NDArray[np.float32],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return the terms to subtract from normal matrices, right sides and squared sums.

        strength (g,) is positive; the other arguments are those of `spectra`.
        """
        weighted, inner = self._normal(strength, relative, weight)
        stacked = np.concatenate([jacobian, residual[:, None].astype(jacobian.dtype)], axis=1)
        cross = (weighted @ np.swapaxes(stacked, 1, 2)).astype(float)
        explained = np.swapaxes(cross, 1, 2) @ np.linalg.solve(inner, cross)
        return explained[:, :-1, :-1], explained[:, :-1, -1], explained[:, -1, -1]

    def expected(
        self,
        strength: NDArray[np.float64],
        relative: NDArray[np.float32],
        weight: NDArray[np.floating],
        residual: NDArray[np.float32],
    ) -> NDArray[np.float64]:
        """Return the expected backgrounds (g, m); the arguments are those of `eliminated`."""
        weighted, inner = self._normal(strength, relative, weight)
        right = (weighted @ residual[..., None]).astype(float)
        return np.asarray(np.linalg.solve(inner, right)[..., 0] @ self.waves)

    def _normal(
        self,
        strength: NDArray[np.float64],
        relative: NDArray[np.float32],
        weight: NDArray[np.floating],
    ) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """Return weighted waves (g, k, m), and the normal matrices (g, k, k) of coefficients."""
        waves = relative[:, None] * self.waves
        weighted = waves * weight.astype(waves.dtype)[:, None]
        inner = (weighted @ np.swapaxes(waves, 1, 2)).astype(float)
        diagonal = np.arange(len(self.variance))
        inner[:, diagonal, diagonal] += 1 / (strength[:, None] * self.variance)
        return weighted, inner


@dataclass(frozen=True)
class Strengths:
    """Strengths of the backgrounds of windows (g,)."""

    variance: NDArray[np.float64]  #: (g,), variances of the backgrounds, 0 for none
    evidence: NDArray[np.float64]  #: (g,), log-evidence for a background
    scale: float  #: factor on the noise


@dataclass(frozen=True)
class Spectra:
    """Residuals of windows (g,), projected on the components of the background."""

    #: (g, k + 1, k + 1), normal matrix of k components in units of the noise, bordered by the
    #: right side and the squared sum of the residuals
    products: NDArray[np.float64]
    freedom: NDArray[np.int64]  #: (g,), degrees of freedom of the residuals
    noise: NDArray[np.floating]  #: (g,), variance of a typical pixel

    def strengths(self, excess: float) -> Strengths:
        """Return the expected variances of the backgrounds.

        The share of windows with a background and a common factor on the noise are estimated with
        them. excess: variance of slow waves of the noise over that of white noise.
        """
        log_det, explained = self._marginals(excess)
        squared = self.products[:, -1, -1]
        probability = np.zeros_like(explained)  # of the ratios; otherwise there is no background
        for _ in range(ROUNDS):
            remaining = squared - np.sum(probability * explained, axis=0)
            scale = float(np.median(remaining / self.freedom))
            gain = 0.5 * (explained / (scale * excess) - log_det)
            probability = softmax(gain, axis=0) * _probability(_evidence(gain))
        ratio = RATIOS @ probability
        # A background below the least ratio is not told from the noise.
        variance = np.where(ratio > RATIOS[0], ratio, 0.0) * self.noise
        return Strengths(variance, _evidence(gain), scale)

    def strengths_at(self, excess: float, scale: float) -> Strengths:
        """Return the expected variances of the backgrounds of windows that have one.

        scale: factor on the noise.
        """
        log_det, explained = self._marginals(excess)
        gain = 0.5 * (explained / (scale * excess) - log_det)
        return Strengths(RATIOS @ softmax(gain, axis=0) * self.noise, _evidence(gain), scale)

    def _marginals(self, excess: float) -> NDArray[np.float64]:
        """Return log-determinants and explained squared residuals (2, r, g) at the ratios."""
        computed = [self._marginal(ratio / excess) for ratio in STEP**COMPUTED]
        return np.asarray(np.einsum('rc,ckg->krg', BETWEEN, computed))

    def _marginal(self, ratio: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return log-determinants (g,) and the squared residuals that a background explains."""
        matrix = ratio * self.products
        diagonal = np.arange(matrix.shape[1])
        matrix[:, diagonal, diagonal] += 1
        pivot = np.linalg.cholesky(matrix)[:, diagonal, diagonal]
        unexplained = (pivot[:, -1] ** 2 - 1) / ratio
        return 2 * np.log(pivot[:, :-1]).sum(axis=1), self.products[:, -1, -1] - unexplained


def _evidence(gain: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return log-evidence (g,) from log-likelihoods (r, g) at equally probable ratios."""
    return np.asarray(logsumexp(gain, axis=0) - np.log(len(RATIOS)))


def _probability(evidence: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the probability (n,) that windows are of a kind, given the log-evidence (n,) for it.

    Their share is unknown and estimated by expectation-maximisation (Dempster, Laird and Rubin, J.
    R. Stat. Soc. B 39, 1977).
    """
    min_share = 0.5 / len(evidence)
    odds = 0.0
    for _ in range(EM_STEPS):
        share = np.mean(expit(evidence + odds))
        odds = float(logit(np.clip(share, min_share, 1 - min_share)))
    return np.asarray(expit(evidence + odds))


@dataclass(frozen=True)
class Texture:
    """Backgrounds of windows (n,) beyond a polynomial."""

    strength: NDArray[np.float64]  #: (n,), variances, 0 for windows without such a background
    #: (n,), numbers of the directions across a straight edge, NO_EDGE for none
    across: NDArray[np.int64]
    squared_px: int  #: square of the radius of the windows
    mask: Mask  #: unsharp mask of the image

    @classmethod
    def none(cls, count: int, offset: NDArray[np.int64], mask: Mask) -> Texture:
        """Return that of windows of pixels (m, 2) with a polynomial background."""
        squared_px = int((offset**2).sum(axis=1).max(initial=0))
        return cls(np.zeros(count), np.full(count, NO_EDGE), squared_px, mask)

    def estimated(
        self,
        rows: NDArray[np.int64],
        parts: Sequence[Part],
        angle: NDArray[np.float64],
        excess: float,
    ) -> Texture:
        """Return the backgrounds that the windows in rows (n,) show.

        parts: those of the windows in turn. angle: (n,) direction across a possible edge [rad].
        excess: variance of slow waves of the noise over that of white noise.
        """
        spectra = [self._spectra(NO_EDGE, part) for part in parts]
        strengths = joined_rows(spectra).strengths(excess)
        textured = np.flatnonzero(strengths.variance)
        strength = np.zeros_like(self.strength)
        direction = np.full_like(self.across, NO_EDGE)
        strength[rows] = strengths.variance
        if len(textured):
            # Is a straight edge a better explanation than waves in all directions?
            part = _chosen(parts, strengths.variance > 0)
            across = np.rint(angle * (DIRECTIONS / np.pi)).astype(int) % DIRECTIONS
            order = np.argsort(across[textured], kind='stable')
            textured = textured[order]
            spectra = []
            for one in np.unique(across[textured]).tolist():
                own = order[across[textured] == one]
                spectra.append(self._spectra(one, tuple(values[own] for values in part)))
            edges = joined_rows(spectra).strengths_at(excess, strengths.scale)
            better = _probability(edges.evidence - strengths.evidence[textured]) > 0.5
            strength[rows[textured[better]]] = edges.variance[better]
            direction[rows[textured[better]]] = across[textured[better]]
        return replace(self, strength=strength, across=direction)

    def in_windows(self, rows: NDArray[np.int64]) -> Iterator[tuple[Cosines, NDArray[np.int64]]]:
        """Yield waves, and which of the windows in rows (g,) have such a background."""
        textured = np.flatnonzero(self.strength[rows])
        across = self.across[rows[textured]]
        for direction in np.unique(across).tolist():
            yield _cosines_in(self.squared_px, direction, self.mask), textured[across == direction]

    def _spectra(self, across: int, part: Part) -> Spectra:
        jacobian, relative, weight, residual = part
        cosines = _cosines_in(self.squared_px, across, self.mask)
        return cosines.spectra(relative, jacobian, weight=weight, residual=residual)


def _chosen(parts: Sequence[Part], chosen: NDArray[np.bool_]) -> Part:
    """Return the chosen windows (n,) of all parts; derivatives by missing unknowns are zero."""
    ends = np.cumsum([len(part[0]) for part in parts])[:-1]
    some = np.split(chosen, ends)
    jacobians, *others = zip(
        *(tuple(values[own] for values in part) for part, own in zip(parts, some))
    )
    relative, weight, residual = (np.concatenate(arrays) for arrays in others)
    return _padded(jacobians), relative, weight, residual


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
