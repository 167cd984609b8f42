# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Light of an image around markers; detection and appearance of markers in their first image.

Only windows around predictions are evaluated, about a twentieth of an image. They are filtered as
one tall image, so that a few calls to OpenCV serve all markers. The response to a round shadow is
the smaller eigenvalue of the Hessian, as in `detection`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..errors import DataError
from ..findings import Kind
from .clipping import UNCLIPPED, Clipping
from .detection import (
    BLOB_RADIUS,
    MIN_SIZE,
    SCALES,
    field_of_view,
    responses,
)
from .imaging import estimate_profile
from .light import Light, Noise, estimate_noise, vertex, white_level
from .marker_motion import GIVEN_GATE, GIVEN_SD_PX, MarkerStates, Motion, assign
from .measurement import circles
from .profile import Profile

MARKER_SCALES = SCALES[:5]  # markers are smaller than beads
# Least response, as a fraction of the light around it. Without noise, the bones of a rendering
# respond by 0.005 to 0.01 at the sizes of markers (median of the 40 strongest maxima), and markers
# by 0.13; after a Gaussian blur of 1.2 px, by 0.07.
MIN_CONTRAST = 0.02
MIN_SNR = 4.5  # least response, over the noise of the response
SHARE = 0.35  # least response of a marker, over that to a typical marker
BACKGROUND_PX = 6  # half the width of the box whose mean is the light around a pixel
SAMPLED = 4  # step of rows and columns when pixels are subsampled
SPARSE = 8  # step of the pixels whose median, of five by five, is the light of wide surroundings
SAME_PX = 1.0  # distance between maxima below which they are one shadow
BORDER = 3  # width of the edge of a window that is not searched, in scales of the blur


@dataclass(frozen=True)
class Shadows:
    """Round shadows: places (n, 2) [px] to about 0.1 px, and strengths (n,).

    The strength is the response over the light around the shadow, less in the dark, as far as it
    has more noise there.
    """

    uv: NDArray[np.float64]
    strength: NDArray[np.floating]

    def strongest(self, count: int) -> Shadows:
        """Return the strongest shadows, at most `count`."""
        order = np.argsort(-self.strength, kind='stable')[:count]
        return Shadows(self.uv[order], self.strength[order])

    def distinct(self) -> Shadows:
        """Return the shadows without those at the place of a stronger shadow."""
        order = np.argsort(-self.strength, kind='stable')
        uv = self.uv[order]
        tree = cKDTree(uv)
        duplicates = {int(j) for i, j in tree.query_pairs(SAME_PX) if i < j}
        kept = order[[number for number in range(len(order)) if number not in duplicates]]
        return Shadows(self.uv[kept], self.strength[kept])


@dataclass(frozen=True)
class MarkerLook:
    """Appearance of markers in the images of a sequence."""

    scale: float  #: blur with the largest response [px]
    white: float | None  #: grey value without light if markers are bright, None if they are dark
    field: NDArray[np.bool_]  #: (h, w), the field of view
    strength: float  #: response to a typical marker over the light around it
    floor: float  #: response below which noise is likely, at the usual light
    light: float  #: usual light: the median in the field
    clipping: Clipping = UNCLIPPED  #: of the light

    @property
    def radius_px(self) -> float:
        """Radius of a blurred marker [px]."""
        return self.scale * BLOB_RADIUS


@dataclass(frozen=True)
class FilteredLight:
    """Light (h, w) of an image with dark markers, filtered for shadows of one size."""

    scale: float
    white: float | None  # as of MarkerLook
    light: NDArray[np.float32]
    response: NDArray[np.float32]
    around: NDArray[np.float32]  # mean of the surrounding light
    # Median light (h / SPARSE, w / SPARSE) of wide surroundings, None for windows of an image.
    wide: NDArray[np.float32] | None = None

    @cached_property
    def relative(self) -> NDArray[np.float32]:
        """Response (h, w) over the surrounding light."""
        return self.relative_at(np.s_[:, :])

    def relative_at(self, pixels: Any) -> NDArray[np.float32]:
        """Return the same at an index of pixels."""
        light = np.maximum(self.around[pixels], self._least)
        return np.asarray(np.divide(self.response[pixels], light, out=light))

    @cached_property
    def _least(self) -> float:
        return 1e-3 * float(self.light.max())

    @cached_property
    def field(self) -> NDArray[np.bool_]:
        """Field of view (h, w)."""
        return field_of_view(self.light, self.scale)

    @cached_property
    def maxima(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows and columns (k,) of the local maxima of the relative response.

        In a whole image, a shadow is darker than its wide surroundings, unlike the gaps of bright
        letters.
        """
        kernel = np.ones((2 * max(1, round(self.scale)) + 1,) * 2, np.uint8)
        dilated = cv2.dilate(self.relative, kernel)
        largest = self.relative >= dilated
        largest &= self.relative > 0
        row, column = np.divmod(np.flatnonzero(largest), largest.shape[1])
        if self.wide is not None:
            # The response is less than the depth of a shadow.
            least = self.wide[row // SPARSE, column // SPARSE] - self.response[row, column]
            dark = self.light[row, column] < least
            row, column = row[dark], column[dark]
        return row, column

    @cached_property
    def noise(self) -> float:
        """Median of the positive relative responses, from a part of the pixels."""
        part = self.relative_at(np.s_[::SAMPLED, ::SAMPLED])
        positive = part[part > 0]
        return float(np.median(positive)) if len(positive) else 0.0

    @cached_property
    def usual(self) -> float:
        """Median light in the field, from a part of the pixels."""
        part = self.light[::SAMPLED, ::SAMPLED]
        field = self.field[::SAMPLED, ::SAMPLED]
        return float(np.median(part[field])) if field.any() else float(self.light.mean())


class FilteredImage:
    """A whole image (h, w), filtered once for each size of shadows, on demand."""

    def __init__(self, image: np.ndarray) -> None:
        self.image = image
        self._by_scale: dict[float, tuple[FilteredLight, FilteredLight]] = {}
        grey = image.astype(np.float32)
        around = cv2.blur(grey, (2 * BACKGROUND_PX + 1,) * 2)
        self._white = white_level(image)
        wide = cv2.medianBlur(np.ascontiguousarray(grey[::SPARSE, ::SPARSE]), 5)
        dark = grey, around, wide
        self._lights = dark, tuple(self._white - values for values in dark)

    def of_scale(self, scale: float) -> tuple[FilteredLight, FilteredLight]:
        """Return the image filtered for dark shadows and for bright shadows."""
        if scale not in self._by_scale:
            dark, bright = self._lights
            filtered = responses(dark[0], scale)
            self._by_scale[scale] = (
                FilteredLight(scale, None, dark[0], filtered[0], *dark[1:]),
                FilteredLight(scale, self._white, bright[0], filtered[1], *bright[1:]),
            )
        return self._by_scale[scale]


class LightWindows:
    """Reads windows of one image, in which markers are dark."""

    def __init__(self, image: np.ndarray, look: MarkerLook) -> None:
        self._flat = image.reshape(-1)
        self._field = look.field.reshape(-1)
        self._all = bool(look.field.all())
        self.shape = image.shape
        self._white = look.white
        self.clipping = look.clipping

    def read(
        self, middle: NDArray[np.int64], offset: NDArray[np.int64]
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Return grey values (n, m) of float32 at middle (n, 2) + offset (m, 2), and validity."""
        height, width = self.shape
        column = middle[:, :1] + offset[:, 0]
        row = middle[:, 1:] + offset[:, 1]
        reach = int(np.abs(offset).max(initial=0))
        inside = (
            (middle.min(initial=reach) >= reach)
            and (middle[:, 0].max(initial=0) < width - reach)
            and (middle[:, 1].max(initial=0) < height - reach)
        )
        if inside:
            index = row * width + column
            valid = np.ones(index.shape, dtype=bool) if self._all else self._field.take(index)
        else:
            valid = (column >= 0) & (column < width) & (row >= 0) & (row < height)
            index = np.clip(row, 0, height - 1) * width + np.clip(column, 0, width - 1)
            valid &= self._field[index]
        grey = self._flat.take(index).astype(np.float32)
        return (grey if self._white is None else self._white - grey), valid


def check_image(image: np.ndarray, size: tuple[int, int] | None = None) -> None:
    """Raise DataError, in one sentence, if nothing can be seen in an image.

    size: expected width and height.
    """
    if not isinstance(image, np.ndarray) or image.ndim != 2:
        raise DataError('an image must be an array of rows and columns of grey values')
    if image.dtype not in (np.uint8, np.uint16):
        raise DataError(f'the image has pixels of {image.dtype}, not of 8 or 16 bits')
    height, width = image.shape
    if min(image.shape) < MIN_SIZE:
        raise DataError(f'the image has only {width} x {height} px')
    if size is not None and (width, height) != size:
        raise DataError(
            f'the image is {width} x {height} px, but the first one is {size[0]} x {size[1]} px'
        )
    # Check a coarse sample first, which takes no time.
    sample = image[::16, ::16]
    if sample.min() == sample.max() and image.min() == image.max():
        cause = f'the image is empty: every pixel has the grey value {int(image.flat[0])}'
        raise DataError(cause, kind=Kind.IMAGE_EMPTY)


def _learn_look(
    image: FilteredImage, near: NDArray[np.float64]
) -> tuple[MarkerLook, FilteredLight]:
    """Learn the appearance of markers from an image and points (n, 2) near them.

    Also return the light filtered for them. Raises DataError if there is nothing round.
    """
    best: _Typical | None = None
    for scale in MARKER_SCALES:
        lights: Sequence[FilteredLight] = image.of_scale(scale)
        if best is not None and best.clear:  # then the polarity is known
            lights = lights[int(best.light.white is not None) :][:1]
        candidate = max(
            (_Typical.near(light, near) for light in lights), key=lambda typical: typical.snr
        )
        if best is None or candidate.merit > best.merit:
            best = candidate
        elif best.clear:
            break  # beyond the size of the markers, the response decreases
    assert best is not None
    return best.look('there is no round shadow where the markers are expected'), best.light


def first_shadows(lights: Iterable[FilteredLight], count: int) -> Shadows:
    """Find shadows in an image and learn the appearance of markers from it.

    lights: dark and bright light of one size. count: number of strongest shadows from which the
    appearance is learned. Raises DataError if there is nothing round.
    """
    best = max(
        (_Typical.strongest(light, count) for light in lights), key=lambda typical: typical.snr
    )
    look = best.look('there are no markers in the image, no round shadow rises above the noise')
    return _find_shadows(look, best.light)


def search_image(image: np.ndarray, look: MarkerLook) -> Shadows:
    """Find shadows in a whole image that may be markers."""
    grey = image.astype(np.float32)
    light = grey if look.white is None else look.white - grey
    return _find_shadows(look, _filtered(light, (2 * BACKGROUND_PX + 1,) * 2, look))


def _filtered(light: NDArray[np.float32], box: tuple[int, int], look: MarkerLook) -> FilteredLight:
    """Filter light for shadows of a look; the surrounding light is the mean of a box."""
    (response,) = responses(light, look.scale, (False,))
    return FilteredLight(look.scale, look.white, light, response, cv2.blur(light, box))


@dataclass(frozen=True)
class _Typical:
    """Response to a typical marker in a filtered image."""

    light: FilteredLight
    strength: float

    @classmethod
    def near(cls, light: FilteredLight, uv: NDArray[np.float64]) -> _Typical:
        """Return the median response near points (n, 2)."""
        height, width = light.response.shape
        around = np.rint(uv).astype(int)[:, None] + _square(int(np.ceil(GIVEN_GATE * GIVEN_SD_PX)))
        column = np.clip(around[..., 0], 0, width - 1)
        row = np.clip(around[..., 1], 0, height - 1)
        return cls(light, float(np.median(light.relative_at((row, column)).max(axis=1))))

    @classmethod
    def strongest(cls, light: FilteredLight, count: int) -> _Typical:
        """Return the median of the `count` maxima in the field that noise explains least."""
        row, column = light.maxima
        inside = light.field[row, column]
        row, column = row[inside], column[inside]
        values = light.relative[row, column]
        above = values / _rise(max(light.usual, 1.0), light.around[row, column])
        values = values[np.argsort(-above, kind='stable')[: max(count, 3)]]
        return cls(light, float(np.median(values)) if len(values) else 0.0)

    @property
    def snr(self) -> float:
        """Strength over the noise; it decides whether markers are dark or bright.

        The noise increases as the light decreases, and may be stronger than markers.
        """
        return self.strength / max(self.light.noise, 1e-9)

    @property
    def merit(self) -> float:
        """Strength reduced by noise, to compare sizes: small sizes respond most to noise, too."""
        return self.strength**2 / max(self.strength + self.light.noise, 1e-9)

    @property
    def clear(self) -> bool:
        """Whether noise does not explain the response."""
        return self.strength >= self.floor

    @property
    def floor(self) -> float:
        """Response below which noise is likely."""
        return max(MIN_SNR * self.light.noise, MIN_CONTRAST)

    def look(self, cause: str) -> MarkerLook:
        """Return the appearance of markers. Raises DataError with the cause if it is noise."""
        light = self.light
        if not self.clear:
            raise DataError(cause, kind=Kind.NO_MARKERS)
        return MarkerLook(
            light.scale,
            light.white,
            field=light.field,
            strength=self.strength,
            floor=self.floor,
            light=max(light.usual, 1.0),
            clipping=Clipping.of(light.light),
        )


def _find_shadows(look: MarkerLook, light: FilteredLight) -> Shadows:
    """Find the shadows of a whole filtered image."""
    row, column = light.maxima
    height, width = light.light.shape
    strong = light.relative[row, column] > max(SHARE * look.strength, look.floor)
    inside = (row > 0) & (row < height - 1) & (column > 0) & (column < width - 1)
    rows = np.flatnonzero(strong & inside & look.field[row, column])
    row, column = row[rows], column[rows]
    rise = _rise(look.light, light.around[row, column])
    clear = light.relative[row, column] >= look.floor * rise
    row, column, rise = row[clear], column[clear], rise[clear]
    response = light.relative
    at = response[row, column]
    # Interpolate to a part of a pixel.
    u = column + vertex(response[row, column - 1], at, response[row, column + 1])
    v = row + vertex(response[row - 1, column], at, response[row + 1, column])
    return Shadows(np.column_stack([u, v]), at / rise)


def search_windows(
    windows: LightWindows, middle: NDArray[np.int64], half: int, look: MarkerLook
) -> Shadows:
    """Search windows of 2 half + 1 px around pixels middle (n, 2); find each shadow once."""
    border = int(np.ceil(BORDER * look.scale))
    size = 2 * (half + border) + 1
    grey, valid = windows.read(middle, _square(half + border))
    light = _filtered(grey.reshape(-1, size), (2 * BACKGROUND_PX + 1, 1), look)
    # The seams between windows lie in their borders.
    searched = np.zeros((len(middle), size, size), dtype=bool)
    inner = np.s_[:, border:-border, border:-border]
    searched[inner] = valid.reshape(searched.shape)[inner]
    shadows = _find_shadows(replace(look, field=searched.reshape(-1, size)), light)
    number = (shadows.uv[:, 1] + 0.5).astype(int) // size
    place = shadows.uv.copy()
    place[:, 1] -= number * size
    place += middle[number] - half - border
    # Overlapping windows contain the same shadow.
    return Shadows(place, shadows.strength).distinct() if len(place) else shadows


@lru_cache(maxsize=64)
def _square(half: int) -> NDArray[np.int64]:
    """Return the pixels (m, 2) of a square window relative to its middle, row by row."""
    axis = np.arange(-half, half + 1)
    return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)


def _rise(usual: float, around: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return how much larger (n,) than at the usual light the noise of relative responses is."""
    light = np.maximum(around, 1e-3 * usual)
    return np.asarray(np.sqrt(np.maximum(usual / light, 1.0)))


MIN_DENSITY = 2e-6  # least density of false shadows [1/px^2]


@dataclass(frozen=True)
class MarkerStart:
    """Properties of the markers in the first image."""

    states: MarkerStates
    look: MarkerLook
    profile: Profile  #: shadow of a typical marker
    noise: Noise
    size: tuple[int, int]  #: width and height of the images [px]
    density: float  #: density of false shadows [1/px^2]


NOWHERE_PX = -2e4  # place of markers whose place is not known yet


def learn_start(image: FilteredImage, target_id: NDArray[np.int64], uv: np.ndarray) -> MarkerStart:
    """Learn from an image with markers near uv (n, 2) [px], NaN for places not known yet.

    Raises DataError if the markers are not in the image.
    """
    height, width = image.image.shape
    known = np.isfinite(uv).all(axis=1)
    given = uv[known]
    inside = ((given > -0.5) & (given < np.array([width, height]) - 0.5)).all(axis=1)
    if not inside.all():
        outside_id = int(target_id[known][~inside][0])
        raise DataError(f'marker {outside_id} of the first frame lies outside of the image')
    look, filtered = _learn_look(image, given)
    shadows = _find_shadows(look, filtered)
    row, column = assign(given, np.full(len(given), GIVEN_SD_PX**2), shadows.uv, GIVEN_GATE)
    if len(row) < max(1, len(given) // 2):
        raise DataError(
            f'only {len(row)} of {len(given)} markers of the first frame are in the image'
        )
    seen = np.flatnonzero(known)[row]
    place = np.where(known[:, None], uv, NOWHERE_PX)
    place[seen] = shadows.uv[column]
    unseen = np.ones(len(uv), dtype=int)
    unseen[seen] = 0
    light = filtered.light
    return MarkerStart(
        MarkerStates.start(Motion.start(place, GIVEN_SD_PX), unseen),
        look,
        profile=estimate_profile(
            Light(light, look.field, look.clipping),
            place[seen],
            circles(np.ones(len(seen))),
            look.radius_px,
        ),
        noise=estimate_noise(light, look.field & look.clipping.leaves(light)),
        size=(width, height),
        density=max((len(shadows.uv) - len(row)) / max(look.field.sum(), 1), MIN_DENSITY),
    )


MAX_HALF = 48  # largest half width of a search window [px]
STRIPS = 6  # strips of an image, searched in turn: a whole image takes as long as five exposures


class MarkerSearch:
    """Finds shadows where markers may be.

    gate: half width of a search window [standard deviations of the prediction]. lost_after: images
    without a marker after which it is lost. search_every: images in which all strips of the image
    are searched in turn if a marker is lost.
    """

    def __init__(
        self, look: MarkerLook, *, gate: float, lost_after: int, search_every: int
    ) -> None:
        self._look = look
        self._gate = gate
        self._lost_after = lost_after
        self._strips = min(STRIPS, search_every)
        self._every = search_every // self._strips

    def everywhere(self, image: np.ndarray) -> Shadows:
        """Find the shadows of a whole image."""
        return search_image(image, self._look)

    def lost(self, states: MarkerStates) -> NDArray[np.bool_]:
        """Return (n,) whether markers are searched in the whole image."""
        return np.asarray(states.unseen > self._lost_after)

    def shadows(
        self, image: np.ndarray, windows: LightWindows, states: MarkerStates, number: int
    ) -> Shadows:
        """Find shadows in an image; number: number of images since the first."""
        lost = self.lost(states)
        parts = []
        if lost.any() and number % self._every == 0:
            parts.append(self._of_strip(image, number // self._every % self._strips))
        reach = np.ceil(self._gate * np.sqrt(states.shadow_variance))
        in_windows = ~lost | (reach <= MAX_HALF)
        half = np.minimum(reach, MAX_HALF).astype(int)
        middle = np.rint(states.motion.uv).astype(int)
        # Few markers need wide windows; the other windows stay small.
        sizes = np.sort(half[in_windows])
        small_half = int(sizes[3 * len(sizes) // 4]) if len(sizes) else 0
        for rows in (in_windows & (half <= small_half), in_windows & (half > small_half)):
            if rows.any():
                size = int(half[rows].max())
                parts.append(search_windows(windows, middle[rows], size, self._look))
        if len(parts) == 1:
            return parts[0]
        uv = np.concatenate([np.zeros((0, 2)), *(part.uv for part in parts)])
        strength = np.concatenate([np.zeros(0), *(part.strength for part in parts)])
        return Shadows(uv, strength).distinct() if len(uv) else Shadows(uv, strength)

    def _of_strip(self, image: np.ndarray, strip: int) -> Shadows:
        """Find the shadows of a strip of rows of an image."""
        height = len(image)
        top, bottom = (height * edge // self._strips for edge in (strip, strip + 1))
        margin = BACKGROUND_PX + int(np.ceil(BORDER * self._look.scale))
        first = max(top - margin, 0)
        strip_rows = slice(first, min(bottom + margin, height))
        look = replace(self._look, field=self._look.field[strip_rows])
        shadows = search_image(image[strip_rows], look)
        uv = shadows.uv + [0, first]
        inside = (uv[:, 1] >= top - 0.5) & (uv[:, 1] < bottom - 0.5)
        return Shadows(uv[inside], shadows.strength[inside])
