# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Find beads in a radiograph: polarity, field of view, size and places of round shadows.

A bead is a blob: both eigenvalues of the Hessian of the blurred image have the same sign
(Lindeberg, "Feature detection with automatic scale selection", IJCV 30, 1998). Edges of plates,
cables and the edge of the field have one small eigenvalue, so the smaller one is the response.
What counts is a response that the noise of the image does not explain; among these, beads are the
strongest ones. Both hold for three beads as for thousands.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import DataError
from ..findings import Kind
from .image_noise import Noise, estimate_noise

MIN_SIZE = 32  # of an image [px]
SCALES = (1.1, 1.5, 2.1, 3.0, 4.2, 6.0, 8.5)  # standard deviations of the blur [px]
BLOB_RADIUS = 1.25  # radius of a blurred disc over the scale at which its response is largest
FINE_SCALE = 2.9  # from which half the resolution tells scales apart as well
# Factors on the scale: the noise of a response decreases with the scale, but beads merge.
WIDER = (1.0, 1.4, 1.9)
# Of a response, in standard deviations of the second derivative. Those of the mean of both
# eigenvalues are 1.22 times smaller (Gaussian noise), so that less than one of the 200,000 places
# of a megapixel exceeds it by chance.
MIN_SNR = 4.0
MIN_SHARE = 0.3  # of the response of a typical bead
MOST_TYPICAL = 40  # strongest blobs that choose polarity and scale, at most
LEAST_TYPICAL = 2
SEEN_SHARE = 0.5  # of the beads of a phantom that every image is expected to show
FIELD_BLUR_PX = 4.0
FIELD_LEVEL = 0.18  # of the light in the field below which there is no field
MIN_CONTRAST = 0.05  # of a bead, as a fraction of the light around it


@dataclass(frozen=True)
class Detections:
    """Blobs of an image, and what they were found with.

    Attributes
    ----------
    light : (h, w) ndarray of float32
        Grey values, turned round where beads are bright, so that beads are dark.
    field : (h, w) ndarray of bool
        The field of view.
    uv : (n, 2) ndarray
        Centres [px], to some 0.1 px.
    strength : (n,) ndarray
        Response at a wider scale, 1 for a typical bead; it increases with the size.
    radius_px : float
        Radius of a typical bead with its blur [px].
    inverted : bool
        Beads are bright in the image.
    """

    light: np.ndarray
    field: NDArray[np.bool_]
    uv: NDArray[np.float64]
    strength: NDArray[np.float64]
    radius_px: float
    inverted: bool


def detect_beads(
    image: np.ndarray,
    beads: int = 2 * MOST_TYPICAL,
    radius_px: float | None = None,
    inverted: bool | None = None,
) -> Detections:
    """Find the beads of an image (h, w) of uint8 or uint16.

    beads is the number of beads of the phantom, radius_px the radius of a typical one, and
    inverted whether they are bright; both are estimated by default. Raises DataError, in one
    sentence, for an image without beads.
    """
    _check(image)
    grey = image.astype(np.float32)
    noise = estimate_noise(grey, (image > image.min()) & (image < image.max()))
    typical = int(np.clip(SEEN_SHARE * beads, LEAST_TYPICAL, MOST_TYPICAL))
    if radius_px is None or inverted is None:
        given = None if radius_px is None else max(radius_px / BLOB_RADIUS, 1.0)
        scale, inverted = _scale_and_polarity(grey, noise, typical, given)
    else:
        scale = max(radius_px / BLOB_RADIUS, 1.0)
    light = float(grey.max()) - grey if inverted else grey
    field = field_of_view(light, scale)
    for wider in WIDER:
        dark, bright = _blobs(grey, noise, wider * scale)
        uv = _beads(bright if inverted else dark, field, typical)
        if len(uv):
            break
    else:
        raise _nothing(image)
    return Detections(
        light,
        field,
        uv=uv,
        strength=_strengths(light, uv, scale),
        radius_px=scale * BLOB_RADIUS,
        inverted=inverted,
    )


def field_of_view(light: np.ndarray, scale: float) -> np.ndarray:
    """Return the mask (h, w) of the field of view: where there is light, holes filled."""
    smooth = cv2.GaussianBlur(light, (0, 0), max(FIELD_BLUR_PX, 2 * scale))
    low = float(np.percentile(smooth, 1))
    high = float(np.percentile(smooth, 95))
    mask = (smooth > low + FIELD_LEVEL * (high - low)).astype(np.uint8)
    if mask.mean() > 0.98 or low > 0.35 * high:
        return np.ones(light.shape, dtype=bool)
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    largest = max(contours, key=cv2.contourArea)
    filled = np.zeros_like(mask)
    # Beads at the edge leave bays in it, so the convex hull is the field.
    cv2.drawContours(filled, [cv2.convexHull(largest)], -1, 1, -1)
    margin = 2 * int(np.ceil(1.5 * scale)) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (margin, margin))
    eroded = cv2.erode(filled, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=1)
    return eroded.astype(bool)


@dataclass(frozen=True)
class _Blobs:
    """Blobs that the noise does not explain.

    Attributes
    ----------
    uv : (n, 2) ndarray
        [px]
    response : (n,) ndarray
    relative : (n,) ndarray
        The same as fractions of the light around.
    """

    uv: NDArray[np.float64]
    response: NDArray[np.float64]
    relative: NDArray[np.float64]


def _typical(values: np.ndarray, count: int) -> float:
    """Median of so many of the largest values, 0 where there are fewer."""
    if len(values) < count:
        return 0.0
    return float(np.median(np.sort(values)[::-1][:count]))


def _scale_and_polarity(
    grey: np.ndarray, noise: Noise, count: int, given: float | None
) -> tuple[float, bool]:
    """Return the scale with the strongest blobs, and whether they are bright. Raises DataError."""
    best: tuple[float, float, bool] | None = None
    for scale, part, factor in _resolutions(grey, given):
        # Noise of neighbouring pixels that is correlated remains so in their mean.
        for inverted, blobs in zip((False, True), _blobs(part, noise, scale / factor, factor)):
            strength = _typical(blobs.response, count)
            if strength > 0 and (best is None or strength > best[0]):
                best = (strength, scale, inverted)
    if best is None:
        raise _nothing(grey)
    return best[1], best[2]


def _resolutions(grey: np.ndarray, given: float | None) -> Iterator[tuple[float, np.ndarray, int]]:
    """Yield scales, the image (h, w) in which they are tried, and how much smaller it is."""
    factor = 1
    for scale in SCALES if given is None else (given,):
        while scale / factor >= FINE_SCALE and min(grey.shape) > 2 * MIN_SIZE:
            height, width = (size // 2 * 2 for size in grey.shape)
            grey = cv2.resize(
                grey[:height, :width], (width // 2, height // 2), interpolation=cv2.INTER_AREA
            )
            factor *= 2
        yield scale, grey, factor


def _nothing(image: np.ndarray) -> DataError:
    """Return the error for an image in which nothing round rises above the noise."""
    low = image.min()
    high = image.max()
    for value, text in ((high, 'saturated'), (low, 'black')):
        share = np.count_nonzero(image == value) / image.size
        if share > 0.5:
            cause = (
                f'there are no beads in the image, {share:.0%} of it are {text} '
                f'(grey value {value:.0f})'
            )
            return DataError(cause, kind=Kind.IMAGE_EMPTY, numbers={'share': share})
    return DataError(
        'there are no beads in the image, nothing round rises above the noise',
        kind=Kind.FEW_BEADS,
    )


def _check(image: np.ndarray) -> None:
    """Raise DataError for an image that cannot contain beads."""
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        raise DataError(f'the image has shape {image.shape} and pixels of {image.dtype}')
    height, width = image.shape
    if min(image.shape) < MIN_SIZE:
        raise DataError(f'the image has only {width} x {height} px')
    low = int(image.min())
    if low == int(image.max()):
        raise DataError(
            f'the image is empty: every pixel has the grey value {low}', kind=Kind.IMAGE_EMPTY
        )


def _blobs(grey: np.ndarray, noise: Noise, scale: float, factor: int = 1) -> tuple[_Blobs, _Blobs]:
    """Return the dark and the bright blobs of an image (h, w), reduced by a factor."""
    background = cv2.GaussianBlur(grey, (0, 0), 8 * scale)
    sd = np.sqrt(noise.variance(background)) * (_noise_of_response(noise, scale * factor))
    dark, bright = _responses(grey, scale)
    top = float(grey.max())
    floor = 1e-3 * top
    return (
        _found(dark, sd, np.maximum(background, floor), scale, factor),
        _found(bright, sd, np.maximum(top - background, floor), scale, factor),
    )


def _noise_of_response(noise: Noise, scale: float) -> float:
    """Standard deviation of a second derivative at a scale, over that of a grey value.

    The sum of the correlation of the noise with that of the derivative of a Gaussian.
    """
    half = int(np.ceil(4 * scale)) + len(noise.correlation) // 2
    axis = np.arange(-half, half + 1)
    gauss = np.exp(-0.5 * (axis / scale) ** 2)
    gauss /= gauss.sum()
    second = scale**2 * np.convolve(gauss, [1, -2, 1], mode='same')
    lags = len(noise.correlation) // 2
    along, across = (
        np.array([values @ np.roll(values, lag) for lag in range(-lags, lags + 1)])
        for values in (second, gauss)
    )
    return float(np.sqrt(np.sum(noise.correlation * np.outer(across, along))))


def _responses(grey: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Responses (h, w) to dark and to bright blobs: the smaller eigenvalue, or 0."""
    smooth = cv2.GaussianBlur(grey, (0, 0), scale)
    xx, yy, xy = (
        cv2.sepFilter2D(smooth, cv2.CV_32F, np.array(a), np.array(b))
        for a, b in (
            ([1.0, -2.0, 1.0], [0.0, 1.0, 0.0]),
            ([0.0, 1.0, 0.0], [1.0, -2.0, 1.0]),
            ([-0.5, 0.0, 0.5], [-0.5, 0.0, 0.5]),
        )
    )
    mean = (0.5 * scale**2) * (xx + yy)
    spread = scale**2 * cv2.sqrt(0.25 * (xx - yy) ** 2 + xy**2)
    dark = np.maximum(mean - spread, 0)
    bright = np.maximum(-mean - spread, 0)
    return dark, bright


def _found(
    response: np.ndarray, sd: np.ndarray, background: np.ndarray, scale: float, factor: int
) -> _Blobs:
    """Local maxima of a response (h, w) that rise above its noise, away from the border."""
    size = 2 * max(1, round(scale)) + 1
    dilated = cv2.dilate(response, np.ones((size, size), np.uint8))
    mask = (response >= dilated) & (response > MIN_SNR * sd)
    mask[[0, -1]] = False
    mask[:, [0, -1]] = False
    v, u = np.nonzero(mask)
    relative = response / background
    uv = np.column_stack(
        [
            u + _vertex(relative[v, u - 1], relative[v, u], relative[v, u + 1]),
            v + _vertex(relative[v - 1, u], relative[v, u], relative[v + 1, u]),
        ]
    )
    return _Blobs(factor * (uv + 0.5) - 0.5, response[v, u], relative[v, u])


def _beads(blobs: _Blobs, field: NDArray[np.bool_], count: int) -> NDArray[np.float64]:
    """Centres (n, 2) of beads in the field, none where they are too weak."""
    column, row = np.rint(blobs.uv).astype(int).T
    inside = field[row, column]
    uv = blobs.uv[inside]
    values = blobs.relative[inside]
    typical = _typical(values, min(count, max(len(values), 1)))
    if typical < MIN_CONTRAST:
        return np.empty((0, 2))
    return uv[values > MIN_SHARE * typical]


def _strengths(light: np.ndarray, uv: NDArray[np.float64], scale: float) -> NDArray[np.float64]:
    """Responses (n,) to beads at a scale beyond that of most, 1 for a typical one.

    There they increase with the size of a bead; at its own scale they hardly do.
    """
    column, row = np.rint(uv).astype(int).T
    background = cv2.GaussianBlur(light, (0, 0), 8 * scale)
    response, _ = _responses(light, WIDER[-1] * scale)
    relative = response[row, column] / np.maximum(background[row, column], 1e-3 * light.max())
    return np.asarray(relative / max(float(np.median(relative)), 1e-9), dtype=float)


def _vertex(before: np.ndarray, at: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Places (n,) of the vertices of parabolas through three samples, relative to the middle."""
    curvature = before - 2 * at + after
    shift = 0.5 * (before - after) / np.where(curvature < 0, curvature, -1.0)
    return np.clip(np.where(curvature < 0, shift, 0), -0.5, 0.5)
