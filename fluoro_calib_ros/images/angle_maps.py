# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Maps of corrected images for a correction that depends on the angle of a C-arm.

While a C-arm turns, every image needs another map, and iterating a map for each pixel takes far
longer than the time between images. The iteration is avoided: with the mean correction d and the
change e at an angle, the source S of pixel x is S = x + d(S) + e(S), which is the source of pixel
x + e(S) by d alone. The map at an angle is therefore that of the mean, shifted by its difference
between x + e(S) and x. The shift is smooth: it is computed at every eighth pixel and interpolated.

Angles are rounded to steps within which no pixel moves by more than LIMIT_PX. A map therefore
serves all images of an arm that stands still, and depends only on the angle.
"""

from __future__ import annotations

from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from ..correction.angle_field import AngleField
from ..correction.base import CorrectionStatus
from ..correction.fluoroscope_calibration import FluoroscopeCalibration
from ..correction.series import sd_grid_pixels
from .corrector import (
    FULL_STEPS,
    LIMIT_PX,
    STRIPE,
    ImageCorrector,
    continued,
    is_folded,
    iterated,
    steps,
)

NODE_PX = 8  # distance between nodes at which the change is iterated
TURN = np.deg2rad(np.arange(360.0))  # angles at which the change and its rate are measured


class AngleMaps:
    """Correctors of the images of one fluoroscope at the angles of its C-arm.

    The corrector of the last angle is kept. Not thread-safe.

    interpolation, border: see `ImageCorrector`. Raises the same DataError as ImageCorrector.
    """

    def __init__(
        self, calibration: FluoroscopeCalibration, interpolation: str = 'linear', border: int = 0
    ) -> None:
        #: corrector of the mean over the angles, for unknown angles or a constant correction
        self.mean = ImageCorrector(calibration, interpolation, border)
        self.built = 0  #: number of maps built for angles
        #: step to which angles are rounded [rad]; infinite if the correction does not change
        self.step = np.inf
        self._calibration = calibration
        self._last: tuple[float, ImageCorrector] | None = None
        self._field = calibration.angle_field
        if self._field is not None:
            rate, largest = _rate(self._field)
            # If half a turn moves no pixel by more than the limit, one map serves all angles.
            self.step = 2 * LIMIT_PX / rate if np.pi * rate > LIMIT_PX else np.inf
            self._base = _Base(calibration, int(np.ceil(largest)) + NODE_PX)

    def rounded(self, angle: float | None) -> float | None:
        """Return the angle [rad] of the map used for an angle; None for the mean."""
        if angle is None or np.isinf(self.step):
            return None
        return round(angle / self.step) * self.step

    def at(self, angle: float | None) -> ImageCorrector:
        """Return the corrector for an angle [rad], None if unknown.

        At an angle far from all calibrated angles, all pixels are OUTSIDE.
        """
        angle = self.rounded(angle)
        if angle is None or self._field is None:
            return self.mean
        if self._last is None or self._last[0] != angle:
            sources = _AtAngle(self._base, self._field, angle)
            mean = self.mean
            corrector = ImageCorrector(self._calibration, mean.interpolation, mean.border, sources)
            self._last = angle, corrector
            self.built += 1
        return self._last[1]


class _Base:
    """Map of the mean, extended around the image.

    margin: width of the extension [px], for pixels whose source the change moves.
    """

    def __init__(self, calibration: FluoroscopeCalibration, margin: int) -> None:
        self._grid = calibration.grid
        self._size = calibration.image_size
        self.height = self._size[1]
        self.margin = margin
        width, height = (side + 2 * margin for side in self._size)
        source = np.empty((2, height, width), dtype=np.float32)
        bad = np.empty((height, width), dtype=np.uint8)
        for start in range(0, height, STRIPE):
            rows = np.arange(start, min(start + STRIPE, height))
            u = np.tile(np.arange(width), len(rows)) - margin
            v = np.repeat(rows, width) - margin
            ideal = np.stack([u, v]).astype(float)
            # A kink at the border would not be interpolated well between nodes on both sides.
            observed = iterated(self._grid, ideal, continued)
            error = np.abs(observed - continued(self._grid, observed) - ideal).max(axis=0)
            source[:, rows] = observed.reshape(2, -1, width)
            bad[rows] = ~(error <= LIMIT_PX).reshape(-1, width)
        bad |= is_folded(source)
        right, down = steps(source)
        self._least_area = float((right[0] * down[1] - right[1] * down[0]).min())
        self._longest_step = float(max(np.abs(right).max(), np.abs(down).max()))
        # A source is interpolated between four pixels, none of which may be bad.
        self._bad = cv2.dilate(bad, np.ones((3, 3), np.uint8)) if bad.any() else None
        image_part = slice(margin, -margin)
        self._source = np.ascontiguousarray(source[:, image_part, image_part])
        self._high = np.array(self._size, dtype=np.float32)[:, None, None] - np.float32(0.5)
        self._inner = [self._far_from_rim(start) for start in range(0, self._size[1], STRIPE)]
        pixels = np.moveaxis(np.indices((height, width))[::-1], 0, 2).astype(np.float32)
        shift = np.moveaxis(source, 0, 2) - pixels + np.float32(margin)
        self._shift = np.ascontiguousarray(shift)  # else OpenCV copies it each time
        nodes = [np.arange(0.5 - NODE_PX / 2 - 1, side + NODE_PX, NODE_PX) for side in self._size]
        self._nodes = np.stack(np.meshgrid(*nodes), axis=2).astype(np.float32) + np.float32(margin)
        self._shift_of_nodes = self._shift_at(self._nodes)

    def _far_from_rim(self, start: int) -> slice:
        """Return the columns of a stripe whose sources are in the image at all angles."""
        sources = self._source[:, start : start + STRIPE]
        near_rim = (sources < self.margin - 0.5) | (sources >= self._high - self.margin)
        width = self._size[0]
        columns = np.flatnonzero(near_rim.reshape(-1, width).any(axis=0))
        left, right = columns[columns < width // 2], columns[columns >= width // 2]
        return slice(left.max(initial=-1) + 1, right.min(initial=width))

    def of_stripe(
        self, start: int, shift: NDArray[np.float32], is_small: bool
    ) -> NDArray[np.float32]:
        """Return sources (2, r, w) of a stripe, shifted by values at nodes; NaN off the image.

        is_small: True if no shift is larger than the margin.
        """
        mean = self._source[:, start : start + STRIPE]
        source = np.empty_like(mean)
        for out, of_mean, of_nodes in zip(source, mean, shift):
            cv2.add(of_mean, self._between(of_nodes, start), dst=out)
        inner = self._inner[start // STRIPE] if is_small else slice(0, 0)
        for columns in (slice(0, inner.start), slice(inner.stop, None)):
            block = source[:, :, columns]
            block[:, ~((block >= -0.5) & (block < self._high)).all(axis=0)] = np.nan
        return source

    def _between(self, of_nodes: NDArray[np.float32], start: int) -> NDArray[np.float32]:
        """Interpolate values (r, w) at the pixels of a stripe from those at nodes.

        The first node is half a step before the image: resizing starts between two nodes.
        """
        width, height = self._size
        count = min(STRIPE, height - start)
        stripe_nodes = of_nodes[start // NODE_PX : -(-(start + count) // NODE_PX) + 2]
        fine = cv2.resize(
            stripe_nodes, (stripe_nodes.shape[1] * NODE_PX, stripe_nodes.shape[0] * NODE_PX)
        )
        return fine[NODE_PX : NODE_PX + count, NODE_PX : NODE_PX + width]

    def status(self, source: NDArray[np.float32]) -> NDArray[np.uint8]:
        """Return the status (h, w) of the observed pixels at sources (2, h, w)."""
        row_status = [
            self._grid.look_up(*source[:, row].astype(float))[1] for row in range(source.shape[1])
        ]
        return np.stack(row_status)

    def may_fold(self, shift: NDArray[np.float32]) -> bool:
        """Return whether sources shifted by (2, rows, columns) may show pixels mirrored."""
        if self._bad is not None:
            return True
        # The determinant of the steps changes by no more than this.
        turn = max(np.abs(np.diff(shift, axis=axis)).max() for axis in (1, 2)) / NODE_PX
        return bool(self._least_area <= 4 * self._longest_step * turn + 2 * turn**2)

    def folded(
        self, source: NDArray[np.float32], change: NDArray[np.float32]
    ) -> NDArray[np.bool_]:
        """Return (h, w) whether sources are folded, or if their pixel has none by the mean."""
        folded = is_folded(source)
        if self._bad is None:
            return folded
        for start in range(0, self._size[1], STRIPE):
            u, v = (self._between(component, start) for component in cv2.split(change))
            u = u + (np.arange(u.shape[1], dtype=np.float32) + self.margin)
            v = v + (np.arange(start, start + len(v), dtype=np.float32) + self.margin)[:, None]
            bad = cv2.remap(self._bad, u, v, cv2.INTER_NEAREST, borderValue=1) > 0
            folded[start : start + STRIPE] |= bad
        return folded

    def at_nodes(
        self, field: AngleField, angle: float
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the change of the correction, and the shift of sources (2, rows, columns)."""
        shift = self._shift_of_nodes
        change = np.zeros_like(self._nodes)
        for _ in range(FULL_STEPS):
            before = change
            source = self._nodes + change + shift - self.margin
            source = np.clip(source, -self.margin, self._size + np.float32(self.margin))
            change = field.duv(source.reshape(-1, 2), angle).reshape(change.shape)
            change = change.astype(np.float32)
            shift = self._shift_at(self._nodes + change)
            # A step leaves the fraction by which the change differs per pixel.
            if np.abs(change - before).max() < LIMIT_PX:
                break
        return change, np.stack(cv2.split(change + shift - self._shift_of_nodes))

    def _shift_at(self, places: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return source minus pixel (rows, columns, 2) of the mean at places [px]."""
        return cv2.remap(
            self._shift, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )


class _AtAngle:
    """`corrector.Sources` at an angle [rad]; the whole map is built only on demand."""

    def __init__(self, base: _Base, field: AngleField, angle: float) -> None:
        self._base = base
        self._covered = bool(field.covers(angle))
        change, self._shift = base.at_nodes(field, angle)
        self._is_small = bool(np.abs(self._shift).max() < base.margin)
        self._folded: NDArray[np.bool_] | None = None
        if base.may_fold(self._shift):
            self._folded = base.folded(self.source, change)
            del self.source  # built without the folds

    def of_stripe(self, start: int) -> NDArray[np.float32]:
        """See `corrector.Sources`."""
        source = self._base.of_stripe(start, self._shift, self._is_small)
        if self._folded is not None:
            source[:, self._folded[start : start + STRIPE]] = np.nan
        return source

    @cached_property
    def source(self) -> NDArray[np.float32]:
        """See `corrector.Sources`."""
        starts = range(0, self._base.height, STRIPE)
        return np.concatenate([self.of_stripe(start) for start in starts], axis=1)

    @cached_property
    def status(self) -> NDArray[np.uint8]:
        """See `corrector.Sources`."""
        status = self._base.status(self.source)
        if not self._covered:
            status[status != CorrectionStatus.INVALID] = CorrectionStatus.OUTSIDE
        return status


def _rate(field: AngleField) -> tuple[float, float]:
    """Return the largest rate of change of a pixel [px/rad] and the largest change [px].

    Beyond the angles that the field covers, its change is extrapolated without a limit.
    """
    uv = sd_grid_pixels(field.image_size)
    changes = np.array([field.duv(uv, float(angle)) for angle in TURN])
    rates = np.diff(changes, axis=0, append=changes[:1]) / (TURN[1] - TURN[0])
    covered = field.covers(TURN)
    return _longest(rates[covered]), _longest(changes[covered])


def _longest(vectors: NDArray[np.float64]) -> float:
    """Return the length of the longest of vectors (..., 2)."""
    return float(np.hypot(vectors[..., 0], vectors[..., 1]).max())
