# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Find beads in a radiograph: polarity, field of view, size and places of round shadows.

A bead is a blob: both eigenvalues of the Hessian of the blurred image have the same sign
(Lindeberg, "Feature detection with automatic scale selection", IJCV 30, 1998). Edges of plates,
cables and the edge of the field have one small eigenvalue, so the smaller one is the response.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import DataError
from ..findings import Kind

MIN_MIDDLE = 256  # size of the middle of an image that is looked at alone [px]
MIN_SIZE = 32  # of an image [px]
SCALES = (1.1, 1.5, 2.1, 3.0, 4.2, 6.0, 8.5)  # standard deviations of the blur [px]
BLOB_RADIUS = 1.25  # radius of a blurred disc over the scale at which its response is largest
# Factors on the scale: the noise of a response decreases with the scale, but beads merge.
WIDER = (1.0, 1.4, 1.9)
MIN_SNR = 6.0  # of a response, over the noise of the response
MIN_SHARE = 0.3  # of the response of a typical bead
TYPICAL = 40  # strongest blobs at each scale that choose polarity and scale
FIELD_BLUR_PX = 4.0
FIELD_LEVEL = 0.18  # of the light in the field below which there is no field
SATURATED = 0.6  # share of pixels at one grey value that leaves no image
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
        Response, 1 for a typical bead.
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
    image: np.ndarray, radius_px: float | None = None, inverted: bool | None = None
) -> Detections:
    """Find the beads of an image (h, w) of uint8 or uint16.

    radius_px is the radius of a bead, and inverted whether beads are bright; both are estimated by
    default. Raises DataError, in one sentence, for an image without beads.
    """
    _check(image)
    grey = image.astype(np.float32)
    scales = SCALES if radius_px is None else (max(radius_px / BLOB_RADIUS, 1.0),)
    if len(scales) == 1 and inverted is not None:
        scale = scales[0]
    else:
        scale, inverted = _scale_and_polarity(grey, scales)
    light = float(grey.max()) - grey if inverted else grey
    field = field_of_view(light, scale)
    for number, wider in enumerate(WIDER):
        try:
            uv, strength = _peaks(_responses(light, wider * scale)[0], field, light, wider * scale)
            break
        except DataError:
            if number == len(WIDER) - 1:
                raise
    return Detections(
        light, field, uv=uv, strength=strength, radius_px=scale * BLOB_RADIUS, inverted=inverted
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


def _scale_and_polarity(grey: np.ndarray, scales: Sequence[float]) -> tuple[float, bool]:
    """Return the scale with the strongest blobs, and whether they are bright. Raises DataError."""
    height, width = grey.shape
    best: tuple[float, float, bool] | None = None
    # The middle is a quarter of the work, and has beads in most images.
    middle = grey[height // 4 : height - height // 4, width // 4 : width - width // 4]
    for part in (middle, grey) if min(middle.shape) >= MIN_MIDDLE else (grey,):
        for scale in scales:
            for inverted, response in zip((False, True), _responses(part, scale)):
                strength, count = _typical(response, scale)
                enough = count >= (TYPICAL // 2 if part is middle else 1)
                if enough and (best is None or strength > best[0]):
                    best = (strength, scale, inverted)
        if best is not None:
            return best[1], best[2]
    raise DataError('there is nothing round in the image, so no beads', kind=Kind.FEW_BEADS)


def _check(image: np.ndarray) -> None:
    """Raise DataError for an image that cannot contain beads."""
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        raise DataError(f'the image has shape {image.shape} and pixels of {image.dtype}')
    height, width = image.shape
    if min(image.shape) < MIN_SIZE:
        raise DataError(f'the image has only {width} x {height} px')
    low = int(image.min())
    high = int(image.max())
    if low == high:
        raise DataError(
            f'the image is empty: every pixel has the grey value {low}', kind=Kind.IMAGE_EMPTY
        )
    for value, text in ((high, 'saturated'), (low, 'black')):
        share = np.count_nonzero(image == value) / image.size
        if share > SATURATED:
            cause = f'the image is {text}: {share:.0%} of it have the grey value {value}'
            raise DataError(cause, kind=Kind.IMAGE_EMPTY, numbers={'share': share})


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


def _typical(response: np.ndarray, scale: float) -> tuple[float, int]:
    """Median response of the strongest blobs of a scale, 0 without any, and their number."""
    values, _ = _maxima(response, scale)
    values = np.sort(values)[::-1][:TYPICAL]
    return (float(np.median(values)) if len(values) else 0.0), len(values)


def _maxima(response: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Values (n,) and places (n, 2), column and row, of local maxima away from the border."""
    size = 2 * max(1, round(scale)) + 1
    dilated = cv2.dilate(response, np.ones((size, size), np.uint8))
    floor = 3 * float(response.mean())
    mask = (response >= dilated) & (response > floor)
    mask[[0, -1]] = False
    mask[:, [0, -1]] = False
    rows, columns = np.nonzero(mask)
    return response[rows, columns], np.column_stack([columns, rows])


def _peaks(
    response: np.ndarray, field: np.ndarray, light: np.ndarray, scale: float
) -> tuple[np.ndarray, np.ndarray]:
    """Centres (n, 2) and relative strengths (n,) of beads. Raises DataError for none."""
    background = cv2.GaussianBlur(light, (0, 0), 8 * scale)
    relative = response / np.maximum(background, 1e-3 * float(light.max()))
    values, places = _maxima(relative, scale)
    inside = field[places[:, 1], places[:, 0]]
    values = values[inside]
    places = places[inside]
    if not len(values):
        raise DataError(
            'there is nothing round in the field of view, so no beads', kind=Kind.FEW_BEADS
        )
    quiet = relative[field]
    noise = float(np.median(quiet[quiet > 0])) if (quiet > 0).any() else 0.0
    typical = float(np.median(np.sort(values)[::-1][: max(TYPICAL, len(values) // 20)]))
    if typical < max(MIN_SNR * noise, MIN_CONTRAST):
        raise DataError(
            'there are no beads in the image, nothing round rises above the noise',
            kind=Kind.FEW_BEADS,
        )
    strong = values > max(MIN_SHARE * typical, MIN_SNR * noise)
    u = places[strong, 0]
    v = places[strong, 1]
    centres = np.column_stack(
        [
            u + _vertex(relative[v, u - 1], relative[v, u], relative[v, u + 1]),
            v + _vertex(relative[v - 1, u], relative[v, u], relative[v + 1, u]),
        ]
    )
    return centres, values[strong] / typical


def _vertex(before: np.ndarray, at: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Places (n,) of the vertices of parabolas through three samples, relative to the middle."""
    curvature = before - 2 * at + after
    shift = 0.5 * (before - after) / np.where(curvature < 0, curvature, -1.0)
    return np.clip(np.where(curvature < 0, shift, 0), -0.5, 0.5)
