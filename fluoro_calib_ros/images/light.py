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

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from .clipping import UNCLIPPED, Clipping

MIN_VARIANCE = 1 / 12  # variance of rounding to integers
SAMPLED = 100_000  # pixels for the noise estimate: they give the median of each level to 2 %
LEVELS = 30  # levels of light at which the noise is estimated
SURE_CORRELATION = 3.0  # significance limit of a correlation [standard deviations]
LAGS = 4  # largest lag at which noise is correlated [px]
SECOND = np.array([1.0, -2.0, 1.0])  # kernel of second differences
MIN_SEEN = 0.1  # least share of the variance in second differences: noise blurred by a pixel
WHITE_LEVELS = (255, 4095)  # largest grey values of 8 and 12 bits
HOT_SHARE = 1e-5  # share of hot pixels: ten in an image of 1024 x 1024 px
MIN_PIXELS = 1000  # pixels that estimates of noise and correlation need
MAX_SLOW = 0.9  # largest share of slow changes; beyond it the noise is not visible


# Width of the blur of scattered light, relative to the image. Scattered light spreads over some
# centimetres in a field of 20 to 40 cm.
SURROUNDINGS = 1 / 16
STRIDE = 8  # pixels over which that light hardly changes
# Blur from which a coarser image has the same blur within 1 %; within 4 % from half of it.
COARSE_BLUR = 4.0


@dataclass(frozen=True)
class Light:
    """Grey values of an image that has dark beads."""

    grey: NDArray[np.float32]  #: (h, w)
    field: NDArray[np.bool_]  #: (h, w), the field of view
    clipping: Clipping = UNCLIPPED

    def above(self, black: float) -> Light:
        """Return the light over a grey value that stands for no light."""
        if not black:
            return self
        clipping = Clipping(self.clipping.low - black, self.clipping.high - black)
        return Light(self.grey - np.float32(black), self.field, clipping)

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


def wide_blur(grey: NDArray[np.float32], blur: float, coarsest: float) -> NDArray[np.float32]:
    """Return a blurred image (h, w), from one so coarse that the blur is at least `coarsest`."""
    factor = max(1, int(blur / coarsest))
    height, width = grey.shape
    size = (max(1, width // factor), max(1, height // factor))
    coarse = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    smooth = cv2.GaussianBlur(coarse, (0, 0), blur / factor)
    return cv2.resize(smooth, (width, height), interpolation=cv2.INTER_LINEAR)


def white_level(image: np.ndarray) -> int:
    """Return the largest grey value that an image of 8, 12 or 16 bit pixels may have.

    Isolated pixels and a text of full scale do not count: 12 bit pixels are stored in 16 bits.
    """
    full = int(np.iinfo(image.dtype).max)
    for white in WHITE_LEVELS:
        above = np.count_nonzero(image > white)
        if above <= HOT_SHARE * image.size or above == np.count_nonzero(image == full):
            return min(white, full)
    return full


@dataclass(frozen=True)
class Noise:
    """Variance of a grey value, constant + gain * grey value, and correlation of the noise.

    The gain is negative where darker grey values have more noise.
    """

    constant: float
    gain: float
    #: (2 LAGS + 1, 2 LAGS + 1), correlation of pixels at lags (row, column), 1 in the middle
    correlation: NDArray[np.float64]

    def variance(self, light: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return the variance of grey values, given their expected light."""
        counted = np.maximum(light, 0) if self.gain > 0 else light
        return np.maximum(self.constant + self.gain * counted, MIN_VARIANCE)

    def above(self, black: float) -> Noise:
        """Return the noise of the light over a grey value that stands for no light."""
        return replace(self, constant=self.constant + self.gain * black)


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
    deviation /= np.sqrt(_seen_by(SECOND, correlation))
    return Noise(*line_of_variance(level, deviation), correlation)


def line_of_variance(
    level: NDArray[np.floating], deviation: NDArray[np.floating], rises: bool = False
) -> tuple[float, float]:
    """Return the constant, and the gain, of the variance of deviations (n,) at levels (n,).

    The variance is estimated robustly at pixels of about the same level. It rises with the light,
    and falls with it in inverted and logarithmic images; it is negative nowhere up to most light.
    rises: whether it is known not to fall.
    """
    parts = np.array_split(np.argsort(level), LEVELS)
    mean = np.array([np.median(level[part]) for part in parts])
    variance = np.array([(1.4826 * np.median(deviation[part])) ** 2 for part in parts])
    variance = np.maximum(variance, MIN_VARIANCE)
    weight = 1 / variance
    most = max(float(level.max()), 1.0)
    share = mean / most
    rows = np.column_stack([np.ones_like(share) if rises else 1 - share, share])
    for _ in range(3):
        ends, _ = nnls(rows * weight[:, None], variance * weight)
        weight = 1 / np.maximum(rows @ ends, MIN_VARIANCE)
    rise = ends[1] if rises else ends[1] - ends[0]
    return max(float(ends[0]), MIN_VARIANCE), float(rise) / most


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
    residual = wider - wide_blur(wider, 3 * LAGS, COARSE_BLUR)
    residual = residual[edge : edge + height - 2 * top, edge : edge + width - 2 * left]
    field = field[top : height - top, left : width - left]
    white = np.zeros((2 * LAGS + 1, 2 * LAGS + 1))
    white[LAGS, LAGS] = 1
    if np.count_nonzero(field) < MIN_PIXELS:
        return white
    chosen = residual[field]
    chosen = chosen[:: len(chosen) // SAMPLED + 1]
    limit = 3 * 1.4826 * float(np.median(np.abs(chosen)))
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


POLYNOMIAL = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))  # powers of x and y


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


def vertex(before: np.ndarray, at: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return vertices (n,) of parabolas through three samples, relative to the middle sample."""
    curvature = before - 2 * at + after
    shift = 0.5 * (before - after) / np.where(curvature < 0, curvature, -1.0)
    return np.clip(np.where(curvature < 0, shift, 0), -0.5, 0.5)
