# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Find beads in a radiograph: polarity, field of view, size and places of round shadows.

A bead is a blob: both eigenvalues of the Hessian of the blurred image have the same sign
(Lindeberg, "Feature detection with automatic scale selection", IJCV 30, 1998). Edges of plates,
cables and the edge of the field have one small eigenvalue, so the smaller one is the response.
Responses that the noise of the image explains are discarded; beads are the strongest of the
others. Both criteria hold for three beads as well as for thousands.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..errors import DataError
from ..findings import Kind
from .clipping import Clipping
from .discs import set_apart
from .light import (
    COARSE_BLUR,
    Light,
    Noise,
    estimate_noise,
    vertex,
    white_level,
    wide_blur,
)

MIN_SIZE = 32  # smallest side of an image [px]
SCALES = (1.1, 1.5, 2.1, 3.0, 4.2, 6.0, 8.5, 12.0, 17.0)  # standard deviations of the blur [px]
BLOB_RADIUS = 1.25  # radius of a blurred disc over the scale of its largest response
FINE_SCALE = 2.9  # scale from which half the resolution separates scales as well [px]
# Factors on the scale: the noise of a response decreases with the scale, but beads merge.
WIDER = (1.0, 1.4, 1.9)
LARGER = (1.4, 2.0, 2.8)  # factors on the scale at which large beads are detected
# Threshold of a response, in standard deviations of the second derivative. Those of the mean of
# both eigenvalues are 1.22 times smaller (Gaussian noise), so that less than one of the 200,000
# places of a megapixel exceeds the threshold by chance.
MIN_SNR = 4.0
MIN_SHARE = 0.3  # threshold of a response, relative to that of a typical bead
MOST_TYPICAL = 40  # largest number of strongest blobs that determine polarity and scale
LEAST_TYPICAL = 2  # smallest number of them
MAX_LIKELY = 3  # largest number of sizes and polarities that are tried
MANY = 4 * MOST_TYPICAL  # number of beads from which the middle quarter of an image shows enough
SEEN_SHARE = 0.5  # expected share of the beads of a phantom that every image shows
BACKGROUND = 8.0  # blur of the light around a bead, over its scale
PIXELS_AT_ONCE = 2**16  # pixels filtered at once: four such arrays fit into a cache of 1 MiB
FIELD_BLUR_PX = 4.0  # least blur of the image from which the field is found
FIELD_LEVEL = 0.18  # level below which there is no field, as a fraction of the light in the field
MAX_PARTS = 8  # largest number of parts into which plates cut the field
# Least lit share of the area that a part adds to the convex hull of the field. It is less than 1/4
# for letters next to a round field, nearly 1/2 beyond a plate, where the plate is widest.
MIN_LIT = 1 / 3
MIN_CONTRAST = 0.05  # least contrast of a bead, as a fraction of the light around it


@dataclass(frozen=True)
class Look:
    """Appearance of beads in an image."""

    radius_px: float  #: radius of a typical bead
    inverted: bool  #: True if beads are bright
    noise: Noise | None = None  #: noise of the image; None if it is to be estimated
    alike: bool = False  #: True if no bead is much larger than a typical bead


@dataclass(frozen=True)
class Detections:
    """Blobs of an image, and the parameters with which they were detected."""

    light: Light  #: grey values, inverted if beads are bright, so that beads are dark
    noise: Noise  #: noise of the light
    uv: NDArray[np.float64]  #: (n, 2), centres [px], to about 0.1 px
    scale: float  #: standard deviation of the blur of the detection [px]
    radius_px: float  #: radius of a typical bead including its blur [px]
    inverted: bool  #: True if beads are bright in the image

    @cached_property
    def strength(self) -> NDArray[np.float64]:
        """Relative responses (n,) at a scale larger than that of most beads; 1 is typical.

        There they increase with the size of a bead; at the bead's own scale they hardly do.
        """
        column, row = np.rint(self.uv).astype(int).T
        (response,) = responses(self.light.grey, WIDER[-1] * self.scale, (False,))
        relative = response[row, column] / _light_around(self.light.grey, self.scale)[row, column]
        return np.asarray(relative / max(float(np.median(relative)), 1e-9), dtype=float)


def detect_beads(
    image: np.ndarray, beads: int = 2 * MOST_TYPICAL, look: Look | None = None
) -> Detections:
    """Find the beads of an image (h, w) of uint8 or uint16.

    beads is the number of beads of the phantom. If look is None, the likeliest size and polarity
    are taken. Raises DataError, in one sentence, if the image shows no beads.
    """
    if look is None:
        return next(likely_detections(image, beads))
    sight = _Sight.of(image, beads, look.noise)
    scale = max(look.radius_px / BLOB_RADIUS, 1.0)
    detections = sight.detections(scale, look.inverted, look.radius_px if look.alike else None)
    if detections is None:
        raise _nothing(image, sight)
    return detections


def likely_detections(image: np.ndarray, beads: int) -> Iterator[Detections]:
    """Yield detections with the likeliest sizes and polarities of the beads, likeliest first.

    Letters and screws may look more like beads than the beads do: the pose decides. Raises
    DataError if nothing is detected with any of them.
    """
    sight = _Sight.of(image, beads)
    # If an image shows fewer beads than expected, the strongest blob determines their size.
    for trial in (sight, replace(sight, typical=1)):
        count = 0
        for scale, inverted in trial.looks(whole_image=beads < MANY):
            detections = trial.detections(scale, inverted)
            if detections is not None:
                count += 1
                yield detections
            if count == MAX_LIKELY:
                return
        if count:
            return
    raise _nothing(image, sight)


@dataclass(frozen=True)
class _Sight:
    """An image (h, w) with its noise, and the number of blobs that determine the bead size."""

    grey: NDArray[np.float32]
    noise: Noise
    typical: int

    @classmethod
    def of(cls, image: np.ndarray, beads: int, noise: Noise | None = None) -> _Sight:
        """Prepare the detection of so many beads in an image. Raises DataError."""
        _check(image)
        grey = np.minimum(image, image.dtype.type(white_level(image))).astype(np.float32)
        if noise is None:
            noise = estimate_noise(grey, Clipping.of(grey).leaves(grey))
        typical = int(np.clip(SEEN_SHARE * beads, LEAST_TYPICAL, MOST_TYPICAL))
        return cls(grey, noise, typical)

    def middle(self) -> NDArray[np.float32]:
        """Return the middle quarter of the image, which takes a quarter of the time."""
        height, width = self.grey.shape
        return self.grey[height // 4 : height - height // 4, width // 4 : width - width // 4]

    def looks(self, whole_image: bool = True) -> list[tuple[float, bool]]:
        """Return scales and polarities of the strongest blobs, strongest first."""
        looks = [] if whole_image else self.likely(self.middle())
        looks = sorted(looks or self.likely(self.grey), reverse=True)
        return [(scale, inverted) for _, scale, inverted in looks]

    def likely(self, grey: NDArray[np.float32]) -> list[tuple[float, float, bool]]:
        """Return strength, scale and polarity of the strongest blobs of the image or a part.

        For either polarity, return the scales at which the strength has a local maximum.
        """
        strengths = np.zeros((2, len(SCALES) + 2))
        fields: dict[int, tuple[NDArray[np.bool_], NDArray[np.bool_]]] = {}
        for column, (scale, part, factor) in enumerate(_resolutions(grey), 1):
            if factor not in fields:
                negative = float(part.max()) - part
                lit = field_of_view(part, FINE_SCALE)
                fields[factor] = lit, lit & field_of_view(negative, FINE_SCALE)
            blobs_of_polarities = _blobs(part, self.noise, scale / factor, factor)
            for row, blobs in enumerate(blobs_of_polarities):
                inside = _inside(blobs.uv, fields[factor][row], factor)
                strengths[row, column] = _typical(blobs.response[inside], self.typical)
        middle = strengths[:, 1:-1]
        peaks = (middle > 0) & (middle >= strengths[:, :-2]) & (middle >= strengths[:, 2:])
        return [
            (float(middle[row, column]), SCALES[column], bool(row))
            for row, column in np.argwhere(peaks)
        ]

    def blobs(self, scale: float, inverted: bool) -> _Blobs:
        """Return the dark or bright blobs of the image."""
        return _blobs(self.grey, self.noise, scale, polarities=(inverted,))[0]

    def merged(self, blobs: _Blobs, scale: float, inverted: bool) -> NDArray[np.float64]:
        """Return places (n, 2) of beads, with the blobs inside a large bead merged into one.

        A large bead has several maxima at a small scale, and a larger response at its own scale:
        a blob is a maximum over places and scales (Lindeberg 1998).
        """
        uv = blobs.uv
        tree = cKDTree(uv) if len(uv) else None
        if tree is None or not tree.query_pairs(2 * LARGER[-1] * BLOB_RADIUS * scale):
            return uv
        merged = np.zeros(len(uv), dtype=bool)
        large: list[NDArray[np.float64]] = []
        for larger in LARGER:
            factor = max(1, int(larger * scale / FINE_SCALE))
            height, width = (size // factor for size in self.grey.shape)
            part = cv2.resize(
                self.grey[: height * factor, : width * factor],
                (width, height),
                interpolation=cv2.INTER_AREA,
            )
            wide_scale = larger * scale
            larger_blobs = _blobs(part, self.noise, wide_scale / factor, factor, (inverted,))[0]
            nearby = tree.query_ball_point(larger_blobs.uv, BLOB_RADIUS * wide_scale)
            for place, relative, rows in zip(larger_blobs.uv, larger_blobs.relative, nearby):
                inside = [row for row in rows if not merged[row]]
                if len(inside) > 1 and relative > blobs.relative[inside].max():
                    merged[inside] = True
                    large.append(place)
        return np.concatenate([uv[~merged], np.reshape(large, (-1, 2))])

    def contrast(self) -> float:
        """Return the contrast of the strongest blob, as a fraction of the light around it."""
        best = 0.0
        for scale, inverted in replace(self, typical=1).looks():
            blobs = self.blobs(scale, inverted)
            light = blobs.response / blobs.relative
            light = float(self.grey.max()) - light if inverted else light
            best = max(best, float((blobs.response / light).max(initial=0.0)))
        return best

    def detections(
        self, scale: float, inverted: bool, radius_px: float | None = None
    ) -> Detections | None:
        """Return the detections at a scale and a polarity, None if there are none.

        radius_px: radius of all beads, if an earlier exposure gave it. Blobs are then neither
        merged nor separated; the earlier pose resolves beads that share a blob.
        """
        grey = self.grey
        light = float(grey.max()) - grey if inverted else grey
        clipping = Clipping.of(light)
        field = field_of_view(light, scale)
        if inverted:
            # Holes of a sheet are bright, but there is no light outside the field either.
            field &= field_of_view(grey, scale)
        for wider in WIDER:
            blobs = _beads(self.blobs(wider * scale, inverted), field, self.typical)
            uv = blobs.uv
            radius = radius_px
            if radius_px is None:
                uv = self.merged(blobs, wider * scale, inverted)
                if len(uv):
                    uv, radius = set_apart(light / _light_around(light, scale), uv)
            if len(uv):
                unclipped = field & clipping.leaves(light)
                return Detections(
                    Light(light, field, clipping),
                    estimate_noise(light, unclipped) if inverted else self.noise,
                    uv=uv,
                    scale=scale,
                    radius_px=radius or scale * BLOB_RADIUS,
                    inverted=inverted,
                )
        return None


def field_of_view(light: NDArray[np.float32], scale: float) -> NDArray[np.bool_]:
    """Return the mask (h, w) of the field of view: where there is light, with holes filled."""
    smooth = wide_blur(light, max(FIELD_BLUR_PX, 2 * scale), COARSE_BLUR / 2)
    stride = int(FIELD_BLUR_PX)  # pixels across which the blurred image hardly changes
    low, high = map(float, np.percentile(smooth[::stride, ::stride], [1, 95]))
    mask = (smooth > low + FIELD_LEVEL * (high - low)).astype(np.uint8)
    if mask.mean() > 0.98 or low > 0.35 * high:
        return np.ones(light.shape, dtype=bool)
    filled = _lit(mask)
    margin = 2 * int(np.ceil(1.5 * scale)) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (margin, margin))
    eroded = cv2.erode(filled, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=1)
    return eroded.astype(bool)


def _lit(mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the field (h, w) of a mask of bright pixels: convex, because beads leave bays in it.

    A plate seen from its edge may cut off a part of the field. Letters next to the field are lit
    as well, but it is dark between them and the field.
    """
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    contours = sorted(contours, key=cv2.contourArea, reverse=True)
    if not contours:
        return mask
    hull = cv2.convexHull(contours[0])
    field = cv2.drawContours(np.zeros_like(mask), [hull], -1, 1, -1)
    for contour in contours[1:MAX_PARTS]:
        wider = cv2.convexHull(np.concatenate([hull, contour]))
        wider_field = cv2.drawContours(np.zeros_like(mask), [wider], -1, 1, -1)
        if mask[wider_field > field].sum() > MIN_LIT * (wider_field > field).sum():
            hull = wider
            field = wider_field
    return field


@dataclass(frozen=True)
class _Blobs:
    """Blobs that noise does not explain."""

    uv: NDArray[np.float64]  #: (n, 2) [px]
    response: NDArray[np.floating]  #: (n,)
    relative: NDArray[np.floating]  #: (n,), responses as fractions of the light around the blobs

    def chosen(self, mask: NDArray[np.bool_]) -> _Blobs:
        """Return the blobs selected by a mask (n,)."""
        return _Blobs(self.uv[mask], self.response[mask], self.relative[mask])


def _typical(values: NDArray[np.floating], count: int) -> float:
    """Return the median of the `count` largest values, 0 if there are fewer."""
    if len(values) < count:
        return 0.0
    return float(np.median(np.sort(values)[::-1][:count]))


def _resolutions(grey: NDArray[np.float32]) -> Iterator[tuple[float, NDArray[np.float32], int]]:
    """Yield scales, the image (h, w) in which each is tried, and its reduction factor."""
    factor = 1
    for scale in SCALES:
        while scale / factor >= FINE_SCALE and min(grey.shape) > 2 * MIN_SIZE:
            height, width = (size // 2 * 2 for size in grey.shape)
            grey = cv2.resize(
                grey[:height, :width], (width // 2, height // 2), interpolation=cv2.INTER_AREA
            )
            factor *= 2
        yield scale, grey, factor


def _inside(
    uv: NDArray[np.float64], field: NDArray[np.bool_], factor: int = 1
) -> NDArray[np.bool_]:
    """Return (n,) whether pixels (n, 2) are in a field that is reduced by a factor."""
    column, row = np.rint((uv + 0.5) / factor - 0.5).astype(int).T
    return field[row, column]


def _nothing(image: np.ndarray, sight: _Sight) -> DataError:
    """Return the error for an image in which nothing round rises above the noise."""
    low = image.min()
    high = image.max()
    for value, text in ((high, 'saturated'), (low, 'black')):
        share = np.count_nonzero(image == value) / image.size
        if share > 0.5:
            cause = (
                f'there are no beads in the image, {share:.0%} of it is {text} (grey value '
                f'{value:.0f})'
            )
            return DataError(cause, kind=Kind.IMAGE_EMPTY, numbers={'share': share})
    contrast = sight.contrast()
    cause = 'there are no beads in the image, no round shadow rises above the noise'
    if contrast:
        cause = (
            'there are no beads in the image: the contrast of its round shadows is at most '
            f'{contrast:.1%}, at least {MIN_CONTRAST:.0%} are needed'
        )
    return DataError(cause, kind=Kind.FEW_BEADS, numbers={'contrast': contrast})


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


def _blobs(
    grey: NDArray[np.float32],
    noise: Noise,
    scale: float,
    factor: int = 1,
    polarities: Sequence[bool] = (False, True),
) -> list[_Blobs]:
    """Return the dark and the bright blobs of an image (h, w) that is reduced by a factor.

    polarities: True for bright blobs, False for dark blobs.
    """
    background = _background(grey, scale)
    per_sd = MIN_SNR * _noise_of_response(noise, scale * factor)
    top = float(grey.max())
    floor = 1e-3 * top
    out = []
    for inverted, response in zip(polarities, responses(grey, scale, polarities)):
        v, u = _maxima(response, scale, per_sd * np.sqrt(noise.variance(background.min())))
        strong = response[v, u] > per_sd * np.sqrt(noise.variance(background[v, u]))
        v, u = v[strong], u[strong]
        light = top - background if inverted else background
        before, at, after, above, below = (
            response[row, column] / np.maximum(light[row, column], floor)
            for row, column in ((v, u - 1), (v, u), (v, u + 1), (v - 1, u), (v + 1, u))
        )
        uv = np.column_stack([u + vertex(before, at, after), v + vertex(above, at, below)])
        out.append(_Blobs(factor * (uv + 0.5) - 0.5, response[v, u], at))
    return out


def _background(grey: NDArray[np.float32], scale: float) -> NDArray[np.float32]:
    """Return the blur of an image (h, w) over many beads of a scale."""
    return wide_blur(grey, BACKGROUND * scale, COARSE_BLUR)


def _light_around(light: np.ndarray, scale: float) -> np.ndarray:
    """Return the light (h, w) around beads of a scale; it is positive."""
    return np.maximum(_background(light, scale), 1e-3 * light.max())


def _noise_of_response(noise: Noise, scale: float) -> float:
    """Return the standard deviation of a second derivative at a scale, over that of a grey value.

    It is the sum over the correlation of the noise and that of the derivative of a Gaussian.
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
    # A correlation with lags set to zero need not be that of any noise.
    variance = np.sum(noise.correlation * np.outer(across, along))
    return float(np.sqrt(max(variance, along[lags] * across[lags])))


def responses(
    grey: NDArray[np.float32], scale: float, polarities: Sequence[bool] = (False, True)
) -> list[NDArray[np.float32]]:
    """Return responses (h, w) to dark and to bright blobs: the smaller eigenvalue, or 0.

    polarities: True for bright blobs.
    """
    out = [np.empty(grey.shape, dtype=np.float32) for _ in polarities]
    for rows, mean, spread in _curvatures(grey, scale):
        for inverted, response in zip(polarities, out):
            smaller = -mean - spread if inverted else mean - spread
            np.maximum(smaller, 0, out=response[rows])
    return out


def _curvatures(
    grey: NDArray[np.float32], scale: float
) -> Iterator[tuple[slice, NDArray[np.float32], NDArray[np.float32]]]:
    """Yield rows, and the mean and half the difference of the eigenvalues of the scaled Hessian.

    A few rows are processed at a time, so that intermediate results stay in the cache of a core.
    """
    smooth = cv2.GaussianBlur(grey, (0, 0), scale)
    second_difference = np.array([1.0, -2.0, 1.0], dtype=np.float32)
    identity = np.array([0.0, 1.0, 0.0], dtype=np.float32)
    first_difference = np.array([-0.5, 0.0, 0.5], dtype=np.float32)
    step = max(PIXELS_AT_ONCE // grey.shape[1], 1)
    for first in range(0, len(grey), step):
        last = min(first + step, len(grey))
        above = max(first - 1, 0)
        strip = smooth[above : last + 1]
        inner = slice(first - above, last - above)
        xx = cv2.sepFilter2D(strip, cv2.CV_32F, second_difference, identity)[inner]
        yy = cv2.sepFilter2D(strip, cv2.CV_32F, identity, second_difference)[inner]
        xy = cv2.sepFilter2D(strip, cv2.CV_32F, first_difference, first_difference)[inner]
        mean = (0.5 * scale**2) * (xx + yy)
        xx -= yy
        xx *= 0.5
        xx *= xx
        xy *= xy
        xx += xy
        spread = np.sqrt(xx, out=xx)
        spread *= scale**2
        yield slice(first, last), mean, spread


def _maxima(
    response: np.ndarray, scale: float, least: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return rows and columns (n,) of local maxima of a response (h, w) inside the border."""
    size = 2 * max(1, round(scale)) + 1
    mask = response >= cv2.dilate(response, np.ones((size, size), np.uint8))
    mask &= response > least
    mask[[0, -1]] = False
    mask[:, [0, -1]] = False
    v, u = np.divmod(np.flatnonzero(mask), mask.shape[1])
    return v, u


def _beads(blobs: _Blobs, field: NDArray[np.bool_], count: int) -> _Blobs:
    """Return the blobs in the field that are beads, none if they are too weak."""
    inside = _inside(blobs.uv, field)
    values = np.where(inside, blobs.relative, 0)
    typical = _typical(values[inside], min(count, max(int(inside.sum()), 1)))
    return blobs.chosen(inside & (values > MIN_SHARE * typical) & (typical >= MIN_CONTRAST))
