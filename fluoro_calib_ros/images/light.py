# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Light of an image: grey values, clipping, noise, and the background of beads.

The background of a window may exceed a polynomial: edges of plates, bone, letters. It is modelled
as a sum of cosines whose power decreases with the cube of their frequency, like that of
radiographs of tissue and of any edge averaged over its directions (Burgess, Jacobson and Judy,
"Human observer detection experiments with mammograms and power-law noise", Med. Phys. 28, 2001).
The only unknown is its strength, estimated by restricted maximum likelihood (Patterson and
Thompson, Biometrika 58, 1971). All windows of the image decide together which of them have such a
background: the more have one, the less evidence is required. The cosines are eliminated from the
normal equations, so standard deviations include the uncertainty of the background.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.special import expit, logit, logsumexp

MIN_VARIANCE = 1 / 12  # variance of rounding to integers
SAMPLED = 100_000  # pixels for the noise estimate: they give the median of each level to 2 %
LEVELS = 30  # levels of light at which the noise is estimated
SURE_CORRELATION = 3.0  # significance limit of a correlation [standard deviations]
LAGS = 4  # largest lag at which noise is correlated [px]
SECOND = np.array([1.0, -2.0, 1.0])  # kernel of second differences
MIN_SEEN = 0.1  # least share of the variance in second differences: noise blurred by a pixel
MIN_CLIPPED = 10  # largest number of outermost grey values that is no evidence of clipping
MIN_PIXELS = 1000  # pixels that estimates of noise and correlation need
MAX_SLOW = 0.9  # largest share of slow changes; beyond it the noise is not visible


# Width of the blur of scattered light, relative to the image. Scattered light spreads over some
# centimetres in a field of 20 to 40 cm.
SURROUNDINGS = 1 / 16
STRIDE = 8  # pixels over which that light hardly changes


@dataclass(frozen=True)
class Light:
    """Grey values of an image that has dark beads."""

    grey: NDArray[np.float32]  #: (h, w)
    field: NDArray[np.bool_]  #: (h, w), the field of view
    #: grey values at which the image is clipped: less, or more, light does not change them
    low: float = -np.inf
    high: float = np.inf

    def around(self, uv: NDArray[np.float64]) -> NDArray[np.floating]:
        """Return the mean light (n,) in the surroundings of pixels (n, 2)."""
        column, row = np.rint(np.asarray(uv).T / STRIDE - 0.5 + 0.5 / STRIDE).astype(int)
        height, width = self._surroundings.shape
        return self._surroundings[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]

    @cached_property
    def _surroundings(self) -> NDArray[np.float32]:
        """Light blurred as scattered light is, at every STRIDE-th pixel."""
        size = [-(-side // STRIDE) for side in self.grey.shape[::-1]]
        small = cv2.resize(self.grey, size, interpolation=cv2.INTER_AREA)
        width = SURROUNDINGS * max(small.shape)
        return cv2.GaussianBlur(small, (0, 0), width, borderType=cv2.BORDER_REPLICATE)


def clipped_at(grey: NDArray[np.floating]) -> tuple[float, float]:
    """Return the values at which an image (h, w) is clipped, infinite if it is not.

    With noise alone, the outermost value is rarer than its neighbour.
    """
    lowest = float(grey.min())
    highest = float(grey.max())
    low = lowest if _is_clipped(grey, lowest, lowest + 1) else -np.inf
    high = highest if _is_clipped(grey, highest, highest - 1) else np.inf
    return low, high


def _is_clipped(grey: NDArray[np.floating], outermost: float, neighbour: float) -> bool:
    """Return whether an outermost grey value is more frequent than its neighbour."""
    count = int(np.count_nonzero(grey == outermost))
    return count > max(int(np.count_nonzero(grey == neighbour)), MIN_CLIPPED)


@dataclass(frozen=True)
class Noise:
    """Variance of a grey value, constant + gain * grey value, and correlation of the noise."""

    constant: float
    gain: float
    #: (2 LAGS + 1, 2 LAGS + 1), correlation of pixels at lags (row, column), 1 in the middle
    correlation: NDArray[np.float64]

    def variance(self, light: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return the variance of grey values, given their expected light."""
        return np.maximum(self.constant + self.gain * np.maximum(light, 0), MIN_VARIANCE)


def estimate_noise(light: NDArray[np.float32], usable: NDArray[np.bool_]) -> Noise:
    """Estimate the noise of an image (h, w) from its deviations from a plane.

    The variance is estimated robustly from second differences (Immerkaer, "Fast noise variance
    estimation", CVIU 64, 1996) at usable pixels of about the same light. They underestimate
    correlated noise; a factor from the correlation corrects this. If hardly any pixel is usable,
    the noise is that of rounding.
    """
    correlation = _correlation(light, usable)
    kernel = np.outer(SECOND, SECOND) / float(np.sum(SECOND**2))
    inside = cv2.erode(usable.astype(np.uint8), np.ones((3, 3), np.uint8))
    chosen = np.flatnonzero(inside)
    if len(chosen) < MIN_PIXELS:
        return Noise(MIN_VARIANCE, 0.0, correlation)
    chosen = chosen[:: len(chosen) // SAMPLED + 1]
    level = cv2.blur(light, (3, 3)).ravel()[chosen]
    deviation = np.abs(cv2.filter2D(light, cv2.CV_32F, kernel).ravel()[chosen])
    parts = np.array_split(np.argsort(level), LEVELS)
    mean = np.array([np.median(level[part]) for part in parts])
    variance = np.array([(1.4826 * np.median(deviation[part])) ** 2 for part in parts])
    variance = np.maximum(variance / _seen_by(SECOND, correlation), MIN_VARIANCE)
    weight = 1 / variance
    gain = constant = 0.0
    for _ in range(3):
        rows = np.column_stack([np.ones_like(mean), mean]) * weight[:, None]
        (constant, gain), _ = nnls(rows, variance * weight)
        weight = 1 / np.maximum(constant + gain * mean, MIN_VARIANCE)
    return Noise(max(constant, MIN_VARIANCE), gain, correlation)


def _seen_by(kernel: NDArray[np.float64], correlation: NDArray[np.float64]) -> float:
    """Return the variance of noise after a kernel along both axes, over that of white noise."""
    lags = len(correlation) // 2
    padded = np.pad(kernel, lags)
    autocorrelation = np.array([padded @ np.roll(padded, lag) for lag in range(-lags, lags + 1)])
    autocorrelation = autocorrelation / autocorrelation[lags]
    return max(float(np.sum(correlation * np.outer(autocorrelation, autocorrelation))), MIN_SEEN)


def _correlation(light: NDArray[np.float32], field: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the correlation of the noise in the light minus its blur, without beads."""
    height, width = light.shape
    top, left = height // 4, width // 4
    # A blur mirrors the light at its border, where a slope would look like noise.
    edge = min(9 * LAGS, top, left)
    wider = light[top - edge : height - top + edge, left - edge : width - left + edge]
    residual = wider - cv2.GaussianBlur(wider, (0, 0), 3 * LAGS)
    residual = residual[edge : edge + height - 2 * top, edge : edge + width - 2 * left]
    field = field[top : height - top, left : width - left]
    white = np.zeros((2 * LAGS + 1, 2 * LAGS + 1))
    white[LAGS, LAGS] = 1
    if np.count_nonzero(field) < MIN_PIXELS:
        return white
    limit = 3 * 1.4826 * float(np.median(np.abs(residual[field])))
    valid = (field & (np.abs(residual) < limit)).astype(np.float32)
    valid = cv2.erode(valid, np.ones((3, 3), np.uint8))
    residual = residual * valid
    if valid.sum() < MIN_PIXELS:
        return white
    mean_square = float(np.sum(residual * residual)) / float(valid.sum())
    if mean_square < MIN_VARIANCE:
        return white
    return correlation_of(residual[None], valid[None])


def correlation_of(
    residual: NDArray[np.floating], valid: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Return the correlation (2 LAGS + 1, 2 LAGS + 1) of residuals (k, h, w), 0 if invalid.

    At the largest lags noise is not correlated. A correlation there comes from slow changes of the
    light, or from what a fit has removed at all lags.
    """
    # With an edge of zeros, a lag along both axes is a lag in the flattened pixels.
    edge_of_zeros = ((0, 0), (0, LAGS), (0, LAGS))
    value, weight = (np.pad(array, edge_of_zeros).reshape(-1) for array in (residual, valid))
    mean_square = float(value @ value) / max(float(weight.sum()), 1.0)
    out = np.zeros((2 * LAGS + 1, 2 * LAGS + 1))
    for row in range(LAGS + 1):
        for column in range(-LAGS if row else 0, LAGS + 1):
            lag = row * (residual.shape[2] + LAGS) + column
            stop = len(value) - lag
            pairs = max(float(weight[:stop] @ weight[lag:]), 1.0)
            products = float(value[:stop] @ value[lag:])
            mean = products / pairs / max(mean_square, 1e-300)
            out[LAGS + row, LAGS + column] = out[LAGS - row, LAGS - column] = mean
    edge = float(np.median(np.concatenate([out[0], out[-1], out[:, 0], out[:, -1]])))
    out = np.clip((out - edge) / max(1 - edge, 1 - MAX_SLOW), 0, 1)
    # Correlations of white noise scatter by one over the root of the number of pixels.
    out[out < SURE_CORRELATION / np.sqrt(max(float(weight.sum()), 1.0))] = 0
    out[LAGS, LAGS] = 1
    return out


def less_common(
    place: NDArray[np.float64],
    size: NDArray[np.float64],
    residual: np.ndarray,
    valid: NDArray[np.bool_],
    usual: NDArray[np.bool_],
) -> np.ndarray:
    """Return standardised residuals (n, m) without the part that usual windows have in common.

    If a shadow is not exactly that of a sphere, all windows show it, depending on the place (n, 2)
    and the size (n,) of the shadow. The common part of each pixel is a polynomial of degree 2 with
    a prior as large as the noise. It absorbs noise of usual windows and adds noise to the others;
    the result is scaled to compensate for both. Invalid residuals are 0.
    """
    differing = np.column_stack([place, np.log(size)])
    centred = differing - differing.mean(axis=0)
    x, y, z = (centred / np.maximum(np.abs(centred).max(axis=0, initial=0.0), 1e-6)).T
    terms = np.stack([*(x**i * y**j for i, j in POLYNOMIAL), z, z * z], axis=1)
    prior = np.eye(terms.shape[1], dtype=residual.dtype)
    usual_terms = terms[usual].astype(residual.dtype)
    products = (usual_terms[:, :, None] * usual_terms[:, None]).reshape(-1, prior.size)
    pixel_normal = (valid[usual].T.astype(residual.dtype) @ products).reshape(-1, *prior.shape)
    right_side = residual[usual].T @ usual_terms
    coefficients = np.linalg.solve(pixel_normal + prior, right_side[..., None])
    common = terms.astype(residual.dtype) @ coefficients[..., 0].T
    normal = usual_terms.T @ usual_terms
    influence = np.linalg.solve(normal + prior, terms.T)
    leverage = np.sum(terms * influence.T, axis=1)
    common_variance = np.sum(influence * (normal @ influence), axis=0)
    noise = np.sqrt(1 + common_variance - np.where(usual, 2 * leverage, 0.0)).astype(
        residual.dtype
    )
    return (residual - common) * valid / noise[:, None]


HIGHEST = 9  # highest number of half waves across a window
# Principal components of the background beyond a polynomial that are used to estimate its
# strength: they contain 0.9 of its variance.
TELLING = 26
EXPONENT = 3.0
# Variance of the waves across a straight edge, relative to that of other waves of their length. In
# eight renderings with plates, errors were the same to 2 % with 10 to 300; the larger, the smaller
# were their standard deviations.
EDGE = 30.0
POLYNOMIAL = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))  # powers of x and y
# Ratios of the variance of the background to that of the noise that are compared. The likelihood
# is wider than their steps: 20 cosines determine the strength to a factor of 1.4.
STEP = 4.0
RATIOS = STEP ** np.arange(-2, 7)
ROUNDS = 3  # iterations over the strengths and the factor on the noise
EM_STEPS = 30  # iterations after which the share of windows has converged to 0.01


def vertex(before: np.ndarray, at: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return vertices (n,) of parabolas through three samples, relative to the middle sample."""
    curvature = before - 2 * at + after
    shift = 0.5 * (before - after) / np.where(curvature < 0, curvature, -1.0)
    return np.clip(np.where(curvature < 0, shift, 0), -0.5, 0.5)


class Cosines:
    """Cosines on the pixels of a window, and their variances.

    offset: (m, 2) pixels relative to the middle of the window. across: direction across a straight
    edge [rad], in which the background changes more; None for a background without an edge.
    """

    def __init__(
        self,
        offset: NDArray[np.int64],
        dtype: type[np.floating],
        across: float | None = None,
    ) -> None:
        half = float(np.abs(offset).max()) + 0.5
        angle = across or 0.0
        turned = offset @ [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        x, y = (turned.T + half) * (np.pi / (2 * half))
        number = np.array(
            [
                (i, j)
                for i, j in product(range(HIGHEST + 1), repeat=2)
                if 0 < i * i + j * j <= HIGHEST**2
            ]
        )
        self.waves = (
            np.cos(np.outer(number[:, 0], x)) * np.cos(np.outer(number[:, 1], y))
        ).astype(dtype)
        power = np.sum(number**2, axis=1) ** (-EXPONENT / 2)
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
        residual: NDArray[np.float64],
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
        reduced = products[:, unknowns:, unknowns:] - np.swapaxes(cross, 1, 2) @ np.linalg.solve(
            normal, cross
        )
        noise = 1 / np.maximum(np.mean(weight, axis=1), 1e-12)
        reduced[:, :-1] *= np.sqrt(noise)[:, None, None]
        reduced[:, :, :-1] *= np.sqrt(noise)[:, None, None]
        freedom = np.maximum(np.count_nonzero(weight, axis=1) - unknowns, 1)
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
        waves = relative[:, None] * self.waves
        weighted = waves * weight.astype(waves.dtype)[:, None]
        inner = (weighted @ np.swapaxes(waves, 1, 2)).astype(float)
        diagonal = np.arange(len(self.variance))
        inner[:, diagonal, diagonal] += 1 / (strength[:, None] * self.variance)
        stacked = np.concatenate([jacobian, residual[:, None].astype(jacobian.dtype)], axis=1)
        cross = (weighted @ np.swapaxes(stacked, 1, 2)).astype(float)
        explained = np.swapaxes(cross, 1, 2) @ np.linalg.solve(inner, cross)
        return explained[:, :-1, :-1], explained[:, :-1, -1], explained[:, -1, -1]


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

    @classmethod
    def joined(cls, parts: Sequence[Spectra]) -> Spectra:
        """Return the spectra of all windows of several groups."""
        names = [field.name for field in fields(cls)]
        return cls(
            **{name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        )

    def strengths(self, excess: float) -> Strengths:
        """Return the variances of the backgrounds, 0 for windows that more likely have none.

        The share of windows with a background and a common factor on the noise are estimated with
        the strengths. excess: variance of slow waves of the noise over that of white noise.
        """
        log_det, explained = self._marginals(excess)
        squared = self.products[:, -1, -1]
        window = np.arange(len(squared))
        likely = np.zeros(len(squared), dtype=bool)
        best = np.zeros(len(squared), dtype=int)
        for _ in range(ROUNDS):
            mean_square = (squared - np.where(likely, explained[best, window], 0.0)) / self.freedom
            scale = float(np.median(mean_square))
            gain = 0.5 * (explained / (scale * excess) - log_det)
            best = np.argmax(gain, axis=0)
            likely = _likely(_evidence(gain))
        strengths = self._most_likely(gain, scale)
        return replace(strengths, variance=np.where(likely, strengths.variance, 0.0))

    def strengths_at(self, excess: float, scale: float) -> Strengths:
        """Return the variances of the backgrounds of windows that have one.

        scale: factor on the noise.
        """
        log_det, explained = self._marginals(excess)
        return self._most_likely(0.5 * (explained / (scale * excess) - log_det), scale)

    def _most_likely(self, gain: NDArray[np.float64], scale: float) -> Strengths:
        """Return the most likely variances, given log-likelihoods (r, g) at the ratios."""
        best = np.argmax(gain, axis=0)
        inner = np.clip(best, 1, len(RATIOS) - 2)
        window = np.arange(len(best))
        offset = vertex(*(gain[inner + step, window] for step in (-1, 0, 1)))
        ratio = RATIOS[best] * np.where(inner == best, STEP**offset, 1.0)
        return Strengths(ratio * self.noise, _evidence(gain), scale)

    def _marginals(self, excess: float) -> NDArray[np.float64]:
        """Return log-determinants and explained squared residuals (2, r, g) at the ratios."""
        return np.stack([self._marginal(ratio / excess) for ratio in RATIOS], axis=1)

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


def _likely(evidence: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return (g,) whether windows are of a kind, given the log-evidence (g,) for it.

    Their share is unknown and estimated by expectation-maximisation (Dempster, Laird and Rubin, J.
    R. Stat. Soc. B 39, 1977).
    """
    min_share = 0.5 / len(evidence)
    odds = 0.0
    for _ in range(EM_STEPS):
        share = np.mean(expit(evidence + odds))
        odds = float(logit(np.clip(share, min_share, 1 - min_share)))
    return np.asarray(evidence + odds > 0)
